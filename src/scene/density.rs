//! Mass density from Hounsfield numbers (DESIGN §5): a calibration file, linear between its knots.

use std::sync::LazyLock;

use serde::Deserialize;

/// The curve of `calibration/materials/density-curve.json` and the thresholds of the classes.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DensityCurve {
    /// Where it comes from.
    pub origin: String,
    /// Hounsfield number and density, ascending, at least two.
    pub knots_hu_g_per_cm3: Vec<[f64; 2]>,
    /// Below this a voxel is air, or lung.
    pub air_below_hu: f64,
    /// Above this it is bone, between the two soft tissue.
    pub bone_above_hu: f64,
    /// At or below this it was not reconstructed: padding outside the field of view.
    pub unknown_at_most_hu: f64,
}

/// Class of a voxel by threshold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ThresholdClass {
    /// Room air, or lung, airways and gas within the body.
    Thin,
    /// Between the thresholds, both included.
    SoftTissue,
    /// Above the upper threshold.
    Bone,
}

static CURVE: LazyLock<DensityCurve> = LazyLock::new(|| {
    serde_json::from_str(include_str!("../../calibration/materials/density-curve.json")).expect("a test reads this file")
});

impl DensityCurve {
    /// The calibration that comes with the program.
    #[must_use]
    pub fn shipped() -> &'static Self {
        &CURVE
    }

    /// g/cm³: linear between the knots, the last slope extended, numbers below the first knot taken as the first.
    #[must_use]
    pub fn density_g_per_cm3(&self, hu: f64) -> f64 {
        let knots = &self.knots_hu_g_per_cm3;
        if hu <= knots[0][0] {
            return knots[0][1];
        }
        let segment = knots.windows(2).position(|pair| hu <= pair[1][0]).unwrap_or(knots.len() - 2);
        let [[x0, y0], [x1, y1]] = [knots[segment], knots[segment + 1]];
        y0 + (hu - x0) / (x1 - x0) * (y1 - y0)
    }

    /// Class by threshold.
    #[must_use]
    pub fn class(&self, hu: f64) -> ThresholdClass {
        if hu < self.air_below_hu {
            ThresholdClass::Thin
        } else if hu <= self.bone_above_hu {
            ThresholdClass::SoftTissue
        } else {
            ThresholdClass::Bone
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_curve_passes_its_knots_and_extends_its_last_slope() {
        let curve = DensityCurve::shipped();
        let cases = [
            (-3000.0, 0.0012),
            (-1000.0, 0.0012),
            (-82.0, 0.95),
            (0.0, 1.0),
            (55.0, 1.06),
            (1700.0, 1.92),
            (-541.0, 0.4756),
            (3345.0, 2.78),
        ];
        for (hu, expected) in cases {
            assert!((curve.density_g_per_cm3(hu) - expected).abs() < 1e-12, "{hu}: {}", curve.density_g_per_cm3(hu));
        }
        assert!((curve.density_g_per_cm3(1000.0) - 1.92).abs() > 0.1, "control");
    }

    #[test]
    fn thresholds_belong_to_soft_tissue() {
        let curve = DensityCurve::shipped();
        let cases = [
            (-700.001, ThresholdClass::Thin),
            (-700.0, ThresholdClass::SoftTissue),
            (250.0, ThresholdClass::SoftTissue),
            (250.001, ThresholdClass::Bone),
        ];
        for (hu, expected) in cases {
            assert_eq!(curve.class(hu), expected, "{hu}");
        }
    }
}
