//! Names that settle, outliers that go, and what is left at beads that the fit has not seen.

use glam::DVec2;
use nalgebra::Matrix2;

use super::adjust::{Adjusted, KnownBead, Weighing};
use crate::calibrate::intensifier::outliers::limit_px;
use crate::estimate::EstimateError;
use crate::geometry::Intrinsics;
use crate::pose::rounded_px;

/// Radii in which shadows are sought, in radii of the disc: the first after a frame's own start, the last while names settle.
const SOUGHT: [f64; 4] = [0.02, 0.014, 0.01, 0.008];
const ROUNDS: usize = 12;
/// Parts of the beads that are held out in turn.
const FOLDS: usize = 10;

impl Adjusted {
    /// Solved and named by turns until the names stay, then freed of shadows that do not belong.
    ///
    /// # Errors
    /// When the equations have no solution.
    pub fn settled(self, beads: &[KnownBead], k: &Intrinsics) -> Result<Self, EstimateError> {
        let radius_px = self.field.disc.radius_px;
        let mut now = self;
        for round in 0..ROUNDS {
            let sought_px = radius_px * SOUGHT[round.min(SOUGHT.len() - 1)];
            let solved = now.solved(beads, k, Weighing::Sought { radius_px: sought_px })?;
            let next = solved.rematched(beads, k, sought_px);
            let same = next.matches_as(&now) && round + 1 >= SOUGHT.len();
            now = next;
            if same {
                break;
            }
        }
        now.without_outliers(beads, k)
    }

    // A false shadow draws the polynomial to itself: judged is how far each would be off had it been left out, the worst first. Off along
    // the direction in which its bead is known badly counts less than across it.
    fn without_outliers(mut self, beads: &[KnownBead], k: &Intrinsics) -> Result<Self, EstimateError> {
        loop {
            let equations = self.equations(beads, k, Weighing::Settled, |_| true);
            let estimate = equations.solve()?;
            let covariance = estimate.covariance()?;
            let solved = equations.state(&estimate, &self);
            let off = |(n, spread): (usize, Matrix2<f64>)| {
                let left = estimate.left_out_linear(&covariance, n);
                left.map_or(f64::INFINITY, |left| rounded_px(DVec2::new(left.offset[0], left.offset[1]), &spread))
            };
            let off_px: Vec<f64> = solved.spreads(beads, k).into_iter().enumerate().map(off).collect();
            let Some(limit_px) = limit_px(off_px.iter().copied()) else { return Ok(solved) };
            let before = self.count();
            let mut off_px = off_px.into_iter();
            self = solved;
            for shot in &mut self.shots {
                shot.matches.retain(|_| off_px.next().is_some_and(|off| off <= limit_px));
            }
            if self.count() == before {
                return Ok(self);
            }
        }
    }

    /// Sum of squared residuals, px², of every shadow under poses and a distortion solved without any shadow of its bead.
    ///
    /// # Errors
    /// When the equations without a part of the beads have no solution.
    pub fn held_out_px2(&self, beads: &[KnownBead], k: &Intrinsics) -> Result<f64, EstimateError> {
        let mut sum = 0.0;
        for held in 0..FOLDS {
            let is_held = |bead: usize| bead % FOLDS == held;
            let equations = self.equations(beads, k, Weighing::Settled, |bead| !is_held(bead));
            let estimate = equations.solve()?;
            let without = equations.state(&estimate, self);
            for shot in &without.shots {
                for (bead, shadow) in shot.matches.iter().filter(|(bead, _)| is_held(*bead)) {
                    sum += without.off_px(shot, &beads[*bead], &shot.shadows[*shadow], k).length_squared();
                }
            }
        }
        Ok(sum)
    }
}
