//! Metal beads of the CT that the scene draws itself are taken out of the CT, so that no bead is drawn twice.
//!
//! A bead blooms: the scanner's point spread carries some thousand HU a millimetre or two past its surface, and clipping at 3071 HU hides
//! how much there was. What is clearly metal near the centre of a sphere of the scene is grown until its halo no longer falls, and
//! replaced by the harmonic function of what surrounds it. Nothing else of the CT changes.

use std::collections::BTreeSet;

use glam::DVec3;

use super::density::DensityCurve;
use super::fill::fill_harmonic;
use super::object_file::{ObjectFile, SphereFile};
use super::physics::Material;
use crate::geometry::VoxelGrid;
use crate::image::quantile;

/// Spheres larger than this are no beads.
const LARGEST_BEAD_MM: f64 = 5.0;
/// Mean atomic number by mass from which a sphere blooms in a CT: titanium has 22, bone 10 to 14.
const METAL_MEAN_Z: f64 = 20.0;
/// No bone reaches this: dense cortical bone has up to 2000 HU.
const METAL_HU: f32 = 2300.0;
/// Metal counts as a sphere's own up to this far from its surface: a bead's position may be off by half of it, and the metal's
/// visible edge lies outside its surface by the other half.
const OWN_MM: f64 = 2.5;
/// A halo does not reach farther than this from what is clearly metal, for point spreads up to 1.5 mm; half a voxel's diagonal comes on top.
const LARGEST_HALO_MM: f64 = 2.5;
/// A halo ends where its median falls by less than this from one layer to the next.
const LEAST_FALL_HU: f64 = 12.0;

/// A bead that the scene draws.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ball {
    /// Its centre.
    pub centre_lps_mm: DVec3,
    /// Its radius.
    pub radius_mm: f64,
}

/// What was taken out of a CT.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Inpainted {
    /// Spheres that had metal around their centre.
    pub balls: usize,
    /// Voxels that changed, ascending.
    pub voxels: Vec<usize>,
    /// How far the widest halo reached past what is clearly metal.
    pub halo_mm: f64,
}

/// The metal beads among `objects`.
pub(super) fn metal_balls(objects: &[ObjectFile]) -> Vec<Ball> {
    let ball = |file: &SphereFile| Ball { centre_lps_mm: DVec3::from_array(file.centre_lps_mm), radius_mm: file.radius_mm };
    let is_bead = |file: &&SphereFile| {
        let mean_z = |material: Material| material.composition.iter().map(|(z, share)| f64::from(*z) * share).sum::<f64>();
        // A material that is not known is refused when its object's turn comes.
        file.radius_mm <= LARGEST_BEAD_MM
            && Material::parse(&file.material).is_ok_and(|material| mean_z(material) >= METAL_MEAN_Z)
    };
    let spheres = objects.iter().filter_map(|object| match object {
        ObjectFile::Sphere(file) => Some(file),
        _ => None,
    });
    spheres.filter(is_bead).map(ball).collect()
}

/// Replaces the metal around each of `balls` in a CT of Hounsfield numbers by what surrounds it. Deterministic; without metal there,
/// only the voxels near the balls are looked at.
pub fn inpaint_metal(grid: &VoxelGrid, hu: &mut [f32], balls: &[Ball]) -> Inpainted {
    let mut inpainted = Inpainted::default();
    let half_diagonal_mm = 0.5 * DVec3::from_array(grid.spacing_mm()).length();
    let mut hidden = BTreeSet::new();
    for ball in balls {
        let metal = own_metal(grid, hu, ball, half_diagonal_mm);
        if metal.is_empty() {
            continue;
        }
        let (voxels, halo_mm) = with_halo(grid, hu, ball, &metal, half_diagonal_mm);
        inpainted.balls += 1;
        inpainted.halo_mm = inpainted.halo_mm.max(halo_mm);
        hidden.extend(voxels);
    }
    if hidden.is_empty() {
        return inpainted;
    }
    let hidden: Vec<usize> = hidden.into_iter().collect();
    let unknown = DensityCurve::shipped().unknown_at_most_hu;
    let usable = |index: usize| hu[index] < METAL_HU && f64::from(hu[index]) > unknown;
    if let Some(filled) = fill_harmonic(grid, hu, &hidden, &usable) {
        hidden.iter().zip(filled).for_each(|(index, value)| hu[*index] = value as f32);
        inpainted.voxels = hidden;
    }
    inpainted
}

