//! What a search asks of every triple of shadows and beads, once for all.

use glam::{DMat3, DVec2, DVec3};

use super::occupancy::Occupancy;
use crate::beads::Detection;
use crate::geometry::Intrinsics;

/// By how much blur, clipping and display curves move a fitted radius, besides what it states of itself: ln of the factor, and px more for a
/// small shadow.
const RADIUS_SLACK: (f64, f64) = (0.35, 0.5);

/// Spheres whose radius is less than so many px at a depth of 1 mm: half a pixel at two metres.
const TELLS_NOTHING: f64 = 1000.0;

/// What is known of a bead during the search.
#[derive(Clone, Copy, Debug)]
pub struct Target {
    pub lps_mm: DVec3,
    /// Standard deviation of its place along the direction that is known worst.
    pub sigma_mm: f64,
    /// Covariance of its place.
    pub place_mm2: DMat3,
    pub radius_mm: Option<f64>,
}

impl Target {
    /// Standard deviation of its place along a direction in `lps` of any length.
    pub fn sigma_along_mm(&self, direction: DVec3) -> f64 {
        let along = direction.normalize_or_zero();
        along.dot(self.place_mm2 * along).max(0.0).sqrt()
    }
}

/// See the module.
pub(super) struct Tables {
    /// Of the shadows, on the plane z = 1.
    pub rays: Vec<DVec2>,
    /// Between beads, row by row.
    pub squares_mm2: Vec<f64>,
    /// The largest distance between two.
    pub longest_mm: f64,
    /// Where a bead has about the radius of a shadow, row by row of beads.
    fits: Vec<Depths>,
    /// The same where the gate lets the bead be.
    in_gate: Vec<Depths>,
    pub shadows: Occupancy,
    count: usize,
}

/// Depths between two, mm; none where the first is not below the second.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Depths {
    pub near: f64,
    pub far: f64,
}

impl Depths {
    pub const NONE: Self = Self { near: f64::INFINITY, far: f64::NEG_INFINITY };
    pub const ALL: Self = Self { near: 0.0, far: f64::INFINITY };

    #[inline]
    pub fn contain(self, depth_mm: f64) -> bool {
        depth_mm > self.near && depth_mm < self.far
    }

    /// Whether a depth that may be off by a factor is among them.
    #[inline(always)]
    pub fn may_contain(self, depth_mm: f64, factor: f64) -> bool {
        (depth_mm * factor > self.near) & (depth_mm < self.far * factor)
    }

    /// What both contain.
    pub fn both(self, other: Self) -> Self {
        Self { near: self.near.max(other.near), far: self.far.min(other.far) }
    }

    /// What one of them contains, and what lies between.
    pub fn hull(self, other: Self) -> Self {
        Self { near: self.near.min(other.near), far: self.far.max(other.far) }
    }

    /// Where a sphere whose radius is `one_px` at a depth of 1 mm has a shadow of `radius_px`, whose logarithm may be off by `slack`:
    /// |ln(radius_px / p)| < slack + more / p, with p = one_px / depth. Spheres of less than `more` px are none.
    fn of_radius(one_px: f64, radius_px: f64, slack: f64) -> Self {
        if !(one_px > 0.0 && radius_px > 0.0) {
            return Self::NONE;
        }
        let more = RADIUS_SLACK.1;
        let shadow = radius_px.ln();
        // Newton's method in ln p, from the side on which it does not overshoot.
        let mut largest = shadow + slack;
        let mut least = shadow - slack;
        for _ in 0..8 {
            let at = more * (-largest).exp();
            largest -= (largest - shadow - slack - at) / (1.0 + at);
        }
        // Of what is smaller than a pixel at any depth the radius tells nothing.
        let is_open = shadow - more.ln() - slack - 1.0 <= 0.0 || one_px < TELLS_NOTHING;
        for _ in 0..8 {
            let at = more * (-least).exp();
            if !is_open {
                least -= (shadow - least - slack - at) / (at - 1.0);
            }
        }
        Self { near: one_px * (-largest).exp(), far: if is_open { f64::INFINITY } else { one_px * (-least).exp() } }
    }
}

