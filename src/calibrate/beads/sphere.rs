//! What a scanner makes of a metal ball: the ball, blurred by a point spread that is a Gaussian, averaged over each voxel.

use glam::{DMat3, DVec3};

/// Share of a ball's contrast that is seen at a point, and its derivatives.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Share {
    /// 1 deep inside a large ball, 0 far away.
    pub value: f64,
    /// By the distance from the centre, per mm.
    pub by_distance: f64,
    /// By the radius, per mm.
    pub by_radius: f64,
    /// By the point spread's σ, per mm.
    pub by_blur: f64,
}

/// The share at `distance_mm` from the centre of a ball blurred by a Gaussian of σ = `blur_mm`.
///
/// The ball convolved with the Gaussian G depends on the distance d alone. With g∓ = G(d ∓ r) of one dimension,
///   f = ½[erf((d+r)/√2σ) − erf((d−r)/√2σ)] − σ²/d (g₋ − g₊),
///   ∂f/∂d = σ²/d² (g₋ − g₊) − r/d (g₋ + g₊),   ∂f/∂r = r/d (g₋ − g₊),
///   ∂f/∂σ = r/(dσ) [(d−r) g₋ + (d+r) g₊] − σ/d (g₋ − g₊).
pub(super) fn share(distance_mm: f64, radius_mm: f64, blur_mm: f64) -> Share {
    // Both terms grow as 1/d where their difference does not; the share is flat there.
    let d = distance_mm.max(0.02 * blur_mm);
    let (near, far) = ((d - radius_mm) / blur_mm, (d + radius_mm) / blur_mm);
    let (near_exp, far_exp) = ((-0.5 * near * near).exp(), (-0.5 * far * far).exp());
    let scale = 1.0 / ((std::f64::consts::TAU).sqrt() * blur_mm);
    let (minus, plus) = (near_exp * scale, far_exp * scale);
    let (difference, sum) = (minus - plus, minus + plus);
    let slope = blur_mm * blur_mm / d;
    Share {
        value: 0.5 * (error_function(far, far_exp) - error_function(near, near_exp)) - slope * difference,
        by_distance: slope / d * difference - radius_mm / d * sum,
        by_radius: radius_mm / d * difference,
        by_blur: radius_mm / (d * blur_mm) * ((d - radius_mm) * minus + (d + radius_mm) * plus) - blur_mm / d * difference,
    }
}

/// erf(x/√2), given exp(−x²/2): Abramowitz and Stegun 7.1.26, within 1.5e-7.
pub(super) fn error_function(x: f64, exp: f64) -> f64 {
    let z = x.abs() * std::f64::consts::FRAC_1_SQRT_2;
    let t = 1.0 / (1.0 + 0.327_591_1 * z);
    let sum = t * (0.254_829_592 + t * (-0.284_496_736 + t * (1.421_413_741 + t * (-1.453_152_027 + t * 1.061_405_429))));
    (1.0 - sum * exp).copysign(x)
}

/// How a slice averages along its normal: a box convolved with a Gaussian, both in slice spacings. A file does not say; reconstructions
/// overlap, leave gaps, and have profiles from nearly a box (axial) to nearly a Gaussian (helical).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct SliceProfile {
    /// The box's width.
    pub width: f64,
    /// The Gaussian's σ.
    pub sigma: f64,
    /// σ of the Gaussian by which a box is sharper along the slices' normal than the point spread is in their plane, mm: a kernel that
    /// smooths does so in the plane alone.
    pub sharper_mm: f64,
}

impl SliceProfile {
    /// Each slice is as thick as the slices are apart.
    pub const BOX: Self = Self::smooth(1.0, 0.0);

    /// Blurred along the normal as in the plane, or more.
    pub const fn smooth(width: f64, sigma: f64) -> Self {
        Self { width, sigma, sharper_mm: 0.0 }
    }

    /// A box that is blurred less along the normal than in the plane.
    pub const fn sharp(width: f64, sharper_mm: f64) -> Self {
        Self { width, sigma: 0.0, sharper_mm }
    }

    /// Standard deviation without the point spread, in slice spacings.
    pub fn deviation(self) -> f64 {
        (self.width * self.width / 12.0 + self.sigma * self.sigma).sqrt()
    }