/// Labels of `voxels` (ascending) become those of the nearest other voxel, counted in steps across faces: what was labelled there was
/// the metal.
pub fn inpaint_labels(grid: &VoxelGrid, labels: &mut [u32], voxels: &[usize]) {
    let mut left: BTreeSet<usize> = voxels.iter().copied().collect();
    while !left.is_empty() {
        let known = |index: &usize| grid.neighbours(*index).find(|next| !left.contains(next)).map(|next| (*index, labels[next]));
        let layer: Vec<(usize, u32)> = left.iter().filter_map(known).collect();
        if layer.is_empty() {
            return;
        }
        for (index, label) in layer {
            labels[index] = label;
            left.remove(&index);
        }
    }
}

/// What is clearly metal and hangs together with metal inside the ball, ascending.
fn own_metal(grid: &VoxelGrid, hu: &[f32], ball: &Ball, half_diagonal_mm: f64) -> Vec<usize> {
    let near = |radius_mm: f64| {
        let mut voxels = grid.within(ball.centre_lps_mm, radius_mm);
        voxels.retain(|index| hu[*index] >= METAL_HU);
        voxels
    };
    let mut left: BTreeSet<usize> = near(ball.radius_mm + OWN_MM + half_diagonal_mm).into_iter().collect();
    let mut reached: Vec<usize> = near(ball.radius_mm + half_diagonal_mm);
    reached.iter().for_each(|index| {
        left.remove(index);
    });
    let mut at = 0;
    while at < reached.len() {
        for next in grid.neighbours(reached[at]) {
            if left.remove(&next) {
                reached.push(next);
            }
        }
        at += 1;
    }
    reached.sort_unstable();
    reached
}

/// The metal and its halo: all voxels up to the distance from the metal at which the median of a layer no longer falls.
fn with_halo(grid: &VoxelGrid, hu: &[f32], ball: &Ball, metal: &[usize], half_diagonal_mm: f64) -> (Vec<usize>, f64) {
    let most_mm = LARGEST_HALO_MM + half_diagonal_mm;
    let layer_mm = (0.75 * grid.spacing_mm().into_iter().fold(f64::INFINITY, f64::min)).max(0.4);
    let metal_places: Vec<DVec3> = metal.iter().map(|index| grid.centre(*index)).collect();
    let reach_mm = metal_places.iter().map(|place| place.distance(ball.centre_lps_mm)).fold(0.0, f64::max);
    let mut around: Vec<(usize, f64)> = Vec::new();
    for index in grid.within(ball.centre_lps_mm, reach_mm + most_mm + 2.0 * layer_mm) {
        let place = grid.centre(index);
        let squared = metal_places.iter().map(|metal| metal.distance_squared(place)).fold(f64::INFINITY, f64::min);
        around.push((index, squared.sqrt()));
    }
    let mut layers: Vec<Vec<f32>> = vec![Vec::new(); (most_mm / layer_mm).ceil() as usize + 2];
    for (index, distance_mm) in around.iter().filter(|(_, distance_mm)| *distance_mm > 0.0) {
        // Other metal than this bead's tells nothing about where its halo ends.
        if let Some(layer) = layers.get_mut((distance_mm / layer_mm) as usize).filter(|_| hu[*index] < METAL_HU) {
            layer.push(hu[*index]);
        }
    }
    // Layers between two slices may be empty.
    let medians: Vec<(usize, f64)> =
        layers.iter_mut().enumerate().filter_map(|(layer, values)| Some((layer, quantile(values, 0.5)?))).collect();
    let last_fall = medians.windows(2).filter(|pair| pair[0].1 - pair[1].1 >= LEAST_FALL_HU).map(|pair| pair[1].0).next_back();
    let halo_mm = last_fall.map_or(layer_mm, |layer| layer as f64 * layer_mm).clamp(half_diagonal_mm, most_mm);
    around.retain(|(_, distance_mm)| *distance_mm <= halo_mm);
    (around.into_iter().map(|(index, _)| index).collect(), halo_mm)
}
