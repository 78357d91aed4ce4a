//! Where a scene has metal that may be beads: small spheres, and bright blobs in a CT.

use std::collections::BTreeSet;

use glam::DVec3;
use rayon::prelude::*;

use crate::scene::model::{Matter, Scene, Shape, Volume};

/// Spheres up to this radius may be beads.
const LARGEST_BEAD_RADIUS_MM: f64 = 4.0;
/// Denser than bone and ceramics are: aluminium and up.
const LEAST_BEAD_G_PER_CM3: f64 = 2.5;
/// Voxels above this are metal (about 2500 HU; cortical bone ends near 1900, enamel near 2400).
const METAL_VOXEL_G_PER_CM3: f32 = 2.35;
/// Blobs up to this extent may be beads, bloom included.
const LARGEST_BLOB_MM: f64 = 14.0;
/// A CT with more metal voxels than this holds an implant or no Hounsfield numbers; beads are not told apart in it.
const MOST_METAL_VOXELS: usize = 400_000;

/// Centres of the scene's small metal spheres, lps mm; the robot's parts are none.
#[must_use]
pub fn bead_spheres(scene: &Scene) -> Vec<DVec3> {
    let robot = scene.robot.as_ref().map(|robot| robot.object);
    let mut found = Vec::new();
    for (_, object) in scene.objects.iter().enumerate().filter(|(index, _)| Some(*index) != robot) {
        let Matter::Solids(solids) = &object.matter else { continue };
        for solid in solids {
            let Shape::Ellipsoid { semi_axes_mm } = solid.shape else { continue };
            let round = semi_axes_mm.max_element() - semi_axes_mm.min_element() <= 1e-6;
            if round && semi_axes_mm.x <= LARGEST_BEAD_RADIUS_MM && solid.density_g_per_cm3 >= LEAST_BEAD_G_PER_CM3 {
                found.push(solid.lps_from_local.translation_mm);
            }
        }
    }
    found
}

/// Metal in a CT.
#[derive(Clone, Debug, PartialEq)]
pub enum CtMetal {
    /// The scene has no CT.
    NoCt,
    /// More than beads: an implant, or numbers that are no Hounsfield units.
    TooMuch {
        /// Bright voxels.
        voxels: usize,
    },
    /// Centres of blobs that may be beads, lps mm, and the size of a voxel.
    Blobs {
        /// Weighted by density.
        centres_lps_mm: Vec<DVec3>,
        /// Largest voxel spacing.
        spacing_mm: f64,
    },
}

/// Bright blobs of bead size in the scene's CTs.
#[must_use]
pub fn ct_metal(scene: &Scene) -> CtMetal {
    let mut all: Option<(Vec<DVec3>, f64)> = None;
    for volume in cts(scene) {
        let bright: Vec<usize> = volume
            .density_g_per_cm3
            .par_iter()
            .zip(&volume.class)
            .enumerate()
            .filter(|(_, (density, class))| **class > 0 && **density >= METAL_VOXEL_G_PER_CM3)
            .map(|(index, _)| index)
            .collect();
        if bright.len() > MOST_METAL_VOXELS {
            return CtMetal::TooMuch { voxels: bright.len() };
        }
        let (centres, spacing) = all.get_or_insert_default();
        *spacing = spacing.max(spacing_mm(volume).max_element());
        centres.extend(blobs(volume, &bright));
    }
    match all {
        Some((centres_lps_mm, spacing_mm)) => CtMetal::Blobs { centres_lps_mm, spacing_mm },
        None => CtMetal::NoCt,
    }
}

/// The scene's CTs.
pub fn cts(scene: &Scene) -> impl Iterator<Item = &Volume> {
    let volumes = scene.objects.iter().flat_map(|object| object.matter.volumes());
    volumes.map(std::convert::AsRef::as_ref).filter(|volume: &&Volume| volume.truncated_at_faces)
}

/// Distances of voxel centres along i, j, k.
#[must_use]
pub fn spacing_mm(volume: &Volume) -> DVec3 {
    let axes = volume.lps_from_voxel.matrix3;
    DVec3::new(axes.x_axis.length(), axes.y_axis.length(), axes.z_axis.length())
}

/// Centres of connected groups of `bright` voxels (26 neighbours) that are no larger than a bead with its bloom.
fn blobs(volume: &Volume, bright: &[usize]) -> Vec<DVec3> {
    let mut left: BTreeSet<usize> = bright.iter().copied().collect();
    let [columns, rows, slices] = volume.size;
    let ijk = |index: usize| [index % columns, index / columns % rows, index / (columns * rows)];
    let spacing = spacing_mm(volume);
    let mut found = Vec::new();
    while let Some(seed) = left.pop_first() {
        let (mut waiting, mut sum, mut weight) = (vec![seed], DVec3::ZERO, 0.0);
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        while let Some(index) = waiting.pop() {
            let [i, j, k] = ijk(index);
            let place = DVec3::new(i as f64, j as f64, k as f64);
            let density = f64::from(volume.density_g_per_cm3[index]);
            sum += density * place;
            weight += density;
            (low, high) = (low.min(place), high.max(place));
            for (di, dj, dk) in (0..27).map(|n| (n % 3, n / 3 % 3, n / 9)) {
                let near = [i + di, j + dj, k + dk];
                if near.iter().zip([columns, rows, slices]).all(|(at, end)| (1..=end).contains(at)) {
                    let neighbour = volume.index(near[0] - 1, near[1] - 1, near[2] - 1);
                    if left.remove(&neighbour) {
                        waiting.push(neighbour);
                    }
                }
            }
        }
        if ((high - low + 1.0) * spacing).max_element() <= LARGEST_BLOB_MM {
            found.push(volume.lps_from_voxel.transform_point3(sum / weight));
        }
    }
    found
}

