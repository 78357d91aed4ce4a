//! Veiling glare: light of an image intensifier that is spread far about.
//!
//! A share of the light that falls on a point is spread by e^(−r/k)/(2πkr), whose integral over the plane is 1 (Seibert, Nalcioglu, Roeck
//! 1984). So wide a blur is made of blocks of pixels: what one block sends to another is the kernel's mean over it.

use rayon::prelude::*;

/// Blocks along the longer side.
const BLOCKS: usize = 96;
/// Points by which the kernel is averaged over blocks nearby, along each side.
const POINTS: i32 = 6;
/// Blocks that are nearby.
const NEAR: i32 = 3;

/// Side of the blocks of a frame in pixels, and how many there are across and down.
fn blocks([width, height]: [usize; 2]) -> (usize, [usize; 2]) {
    let factor = width.max(height).div_ceil(BLOCKS).max(1);
    (factor, [width.div_ceil(factor), height.div_ceil(factor)])
}

/// Pairs of blocks between which the light of a frame is spread.
#[must_use]
pub fn block_pairs(size_px: [usize; 2]) -> f64 {
    let (_, [across, down]) = blocks(size_px);
    ((across * down) as f64).powi(2)
}

/// All of `light` (row-major, one sum per pixel) spread with the scale k, per pixel. What leaves the frame is lost, nothing enters it.
#[must_use]
pub fn spread(light: &[f64], [width, height]: [usize; 2], scale_px: f64) -> Vec<f64> {
    if light.is_empty() {
        return Vec::new();
    }
    let (factor, [across, down]) = blocks([width, height]);
    let mut sums = vec![0.0; across * down];
    for (index, value) in light.iter().enumerate() {
        sums[index / width / factor * across + index % width / factor] += value;
    }
    let kernel = kernel(across.max(down), factor as f64, scale_px);
    let reach = across.max(down);
    let blurred: Vec<f64> = (0..across * down)
        .into_par_iter()
        .map(|to| {
            let (column, row) = (to % across, to / across);
            let line = |from: usize| {
                let weights = &kernel[from.abs_diff(row) * reach..][..reach];
                (0..across).map(|at| sums[from * across + at] * weights[at.abs_diff(column)]).sum::<f64>()
            };
            (0..down).map(line).sum()
        })
        .collect();
    // Block b has its middle at (b + ½) · factor − ½.
    let place = |pixel: usize, blocks: usize| {
        let at = ((pixel as f64 + 0.5) / factor as f64 - 0.5).clamp(0.0, (blocks - 1) as f64);
        let low = (at as usize).min(blocks.saturating_sub(2));
        (low, (low + 1).min(blocks - 1), at - low as f64)
    };
    let mut out = vec![0.0; light.len()];
    out.par_chunks_mut(width).enumerate().for_each(|(row, values)| {
        let (top, bottom, down_share) = place(row, down);
        for (column, value) in values.iter_mut().enumerate() {
            let (left, right, share) = place(column, across);
            let along = |row: usize| (1.0 - share) * blurred[row * across + left] + share * blurred[row * across + right];
            *value = (1.0 - down_share) * along(top) + down_share * along(bottom);
        }
    });
    out
}

/// Share of one pixel's light that arrives per pixel of a block so many blocks down and across, `count` × `count`.
fn kernel(count: usize, side_px: f64, scale_px: f64) -> Vec<f64> {
    let density = |r_px: f64| (-r_px / scale_px).exp() / (std::f64::consts::TAU * scale_px * r_px);
    (0..count * count)
        .map(|index| {
            let (dx, dy) = ((index % count) as i32, (index / count) as i32);
            if (dx, dy) == (0, 0) {
                // The pole is integrated over a disc of the block's area.
                let radius_px = side_px / std::f64::consts::PI.sqrt();
                return -(-radius_px / scale_px).exp_m1() / (side_px * side_px);
            }
            let points = if dx.max(dy) <= NEAR { POINTS } else { 1 };
            let offset = |n: i32| (f64::from(n) + 0.5) / f64::from(points) - 0.5;
            let at = |i: i32, j: i32| side_px * (f64::from(dx) + offset(i)).hypot(f64::from(dy) + offset(j));
            let sum: f64 = (0..points * points).map(|n| density(at(n % points, n / points))).sum();
            sum / f64::from(points * points)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::{block_pairs, spread};

    #[test]
    fn a_frame_has_as_many_blocks_along_its_longer_side_whatever_its_pixels() {
        assert_eq!(block_pairs([96, 48]), (96.0f64 * 48.0).powi(2));
        assert_eq!(block_pairs([1536, 768]), block_pairs([96, 48]));
        // Seven pixels a side: 89 by 69.
        assert_eq!(block_pairs([620, 480]), (89.0f64 * 69.0).powi(2));
    }

    /// In the middle of an even disc of radius R the glare is 1 − e^(−R/k), and outside, at distance d, what quadrature gives.
    #[test]
    fn an_even_disc_glares_as_its_integral_says() {
        let (size, radius, scale) = (400usize, 150.0, 60.0);
        let middle = 199.5;
        let inside = |index: usize| ((index % size) as f64 - middle).hypot((index / size) as f64 - middle) <= radius;
        let light: Vec<f64> = (0..size * size).map(|index| f64::from(u8::from(inside(index)))).collect();
        let glare = spread(&light, [size, size], scale);
        let centre = glare[200 * size + 200];
        assert!((centre - (1.0 - (-radius / scale).exp())).abs() < 2e-3, "{centre}");
        // At (199.5 + 180, 199.5): rings about the point, each with the arc that lies inside the disc.
        let distance = 180.0f64;
        let mut expected = 0.0;
        let step = 0.05;
        let mut r = distance - radius + 0.5 * step;
        while r < distance + radius {
            let cosine = (r * r + distance * distance - radius * radius) / (2.0 * r * distance);
            expected += 2.0 * cosine.clamp(-1.0, 1.0).acos() * (-r / scale).exp() / (std::f64::consts::TAU * scale) * step;
            r += step;
        }
        let (left, right) = (glare[199 * size + 379], glare[199 * size + 380]);
        let there = 0.5 * (left + right);
        assert!((there - expected).abs() < 0.02 * expected, "{there} {expected}");
    }
}
