//! Compton scattering: the angle by Klein and Nishina's formula times the incoherent function of the material's atoms.
//!
//! With α = E/511 keV and ε = 1/(1 + α(1 − c)), c = cos θ, the cross section per solid angle is ∝ ε²(ε + 1/ε + c² − 1) · S(x),
//! x = E/(12.398 keV Å) · √((1 − c)/2), S of the mixture: Σ wᵢ/Aᵢ Sᵢ. The scattered photon has the energy εE; the electron's motion in
//! its atom (Doppler broadening) is left out.

use super::alias::Alias;
use super::stream::Stream;
use crate::scene::physics::{ENERGY_RANGE_KEV, Material, PhysicsError, atomic_weight, form_factors};

/// Rest energy of the electron.
pub const ELECTRON_KEV: f64 = 510.998_95;

/// h·c: a photon of E keV has a wavelength of 12.398/E Å.
pub const KEV_ANGSTROM: f64 = 12.398_419_8;

/// Rows of S per 1/Å: linear between them.
pub(super) const ROWS_PER_UNIT_X: f64 = 80.0;

/// Boxes of the envelope along the energy and along the cosine.
pub(super) const ENVELOPE_KEV: f64 = 2.0;
pub(super) const ENVELOPE_COSINES: usize = 32;

/// Rows of the normalisation per keV.
pub(super) const NORMS_PER_KEV: f64 = 4.0;

/// One energy box of the envelope: a bound of the cross section in each box of cosines, and how to draw a box by it.
#[derive(Clone, Debug)]
pub(super) struct Envelope {
    pub(super) bounds: [f64; ENVELOPE_COSINES],
    pub(super) boxes: Alias,
}

/// Compton scattering in one material.
#[derive(Clone, Debug)]
pub struct Compton {
    /// S over the electrons of the mixture: from 0 to 1.
    pub(super) incoherent: Vec<f64>,
    pub(super) envelopes: Vec<Envelope>,
    /// ∫ over all directions.
    pub(super) norms: Vec<f64>,
}

impl Compton {
    /// Tabulates `material`.
    ///
    /// # Errors
    /// When an element is not in the tables.
    pub fn new(material: &Material) -> Result<Self, PhysicsError> {
        let last_x = ENERGY_RANGE_KEV.1 / KEV_ANGSTROM;
        let mut incoherent = vec![0.0; (last_x * ROWS_PER_UNIT_X) as usize + 3];
        let mut electrons = 0.0;
        for (z, fraction) in &material.composition {
            let table = form_factors(*z)?;
            let atoms = fraction / atomic_weight(*z).unwrap_or(f64::INFINITY);
            electrons += atoms * f64::from(*z);
            for (row, sum) in incoherent.iter_mut().enumerate() {
                *sum += atoms * table.incoherent(row as f64 / ROWS_PER_UNIT_X);
            }
        }
        incoherent.iter_mut().for_each(|sum| *sum /= electrons);
        let mut compton = Self { incoherent, envelopes: Vec::new(), norms: Vec::new() };
        let (first_kev, last_kev) = ENERGY_RANGE_KEV;
        let boxes = ((last_kev - first_kev) / ENVELOPE_KEV).ceil() as usize;
        compton.envelopes = (0..boxes).map(|n| compton.envelope(first_kev + n as f64 * ENVELOPE_KEV)).collect();
        let norms = ((last_kev - first_kev) * NORMS_PER_KEV) as usize + 2;
        compton.norms = (0..norms).map(|n| compton.integral(first_kev + n as f64 / NORMS_PER_KEV)).collect();
        Ok(compton)
    }

