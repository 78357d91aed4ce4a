//! That the picture is distorted: beads of a straight picture of square pixels have residuals that neither pincushion and S explain, nor
//! pixels of another shape.

use glam::{DVec2, DVec3};

use super::case::Case;
use super::cautions::Cautions;
use super::explained::{Reading, Rejected};
use super::refusal::{Refusal, taller_words};
use super::settle::Settled;
use super::solve::{Free, Match, Options, image_of, solve};
use crate::estimate::{Freedom, Loss, Problem, Settings};

/// Pincushion and S: k1 and s of the lens.
const LENS: [usize; 2] = [0, 4];
/// Height and skew of pixels: fy and skew of K.
const PIXELS: [usize; 2] = [1, 2];
/// How often the two explain as much of a straight picture by chance: where that is worth a word, and where it is sure.
const BY_CHANCE: (f64, f64) = (1e-3, 1e-5);
/// Fewer degrees of freedom, beside the pose and the two terms, tell nothing.
const LEAST_DEGREES: usize = 4;
/// At the outermost bead, px: a shift worth a word, and one that moves landmarks too far.
const SHIFT_PX: (f64, f64) = (0.7, 2.0);

/// What may be wrong with the picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    /// It is bent.
    Lens,
    /// Its pixels are not those of K.
    Pixels,
}

impl Case<'_> {
    /// A distortion that the matched beads show: a word, or where it moves what lies among them, a refusal.
    pub(super) fn check_lens(&self, last: &Settled, cautions: &mut Cautions) -> Result<(), Refusal> {
        if self.request.distortion.is_some() || self.request.free() != Free::Pose {
            return Ok(());
        }
        let found = [Fault::Lens, Fault::Pixels].into_iter().filter_map(|fault| self.bent(last, fault));
        // The one that explains more.
        let Some(Bent { fault, given_px, bent_px, shift_px, taller, is_sure }) =
            found.min_by(|a, b| a.bent_px.total_cmp(&b.bent_px))
        else {
            return Ok(());
        };
        if shift_px > SHIFT_PX.1 && is_sure {
            return Err(match fault {
                Fault::Lens => Refusal::Distorted { given_px, bent_px, shift_px },
                Fault::Pixels => Refusal::Pixels { given_px, bent_px, taller },
            });
        }
        if shift_px > SHIFT_PX.0 {
            let (what, remedy) = match fault {
                Fault::Lens => (
                    format!("the picture is distorted by {shift_px:.1} px at the outermost of them"),
                    "calibrate the intensifier or lens",
                ),
                Fault::Pixels => (
                    format!("its pixels are {:.1} % {} than K says", 100.0 * (taller - 1.0).abs(), taller_words(taller)),
                    "was the picture stretched on its way?",
                ),
            };
            cautions.doubt(format!("the beads agree to {bent_px:.2} px instead of {given_px:.2} px if {what}: {remedy}"));
        }
        Ok(())
    }

    fn bent(&self, last: &Settled, fault: Fault) -> Option<Bent> {
        let matches = &last.matches;
        let terms = if fault == Fault::Lens { LENS } else { PIXELS };
        let degrees = (2 * matches.len()).checked_sub(6 + terms.len()).filter(|degrees| *degrees >= LEAST_DEGREES)? as f64;
        // The quantile of F with two degrees of freedom above: P(F > x) = (1 + 2x/d)^(−d/2).
        let needed = |by_chance: f64| 0.5 * degrees * (by_chance.powf(-2.0 / degrees) - 1.0);
        let (k, pose) = (last.solution.intrinsics, last.solution.camera_from_lps);
        let mean_lps = matches.iter().map(|m| m.lps_mm).sum::<DVec3>() / matches.len() as f64;
        let mut problem = Problem::new();
        let camera = problem.pose("camera_from_lps", pose, mean_lps, true);
        let freedom = |own: Fault| if own == fault { Freedom::Only(terms.to_vec()) } else { Freedom::Constant };
        let intrinsics = problem.vector("intrinsics", &[k.fx, k.fy, k.skew, k.cx, k.cy], freedom(Fault::Pixels));
        let lens = problem.vector("lens", &[0.0; 5], freedom(Fault::Lens));
        for m in matches {
            problem.add(image_of(m, camera, intrinsics, 1.0).through(lens), Loss::None);
        }
        let estimate = problem.solve(&Settings::default()).ok()?;
        let state = estimate.state();
        let freed: f64 = (0..matches.len()).map(|n| estimate.chi2(n)).sum();
        // The same without the two terms: a pose that a fused prior, or a robust loss, has drawn away would make them look needed.
        let straight = solve(matches, &pose, &k, &Options::least_squares(Free::Pose))?;
        let given: f64 = straight.chi2.iter().sum();
        let ratio = ((given - freed) / terms.len() as f64) / (freed / degrees);
        if !(ratio > needed(BY_CHANCE.0)) {
            let reading = if fault == Fault::Lens { Reading::Distortion } else { Reading::PixelShape };
            self.hear(reading, None, &pose, Rejected::NotNeeded { times: ratio, needed: needed(BY_CHANCE.0) });
            return None;
        }
        let rms = |squares: f64| (squares / matches.len() as f64).sqrt();
        let left = (0..matches.len()).map(|n| DVec2::from_slice(estimate.offset(n)).length_squared()).sum();
        let seen = |m: &Match| {
            let p = state.pose(camera).transform_point(m.lps_mm);
            p.truncate() / p.z
        };
        let middle = matches.iter().map(seen).sum::<DVec2>() / matches.len() as f64;
        let [k1, s] = LENS.map(|term| state.vector(lens)[term]);
        let [fy, skew] = PIXELS.map(|term| state.vector(intrinsics)[term]);
        let shift = |m: &Match| match fault {
            Fault::Lens => k.fx * k1.hypot(s) * seen(m).length().powi(3),
            Fault::Pixels => (fy - k.fy).hypot(skew - k.skew) * (seen(m) - middle).y.abs(),
        };
        let shift_px = matches.iter().map(shift).fold(0.0, f64::max);
        let (taller, is_sure) = (k.fy / fy, ratio > needed(BY_CHANCE.1));
        shift_px.is_finite().then_some(Bent { fault, given_px: last.rms_px(), bent_px: rms(left), shift_px, taller, is_sure })
    }
}

struct Bent {
    fault: Fault,
    given_px: f64,
    bent_px: f64,
    /// Of the distortion, at the outermost matched bead.
    shift_px: f64,
    /// Height of a pixel over its width, by K's.
    taller: f64,
    /// Not by chance.
    is_sure: bool,
}
