//! Pose from three beads and three shadows, K known.
//!
//! A C-arm looks through a long lens, so the weak-perspective solution (Huttenlocher & Ullman 1990) is a close start: with ray
//! directions d_i = (x_i, y_i, 1), relative to point 1, squared mean depth Z satisfies
//!     (D₁₂² − Z q₁₂²)(D₁₃² − Z q₁₃²) = (D₁₂·D₁₃ − Z q₁₂·q₁₃)²,
//! a quadratic whose smaller root is the real one, and leaves a mirror twin. Newton's method on the three distances then makes both exact.

use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::geometry::Rigid;

/// About the depths of points in `lps` whose images on the plane z = 1 of `camera` are these: of the pose and of its twin.
pub fn rough_depths(points: &[DVec3; 3], images: &[DVec2; 3]) -> Option<[[f64; 3]; 2]> {
    let (p12, p13) = (points[1] - points[0], points[2] - points[0]);
    let (q12, q13) = (images[1] - images[0], images[2] - images[0]);
    let (a1, a2, a3) = (p12.length_squared(), p13.length_squared(), p12.dot(p13));
    let (b1, b2, b3) = (q12.length_squared(), q13.length_squared(), q12.dot(q13));
    // (b1 b2 − b3²) Z² − (a1 b2 + a2 b1 − 2 a3 b3) Z + (a1 a2 − a3²) = 0
    let (a, b, c) = (b1 * b2 - b3 * b3, a1 * b2 + a2 * b1 - 2.0 * a3 * b3, a1 * a2 - a3 * a3);
    let discriminant = (b * b - 4.0 * a * c).max(0.0);
    let z2 = 2.0 * c / (b + discriminant.sqrt());
    if !(z2 > 0.0 && z2.is_finite()) {
        return None;
    }
    let z = z2.sqrt();
    let h2 = (a1 - z2 * b1).max(0.0).sqrt();
    let h3 = (a2 - z2 * b2).max(0.0).sqrt() * (a3 - z2 * b3).signum();
    // Where the triangle lies flat to the detector the twins coincide and Newton's matrix is singular: keep them apart by a little.
    let least = 0.02 * a1.max(a2).sqrt();
    let (h2, h3) = if h2.abs() + h3.abs() < least { (least, 0.5 * least) } else { (h2, h3) };
    Some([1.0, -1.0].map(|sign| [z, z + sign * h2, z + sign * h3]))
}

/// The depths that are exact, from rough ones.
pub fn depths(points: &[DVec3; 3], images: &[DVec2; 3], start: [f64; 3]) -> Option<[f64; 3]> {
    const PAIRS: [(usize, usize); 3] = [(0, 1), (0, 2), (1, 2)];
    let rays = images.map(|q| DVec3::new(q.x, q.y, 1.0));
    let wanted = PAIRS.map(|(i, j)| points[i].distance_squared(points[j]));
    let mut depths = DVec3::from_array(start);
    for _ in 0..12 {
        let at = [rays[0] * depths.x, rays[1] * depths.y, rays[2] * depths.z];
        let mut rows = [DVec3::ZERO; 3];
        let mut errors = DVec3::ZERO;
        for (n, (i, j)) in PAIRS.into_iter().enumerate() {
            let gap = at[i] - at[j];
            errors[n] = gap.length_squared() - wanted[n];
            rows[n][i] = 2.0 * gap.dot(rays[i]);
            rows[n][j] = -2.0 * gap.dot(rays[j]);
        }
        let jacobian = DMat3::from_cols(rows[0], rows[1], rows[2]).transpose();
        if !(jacobian.determinant().abs() > 1e-12) {
            return None;
        }
        let mut step = jacobian.inverse() * errors;
        let longest = 0.3 * depths.length();
        if step.length() > longest {
            step *= longest / step.length();
        }
        depths -= step;
        if !depths.is_finite() {
            return None;
        }
        if step.length() < 1e-7 * depths.length() {
            break;
        }
    }
    if !(depths.min_element() > 0.0) {
        return None;
    }
    let at = [rays[0] * depths.x, rays[1] * depths.y, rays[2] * depths.z];
    let residual =
        PAIRS.iter().enumerate().map(|(n, (i, j))| (at[*i].distance(at[*j]) - wanted[n].sqrt()).abs()).fold(0.0, f64::max);
    (residual < 0.02 * wanted[0].max(wanted[1]).sqrt()).then(|| depths.to_array())
}