    /// Nodes in slice spacings, and weights that add up to 1; `spacing_mm` says how many are needed.
    fn nodes(self, spacing_mm: f64) -> Vec<(f64, f64)> {
        if self.sigma == 0.0 {
            let nodes = gauss_legendre(node_count(self.width * spacing_mm));
            let inside = nodes.into_iter().map(|(x, weight)| (0.5 * self.width * x, 0.5 * weight));
            return inside.chain(self.steeper_ends(spacing_mm)).collect();
        }
        // Evenly spaced nodes integrate what is as smooth as a blurred ball: the step is below its σ.
        let half = 0.5 * self.width + 3.0 * self.sigma;
        let count = ((half * spacing_mm / NODE_MM).ceil() as i32).max(3);
        let phi = |x: f64| error_function(x, (-0.5 * x * x).exp());
        let density = |x: f64| match self.width > 0.0 {
            true => phi((x + 0.5 * self.width) / self.sigma) - phi((x - 0.5 * self.width) / self.sigma),
            false => (-0.5 * (x / self.sigma).powi(2)).exp(),
        };
        let nodes: Vec<(f64, f64)> =
            (-count..=count).map(|n| half * f64::from(n) / f64::from(count)).map(|x| (x, density(x))).collect();
        let sum: f64 = nodes.iter().map(|(_, weight)| weight).sum();
        nodes.into_iter().map(|(x, weight)| (x, weight / sum)).collect()
    }

    /// Nodes beside a box's own that take a Gaussian of σ = s out of what it averages; their weights add up to 0.
    ///
    /// Without the Gaussian, f is f − s²/2 f″ + s⁴/8 f⁗ − …, so that its mean over a box of width w changes by
    /// [−s²/2 f′ + s⁴/8 f‴]/w between the box's ends. The derivatives are differences: with Δₙ = f(x + nh) − f(x − nh),
    ///   f′ = (8 Δ₁ − Δ₂)/12h,   f‴ = (Δ₂ − 2 Δ₁)/2h³.
    fn steeper_ends(self, spacing_mm: f64) -> Vec<(f64, f64)> {
        let (s, width_mm) = (self.sharper_mm, self.width * spacing_mm);
        if s == 0.0 {
            return Vec::new();
        }
        let step_mm = 0.7 * s;
        let first = 0.5 * s * s / (width_mm * step_mm);
        let third = s.powi(4) / (8.0 * width_mm * step_mm.powi(3));
        let of_differences = [(1.0, -2.0 / 3.0 * first - third), (2.0, first / 12.0 + 0.5 * third)];
        let mut nodes = Vec::new();
        for end in [-1.0, 1.0] {
            for (steps, weight) in of_differences {
                for side in [-1.0, 1.0] {
                    let at_mm = 0.5 * width_mm * end + side * steps * step_mm;
                    nodes.push((at_mm / spacing_mm, end * side * weight));
                }
            }
        }
        nodes
    }
}

/// Distance of nodes that is exact enough for a point spread of σ = 0.3 mm.
const NODE_MM: f64 = 0.3;

fn node_count(length_mm: f64) -> usize {
    ((length_mm / NODE_MM).round() as usize).clamp(2, 8)
}

/// Points inside a voxel at which a smooth function averages to its mean over the voxel, by Gauss and Legendre.
#[derive(Clone, Debug)]
pub(super) struct VoxelPoints {
    /// Offset from the voxel's centre, lps mm, and weight; the weights add up to 1.
    points: Vec<(DVec3, f64)>,
    /// From the voxel's centre to a corner.
    pub half_diagonal_mm: f64,
    /// From the voxel's centre to the farthest point.
    reach_mm: f64,
}

