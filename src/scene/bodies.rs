//! Bodies that have moved since the scan: each is cut out of its CT and lies where it is now, what it left is filled.
//!
//! *Cut out.* A body's voxels go to a grid of their own, whose affine carries the motion: its field is what it was, nothing is
//! resampled. The grids of one CT add up ([`Matter::Parts`]). The trilinear interpolant of "this voxel is the body's" says which share of
//! each point the body takes; what lies there of the same CT keeps the rest of it: soft tissue ends where bone begins, and no seam of
//! nothing is left between them, as cell-wise displacement would leave one.
//!
//! *Filled.* The voxels that a body leaves take the harmonic function of the densities of the soft tissue that touches them, and the
//! composition that most of it has: the smoothest tissue that agrees with what is there. Bone and air beside a body say nothing about
//! what flows in behind it; where only they touch it, any matter will do, and a body in mere air leaves air. It is a guess:
//! [`Bodies::filled`](super::model::Bodies::filled) says where it stands.

use std::sync::Arc;

use glam::{DAffine3, DVec3};
use rayon::prelude::*;

use super::SceneError;
use super::fill::fill_harmonic;
use super::model::{Filling, LabelledBody, Matter, Motion, Object, Scene, Volume, is_still};
use crate::geometry::Rigid;
use crate::geometry::VoxelGrid;

/// Shares of a voxel that are as good as nothing.
const ROUNDING: f64 = 1e-9;
/// Densities of soft tissue, g/cm³, fat to muscle; voxels that share their place with air or bone lie outside.
const SOFT_G_PER_CM3: (f32, f32) = (0.85, 1.12);

impl Scene {
    /// Names of the bodies that objects and labels belong to, each once.
    #[must_use]
    pub fn body_names(&self) -> Vec<&str> {
        let of_objects = self.objects.iter().map(|object| object.body.as_str());
        let mut names: Vec<&str> = Vec::new();
        for name in of_objects.chain(self.bodies.labelled.iter().map(|body| body.name.as_str())) {
            if !names.contains(&name) {
                names.push(name);
            }
        }
        names
    }

    /// This scene, as it was scanned, with its bodies where `places` has them: name and lps_from_body. Bodies that are not named lie where
    /// they were scanned; without any motion nothing changes.
    ///
    /// # Errors
    /// When a body has moved that the scene does not know.
    pub fn with_bodies(&self, places: &[(&str, Rigid)]) -> Result<Self, SceneError> {
        let known = self.body_names();
        if let Some((body, motion)) = places.iter().find(|(name, motion)| !known.contains(name) && !is_still(motion)) {
            return Err(SceneError::UnknownBody {
                body: (*body).to_owned(),
                angle_deg: motion.angle_to_rad(&Rigid::IDENTITY).to_degrees(),
                shift_mm: motion.translation_mm.length(),
                known: known.join(", "),
            });
        }
        let place = |body: &str| {
            let named = places.iter().find(|(name, _)| *name == body).map_or(Rigid::IDENTITY, |(_, motion)| *motion);
            if is_still(&named) { Rigid::IDENTITY } else { named }
        };
        let mut scene = self.clone();
        scene.bodies.filled.clear();
        for (index, object) in self.objects.iter().enumerate() {
            let motion = place(&object.body);
            let moved: Vec<(&LabelledBody, Rigid)> = self.labelled_of(object).map(|body| (body, place(&body.name))).collect();
            scene.objects[index].matter = match &object.matter {
                Matter::Volume(volume) if moved.iter().any(|(_, own)| !is_still(&(motion.inverse() * *own))) => {
                    let (parts, filled) = self.parts(volume, motion, &moved);
                    scene.bodies.filled.extend(filled.into_iter().map(|(body, shares)| (body, Arc::new(shares))));
                    Matter::Parts(parts.into_iter().map(Arc::new).collect())
                }
                matter if is_still(&motion) => matter.clone(),
                matter => displaced(matter, &motion),
            };
            if let Some(robot) = scene.robot.as_mut().filter(|robot| robot.object == index) {
                robot.lps_from_base = motion * robot.lps_from_base;
            }
        }
        scene.bodies.motions = known.iter().map(|name| self.motion(name, place(name), &scene)).collect();
        Ok(scene)
    }

