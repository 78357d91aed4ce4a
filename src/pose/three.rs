//! A body of which no more than three beads are seen.
//!
//! Three shadows are six numbers, and so is a pose: some pose fits any three exactly, mostly two or four do. What tells is where the body
//! is expected: with the specimen, but for [`PRIOR_SIGMA`]. That counts as a measurement beside the shadows, in the place and in its
//! covariance, and what it leaves open is refused: another triple of shadows, a mirror twin, or an accident that is too likely.

use std::f64::consts::PI;
use std::ops::RangeInclusive;

use glam::{DVec2, DVec3};
use nalgebra::{Matrix2, Matrix2x6, Matrix6, Vector6};

use super::case::{Case, PRIOR_SIGMA};
use super::gate::information_about;
use super::judge::MOST_SIGMA;
use super::record::{Covariance, Pose};
use super::request::Registration;
use super::search::apart;
use super::settle::Settled;
use super::solve::{Free, Match, Measured, Options, Solution, image_by_point, image_spread, point_by_pose, solve};
use super::triangle::{Images, depths, pose as pose_of, rough_depths};
use super::verdict::MOST_CHANCE;
use crate::beads::{Bead, Detection};
use crate::geometry::{Intrinsics, Rigid};

/// Of more beads three that are seen are not told apart.
const MOST_BEADS: usize = 8;
/// Squared deviation of shadows and expectation together (six degrees of freedom) of what is believed: one in a thousand is farther off.
const MOST_OFF: f64 = 22.5;
/// The same by the linear rule, which errs by half of the turn times the shift, and how far a shadow may be from it: variances, px².
const ROUGHLY_OFF: f64 = 2.0 * MOST_OFF;
const SLACK_PX2: [f64; 3] = [4.0, 0.0, 4.0];
/// Triples that are tried by that rule, and solved.
const MOST_TRIED: usize = 300_000;
const MOST_SOLVED: usize = 24;
/// Another reading must be farther off by so much.
const CLEAR: f64 = 12.0;
/// One of so many beads has no shadow of its own, and that of something else may stand in for it.
const MISSED: f64 = 20.0;
/// Radii of shadows over those of the beads.
const BEAD_SIZED: RangeInclusive<f64> = 0.7..=1.4;
/// Readings as close as this are one: rad, mm.
const ONE_READING: (f64, f64) = (0.005, 0.5);

/// Where the other beads have the specimen.
#[derive(Clone, Copy)]
pub(super) struct Expected {
    pub camera_from_lps: Rigid,
    pub covariance: Covariance,
    pub intrinsics: Intrinsics,
    /// On which the frame's shadows lie, those of other bodies among them.
    pub area_px2: f64,
}

/// A body that has a place.
pub(super) struct Placed {
    pub pose: Pose,
    /// Squared distance of its shadows from where they would be had it not moved, in standard deviations of shadows, beads and camera: six
    /// degrees of freedom. `None` for a body that its own beads place.
    pub off: Option<f64>,
}

/// Three beads, and the shadows that may be theirs.
struct Triple {
    beads: [usize; 3],
    shadows: [usize; 3],
    /// By the linear rule.
    off: f64,
}

/// A triple that is solved.
struct Reading {
    matches: Vec<Match>,
    solution: Solution,
    off: f64,
}

/// A body's beads among the shadows that are no other's.
struct Body<'s, 'c> {
    case: &'s Case<'c>,
    expected: &'s Expected,
    /// What the expectation says, and how far it lets the body move.
    measured: Measured,
    covariance: Matrix6<f64>,
}

/// The place of the body whose beads are the layout's, or in words why it has none.
pub(super) fn place(request: &Registration, detections: &[Detection], expected: &Expected) -> Result<Placed, String> {
    let count = request.layout.beads.len();
    if !(3..=MOST_BEADS).contains(&count) {
        return Err(format!("fewer than four of its {count} beads are seen, and a place by three takes 3 to {MOST_BEADS} beads"));
    }
    let case = Case::new(request, detections, None).map_err(|refusal| refusal.to_string())?;
    let centre = expected.camera_from_lps.transform_point(request.layout.centroid_lps_mm());
    let information = information_about(centre, PRIOR_SIGMA.0, PRIOR_SIGMA.1);
    let measured = Measured { camera_from_lps: expected.camera_from_lps, information };
    let covariance = information.try_inverse().ok_or("where it is expected is not known")?;
    Body { case: &case, expected, measured, covariance }.place()
}

