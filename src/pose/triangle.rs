//! Pose from three beads and three shadows, K known.
//!
//! A C-arm looks through a long lens, so the weak-perspective solution (Huttenlocher & Ullman 1990) is a close start: with ray
//! directions d_i = (x_i, y_i, 1) about the axis, relative to point 1, squared mean depth Z satisfies
//!     (D₁₂² − Z q₁₂²)(D₁₃² − Z q₁₃²) = (D₁₂·D₁₃ − Z q₁₂·q₁₃)²,
//! a quadratic whose smaller root is the real one, and leaves a mirror twin. Newton's method on the three distances then makes both exact.

use glam::{DMat3, DQuat, DVec2, DVec3};

use crate::geometry::Rigid;

/// Three images, as the equations want them.
#[derive(Clone, Copy)]
pub struct Images {
    /// On the plane z = 1.
    at: [DVec2; 3],
    /// ‖q₁₂‖², ‖q₁₃‖², q₁₂·q₁₃ of the images that a camera would have whose axis looks at them, on its plane z = 1: there the lens is as good
    /// as long. Off axis it is not, however small the triangle.
    edges: [f64; 3],
    /// Depth in the frame's camera over that in the turned one.
    straight: [f64; 3],
    /// Squared lengths of the rays (x, y, 1), and the products of 1 and 2, 1 and 3, 2 and 3.
    squares: [f64; 3],
    products: [f64; 3],
}

impl Images {
    /// Of places on the plane z = 1.
    pub fn new(at: [DVec2; 3]) -> Self {
        let product = |i: usize, j: usize| at[i].dot(at[j]) + 1.0;
        let turn = DQuat::from_rotation_arc(((at[0] + at[1] + at[2]) / 3.0).extend(1.0).normalize(), DVec3::Z);
        let rays = at.map(|q| turn * q.extend(1.0));
        let turned = rays.map(|ray| ray.truncate() / ray.z);
        let (q12, q13) = (turned[1] - turned[0], turned[2] - turned[0]);
        Self {
            at,
            straight: rays.map(|ray| 1.0 / ray.z),
            edges: [q12.length_squared(), q13.length_squared(), q12.dot(q13)],
            squares: [product(0, 0), product(1, 1), product(2, 2)],
            products: [product(0, 1), product(0, 2), product(1, 2)],
        }
    }

    /// Squared distances on the plane: of 1 and 2, 1 and 3, 2 and 3.
    pub fn squares_apart(&self) -> [f64; 3] {
        [(0, 1), (0, 2), (1, 2)].map(|(i, j)| self.at[i].distance_squared(self.at[j]))
    }

    /// Twice the area of their triangle.
    pub fn twice_area(&self) -> f64 {
        (self.at[1] - self.at[0]).perp_dot(self.at[2] - self.at[0]).abs()
    }

    /// Distance from the place of `one` at a depth of 1 mm to the ray of `other`.
    pub fn off_ray(&self, one: usize, other: usize) -> f64 {
        self.ray(one).cross(self.ray(other)).length() / self.ray(other).length()
    }

    #[inline(always)]
    fn ray(&self, n: usize) -> DVec3 {
        DVec3::new(self.at[n].x, self.at[n].y, 1.0)
    }

    /// Squared distances at these depths, less those that are.
    #[inline(always)]
    fn errors(&self, squares_mm2: [f64; 3], [x, y, z]: [f64; 3]) -> [f64; 3] {
        let ([n1, n2, n3], [c12, c13, c23]) = (self.squares, self.products);
        [
            x * x * n1 + y * y * n2 - 2.0 * x * y * c12 - squares_mm2[0],
            x * x * n1 + z * z * n3 - 2.0 * x * z * c13 - squares_mm2[1],
            y * y * n2 + z * z * n3 - 2.0 * y * z * c23 - squares_mm2[2],
        ]
    }
}

/// Depths of three points, and how good they are.
pub struct Rough {
    /// Of the pose and of its twin.
    pub depths_mm: [[f64; 3]; 2],
    /// Longest side over depth.
    pub spread: f64,
    /// Squared mean depth.
    mean_mm2: f64,
}

