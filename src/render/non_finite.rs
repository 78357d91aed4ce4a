//! Counts of NaN and infinity per pass, for `--count-non-finite`; what the shaders computed is counted as it is read back.

use super::cpu::attenuate_spectrum::Signal;
use super::cpu::integrate_density::Density;

/// Values that are not finite, by the pass that made them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct NonFinite {
    /// Area densities.
    pub integrate_density: u64,
    /// Line integrals and moments of what arrives.
    pub attenuate_spectrum: u64,
    /// Poisson deviates, and the noise made of them.
    pub add_noise: u64,
    /// Values of the pages.
    pub detect: u64,
}

impl NonFinite {
    /// Counts in what an executor gave back.
    #[must_use]
    pub fn of(density: &Density, signal: &Signal, deviates: &[f32]) -> Self {
        Self {
            integrate_density: count(&density.g_per_cm2),
            attenuate_spectrum: count_signal(signal),
            add_noise: count(deviates),
            detect: 0,
        }
    }

    /// All passes together.
    #[must_use]
    pub fn total(&self) -> u64 {
        self.integrate_density + self.attenuate_spectrum + self.add_noise + self.detect
    }
}

/// NaN and infinities in line integrals and moments.
#[must_use]
pub fn count_signal(signal: &Signal) -> u64 {
    let moments = signal.arriving.iter().flat_map(|a| [a.photon_fraction, a.mean_response, a.mean_square_response]);
    count(&signal.line_integral) + moments.filter(|value| !value.is_finite()).count() as u64
}

/// NaN and infinities in `values`.
#[must_use]
pub fn count(values: &[f32]) -> u64 {
    values.iter().filter(|value| !value.is_finite()).count() as u64
}