impl VoxelPoints {
    /// For voxels with the edges that are the columns of `edges_mm`; along the edge of number `slices` they average as `profile` says.
    pub fn new(edges_mm: DMat3, slices: usize, profile: SliceProfile) -> Self {
        let edges = [edges_mm.x_axis, edges_mm.y_axis, edges_mm.z_axis];
        let nodes = [0, 1, 2].map(|axis| {
            let of_axis = if axis == slices { profile } else { SliceProfile::BOX };
            of_axis.nodes(edges[axis].length())
        });
        let mut points = Vec::new();
        for (z, along_z) in &nodes[2] {
            for (y, along_y) in &nodes[1] {
                for (x, along_x) in &nodes[0] {
                    let offset = edges[0] * *x + edges[1] * *y + edges[2] * *z;
                    points.push((offset, along_x * along_y * along_z));
                }
            }
        }
        let corner = |bits: usize| (0..3).map(|axis| edges[axis] * if bits >> axis & 1 == 1 { 0.5 } else { -0.5 }).sum::<DVec3>();
        let half_diagonal_mm = (0..8).map(|bits| corner(bits).length()).fold(0.0, f64::max);
        let reach_mm = points.iter().map(|(offset, _)| offset.length()).fold(half_diagonal_mm, f64::max);
        Self { points, half_diagonal_mm, reach_mm }
    }

    /// Mean share over the voxel whose centre lies at `offset_mm` from the ball's, and its derivatives by that offset, the radius and σ.
    pub fn mean_share(&self, offset_mm: DVec3, radius_mm: f64, blur_mm: f64) -> (f64, DVec3, f64, f64) {
        let (mut value, mut by_place, mut by_radius, mut by_blur) = (0.0, DVec3::ZERO, 0.0, 0.0);
        if offset_mm.length() - self.reach_mm > radius_mm + 6.0 * blur_mm {
            return (value, by_place, by_radius, by_blur);
        }
        for (inside, weight) in &self.points {
            let away = offset_mm + *inside;
            let distance_mm = away.length();
            let share = share(distance_mm, radius_mm, blur_mm);
            value += weight * share.value;
            by_place += away * (weight * share.by_distance / distance_mm.max(0.02 * blur_mm));
            by_radius += weight * share.by_radius;
            by_blur += weight * share.by_blur;
        }
        (value, by_place, by_radius, by_blur)
    }
}