impl Rough {
    /// About the depths of three points with these images, of sense where they are [real](Self::is_real). `squares_mm2` between the points:
    /// 1 and 2, 1 and 3, 2 and 3.
    #[inline(always)]
    pub fn new(squares_mm2: [f64; 3], images: &Images) -> Self {
        let [b1, b2, b3] = images.edges;
        let [a1, a2, _] = squares_mm2;
        let a3 = 0.5 * (a1 + a2 - squares_mm2[2]);
        // (b1 b2 − b3²) Z² − (a1 b2 + a2 b1 − 2 a3 b3) Z + (a1 a2 − a3²) = 0
        let (a, b, c) = (b1 * b2 - b3 * b3, a1 * b2 + a2 * b1 - 2.0 * a3 * b3, a1 * a2 - a3 * a3);
        let discriminant = (b * b - 4.0 * a * c).max(0.0);
        let z2 = 2.0 * c / (b + discriminant.sqrt());
        let z = z2.sqrt();
        let h2 = (a1 - z2 * b1).max(0.0).sqrt();
        let h3 = (a2 - z2 * b2).max(0.0).sqrt() * (a3 - z2 * b3).signum();
        // Where the triangle lies flat to the detector the twins coincide and Newton's matrix is singular: keep them apart by a little.
        let least = 0.02 * a1.max(a2).sqrt();
        let (h2, h3) = if h2.abs() + h3.abs() < least { (least, 0.5 * least) } else { (h2, h3) };
        let [s1, s2, s3] = images.straight;
        let depths_mm = [[z * s1, (z + h2) * s2, (z + h3) * s3], [z * s1, (z - h2) * s2, (z - h3) * s3]];
        Self { depths_mm, spread: a1.max(a2).max(squares_mm2[2]).sqrt() / z, mean_mm2: z2 }
    }

    /// Whether there are such depths.
    #[inline(always)]
    pub fn is_real(&self) -> bool {
        self.mean_mm2 > 0.0 && self.mean_mm2.is_finite()
    }

    /// The factor within which all but one in a hundred are, by the spread: the lens is as long as the depth is in sides of the triangle.
    #[inline(always)]
    pub fn factor(spread: f64) -> f64 {
        1.0 + spread * (1.2 + 0.7 * spread)
    }

    /// The same after one of Newton's steps.
    #[inline(always)]
    pub fn stepped_factor(spread: f64) -> f64 {
        1.0 + spread * (0.2 + 2.0 * spread)
    }
}

/// About the depths of three points with these images; `None` where there are none.
pub fn rough_depths(squares_mm2: [f64; 3], images: &Images) -> Option<Rough> {
    Some(Rough::new(squares_mm2, images)).filter(Rough::is_real)
}

/// One of Newton's steps.
///
/// Squared distance of points i and j at depths z on their rays: zᵢ² ‖dᵢ‖² + zⱼ² ‖dⱼ‖² − 2 zᵢ zⱼ dᵢ·dⱼ. Each knows two depths, and the three
/// equations of a step are solved by hand.
pub struct Step {
    /// What the depths lose, times the determinant.
    by: [f64; 3],
    determinant: f64,
    inverse: f64,
    /// Squared lengths of the step and of the depths.
    step2: f64,
    length2: f64,
}

impl Step {
    #[inline(always)]
    pub fn new(squares_mm2: [f64; 3], images: &Images, depths: [f64; 3]) -> Self {
        let ([n1, n2, n3], [c12, c13, c23]) = (images.squares, images.products);
        let [x, y, z] = depths;
        let [e1, e2, e3] = images.errors(squares_mm2, depths);
        let (e1, e2, e3) = (0.5 * e1, 0.5 * e2, 0.5 * e3);
        // Rows (p, q, 0), (r, 0, s), (0, t, u).
        let (p, q) = (x * n1 - y * c12, y * n2 - x * c12);
        let (r, s) = (x * n1 - z * c13, z * n3 - x * c13);
        let (t, u) = (y * n2 - z * c23, z * n3 - y * c23);
        let determinant = -(p * s * t + q * r * u);
        let by =
            [-(e1 * s * t + q * (e2 * u - s * e3)), p * (e2 * u - s * e3) - e1 * r * u, e1 * r * t - p * e2 * t - q * r * e3];
        let inverse = 1.0 / determinant;
        let step2 = (by[0] * by[0] + by[1] * by[1] + by[2] * by[2]) * inverse * inverse;
        Self { by, determinant, inverse, step2, length2: x * x + y * y + z * z }
    }

