//! Attenuation, materials and spectra, from tables embedded in the binary (`calibration/materials`, `calibration/spectra`).

mod elements;
mod form_factors;
mod formula;
mod materials;
mod spectrum;
mod spectrum_file;

pub use elements::{Coefficients, ELEMENT_COUNT, ENERGY_RANGE_KEV, element_attenuation, symbol, z_of};
pub use form_factors::{FormFactors, form_factors};
pub use formula::atomic_weight;
pub use materials::{Material, material_names, materials};
pub use spectrum::{ANODE_ANGLES_DEG, Bin, KVP_RANGE, Spectrum};

/// Why a physical quantity is not known.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PhysicsError {
    /// The energy is outside the tables.
    #[error("energy {energy_kev} keV is outside the tables ({from_kev} to {to_kev} keV)")]
    Energy {
        /// Asked for.
        energy_kev: f64,
        /// First of the tables.
        from_kev: f64,
        /// Last of the tables.
        to_kev: f64,
    },
    /// Neither a known material nor a formula.
    #[error(
        "material '{name}' is not known{suggestion}; use a name of the materials table, a formula (H2O) or mass fractions (Ti:0.9,Al:0.1)"
    )]
    Unknown {
        /// What was asked for.
        name: String,
        /// `, did you mean …` or nothing.
        suggestion: String,
    },
    /// A formula cannot be read.
    #[error("formula '{formula}': {detail}")]
    Formula {
        /// The formula.
        formula: String,
        /// What is wrong.
        detail: String,
    },
    /// Mass fractions do not add up.
    #[error("mass fractions of '{name}' add up to {sum}, expected 1 within 1 %")]
    Fractions {
        /// The mixture.
        name: String,
        /// What they add up to.
        sum: f64,
    },
    /// The material has no nominal density.
    #[error("material '{name}' has no nominal density, {remedy}")]
    NoDensity {
        /// The material.
        name: String,
        /// What can be done where it is named.
        remedy: &'static str,
    },
    /// The tube voltage is outside the tables.
    #[error("tube voltage {kvp} kV is outside the spectra ({from_kvp} to {to_kvp} kV)")]
    TubeVoltage {
        /// Asked for.
        kvp: f64,
        /// Lowest.
        from_kvp: f64,
        /// Highest.
        to_kvp: f64,
    },
    /// The anode angle is outside the tables.
    #[error("anode angle {angle_deg} deg is outside the spectra ({from_deg} to {to_deg} deg)")]
    AnodeAngle {
        /// Asked for.
        angle_deg: f64,
        /// Smallest.
        from_deg: f64,
        /// Largest.
        to_deg: f64,
    },
    /// A filter of negative or unknown thickness.
    #[error("filter of {material} is {thickness_mm} mm thick, expected 0 or more")]
    Filter {
        /// Material.
        material: String,
        /// Thickness.
        thickness_mm: f64,
    },
    /// A spectrum file is wrong.
    #[error("spectrum {path}: {detail}")]
    SpectrumFile {
        /// The file.
        path: String,
        /// Which row, and what is wrong there.
        detail: String,
    },
    /// Nothing comes through.
    #[error("the spectrum is empty: nothing passes the filters")]
    Empty,
}