/// `camera_from_lps` under which the points lie at those depths along their rays.
pub fn pose(points: &[DVec3; 3], images: &[DVec2; 3], depths: [f64; 3]) -> Option<Rigid> {
    align(points, &std::array::from_fn(|n| DVec3::new(images[n].x, images[n].y, 1.0) * depths[n]))
}

/// The rigid motion that takes triangle `from` to its copy `to`; `None` where the corners of one lie on a line.
#[must_use]
pub fn align(from: &[DVec3; 3], to: &[DVec3; 3]) -> Option<Rigid> {
    let frame = |p: &[DVec3; 3]| {
        let x = (p[1] - p[0]).normalize();
        let z = x.cross(p[2] - p[0]);
        (z.length() > 1e-6).then(|| DMat3::from_cols(x, z.normalize().cross(x), z.normalize()))
    };
    let rotation = DQuat::from_mat3(&(frame(to)? * frame(from)?.transpose())).normalize();
    let (from_mean, to_mean) = ((from[0] + from[1] + from[2]) / 3.0, (to[0] + to[1] + to[2]) / 3.0);
    Some(Rigid { rotation, translation_mm: to_mean - rotation * from_mean })
}

#[cfg(test)]
mod tests {
    use super::pose as pose_of;
    use super::*;
    use crate::pose::search::ROUGH;
    use crate::random::{Purpose, Stream};

    #[test]
    fn one_of_the_two_is_the_truth() {
        let mut random = Stream::new(4, 0, 0, Purpose::Evaluation);
        let mut right = 0;
        for _ in 0..200 {
            let mut vector = |s: f64| DVec3::new(random.normal(), random.normal(), random.normal()) * s;
            let pose = Rigid::translation(DVec3::new(0.0, 0.0, 700.0) + vector(15.0)) * Rigid::exp(vector(1.0), DVec3::ZERO);
            let points = [vector(40.0), vector(40.0), vector(40.0)];
            let images = points.map(|p| {
                let c = pose.transform_point(p);
                DVec2::new(c.x / c.z, c.y / c.z)
            });
            let close =
                |found: &Rigid| found.angle_to_rad(&pose) < 1e-5 && found.translation_mm.distance(pose.translation_mm) < 1e-2;
            let exact = |start: [f64; 3]| pose_of(&points, &images, depths(&points, &images, start)?);
            right +=
                usize::from(rough_depths(&points, &images).into_iter().flatten().filter_map(exact).any(|found| close(&found)));
        }
        assert!(right >= 190, "{right} of 200");
    }

    /// Triangles in a box of 180 mm at 450 mm from the source, those left out that the search leaves out.
    #[test]
    fn rough_depths_are_within_their_factor() {
        let mut random = Stream::new(5, 0, 0, Purpose::Evaluation);
        let (mut within, mut cases) = (0, 0);
        for _ in 0..4000 {
            let mut corner = || DVec3::from_array([(); 3].map(|()| 180.0 * random.uniform() - 90.0));
            let points = [corner(), corner(), corner()];
            let in_camera = points.map(|p| p + DVec3::new(60.0, -40.0, 450.0));
            let images = in_camera.map(|c| DVec2::new(c.x / c.z, c.y / c.z));
            let longest = [(0, 1), (0, 2), (1, 2)].map(|(i, j)| images[i].distance(images[j])).into_iter().fold(0.0, f64::max);
            if (images[1] - images[0]).perp_dot(images[2] - images[0]).abs() <= 0.03 * longest * longest {
                continue;
            }
            let is_near = |start: [f64; 3]| (0..3).all(|n| (start[n] / in_camera[n].z).ln().abs() < ROUGH.ln());
            within += usize::from(rough_depths(&points, &images).into_iter().flatten().any(is_near));
            cases += 1;
        }
        assert!(cases > 3000 && within as f64 > 0.985 * f64::from(cases), "{within} of {cases}");
    }
}
