//! P by the normalised direct linear transform, for six or more matches that are not coplanar (Hartley & Zisserman 2004, §7.1).

use glam::{DVec2, DVec3};
use nalgebra::{DMatrix, Matrix3, Matrix3x4, Matrix4};

use super::solve::Match;
use crate::geometry::{Intrinsics, Projection, Rigid};

/// K and pose of the P that fits best algebraically; `None` when there are fewer than six matches or P is no camera.
pub fn direct(matches: &[Match]) -> Option<(Intrinsics, Rigid)> {
    if matches.len() < 6 {
        return None;
    }
    let count = matches.len() as f64;
    let mean2 = matches.iter().map(|m| m.image_px).sum::<DVec2>() / count;
    let mean3 = matches.iter().map(|m| m.lps_mm).sum::<DVec3>() / count;
    // Mean distance √2 and √3 from the origin.
    let s2 = std::f64::consts::SQRT_2 * count / matches.iter().map(|m| m.image_px.distance(mean2)).sum::<f64>();
    let s3 = 3.0f64.sqrt() * count / matches.iter().map(|m| m.lps_mm.distance(mean3)).sum::<f64>();
    let mut rows = DMatrix::zeros(2 * matches.len(), 12);
    for (n, m) in matches.iter().enumerate() {
        let (x, p) = ((m.image_px - mean2) * s2, (m.lps_mm - mean3) * s3);
        for (i, value) in [p.x, p.y, p.z, 1.0].into_iter().enumerate() {
            rows[(2 * n, i)] = value;
            rows[(2 * n, 8 + i)] = -x.x * value;
            rows[(2 * n + 1, 4 + i)] = value;
            rows[(2 * n + 1, 8 + i)] = -x.y * value;
        }
    }
    // The right singular vector of the smallest singular value: the eigenvector of AᵀA, whose numbers are of order one.
    let eigen = (rows.transpose() * &rows).symmetric_eigen();
    let smallest = eigen.eigenvalues.iter().enumerate().min_by(|a, b| a.1.total_cmp(b.1))?.0;
    let vector = eigen.eigenvectors.column(smallest);
    let normalised = Matrix3x4::from_fn(|i, j| vector[4 * i + j]);
    let image_from_normal = Matrix3::new(1.0 / s2, 0.0, mean2.x, 0.0, 1.0 / s2, mean2.y, 0.0, 0.0, 1.0);
    let normal_from_lps =
        Matrix4::new(s3, 0.0, 0.0, -s3 * mean3.x, 0.0, s3, 0.0, -s3 * mean3.y, 0.0, 0.0, s3, -s3 * mean3.z, 0.0, 0.0, 0.0, 1.0);
    let p = image_from_normal * normalised * normal_from_lps;
    let projection = Projection(std::array::from_fn(|i| std::array::from_fn(|j| p[(i, j)])));
    let (intrinsics, pose) = projection.decompose().ok()?;
    (pose.transform_point(mean3).z > 0.0).then_some((intrinsics, pose))
}
