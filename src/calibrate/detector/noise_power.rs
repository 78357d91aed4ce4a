//! Normalised noise power: |Fourier transform|² of flat-fielded differences, per area, over the squared mean signal.

use super::air::{AirMap, Consistent};
use super::offset::Offset;
use crate::acquire::NoisePower;
use crate::image::Image;
use crate::image::fourier::{Complex, transform};

/// Sides of the regions that are tried.
const REGIONS_PX: [usize; 3] = [128, 64, 32];
/// A region with a larger share of bad pixels is left out; the others' are set to the mean.
const MOST_BAD: f64 = 0.02;

/// Of the pair with the most signal; `None` without a pair or on a panel smaller than a region.
pub(super) fn find(
    group: &Consistent,
    offset: &Offset,
    air: &AirMap,
    bad: &Image<u8>,
    pitch_mm: Option<f64>,
) -> Option<NoisePower> {
    let level = group.levels.iter().rev().find(|level| level.frames.len() >= 2)?;
    let (width, height) = (bad.width, bad.height);
    let side = REGIONS_PX.into_iter().find(|side| width >= 2 * side && height >= 2 * side)?;
    let mut power = vec![0.0; side * side];
    let mut regions = 0usize;
    for pair in level.frames.chunks(2).filter(|pair| pair.len() == 2) {
        let flat = |at: usize, frame: usize| {
            let share = f64::from(air.share.pixels[at]);
            if share > 0.0 { (f64::from(pair[frame].pixels.pixels[at]) - offset.at(at)) / share } else { 0.0 }
        };
        for top in (0..=height - side).step_by(side) {
            for left in (0..=width - side).step_by(side) {
                let place = |n: usize| (top + n / side) * width + left + n % side;
                let good: Vec<usize> = (0..side * side).filter(|&n| bad.pixels[place(n)] == 0).collect();
                if ((side * side - good.len()) as f64) > MOST_BAD * (side * side) as f64 {
                    continue;
                }
                let n = good.len() as f64;
                let means = [0, 1].map(|frame| good.iter().map(|&at| flat(place(at), frame)).sum::<f64>() / n);
                let mut values: Vec<Complex> = vec![[0.0, 0.0]; side * side];
                for &at in &good {
                    let relative = flat(place(at), 0) / means[0] - flat(place(at), 1) / means[1];
                    values[at] = [relative / std::f64::consts::SQRT_2, 0.0];
                }
                transform_square(&mut values, side);
                // Pixels that are missing carry no noise: the others stand for them.
                let norm = 1.0 / (n * regions_norm(side) / (side * side) as f64);
                power.iter_mut().zip(&values).for_each(|(sum, [re, im])| *sum += (re * re + im * im) * norm);
                regions += 1;
            }
        }
    }
    if regions == 0 {
        return None;
    }
    let pitch = pitch_mm.unwrap_or(1.0);
    let bins = side / 2;
    let (mut sums, mut counts) = (vec![0.0; bins + 1], vec![0.0; bins + 1]);
    for (at, value) in power.iter().enumerate() {
        let signed = |k: usize| if k > side / 2 { k as f64 - side as f64 } else { k as f64 };
        let radius = signed(at % side).hypot(signed(at / side)).round() as usize;
        if (1..=bins).contains(&radius) {
            sums[radius] += value / regions as f64;
            counts[radius] += 1.0;
        }
    }
    Some(NoisePower {
        exposure_mas: level.mas,
        regions,
        region_px: side,
        frequency_lp_per_mm: (1..=bins).map(|k| k as f64 / (side as f64 * pitch)).collect(),
        normalised_power_mm2: (1..=bins).map(|k| pitch * pitch * sums[k] / f64::max(counts[k], 1.0)).collect(),
    })
}

/// White noise of variance v has a power of v per pixel area.
fn regions_norm(side: usize) -> f64 {
    (side * side) as f64
}

fn transform_square(values: &mut [Complex], side: usize) {
    values.chunks_exact_mut(side).for_each(transform);
    let mut column = vec![[0.0, 0.0]; side];
    for u in 0..side {
        for v in 0..side {
            column[v] = values[v * side + u];
        }
        transform(&mut column);
        for v in 0..side {
            values[v * side + u] = column[v];
        }
    }
}
