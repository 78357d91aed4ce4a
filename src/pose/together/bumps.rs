//! Bodies that moved between two views, against each other or against the room.

use glam::DVec3;
use nalgebra::{DMatrix, Matrix6};

use super::record::{Against, Bump};
use super::setup::{Blocks, Segment, Setup, scale_of};
use crate::estimate::{BlockId, Covariance, Estimate, PoseBlock, about, deviation};
use crate::geometry::Rigid;
use crate::pose::bodies::{FEWEST, LEAST_MOTION, MOVED, names};
use crate::pose::gate::information_about;
use crate::pose::prior::Prior;
use crate::pose::record::Pose;

/// 6×6: ξ about the origin of `a` from ξ about the origin of `b`, for T = a_from_b: exp(ξ̂_a) T = T exp(ξ̂_b).
pub fn adjoint(a_from_b: &Rigid) -> Matrix6<f64> {
    let mut out = Matrix6::zeros();
    for (column, axis) in DVec3::AXES.into_iter().enumerate() {
        let turned = a_from_b.transform_vector(axis);
        let carried = a_from_b.translation_mm.cross(turned);
        for row in 0..3 {
            out[(row, column)] = turned[row];
            out[(row + 3, column)] = carried[row];
            out[(row + 3, column + 3)] = turned[row];
        }
    }
    out
}

/// Every body but the first by itself in every view that shows enough of its beads; without a place, the others' beads count in none.
pub fn each_view(setup: &mut Setup, poses: &[&Pose]) {
    let names = names(setup.layout);
    let [_, others @ ..] = names.as_slice() else { return };
    for body in others {
        let of_body = |n: usize| setup.layout.beads[n].body == *body;
        let count = |view: usize| setup.observations.iter().filter(|o| o.view == view && of_body(o.bead)).count();
        let views: Vec<usize> = (0..poses.len()).filter(|view| count(*view) >= FEWEST).collect();
        for view in views {
            let known = poses[view].bodies.iter().find(|own| own.name == *body);
            let lps_from_body = known.map_or(Rigid::IDENTITY, |own| own.lps_from_body);
            setup.segments.push(Segment { body: body.clone(), views: vec![view], lps_from_body, free: true });
        }
    }
}

/// The motion from one place of a body to another: angle, shift of its beads, χ².
struct Motion {
    angle_deg: f64,
    shift_mm: f64,
    chi2: f64,
}

impl Motion {
    fn new(step: &Rigid, centre_mm: DVec3, xi: nalgebra::Vector6<f64>, covariance: Matrix6<f64>) -> Option<Self> {
        let chi2 = (xi.transpose() * covariance.try_inverse()? * xi)[(0, 0)];
        let angle_deg = step.angle_to_rad(&Rigid::IDENTITY).to_degrees();
        Some(Self { angle_deg, shift_mm: step.transform_point(centre_mm).distance(centre_mm), chi2 })
    }

    fn is_one(&self) -> bool {
        self.chi2 > MOVED && (self.angle_deg > LEAST_MOTION.0 || self.shift_mm > LEAST_MOTION.1)
    }
}

fn centre_of(setup: &Setup, body: &str) -> DVec3 {
    let own: Vec<DVec3> = setup.layout.beads.iter().filter(|bead| bead.body == body).map(|bead| bead.lps_mm).collect();
    own.iter().sum::<DVec3>() / own.len().max(1) as f64
}