    fn labelled_of<'s>(&'s self, object: &'s Object) -> impl Iterator<Item = &'s LabelledBody> {
        self.bodies.labelled.iter().map(Arc::as_ref).filter(|body| body.object == object.name)
    }

    /// What is said of a body's motion; `moved` is the scene after it.
    fn motion(&self, body: &str, lps_from_body: Rigid, moved: &Scene) -> Motion {
        let mut middles: Vec<DVec3> = Vec::new();
        for object in &self.objects {
            if object.body == body
                && let Some((low, high)) = object.bounds_lps_mm()
            {
                middles.push(0.5 * (low + high));
            }
            if let Some(volume) = object.matter.volumes().first() {
                let grid = grid_of(volume);
                let own = self.labelled_of(object).filter(|labelled| labelled.name == body);
                middles.extend(
                    own.map(|own| own.voxels.iter().map(|index| grid.centre(*index)).sum::<DVec3>() / own.voxels.len() as f64),
                );
            }
        }
        let middle = middles.iter().sum::<DVec3>() / middles.len().max(1) as f64;
        let filled_cm3 = |filled: &Volume| {
            let voxel_cm3 = filled.lps_from_voxel.matrix3.determinant().abs() * 1e-3;
            filled.density_g_per_cm3.iter().map(|share| f64::from(*share)).sum::<f64>() * voxel_cm3
        };
        let left = moved.bodies.filled.iter().filter(|(name, _)| name == body);
        Motion {
            body: body.to_owned(),
            lps_from_body,
            shift_mm: lps_from_body.transform_point(middle).distance(middle),
            filled_cm3: left.map(|(_, filled)| filled_cm3(filled)).sum(),
        }
    }

    /// The CT without the bodies that lie elsewhere than the rest of it, whose motion is `motion`, and those bodies; and what stands where
    /// they lay. `bodies` are all of the CT's, with their motions.
    fn parts(&self, volume: &Volume, motion: Rigid, bodies: &[(&LabelledBody, Rigid)]) -> (Vec<Volume>, Vec<(String, Volume)>) {
        let is_matter = |index: usize| {
            let class = usize::from(volume.class[index]);
            class > 0 && volume.density_g_per_cm3[index] > 0.0 && !self.is_air(volume.class_materials[class - 1])
        };
        let around = |index: usize| is_matter(index) && !bodies.iter().any(|(body, _)| body.voxels.binary_search(&index).is_ok());
        let mut rest = Volume { lps_from_voxel: affine(&motion) * volume.lps_from_voxel, ..volume.clone() };
        let (mut parts, mut filled): (Vec<Volume>, Vec<(String, Volume)>) = (Vec::new(), Vec::new());
        for (body, own) in bodies.iter().filter(|(_, own)| !is_still(&(motion.inverse() * *own))) {
            let filling = body.filling.get_or_init(|| fill(volume, &body.voxels, &around));
            let (first, mut part) = empty_around(volume, &body.voxels);
            let mut shares = Volume {
                lps_from_voxel: affine(&motion) * part.lps_from_voxel,
                truncated_at_faces: false,
                unknown: Vec::new(),
                ..part.clone()
            };
            part.lps_from_voxel = affine(own) * part.lps_from_voxel;
            let (grid, left) = (grid_of(volume), filling.class.min(1));
            for (index, density) in body.voxels.iter().zip(&filling.density_g_per_cm3) {
                let [i, j, k] = grid.coordinates(*index);
                let at = part.index(i - first[0], j - first[1], k - first[2]);
                if is_matter(*index) {
                    (part.class[at], part.density_g_per_cm3[at]) = (volume.class[*index], volume.density_g_per_cm3[*index]);
                }
                (rest.class[*index], rest.density_g_per_cm3[*index]) = (filling.class, *density);
                (shares.class[at], shares.density_g_per_cm3[at]) = (left, f32::from(left));
            }
            parts.push(part);
            filled.push((body.name.clone(), shares));
        }
        // Of two bodies at one place the later one is there.
        for later in 0..parts.len() {
            let (before, from) = parts.split_at_mut(later);
            let shares = filled.iter_mut().map(|(_, shares)| shares);
            before.iter_mut().chain(shares).chain(std::iter::once(&mut rest)).for_each(|under| make_room(under, &from[0]));
        }
        parts.insert(0, rest);
        (parts, filled)
    }
}

