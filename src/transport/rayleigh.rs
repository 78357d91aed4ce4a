//! Rayleigh scattering: the angle by Thomson's formula times the squared form factor of the material's atoms, each for itself.
//!
//! Per solid angle ∝ (1 + c²)/2 · F²(x) with x = E/(12.398 keV Å) · √((1 − c)/2). dc is proportional to d(x²), so F² is drawn over x² from its
//! cumulative, which does not depend on the energy but for its end, and (1 + c²)/2 by rejection.

use super::compton::KEV_ANGSTROM;
use super::stream::Stream;
use crate::scene::physics::{ENERGY_RANGE_KEV, Material, PhysicsError, atomic_weight, form_factors};

/// Steps of x per 1/Å; within one F² is taken as its mean.
pub(super) const STEPS_PER_UNIT_X: f64 = 200.0;

/// Entries of the table that finds a step by its share of the cumulative.
pub(super) const GUIDES: usize = 2048;

/// Rows of the normalisation per keV.
pub(super) const NORMS_PER_KEV: f64 = 4.0;

/// Rayleigh scattering in one material.
#[derive(Clone, Debug)]
pub struct Rayleigh {
    /// Mean of F² over each step, per unit of the mixture's mass.
    pub(super) squares: Vec<f64>,
    /// ∫F² d(x²) up to each step.
    pub(super) below: Vec<f64>,
    /// The step in which the cumulative passes n/GUIDES of its end.
    pub(super) guides: Vec<u32>,
    /// ∫ over all directions.
    pub(super) norms: Vec<f64>,
}

impl Rayleigh {
    /// Tabulates `material`.
    ///
    /// # Errors
    /// When an element is not in the tables.
    pub fn new(material: &Material) -> Result<Self, PhysicsError> {
        let steps = (ENERGY_RANGE_KEV.1 / KEV_ANGSTROM * STEPS_PER_UNIT_X).ceil() as usize + 1;
        // Values at the ends and in the middle of every step.
        let mut values = vec![0.0; 2 * steps + 1];
        for (z, fraction) in &material.composition {
            let table = form_factors(*z)?;
            let atoms = fraction / atomic_weight(*z).unwrap_or(f64::INFINITY);
            for (n, sum) in values.iter_mut().enumerate() {
                *sum += atoms * table.form(0.5 * n as f64 / STEPS_PER_UNIT_X).powi(2);
            }
        }
        let (mut squares, mut below) = (Vec::with_capacity(steps), vec![0.0]);
        for step in 0..steps {
            // Simpson's rule over x² = t: the middle of the step in x weighs by dt = 2x dx.
            let x = |half: usize| 0.5 * (2 * step + half) as f64 / STEPS_PER_UNIT_X;
            let sum: f64 = [1.0, 4.0, 1.0].iter().enumerate().map(|(n, w)| w * values[2 * step + n] * 2.0 * x(n)).sum();
            let (integral, width) = (sum / (6.0 * STEPS_PER_UNIT_X), x(2).powi(2) - x(0).powi(2));
            squares.push(integral / width);
            below.push(below[step] + integral);
        }
        let end = below[steps];
        let guide = |n: usize| below.partition_point(|sum| *sum <= end * n as f64 / GUIDES as f64) as u32 - 1;
        let guides = (0..GUIDES).map(guide).collect();
        let mut rayleigh = Self { squares, below, guides, norms: Vec::new() };
        let (first_kev, last_kev) = ENERGY_RANGE_KEV;
        let norms = ((last_kev - first_kev) * NORMS_PER_KEV) as usize + 2;
        rayleigh.norms = (0..norms).map(|n| rayleigh.integral((first_kev + n as f64 / NORMS_PER_KEV).min(last_kev))).collect();
        Ok(rayleigh)
    }

    /// ∫ (1 + c²)/2 F² dΩ, step by step with c² at the step's middle: c = 1 − 2t/T, T = (E/12.398)², dΩ = 4π dt/T.
    fn integral(&self, energy_kev: f64) -> f64 {
        let end = (energy_kev / KEV_ANGSTROM).powi(2);
        let edge = |step: usize| (step as f64 / STEPS_PER_UNIT_X).powi(2).min(end);
        let term = |(step, square): (usize, &f64)| {
            let (from, to) = (edge(step), edge(step + 1));
            let cosine = 1.0 - (from + to) / end;
            square * (to - from) * 0.5 * (1.0 + cosine * cosine)
        };
        4.0 * std::f64::consts::PI / end * self.squares.iter().enumerate().map(term).sum::<f64>()
    }

    /// Probability per solid angle of scattering by an angle of this cosine.
    #[inline]
    #[must_use]
    pub fn density(&self, energy_kev: f64, cosine: f64) -> f64 {
        let x = energy_kev / KEV_ANGSTROM * (0.5 * (1.0 - cosine)).max(0.0).sqrt();
        let square = self.squares[((x * STEPS_PER_UNIT_X) as usize).min(self.squares.len() - 1)];
        let position = ((energy_kev - ENERGY_RANGE_KEV.0) * NORMS_PER_KEV).max(0.0);
        let row = (position as usize).min(self.norms.len() - 2);
        let norm = self.norms[row] + (self.norms[row + 1] - self.norms[row]) * (position - row as f64);
        0.5 * (1.0 + cosine * cosine) * square / norm
    }

    /// Draws the cosine of an angle.
    #[inline]
    pub fn cosine(&self, energy_kev: f64, stream: &mut Stream) -> f64 {
        let end = (energy_kev / KEV_ANGSTROM).powi(2);
        let last = ((energy_kev / KEV_ANGSTROM * STEPS_PER_UNIT_X) as usize).min(self.squares.len() - 1);
        let edge = |step: usize| (step as f64 / STEPS_PER_UNIT_X).powi(2);
        let most = self.below[last] + self.squares[last] * (end - edge(last));
        let per_guide = GUIDES as f64 / self.below[self.below.len() - 1];
        loop {
            let wanted = stream.uniform() * most;
            let mut step = self.guides[((wanted * per_guide) as usize).min(GUIDES - 1)] as usize;
            while step < last && self.below[step + 1] <= wanted {
                step += 1;
            }
            let squared = edge(step) + (wanted - self.below[step]) / self.squares[step];
            let cosine = (1.0 - 2.0 * squared / end).clamp(-1.0, 1.0);
            if 2.0 * stream.uniform() < 1.0 + cosine * cosine {
                return cosine;
            }
        }
    }

    /// Cross section per gram, cm²/g: what the tables' Rayleigh attenuation should be.
    #[must_use]
    pub fn cm2_per_g(&self, energy_kev: f64) -> f64 {
        // r_e² with r_e = 2.8179403e-13 cm; Avogadro's number turns atoms per u into atoms per gram.
        2.817_940_3e-13_f64.powi(2) * 6.022_140_76e23 * self.integral(energy_kev)
    }
}
