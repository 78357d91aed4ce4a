//! Named materials, formulas and mixtures.

use std::sync::LazyLock;

use super::elements::{Coefficients, element_attenuation, z_of};
use super::formula::{parse_formula, parse_fractions};
use super::{PhysicsError, symbol};
use crate::spelling::nearest;

/// A composition, and a nominal density where one is known.
#[derive(Clone, Debug, PartialEq)]
pub struct Material {
    /// Lower-case name of the table, or the formula as written.
    pub name: String,
    /// Nominal density.
    pub density_g_per_cm3: Option<f64>,
    /// Atomic number and mass fraction; the fractions add up to 1.
    pub composition: Vec<(u8, f64)>,
}

static TABLE: LazyLock<Vec<Material>> = LazyLock::new(|| {
    let mut table: Vec<Material> = Vec::new();
    for line in include_str!("../../../calibration/materials/materials.csv").lines() {
        let cells: Vec<&str> = line.split(',').collect();
        let [name, density, element, fraction, ..] = cells.as_slice() else { continue };
        let (Ok(density), Some(z), Ok(fraction)) = (density.parse::<f64>(), z_of(element), fraction.parse::<f64>()) else {
            continue;
        };
        match table.last_mut().filter(|material| material.name == *name) {
            Some(material) => material.composition.push((z, fraction)),
            None => table.push(Material {
                name: (*name).to_owned(),
                density_g_per_cm3: Some(density),
                composition: vec![(z, fraction)],
            }),
        }
    }
    for material in &mut table {
        let sum: f64 = material.composition.iter().map(|(_, fraction)| fraction).sum();
        material.composition.iter_mut().for_each(|(_, fraction)| *fraction /= sum);
    }
    table
});

/// The materials table, in its order.
#[must_use]
pub fn materials() -> &'static [Material] {
    &TABLE
}

/// Names of the materials table, in its order.
pub fn material_names() -> impl Iterator<Item = &'static str> {
    TABLE.iter().map(|material| material.name.as_str())
}

impl Material {
    /// A name of the table (any case), a chemical formula (`H2O`, `Ti90Al6V4`: counts of atoms), or mass fractions
    /// (`Ti:0.9,Al:0.06,V:0.04`). A single element takes the density of its table entry, if it has one.
    ///
    /// # Errors
    /// When it is none of these; near names are suggested.
    pub fn parse(text: &str) -> Result<Self, PhysicsError> {
        let text = text.trim();
        let lower = text.to_lowercase();
        if let Some(known) = TABLE.iter().find(|material| material.name == lower) {
            return Ok(known.clone());
        }
        let composition = if text.contains(':') {
            parse_fractions(text)?
        } else {
            // What starts like a formula but is a misspelt name should get the suggestion, not the parser's complaint.
            parse_formula(text).map_err(|error| {
                let looks_like_formula = text.chars().any(|c| c.is_ascii_digit() || c == '(') || text.len() <= 3;
                if looks_like_formula && near(&lower).is_none() { error } else { unknown(text, &lower) }
            })?
        };
        let density_g_per_cm3 = match composition.as_slice() {
            [(z, _)] => {
                TABLE.iter().find(|m| m.composition.len() == 1 && m.composition[0].0 == *z).and_then(|m| m.density_g_per_cm3)
            }
            _ => None,
        };
        Ok(Self { name: text.to_owned(), density_g_per_cm3, composition })
    }

    /// Nominal density.
    ///
    /// # Errors
    /// When there is none.
    pub fn nominal_density_g_per_cm3(&self) -> Result<f64, PhysicsError> {
        self.nominal_density_or("name one of `sidecarm materials` that has one")
    }

    /// The same, where something else can be done about a material that has none.
    ///
    /// # Errors
    /// When there is none.
    pub fn nominal_density_or(&self, remedy: &'static str) -> Result<f64, PhysicsError> {
        self.density_g_per_cm3.ok_or_else(|| PhysicsError::NoDensity { name: self.name.clone(), remedy })
    }

    /// Mass attenuation of the mixture: Σ w_i (μ/ρ)_i.
    ///
    /// # Errors
    /// When the energy is outside the tables.
    pub fn attenuation(&self, energy_kev: f64) -> Result<Coefficients, PhysicsError> {
        let mut sum = Coefficients::default();
        for (z, fraction) in &self.composition {
            sum.add(&element_attenuation(*z, energy_kev)?, *fraction);
        }
        Ok(sum)
    }

    /// `H 0.1119, O 0.8881` for people.
    #[must_use]
    pub fn describe(&self) -> String {
        let part = |(z, fraction): &(u8, f64)| format!("{} {fraction:.4}", symbol(*z).unwrap_or("?"));
        self.composition.iter().map(part).collect::<Vec<_>>().join(", ")
    }
}

fn unknown(text: &str, lower: &str) -> PhysicsError {
    let suggestion = near(lower).map_or_else(String::new, |name| format!(", did you mean {name}?"));
    PhysicsError::Unknown { name: text.to_owned(), suggestion }
}

/// The name of the table nearest to `lower`, if it is near at all.
fn near(lower: &str) -> Option<&'static str> {
    nearest(lower, material_names())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_has_its_materials_and_any_case_finds_them() {
        assert_eq!(material_names().count(), 23);
        assert_eq!(Material::parse("Steel_316L").expect("known").density_g_per_cm3, Some(8.0));
        assert_eq!(Material::parse("Al").expect("element").density_g_per_cm3, Some(2.699));
        assert_eq!(Material::parse("Ti90Al6V4").expect("formula").density_g_per_cm3, None);
    }

    #[test]
    fn water_at_60_kev_has_the_known_mean_free_path_and_shares() {
        let water = Material::parse("water").expect("known").attenuation(60.0).expect("inside");
        assert!((10.0 / water.total_cm2_per_g - 48.57).abs() < 0.05, "{}", 10.0 / water.total_cm2_per_g);
        for (share, expected) in
            [(water.photo_cm2_per_g, 0.0725), (water.compton_cm2_per_g, 0.8599), (water.rayleigh_cm2_per_g, 0.0676)]
        {
            assert!((share / water.total_cm2_per_g - expected).abs() < 3e-4);
        }
        let formula = Material::parse("H2O").expect("formula").attenuation(60.0).expect("inside");
        assert!((formula.total_cm2_per_g / water.total_cm2_per_g - 1.0).abs() < 1e-5);
    }

    #[test]
    fn misspelt_names_are_suggested() {
        for (typed, meant) in [("titanum", "titanium"), ("bone", "bone_cortical"), ("Steel", "steel_316l")] {
            let error = Material::parse(typed).expect_err(typed).to_string();
            assert!(error.contains(meant), "{error}");
        }
        assert!(matches!(Material::parse("unobtainium"), Err(PhysicsError::Unknown { .. })));
    }
}