/// Joins the views between which a body has not moved, and names those between which it has.
pub fn joined(setup: &Setup, blocks: &Blocks, estimate: &Estimate, covariance: &Covariance) -> (Vec<Segment>, Vec<Bump>) {
    let scale = scale_of(estimate);
    let state = estimate.state();
    let moved_by = |from: Option<PoseBlock>, to: PoseBlock, centre_mm: DVec3| {
        let pose = |block: Option<PoseBlock>| block.map_or(Rigid::IDENTITY, |block| *state.pose(block));
        let step = *state.pose(to) * pose(from).inverse();
        // exp(ξ̂) from = to; each block's own ξ is about its centre, and the earlier one's is carried over by the step.
        let back = |block: PoseBlock| about(-state.motion(block).centre_mm());
        let ids: Vec<BlockId> = from.iter().chain([&to]).map(PoseBlock::id).collect();
        let mut rows = DMatrix::zeros(6, 6 * ids.len());
        if let Some(from) = from {
            rows.view_mut((0, 0), (6, 6)).copy_from(&(-adjoint(&step) * back(from)));
        }
        rows.view_mut((0, 6 * ids.len() - 6), (6, 6)).copy_from(&back(to));
        let joint = &rows * covariance.of(&ids) * rows.transpose();
        let there = about(centre_mm);
        let covariance = there * Matrix6::from_fn(|i, j| scale * joint[(i, j)]) * there.transpose();
        Motion::new(&step, centre_mm, there * deviation(state.pose(to), &pose(from)), covariance)
    };
    let names = names(setup.layout);
    let (mut segments, mut bumps): (Vec<Segment>, Vec<Bump>) = (Vec::new(), Vec::new());
    for body in names.iter().skip(1) {
        let own: Vec<usize> = (0..setup.segments.len()).filter(|n| setup.segments[*n].body == *body).collect();
        let centre_mm = centre_of(setup, body);
        let mut runs: Vec<Vec<usize>> = Vec::new();
        for n in own {
            let first = runs.last().map(|run| run[0]);
            let bump = first.and_then(|first| moved_by(Some(blocks.segments[first]), blocks.segments[n], centre_mm));
            match (runs.last_mut(), bump.filter(Motion::is_one)) {
                (Some(run), None) => run.push(n),
                (_, found) => {
                    bumps.extend(found.map(|Motion { angle_deg, shift_mm, chi2 }| Bump {
                        body: body.clone(),
                        against: Against::Body { name: names[0].clone() },
                        from_view: setup.segments[n].views[0],
                        angle_deg,
                        shift_mm,
                        chi2,
                    }));
                    runs.push(vec![n]);
                }
            }
        }
        for (number, run) in runs.iter().enumerate() {
            // Views that show too few of its beads stand with those before them.
            let start = if number == 0 { 0 } else { setup.segments[run[0]].views[0] };
            let end = runs.get(number + 1).map_or(setup.cameras.len(), |next| setup.segments[next[0]].views[0]);
            let free = run.iter().any(|n| moved_by(None, blocks.segments[*n], centre_mm).is_some_and(|motion| motion.is_one()));
            let lps_from_body = if free { setup.segments[run[0]].lps_from_body } else { Rigid::IDENTITY };
            segments.push(Segment { body: body.clone(), views: (start..end).collect(), lps_from_body, free });
        }
    }
    (segments, bumps)
}

/// The specimen against the room: each view's camera against where its prior puts it, compared with the first view since the last motion.
pub fn against_room(
    setup: &Setup,
    blocks: &Blocks,
    estimate: &Estimate,
    covariance: &Covariance,
    priors: &[Option<Prior>],
) -> Vec<Bump> {
    let (state, scale) = (estimate.state(), scale_of(estimate));
    let body = names(setup.layout).swap_remove(0);
    let centre_mm = centre_of(setup, &body);
    let spread = |view: usize, prior: &Prior| {
        let motion = state.motion(blocks.cameras[view]);
        let back = about(-motion.centre_mm());
        let own = covariance.of(&[blocks.cameras[view].id()]);
        let own = back * Matrix6::from_fn(|i, j| scale * own[(i, j)]) * back.transpose();
        let stated = match prior.covariance {
            Some(rows) => Some(Matrix6::from_fn(|i, j| rows[i][j])),
            None => {
                let (turn, shift) = crate::pose::PRIOR_SIGMA;
                information_about(prior.camera_from_lps.transform_point(centre_mm), turn, shift).try_inverse()
            }
        };
        stated.map(|stated| own + stated)
    };
    let mut bumps = Vec::new();
    let mut first: Option<(usize, &Prior)> = None;
    for (view, prior) in priors.iter().enumerate() {
        let Some(prior) = prior else { continue };
        let Some((before, earlier)) = first else {
            first = Some((view, prior));
            continue;
        };
        // Had nothing moved, the prior would be as far off here as it was there.
        let camera = |view: usize| *state.pose(blocks.cameras[view]);
        let carried = prior.camera_from_lps * earlier.camera_from_lps.inverse();
        let expected = carried * camera(before);
        let (Some(own), Some(other)) = (spread(view, prior), spread(before, earlier)) else { continue };
        let carry = adjoint(&carried);
        let there = about(camera(view).transform_point(centre_mm));
        let covariance = there * (own + carry * other * carry.transpose()) * there.transpose();
        // The specimen's motion in its own axes.
        let step = expected.inverse() * camera(view);
        let motion = Motion::new(&step, centre_mm, there * deviation(&camera(view), &expected), covariance);
        if let Some(Motion { angle_deg, shift_mm, chi2 }) = motion.filter(Motion::is_one) {
            bumps.push(Bump { body: body.clone(), against: Against::Room, from_view: view, angle_deg, shift_mm, chi2 });
            first = Some((view, prior));
        }
    }
    bumps
}