/// Whether there is matter (beads and robot aside) within `reach_mm` of a point; `None` for a scene without any.
#[derive(Debug)]
pub struct Specimen<'a> {
    volumes: Vec<&'a Volume>,
    /// Object index of the robot.
    robot: Option<usize>,
    scene: &'a Scene,
}

impl<'a> Specimen<'a> {
    /// The scene's matter that is neither a bead nor the robot; `None` where there is none.
    #[must_use]
    pub fn of(scene: &'a Scene) -> Option<Self> {
        let volumes: Vec<&Volume> = cts(scene).collect();
        let specimen = Self { volumes, robot: scene.robot.as_ref().map(|robot| robot.object), scene };
        let any = !specimen.volumes.is_empty() || specimen.others().next().is_some();
        any.then_some(specimen)
    }

    /// Solids and meshes larger than beads.
    fn others(&self) -> impl Iterator<Item = &'a Matter> + '_ {
        let objects = self.scene.objects.iter().enumerate().filter(|(index, _)| Some(*index) != self.robot);
        objects.map(|(_, object)| &object.matter).filter(|matter| match matter {
            Matter::Solids(solids) => solids.iter().any(|solid| solid.shape.bounding_sphere().1 > LARGEST_BEAD_RADIUS_MM),
            Matter::Mesh(_) => true,
            Matter::Volume(_) | Matter::Parts(_) => false,
        })
    }

    /// Whether matter lies within `reach_mm` of `point`.
    #[must_use]
    pub fn is_near(&self, point: DVec3, reach_mm: f64) -> bool {
        self.volumes.iter().any(|volume| near_in_volume(volume, point, reach_mm))
            || self.others().any(|matter| near_in_shapes(matter, point, reach_mm))
    }

    /// How far `point` lies outside the box around everything, mm; 0 inside.
    #[must_use]
    pub fn outside_mm(&self, point: DVec3) -> f64 {
        let boxes = self.scene.objects.iter().filter_map(crate::scene::model::Object::bounds_lps_mm);
        match boxes.reduce(|a, b| (a.0.min(b.0), a.1.max(b.1))) {
            Some((low, high)) => (low - point).max(point - high).max(DVec3::ZERO).length(),
            None => f64::INFINITY,
        }
    }
}

fn near_in_volume(volume: &Volume, point: DVec3, reach_mm: f64) -> bool {
    let voxel_from_lps = volume.lps_from_voxel.inverse();
    const STEPS: i32 = 3;
    let step = reach_mm / f64::from(STEPS);
    let side = 2 * STEPS + 1;
    (0..side * side * side).any(|n| {
        let offset =
            DVec3::new(f64::from(n % side - STEPS), f64::from(n / side % side - STEPS), f64::from(n / (side * side) - STEPS));
        if offset.length() > f64::from(STEPS) {
            return false;
        }
        let at = voxel_from_lps.transform_point3(point + offset * step).round();
        let end = DVec3::from_array(volume.size.map(|n| n as f64));
        // NaN is nowhere.
        let inside = at.cmpge(DVec3::ZERO).all() && at.cmplt(end).all();
        inside && volume.class[volume.index(at.x as usize, at.y as usize, at.z as usize)] > 0
    })
}

fn near_in_shapes(matter: &Matter, point: DVec3, reach_mm: f64) -> bool {
    match matter {
        Matter::Volume(_) | Matter::Parts(_) => false,
        Matter::Mesh(mesh) => {
            let (low, high) = mesh
                .vertices_lps_mm
                .iter()
                .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), p| (low.min(*p), high.max(*p)));
            point.cmpge(low - reach_mm).all() && point.cmple(high + reach_mm).all()
        }
        Matter::Solids(solids) => solids.iter().any(|solid| {
            let p = solid.lps_from_local.inverse().transform_point(point);
            match solid.shape {
                Shape::Ellipsoid { semi_axes_mm } => (p / (semi_axes_mm + reach_mm)).length() <= 1.0,
                Shape::Cuboid { half_size_mm } => p.abs().cmple(half_size_mm + reach_mm).all(),
                Shape::Cylinder { length_mm, radius_mm, .. } => {
                    p.z >= -reach_mm && p.z <= length_mm + reach_mm && p.truncate().length() <= radius_mm + reach_mm
                }
            }
        }),
    }
}

/// Share of a CT's voxels that are air.
#[must_use]
pub fn air_share(volume: &Volume) -> f64 {
    let air = volume.class.par_iter().filter(|class| **class == 0).count();
    air as f64 / volume.class.len().max(1) as f64
}