    #[inline(always)]
    pub fn is_defined(&self) -> bool {
        self.determinant.abs() > 1e-12
    }

    /// Whether it is taken a third of the depths long only; rare.
    #[inline(always)]
    pub fn is_too_long(&self) -> bool {
        self.step2 > 0.09 * self.length2
    }

    /// Whether the next step, about the square of this one, would be none.
    #[inline(always)]
    pub fn is_last(&self) -> bool {
        self.step2 < 1e-10 * self.length2
    }

    /// Where it leads from `depths` if it is not too long.
    #[inline(always)]
    pub fn whole(&self, depths: [f64; 3]) -> [f64; 3] {
        self.times(self.inverse, depths)
    }

    /// Where it leads from `depths`.
    pub fn taken(&self, depths: [f64; 3]) -> [f64; 3] {
        if self.is_too_long() {
            self.times(self.inverse * (0.09 * self.length2 / self.step2).sqrt(), depths)
        } else {
            self.whole(depths)
        }
    }

    #[inline(always)]
    fn times(&self, factor: f64, [x, y, z]: [f64; 3]) -> [f64; 3] {
        [x - factor * self.by[0], y - factor * self.by[1], z - factor * self.by[2]]
    }
}

/// Whether all depths are numbers.
#[inline(always)]
pub fn are_finite([x, y, z]: [f64; 3]) -> bool {
    x.is_finite() & y.is_finite() & z.is_finite()
}

/// No distance is off by more than this share of the longer of the first two sides.
pub const MOST_OFF: f64 = 0.02;

/// Whether points at these depths, in front of the camera, have these distances.
#[inline(always)]
pub fn agree(squares_mm2: [f64; 3], images: &Images, depths: [f64; 3]) -> bool {
    let [e1, e2, e3] = images.errors(squares_mm2, depths);
    let [a1, a2, a3] = squares_mm2;
    // As differences of lengths.
    let (off1, off2, off3) = (off(a1, e1), off(a2, e2), off(a3, e3));
    let most = 0.0f64.max(off1).max(off2).max(off3);
    (depths[0] > 0.0) & (depths[1] > 0.0) & (depths[2] > 0.0) & (most < MOST_OFF * a1.max(a2).sqrt())
}

#[inline(always)]
fn off(square_mm2: f64, error_mm2: f64) -> f64 {
    ((square_mm2 + error_mm2).max(0.0).sqrt() - square_mm2.sqrt()).abs()
}

/// Most of Newton's steps.
pub const MOST_STEPS: usize = 12;

/// The depths that are exact, from rough ones; `None` as well where they do not count, by `counts`, after the first step.
pub fn depths(squares_mm2: [f64; 3], images: &Images, start: [f64; 3], counts: impl Fn(&[f64; 3]) -> bool) -> Option<[f64; 3]> {
    let mut depths = start;
    for steps in 0..MOST_STEPS {
        let step = Step::new(squares_mm2, images, depths);
        if !step.is_defined() {
            return None;
        }
        depths = step.taken(depths);
        if !are_finite(depths) || (steps == 0 && !counts(&depths)) {
            return None;
        }
        if step.is_last() {
            break;
        }
    }
    agree(squares_mm2, images, depths).then_some(depths)
}

/// `camera_from_lps` under which the points lie at those depths along their rays.
pub fn pose(points: &[DVec3; 3], images: &Images, depths: [f64; 3]) -> Option<Rigid> {
    align(points, &std::array::from_fn(|n| images.ray(n) * depths[n]))
}

