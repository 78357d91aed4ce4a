//! That the picture is distorted: beads of a straight picture have residuals that neither pincushion nor S explains.

use glam::{DVec2, DVec3};

use super::case::Case;
use super::cautions::Cautions;
use super::refusal::Refusal;
use super::settle::Settled;
use super::solve::{Free, Match, Options, image_of, solve};
use crate::estimate::{Freedom, Loss, Problem, Settings};

/// Pincushion and S: k1 and s of the lens.
const TERMS: [usize; 2] = [0, 4];
/// How often the two explain as much of a straight picture by chance.
const BY_CHANCE: f64 = 1e-5;
/// Fewer degrees of freedom, beside the pose and the two terms, tell nothing.
const LEAST_DEGREES: usize = 4;
/// At the outermost bead, px: a shift worth a word, and one that moves landmarks too far.
const SHIFT_PX: (f64, f64) = (0.7, 2.0);

impl Case<'_> {
    /// A distortion that the matched beads show: a word, or where it moves what lies among them, a refusal.
    pub(super) fn check_lens(&self, last: &Settled, cautions: &mut Cautions) -> Result<(), Refusal> {
        if self.request.distortion.is_some() || self.request.free() != Free::Pose {
            return Ok(());
        }
        let Some(bent) = self.bent(last) else { return Ok(()) };
        if bent.shift_px > SHIFT_PX.1 {
            let Bent { given_px, bent_px, shift_px } = bent;
            return Err(Refusal::Distorted { given_px, bent_px, shift_px });
        }
        if bent.shift_px > SHIFT_PX.0 {
            cautions.say(format!(
                "the beads agree to {:.2} px instead of {:.2} px if the picture is distorted by {:.1} px at the outermost of them: calibrate the intensifier or lens",
                bent.bent_px, bent.given_px, bent.shift_px
            ));
        }
        Ok(())
    }

    fn bent(&self, last: &Settled) -> Option<Bent> {
        let matches = &last.matches;
        let degrees = (2 * matches.len()).checked_sub(6 + TERMS.len()).filter(|degrees| *degrees >= LEAST_DEGREES)? as f64;
        // The quantile of F with two degrees of freedom above: P(F > x) = (1 + 2x/d)^(−d/2).
        let needed = 0.5 * degrees * (BY_CHANCE.powf(-2.0 / degrees) - 1.0);
        let (k, pose) = (last.solution.intrinsics, last.solution.camera_from_lps);
        let mean_lps = matches.iter().map(|m| m.lps_mm).sum::<DVec3>() / matches.len() as f64;
        let mut problem = Problem::new();
        let camera = problem.pose("camera_from_lps", pose, mean_lps, true);
        let intrinsics = problem.vector("intrinsics", &[k.fx, k.fy, k.skew, k.cx, k.cy], Freedom::Constant);
        let lens = problem.vector("lens", &[0.0; 5], Freedom::Only(TERMS.to_vec()));
        for m in matches {
            problem.add(image_of(m, camera, intrinsics, 1.0).through(lens), Loss::None);
        }
        let estimate = problem.solve(&Settings::default()).ok()?;
        let state = estimate.state();
        let freed: f64 = (0..matches.len()).map(|n| estimate.chi2(n)).sum();
        // The same without the two terms: a pose that a fused prior, or a robust loss, has drawn away would make them look needed.
        let straight = solve(matches, &pose, &k, &Options::least_squares(Free::Pose))?;
        let given: f64 = straight.chi2.iter().sum();
        let ratio = ((given - freed) / TERMS.len() as f64) / (freed / degrees);
        if !(ratio > needed) {
            return None;
        }
        let rms = |squares: f64| (squares / matches.len() as f64).sqrt();
        let left = (0..matches.len()).map(|n| DVec2::from_slice(estimate.offset(n)).length_squared()).sum();
        let [k1, s] = TERMS.map(|term| state.vector(lens)[term]);
        let shift = |m: &Match| {
            let p = state.pose(camera).transform_point(m.lps_mm);
            k.fx * k1.hypot(s) * (p.truncate() / p.z).length().powi(3)
        };
        let shift_px = matches.iter().map(shift).fold(0.0, f64::max);
        shift_px.is_finite().then_some(Bent { given_px: last.rms_px(), bent_px: rms(left), shift_px })
    }
}

struct Bent {
    given_px: f64,
    bent_px: f64,
    /// Of the distortion, at the outermost matched bead.
    shift_px: f64,
}
