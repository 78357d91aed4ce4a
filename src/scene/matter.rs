//! HU and labels to densities and classes (DESIGN §5).

use std::sync::LazyLock;

use serde::Deserialize;

use super::nifti::Grid;

/// The calibration file of the density curve.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DensityCurve {
    /// Where it is from.
    pub origin: String,
    /// HU and g/cm³, ascending.
    pub knots_hu_g_per_cm3: Vec<[f64; 2]>,
    /// Threshold class `air`.
    pub air_below_hu: f64,
    /// Threshold class `bone_cortical`.
    pub bone_above_hu: f64,
    /// Padding: outside the reconstruction circle.
    pub unknown_below_hu: f64,
}

static CURVE: LazyLock<DensityCurve> = LazyLock::new(|| {
    serde_json::from_str(include_str!("../../calibration/materials/density-curve.json"))
        .expect("embedded curve is checked by a test")
});

impl DensityCurve {
    /// The shipped curve.
    #[must_use]
    pub fn shipped() -> &'static Self {
        &CURVE
    }

    /// Density of a voxel: linear between the knots, HU below the first taken as the first, last slope extended.
    #[must_use]
    pub fn density_g_per_cm3(&self, hu: f64) -> f64 {
        let knots = &self.knots_hu_g_per_cm3;
        let hu = hu.max(knots[0][0]);
        let above = knots.partition_point(|knot| knot[0] <= hu).clamp(1, knots.len() - 1);
        let ([x0, y0], [x1, y1]) = (knots[above - 1], knots[above]);
        y0 + (y1 - y0) * (hu - x0) / (x1 - x0)
    }
}

/// What a class means while voxels are sorted into classes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Class {
    /// Scene material index.
    pub material: usize,
    /// Overrides the density from HU.
    pub nominal_g_per_cm3: Option<f64>,
}

/// Classes of a CT: index 0 of `class` is nothing, c > 0 is `classes[c − 1]`.
#[derive(Clone, Debug)]
pub struct Classified {
    /// Density per voxel.
    pub density_g_per_cm3: Vec<f32>,
    /// Class per voxel.
    pub class: Vec<u8>,
    /// Padding; empty if there is none.
    pub unknown: Vec<bool>,
}

/// Sorts the voxels of `hu`. `choose(hu, index)` gives the class (1-based) or 0 for nothing.
#[must_use]
pub fn classify(hu: &Grid, classes: &[Class], choose: impl Fn(f64, usize) -> u8) -> Classified {
    let curve = DensityCurve::shipped();
    let mut class = Vec::with_capacity(hu.values.len());
    let mut density_g_per_cm3 = Vec::with_capacity(hu.values.len());
    for (index, value) in hu.values.iter().enumerate() {
        let value = f64::from(*value);
        let chosen = choose(value, index);
        let density = match usize::from(chosen).checked_sub(1).and_then(|c| classes.get(c)) {
            None => 0.0,
            Some(class) => class.nominal_g_per_cm3.unwrap_or_else(|| curve.density_g_per_cm3(value)),
        };
        class.push(if density > 0.0 { chosen } else { 0 });
        density_g_per_cm3.push(density as f32);
    }
    let padded = |value: &f32| f64::from(*value) < curve.unknown_below_hu;
    let unknown = if hu.values.iter().any(padded) { hu.values.iter().map(padded).collect() } else { Vec::new() };
    Classified { density_g_per_cm3, class, unknown }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_curve_passes_its_knots_and_extends_its_last_slope() {
        let curve = DensityCurve::shipped();
        for [hu, density] in &curve.knots_hu_g_per_cm3 {
            assert!((curve.density_g_per_cm3(*hu) - density).abs() < 1e-12);
        }
        assert!((curve.density_g_per_cm3(-2048.0) - 0.0012).abs() < 1e-12);
        let slope = (1.92 - 1.06) / (1700.0 - 55.0);
        assert!((curve.density_g_per_cm3(3000.0) - (1.92 + 1300.0 * slope)).abs() < 1e-9);
    }
}