    /// Bounds over energies from `from_kev`: the largest of samples, and 2 % for what lies between them.
    fn envelope(&self, from_kev: f64) -> Envelope {
        let width = 2.0 / ENVELOPE_COSINES as f64;
        let bounds = std::array::from_fn(|n| {
            let samples = (0..=8).flat_map(|i| (0..=16).map(move |j| (f64::from(i) / 8.0, f64::from(j) / 16.0)));
            let value = |(i, j): (f64, f64)| {
                let energy_kev = (from_kev + i * ENVELOPE_KEV).min(ENERGY_RANGE_KEV.1);
                self.shape(energy_kev, -1.0 + width * (n as f64 + j))
            };
            1.02 * samples.map(value).fold(0.0, f64::max)
        });
        Envelope { bounds, boxes: Alias::new(&bounds) }
    }

    /// ∫ shape dΩ by Simpson's rule in √(1 − c), in which S is smooth.
    fn integral(&self, energy_kev: f64) -> f64 {
        let count = 400;
        let step = 2f64.sqrt() / f64::from(count);
        let term = |n: i32| {
            let root = f64::from(n) * step;
            let weight = if n == 0 || n == count {
                1.0
            } else if n % 2 == 1 {
                4.0
            } else {
                2.0
            };
            weight * self.shape(energy_kev, 1.0 - root * root) * 2.0 * root
        };
        std::f64::consts::TAU * step / 3.0 * (0..=count).map(term).sum::<f64>()
    }

    /// ε²(ε + 1/ε + c² − 1) · S: the cross section per solid angle and electron, in units of r_e²/2.
    #[inline]
    fn shape(&self, energy_kev: f64, cosine: f64) -> f64 {
        let ratio = energy_ratio(energy_kev, cosine);
        let position = energy_kev / KEV_ANGSTROM * (0.5 * (1.0 - cosine)).max(0.0).sqrt() * ROWS_PER_UNIT_X;
        let row = (position as usize).min(self.incoherent.len() - 2);
        let (low, high) = (self.incoherent[row], self.incoherent[row + 1]);
        let bound = low + (high - low) * (position - row as f64);
        ratio * (ratio * ratio + 1.0 + (cosine * cosine - 1.0) * ratio) * bound
    }

    /// Probability per solid angle of scattering by an angle of this cosine.
    #[inline]
    #[must_use]
    pub fn density(&self, energy_kev: f64, cosine: f64) -> f64 {
        let position = ((energy_kev - ENERGY_RANGE_KEV.0) * NORMS_PER_KEV).max(0.0);
        let row = (position as usize).min(self.norms.len() - 2);
        let norm = self.norms[row] + (self.norms[row + 1] - self.norms[row]) * (position - row as f64);
        self.shape(energy_kev, cosine) / norm
    }

    /// Draws the cosine of an angle: a box by the envelope, a place in it, and whether the curve is above that place.
    #[inline]
    pub fn cosine(&self, energy_kev: f64, stream: &mut Stream) -> f64 {
        let row = ((energy_kev - ENERGY_RANGE_KEV.0) / ENVELOPE_KEV).max(0.0) as usize;
        let envelope = &self.envelopes[row.min(self.envelopes.len() - 1)];
        loop {
            let n = envelope.boxes.draw(stream);
            let cosine = -1.0 + (n as f64 + stream.uniform()) * (2.0 / ENVELOPE_COSINES as f64);
            let shape = self.shape(energy_kev, cosine);
            debug_assert!(shape <= envelope.bounds[n], "{energy_kev} keV, cosine {cosine}");
            if stream.uniform() * envelope.bounds[n] < shape {
                return cosine;
            }
        }
    }

    /// Cross section per electron, barn: what the tables' Compton attenuation should be.
    #[must_use]
    pub fn barn_per_electron(&self, energy_kev: f64) -> f64 {
        // r_e²/2 with r_e = 2.8179403 fm; 1 barn = 100 fm².
        0.5 * 2.817_940_3_f64.powi(2) / 100.0 * self.integral(energy_kev)
    }
}

/// What a photon scattered by a free electron at rest keeps of its energy.
#[inline]
#[must_use]
pub fn energy_ratio(energy_kev: f64, cosine: f64) -> f64 {
    1.0 / (1.0 + energy_kev / ELECTRON_KEV * (1.0 - cosine))
}