impl Body<'_, '_> {
    fn place(&self) -> Result<Placed, String> {
        let request = self.case.request;
        let triples = self.triples()?;
        if triples.len() > MOST_SOLVED {
            return Err(format!("{} triples of shadows may be three of its beads", triples.len()));
        }
        let mut readings: Vec<Reading> = triples.iter().flat_map(|triple| self.readings(triple)).collect();
        readings.sort_by(|a, b| a.off.total_cmp(&b.off));
        let [best, others @ ..] = readings.as_slice() else {
            return Err("no three shadows lie as three of its beads may".to_owned());
        };
        if !(best.off <= MOST_OFF) {
            let (off, limit) = (best.off.sqrt(), MOST_OFF.sqrt());
            return Err(format!("its shadows are {off:.1} standard deviations from where it may be (limit {limit:.1})"));
        }
        if let Some(other) = others.iter().find(|other| other.off < best.off + CLEAR && self.is_another(best, other)) {
            let centre = request.layout.centroid_lps_mm();
            let (angle_rad, shift_mm) = apart(&best.solution.camera_from_lps, &other.solution.camera_from_lps, centre);
            return Err(format!(
                "three shadows let it be in two places, {:.1}° and {shift_mm:.1} mm apart",
                angle_rad.to_degrees()
            ));
        }
        let is_matched = |bead: usize| best.matches.iter().any(|m| m.bead == bead);
        let is_in_frame = |lps_mm: DVec3| best.solution.place(lps_mm).1.is_some_and(|at| !request.is_outside(at));
        let is_missing = |(n, bead): &(usize, &Bead)| !is_matched(*n) && is_in_frame(bead.lps_mm);
        if let Some((_, bead)) = request.layout.beads.iter().enumerate().find(is_missing) {
            return Err(format!("{} should be seen beside the three that would be its beads", bead.name));
        }
        let chance = self.accidents(best.off);
        if !(chance <= MOST_CHANCE) {
            return Err(format!(
                "{chance:.2} places by accident are expected of {} shadows (limit {MOST_CHANCE})",
                self.case.detections.len()
            ));
        }
        let chi2_per_dof = best.off / 6.0;
        let covariance = &best.solution.covariance * chi2_per_dof.max(1.0);
        let sigma = |n: usize| covariance[(n, n)].sqrt();
        let (turn_deg, across_mm, along_mm) =
            (sigma(0).max(sigma(1)).max(sigma(2)).to_degrees(), sigma(3).max(sigma(4)), sigma(5));
        if !(turn_deg <= MOST_SIGMA[0] && across_mm <= MOST_SIGMA[1] && along_mm <= MOST_SIGMA[2]) {
            return Err(format!(
                "three shadows leave its place uncertain by {turn_deg:.1}°, {across_mm:.1} mm across and {along_mm:.1} mm along the beam"
            ));
        }
        let off = self.off_unmoved(&best.matches).ok_or("where it would be had it not moved is not known")?;
        let settled = Settled {
            solution: best.solution.clone(),
            matches: best.matches.clone(),
            left_out: Vec::new(),
            merged: Vec::new(),
            chi2_per_dof,
            options: self.options(),
        };
        Ok(Placed { pose: self.case.accept(&settled, &covariance, &[], chance, Vec::new()), off: Some(off) })
    }

    fn options(&self) -> Options {
        Options { measured: Some(self.measured), ..Options::least_squares(Free::Pose) }
    }

    fn in_camera(&self, bead: usize) -> DVec3 {
        self.expected.camera_from_lps.transform_point(self.case.request.layout.beads[bead].lps_mm)
    }

    /// What a bead's own uncertainty, and its shadow's, spread its image by.
    fn noise(&self, bead: usize, noise_px2: [f64; 3]) -> Matrix2<f64> {
        let Expected { camera_from_lps, intrinsics, .. } = self.expected;
        let own = &self.case.request.layout.beads[bead];
        image_spread(intrinsics, camera_from_lps, own.lps_mm, &own.place_mm2(), noise_px2)
    }

