//! Masks by cause, and their union.

use std::collections::BTreeMap;

use glam::DVec2;

use super::shape::Disc;
use crate::image::Image;

/// Why a pixel means nothing, or is left out of the scores.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Cause {
    /// Behind the collimator or in its penumbra, or outside an image intensifier's disc.
    Collimation,
    /// At the end of the frame's scale.
    Saturation,
    /// No signal at all: its logarithm does not exist.
    NoSignal,
    /// Text and marks that the console wrote into the pixels.
    BurnedIn,
    /// Not finite in the acquired frame: nothing was measured, or somebody marked it so.
    NotMeasured,
    /// The simulation says that it cannot know: beyond a cut face of the CT, or outside the field that the scene states.
    Invalid,
    /// The simulation shows a guess: what fills the place that a moved body left.
    Filled,
    /// Dead, hot or unstable, as the detector calibration says (they were interpolated), or as the frame shows by itself.
    DeadPixels,
    /// Around the beads, whose positions were fitted.
    Beads,
    /// The robot or another tool, which is scored apart.
    Tool,
    /// The mask that was handed in: things only in the acquired frame.
    Extra,
}

impl Cause {
    /// As people read it.
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::Collimation => "collimation",
            Self::Saturation => "saturation",
            Self::NoSignal => "no signal",
            Self::BurnedIn => "burned in",
            Self::NotMeasured => "not measured",
            Self::Invalid => "unknown to the DRR",
            Self::Filled => "filled where a body lay",
            Self::DeadPixels => "dead pixels",
            Self::Beads => "beads",
            Self::Tool => "tool",
            Self::Extra => "extra mask",
        }
    }
}

/// The share of the image that each cause takes; they may overlap.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct MaskShares {
    /// Share by cause, 0 to 1, for the causes that take anything.
    pub causes: BTreeMap<Cause, f64>,
    /// Share of the union.
    pub masked: f64,
    /// What is left: 1 − `masked`.
    pub left: f64,
    /// What the collimation was taken for: `left, top edges at …`, `disc of radius …`.
    pub field: Option<String>,
}

/// Below this share left nothing is scored.
pub const REQUIRED_SHARE: f64 = 0.25;
/// Blur that a bead's disc is widened by.
const BEAD_MARGIN_PX: f64 = 4.0;

/// All masks, and their union.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Masks {
    layers: Vec<(Cause, Image<bool>)>,
    /// What the open field was taken for; `None` where the frame shows no edge of one.
    pub field: Option<String>,
    /// Its round edge, if it has one: an iris's, or that of an image intensifier's input.
    pub disc: Option<Disc>,
}

impl Masks {
    /// Adds what is true in `mask` to what `cause` takes already.
    pub fn add(&mut self, cause: Cause, mask: Image<bool>) {
        match self.layers.iter_mut().find(|(known, _)| *known == cause) {
            Some((_, layer)) => layer.pixels.iter_mut().zip(&mask.pixels).for_each(|(taken, more)| *taken |= more),
            None => self.layers.push((cause, mask)),
        }
    }

    /// True where no cause (but those in `except`) applies.
    #[must_use]
    pub fn usable(&self, width: usize, height: usize, except: &[Cause]) -> Image<bool> {
        let mut usable = Image::filled(width, height, true);
        for (cause, mask) in &self.layers {
            if !except.contains(cause) {
                usable.pixels.iter_mut().zip(&mask.pixels).for_each(|(u, m)| *u &= !m);
            }
        }
        usable
    }

    /// What `cause` takes, if anything.
    #[must_use]
    pub fn layer(&self, cause: Cause) -> Option<&Image<bool>> {
        self.layers.iter().find(|(found, _)| *found == cause).map(|(_, mask)| mask)
    }

    /// True where a frame of this size shows nothing of what stood before the panel, because the collimator shuts it off.
    #[must_use]
    pub fn shut_off(&self, width: usize, height: usize) -> Image<bool> {
        let layer = self.layer(Cause::Collimation).filter(|layer| (layer.width, layer.height) == (width, height));
        layer.cloned().unwrap_or_else(|| Image::filled(width, height, false))
    }

    /// Share of each cause and of their union.
    #[must_use]
    pub fn shares(&self, width: usize, height: usize) -> MaskShares {
        let total = (width * height).max(1) as f64;
        let share = |mask: &Image<bool>| mask.pixels.iter().filter(|m| **m).count() as f64 / total;
        let left = share(&self.usable(width, height, &[]));
        let causes = self.layers.iter().map(|(cause, mask)| (*cause, share(mask))).filter(|(_, s)| *s > 0.0).collect();
        MaskShares { causes, masked: 1.0 - left, left, field: self.field.clone() }
    }
}

/// Discs around projected beads: centre and radius in pixels.
#[must_use]
pub fn discs(width: usize, height: usize, beads: &[(DVec2, f64)]) -> Image<bool> {
    let mut mask = Image::filled(width, height, false);
    for (centre, radius_px) in beads {
        let reach = 1.25 * radius_px + BEAD_MARGIN_PX;
        if !(centre.is_finite() && reach.is_finite()) {
            continue;
        }
        let range = |c: f64, end: usize| {
            (c - reach).floor().max(0.0) as usize..((c + reach).ceil() + 1.0).clamp(0.0, end as f64) as usize
        };
        for v in range(centre.y, height) {
            for u in range(centre.x, width) {
                if DVec2::new(u as f64, v as f64).distance(*centre) <= reach {
                    *mask.at_mut(u, v) = true;
                }
            }
        }
    }
    mask
}

/// A mask of blocks of `factor` × `factor` pixels: true where any pixel is.
#[must_use]
pub fn any_in_block(mask: &Image<bool>, factor: usize) -> Image<bool> {
    let (width, height) = ((mask.width / factor).max(1), (mask.height / factor).max(1));
    let mut coarse = Image::filled(width, height, false);
    for (at, _) in mask.pixels.iter().enumerate().filter(|(_, m)| **m) {
        let (u, v) = (at % mask.width / factor, at / mask.width / factor);
        if u < width && v < height {
            *coarse.at_mut(u, v) = true;
        }
    }
    coarse
}

impl Masks {
    /// All masks at `factor` times fewer pixels a side.
    #[must_use]
    pub fn binned(&self, factor: usize) -> Self {
        if factor == 1 {
            return self.clone();
        }
        let layers = self.layers.iter().map(|(cause, mask)| (*cause, any_in_block(mask, factor))).collect();
        // The centre of the first coarse pixel lies at (factor − 1)/2 fine pixels.
        let side = factor as f64;
        let coarse = |disc: Disc| Disc { centre: (disc.centre - 0.5 * (side - 1.0)) / side, radius_px: disc.radius_px / side };
        Self { layers, field: self.field.clone(), disc: self.disc.map(coarse) }
    }
}
