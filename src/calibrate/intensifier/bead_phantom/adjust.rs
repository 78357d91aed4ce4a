//! Poses of frames and the one distortion that they share, solved together; and which shadow is which bead under them.

use glam::{DMat3, DVec2, DVec3};
use nalgebra::Matrix2;

use super::residual::StraightenedBead;
use super::shift_field::{ShiftField, free_directions};
use crate::calibrate::intensifier::spots::Spot;
use crate::estimate::{Estimate, EstimateError, Freedom, Loss, PoseBlock, Problem, Reading, Settings, VectorBlock};
use crate::geometry::{Intrinsics, Rigid};
use crate::pose::image_spread;

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
    /// Covariance of `lps_mm`.
    pub place_mm2: DMat3,
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
    /// coefficients. Shadows are weighed by their noise as the field from which it starts carries it: were it to follow the field that is
    /// sought, one that widens the noise would seem to fit better.
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
                let [uu, uv, vv] = self.field.straight_noise_px2(shadow.image_px, shadow.noise_px2);
                let residual = StraightenedBead {
                    ids: [camera.id(), shift.id()],
                    camera,
                    shift,
                    intrinsics: *intrinsics,
                    lps_mm: bead.lps_mm,
                    place_mm2: bead.place_mm2,
                    image_px: shadow.image_px,
                    terms: self.field.terms_at(shadow.image_px),
                    noise_px2: [uu + loose_px.powi(2), uv, vv + loose_px.powi(2)],
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

    /// S of every matched shadow, in the order of [`Self::equations`].
    pub fn spreads(&self, beads: &[KnownBead], k: &Intrinsics) -> Vec<Matrix2<f64>> {
        let mut spreads = Vec::with_capacity(self.count());
        for shot in &self.shots {
            for (bead, shadow) in &shot.matches {
                let (bead, shadow) = (&beads[*bead], &shot.shadows[*shadow]);
                let noise_px2 = self.field.straight_noise_px2(shadow.image_px, shadow.noise_px2);
                spreads.push(image_spread(k, &shot.camera_from_lps, bead.lps_mm, &bead.place_mm2, noise_px2));
            }
        }
        spreads
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

#[cfg(test)]
mod tests {
    use glam::DQuat;

    use super::*;
    use crate::estimate::{about, deviation};
    use crate::mask::Disc;
    use crate::random::{Purpose, Stream};

    const K: Intrinsics = Intrinsics { fx: 4000.0, fy: 4000.0, skew: 0.0, cx: 511.5, cy: 511.5 };
    /// In the plane of a CT's slices, and along its axis: thick slices.
    const PLACE_MM: [f64; 2] = [0.05, 0.8];
    const NOISE_PX: f64 = 0.05;
    const DRAWS: u64 = 20;

    /// Eighty beads, half of an axial and half of a sagittal scan, off their places by what is stated of them, and their shadows in one
    /// frame without distortion.
    fn drawn(seed: u64) -> (Adjusted, Vec<KnownBead>) {
        let mut random = Stream::new(seed, 62, 0, Purpose::Evaluation);
        let rotation = DQuat::from_rotation_z(0.4) * DQuat::from_rotation_x(1.2);
        let camera_from_lps = Rigid { rotation, translation_mm: DVec3::new(3.0, -4.0, 700.0) };
        let (mut beads, mut shadows) = (Vec::new(), Vec::new());
        for n in 0..80 {
            let mut within = || 130.0 * (random.uniform() - 0.5);
            let truth = DVec3::new(within(), within(), within());
            let [least, most] = PLACE_MM;
            let sigmas = if n % 2 == 0 { DVec3::new(least, least, most) } else { DVec3::new(most, least, least) };
            let mut normal = || random.normal();
            let lps_mm = truth + sigmas * DVec3::new(normal(), normal(), normal());
            beads.push(KnownBead { lps_mm, place_mm2: DMat3::from_diagonal(sigmas * sigmas) });
            let image_px = K.project(camera_from_lps.transform_point(truth)) + NOISE_PX * DVec2::new(normal(), normal());
            shadows.push(Spot { image_px, sigma_px: NOISE_PX, noise_px2: [NOISE_PX * NOISE_PX, 0.0, NOISE_PX * NOISE_PX] });
        }
        let matches = (0..beads.len()).map(|n| (n, n)).collect();
        let field = ShiftField::trial(Disc { centre: DVec2::splat(511.5), radius_px: 450.0 }, 0.0, 0.0);
        (Adjusted { shots: vec![Shot { frame: 0, shadows, camera_from_lps, matches }], field }, beads)
    }

    /// Of the frame's pose what is off, and the covariance that the equations state of it.
    fn solved(truth: &Adjusted, beads: &[KnownBead]) -> (nalgebra::Vector6<f64>, nalgebra::Matrix6<f64>) {
        let equations = truth.equations(beads, &K, Weighing::Settled, |_| true);
        let estimate = equations.solve().expect("solves");
        let camera = equations.cameras[0];
        let stated = estimate.covariance().expect("determined").of(&[camera.id()]);
        let found = estimate.state().motion(camera);
        let off = about(found.centre_mm()) * deviation(&truth.shots[0].camera_from_lps, &found.pose);
        (off, nalgebra::Matrix6::from_fn(|i, j| stated[(i, j)]))
    }

    #[test]
    fn what_is_stated_holds_where_beads_are_known_far_worse_along_one_axis() {
        let (mut own, mut alike) = (0.0, 0.0);
        for seed in 0..DRAWS {
            let (truth, beads) = drawn(seed);
            let (off, covariance) = solved(&truth, &beads);
            let stated = covariance.cholesky().expect("positive definite");
            own += off.dot(&stated.solve(&off));
            let mean_mm2 = (2.0 * PLACE_MM[0].powi(2) + PLACE_MM[1].powi(2)) / 3.0;
            let same = |bead: &KnownBead| KnownBead { place_mm2: DMat3::from_diagonal(DVec3::splat(mean_mm2)), ..*bead };
            let (off, _) = solved(&truth, &beads.iter().map(same).collect::<Vec<_>>());
            alike += off.dot(&stated.solve(&off));
        }
        // χ² of n numbers scatters by √(2 n) about n; 4.5 times that is accident once in some 100 000 times.
        let numbers = 6.0 * DRAWS as f64;
        let most = 4.5 * (2.0 * numbers).sqrt();
        assert!((own - numbers).abs() < most, "{own} of {numbers} ± {most}");
        // The control: with places that are known alike along all axes the same shadows give poses further off than these state.
        assert!(alike > 3.0 * numbers, "{alike} of {numbers}");
    }

    /// Near the rim of a pincushion the straight picture is smaller than the frame, and with it the noise of shadows: weighed by what it is in
    /// the frame, they fitted better than they can.
    #[test]
    fn shadows_of_a_bent_picture_fit_as_their_noise_allows() {
        const NOISE_PX: [f64; 2] = [0.2, 0.1];
        let disc = Disc { centre: DVec2::splat(511.5), radius_px: 450.0 };
        let field = ShiftField::trial(disc, 0.12, 0.03);
        let camera_from_lps = Rigid { rotation: DQuat::from_rotation_x(1.2), translation_mm: DVec3::new(3.0, -4.0, 700.0) };
        let (mut sum, mut as_in_the_frame, mut degrees) = (0.0, 0.0, 0.0);
        for seed in 0..2 * DRAWS {
            let mut random = Stream::new(seed, 65, 0, Purpose::Evaluation);
            let (mut beads, mut shadows) = (Vec::new(), Vec::new());
            for n in 0..80 {
                let at =
                    disc.centre + 430.0 * random.uniform().sqrt() * DVec2::from_angle(std::f64::consts::TAU * random.uniform());
                let depth_mm = 630.0 + 140.0 * random.uniform();
                let lps_mm = camera_from_lps.inverse().transform_point(K.unproject(field.straight(at)) * depth_mm);
                // Places that are known exactly, but for what makes a covariance.
                beads.push(KnownBead { lps_mm, place_mm2: DMat3::from_diagonal(DVec3::splat(1e-10)) });
                let [u_px, v_px] = if n % 2 == 0 { NOISE_PX } else { [NOISE_PX[1], NOISE_PX[0]] };
                let image_px = at + DVec2::new(u_px * random.normal(), v_px * random.normal());
                shadows.push(Spot { image_px, sigma_px: 0.15, noise_px2: [u_px * u_px, 0.0, v_px * v_px] });
            }
            let matches = (0..beads.len()).map(|n| (n, n)).collect();
            let shot = Shot { frame: 0, shadows, camera_from_lps, matches };
            let truth = Adjusted { shots: vec![shot], field: field.clone() };
            let equations = truth.equations(&beads, &K, Weighing::Settled, |_| true);
            let estimate = equations.solve().expect("solves");
            for (n, shadow) in truth.shots[0].shadows.iter().enumerate() {
                sum += estimate.chi2(n);
                let [uu, _, vv] = shadow.noise_px2;
                let off = estimate.offset(n);
                as_in_the_frame += off[0] * off[0] / uu + off[1] * off[1] / vv;
            }
            // A pose, and sixteen coefficients that are free.
            degrees += 160.0 - 22.0;
        }
        let most = 4.5 * f64::sqrt(2.0 * degrees);
        assert!((sum - degrees).abs() < most, "{sum} of {degrees} ± {most}");
        assert!(degrees - as_in_the_frame > most, "the control: {as_in_the_frame} of {degrees} ± {most}");
    }
}