/// Nodes in −1 to 1 and weights that add up to 2: the roots of the Legendre polynomial of degree `count`, by Newton.
fn gauss_legendre(count: usize) -> Vec<(f64, f64)> {
    let node = |index: usize| {
        let n = count as f64;
        let mut x = (std::f64::consts::PI * (index as f64 + 0.75) / (n + 0.5)).cos();
        let mut slope = 1.0;
        for _ in 0..30 {
            let (mut before, mut value) = (1.0, x);
            for degree in 2..=count {
                let k = degree as f64;
                (before, value) = (value, ((2.0 * k - 1.0) * x * value - (k - 1.0) * before) / k);
            }
            slope = n * (x * value - before) / (x * x - 1.0);
            x -= value / slope;
        }
        (x, 2.0 / ((1.0 - x * x) * slope * slope))
    };
    (0..count).map(node).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The ball convolved with the Gaussian by summing over shells of the ball: ∫ 4πs² of the Gaussian's mean over a shell.
    fn by_summing(d: f64, radius: f64, blur: f64) -> f64 {
        let steps = 4000;
        let gauss = |x: f64| (-0.5 * x * x / (blur * blur)).exp();
        let shell = |s: f64| s / d * (gauss(d - s) - gauss(d + s)) / (blur * std::f64::consts::TAU.sqrt());
        (0..steps).map(|n| shell((n as f64 + 0.5) * radius / steps as f64)).sum::<f64>() * radius / steps as f64
    }

    #[test]
    fn the_share_is_the_convolution_and_its_derivatives_are_differences() {
        let mut cases = 0;
        for (radius, blur) in [(0.5, 0.4), (0.75, 0.64), (2.5, 0.3), (0.3, 0.6)] {
            for d in [0.05, 0.3, 0.8, 1.6, 2.9] {
                let at = |d: f64, r: f64, s: f64| share(d, r, s).value;
                let found = share(d, radius, blur);
                assert!((found.value - by_summing(d, radius, blur)).abs() < 2e-6, "{radius} {blur} {d}: {found:?}");
                let h = 1e-3;
                let differences = [
                    (at(d + h, radius, blur) - at(d - h, radius, blur), found.by_distance),
                    (at(d, radius + h, blur) - at(d, radius - h, blur), found.by_radius),
                    (at(d, radius, blur + h) - at(d, radius, blur - h), found.by_blur),
                ];
                assert!(
                    differences.iter().all(|(difference, slope)| (difference / (2.0 * h) - slope).abs() < 1e-3),
                    "{differences:?}"
                );
                cases += 1;
            }
        }
        assert_eq!(cases, 20);
        assert!((share(0.0, 3.0, 0.3).value - 1.0).abs() < 1e-6 && share(0.0, 3.0, 0.3).by_distance.abs() < 1e-6);
    }

    /// Taken out of a Gaussian of σ = b, one of σ = s leaves √(b² − s²): as a ball of next to no radius shows, whose share is a Gaussian.
    #[test]
    fn a_sharp_slice_takes_the_blur_out_along_its_normal() {
        let (blur, sharper, thick) = (0.45f64, 0.3f64, 1.4);
        let left = (blur * blur - sharper * sharper).sqrt();
        let cdf = |x: f64| 0.5 * (1.0 + error_function(x / left, (-0.5 * (x / left) * (x / left)).exp()));
        let profile = SliceProfile::sharp(1.0, sharper);
        let nodes = profile.nodes(thick);
        assert!((nodes.iter().map(|(_, weight)| weight).sum::<f64>() - 1.0).abs() < 1e-12);
        let mut apart: f64 = 0.0;
        for n in 0..20 {
            let z = 0.1 * f64::from(n);
            let gauss = |x: f64| (-0.5 * (x / blur).powi(2)).exp() / (std::f64::consts::TAU.sqrt() * blur);
            let seen: f64 = nodes.iter().map(|(x, weight)| weight * gauss(z + x * thick)).sum();
            let truth = (cdf(z + 0.5 * thick) - cdf(z - 0.5 * thick)) / thick;
            // Without the last term of the series it would be 0.015 off.
            assert!((seen - truth).abs() < 0.01, "{z} mm: {seen} {truth}");
            let plain: f64 = SliceProfile::BOX.nodes(thick).iter().map(|(x, weight)| weight * gauss(z + x * thick)).sum();
            apart = apart.max((plain - truth).abs());
        }
        assert!(apart > 0.03, "the box without it is another: {apart}");
    }

    #[test]
    fn points_in_a_voxel_average_a_thick_slice() {
        let points = VoxelPoints::new(DMat3::from_diagonal(DVec3::new(0.7, 0.6, 2.5)), 2, SliceProfile::BOX);
        let mut sum = 0.0;
        let n = 40;
        let offset = DVec3::new(0.5, -0.3, 1.1);
        for k in 0..n * n * n {
            let along = |k: usize| (k as f64 + 0.5) / n as f64 - 0.5;
            let inside = DVec3::new(0.7 * along(k % n), 0.6 * along(k / n % n), 2.5 * along(k / n / n));
            sum += share((offset + inside).length(), 0.75, 0.4).value / (n * n * n) as f64;
        }
        let (mean, by_place, ..) = points.mean_share(offset, 0.75, 0.4);
        assert!((mean - sum).abs() < 2e-3 && mean > 0.05, "{mean} {sum}");
        let moved = points.mean_share(offset + DVec3::new(0.0, 0.0, 1e-3), 0.75, 0.4).0;
        assert!(((moved - mean) / 1e-3 - by_place.z).abs() < 1e-3);
        let (near, far) = (DVec3::new(0.3, 0.2, 0.4), DVec3::new(0.3, 0.2, 1.7));
        let sharp = VoxelPoints::new(DMat3::from_diagonal(DVec3::new(0.7, 0.6, 2.5)), 2, SliceProfile::sharp(1.0, 0.35));
        assert!(sharp.mean_share(near, 0.75, 0.4).0 > points.mean_share(near, 0.75, 0.4).0 + 1e-3);
        assert!(sharp.mean_share(far, 0.75, 0.4).0 < points.mean_share(far, 0.75, 0.4).0 - 1e-3);
        assert!((points.half_diagonal_mm - 0.5 * DVec3::new(0.7, 0.6, 2.5).length()).abs() < 1e-12);
    }
}
