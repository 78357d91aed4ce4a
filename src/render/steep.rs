//! Bricks of a volume in which density jumps from one voxel to the next as only metal makes it: no step between rays may skip them.

use glam::DVec3;
use rayon::prelude::*;

use crate::scene::model::Volume;

/// Neighbouring voxels that differ by more than this, g/cm³: skin, bone and marrow differ by less.
const STEEP_G_PER_CM3: f32 = 1.2;

/// Middles of the steep bricks of `brick`³ voxels, in `cell` coordinates (voxel + 1).
#[must_use]
pub fn steep_bricks(volume: &Volume, brick: usize) -> Vec<DVec3> {
    let [ni, nj, nk] = volume.size;
    let stride = [1, ni, ni * nj];
    let density = |index: usize| if volume.class[index] == 0 { 0.0 } else { volume.density_g_per_cm3[index] };
    let steep = |i: usize, j: usize, k: usize| {
        let at = volume.index(i, j, k);
        let here = density(at);
        // NaN is steep.
        [(i, ni), (j, nj), (k, nk)]
            .into_iter()
            .zip(stride)
            .any(|((x, n), stride)| x + 1 < n && !((density(at + stride) - here).abs() <= STEEP_G_PER_CM3))
            // The border of the grid is where a tool ends.
            || [(i, ni), (j, nj), (k, nk)].iter().any(|(x, n)| (*x == 0 || x + 1 == *n) && !(here <= STEEP_G_PER_CM3))
    };
    let layers = nk.div_ceil(brick);
    let of_layer = |bk: usize| {
        let mut found = Vec::new();
        for bj in 0..nj.div_ceil(brick) {
            for bi in 0..ni.div_ceil(brick) {
                let end = |b: usize, n: usize| ((b + 1) * brick).min(n);
                let any = (bk * brick..end(bk, nk))
                    .any(|k| (bj * brick..end(bj, nj)).any(|j| (bi * brick..end(bi, ni)).any(|i| steep(i, j, k))));
                if any {
                    found.push(DVec3::new(bi as f64, bj as f64, bk as f64) * brick as f64 + 0.5 * (brick as f64 + 1.0));
                }
            }
        }
        found
    };
    (0..layers).into_par_iter().flat_map_iter(of_layer).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pin_of_one_voxel_is_steep_and_bone_is_not() {
        let size = [24, 20, 17];
        let count = size.iter().product();
        let bone = |index: usize| if index % 24 < 12 { 1.0 } else { 1.9 };
        let mut volume = Volume {
            size,
            lps_from_voxel: glam::DAffine3::IDENTITY,
            density_g_per_cm3: (0..count).map(bone).collect(),
            class: vec![1; count],
            class_materials: vec![0],
            truncated_at_faces: true,
            unknown: Vec::new(),
        };
        volume.density_g_per_cm3.iter_mut().for_each(|density| *density *= 0.6);
        assert!(steep_bricks(&volume, 8).is_empty());
        let pin = volume.index(9, 9, 9);
        volume.density_g_per_cm3[pin] = 4.4;
        let found = steep_bricks(&volume, 8);
        assert_eq!(found, [DVec3::splat(12.5)], "the brick of voxels 8 to 15");
    }
}
