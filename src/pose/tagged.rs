//! The pose that tags give: a start for the beads, and a pose of its own where beads are too few.
//!
//! Four corners of a known square give two poses, which differ by the square's tilt about the line of sight; corners of several tags give
//! one. Tags that agree are found from pairs of them, so that one that is misread or has been moved does not spoil the others.

use glam::{DMat3, DVec3};
use nalgebra::{DMatrix, Matrix3, Matrix6, SVector};

use super::prior::Prior;
use super::record::Covariance;
use super::refusal::Refusal;
use super::solve::{Free, Match, Options, Solution, about, solve};
use super::verdict::mirrored;
use crate::beads::tags::{SeenTag, Tag, TagLayout};
use crate::geometry::{Intrinsics, Rigid};

/// Standard deviation of a corner per axis.
pub(super) const CORNER_SIGMA_PX: f64 = 0.2;
/// Squared residual in standard deviations, per corner, up to which a tag agrees with the others: what blur and threshold do to all four
/// corners alike is not in their standard deviation.
const AGREES: f64 = 20.0;
/// A twin that fits no worse than this many units of χ² is not told apart.
pub(super) const TOLD_APART: f64 = 12.0;
/// Tags, largest first, from whose pairs a pose is sought.
const MOST_STARTS: usize = 8;
/// The covariance of a start is that of the corners, times this: their errors are partly alike.
const START_SHARE: f64 = 4.0;

/// A listed tag and what the frame shows of it.
#[derive(Clone, Copy, Debug)]
pub(super) struct View<'a> {
    pub tag: &'a Tag,
    pub seen: &'a SeenTag,
}

/// Listed tags that are seen once; a tag that is seen twice is none.
pub(super) fn views<'a>(layout: &'a TagLayout, seen: &'a [SeenTag]) -> Vec<View<'a>> {
    let own = |tag: &'a Tag| {
        let mut here = seen.iter().filter(|seen| seen.family == layout.family && seen.id == tag.id);
        let first = here.next()?;
        here.next().is_none().then_some(View { tag, seen: first })
    };
    layout.tags.iter().filter_map(own).collect()
}

/// The pose of the tags that agree.
#[derive(Clone, Debug)]
pub(super) struct TagPose {
    pub solution: Solution,
    pub matches: Vec<Match>,
    /// Of the views: whether it agrees.
    pub agrees: Vec<bool>,
    pub chi2_per_dof: f64,
    /// The other solution of a plane, and by how much of χ² it fits worse.
    pub twin: Option<(Rigid, f64)>,
}

impl TagPose {
    /// About the tags' centroid, scaled by what the corners show of their noise.
    pub fn covariance(&self) -> DMatrix<f64> {
        &self.solution.covariance * self.chi2_per_dof.max(1.0)
    }

    /// Whether the twin is out of the question.
    pub fn is_told_apart(&self) -> bool {
        self.twin.is_none_or(|(_, worse)| worse >= TOLD_APART * self.chi2_per_dof.max(1.0))
    }

    /// Where the beads are sought: one start, or both solutions of a plane.
    pub fn starts(&self) -> Vec<Prior> {
        let mut starts = vec![self.start(self.solution.camera_from_lps)];
        if let Some((twin, _)) = self.twin.filter(|_| !self.is_told_apart()) {
            starts.push(self.start(twin));
        }
        starts
    }

    fn start(&self, camera_from_lps: Rigid) -> Prior {
        let own = self.covariance();
        let back = about(-self.solution.centroid_mm);
        let spread = back * Matrix6::from_fn(|i, j| START_SHARE * own[(i, j)]) * back.transpose();
        let rows: Covariance = std::array::from_fn(|i| std::array::from_fn(|j| 0.5 * (spread[(i, j)] + spread[(j, i)])));
        Prior { camera_from_lps, covariance: Some(rows) }
    }
}

