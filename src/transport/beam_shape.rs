//! What heel and bow-tie leave of each energy in a direction, tabulated from the yardstick's own functions.

use glam::DVec3;

use super::error::TransportError;
use crate::render::reference::left_of;
use crate::scene::optics::{BeamShape, BowTie, Heel};

/// Take-off angles of the heel's table, degrees: from the target's surface to where no tube opens.
pub(super) const FIRST_DEG: f64 = 0.25;
pub(super) const STEP_DEG: f64 = 0.25;
const ANGLES: usize = 240;

/// Shares by direction and energy.
pub struct Left {
    pub(super) bowtie: Option<(BowTie, Vec<f64>)>,
    pub(super) heel: Option<(Heel, Vec<Vec<f64>>)>,
}

impl Left {
    /// Tabulates `shape` at `energies_kev`.
    ///
    /// # Errors
    /// When an energy is outside the tables.
    pub fn new(shape: &BeamShape, energies_kev: &[f64]) -> Result<Self, TransportError> {
        let bowtie = match &shape.bowtie {
            Some(bowtie) => {
                let attenuation = |energy_kev: &f64| Ok(bowtie.material.attenuation(*energy_kev)?.total_cm2_per_g);
                let coefficients = energies_kev.iter().map(attenuation).collect::<Result<Vec<f64>, TransportError>>()?;
                Some((bowtie.clone(), coefficients))
            }
            None => None,
        };
        let heel = match shape.heel {
            Some(heel) => {
                let alone = BeamShape { heel: Some(heel), ..BeamShape::default() };
                let row = |n: usize| {
                    // A ray in the plane of anode and principal ray leaves the target at the anode angle less its own towards the anode.
                    let take_off_deg = FIRST_DEG + n as f64 * STEP_DEG;
                    let (sine, cosine) = (heel.anode_angle_deg - take_off_deg).to_radians().sin_cos();
                    Ok(left_of(&alone, energies_kev, heel.anode_towards.in_camera() * sine + DVec3::Z * cosine)?)
                };
                Some((heel, (0..ANGLES).map(row).collect::<Result<Vec<_>, TransportError>>()?))
            }
            None => None,
        };
        Ok(Self { bowtie, heel })
    }

    /// Whether nothing is taken anywhere.
    #[must_use]
    pub fn is_everything(&self) -> bool {
        self.bowtie.is_none() && self.heel.is_none()
    }

    /// Share of the photons of energy `bin` that are left along a ray of the camera.
    #[inline]
    #[must_use]
    pub fn share(&self, bin: usize, ray: DVec3) -> f64 {
        let mut share = 1.0;
        if let Some((bowtie, coefficients)) = &self.bowtie {
            share *= (-coefficients[bin] * bowtie.area_density(ray)).exp();
        }
        if let Some((heel, rows)) = &self.heel {
            let sine = heel.sine_of_take_off(ray);
            if !(sine > 0.0) {
                return 0.0;
            }
            let position = ((sine.min(1.0).asin().to_degrees() - FIRST_DEG) / STEP_DEG).clamp(0.0, (ANGLES - 1) as f64);
            let row = (position as usize).min(ANGLES - 2);
            let (low, high) = (rows[row][bin], rows[row + 1][bin]);
            share *= low + (high - low) * (position - row as f64);
        }
        share
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::optics::{Axis, Towards};
    use crate::scene::physics::Material;
    use crate::transport::stream::Stream;

    /// Heel and bow-tie cancel in the image, so that only a direct comparison sees them.
    #[test]
    fn what_is_left_is_what_the_yardstick_leaves() {
        let energies_kev = [25.5, 40.5, 57.5, 80.5];
        let heel = Heel { tube_kvp: 90.0, anode_angle_deg: 12.0, anode_towards: Towards::PlusColumn };
        let aluminium = Material::parse("aluminium").expect("known");
        let thickness_mm = vec![[-6.0, 12.0], [0.0, 1.0], [6.0, 9.0]];
        let bowtie = BowTie { material: aluminium, density_g_per_cm3: 2.7, axis: Axis::Row, thickness_mm };
        let shape = BeamShape { heel: Some(heel), bowtie: Some(bowtie), ..BeamShape::default() };
        let (left, mut stream, mut far) = (Left::new(&shape, &energies_kev).expect("inside"), Stream::new(1, 0), 0);
        for _ in 0..40 {
            let ray = DVec3::new(0.3 * (stream.uniform() - 0.5), 0.3 * (stream.uniform() - 0.5), 1.0);
            let expected = left_of(&shape, &energies_kev, ray).expect("inside");
            for (bin, expected) in expected.iter().enumerate() {
                let found = left.share(bin, ray);
                assert!((found - expected).abs() < 0.01 * expected + 1e-4, "{ray} {bin}: {found} {expected}");
                far += usize::from((expected - 1.0).abs() > 0.1);
            }
        }
        assert!(far > 100 && !left.is_everything(), "{far}");
    }
}