impl Tables {
    /// Places within `widest_px` of a shadow are near it; `may_pair` tells which bead and shadow may belong together at all.
    pub fn new(
        targets: &[Target],
        detections: &[Detection],
        intrinsics: &Intrinsics,
        widest_px: f64,
        in_gate: &[Depths],
        may_pair: impl Fn(usize, usize) -> bool,
    ) -> Self {
        let ray = |d: &Detection| {
            let p = intrinsics.unproject(d.image_px);
            DVec2::new(p.x, p.y)
        };
        let squares_mm2: Vec<f64> =
            targets.iter().flat_map(|a| targets.iter().map(move |b| a.lps_mm.distance_squared(b.lps_mm))).collect();
        let fits: Vec<Depths> = {
            let of = |bead: usize, n: usize| match targets[bead].radius_mm {
                _ if !may_pair(bead, n) => Depths::NONE,
                Some(radius_mm) => {
                    let slack_ln = detections[n].radius_slack_ln(RADIUS_SLACK.0);
                    Depths::of_radius(intrinsics.fx * radius_mm, detections[n].radius_px, slack_ln)
                }
                None => Depths::ALL,
            };
            let shadows = 0..detections.len();
            (0..targets.len()).flat_map(|bead| shadows.clone().map(move |n| (bead, n))).map(|(bead, n)| of(bead, n)).collect()
        };
        Self {
            rays: detections.iter().map(ray).collect(),
            longest_mm: squares_mm2.iter().copied().fold(0.0, f64::max).sqrt(),
            squares_mm2,
            in_gate: fits.iter().enumerate().map(|(n, fits)| fits.both(in_gate[n / detections.len()])).collect(),
            fits,
            shadows: Occupancy::new(detections, widest_px),
            count: detections.len(),
        }
    }

    /// Whether a shadow has the radius that bead would have at that depth.
    #[inline]
    pub fn radius_fits(&self, bead: usize, detection: usize, depth_mm: f64) -> bool {
        self.fits[bead * self.count + detection].contain(depth_mm)
    }

    /// Depths at which it would, and at which the gate lets the bead be.
    #[inline]
    pub fn in_gate(&self, bead: usize, detection: usize) -> Depths {
        self.in_gate[bead * self.count + detection]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_radius_fits_between_two_depths() {
        for (one_px, radius_px) in [(3900.0, 6.1), (800.0, 2.1), (2000.0, 0.9), (9000.0, 30.0)] {
            let depths = Depths::of_radius(one_px, radius_px, RADIUS_SLACK.0);
            for n in 1..4000 {
                let depth_mm = f64::from(n);
                let predicted_px = one_px / depth_mm;
                let fits = (radius_px / predicted_px).ln().abs() < 0.35 + 0.5 / predicted_px;
                let is_open = one_px < TELLS_NOTHING && radius_px > predicted_px;
                assert!(depths.contain(depth_mm) == fits || is_open || predicted_px < 0.5, "{radius_px} px of {predicted_px}");
            }
        }
        // A small bead in a binned frame, as its shadow is fitted.
        for radius_px in [1.0, 1.92, 1.95, 3.0] {
            assert!(Depths::of_radius(0.18 * 1314.0, radius_px, RADIUS_SLACK.0).contain(700.0), "{radius_px}");
        }
        for radius_px in [0.0, -1.0, f64::NAN] {
            assert!(!Depths::of_radius(3900.0, radius_px, RADIUS_SLACK.0).contain(700.0));
        }
        // Of 5.6 px; half as large is too small, unless blur may hide as much.
        let hidden = |radius_sigma_ln: f64| Detection { radius_sigma_ln, ..Detection::default() }.radius_slack_ln(RADIUS_SLACK.0);
        assert!([0.0, 0.35].map(|sigma_ln| Depths::of_radius(3900.0, 2.8, hidden(sigma_ln)).contain(700.0)) == [false, true]);
        assert!(!Depths::ALL.contain(f64::NAN) && !Depths::NONE.contain(700.0));
    }
}