fn affine(motion: &Rigid) -> DAffine3 {
    DAffine3::from_rotation_translation(motion.rotation, motion.translation_mm)
}

fn grid_of(volume: &Volume) -> VoxelGrid {
    VoxelGrid { size: volume.size, lps_from_voxel: volume.lps_from_voxel }
}

/// An object as a whole, moved.
fn displaced(matter: &Matter, motion: &Rigid) -> Matter {
    match matter {
        Matter::Solids(solids) => {
            let mut solids = solids.clone();
            solids.iter_mut().for_each(|solid| solid.lps_from_local = *motion * solid.lps_from_local);
            Matter::Solids(solids)
        }
        Matter::Mesh(mesh) => {
            let mut mesh = (**mesh).clone();
            mesh.vertices_lps_mm.iter_mut().for_each(|vertex| *vertex = motion.transform_point(*vertex));
            Matter::Mesh(Arc::new(mesh))
        }
        Matter::Volume(volume) => Matter::Volume(Arc::new(moved_grid(volume, motion))),
        Matter::Parts(parts) => Matter::Parts(parts.iter().map(|part| Arc::new(moved_grid(part, motion))).collect()),
    }
}

fn moved_grid(volume: &Volume, motion: &Rigid) -> Volume {
    Volume { lps_from_voxel: affine(motion) * volume.lps_from_voxel, ..volume.clone() }
}

/// What fills `voxels` once they are empty; `around` says which other voxels hold matter that stays.
fn fill(volume: &Volume, voxels: &[usize], around: &(dyn Fn(usize) -> bool + Sync)) -> Filling {
    let (grid, density) = (grid_of(volume), &volume.density_g_per_cm3);
    let soft = |index: usize| around(index) && density[index] >= SOFT_G_PER_CM3.0 && density[index] <= SOFT_G_PER_CM3.1;
    let of: [&dyn Fn(usize) -> bool; 2] = [&soft, &around];
    for usable in of {
        let mut touching = [0usize; 256];
        let touched = voxels.iter().flat_map(|index| grid.neighbours(*index)).filter(|next| usable(*next));
        touched.for_each(|next| touching[usize::from(volume.class[next])] += 1);
        // The first of equals.
        let most = (1..256).rev().max_by_key(|class| touching[*class]).filter(|class| touching[*class] > 0);
        if let (Some(class), Some(filled)) = (most, fill_harmonic(&grid, density, voxels, usable)) {
            return Filling { class: class as u8, density_g_per_cm3: filled.into_iter().map(|value| value as f32).collect() };
        }
    }
    Filling { class: 0, density_g_per_cm3: vec![0.0; voxels.len()] }
}

