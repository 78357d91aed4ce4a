//! Area densities between cast pixels, bilinear.

use rayon::prelude::*;

use super::integrate_density::Density;

/// `coarse` columns and rows, every `step`-th pixel of `size`; pixels beyond the last cast one repeat it.
#[must_use]
pub fn enlarge_density(density: &Density, coarse: [usize; 2], size: [usize; 2], step: usize) -> Density {
    let [width, height] = size;
    let materials = density.material_count;
    let mut g_per_cm2 = vec![0.0f32; width * height * materials];
    let mut valid = vec![1u8; width * height];
    let place = |pixel: usize, last: usize| {
        let at = (pixel / step).min(last);
        (at, (at + 1).min(last), (pixel - at * step).min(step) as f32 / step as f32)
    };
    let rows = g_per_cm2.par_chunks_mut((width * materials).max(1)).zip(valid.par_chunks_mut(width.max(1)));
    rows.enumerate().for_each(|(v, (out, valid))| {
        let (top, bottom, fv) = place(v, coarse[1] - 1);
        for u in 0..width {
            let (left, right, fu) = place(u, coarse[0] - 1);
            let corners =
                [top * coarse[0] + left, top * coarse[0] + right, bottom * coarse[0] + left, bottom * coarse[0] + right];
            for material in 0..materials {
                let at = |corner: usize| density.g_per_cm2[corners[corner] * materials + material];
                let upper = at(0) + fu * (at(1) - at(0));
                let lower = at(2) + fu * (at(3) - at(2));
                out[u * materials + material] = upper + fv * (lower - upper);
            }
            valid[u] = corners.iter().map(|corner| density.valid[*corner]).min().unwrap_or(1);
        }
    });
    Density { material_count: materials, g_per_cm2, valid }
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
}
