//! The problem of several views: a camera each, K, bead places with their priors, and where each body is from which view on.

use glam::{DVec2, DVec3};
use nalgebra::Matrix3;

use crate::beads::BeadLayout;
use crate::estimate::{
    BeadImage, Covariance, Estimate, EstimateError, Freedom, Loss, Place, PoseBlock, Problem, Reading, Settings, VectorBlock,
};
use crate::geometry::{Intrinsics, Rigid};
use crate::pose::solve::{Free, square_pixels};

/// A shadow of a bead.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Observation {
    pub view: usize,
    /// Index in the layout.
    pub bead: usize,
    pub image_px: DVec2,
    pub sigma_px: f64,
    /// Covariance of `image_px`: uu, uv, vv.
    pub noise_px2: [f64; 3],
}

/// A body's place, from some view to another.
#[derive(Clone, Debug, PartialEq)]
pub struct Segment {
    pub body: String,
    pub views: Vec<usize>,
    pub lps_from_body: Rigid,
    /// Solved; else the body has not moved, and the segment stands for the identity.
    pub free: bool,
}

/// What is solved, and from where.
#[derive(Clone, Debug)]
pub struct Setup<'a> {
    pub layout: &'a BeadLayout,
    pub cameras: Vec<Rigid>,
    pub intrinsics: Vec<Intrinsics>,
    pub free: Free,
    pub observations: Vec<Observation>,
    pub segments: Vec<Segment>,
    /// Beads whose place in the layout counts for nothing.
    pub freed: Vec<bool>,
    pub places_mm: Vec<DVec3>,
}

/// Where everything stands in the problem.
pub struct Blocks {
    pub cameras: Vec<PoseBlock>,
    /// One for all views where K is solved.
    pub intrinsics: Vec<VectorBlock>,
    pub segments: Vec<PoseBlock>,
    pub beads: Vec<Option<VectorBlock>>,
    /// Residual of each bead's prior.
    pub priors: Vec<Option<usize>>,
    /// Residual of each observation.
    pub images: Vec<usize>,
}

impl Blocks {
    pub fn intrinsics_of(&self, view: usize) -> VectorBlock {
        self.intrinsics[view.min(self.intrinsics.len() - 1)]
    }
}

impl<'a> Setup<'a> {
    pub fn segment_of(&self, view: usize, bead: usize) -> Option<usize> {
        let body = &self.layout.beads[bead].body;
        self.segments.iter().position(|segment| segment.body == *body && segment.views.contains(&view))
    }

    pub fn seen_in(&self, bead: usize) -> impl Iterator<Item = &Observation> {
        self.observations.iter().filter(move |o| o.bead == bead)
    }

    pub fn problem(&self) -> (Problem<'a>, Blocks) {
        let mut problem = Problem::new();
        let centre = |bodies: &dyn Fn(&str) -> bool| {
            let own: Vec<DVec3> = self.layout.beads.iter().filter(|b| bodies(&b.body)).map(|b| b.lps_mm).collect();
            own.iter().sum::<DVec3>() / own.len().max(1) as f64
        };
        let pivot_mm = centre(&|_| true);
        let cameras: Vec<PoseBlock> =
            self.cameras.iter().map(|camera| problem.pose("camera_from_lps", *camera, pivot_mm, true)).collect();
        let one = if self.free == Free::Pose { &self.intrinsics[..] } else { &self.intrinsics[..1] };
        let intrinsics: Vec<VectorBlock> = one
            .iter()
            .map(|k| {
                let freedom = if self.free == Free::Pose { Freedom::Constant } else { square_pixels(k) };
                problem.vector("intrinsics", &[k.fx, k.fy, k.skew, k.cx, k.cy], freedom)
            })
            .collect();
        let segments: Vec<PoseBlock> = self
            .segments
            .iter()
            .map(|segment| {
                let pivot_mm = centre(&|body| body == segment.body);
                problem.pose("lps_from_body", segment.lps_from_body, pivot_mm, segment.free)
            })
            .collect();
        let seen = |bead: usize| self.seen_in(bead).next().is_some();
        let beads: Vec<Option<VectorBlock>> = self
            .places_mm
            .iter()
            .enumerate()
            .map(|(n, place)| seen(n).then(|| problem.eliminated("bead", &place.to_array())))
            .collect();
        let mut blocks = Blocks { cameras, intrinsics, segments, priors: vec![None; beads.len()], beads, images: Vec::new() };
        for o in &self.observations {
            let Some(bead) = blocks.beads[o.bead] else { continue };
            let (camera, k) = (blocks.cameras[o.view], blocks.intrinsics_of(o.view));
            let mut image = BeadImage::new(camera, k, Place::Solved(bead), o.image_px, o.noise_px2);
            if let Some(segment) = self.segment_of(o.view, o.bead) {
                image = image.on_body(blocks.segments[segment]);
            }
            blocks.images.push(problem.add(image, Loss::None));
        }
        for (n, bead) in self.layout.beads.iter().enumerate() {
            let Some(block) = blocks.beads[n].filter(|_| !self.freed[n]) else { continue };
            let prior = Reading::of_place(block, bead.lps_mm, &bead.place_mm2());
            blocks.priors[n] = Some(problem.add(prior, Loss::None));
        }
        if let Free::Known(prior) = self.free {
            problem.add(prior.reading(blocks.intrinsics[0]), Loss::None);
        }
        (problem, blocks)
    }

    /// Takes over where a solution ended.
    pub fn take(&mut self, estimate: &Estimate, blocks: &Blocks) {
        let state = estimate.state();
        for (own, block) in self.cameras.iter_mut().zip(&blocks.cameras) {
            *own = *state.pose(*block);
        }
        for (own, block) in self.segments.iter_mut().zip(&blocks.segments) {
            own.lps_from_body = *state.pose(*block);
        }
        for (own, block) in self.places_mm.iter_mut().zip(&blocks.beads) {
            if let Some(block) = block {
                *own = state.point(*block);
            }
        }
        for (view, own) in self.intrinsics.iter_mut().enumerate() {
            if let &[fx, fy, skew, cx, cy, ..] = state.vector(blocks.intrinsics_of(view)) {
                *own = Intrinsics { fx, fy, skew, cx, cy };
            }
        }
    }
}

/// Solves, with the covariance of all.
pub fn solved<'p>(problem: &'p Problem) -> Result<(Estimate<'p>, Covariance), EstimateError> {
    let estimate = problem.solve(&Settings { iterations: 60, ..Settings::default() })?;
    let covariance = estimate.covariance()?;
    Ok((estimate, covariance))
}

/// χ² over its degrees of freedom, one at least: what covariances are scaled by.
pub fn scale_of(estimate: &Estimate) -> f64 {
    (estimate.chi2_sum() / estimate.degrees_of_freedom().max(1) as f64).max(1.0)
}

/// The covariance of a bead's place.
pub fn place_covariance(covariance: &Covariance, block: VectorBlock) -> Matrix3<f64> {
    let of = covariance.of(&[block.id()]);
    Matrix3::from_fn(|i, j| of[(i, j)])
}