/// Turn and shift of [`pose`], in fewer operations and as good as the depths are.
#[inline(always)]
pub fn turn_and_shift(points: &[DVec3; 3], images: &Images, depths: [f64; 3]) -> (DMat3, DVec3) {
    let in_camera = [images.ray(0) * depths[0], images.ray(1) * depths[1], images.ray(2) * depths[2]];
    let DMat3 { x_axis: u, y_axis: v, z_axis: w } = sides(points);
    let inverse = DMat3::from_cols(v.cross(w), w.cross(u), w).transpose() * w.length_squared().recip();
    let turn = sides(&in_camera) * inverse;
    (turn, in_camera[0] - turn * points[0])
}

/// Two sides of a triangle and what is square to both.
#[inline(always)]
fn sides(p: &[DVec3; 3]) -> DMat3 {
    let (u, v) = (p[1] - p[0], p[2] - p[0]);
    DMat3::from_cols(u, v, u.cross(v))
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
    use crate::random::{Purpose, Stream};

    fn squares(points: &[DVec3; 3]) -> [f64; 3] {
        [(0, 1), (0, 2), (1, 2)].map(|(i, j)| points[i].distance_squared(points[j]))
    }

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
            let (squares, images) = (squares(&points), Images::new(images));
            let exact = |start: [f64; 3]| {
                let depths = depths(squares, &images, start, |_| true)?;
                let (turn, shift_mm) = turn_and_shift(&points, &images, depths);
                let pose = pose_of(&points, &images, depths)?;
                let off = |p: &DVec3| (turn * *p + shift_mm).distance(pose.transform_point(*p));
                assert!(points.iter().chain([&DVec3::ONE]).map(off).fold(0.0, f64::max) < 1e-4);
                Some(pose)
            };
            right += usize::from(
                rough_depths(squares, &images)
                    .is_some_and(|rough| rough.depths_mm.into_iter().filter_map(exact).any(|found| close(&found))),
            );
        }
        assert!(right >= 190, "{right} of 200");
    }

    /// Triangles in large and near boxes, ordinary and small ones, on the axis and far from it, those left out that the search leaves out.
    #[test]
    fn rough_depths_are_within_their_factor() {
        let mut random = Stream::new(5, 0, 0, Purpose::Evaluation);
        for (side_mm, depth_mm, off_axis) in
            [(180.0, 450.0, 0.16), (110.0, 650.0, 0.0), (110.0, 650.0, 0.25), (50.0, 700.0, 0.25), (25.0, 800.0, 0.25)]
        {
            let (mut within, mut cases) = (0, 0);
            for _ in 0..4000 {
                let mut corner = || DVec3::from_array([(); 3].map(|()| side_mm * (random.uniform() - 0.5)));
                let points = [corner(), corner(), corner()];
                let in_camera = points.map(|p| p + DVec3::new(0.8 * off_axis, -0.6 * off_axis, 1.0) * depth_mm);
                let images = Images::new(in_camera.map(|c| DVec2::new(c.x / c.z, c.y / c.z)));
                if images.twice_area() <= 0.03 * images.squares_apart().into_iter().fold(0.0, f64::max) {
                    continue;
                }
                let is_near =
                    |depths: &[f64; 3], factor: f64| (0..3).all(|n| (depths[n] / in_camera[n].z).ln().abs() < factor.ln());
                let Some(rough) = rough_depths(squares(&points), &images) else { continue };
                let is_found = |start: &[f64; 3]| {
                    let counts = |depths: &[f64; 3]| is_near(depths, Rough::stepped_factor(rough.spread));
                    let exact = || depths(squares(&points), &images, *start, counts);
                    is_near(start, Rough::factor(rough.spread)) && exact().is_some_and(|depths| is_near(&depths, 1.0 + 1e-6))
                };
                let solvable = |start: &[f64; 3]| {
                    depths(squares(&points), &images, *start, |_| true).is_some_and(|depths| is_near(&depths, 1.0 + 1e-6))
                };
                cases += i32::from(rough.depths_mm.iter().any(solvable));
                within += i32::from(rough.depths_mm.iter().any(is_found));
            }
            assert!(
                cases > 3000 && f64::from(within) > 0.97 * f64::from(cases),
                "{within} of {cases}: {side_mm} {depth_mm} {off_axis}"
            );
        }
    }
}
