//! Where the drill's tip is against where readings and offsets put it.

use glam::{DMat3, DVec2, DVec3};
use nalgebra::{Matrix3, SMatrix, Vector3};

use super::chain::{OWN, State, shape};
use super::shot::Shot;
use super::solve::Fitted;
use crate::geometry::RobotModel;

/// Step of a bend for its effect on the tip, degrees.
const STEP_DEG: f64 = 1e-4;
/// Readings that differ by less are those of one shape, degrees.
const SAME_DEG: f64 = 0.1;
/// Beams at least this far apart tell a discrepancy in space.
const APART_DEG: f64 = 20.0;
/// What poses and the base add to the difference of two shots.
const POSE_MM: f64 = 0.1;
/// Shots whose discrepancies contradict each other by more are not of one load: χ² over its degrees of freedom.
const MOST_CHI2: f64 = 9.0;

/// The discrepancy of one shot: seen minus predicted from readings and offsets.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tip {
    /// Along columns and rows at the tip's depth.
    pub off_mm: [f64; 2],
    /// Standard deviations.
    pub sigma_mm: [f64; 2],
    /// Length.
    pub length_mm: f64,
    /// Standard deviation along it.
    pub length_sigma_mm: f64,
}

/// The discrepancy of shots of one shape, in space.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SharedTip {
    /// Their names.
    pub shots: Vec<String>,
    /// Along x, y, z of the base.
    pub off_in_base_mm: [f64; 3],
    /// Standard deviations.
    pub sigma_mm: [f64; 3],
    /// Length.
    pub length_mm: f64,
}

/// What a shot sees of a displacement.
pub(super) struct Seen {
    pub tip: Tip,
    covariance_mm2: SMatrix<f64, 2, 2>,
    /// Its two image axes, for displacements in `base`.
    from_base: [DVec3; 2],
    beam_in_base: DVec3,
}

pub(super) fn tip_px(model: &RobotModel, shot: &Shot, state: &State, own_deg: &[f64; OWN]) -> Option<(DVec2, f64)> {
    let shape = shape(model, shot, &state.offsets_deg, own_deg)?;
    shot.image(shot.lps_from_carrier.transform_point(state.carrier_from_base.transform_point(shape.base_from_tip.translation_mm)))
}

/// The discrepancy of the `n`th shot; its covariance is `scale` times that of the fit.
pub(super) fn tip(model: &RobotModel, shot: &Shot, state: &State, n: usize, fitted: &Fitted, scale: f64) -> Option<Seen> {
    let own = state.own_deg[n];
    let (predicted, depth_mm) = tip_px(model, shot, state, &[0.0; OWN])?;
    let mm_per_px = depth_mm / shot.view.intrinsics.fx;
    let off = (tip_px(model, shot, state, &own)?.0 - predicted) * mm_per_px;
    let mut by_own = SMatrix::<f64, 2, OWN>::zeros();
    for k in 0..OWN {
        let at = |by: f64| {
            let mut near = own;
            near[k] += by;
            tip_px(model, shot, state, &near).map(|(px, _)| px)
        };
        let slope = (at(STEP_DEG)? - at(-STEP_DEG)?) * (mm_per_px / (2.0 * STEP_DEG));
        (by_own[(0, k)], by_own[(1, k)]) = (slope.x, slope.y);
    }
    let own_covariance = SMatrix::<f64, OWN, OWN>::from_fn(|i, j| fitted.joint[(6 + i, 6 + j)]);
    let covariance_mm2 = by_own * own_covariance * by_own.transpose() * scale;
    let along = if off.length() > 0.0 { off.normalize() } else { DVec2::X };
    let variance = |a: DVec2, b: DVec2| {
        a.x * (covariance_mm2[(0, 0)] * b.x + covariance_mm2[(0, 1)] * b.y)
            + a.y * (covariance_mm2[(1, 0)] * b.x + covariance_mm2[(1, 1)] * b.y)
    };
    // A displacement d moves the image by (d.x − x/z d.z, d.y − y/z d.z) in mm at the tip's depth.
    let ray = shot.view.intrinsics.unproject(predicted);
    let camera_from_base = shot.view.camera_from_lps * shot.lps_from_carrier * state.carrier_from_base;
    let to_base = camera_from_base.rotation.conjugate();
    let from_base = [DVec3::new(1.0, 0.0, -ray.x), DVec3::new(0.0, 1.0, -ray.y)].map(|row| to_base * row);
    let tip = Tip {
        off_mm: off.to_array(),
        sigma_mm: [variance(DVec2::X, DVec2::X).sqrt(), variance(DVec2::Y, DVec2::Y).sqrt()],
        length_mm: off.length(),
        length_sigma_mm: variance(along, along).sqrt(),
    };
    Some(Seen { tip, covariance_mm2, from_base, beam_in_base: (to_base * ray).normalize() })
}

