//! Which pixels are left out of every score, and why.

use std::collections::BTreeMap;

use glam::DVec2;

use super::collimation;
use super::filters::zip;
use crate::acquire::panel_maps::{AT_LOW_END, BURNED_IN, DEAD, HOT, SATURATED, UNSTABLE};
use crate::acquire::{Domain, Frame};
use crate::image::Image;

/// Why a pixel is left out of the scores.
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
    /// Not finite in either image, or the simulation says that it cannot know (truncated CT).
    Invalid,
    /// Dead, hot or unstable, as the detector calibration says; they were interpolated.
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
            Self::Invalid => "invalid",
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
pub(super) struct Masks {
    layers: Vec<(Cause, Image<bool>)>,
    pub field: Option<String>,
}

impl Masks {
    pub(super) fn new() -> Self {
        Self { layers: Vec::new(), field: None }
    }

    /// Adds what is true in `mask` to what `cause` takes already.
    pub(super) fn add(&mut self, cause: Cause, mask: Image<bool>) {
        match self.layers.iter_mut().find(|(known, _)| *known == cause) {
            Some((_, layer)) => layer.pixels.iter_mut().zip(&mask.pixels).for_each(|(taken, more)| *taken |= more),
            None => self.layers.push((cause, mask)),
        }
    }

    /// True where no cause (but those in `except`) applies.
    pub(super) fn usable(&self, width: usize, height: usize, except: &[Cause]) -> Image<bool> {
        let mut usable = Image::filled(width, height, true);
        for (cause, mask) in &self.layers {
            if !except.contains(cause) {
                usable.pixels.iter_mut().zip(&mask.pixels).for_each(|(u, m)| *u &= !m);
            }
        }
        usable
    }

    pub(super) fn layer(&self, cause: Cause) -> Option<&Image<bool>> {
        self.layers.iter().find(|(found, _)| *found == cause).map(|(_, mask)| mask)
    }

    pub(super) fn shares(&self, width: usize, height: usize) -> MaskShares {
        let total = (width * height).max(1) as f64;
        let share = |mask: &Image<bool>| mask.pixels.iter().filter(|m| **m).count() as f64 / total;
        let left = share(&self.usable(width, height, &[]));
        let causes = self.layers.iter().map(|(cause, mask)| (*cause, share(mask))).filter(|(_, s)| *s > 0.0).collect();
        MaskShares { causes, masked: 1.0 - left, left, field: self.field.clone() }
    }
}

/// Masks that the acquired frame alone decides, at its full size.
pub(super) fn of_frame(frame: &Frame) -> Masks {
    let pixels = &frame.pixels;
    let mut masks = Masks::new();
    masks.add(Cause::Invalid, pixels.map(|v| !v.is_finite()));
    if let Some(field) = collimation::detect(pixels, frame.larger_is_more_attenuation()) {
        masks.field = Some(field.description);
        masks.add(Cause::Collimation, field.outside);
    }
    // Writing is found first: its strokes lie at the ends of the scale as well, but are no clipping.
    let flagged = |flags: &Image<u8>, any: u8| flags.map(|flag| flag & any != 0);
    let at_end = |end: Option<f32>| pixels.map(|v| end == Some(*v));
    let flags = frame.correction.as_ref().and_then(|correction| correction.flags.as_deref());
    let mut saturated = at_end(frame.clipping.saturated_at);
    let mut black = at_end(frame.clipping.black_at);
    if let Some(flags) = flags {
        saturated = zip(&saturated, flags, |here, flag| *here || flag & SATURATED != 0);
        black = zip(&black, flags, |here, flag| *here || flag & AT_LOW_END != 0);
    }
    let written = burned_in(&[&saturated, &black]);
    masks.add(Cause::Saturation, saturated);
    if frame.domain == Domain::Display {
        masks.add(Cause::NoSignal, black);
    }
    masks.add(Cause::BurnedIn, written);
    if let Some(flags) = flags {
        masks.add(Cause::BurnedIn, flagged(flags, BURNED_IN));
        masks.add(Cause::DeadPixels, flagged(flags, DEAD | HOT | UNSTABLE));
    }
    masks
}

