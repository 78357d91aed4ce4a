//! A bead's shadow, straightened by the distortion that is sought, against its projection.

use glam::{DMat3, DVec3};

use crate::estimate::{BlockId, Evaluation, PoseBlock, Residual, State, VectorBlock, turned};
use crate::geometry::Intrinsics;
use crate::pose::image_spread;

/// p + Σ sₖ tₖ(p) − K · (camera_from_lps · bead), px: linear in the coefficients s.
pub struct StraightenedBead {
    pub ids: [BlockId; 2],
    /// `camera_from_lps`.
    pub camera: PoseBlock,
    /// Coefficients of columns, then of rows, px.
    pub shift: VectorBlock,
    pub intrinsics: Intrinsics,
    pub lps_mm: DVec3,
    /// Covariance of `lps_mm`.
    pub place_mm2: DMat3,
    pub image_px: glam::DVec2,
    /// Of the terms tₖ at `image_px`.
    pub terms: Vec<f64>,
    /// Covariance of the shadow's place and of what the polynomial cannot follow: uu, uv, vv.
    pub noise_px2: [f64; 3],
}

impl Residual for StraightenedBead {
    fn dimension(&self) -> usize {
        2
    }

    fn blocks(&self) -> &[BlockId] {
        &self.ids
    }

    fn evaluate(&self, state: &State, out: &mut Evaluation) -> bool {
        let motion = state.motion(self.camera);
        let p = motion.pose.transform_point(self.lps_mm);
        if !(p.z > 1.0) {
            return false;
        }
        let (by_u, by_v) = state.vector(self.shift).split_at(self.terms.len());
        let sum = |by: &[f64]| by.iter().zip(&self.terms).map(|(coefficient, term)| coefficient * term).sum::<f64>();
        let off = self.image_px + glam::DVec2::new(sum(by_u), sum(by_v)) - self.intrinsics.project(p);
        out.offset().copy_from_slice(&off.to_array());
        let spread = image_spread(&self.intrinsics, &motion.pose, self.lps_mm, &self.place_mm2, self.noise_px2);
        let Some(information) = spread.try_inverse() else { return false };
        out.information().copy_from_slice(information.as_slice());
        if let Some(jacobian) = out.jacobian(0) {
            let arm = p - motion.centre_mm();
            let [u, v] = self.intrinsics.slopes_px_per_mm(p).map(|row| turned(row, arm));
            jacobian.chunks_exact_mut(2).zip(u.into_iter().zip(v)).for_each(|(column, (u, v))| (column[0], column[1]) = (u, v));
        }
        if let Some(jacobian) = out.jacobian(1) {
            // The prediction is what the shift leaves to explain.
            let (first, second) = jacobian.split_at_mut(2 * self.terms.len());
            for (n, term) in self.terms.iter().enumerate() {
                (first[2 * n], second[2 * n + 1]) = (-term, -term);
            }
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use glam::DVec2;
    use nalgebra::DMatrix;

    use super::*;
    use crate::estimate::{Freedom, Loss, Numeric, Problem, Settings};
    use crate::geometry::Rigid;

    /// One step of least squares from the same start with derivatives of the residual's own, and with differences.
    #[test]
    fn derivatives_are_those_of_the_function() {
        let intrinsics = Intrinsics { fx: 900.0, fy: 900.0, skew: 0.0, cx: 250.0, cy: 260.0 };
        let solved = |numeric: bool| {
            let mut problem = Problem::new();
            let start = Rigid::exp(DVec3::new(0.3, -0.2, 0.4), DVec3::new(3.0, 5.0, 700.0));
            let camera = problem.pose("camera_from_lps", start, DVec3::new(5.0, 6.0, 7.0), true);
            let shift = problem.vector("shift", &[0.1, 0.2, 0.3, 0.4, 0.5, 0.6], Freedom::Only(vec![1, 5]));
            for n in 0..9 {
                let side = |n: i32| f64::from(n % 3 - 1);
                let lps_mm = DVec3::new(50.0 * side(n), 50.0 * side(n / 3), 20.0 * side(n * n));
                let image_px = DVec2::new(250.0 + 60.0 * side(n), 260.0 + 60.0 * side(n / 3));
                let terms = vec![1.0, 0.01 * image_px.x, 0.01 * image_px.y];
                let bead = StraightenedBead {
                    ids: [camera.id(), shift.id()],
                    camera,
                    shift,
                    intrinsics,
                    lps_mm,
                    place_mm2: DMat3::ZERO,
                    image_px,
                    terms: terms.clone(),
                    noise_px2: [0.25, 0.0, 0.25],
                };
                if numeric {
                    let information = DMatrix::identity(2, 2) * 4.0;
                    let predict = move |state: &State, out: &mut [f64]| {
                        let s = state.vector(shift);
                        let by = |n: usize| (0..3).map(|k| s[n + k] * terms[k]).sum::<f64>();
                        let at = intrinsics.project(state.pose(camera).transform_point(lps_mm)) - DVec2::new(by(0), by(3));
                        out.copy_from_slice(&at.to_array());
                        true
                    };
                    let ids = [camera.id(), shift.id()];
                    let numeric = Numeric::new(&problem, &ids, &image_px.to_array(), information, predict);
                    problem.add(numeric, Loss::None);
                } else {
                    problem.add(bead, Loss::None);
                }
            }
            let estimate = problem.solve(&Settings { iterations: 1, ..Settings::default() }).expect("a step");
            (*estimate.state().pose(camera), estimate.state().vector(shift).to_vec(), estimate.chi2_sum())
        };
        let (own, differences) = (solved(false), solved(true));
        assert!(
            own.0.angle_to_rad(&differences.0) < 1e-6 && (own.2 / differences.2 - 1.0).abs() < 1e-5,
            "{own:?} {differences:?}"
        );
        assert!(own.1.iter().zip(&differences.1).all(|(a, b)| (a - b).abs() < 1e-4), "{own:?} {differences:?}");
        assert!((own.1[1] - 0.2).abs() > 1e-3, "the step moves something: {own:?}");
    }
}