    /// Covariance of the images of three beads about where they are expected, by that of the pose.
    fn spread(&self, beads: [usize; 3], pose: &Matrix6<f64>, noises_px2: [[f64; 3]; 3]) -> Matrix6<f64> {
        let mut rows = Matrix6::zeros();
        for (n, bead) in beads.into_iter().enumerate() {
            let p = self.in_camera(bead);
            let by_pose: Matrix2x6<f64> = image_by_point(&self.expected.intrinsics, p) * point_by_pose(p, DVec3::ZERO);
            rows.fixed_view_mut::<2, 6>(2 * n, 0).copy_from(&by_pose);
        }
        let mut spread = rows * pose * rows.transpose();
        for (n, bead) in beads.into_iter().enumerate() {
            let noise = self.noise(bead, noises_px2[n]);
            for (i, j) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
                spread[(2 * n + i, 2 * n + j)] += noise[(i, j)];
            }
        }
        spread
    }

    fn offset(&self, bead: usize, shadow: usize) -> DVec2 {
        self.case.detections[shadow].image_px - self.expected.intrinsics.project(self.in_camera(bead))
    }

    /// Squared distance of three shadows from where their beads are expected, by the inverse of their spread.
    fn squares(&self, beads: [usize; 3], shadows: [usize; 3], inverse: &Matrix6<f64>) -> f64 {
        let [a, b, c] = [0, 1, 2].map(|n| self.offset(beads[n], shadows[n]));
        let off = Vector6::new(a.x, a.y, b.x, b.y, c.x, c.y);
        off.dot(&(inverse * off))
    }

    /// How far the shadows are from where they would be had the body not moved.
    fn off_unmoved(&self, matches: &[Match]) -> Option<f64> {
        let [a, b, c] = matches else { return None };
        let camera = Matrix6::from_fn(|i, j| self.expected.covariance[i][j]);
        let beads = [a.bead, b.bead, c.bead];
        let inverse = self.spread(beads, &camera, [a.noise_px2, b.noise_px2, c.noise_px2]).try_inverse()?;
        Some(self.squares(beads, [a.detection, b.detection, c.detection], &inverse)).filter(|off| off.is_finite())
    }

    /// Shadows that may be a bead's: of its size, and no farther off than the body may have moved.
    fn may_be(&self, bead: usize) -> Vec<usize> {
        let (request, p) = (self.case.request, self.in_camera(bead));
        let by_pose: Matrix2x6<f64> = image_by_point(&self.expected.intrinsics, p) * point_by_pose(p, DVec3::ZERO);
        let spread = by_pose * self.covariance * by_pose.transpose() + self.noise(bead, SLACK_PX2);
        let Some(inverse) = spread.try_inverse().filter(|_| p.z > 1.0) else { return Vec::new() };
        let radius_px = request.layout.radius_mm(bead, request.bead_radius_mm).map(|mm| mm * self.expected.intrinsics.fx / p.z);
        // Of those that a person has put together either both are meant or none.
        let is_meant = |n: usize| self.case.pinned.iter().all(|(own, shadow)| (*own == bead) == (*shadow == n));
        let is_near = |n: usize| {
            let off = self.offset(bead, n);
            let off = nalgebra::Vector2::new(off.x, off.y);
            off.dot(&(inverse * off)) <= ROUGHLY_OFF
        };
        let is_sized = |n: usize| {
            let shadow = &self.case.detections[n];
            radius_px.is_none_or(|px| {
                let off_ln = (shadow.radius_px / px).ln();
                let end = if off_ln < 0.0 { *BEAD_SIZED.start() } else { *BEAD_SIZED.end() };
                off_ln.abs() <= shadow.radius_slack_ln(end.ln())
            })
        };
        let shadows = 0..self.case.detections.len();
        shadows.filter(|n| !self.case.barred.contains(n) && is_meant(*n) && is_sized(*n) && is_near(*n)).collect()
    }

    /// Any three of the beads.
    fn choices(&self) -> Vec<[usize; 3]> {
        let count = self.case.request.layout.beads.len();
        (0..count).flat_map(|a| (a + 1..count).flat_map(move |b| (b + 1..count).map(move |c| [a, b, c]))).collect()
    }

    /// Triples of shadows that may be three of the beads, the likeliest first.
    fn triples(&self) -> Result<Vec<Triple>, String> {
        let may_be: Vec<Vec<usize>> = (0..self.case.request.layout.beads.len()).map(|bead| self.may_be(bead)).collect();
        let choices = self.choices();
        let tried: usize = choices.iter().map(|beads| beads.iter().map(|bead| may_be[*bead].len()).product::<usize>()).sum();
        if tried > MOST_TRIED {
            return Err(format!("{tried} triples of shadows lie where three of its beads may"));
        }
        let mut triples = Vec::new();
        for beads in choices {
            let spread = self.spread(beads, &self.covariance, [SLACK_PX2; 3]);
            let Some(inverse) = spread.try_inverse() else { continue };
            let [first, second, third] = beads.map(|bead| &may_be[bead]);
            for a in first {
                for b in second.iter().filter(|b| *b != a) {
                    for c in third.iter().filter(|c| *c != a && *c != b) {
                        let shadows = [*a, *b, *c];
                        let off = self.squares(beads, shadows, &inverse);
                        if off <= ROUGHLY_OFF {
                            triples.push(Triple { beads, shadows, off });
                        }
                    }
                }
            }
        }
        triples.sort_by(|a, b| a.off.total_cmp(&b.off));
        Ok(triples)
    }

    /// Where a triple puts the body: from where it is expected, and from the pose and its twin that fit the shadows exactly.
    fn readings(&self, triple: &Triple) -> Vec<Reading> {
        let k = &self.expected.intrinsics;
        let matches: Vec<Match> = (0..3)
            .map(|n| {
                let (bead, detection) = (triple.beads[n], triple.shadows[n]);
                let (own, shadow) = (&self.case.request.layout.beads[bead], &self.case.detections[detection]);
                Match::new(bead, (own.lps_mm, own.place_mm2()), detection, shadow, shadow.image_px)
            })
            .collect();
        let points: [DVec3; 3] = std::array::from_fn(|n| matches[n].lps_mm);
        let squares_mm2 = [(0, 1), (0, 2), (1, 2)].map(|(i, j): (usize, usize)| points[i].distance_squared(points[j]));
        let images = Images::new(std::array::from_fn(|n| k.unproject(matches[n].image_px).truncate()));
        let exact = |start: [f64; 3]| {
            let depths = depths(squares_mm2, &images, start, |_| true)?;
            pose_of(&points, &images, depths)
        };
        let exactly = rough_depths(squares_mm2, &images).map(|rough| rough.depths_mm.map(exact)).unwrap_or_default();
        let starts = [Some(self.expected.camera_from_lps)].into_iter().chain(exactly).flatten();
        let reading = |start: Rigid| {
            let solution = solve(&matches, &start, k, &self.options())?;
            let off = solution.chi2.iter().sum::<f64>() + solution.prior_chi2;
            Some(Reading { matches: matches.clone(), solution, off }).filter(|reading| reading.off.is_finite())
        };
        starts.filter_map(reading).collect()
    }

    fn is_another(&self, best: &Reading, other: &Reading) -> bool {
        let pairs = |reading: &Reading| reading.matches.iter().map(|m| (m.bead, m.detection)).collect::<Vec<_>>();
        let centre = self.case.request.layout.centroid_lps_mm();
        let (angle_rad, shift_mm) = apart(&best.solution.camera_from_lps, &other.solution.camera_from_lps, centre);
        pairs(best) != pairs(other) || !(angle_rad <= ONE_READING.0 && shift_mm <= ONE_READING.1)
    }

    /// Places as likely as one that is `off`, squared, that are expected where nothing is the body's: three shadows at random within an
    /// ellipsoid of six dimensions, π³/6 off³ √det S, and one that stands in for a bead's own that is missed, within an ellipse.
    fn accidents(&self, off: f64) -> f64 {
        let (shadows, off) = (self.case.detections.len() as f64, off.max(6.0));
        let per_px2 = shadows / self.expected.area_px2.max(1.0);
        let others_per_px2 = (shadows - 3.0).max(0.0) / self.expected.area_px2.max(1.0);
        let of = |beads: [usize; 3]| {
            let spread = self.spread(beads, &self.covariance, [SLACK_PX2; 3]);
            let Some(inverse) = spread.try_inverse() else { return f64::INFINITY };
            let all = PI.powi(3) / 6.0 * off.powi(3) * spread.determinant().max(0.0).sqrt() * per_px2.powi(3);
            // The block of the inverse is the inverse of what one image is spread by where the two others are known.
            let ellipse = |n: usize| PI * off / inverse.fixed_view::<2, 2>(2 * n, 2 * n).into_owned().determinant().sqrt();
            all + (0..3).map(ellipse).sum::<f64>() * others_per_px2 / MISSED
        };
        self.choices().into_iter().map(of).sum()
    }
}
