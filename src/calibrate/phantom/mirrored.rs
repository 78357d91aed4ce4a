//! The cloud mirrored in depth.
//!
//! Through a long lens depth shows only by how beads move from shot to shot, and the cloud turned inside out, turning the other way, moves
//! nearly alike: with q = R p, D = diag(1, 1, −1) and p′ = D p, R′ = D R D gives q′ = D q, the same picture but for perspective. Rough
//! cameras speak against it, yet a layout that rests on the sign of a joint alone is not to be believed: perspective must tell.

use glam::{DMat3, DQuat, DVec3};
use nalgebra::Matrix3;

use super::adjust::{Adjustment, Rough};
use super::shot::PhantomShot;
use super::structure::Structure;
use crate::estimate::Settings;
use crate::geometry::Rigid;

/// How far cameras may go from the mirrored start, rad and mm.
const FREE: (f64, f64) = (0.3, 100.0);

/// The best solution near the mirror image.
#[derive(Clone, Copy, Debug)]
pub(super) struct MirrorImage {
    /// Σ of squares of the shadows, in standard deviations.
    pub chi2: f64,
    /// The same of the cloud as found, its cameras as free.
    pub found_chi2: f64,
    /// How far its beads are from those found, after the best motion and scale, √mean of squares.
    pub apart_mm: f64,
}

/// Turns the cloud inside out and solves from there.
pub(super) fn mirror_image(shots: &[PhantomShot], structure: &Structure) -> Option<MirrorImage> {
    let (_, first) = structure.shots().next()?;
    let first = *first;
    let in_first: Vec<DVec3> = structure.points.iter().map(|point| first.transform_point(*point)).collect();
    let centre = in_first.iter().sum::<DVec3>() / in_first.len().max(1) as f64;
    let inside_out = |p: DVec3| DVec3::new(p.x, p.y, 2.0 * centre.z - p.z);
    let first_from_world = first;
    let world_from_first = first.inverse();
    let mut mirrored = structure.clone();
    for (point, p) in mirrored.points.iter_mut().zip(&in_first) {
        *point = world_from_first.transform_point(inside_out(*p));
    }
    let flip = DMat3::from_diagonal(DVec3::new(1.0, 1.0, -1.0));
    for camera in mirrored.cameras.iter_mut().flatten() {
        let camera_from_first = *camera * world_from_first;
        let rotation = DQuat::from_mat3(&(flip * DMat3::from_quat(camera_from_first.rotation) * flip)).normalize();
        let translation_mm = camera_from_first.transform_point(centre) - rotation * centre;
        *camera = Rigid { rotation, translation_mm } * first_from_world;
    }
    let (found_chi2, _) = solved(shots, structure)?;
    let (chi2, points) = solved(shots, &mirrored)?;
    Some(MirrorImage { chi2, found_chi2, apart_mm: apart_mm(&structure.points, &points) })
}

/// Σ of squares of the shadows and the beads, the cameras hardly held.
fn solved(shots: &[PhantomShot], structure: &Structure) -> Option<(f64, Vec<DVec3>)> {
    let adjustment = Adjustment { rough: Rough::Hardly(FREE.0, FREE.1), ..Adjustment::plain(shots, structure) };
    let (problem, blocks) = adjustment.problem();
    let estimate = problem.solve(&Settings { iterations: 80, step_sigmas: 1e-4 }).ok()?;
    let chi2 = blocks.images.iter().map(|(.., n)| estimate.chi2(*n)).sum();
    Some((chi2, blocks.taken(structure, &estimate).points))
}

/// √mean squared distance after the best motion and scale (Umeyama 1991), without mirroring.
fn apart_mm(a: &[DVec3], b: &[DVec3]) -> f64 {
    let n = a.len().max(1) as f64;
    let centred = |points: &[DVec3]| -> Vec<nalgebra::Vector3<f64>> {
        let centre = points.iter().sum::<DVec3>() / n;
        points.iter().map(|p| nalgebra::Vector3::from((*p - centre).to_array())).collect()
    };
    let (a, b) = (centred(a), centred(b));
    let cross: Matrix3<f64> = a.iter().zip(&b).map(|(a, b)| a * b.transpose()).sum();
    let svd = cross.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else { return f64::INFINITY };
    let sign = (u * v_t).determinant().signum();
    let mut order = [0, 1, 2];
    order.sort_by(|i, j| svd.singular_values[*j].total_cmp(&svd.singular_values[*i]));
    let mut signs = nalgebra::Vector3::repeat(1.0);
    signs[order[2]] = sign;
    let rotation = u * Matrix3::from_diagonal(&signs) * v_t;
    let of_b: f64 = b.iter().map(nalgebra::Vector3::norm_squared).sum();
    let scale = svd.singular_values.dot(&signs) / of_b.max(f64::MIN_POSITIVE);
    let squares: f64 = a.iter().zip(&b).map(|(a, b)| (a - rotation * b * scale).norm_squared()).sum();
    (squares / n).sqrt()
}
