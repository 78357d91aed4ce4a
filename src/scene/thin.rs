//! Volumes of fewer slices, for small pictures: along their rays nobody counts voxels.

use glam::{DAffine3, DVec3};
use rayon::prelude::*;

use super::model::Volume;

impl Volume {
    /// The same with `factor` slices across `axis` made one, of their mean density: what lies beside each other stays apart, and the mass
    /// along a ray that runs along the axis is the same. A voxel is of the material that weighs most in it.
    #[must_use]
    pub fn thinned(&self, axis: usize, factor: usize) -> Self {
        let mut size = self.size;
        size[axis] = size[axis].div_ceil(factor);
        let step = [1, self.size[0], self.size[0] * self.size[1]][axis];
        let mut density_g_per_cm3 = vec![0.0f32; size.iter().product()];
        let mut class = vec![0u8; density_g_per_cm3.len()];
        let mut unknown = vec![false; if self.unknown.is_empty() { 0 } else { density_g_per_cm3.len() }];
        // Of one voxel: the first of those that it is made of, and how many there are.
        let of = |[i, j, k]: [usize; 3]| {
            let mut first = [i, j, k];
            first[axis] *= factor;
            (self.index(first[0], first[1], first[2]), factor.min(self.size[axis] - first[axis]))
        };
        let mean = |first: usize, slices: usize| {
            let voxels = (0..slices).map(|n| first + n * step);
            let mass = |class: u8| -> f32 {
                let own = voxels.clone().filter(|voxel| self.class[*voxel] == class);
                own.map(|voxel| self.density_g_per_cm3[voxel]).sum()
            };
            let (mut heaviest, mut most, mut all) = (0, 0.0, 0.0f32);
            for voxel in voxels.clone().filter(|voxel| self.class[*voxel] > 0) {
                all += self.density_g_per_cm3[voxel];
                let mass = mass(self.class[voxel]);
                if mass > most {
                    (heaviest, most) = (self.class[voxel], mass);
                }
            }
            // What is no number stays none.
            let heaviest = if all.is_nan() { voxels.clone().map(|voxel| self.class[voxel]).max().unwrap_or(0) } else { heaviest };
            (all / factor as f32, heaviest)
        };
        let layer = size[0] * size[1];
        if layer > 0 {
            let layers = density_g_per_cm3.par_chunks_mut(layer).zip(class.par_chunks_mut(layer)).enumerate();
            layers.for_each(|(k, (densities, classes))| {
                for (index, (density, class)) in densities.iter_mut().zip(classes).enumerate() {
                    let (first, slices) = of([index % size[0], index / size[0], k]);
                    (*density, *class) = mean(first, slices);
                }
            });
        }
        unknown.iter_mut().enumerate().for_each(|(index, unknown)| {
            let (first, slices) = of([index % size[0], index / size[0] % size[1], index / layer]);
            *unknown = (0..slices).any(|n| self.unknown[first + n * step]);
        });
        let mut step_voxels = DVec3::ONE;
        step_voxels[axis] = factor as f64;
        // The middle of the slices that are one.
        let mut shift = DVec3::ZERO;
        shift[axis] = 0.5 * (factor as f64 - 1.0);
        let lps_from_voxel = self.lps_from_voxel * DAffine3::from_translation(shift) * DAffine3::from_scale(step_voxels);
        let class_materials = self.class_materials.clone();
        let truncated_at_faces = self.truncated_at_faces;
        Self { size, lps_from_voxel, density_g_per_cm3, class, class_materials, truncated_at_faces, unknown }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mass_stays_where_it_was_and_the_heavier_material_names_the_voxel() {
        let size = [3, 2, 5];
        let voxels = size.iter().product::<usize>();
        let density_g_per_cm3: Vec<f32> =
            (0..voxels).map(|n| if n % 7 == 0 { 0.0 } else { 0.25 * (n % 5) as f32 + 0.25 }).collect();
        let class: Vec<u8> =
            density_g_per_cm3.iter().enumerate().map(|(n, density)| if *density > 0.0 { 1 + (n % 2) as u8 } else { 0 }).collect();
        let volume = Volume {
            size,
            lps_from_voxel: DAffine3::from_scale_rotation_translation(
                DVec3::new(0.5, 0.75, 2.0),
                glam::DQuat::from_rotation_x(0.4),
                DVec3::new(3.0, -2.0, 9.0),
            ),
            unknown: (0..voxels).map(|n| n == 4).collect(),
            density_g_per_cm3,
            class,
            class_materials: vec![0, 1],
            truncated_at_faces: true,
        };
        let moment = |volume: &Volume| {
            let (mut mass, mut place) = (0.0, DVec3::ZERO);
            for k in 0..volume.size[2] {
                for j in 0..volume.size[1] {
                    for i in 0..volume.size[0] {
                        let own = f64::from(volume.density_g_per_cm3[volume.index(i, j, k)])
                            * volume.lps_from_voxel.matrix3.determinant().abs();
                        mass += own;
                        place += own * volume.lps_from_voxel.transform_point3(DVec3::new(i as f64, j as f64, k as f64));
                    }
                }
            }
            (mass, place / mass)
        };
        for (axis, factor, expected) in [(0, 2, [2, 2, 5]), (1, 2, [3, 1, 5]), (2, 3, [3, 2, 2]), (2, 1, size)] {
            let thin = volume.thinned(axis, factor);
            assert_eq!(thin.size, expected);
            let ((mass, place), (thin_mass, thin_place)) = (moment(&volume), moment(&thin));
            assert!((mass - thin_mass).abs() < 1e-5 * mass, "{axis}: {mass} {thin_mass}");
            // Within a voxel, of what is made one.
            let off = volume.lps_from_voxel.inverse().transform_vector3(place - thin_place).abs();
            let across: f64 = (0..3).filter(|other| *other != axis).map(|other| off[other]).sum();
            assert!(across < 1e-5 && off[axis] <= 0.5 * factor as f64, "{axis}: {off}");
            assert_eq!(thin.unknown.iter().filter(|unknown| **unknown).count(), 1);
        }
        // 0.5 g/cm³ of the second material, 1.25 of the first.
        let two =
            Volume { size: [1, 1, 2], density_g_per_cm3: vec![0.5, 1.25], class: vec![2, 1], unknown: Vec::new(), ..volume };
        let one = two.thinned(2, 2);
        assert_eq!((one.class[0], one.density_g_per_cm3[0]), (1, 0.875));
    }
}
