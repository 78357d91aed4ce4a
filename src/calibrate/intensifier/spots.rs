//! The round mask of the frames, and the spots of the grid in one of them.

use glam::DVec2;

use super::frames::GridFrame;
use crate::acquire::Frame;
use crate::beads::{Detection, Expectation, Signal, detect, detect_image, known_at_best};
use crate::estimate::median;
use crate::image::Image;
use crate::mask::{Disc, find_field};

/// What the grid is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum GridOf {
    /// Metal beads: dark where the signal is transmission.
    Beads,
    /// Holes in a metal plate.
    Holes,
}

/// A spot of the grid in the frame.
#[derive(Clone, Copy, Debug)]
pub struct Spot {
    /// Its centre.
    pub image_px: DVec2,
    /// Standard deviation per axis, the mean of both.
    pub sigma_px: f64,
    /// Covariance of the centre: uu, uv, vv.
    pub noise_px2: [f64; 3],
}

impl Spot {
    /// Where a shadow lies.
    pub fn of(shadow: &Detection) -> Self {
        Self {
            image_px: shadow.image_px,
            sigma_px: shadow.sigma_px.max(LEAST_SIGMA_PX),
            noise_px2: known_at_best(shadow.noise_px2(), LEAST_SIGMA_PX),
        }
    }
}

/// Spots of one grid have radii within this factor of the median.
const ALIKE: f64 = 1.7;
/// A disc smaller than this share of the frame's shorter side is a hole, or the collimator's, and not the intensifier's.
const LEAST_DISC: f64 = 0.25;
/// What is known of centres at best: thresholds, pixels' gain.
const LEAST_SIGMA_PX: f64 = 0.03;

/// The round mask that all frames share, and where it comes from: given, else the median of those seen in the frames, else the largest that
/// the frame holds.
#[must_use]
pub fn disc(frames: &[GridFrame], given: Option<Disc>) -> (Disc, String) {
    if let Some(disc) = given {
        return (disc, "the round mask was given".to_owned());
    }
    let seen = |frame: &Frame| find_field(&frame.pixels, frame.larger_is_more_attenuation(), frame.domain.is_gray())?.shape.disc;
    let large = |disc: &Disc, frame: &Frame| disc.radius_px >= LEAST_DISC * frame.size_px[0].min(frame.size_px[1]) as f64;
    let discs: Vec<Disc> =
        frames.iter().filter_map(|GridFrame { frame, .. }| seen(frame).filter(|disc| large(disc, frame))).collect();
    let usual = |of: fn(&Disc) -> f64| median(discs.iter().map(of));
    let centre = usual(|disc| disc.centre.x).zip(usual(|disc| disc.centre.y));
    let Some(((x, y), radius_px)) = centre.zip(usual(|disc| disc.radius_px)) else {
        let [width, height] = frames.first().map_or([0, 0], |frame| frame.frame.size_px).map(|n| n as f64);
        let centre = 0.5 * DVec2::new(width - 1.0, height - 1.0);
        let disc = Disc { centre, radius_px: 0.5 * width.min(height) };
        return (disc, "no round mask shows in the frames: the largest disc in the frame is taken for it (--disc)".to_owned());
    };
    let disc = Disc { centre: DVec2::new(x, y), radius_px };
    (disc, format!("the round mask was seen in {} of {} frames", discs.len(), frames.len()))
}

/// The spots of `grid` inside `disc`.
pub fn find(frame: &Frame, grid: GridOf, disc: &Disc) -> Vec<Spot> {
    let pixels = &frame.pixels;
    let usable = inside(frame, disc);
    let expected = Expectation { radius_px: None, grid: true };
    let mut found = match grid {
        GridOf::Beads => detect(frame, Some(&usable), &expected).found,
        GridOf::Holes => {
            let bright = if frame.larger_is_more_attenuation() { pixels.map(|value| -value) } else { pixels.clone() };
            detect_image(&bright, Signal::Attenuation, Some(&usable), &expected).found
        }
    };
    if let Some(median_px) = median(found.iter().map(|spot: &Detection| spot.radius_px)) {
        found.retain(|spot| spot.radius_px < ALIKE * median_px && spot.radius_px * ALIKE > median_px);
    }
    found.iter().map(Spot::of).collect()
}

/// Pixels of the frame inside `disc`, its rim left out.
pub fn inside(frame: &Frame, disc: &Disc) -> Image<bool> {
    let mut inside = frame.pixels.map(|_| false);
    for (index, inside) in inside.pixels.iter_mut().enumerate() {
        let at = DVec2::new((index % frame.pixels.width) as f64, (index / frame.pixels.width) as f64);
        *inside = at.distance(disc.centre) <= disc.radius_px - 1.0;
    }
    inside
}
