//! Masked pixels filled in from around them, smoothly, so that filters may run over them without meeting an edge.

use rayon::prelude::*;

use crate::image::Image;

/// `pixels` where `usable`, elsewhere a smooth continuation: means of ever larger blocks, the finest that holds a usable pixel (push and
/// pull, after Gortler et al. 1996). 0 where nothing is usable.
#[must_use]
pub fn fill(pixels: &Image<f32>, usable: &Image<bool>) -> Image<f32> {
    if usable.pixels.iter().all(|usable| *usable) {
        return pixels.clone();
    }
    let weighted = |(value, usable): (&f32, &bool)| if *usable { [*value, 1.0] } else { [0.0, 0.0] };
    let finest = pixels.pixels.par_iter().zip(&usable.pixels).map(weighted).collect();
    let mut levels = vec![Image { width: pixels.width, height: pixels.height, pixels: finest }];
    while let Some(level) = levels.last()
        && (level.width > 1 || level.height > 1)
    {
        levels.push(push(level));
    }
    let Some(mut coarse) = levels.pop().map(|level| level.map(|[sum, weight]| if *weight > 0.0 { sum / weight } else { 0.0 }))
    else {
        return pixels.clone();
    };
    while let Some(level) = levels.pop() {
        coarse = pull(&level, &coarse);
    }
    coarse
}

/// Blocks of two by two: sum of weighted values, and weight, which is at most one.
fn push(level: &Image<[f32; 2]>) -> Image<[f32; 2]> {
    let (width, height) = (level.width.div_ceil(2), level.height.div_ceil(2));
    let mut out = Image::filled(width, height, [0.0f32; 2]);
    out.pixels.par_chunks_mut(width).zip(level.pixels.par_chunks(2 * level.width)).for_each(|(out, rows)| {
        for row in rows.chunks(level.width) {
            for (column, [value, weight]) in row.iter().enumerate() {
                let block = &mut out[column / 2];
                block[0] += value;
                block[1] += weight;
            }
        }
        out.iter_mut().filter(|block| block[1] > 1.0).for_each(|block| *block = [block[0] / block[1], 1.0]);
    });
    out
}

/// What a level does not know comes from the coarser one, interpolated.
fn pull(level: &Image<[f32; 2]>, coarse: &Image<f32>) -> Image<f32> {
    let mut out = Image::filled(level.width, level.height, 0.0f32);
    out.pixels.par_chunks_mut(level.width).enumerate().for_each(|(row, line)| {
        for (column, out) in line.iter_mut().enumerate() {
            let [value, weight] = *level.at(column, row);
            // Pixel (c, r) lies a quarter of a block from its block's middle.
            let beyond = || {
                let at = |n: usize, end: usize| {
                    let near = n / 2;
                    let far = if n.is_multiple_of(2) { near.saturating_sub(1) } else { (near + 1).min(end - 1) };
                    [near, far]
                };
                let ([c0, c1], [r0, r1]) = (at(column, coarse.width), at(row, coarse.height));
                let across = |r: usize| 0.75 * coarse.at(c0, r) + 0.25 * coarse.at(c1, r);
                0.75 * across(r0) + 0.25 * across(r1)
            };
            *out = match weight {
                weight if weight >= 1.0 => value,
                weight => value + (1.0 - weight) * beyond(),
            };
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn holes_continue_their_surroundings_and_known_pixels_stay() {
        let plane = |n: usize| (n % 60) as f32 + 2.0 * (n / 60) as f32;
        let pixels = Image { width: 60, height: 50, pixels: (0..3000).map(plane).collect() };
        let usable = Image { width: 60, height: 50, pixels: (0..3000).map(|n| !(20..36).contains(&(n % 60))).collect() };
        let spoilt = Image {
            pixels: pixels.pixels.iter().zip(&usable.pixels).map(|(v, u)| if *u { *v } else { f32::NAN }).collect(),
            ..pixels.clone()
        };
        let filled = fill(&spoilt, &usable);
        for (n, value) in filled.pixels.iter().enumerate() {
            let off = (value - pixels.pixels[n]).abs();
            assert!(if usable.pixels[n] { off == 0.0 } else { off < 12.0 }, "{n}: {value}");
        }
        let none = fill(&spoilt, &usable.map(|_| false));
        assert!(none.pixels.iter().all(|value| *value == 0.0));
        let one = fill(&Image::filled(1, 1, f32::NAN), &Image::filled(1, 1, false));
        assert_eq!(one.pixels, [0.0]);
        let all = fill(&pixels, &usable.map(|_| true));
        assert_eq!(all, pixels);
    }
}
