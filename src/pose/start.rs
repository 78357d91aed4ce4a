//! A second opinion on where to start: OpenCV's SQPnP, where the feature `vision` is built in.

use super::solve::Match;
use crate::geometry::{Intrinsics, Rigid};

/// The pose OpenCV's SQPnP (Terzakis & Lourakis 2020) gives for four or more matches; `None` when it gives none.
#[cfg(feature = "vision")]
pub fn opencv(matches: &[Match], intrinsics: &Intrinsics) -> Option<Rigid> {
    use glam::{DQuat, DVec3};
    use opencv::core::{Mat, MatTraitConst, Point2d, Point3d, Vector};

    // OpenCV 4.6 has no skew in its camera; ours is zero but for hand-made K.
    if matches.len() < 4 || intrinsics.skew != 0.0 {
        return None;
    }
    let objects: Vector<Point3d> = matches.iter().map(|m| Point3d::new(m.lps_mm.x, m.lps_mm.y, m.lps_mm.z)).collect();
    let images: Vector<Point2d> = matches.iter().map(|m| Point2d::new(m.image_px.x, m.image_px.y)).collect();
    let k = Mat::from_slice_2d(&intrinsics.to_rows()).ok()?;
    let (mut turn, mut shift) = (Mat::default(), Mat::default());
    let none = Mat::default();
    let solved =
        opencv::calib3d::solve_pnp(&objects, &images, &k, &none, &mut turn, &mut shift, false, opencv::calib3d::SOLVEPNP_SQPNP)
            .ok()?;
    let vector = |m: &Mat| -> Option<DVec3> {
        let at = |n| m.at::<f64>(n).ok().copied();
        Some(DVec3::new(at(0)?, at(1)?, at(2)?)).filter(|v| v.is_finite())
    };
    let pose = Rigid { rotation: DQuat::from_scaled_axis(vector(&turn)?), translation_mm: vector(&shift)? };
    solved.then_some(pose)
}

/// Without the feature `vision` there is no second opinion.
#[cfg(not(feature = "vision"))]
pub fn opencv(_matches: &[Match], _intrinsics: &Intrinsics) -> Option<Rigid> {
    None
}