/// A grid of nothing around `voxels`, a voxel larger on each side where the CT goes on, and where its first voxel is in the CT. Where the
/// CT ends there the body was cut off.
fn empty_around(volume: &Volume, voxels: &[usize]) -> ([usize; 3], Volume) {
    let grid = grid_of(volume);
    let (mut low, mut high) = ([usize::MAX; 3], [0; 3]);
    for at in voxels.iter().map(|index| grid.coordinates(*index)) {
        low = std::array::from_fn(|axis| low[axis].min(at[axis]));
        high = std::array::from_fn(|axis| high[axis].max(at[axis]));
    }
    let first = low.map(|n| n.saturating_sub(1));
    let size: [usize; 3] = std::array::from_fn(|axis| (high[axis] + 1).min(volume.size[axis] - 1) + 1 - first[axis]);
    let count = size.iter().product();
    let at_border = (0..3).any(|axis| low[axis] == 0 || high[axis] + 1 == volume.size[axis]);
    let own = VoxelGrid { size, lps_from_voxel: volume.lps_from_voxel };
    let unknown = |index: usize| {
        let [i, j, k] = own.coordinates(index);
        volume.unknown[volume.index(first[0] + i, first[1] + j, first[2] + k)]
    };
    let part = Volume {
        size,
        lps_from_voxel: volume.lps_from_voxel * DAffine3::from_translation(DVec3::from_array(first.map(|n| n as f64))),
        density_g_per_cm3: vec![0.0; count],
        class: vec![0; count],
        class_materials: volume.class_materials.clone(),
        truncated_at_faces: volume.truncated_at_faces && at_border,
        unknown: if volume.unknown.is_empty() { Vec::new() } else { (0..count).map(unknown).collect() },
    };
    (first, part)
}

/// Leaves each voxel of `under` the share of its density that `body` does not take at its centre.
fn make_room(under: &mut Volume, body: &Volume) {
    let body_from_under = body.lps_from_voxel.inverse() * under.lps_from_voxel;
    let under_from_body = body_from_under.inverse();
    let end = DVec3::from_array(body.size.map(|n| n as f64));
    let corner = |bits: u32| DVec3::new(f64::from(bits & 1), f64::from(bits >> 1 & 1), f64::from(bits >> 2)) * end - 0.5;
    let corners = (0..8).map(|bits| under_from_body.transform_point3(corner(bits)));
    let (low, high) = corners.fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(low, high), p| (low.min(p), high.max(p)));
    let range =
        |axis: usize, size: usize| low[axis].ceil().max(0.0) as usize..((high[axis].floor() + 1.0).max(0.0) as usize).min(size);
    let [columns, rows, slices] = std::array::from_fn(|axis| range(axis, under.size[axis]));
    let (row, slice) = (under.size[0], under.size[0] * under.size[1]);
    let layers = under.density_g_per_cm3.par_chunks_mut(slice).zip(under.class.par_chunks_mut(slice)).enumerate();
    layers.filter(|(k, _)| slices.contains(k)).for_each(|(k, (density, class))| {
        for j in rows.clone() {
            for i in columns.clone() {
                let at = i + row * j;
                if class[at] == 0 {
                    continue;
                }
                let taken = share(body, body_from_under.transform_point3(DVec3::new(i as f64, j as f64, k as f64)));
                density[at] = (f64::from(density[at]) * (1.0 - taken)) as f32;
                if taken > 1.0 - ROUNDING {
                    (density[at], class[at]) = (0.0, 0);
                }
            }
        }
    });
}

/// Share of a point that a body takes: the trilinear interpolant of 1 in its voxels and 0 in all others, which its field weighs them with.
fn share(body: &Volume, voxel: DVec3) -> f64 {
    let last = DVec3::from_array(body.size.map(|n| n as f64 - 1.0));
    if !(voxel.cmpge(DVec3::splat(-0.5)).all() && voxel.cmple(last + 0.5).all()) {
        return 0.0;
    }
    let held = voxel.clamp(DVec3::ZERO, last);
    let low = held.floor();
    let upper = held - low;
    let corner = |bits: usize| {
        let side = |axis: usize| {
            let first = low[axis] as usize;
            if bits >> axis & 1 == 1 { ((first + 1).min(body.size[axis] - 1), upper[axis]) } else { (first, 1.0 - upper[axis]) }
        };
        let [(i, a), (j, b), (k, c)] = [side(0), side(1), side(2)];
        if body.class[body.index(i, j, k)] > 0 { a * b * c } else { 0.0 }
    };
    (0..8).map(corner).sum()
}
