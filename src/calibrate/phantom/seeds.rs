//! Three shots matched from nothing but rough cameras.
//!
//! What is unsure of a camera moves its whole picture, and turns and stretches it a little. So one bead seen in three shots, taken on trial,
//! tells how each picture is moved; all others must then lie within the little that is left, and the trial with most of them is improved
//! step by step, the gate closing as cameras and beads become known.

use glam::{DVec2, DVec3};
use nalgebra::{Matrix2, Matrix2x6, Matrix6, Vector2};

use super::adjust::Adjustment;
use super::shot::{CameraErrors, PhantomShot, ShotShadow, middle_of, nearest};
use super::structure::{Structure, one_to_one, ray, seen};
use crate::estimate::{about, median, turned};
use crate::geometry::Rigid;

/// Shadows of a shot that start a trial: the best.
const MOST_SHADOWS: usize = 30;
/// Squared deviation of three pictures' moves from what the rough cameras allow.
const MOST_MOVED: f64 = 25.0;
/// Gate of what is left, in standard deviations.
const TIMES: f64 = 3.0;
/// How far a bead may lie from the middle.
const REACH_MM: f64 = 300.0;
/// Trials that are improved.
const MOST_TRIALS: usize = 30;
/// How the gate closes, as shares of the first.
const CLOSING: [f64; 4] = [0.5, 0.2, 0.08, 0.0];
/// Fewest beads of a match.
const FEWEST: usize = 4;

/// How far a picture may lie from where the rough camera has it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Gate {
    /// Inverse covariance of the whole picture's move.
    information: Matrix2<f64>,
    /// What is left beside a known move.
    pub fine_px: f64,
    /// What is left of shadows whose beads and camera are known.
    pub last_px: f64,
}

impl Gate {
    /// Of each shot, `times` as wide as its covariance says.
    pub fn all(shots: &[PhantomShot], errors: &CameraErrors, times: f64) -> Vec<Self> {
        let cameras: Vec<_> = shots.iter().map(|shot| shot.camera_from_world).collect();
        let middle = middle_of(&cameras);
        shots.iter().map(|shot| Self::of(shot, errors, shot.camera_from_world.transform_point(middle), times)).collect()
    }

    fn of(shot: &PhantomShot, errors: &CameraErrors, middle: DVec3, times: f64) -> Self {
        let k = shot.intrinsics;
        let p = if middle.z > 1.0 { middle } else { DVec3::Z * 600.0 };
        let rows = k.slopes_px_per_mm(p).map(|slope| turned(slope, p));
        let slope = Matrix2x6::from_fn(|i, j| rows[i][j]);
        let covariance = Matrix6::from_fn(|i, j| shot.covariance[i][j]) * (times * times);
        let sigma_px = median(shot.shadows.iter().map(ShotShadow::sigma_px)).unwrap_or(0.1);
        let moved = slope * covariance * slope.transpose() + Matrix2::identity() * sigma_px.powi(2).max(0.04);
        let own = about(p) * covariance * about(p).transpose();
        let largest = |from: usize| (from..from + 3).map(|n| own[(n, n)]).fold(0.0, f64::max).sqrt();
        let count = shot.shadows.len().max(1) as f64;
        let mean = shot.shadows.iter().map(|shadow| shadow.image_px).sum::<DVec2>() / count;
        let spread = (shot.shadows.iter().map(|shadow| shadow.image_px.distance_squared(mean)).sum::<f64>() / count).sqrt();
        // A wrong principal point is a turned camera, but for terms of second order in the angle to the axis.
        let bent = (errors.principal_point_px + errors.each_principal_point_px) * (spread / k.fx).powi(2);
        let last_px = (6.0 * sigma_px).max(0.6).hypot(TIMES * bent);
        let left = spread * (2.0 * largest(0).powi(2) + (largest(3) / p.z).powi(2)).sqrt();
        Self { information: moved.try_inverse().unwrap_or_else(Matrix2::zeros), fine_px: TIMES * left + last_px, last_px }
    }

    /// Squared deviation of a move.
    pub fn moved(&self, by: DVec2) -> f64 {
        let by = Vector2::new(by.x, by.y);
        by.dot(&(self.information * by))
    }
}

/// Three shots and how their pictures are moved.
struct Trio<'a> {
    shots: &'a [PhantomShot],
    gates: &'a [Gate],
    of: [usize; 3],
}

/// A bead by its shadows in three shots, and how far they are from it.
#[derive(Clone, Copy, Debug)]
struct Triple {
    shadows: [usize; 3],
    point: DVec3,
    off_px: f64,
}

/// Matches of three shots, the best first; each differs from those before it.
pub(super) fn of_three(shots: &[PhantomShot], gates: &[Gate], of: [usize; 3]) -> Vec<Structure> {
    let trio = Trio { shots, gates, of };
    let rough = of.map(|n| shots[n].camera_from_world);
    let counts = of.map(|n| shots[n].shadows.len().min(MOST_SHADOWS));
    let mut trials: Vec<(f64, Vec<Triple>)> = Vec::new();
    for i in 0..counts[0] {
        for j in 0..counts[1] {
            for k in 0..counts[2] {
                let Some(moves) = trio.moves(&rough, [i, j, k]) else { continue };
                let share = |triple: &Triple| 1.0 - 0.5 * triple.off_px / trio.gate_px(1.0);
                let found = trio.triples(&rough, moves, 1.0, MOST_SHADOWS);
                if found.len() >= FEWEST {
                    trials.push((found.iter().map(share).sum(), found));
                }
            }
        }
    }
    trials.sort_by(|a, b| b.0.total_cmp(&a.0));
    // Each bead of a match starts a trial; one of them is enough.
    let mut distinct: Vec<Vec<[usize; 3]>> = Vec::new();
    trials.retain(|(_, found)| {
        let own: Vec<[usize; 3]> = found.iter().map(|triple| triple.shadows).collect();
        let alike = |known: &Vec<[usize; 3]>| own.iter().filter(|shadows| known.contains(shadows)).count() * 5 > own.len() * 4;
        let is_new = distinct.len() < MOST_TRIALS && !distinct.iter().any(alike);
        if is_new {
            distinct.push(own);
        }
        is_new
    });
    let mut matches: Vec<Structure> = Vec::new();
    for (_, triples) in trials {
        if let Some(found) = trio.improved(&triples)
            && matches.iter().all(|known| known.alike(&found) < 0.5)
        {
            matches.push(found);
        }
    }
    let worth = |found: &Structure| found.points.len() as f64 - 0.2 * found.rms_px(shots);
    matches.sort_by(|a, b| worth(b).total_cmp(&worth(a)));
    matches
}

