//! Everything at once: cameras, beads, and what is wrong in all shots alike.
//!
//! Every camera has its rough place as a measurement, so that the world does not float. All cameras may stand nearer or farther than
//! expected by one common length, all K have one common error: both change the size of the cloud and hardly its images.

use glam::DVec3;
use nalgebra::{DMatrix, Matrix6};

use super::scale::Measured;
use super::shot::{CameraErrors, PhantomShot};
use super::structure::Structure;
use crate::estimate::{
    BeadImage, Covariance, Estimate, EstimateError, Freedom, Loss, Numeric, Place, PoseBlock, PosePrior, Problem, Reading,
    Settings, State, VectorBlock, deviation,
};
use crate::geometry::Rigid;

/// Nothing of K is known better: a share of f, and px.
const TIE: (f64, f64) = (1e-6, 1e-3);

/// How the rough cameras count.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Rough {
    /// As stated.
    Stated,
    /// Hardly: about where the structure has them, rad and mm per axis.
    Hardly(f64, f64),
}

/// What is solved.
pub(super) struct Adjustment<'a> {
    pub shots: &'a [PhantomShot],
    pub structure: &'a Structure,
    pub rough: Rough,
    pub errors: CameraErrors,
    pub measured: Measured,
}

/// Where everything stands in the problem.
pub(super) struct Blocks {
    pub cameras: Vec<Option<PoseBlock>>,
    pub intrinsics: Vec<Option<VectorBlock>>,
    pub points: Vec<VectorBlock>,
    /// Residual of each rough camera.
    pub priors: Vec<Option<usize>>,
    /// Residual of each shadow: bead, shot, number of the residual.
    pub images: Vec<(usize, usize, usize)>,
}

impl<'a> Adjustment<'a> {
    /// Cameras and beads alone, K and the rough cameras as stated.
    pub fn plain(shots: &'a [PhantomShot], structure: &'a Structure) -> Self {
        Self { shots, structure, rough: Rough::Stated, errors: CameraErrors::default(), measured: Measured::default() }
    }

    pub fn problem(&self) -> (Problem<'a>, Blocks) {
        let mut problem = Problem::new();
        let (shots, structure) = (self.shots, self.structure);
        let pivot = structure.points.iter().sum::<DVec3>() / structure.points.len().max(1) as f64;
        let depth = (self.errors.depth_mm > 0.0).then(|| {
            let depth = problem.vector("depth of all cameras", &[0.0], Freedom::All);
            problem.add(Reading::with_sigmas(depth, &[0.0], &[self.errors.depth_mm]), Loss::None);
            depth
        });
        let error_of_k = self.error_of_k(&mut problem);
        let mut blocks = Blocks {
            cameras: vec![None; shots.len()],
            intrinsics: vec![None; shots.len()],
            points: Vec::new(),
            priors: vec![None; shots.len()],
            images: Vec::new(),
        };
        for (n, camera) in structure.shots() {
            let shot = &shots[n];
            let block = problem.pose("camera_from_world", *camera, pivot, true);
            let (mean, information) = match self.rough {
                Rough::Stated => (shot.camera_from_world, information(shot)),
                Rough::Hardly(rad, mm) => (*camera, hardly(camera.transform_point(pivot), rad, mm)),
            };
            blocks.priors[n] = Some(match depth {
                Some(depth) => {
                    let predict = move |state: &State, out: &mut [f64]| {
                        let mean = Rigid::translation(DVec3::Z * state.vector(depth)[0]) * mean;
                        out.copy_from_slice(deviation(state.pose(block), &mean).as_slice());
                        true
                    };
                    let information = DMatrix::from_fn(6, 6, |i, j| information[(i, j)]);
                    let prior = Numeric::new(&problem, &[block.id(), depth.id()], &[0.0; 6], information, predict);
                    problem.add(prior, Loss::None)
                }
                None => problem.add(PosePrior::new(block, mean, information), Loss::None),
            });
            blocks.cameras[n] = Some(block);
            blocks.intrinsics[n] = Some(self.intrinsics(&mut problem, shot, error_of_k));
        }
        // Evidence of the size holds beads together; else none shares a residual with another.
        let apart = self.measured.is_empty();
        for point in &structure.points {
            let at = point.to_array();
            blocks.points.push(if apart { problem.eliminated("bead", &at) } else { problem.vector("bead", &at, Freedom::All) });
        }
        for bead in 0..structure.points.len() {
            for (shot, shadow) in structure.shadows_of(bead) {
                let (Some(camera), Some(k)) = (blocks.cameras[shot], blocks.intrinsics[shot]) else { continue };
                let own = &shots[shot].shadows[shadow];
                let image = BeadImage::new(camera, k, Place::Solved(blocks.points[bead]), own.image_px, own.weighed_px2());
                blocks.images.push((bead, shot, problem.add(image, Loss::None)));
            }
        }
        self.measured.add_to(&mut problem, &blocks.points, &blocks.cameras);
        (problem, blocks)
    }

