//! Beads, cameras, and which shadow is whose.

use glam::{DVec2, DVec3};

use super::shot::{PhantomShot, nearest};
use crate::geometry::Rigid;

/// What is known so far.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Structure {
    /// `camera_from_world` of the shots that take part.
    pub cameras: Vec<Option<Rigid>>,
    /// Beads in the world.
    pub points: Vec<DVec3>,
    /// Of each bead and each shot: the number of its shadow.
    pub tracks: Vec<Vec<Option<usize>>>,
}

/// Where a camera sees a point; `None` behind or beside the focal spot.
pub(super) fn seen(shot: &PhantomShot, camera: &Rigid, point: DVec3) -> Option<DVec2> {
    let p = camera.transform_point(point);
    (p.z > 1.0).then(|| shot.intrinsics.project(p))
}

/// The ray of a place in a shot: origin and unit direction in the world.
pub(super) fn ray(shot: &PhantomShot, camera: &Rigid, image_px: DVec2) -> (DVec3, DVec3) {
    let world_from_camera = camera.inverse();
    let way = world_from_camera.transform_vector(shot.intrinsics.unproject(image_px));
    (world_from_camera.translation_mm, way.normalize())
}

impl Structure {
    pub fn new(shots: usize) -> Self {
        Self { cameras: vec![None; shots], points: Vec::new(), tracks: Vec::new() }
    }

    /// Shots that take part.
    pub fn shots(&self) -> impl Iterator<Item = (usize, &Rigid)> {
        self.cameras.iter().enumerate().filter_map(|(n, camera)| Some((n, camera.as_ref()?)))
    }

    /// Shadows of a bead: (shot, shadow).
    pub fn shadows_of(&self, bead: usize) -> impl Iterator<Item = (usize, usize)> {
        self.tracks[bead].iter().enumerate().filter_map(|(shot, shadow)| Some((shot, (*shadow)?)))
    }

    /// Shadows of a shot: (bead, shadow).
    pub fn shadows_in(&self, shot: usize) -> impl Iterator<Item = (usize, usize)> {
        self.tracks.iter().enumerate().filter_map(move |(bead, track)| Some((bead, track[shot]?)))
    }

    /// Shadows that belong to beads.
    pub fn observations(&self) -> usize {
        self.tracks.iter().flatten().flatten().count()
    }

    /// Places a bead by its shadows.
    pub fn triangulated(&self, shots: &[PhantomShot], shadows: &[(usize, usize)]) -> Option<DVec3> {
        let rays = shadows.iter().filter_map(|(shot, shadow)| {
            let camera = self.cameras[*shot].as_ref()?;
            Some(ray(&shots[*shot], camera, shots[*shot].shadows[*shadow].image_px))
        });
        nearest(rays)
    }

    /// Drops beads in fewer than `fewest` shots; returns where they were, and in how many shots.
    pub fn drop_rare(&mut self, fewest: usize) -> Vec<(DVec3, usize)> {
        let mut dropped = Vec::new();
        for bead in (0..self.points.len()).rev() {
            let shots = self.shadows_of(bead).count();
            if shots < fewest {
                dropped.push((self.points.remove(bead), shots));
                self.tracks.remove(bead);
            }
        }
        dropped
    }

    /// Takes a shot out.
    pub fn without_shot(&mut self, shot: usize) {
        self.cameras[shot] = None;
        self.tracks.iter_mut().for_each(|track| track[shot] = None);
    }

    /// √mean(dx² + dy²) over all shadows of beads, px.
    pub fn rms_px(&self, shots: &[PhantomShot]) -> f64 {
        let mut squares = 0.0;
        for (bead, point) in self.points.iter().enumerate() {
            for (shot, shadow) in self.shadows_of(bead) {
                let at = self.cameras[shot].as_ref().and_then(|camera| seen(&shots[shot], camera, *point));
                squares += at.map_or(f64::INFINITY, |at| at.distance_squared(shots[shot].shadows[shadow].image_px));
            }
        }
        (squares / self.observations().max(1) as f64).sqrt()
    }

    /// How many of the other's matches are its own too, as a share of the smaller.
    pub fn alike(&self, other: &Self) -> f64 {
        let pairs = |of: &Self| -> std::collections::BTreeSet<[(usize, usize); 2]> {
            let all = (0..of.points.len()).flat_map(|bead| {
                let own: Vec<(usize, usize)> = of.shadows_of(bead).collect();
                own.windows(2).map(|pair| [pair[0], pair[1]]).collect::<Vec<_>>()
            });
            all.collect()
        };
        let (own, theirs) = (pairs(self), pairs(other));
        own.intersection(&theirs).count() as f64 / own.len().min(theirs.len()).max(1) as f64
    }
}

/// One-to-one: the nearest first, no farther than `gate_px`. `predicted` and the result count as given; `free` says which shadows may be
/// taken.
pub(super) fn matched(
    predicted: &[Option<DVec2>],
    shot: &PhantomShot,
    gate_px: f64,
    free: &dyn Fn(usize) -> bool,
) -> Vec<(usize, usize, f64)> {
    let mut near = Vec::new();
    for (point, at) in predicted.iter().enumerate() {
        let Some(at) = at else { continue };
        for (n, shadow) in shot.shadows.iter().enumerate().filter(|(n, _)| free(*n)) {
            let off = shadow.image_px.distance(*at);
            if off <= gate_px {
                near.push((point, n, off));
            }
        }
    }
    near.sort_by(|a, b| a.2.total_cmp(&b.2));
    one_to_one(near, |(point, shadow, _)| [*point, *shadow])
}

/// Of a list in order of preference, what takes no number twice in any place.
pub(super) fn one_to_one<T, const N: usize>(sorted: Vec<T>, of: impl Fn(&T) -> [usize; N]) -> Vec<T> {
    let mut taken: [std::collections::BTreeSet<usize>; N] = std::array::from_fn(|_| std::collections::BTreeSet::new());
    let mut kept = Vec::new();
    for item in sorted {
        let numbers = of(&item);
        if numbers.iter().zip(&taken).all(|(number, taken)| !taken.contains(number)) {
            numbers.iter().zip(&mut taken).for_each(|(number, taken)| {
                taken.insert(*number);
            });
            kept.push(item);
        }
    }
    kept
}
