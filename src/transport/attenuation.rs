//! Attenuation of one material by energy, tabulated so finely that a flight looks it up by an index.

use crate::scene::physics::{ENERGY_RANGE_KEV, Material, PhysicsError};

/// Rows per keV. Between rows the tables are linear: 2e-4 of μ/ρ at 5 keV, 6e-5 at 10 keV; an absorption edge is 1/16 keV wide.
pub(super) const ROWS_PER_KEV: f64 = 16.0;

/// What a photon of one energy may do in a material.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Shares {
    /// Of photoelectric absorption.
    pub photo: f64,
    /// Of photoelectric absorption or Compton scattering; the rest is Rayleigh scattering.
    pub photo_or_compton: f64,
}

/// μ/ρ and its shares at rows of equal spacing from the lowest energy of the tables.
#[derive(Clone, Debug)]
pub struct Attenuation {
    pub(super) mm2_per_mg: Vec<f64>,
    pub(super) shares: Vec<Shares>,
}

impl Attenuation {
    /// Tabulates `material`.
    ///
    /// # Errors
    /// When an element is not in the tables.
    pub fn new(material: &Material) -> Result<Self, PhysicsError> {
        let (first_kev, last_kev) = ENERGY_RANGE_KEV;
        let count = ((last_kev - first_kev) * ROWS_PER_KEV) as usize + 1;
        let mut table = Self { mm2_per_mg: Vec::with_capacity(count + 1), shares: Vec::with_capacity(count + 1) };
        for row in 0..count {
            let found = material.attenuation(first_kev + row as f64 / ROWS_PER_KEV)?;
            let photo = found.photo_cm2_per_g / found.total_cm2_per_g;
            let photo_or_compton = (found.photo_cm2_per_g + found.compton_cm2_per_g) / found.total_cm2_per_g;
            table.mm2_per_mg.push(0.1 * found.total_cm2_per_g);
            table.shares.push(Shares { photo, photo_or_compton });
        }
        // A row more, so that the last energy has one above it.
        table.mm2_per_mg.push(table.mm2_per_mg[count - 1]);
        table.shares.push(table.shares[count - 1]);
        Ok(table)
    }

    fn place(&self, energy_kev: f64) -> (usize, f64) {
        let position = ((energy_kev - ENERGY_RANGE_KEV.0) * ROWS_PER_KEV).max(0.0);
        let row = (position as usize).min(self.mm2_per_mg.len() - 2);
        (row, position - row as f64)
    }

    /// μ per mm at a density of 1 g/cm³.
    #[inline]
    #[must_use]
    pub fn per_mm_at_unit_density(&self, energy_kev: f64) -> f64 {
        let (row, fraction) = self.place(energy_kev);
        let (low, high) = (self.mm2_per_mg[row], self.mm2_per_mg[row + 1]);
        low + (high - low) * fraction
    }

    /// What happens at a collision.
    #[inline]
    #[must_use]
    pub fn shares(&self, energy_kev: f64) -> Shares {
        let (row, fraction) = self.place(energy_kev);
        let (low, high) = (self.shares[row], self.shares[row + 1]);
        Shares {
            photo: low.photo + (high.photo - low.photo) * fraction,
            photo_or_compton: low.photo_or_compton + (high.photo_or_compton - low.photo_or_compton) * fraction,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fine_table_is_the_tables_away_from_edges() {
        let mut cases = 0;
        for name in ["water", "bone_cortical", "titanium", "steel_316l", "soft_tissue_tg195"] {
            let material = Material::parse(name).expect("known");
            let table = Attenuation::new(&material).expect("tabulated");
            for energy_kev in [10.03, 17.77, 33.333, 56.4, 60.0, 99.97, 149.99, 150.0] {
                let exact = material.attenuation(energy_kev).expect("inside");
                let found = table.per_mm_at_unit_density(energy_kev);
                assert!((found / (0.1 * exact.total_cm2_per_g) - 1.0).abs() < 2e-4, "{name} at {energy_kev} keV");
                assert!((1.01 * found / (0.1 * exact.total_cm2_per_g) - 1.0).abs() > 2e-4, "control");
                let shares = table.shares(energy_kev);
                assert!((shares.photo - exact.photo_cm2_per_g / exact.total_cm2_per_g).abs() < 2e-4);
                assert!((1.0 - shares.photo_or_compton - exact.rayleigh_cm2_per_g / exact.total_cm2_per_g).abs() < 2e-4);
                cases += 1;
            }
        }
        assert_eq!(cases, 40);
    }
}
