//! Pixels that are not to be trusted: dead, hot or unstable.

use super::air::{AirMap, Consistent};
use super::offset::Offset;
use super::transfer::Transfer;
use crate::acquire::BadPixels;
use crate::acquire::panel_maps::{DEAD, HOT, UNSTABLE};
use crate::image::Image;

/// Outside this share of what its surroundings see, a pixel is dead.
const RESPONSE: std::ops::RangeInclusive<f64> = 0.5..=1.5;
/// A dark value this many robust deviations above the panel's …
const HOT_SIGMAS: f64 = 10.0;
/// … and this many deviations of the electronic noise is hot.
const HOT_READOUTS: f64 = 5.0;
/// A χ² this many of its own deviations too large, and this much in all, is no chance among 10⁷ pixels.
const UNSTABLE_SIGMAS: f64 = 8.0;
const UNSTABLE_MORE: f64 = 25.0;

/// From the darks alone.
pub(super) fn hot(offset: &Offset, size_px: [usize; 2]) -> Image<u8> {
    let mut bad = Image::filled(size_px[0], size_px[1], 0u8);
    let Some(map) = &offset.map else { return bad };
    let values: Vec<f64> = map.pixels.iter().map(|v| f64::from(*v)).collect();
    let (centre, deviation) = super::groups::median_and_deviation(&values);
    let readout = offset.readout_sigma.unwrap_or(1.0);
    let limit = (HOT_SIGMAS * deviation).max(HOT_READOUTS * readout).max(1.0);
    bad.pixels.iter_mut().zip(&values).filter(|(_, v)| !(**v - centre <= limit)).for_each(|(flag, _)| *flag |= HOT);
    offset.saturated.iter().for_each(|&at| bad.pixels[at] |= HOT);
    if let (Some((variance, frames)), true) = (&offset.temporal, readout > 0.0) {
        let freedom = (*frames - 1) as f64;
        let chi = |v: &f32| f64::from(*v) * freedom / (readout * readout);
        bad.pixels
            .iter_mut()
            .zip(&variance.pixels)
            .filter(|(_, v)| is_unstable(chi(v), freedom))
            .for_each(|(flag, _)| *flag |= UNSTABLE);
    }
    bad
}

fn is_unstable(chi: f64, freedom: f64) -> bool {
    !(chi <= freedom + UNSTABLE_SIGMAS * (2.0 * freedom).sqrt() + UNSTABLE_MORE)
}

/// Pixels that respond quite differently from the smooth surface.
pub(super) fn add_dead(bad: &mut Image<u8>, air: &AirMap) {
    for (at, flag) in bad.pixels.iter_mut().enumerate() {
        let response = f64::from(air.share.pixels[at]) / f64::from(air.smooth.pixels[at]);
        if !RESPONSE.contains(&response) {
            *flag |= DEAD;
        }
    }
}

/// Pixels that vary from frame to frame by more than quanta and electronics.
pub(super) fn add_unstable(bad: &mut Image<u8>, group: &Consistent, air: &AirMap, offset: &Offset, transfer: &Transfer) {
    let frames = group.levels.iter().flat_map(|level| level.frames.iter().map(move |frame| (level, *frame)));
    let frames: Vec<_> = frames.collect();
    if frames.len() < 4 {
        return;
    }
    let freedom = frames.len() as f64 - 1.0;
    let scales: Vec<f64> = frames
        .iter()
        .map(|(_, frame)| {
            // The frame's own output against the map, from an even sample of good pixels.
            let sample = (0..bad.pixels.len()).step_by(7).filter(|&at| bad.pixels[at] == 0 && air.share.pixels[at] > 0.0);
            let ratios = sample.map(|at| (f64::from(frame.pixels.pixels[at]) - offset.at(at)) / f64::from(air.share.pixels[at]));
            super::groups::median(ratios.map(|ratio| ratio as f32).collect())
        })
        .collect();
    for at in 0..bad.pixels.len() {
        let share = f64::from(air.share.pixels[at]);
        let chi: f64 = frames
            .iter()
            .zip(&scales)
            .map(|((_, frame), scale)| {
                let expected = scale * share;
                let off = f64::from(frame.pixels.pixels[at]) - offset.at(at) - expected;
                off * off / transfer.variance(expected).max(1.0 / 12.0)
            })
            .sum();
        if is_unstable(chi, freedom) {
            bad.pixels[at] |= UNSTABLE;
        }
    }
}

/// By kind.
pub(super) fn count(bad: &Image<u8>) -> BadPixels {
    let of = |kind: u8| bad.pixels.iter().filter(|flag| **flag & kind != 0).count();
    BadPixels { dead: of(DEAD), hot: of(HOT), unstable: of(UNSTABLE) }
}