impl Trio<'_> {
    /// The widest of the three gates, closed to `share`.
    fn gate_px(&self, share: f64) -> f64 {
        let own = |n: &usize| (share * self.gates[*n].fine_px).max(self.gates[*n].last_px);
        self.of.iter().map(own).fold(0.0, f64::max)
    }

    /// How each picture is moved if these shadows are one bead's; `None` where no camera may be so far off.
    fn moves(&self, cameras: &[Rigid; 3], shadows: [usize; 3]) -> Option<[DVec2; 3]> {
        let at: [DVec2; 3] = std::array::from_fn(|n| self.shots[self.of[n]].shadows[shadows[n]].image_px);
        let point = nearest((0..3).map(|n| ray(&self.shots[self.of[n]], &cameras[n], at[n])))?;
        let mut moves = [DVec2::ZERO; 3];
        let mut moved = 0.0;
        for n in 0..3 {
            moves[n] = at[n] - seen(&self.shots[self.of[n]], &cameras[n], point)?;
            moved += self.gates[self.of[n]].moved(moves[n]);
        }
        (moved <= MOST_MOVED).then_some(moves)
    }

    /// Beads that three pictures, moved back, agree on: one to one, the closest first.
    fn triples(&self, cameras: &[Rigid; 3], moves: [DVec2; 3], share: f64, most: usize) -> Vec<Triple> {
        let [a, b, c] = self.of.map(|n| &self.shots[n]);
        let rays = |n: usize, shot: &PhantomShot| -> Vec<_> {
            let all = shot.shadows.iter().take(most);
            all.map(|shadow| ray(shot, &cameras[n], shadow.image_px - moves[n])).collect()
        };
        let (in_a, in_b) = (rays(0, a), rays(1, b));
        let gate_px = self.gate_px(share);
        let middle = nearest([a, b, c].iter().zip(cameras).map(|(shot, camera)| ray(shot, camera, centre_px(shot))));
        let mut found = Vec::new();
        for (i, from_a) in in_a.iter().enumerate() {
            for (j, from_b) in in_b.iter().enumerate() {
                let Some(point) = nearest([*from_a, *from_b].into_iter()) else { continue };
                if middle.is_some_and(|middle| middle.distance(point) > REACH_MM) {
                    continue;
                }
                let off = |n: usize, shot: &PhantomShot, at: DVec2| {
                    seen(shot, &cameras[n], point).map_or(f64::INFINITY, |seen| seen.distance(at - moves[n]))
                };
                let (off_a, off_b) = (off(0, a, a.shadows[i].image_px), off(1, b, b.shadows[j].image_px));
                if !(off_a <= gate_px && off_b <= gate_px) {
                    continue;
                }
                let nearest_in_c = c.shadows.iter().take(most).enumerate().map(|(k, shadow)| (k, off(2, c, shadow.image_px)));
                if let Some((k, off_c)) = nearest_in_c.min_by(|x, y| x.1.total_cmp(&y.1)).filter(|(_, off)| *off <= gate_px) {
                    let off_px = (off_a.powi(2) + off_b.powi(2) + off_c.powi(2)).sqrt();
                    found.push(Triple { shadows: [i, j, k], point, off_px });
                }
            }
        }
        found.sort_by(|x, y| x.off_px.total_cmp(&y.off_px));
        one_to_one(found, |triple| triple.shadows)
    }

    fn structure(&self, cameras: &[Rigid; 3], triples: &[Triple]) -> Structure {
        let mut structure = Structure::new(self.shots.len());
        for (n, camera) in self.of.iter().zip(cameras) {
            structure.cameras[*n] = Some(*camera);
        }
        for triple in triples {
            let mut track = vec![None; self.shots.len()];
            for (n, shadow) in self.of.iter().zip(triple.shadows) {
                track[*n] = Some(shadow);
            }
            structure.points.push(triple.point);
            structure.tracks.push(track);
        }
        structure
    }

    /// Solved and matched anew while the gate closes; `None` where too few are left.
    fn improved(&self, triples: &[Triple]) -> Option<Structure> {
        let rough = self.of.map(|n| self.shots[n].camera_from_world);
        let mut structure = self.structure(&rough, triples);
        for share in CLOSING {
            structure = Adjustment::plain(self.shots, &structure).improved()?;
            let cameras = self.of.map(|n| structure.cameras[n].unwrap_or(rough[0]));
            let triples = self.triples(&cameras, [DVec2::ZERO; 3], share, usize::MAX);
            if triples.len() < FEWEST {
                return None;
            }
            structure = self.structure(&cameras, &triples);
        }
        Adjustment::plain(self.shots, &structure).improved()
    }
}

fn centre_px(shot: &PhantomShot) -> DVec2 {
    shot.shadows.iter().map(|shadow| shadow.image_px).sum::<DVec2>() / shot.shadows.len().max(1) as f64
}
