//! Mass attenuation coefficients of the elements 1–92: xraylib's photoelectric, Compton and Rayleigh cross sections and their sum.

use std::sync::LazyLock;

use super::PhysicsError;

/// Elements in the tables.
pub const ELEMENT_COUNT: u8 = 92;

/// First and last energy of the tables.
pub const ENERGY_RANGE_KEV: (f64, f64) = (1.0, 150.0);

const SYMBOLS: [&str; ELEMENT_COUNT as usize] = [
    "H", "He", "Li", "Be", "B", "C", "N", "O", "F", "Ne", "Na", "Mg", "Al", "Si", "P", "S", "Cl", "Ar", "K", "Ca", "Sc", "Ti",
    "V", "Cr", "Mn", "Fe", "Co", "Ni", "Cu", "Zn", "Ga", "Ge", "As", "Se", "Br", "Kr", "Rb", "Sr", "Y", "Zr", "Nb", "Mo", "Tc",
    "Ru", "Rh", "Pd", "Ag", "Cd", "In", "Sn", "Sb", "Te", "I", "Xe", "Cs", "Ba", "La", "Ce", "Pr", "Nd", "Pm", "Sm", "Eu", "Gd",
    "Tb", "Dy", "Ho", "Er", "Tm", "Yb", "Lu", "Hf", "Ta", "W", "Re", "Os", "Ir", "Pt", "Au", "Hg", "Tl", "Pb", "Bi", "Po", "At",
    "Rn", "Fr", "Ra", "Ac", "Th", "Pa", "U",
];

/// Mass attenuation by interaction, cm²/g.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Coefficients {
    /// Sum of the others.
    pub total_cm2_per_g: f64,
    /// Photoelectric absorption.
    pub photo_cm2_per_g: f64,
    /// Incoherent scattering.
    pub compton_cm2_per_g: f64,
    /// Coherent scattering.
    pub rayleigh_cm2_per_g: f64,
}

impl Coefficients {
    /// Adds `weight` times `other`.
    pub(super) fn add(&mut self, other: &Self, weight: f64) {
        self.total_cm2_per_g += weight * other.total_cm2_per_g;
        self.photo_cm2_per_g += weight * other.photo_cm2_per_g;
        self.compton_cm2_per_g += weight * other.compton_cm2_per_g;
        self.rayleigh_cm2_per_g += weight * other.rayleigh_cm2_per_g;
    }
}

/// One row of the table, logarithms taken.
struct Row {
    ln_energy: f64,
    ln_values: [f64; 3],
}

static TABLE: LazyLock<Vec<Vec<Row>>> = LazyLock::new(|| {
    let mut table: Vec<Vec<Row>> = (0..ELEMENT_COUNT).map(|_| Vec::new()).collect();
    for line in include_str!("../../../calibration/materials/elements.csv").lines() {
        let mut cells = line.split(',');
        let Some(z) = cells.next().and_then(|cell| cell.parse::<usize>().ok()) else { continue };
        let numbers: Vec<f64> = cells.filter_map(|cell| cell.parse().ok()).collect();
        if let ([energy, values @ ..], Some(rows)) = (numbers.as_slice(), table.get_mut(z - 1)) {
            rows.push(Row { ln_energy: energy.ln(), ln_values: std::array::from_fn(|i| values[i].ln()) });
        }
    }
    table
});

/// Symbol of element `z`, 1–92.
#[must_use]
pub fn symbol(z: u8) -> Option<&'static str> {
    SYMBOLS.get(usize::from(z).checked_sub(1)?).copied()
}

/// Atomic number of a symbol, upper and lower case as in the periodic table.
#[must_use]
pub fn z_of(symbol: &str) -> Option<u8> {
    SYMBOLS.iter().position(|known| *known == symbol).map(|index| index as u8 + 1)
}

/// Attenuation of element `z` at `energy_kev`, log–log interpolated between the rows of its table. At an absorption edge itself the
/// value above the edge holds.
///
/// # Errors
/// When the energy (or the element) is outside the tables.
pub fn element_attenuation(z: u8, energy_kev: f64) -> Result<Coefficients, PhysicsError> {
    let (from_kev, to_kev) = ENERGY_RANGE_KEV;
    if !(energy_kev >= from_kev && energy_kev <= to_kev) {
        return Err(PhysicsError::Energy { energy_kev, from_kev, to_kev });
    }
    let rows = usize::from(z)
        .checked_sub(1)
        .and_then(|index| TABLE.get(index))
        .ok_or_else(|| PhysicsError::Unknown { name: format!("element {z}"), suggestion: String::new() })?;
    let x = energy_kev.ln();
    let above = rows.partition_point(|row| row.ln_energy <= x).clamp(1, rows.len() - 1);
    let (a, b) = (&rows[above - 1], &rows[above]);
    let fraction = ((x - a.ln_energy) / (b.ln_energy - a.ln_energy)).clamp(0.0, 1.0);
    let [photo, compton, rayleigh] =
        std::array::from_fn(|i| (a.ln_values[i] + (b.ln_values[i] - a.ln_values[i]) * fraction).exp());
    Ok(Coefficients {
        total_cm2_per_g: photo + compton + rayleigh,
        photo_cm2_per_g: photo,
        compton_cm2_per_g: compton,
        rayleigh_cm2_per_g: rayleigh,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// 400 random values printed by xraylib 4.3.0 itself.
    #[test]
    fn agrees_with_xraylib_away_from_edges() {
        let mut cases = 0;
        for line in include_str!("../../../tests/data/xraylib-random.csv").lines().skip(2) {
            let n: Vec<f64> = line.split(',').filter_map(|cell| cell.parse().ok()).collect();
            let found = element_attenuation(n[0] as u8, n[1]).expect("inside the tables");
            assert!((found.total_cm2_per_g / n[2] - 1.0).abs() < 2e-3, "Z={} at {} keV", n[0], n[1]);
            for (ours, theirs) in
                [(found.photo_cm2_per_g, n[3]), (found.compton_cm2_per_g, n[4]), (found.rayleigh_cm2_per_g, n[5])]
            {
                assert!((ours - theirs).abs() < 2e-3 * n[2], "Z={} at {} keV: {ours} {theirs}", n[0], n[1]);
            }
            assert!((found.total_cm2_per_g * 1.01 / n[2] - 1.0).abs() > 2e-3, "control: 1 % off is seen");
            cases += 1;
        }
        assert_eq!(cases, 400);
    }

    #[test]
    fn lead_jumps_at_its_k_edge() {
        let below = element_attenuation(82, 87.9).expect("inside").total_cm2_per_g;
        let above = element_attenuation(82, 88.1).expect("inside").total_cm2_per_g;
        assert!(above / below > 3.5, "{below} {above}");
    }

    #[test]
    fn energies_outside_and_nan_are_refused() {
        for energy_kev in [0.99, 150.1, f64::NAN] {
            assert!(matches!(element_attenuation(6, energy_kev), Err(PhysicsError::Energy { .. })));
        }
    }
}