/// The corners of a view as matches; they belong to no bead and no shadow.
pub(super) fn corners(view: &View) -> impl Iterator<Item = Match> {
    let place_mm2 = DMat3::from_diagonal(DVec3::splat(view.tag.sigma_mm.powi(2)));
    let variance = CORNER_SIGMA_PX.powi(2);
    view.tag.corners_lps_mm().into_iter().zip(view.seen.corners_px).map(move |(lps_mm, image_px)| Match {
        bead: usize::MAX,
        detection: usize::MAX,
        lps_mm,
        image_px,
        sigma_px: CORNER_SIGMA_PX,
        noise_px2: [variance, 0.0, variance],
        place_mm2,
    })
}

/// The pose on which most tags agree.
pub(super) fn estimate(views: &[View], k: &Intrinsics) -> Result<TagPose, Refusal> {
    let ids = |views: &[View]| views.iter().map(|view| view.tag.id).collect::<Vec<u32>>();
    let mut order: Vec<usize> = (0..views.len()).collect();
    order.sort_by(|a, b| views[*b].seen.side_px().total_cmp(&views[*a].seen.side_px()));
    order.truncate(MOST_STARTS);
    let mut best: Option<(Vec<bool>, f64, Solution)> = None;
    for (n, first) in order.iter().enumerate() {
        let starts = planar(&views[*first], k);
        // Alone only where nobody is beside it: two that agree say more than one.
        let pairs = order[n + 1..].iter().map(|second| vec![*first, *second]).chain([vec![*first]]);
        for members in pairs {
            for start in &starts {
                let Some((agrees, cost, solution)) = consensus(views, &members, start, k) else { continue };
                let count = |agrees: &[bool]| agrees.iter().filter(|agrees| **agrees).count();
                let better =
                    best.as_ref().is_none_or(|(other, other_cost, _)| (count(&agrees), -cost) > (count(other), -other_cost));
                if better {
                    best = Some((agrees, cost, solution));
                }
            }
        }
    }
    let (agrees, _, solution) = best.ok_or_else(|| Refusal::TagsDisagree { tags: ids(views), agreeing: 0 })?;
    let matches = corners_of(views, &agrees);
    let fit: f64 = solution.chi2.iter().sum();
    let chi2_per_dof = fit / (2 * matches.len() - 6) as f64;
    let twin = mirrored(&matches, &solution.camera_from_lps, k).map(|(pose, other)| (pose, other - fit));
    Ok(TagPose { solution, matches, agrees, chi2_per_dof, twin })
}

fn corners_of(views: &[View], members: &[bool]) -> Vec<Match> {
    views.iter().zip(members).filter(|(_, member)| **member).flat_map(|(view, _)| corners(view)).collect()
}

/// From `members` to all tags that agree with them, solved again until nobody comes or goes.
fn consensus(views: &[View], members: &[usize], start: &Rigid, k: &Intrinsics) -> Option<(Vec<bool>, f64, Solution)> {
    let options = Options::least_squares(Free::Pose);
    let mut agrees: Vec<bool> = (0..views.len()).map(|n| members.contains(&n)).collect();
    let mut solution = solve(&corners_of(views, &agrees), start, k, &options)?;
    for _ in 0..4 {
        let next: Vec<bool> = views.iter().map(|view| misfit(view, &solution, k) <= AGREES).collect();
        // A tag that does not agree with itself is misread.
        if !members.iter().all(|n| next[*n]) {
            return None;
        }
        if next == agrees {
            break;
        }
        agrees = next;
        solution = solve(&corners_of(views, &agrees), &solution.camera_from_lps, k, &options)?;
    }
    let kept = views.iter().zip(&agrees).all(|(view, agrees)| !agrees || misfit(view, &solution, k) <= AGREES);
    let cost = solution.chi2.iter().sum();
    kept.then_some((agrees, cost, solution))
}

/// Mean squared residual of a tag's corners, in standard deviations of corners and pose.
fn misfit(view: &View, solution: &Solution, k: &Intrinsics) -> f64 {
    let squared = corners(view).map(|corner| off_by(&corner, solution, &solution.covariance, k).unwrap_or(f64::INFINITY));
    squared.sum::<f64>() / 4.0
}

