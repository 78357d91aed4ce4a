//! The input, checked and normalised.

use super::asked::{EnergyBins, MOST_MATERIALS, QuadratureError, Region};
use super::mixture::{Mixture, SUMS};
use super::paths::Reach;

/// The checked input: normalised, without empty bins, and only the materials that can lie in the beam.
pub(super) struct Bins<'a> {
    pub source: &'a EnergyBins<'a>,
    pub mixture: Mixture,
    pub reach: Reach,
    /// What each sum's weights added up to.
    pub totals: [f64; SUMS],
    /// How many of the sums are asked for.
    pub sums: usize,
    /// Indices of the materials that can lie in the beam.
    pub active: Vec<usize>,
    /// Smallest and largest ln cm²/g of each active material.
    pub ln_bounds: Vec<(f64, f64)>,
}

impl<'a> Bins<'a> {
    pub fn new(source: &'a EnergyBins<'a>, region: &Region) -> Result<Self, QuadratureError> {
        let bins = source.energies_kev.len();
        let materials = source.cm2_per_g.len();
        if materials > MOST_MATERIALS {
            return Err(QuadratureError::Materials { found: materials });
        }
        check("energies", source.energies_kev, bins)?;
        check("largest area densities", region.largest_g_per_cm2, materials)?;
        if let Some(limit) = region.largest_line_integral {
            check("largest line integral", &[limit], 1)?;
        }
        for attenuation in source.cm2_per_g {
            check("mass attenuation", attenuation, bins)?;
        }
        let mut sums = vec![("signal weights", source.signal_weights)];
        if let Some(noise) = source.noise_weights {
            sums.extend([("photon weights", noise.photons), ("square weights", noise.squares)]);
        }
        let mut totals = [0.0; SUMS];
        for (total, (what, weights)) in totals.iter_mut().zip(&sums) {
            check(what, weights, bins)?;
            *total = weights.iter().sum();
            if !(*total > 0.0 && total.is_finite()) {
                return Err(QuadratureError::Empty { what, sum: *total });
            }
        }
        let active: Vec<usize> = (0..materials).filter(|m| region.largest_g_per_cm2[*m] > 0.0).collect();
        let kept: Vec<usize> = (0..bins).filter(|k| sums.iter().any(|(_, weights)| weights[*k] > 0.0)).collect();
        let weights_of = |k: &usize| {
            let mut all = [0.0; SUMS];
            for ((weight, (_, weights)), total) in all.iter_mut().zip(&sums).zip(&totals) {
                *weight = weights[*k] / total;
            }
            all
        };
        let mixture = Mixture {
            materials: active.len(),
            weights: kept.iter().map(weights_of).collect(),
            cm2_per_g: kept.iter().flat_map(|k| active.iter().map(|m| source.cm2_per_g[*m][*k])).collect(),
        }
        .without_negligible();
        let ln_bounds = (0..active.len())
            .map(|m| {
                let logs = (0..mixture.terms()).map(|k| mixture.attenuation(k)[m].max(1e-12).ln());
                logs.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), b| (low.min(b), high.max(b)))
            })
            .collect();
        let largest: Vec<f64> = active.iter().map(|m| region.largest_g_per_cm2[*m]).collect();
        let reach = Reach::new(&mixture, largest, region.largest_line_integral);
        Ok(Self { source, mixture, reach, totals, sums: sums.len(), active, ln_bounds })
    }
}

fn check(what: &'static str, values: &[f64], expected: usize) -> Result<(), QuadratureError> {
    if values.len() != expected {
        return Err(QuadratureError::Length { what, found: values.len(), expected });
    }
    match values.iter().position(|value| !(*value >= 0.0 && value.is_finite())) {
        Some(index) => Err(QuadratureError::Value { what, index, found: values[index] }),
        None => Ok(()),
    }
}
