//! Poses of frames and the one distortion that they share, solved together; and which shadow is which bead under them.

use glam::{DVec2, DVec3};

use super::residual::StraightenedBead;
use super::shift_field::{ShiftField, free_directions};
use crate::calibrate::intensifier::spots::Spot;
use crate::estimate::{Estimate, EstimateError, Freedom, Loss, PoseBlock, Problem, Reading, Settings, VectorBlock};
use crate::geometry::{Intrinsics, Rigid};

/// Coefficients are expected within this share of the disc's radius: a bound for those that the beads leave open, and next to nothing
/// beside hundreds of shadows.
const COEFFICIENT: f64 = 0.1;
/// Loss of shadows that may be no bead's, in standard deviations.
const DOUBTED: f64 = 3.0;
/// The place of a shadow that may be another's is taken as known to this share of the radius in which it was sought.
const LOOSE: f64 = 0.25;

/// A bead of the phantom.
#[derive(Clone, Copy, Debug)]
pub struct KnownBead {
    pub lps_mm: DVec3,
    /// Per axis.
    pub sigma_mm: f64,
}

/// A frame: its shadows, and what is known of it by now.
#[derive(Clone, Debug)]
pub struct Shot {
    /// Among the frames given.
    pub frame: usize,
    pub shadows: Vec<Spot>,
    pub camera_from_lps: Rigid,
    /// Bead and shadow, by bead.
    pub matches: Vec<(usize, usize)>,
}

/// Frames of one C-arm angle and their distortion.
#[derive(Clone, Debug)]
pub struct Adjusted {
    pub shots: Vec<Shot>,
    pub field: ShiftField,
}

/// The same with its equations still at hand.
pub struct Equations<'a> {
    problem: Problem<'a>,
    cameras: Vec<PoseBlock>,
    shift: VectorBlock,
}

/// How shadows are weighed.
#[derive(Clone, Copy, Debug)]
pub enum Weighing {
    /// By their noise alone: they are the beads'.
    Settled,
    /// Sought within so many pixels; some may be others'.
    Sought {
        /// That radius.
        radius_px: f64,
    },
}

impl Adjusted {
    /// The residuals of all matched shadows whose bead `counts`, frame by frame and in the order of their matches, then the bound on the
    /// coefficients.
    pub fn equations(
        &self,
        beads: &[KnownBead],
        intrinsics: &Intrinsics,
        weighing: Weighing,
        counts: impl Fn(usize) -> bool,
    ) -> Equations<'static> {
        let (loose_px, loss) = match weighing {
            Weighing::Settled => (0.0, Loss::None),
            Weighing::Sought { radius_px } => (LOOSE * radius_px, Loss::Cauchy(DOUBTED)),
        };
        let mut problem = Problem::new();
        let pivot_mm = beads.iter().map(|bead| bead.lps_mm).sum::<DVec3>() / beads.len().max(1) as f64;
        let numbers = self.field.numbers();
        let shift = problem.vector("distortion", &numbers, Freedom::Along(free_directions(self.field.order)));
        let mut cameras = Vec::new();
        for shot in &self.shots {
            let camera = problem.pose("camera_from_lps", shot.camera_from_lps, pivot_mm, true);
            cameras.push(camera);
            for (bead, shadow) in shot.matches.iter().filter(|(bead, _)| counts(*bead)) {
                let (bead, shadow) = (&beads[*bead], &shot.shadows[*shadow]);
                let residual = StraightenedBead {
                    ids: [camera.id(), shift.id()],
                    camera,
                    shift,
                    intrinsics: *intrinsics,
                    lps_mm: bead.lps_mm,
                    sigma_mm: bead.sigma_mm,
                    image_px: shadow.image_px,
                    terms: self.field.terms_at(shadow.image_px),
                    variance_px2: shadow.sigma_px.powi(2) + loose_px.powi(2),
                };
                problem.add(residual, loss);
            }
        }
        let sigmas = vec![COEFFICIENT * self.field.disc.radius_px; numbers.len()];
        problem.add(Reading::with_sigmas(shift, &vec![0.0; numbers.len()], &sigmas), Loss::None);
        Equations { problem, cameras, shift }
    }

    /// Solved from where it is.
    ///
    /// # Errors
    /// When a bead comes to lie behind the focal spot, or a number is not finite.
    pub fn solved(&self, beads: &[KnownBead], k: &Intrinsics, weighing: Weighing) -> Result<Self, EstimateError> {
        let equations = self.equations(beads, k, weighing, |_| true);
        let estimate = equations.solve()?;
        Ok(equations.state(&estimate, self))
    }

    /// Straightened shadow less projection.
    pub fn off_px(&self, shot: &Shot, bead: &KnownBead, shadow: &Spot, k: &Intrinsics) -> DVec2 {
        self.field.straight(shadow.image_px) - k.project(shot.camera_from_lps.transform_point(bead.lps_mm))
    }

    /// The shadows nearest to where the beads are expected, one each, within `radius_px`.
    pub fn rematched(&self, beads: &[KnownBead], k: &Intrinsics, radius_px: f64) -> Self {
        let mut next = self.clone();
        for shot in &mut next.shots {
            let mut pairs = Vec::new();
            for (n, bead) in beads.iter().enumerate() {
                if !(shot.camera_from_lps.transform_point(bead.lps_mm).z > 1.0) {
                    continue;
                }
                for (m, shadow) in shot.shadows.iter().enumerate() {
                    let off_px = self.off_px(shot, bead, shadow, k).length();
                    if off_px < radius_px {
                        pairs.push((off_px, n, m));
                    }
                }
            }
            pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
            let mut matches: Vec<(usize, usize)> = Vec::new();
            for (_, bead, shadow) in pairs {
                if !matches.iter().any(|(b, s)| *b == bead || *s == shadow) {
                    matches.push((bead, shadow));
                }
            }
            matches.sort_unstable();
            shot.matches = matches;
        }
        next
    }

    /// Matched shadows of all frames.
    pub fn count(&self) -> usize {
        self.shots.iter().map(|shot| shot.matches.len()).sum()
    }

    /// Whether every frame's shadows have the same names.
    pub fn matches_as(&self, other: &Self) -> bool {
        self.shots.iter().zip(&other.shots).all(|(a, b)| a.matches == b.matches)
    }
}

impl Equations<'_> {
    pub fn solve(&self) -> Result<Estimate<'_>, EstimateError> {
        self.problem.solve(&Settings::default())
    }

    /// `from` with what the estimate says.
    pub fn state(&self, estimate: &Estimate, from: &Adjusted) -> Adjusted {
        let mut next = from.clone();
        for (shot, camera) in next.shots.iter_mut().zip(&self.cameras) {
            shot.camera_from_lps = *estimate.state().pose(*camera);
        }
        next.field = from.field.with_numbers(estimate.state().vector(self.shift));
        next
    }
}