/// Discs around projected beads: centre and radius in pixels.
pub(super) fn discs(width: usize, height: usize, beads: &[(DVec2, f64)]) -> Image<bool> {
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

/// Letters are components of exactly one extreme value, a few to some dozen pixels high, in a row with at least two others of like
/// height. (A first form: writing in gray, or with a shadow, is not found; `--mask` takes it.)
fn burned_in(ends: &[&Image<bool>; 2]) -> Image<bool> {
    let mut written = Image::filled(ends[0].width, ends[0].height, false);
    for end in ends {
        let components = components(end);
        let letters: Vec<&Component> = components.iter().filter(|c| c.looks_like_a_letter(end.height)).collect();
        for letter in &letters {
            let neighbours = letters.iter().filter(|other| letter.stands_in_line_with(other)).count();
            // The letter itself is one of them.
            if neighbours >= 3 {
                letter.indices.iter().for_each(|&at| written.pixels[at] = true);
            }
        }
    }
    dilate_once(&written)
}

/// A connected set of pixels and its box (inclusive).
pub(super) struct Component {
    pub indices: Vec<usize>,
    left: usize,
    right: usize,
    top: usize,
    bottom: usize,
}

impl Component {
    fn height(&self) -> usize {
        self.bottom - self.top + 1
    }

    fn looks_like_a_letter(&self, image_height: usize) -> bool {
        let limit = (image_height / 12).max(8);
        let (width, height) = (self.right - self.left + 1, self.height());
        let fill = self.indices.len() as f64 / (width * height) as f64;
        (5..=limit).contains(&height) && width <= 2 * limit && self.indices.len() >= 5 && (0.1..=0.95).contains(&fill)
    }

    fn stands_in_line_with(&self, other: &Self) -> bool {
        let (height, other_height) = (self.height(), other.height());
        let like = height.abs_diff(other_height) <= height.max(other_height) / 2;
        let level = self.bottom.abs_diff(other.bottom) <= height / 2;
        let gap = if self.left > other.right { self.left - other.right } else { other.left.saturating_sub(self.right) };
        like && level && gap <= 4 * height
    }
}

/// 8-connected components of the true pixels.
pub(super) fn components(mask: &Image<bool>) -> Vec<Component> {
    let (width, height) = (mask.width, mask.height);
    let mut seen = vec![false; mask.pixels.len()];
    let mut found = Vec::new();
    for start in 0..mask.pixels.len() {
        if seen[start] || !mask.pixels[start] {
            continue;
        }
        seen[start] = true;
        let mut indices = vec![start];
        let mut next = 0;
        let (mut left, mut right, mut top, mut bottom) = (width, 0, height, 0);
        while next < indices.len() {
            let at = indices[next];
            next += 1;
            let (u, v) = (at % width, at / width);
            (left, right, top, bottom) = (left.min(u), right.max(u), top.min(v), bottom.max(v));
            for row in v.saturating_sub(1)..(v + 2).min(height) {
                for column in u.saturating_sub(1)..(u + 2).min(width) {
                    let beside = row * width + column;
                    if mask.pixels[beside] && !seen[beside] {
                        seen[beside] = true;
                        indices.push(beside);
                    }
                }
            }
        }
        found.push(Component { indices, left, right, top, bottom });
    }
    found
}

fn dilate_once(mask: &Image<bool>) -> Image<bool> {
    let mut wide = mask.clone();
    for v in 0..mask.height {
        for u in 0..mask.width {
            if *mask.at(u, v) {
                for row in v.saturating_sub(1)..(v + 2).min(mask.height) {
                    for column in u.saturating_sub(1)..(u + 2).min(mask.width) {
                        *wide.at_mut(column, row) = true;
                    }
                }
            }
        }
    }
    wide
}

/// A mask of blocks of `factor` × `factor` pixels: true where any pixel is.
pub(super) fn any_in_block(mask: &Image<bool>, factor: usize) -> Image<bool> {
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
    pub(super) fn binned(self, factor: usize) -> Self {
        let layers = self.layers.into_iter().map(|(cause, mask)| (cause, any_in_block(&mask, factor))).collect();
        Self { layers, field: self.field }
    }
}
