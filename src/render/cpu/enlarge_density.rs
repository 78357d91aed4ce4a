//! Area densities between cast pixels, bilinear.

use rayon::prelude::*;

use super::integrate_density::Density;

/// `coarse` columns and rows, every `step`-th pixel of `size`; pixels beyond the last cast one repeat it.
#[must_use]
pub fn enlarge_density(density: &Density, coarse: [usize; 2], size: [usize; 2], step: usize) -> Density {
    let [width, height] = size;
    let materials = density.material_count;
    let (mut g_per_cm2, mut valid) = (vec![0.0f32; width * height * materials], vec![1u8; width * height]);
    let cast_row = |row: usize| {
        let first = row * coarse[0];
        (&density.g_per_cm2[first * materials..(first + coarse[0]) * materials], &density.valid[first..first + coarse[0]])
    };
    // The rows between two cast ones share what lies between their pixels.
    let bands = g_per_cm2.par_chunks_mut((step * width * materials).max(1)).zip(valid.par_chunks_mut((step * width).max(1)));
    bands.enumerate().for_each(|(band, (out, valid))| {
        let (top, bottom) = (band.min(coarse[1] - 1), (band + 1).min(coarse[1] - 1));
        let (mut upper, mut lower) = (vec![0.0f32; width * materials], vec![0.0f32; width * materials]);
        enlarge_row(cast_row(top).0, &mut upper, [coarse[0], materials, step]);
        enlarge_row(cast_row(bottom).0, &mut lower, [coarse[0], materials, step]);
        for (row, out) in out.chunks_exact_mut((width * materials).max(1)).enumerate() {
            let share = (band * step + row - top * step).min(step) as f32 / step as f32;
            for ((out, upper), lower) in out.iter_mut().zip(&upper).zip(&lower) {
                *out = upper + share * (lower - upper);
            }
        }
        let (above, below) = (cast_row(top).1, cast_row(bottom).1);
        let corners = |column: usize| above[column].min(below[column]);
        for row in valid.chunks_exact_mut(width.max(1)) {
            for (u, valid) in row.iter_mut().enumerate() {
                let left = (u / step).min(coarse[0] - 1);
                *valid = corners(left).min(corners((left + 1).min(coarse[0] - 1)));
            }
        }
    });
    Density { material_count: materials, g_per_cm2, valid }
}

/// A row of `columns` cast pixels of so many `materials`, every `step`-th pixel of `out`.
fn enlarge_row(cast: &[f32], out: &mut [f32], [columns, materials, step]: [usize; 3]) {
    for (u, out) in out.chunks_exact_mut(materials.max(1)).enumerate() {
        let left = (u / step).min(columns - 1);
        let share = (u - left * step).min(step) as f32 / step as f32;
        let [left, right] = [left, (left + 1).min(columns - 1)].map(|column| &cast[column * materials..(column + 1) * materials]);
        for ((out, left), right) in out.iter_mut().zip(left).zip(right) {
            *out = left + share * (right - left);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plane_comes_back_as_it_was() {
        let coarse = [4, 3];
        let g_per_cm2 = (0..12).map(|i| (4 * (i % 4)) as f32 * 0.5 + (4 * (i / 4)) as f32 * 0.25).collect();
        let density = Density { material_count: 1, g_per_cm2, valid: vec![1; 12] };
        let large = enlarge_density(&density, coarse, [13, 9], 4);
        for (i, value) in large.g_per_cm2.iter().enumerate() {
            let expected = (i % 13) as f32 * 0.5 + (i / 13) as f32 * 0.25;
            assert!((value - expected).abs() < 1e-6, "{i}: {value} {expected}");
        }
    }

    /// Bit for bit what the four cast pixels around a pixel give it, first along the row.
    #[test]
    fn every_pixel_is_what_the_four_around_it_give() {
        let mut stream = crate::random::Stream::new(3, 0, 0, crate::random::Purpose::Evaluation);
        let (coarse, size, step, materials) = ([9, 7], [31, 25], 4, 3);
        let g_per_cm2: Vec<f32> = (0..coarse[0] * coarse[1] * materials).map(|_| stream.uniform() as f32).collect();
        let density = Density { material_count: materials, g_per_cm2: g_per_cm2.clone(), valid: vec![1; coarse[0] * coarse[1]] };
        let large = enlarge_density(&density, coarse, size, step);
        for (index, found) in large.g_per_cm2.iter().enumerate() {
            let (pixel, material) = (index / materials, index % materials);
            let place = |at: usize, last: usize| {
                let first = (at / step).min(last);
                (first, (first + 1).min(last), (at - first * step).min(step) as f32 / step as f32)
            };
            let (left, right, fu) = place(pixel % size[0], coarse[0] - 1);
            let (top, bottom, fv) = place(pixel / size[0], coarse[1] - 1);
            let at = |u: usize, v: usize| g_per_cm2[(v * coarse[0] + u) * materials + material];
            let upper = at(left, top) + fu * (at(right, top) - at(left, top));
            let lower = at(left, bottom) + fu * (at(right, bottom) - at(left, bottom));
            assert_eq!(*found, upper + fv * (lower - upper), "pixel {pixel}, material {material}");
        }
    }

    /// Two materials, an image that ends between and beyond cast pixels, one ray cut off.
    #[test]
    fn pixels_beyond_the_last_cast_one_repeat_it_and_what_touches_a_cut_ray_is_cut() {
        let g_per_cm2 = (0..6).flat_map(|i| [i as f32, 10.0 * (i % 3) as f32]).collect();
        let density = Density { material_count: 2, g_per_cm2, valid: vec![1, 1, 1, 1, 1, 0] };
        let large = enlarge_density(&density, [3, 2], [6, 4], 2);
        let rows: Vec<Vec<[f32; 2]>> =
            large.g_per_cm2.chunks(12).map(|row| row.chunks(2).map(|pair| [pair[0], pair[1]]).collect()).collect();
        assert_eq!(rows[0], [[0.0, 0.0], [0.5, 5.0], [1.0, 10.0], [1.5, 15.0], [2.0, 20.0], [2.0, 20.0]]);
        assert_eq!(rows[1], [[1.5, 0.0], [2.0, 5.0], [2.5, 10.0], [3.0, 15.0], [3.5, 20.0], [3.5, 20.0]]);
        assert_eq!(rows[2], rows[3]);
        assert_eq!(rows[2], [[3.0, 0.0], [3.5, 5.0], [4.0, 10.0], [4.5, 15.0], [5.0, 20.0], [5.0, 20.0]]);
        // The second column from the right and what leans on it.
        assert_eq!(large.valid[..6], [1, 1, 0, 0, 0, 0]);
        assert_eq!(large.valid[18..], [1, 1, 0, 0, 0, 0]);
    }
}