/// Discrepancies in space of shots with the same readings that look from two sides and agree.
pub(super) fn shared(shots: &[&Shot], seen: &[Option<Seen>]) -> Vec<SharedTip> {
    let mut taken = vec![false; shots.len()];
    let mut found = Vec::new();
    for first in 0..shots.len() {
        if taken[first] {
            continue;
        }
        let alike = |k: &usize| {
            let pairs = shots[*k].readings_deg.iter().zip(&shots[first].readings_deg);
            pairs.into_iter().all(|(a, b)| (a - b).abs() < SAME_DEG)
        };
        let group: Vec<usize> = (first..shots.len()).filter(|k| !taken[*k] && alike(k)).collect();
        group.iter().for_each(|k| taken[*k] = true);
        found.extend(together(shots, seen, &group));
    }
    found
}

fn together(shots: &[&Shot], seen: &[Option<Seen>], group: &[usize]) -> Option<SharedTip> {
    let members: Vec<(usize, &Seen)> = group.iter().filter_map(|k| Some((*k, seen[*k].as_ref()?))).collect();
    let beams: Vec<DVec3> = members.iter().map(|(_, seen)| seen.beam_in_base).collect();
    if spread_deg(&beams) < APART_DEG {
        return None;
    }
    let (mut normal, mut right, mut squares) = (Matrix3::zeros(), Vector3::zeros(), 0.0);
    for (_, seen) in &members {
        let rows = SMatrix::<f64, 2, 3>::from_fn(|i, j| seen.from_base[i][j]);
        let weight = (seen.covariance_mm2 + SMatrix::<f64, 2, 2>::identity() * POSE_MM.powi(2)).try_inverse()?;
        let off = SMatrix::<f64, 2, 1>::from(seen.tip.off_mm);
        normal += rows.transpose() * weight * rows;
        right += rows.transpose() * weight * off;
        squares += (off.transpose() * weight * off)[(0, 0)];
    }
    let covariance = normal.try_inverse()?;
    let off = covariance * right;
    let chi2 = squares - off.dot(&right);
    let degrees_of_freedom = (2 * members.len()).saturating_sub(3).max(1) as f64;
    if !(chi2 / degrees_of_freedom <= MOST_CHI2) {
        return None;
    }
    Some(SharedTip {
        shots: members.iter().map(|(k, _)| shots[*k].name.clone()).collect(),
        off_in_base_mm: off.into(),
        sigma_mm: std::array::from_fn(|axis| covariance[(axis, axis)].sqrt()),
        length_mm: off.norm(),
    })
}

/// Largest angle between two of some lines.
pub(super) fn spread_deg(lines: &[DVec3]) -> f64 {
    let mut most = 0.0f64;
    for (n, a) in lines.iter().enumerate() {
        for b in &lines[..n] {
            most = most.max(a.cross(*b).length().atan2(a.dot(*b).abs()).to_degrees());
        }
    }
    most
}

/// Turns of a covariance's axes: its largest standard deviation in any direction.
pub(super) fn worst_sigma(covariance: DMat3) -> f64 {
    let matrix = Matrix3::from_fn(|i, j| covariance.col(j)[i]);
    matrix.symmetric_eigen().eigenvalues.max().max(0.0).sqrt()
}
