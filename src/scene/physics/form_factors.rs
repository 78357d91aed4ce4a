//! What binding does to scattering: form factors F(q, Z) and incoherent functions S(q, Z) of the elements 1–92, from xraylib.
//!
//! q = sin(θ/2)/λ in 1/Å. The Rayleigh cross section by angle is Thomson's times F², the Compton one is Klein and Nishina's times S.

use std::io::Read;
use std::sync::LazyLock;

use super::{ELEMENT_COUNT, PhysicsError};

/// One element's functions at ascending q from 0.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FormFactors {
    q_per_angstrom: Vec<f64>,
    form: Vec<f64>,
    incoherent: Vec<f64>,
}

static TABLE: LazyLock<Vec<FormFactors>> = LazyLock::new(|| {
    let mut text = String::new();
    let packed: &[u8] = include_bytes!("../../../calibration/materials/form-factors.csv.gz");
    // A file that cannot be unpacked leaves the table empty, which every question then says.
    let unpacked = flate2::read::GzDecoder::new(packed).read_to_string(&mut text);
    let mut table = vec![FormFactors::default(); usize::from(ELEMENT_COUNT)];
    for line in text.lines().filter(|_| unpacked.is_ok()) {
        let cells: Option<Vec<f64>> = line.split(',').map(|cell| cell.parse().ok()).collect();
        let Some([z, q, form, incoherent]) = cells.as_deref() else { continue };
        if let Some(element) = (*z as usize).checked_sub(1).and_then(|index| table.get_mut(index)) {
            element.q_per_angstrom.push(*q);
            element.form.push(*form);
            element.incoherent.push(*incoherent);
        }
    }
    table
});

/// The functions of element `z`.
///
/// # Errors
/// When there is no such element.
pub fn form_factors(z: u8) -> Result<&'static FormFactors, PhysicsError> {
    let known = usize::from(z).checked_sub(1).and_then(|index| TABLE.get(index)).filter(|table| table.form.len() >= 4);
    known.ok_or_else(|| PhysicsError::Unknown { name: format!("element {z}"), suggestion: String::new() })
}

impl FormFactors {
    /// F at q; Z at 0.
    #[must_use]
    pub fn form(&self, q_per_angstrom: f64) -> f64 {
        self.cubic(&self.form, q_per_angstrom)
    }

    /// S at q; 0 at 0, Z where all electrons are free.
    #[must_use]
    pub fn incoherent(&self, q_per_angstrom: f64) -> f64 {
        self.cubic(&self.incoherent, q_per_angstrom)
    }

    /// The cubic through the four rows around q; the last row's value beyond them.
    fn cubic(&self, values: &[f64], q_per_angstrom: f64) -> f64 {
        let rows = &self.q_per_angstrom;
        let q = q_per_angstrom.clamp(0.0, rows[rows.len() - 1]);
        let first = rows.partition_point(|row| *row <= q).saturating_sub(2).min(rows.len() - 4);
        let term = |i: usize| {
            let others = (first..first + 4).filter(|j| *j != i);
            values[i] * others.map(|j| (q - rows[j]) / (rows[i] - rows[j])).product::<f64>()
        };
        (first..first + 4).map(term).sum::<f64>().max(0.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_electrons_scatter_together_forwards_and_each_for_itself_at_large_q() {
        let mut cases = 0;
        for z in 1..=ELEMENT_COUNT {
            let (table, electrons) = (form_factors(z).expect("tabulated"), f64::from(z));
            assert!((table.form(0.0) / electrons - 1.0).abs() < 1e-3, "F(0) of {z} is {}", table.form(0.0));
            assert_eq!(table.incoherent(0.0), 0.0);
            assert!((table.incoherent(12.0) / electrons - 1.0).abs() < 0.15, "S(12) of {z} is {}", table.incoherent(12.0));
            assert!(table.form(12.0) < 0.03 * electrons, "F(12) of {z} is {}", table.form(12.0));
            cases += 1;
        }
        assert_eq!(cases, 92);
        assert!(form_factors(0).is_err() && form_factors(93).is_err());
    }

    /// Hydrogen's form factor has a closed form: (1 + (2π a₀ q)²)⁻² with q in 1/Å and a₀ = 0.529 Å; S = 1 − F². The tables' hydrogen is
    /// bound in a molecule, so the two agree loosely; a q that is off by 10 % disagrees more.
    #[test]
    fn hydrogen_follows_its_closed_form() {
        let table = form_factors(1).expect("tabulated");
        let closed = |q: f64| (1.0 + (2.0 * std::f64::consts::PI * 0.529_177 * q).powi(2)).powi(-2);
        let worst = |scale: f64| {
            (1..40).map(|n| 0.02 * f64::from(n)).map(|q| (table.form(q * scale) - closed(q)).abs()).fold(0.0, f64::max)
        };
        assert!(worst(1.0) < 0.5 * worst(1.2), "{} {}", worst(1.0), worst(1.2));
        for q in [0.1, 0.3, 0.7] {
            assert!((table.incoherent(q) - (1.0 - table.form(q).powi(2))).abs() < 0.02, "{q}");
        }
    }

    #[test]
    fn rows_are_met_and_between_them_the_curve_is_smooth() {
        let table = form_factors(8).expect("tabulated");
        assert_eq!(table.form(table.q_per_angstrom[7]), table.form[7]);
        let halfway = table.form(0.5 * (table.q_per_angstrom[7] + table.q_per_angstrom[8]));
        assert!(halfway < table.form[7] && halfway > table.form[8]);
    }
}
