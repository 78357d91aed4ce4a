//! Where on the screen things can be seen.

use glam::DVec3;

use crate::geometry::View;

/// Screen bounds: first and one past the last column and row.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bounds {
    /// First column and row.
    pub from: [u32; 2],
    /// One past the last.
    pub to: [u32; 2],
}

impl Bounds {
    /// Whether the two share a pixel.
    #[must_use]
    pub fn meets(&self, other: &Self) -> bool {
        (0..2).all(|axis| self.from[axis] < other.to[axis] && other.from[axis] < self.to[axis])
    }

    /// Whether no pixel is inside.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        (0..2).any(|axis| self.from[axis] >= self.to[axis])
    }
}

/// Pixels whose rays can meet a sphere; generous by a pixel.
// In the x–z plane the tangents leave at θ ± α, θ = atan2(x, z), sin α = r / √(x² + z²); likewise in y–z. Where a tangent
// points 90° or more away from the axis the image is unbounded on that side.
pub(super) fn sphere_bounds(view: &View, centre: DVec3, radius_mm: f64) -> Bounds {
    let k = &view.intrinsics;
    let range = |across: f64| -> Option<(f64, f64)> {
        let distance = across.hypot(centre.z);
        if !(distance > radius_mm) {
            return Some((f64::NEG_INFINITY, f64::INFINITY));
        }
        let (theta, alpha) = (across.atan2(centre.z), (radius_mm / distance).asin());
        let right_angle = std::f64::consts::FRAC_PI_2;
        if theta - alpha >= right_angle || theta + alpha <= -right_angle {
            return None;
        }
        let low = if theta - alpha <= -right_angle { f64::NEG_INFINITY } else { (theta - alpha).tan() };
        let high = if theta + alpha >= right_angle { f64::INFINITY } else { (theta + alpha).tan() };
        Some((low, high))
    };
    let nothing = Bounds { from: [0, 0], to: [0, 0] };
    let (Some(x), Some(y)) = (range(centre.x), range(centre.y)) else { return nothing };
    let skewed = if k.skew == 0.0 { (0.0, 0.0) } else { (k.skew * y.0, k.skew * y.1) };
    let u = (k.fx * x.0 + skewed.0.min(skewed.1) + k.cx, k.fx * x.1 + skewed.0.max(skewed.1) + k.cx);
    let v = (k.fy * y.0 + k.cy, k.fy * y.1 + k.cy);
    let first = |low: f64, n: u32| (low - 1.0).floor().clamp(0.0, f64::from(n)) as u32;
    let last = |high: f64, n: u32| (high + 2.0).ceil().clamp(0.0, f64::from(n)) as u32;
    let [width, height] = view.size_px;
    Bounds { from: [first(u.0, width), first(v.0, height)], to: [last(u.1, width), last(v.1, height)] }
}