    /// What is wrong with all K: f, cx and cy in px of the first shot.
    fn error_of_k(&self, problem: &mut Problem<'a>) -> Option<VectorBlock> {
        let CameraErrors { depth_mm: _, focal, principal_point_px, each_focal, each_principal_point_px } = self.errors;
        if !(focal + principal_point_px + each_focal + each_principal_point_px > 0.0) {
            return None;
        }
        let sigmas = self.sigmas_of_k(focal, principal_point_px);
        // Fx and fy, which pixels hold together; then cx and cy.
        let block = problem.vector("error of K", &[0.0; 5], square_pixels());
        problem.add(Reading::with_sigmas(block, &[0.0; 5], &sigmas), Loss::None);
        Some(block)
    }

    /// Standard deviations of fx, fy, skew, cx, cy; those that follow from others are not counted twice.
    fn sigmas_of_k(&self, focal: f64, principal_point_px: f64) -> [f64; 5] {
        let first = self.structure.shots().next().map_or(1.0, |(n, _)| self.shots[n].intrinsics.fx);
        let least = |sigma: f64, least: f64| if sigma > least { sigma } else { least };
        let point = least(principal_point_px, TIE.1);
        [first * least(focal, TIE.0), f64::NAN, f64::NAN, point, point]
    }

    fn intrinsics(&self, problem: &mut Problem<'a>, shot: &PhantomShot, error: Option<VectorBlock>) -> VectorBlock {
        let k = shot.intrinsics;
        let start = [k.fx, k.fy, k.skew, k.cx, k.cy];
        let Some(error) = error else { return problem.vector("intrinsics", &start, Freedom::Constant) };
        let block = problem.vector("intrinsics", &start, square_pixels());
        let sigmas = self.sigmas_of_k(self.errors.each_focal, self.errors.each_principal_point_px);
        problem.add(Reading::with_sigmas(block, &start, &sigmas).behind(error), Loss::None);
        block
    }

    /// Solves for cameras and beads; `None` where that leads nowhere.
    pub fn improved(&self) -> Option<Structure> {
        let (problem, blocks) = self.problem();
        let estimate = problem.solve(&Settings { iterations: 30, step_sigmas: 1e-4 }).ok()?;
        Some(blocks.taken(self.structure, &estimate))
    }
}

impl Blocks {
    /// The structure where a solution ended.
    pub fn taken(&self, structure: &Structure, estimate: &Estimate) -> Structure {
        let state = estimate.state();
        let mut taken = structure.clone();
        for (own, block) in taken.cameras.iter_mut().zip(&self.cameras) {
            *own = block.map(|block| *state.pose(block));
        }
        for (own, block) in taken.points.iter_mut().zip(&self.points) {
            *own = state.point(*block);
        }
        taken
    }
}

/// A camera alone, from beads that stay where they are; `times` its stated covariance in standard deviations.
pub(super) fn resected(shot: &PhantomShot, camera: &Rigid, beads: &[(DVec3, usize)], times: f64) -> Option<Rigid> {
    let mut problem = Problem::new();
    let pivot = beads.iter().map(|(at, _)| *at).sum::<DVec3>() / beads.len().max(1) as f64;
    let block = problem.pose("camera_from_world", *camera, pivot, true);
    problem.add(PosePrior::new(block, shot.camera_from_world, information(shot) / (times * times)), Loss::None);
    let k = shot.intrinsics;
    let intrinsics = problem.vector("intrinsics", &[k.fx, k.fy, k.skew, k.cx, k.cy], Freedom::Constant);
    for (body_mm, shadow) in beads {
        let own = &shot.shadows[*shadow];
        let place = Place::Known { body_mm: *body_mm, covariance_mm2: glam::DMat3::ZERO, share: 1.0 };
        problem.add(BeadImage::new(block, intrinsics, place, own.image_px, own.weighed_px2()), Loss::None);
    }
    let estimate = problem.solve(&Settings { iterations: 30, step_sigmas: 1e-4 }).ok()?;
    Some(*estimate.state().pose(block))
}

/// Solves, with the covariance of all.
pub(super) fn solved<'p>(problem: &'p Problem) -> Result<(Estimate<'p>, Covariance), EstimateError> {
    let estimate = problem.solve(&Settings { iterations: 80, ..Settings::default() })?;
    let covariance = estimate.covariance()?;
    Ok((estimate, covariance))
}

fn square_pixels() -> Freedom {
    let mut along = DMatrix::zeros(5, 3);
    (along[(0, 0)], along[(1, 0)], along[(3, 1)], along[(4, 2)]) = (1.0, 1.0, 1.0, 1.0);
    Freedom::Along(along)
}

fn information(shot: &PhantomShot) -> Matrix6<f64> {
    let covariance = Matrix6::from_fn(|i, j| shot.covariance[i][j]);
    covariance.try_inverse().unwrap_or_else(Matrix6::zeros)
}

/// Of ξ about the origin, from independent standard deviations about `centre`.
fn hardly(centre: DVec3, rad: f64, mm: f64) -> Matrix6<f64> {
    let own = Matrix6::from_diagonal(&nalgebra::Vector6::new(rad, rad, rad, mm, mm, mm).map(|sigma| sigma.powi(-2)));
    let about = crate::estimate::about(centre);
    about.transpose() * own * about
}