/// Squared distance of a corner from where a pose puts it, in standard deviations of both; `None` behind the source.
pub(super) fn off_by(corner: &Match, solution: &Solution, covariance: &DMatrix<f64>, k: &Intrinsics) -> Option<f64> {
    let p = solution.camera_from_lps.transform_point(corner.lps_mm);
    if !(p.z > 1.0) {
        return None;
    }
    let image = super::solve::image_by_point(k, p);
    let by_pose = image * super::solve::point_by_pose(p, solution.centroid_mm);
    let pose = Matrix6::from_fn(|i, j| covariance[(i, j)]);
    let spread = super::solve::image_spread(k, &solution.camera_from_lps, corner.lps_mm, &corner.place_mm2, corner.noise_px2)
        + by_pose * pose * by_pose.transpose();
    let off = corner.image_px - k.project(p);
    let off = nalgebra::Vector2::new(off.x, off.y);
    Some((off.transpose() * spread.try_inverse()? * off)[(0, 0)]).filter(|squared| squared.is_finite())
}

/// The poses of one tag: from the homography of its corners, and that mirrored about the line of sight.
pub(super) fn planar(view: &View, k: &Intrinsics) -> Vec<Rigid> {
    let Some(start) = from_homography(view, k) else { return Vec::new() };
    let matches: Vec<Match> = corners(view).collect();
    let Some(first) = solve(&matches, &start, k, &Options::least_squares(Free::Pose)) else { return Vec::new() };
    let twin = mirrored(&matches, &first.camera_from_lps, k).map(|(pose, _)| pose);
    std::iter::once(first.camera_from_lps).chain(twin).collect()
}

// Corners (x, y) of the tag, in mm, and rays (a, b, 1) = K⁻¹ (u, v, 1) obey (a, b, 1) ∝ G (x, y, 1) with G = [r₁ r₂ t]: eight equations for
// the entries of G but for its scale, G₃₃ = 1 (the tag's centre is in front of the source, so t_z ≠ 0). Then |r₁| and |r₂| are both 1 at
// the true scale; their geometric mean is taken, and [r₁ r₂ r₁×r₂] is made orthonormal.
fn from_homography(view: &View, k: &Intrinsics) -> Option<Rigid> {
    let half = 0.5 * view.tag.size_mm;
    let mut rows = nalgebra::SMatrix::<f64, 8, 8>::zeros();
    let mut right = SVector::<f64, 8>::zeros();
    for (n, ([x, y], at)) in crate::beads::tags::CORNERS.into_iter().zip(view.seen.corners_px).enumerate() {
        let (x, y, ray) = (x * half, y * half, k.unproject(at));
        for (row, from, value) in [(2 * n, 0, ray.x), (2 * n + 1, 3, ray.y)] {
            rows[(row, from)] = x;
            rows[(row, from + 1)] = y;
            rows[(row, from + 2)] = 1.0;
            rows[(row, 6)] = -value * x;
            rows[(row, 7)] = -value * y;
            right[row] = value;
        }
    }
    let g = rows.lu().solve(&right)?;
    let (r1, r2, t) = (DVec3::new(g[0], g[3], g[6]), DVec3::new(g[1], g[4], g[7]), DVec3::new(g[2], g[5], 1.0));
    let depth_mm = 1.0 / (r1.length() * r2.length()).sqrt();
    if !(depth_mm > 0.0 && depth_mm.is_finite()) {
        return None;
    }
    let (r1, r2) = (r1 * depth_mm, r2 * depth_mm);
    let r3 = r1.cross(r2);
    let near = Matrix3::new(r1.x, r2.x, r3.x, r1.y, r2.y, r3.y, r1.z, r2.z, r3.z).svd(true, true);
    let turn = near.u? * near.v_t?;
    let column = |n: usize| DVec3::new(turn[(0, n)], turn[(1, n)], turn[(2, n)]);
    let turn = glam::DMat3::from_cols(column(0), column(1), column(2));
    if !(turn.determinant() > 0.0) {
        return None;
    }
    let camera_from_tag = Rigid { rotation: glam::DQuat::from_mat3(&turn).normalize(), translation_mm: t * depth_mm };
    Some(camera_from_tag * view.tag.lps_from_tag.inverse())
}
