//! What was made of a prior, and of all else that a registration looked at.

use glam::DVec3;
use nalgebra::{DMatrix, Matrix6};

use super::accept::rows_of;
use super::case::Case;
use super::explained::{Explained, ExplainedPrior, PriorUse};
use super::innovation::innovation_of;
use super::prior::Prior;
use super::record::TelemetryInnovation;
use super::settle::Settled;
use super::solve::{Options, about, solve};

impl Case<'_> {
    /// All of it; `found` is a match that was settled, with the covariance of its solution.
    pub(super) fn explained(&self, found: Option<(&Settled, &DMatrix<f64>)>) -> Explained {
        let prior = self.request.prior.map(|prior| self.prior_use(prior, found));
        Explained { prior, readings: self.heard.borrow().clone(), told: Vec::new() }
    }

    fn prior_use(&self, prior: &Prior, found: Option<(&Settled, &DMatrix<f64>)>) -> ExplainedPrior {
        let covariance = match prior.covariance {
            Some(rows) => Matrix6::from_fn(|i, j| rows[i][j]),
            None => self.gate(prior).information.try_inverse().unwrap_or_else(Matrix6::zeros),
        };
        let there = about(prior.camera_from_lps.transform_point(self.request.layout.centroid_lps_mm()));
        let at_beads = there * covariance * there.transpose();
        let sigma = |n: usize| at_beads[(n, n)].max(0.0).sqrt();
        let stated = Prior { covariance: Some(rows_of(&covariance)), ..*prior };
        let off = found.and_then(|(settled, own)| off_beads(settled, own, &stated));
        let length = |numbers: [f64; 3]| DVec3::from_array(numbers).length();
        ExplainedPrior {
            source: None,
            sigma_deg: [0, 1, 2].map(|n| sigma(n).to_degrees()),
            sigma_mm: [3, 4, 5].map(sigma),
            stated: prior.covariance.is_some(),
            used: match (self.without_prior, self.request.fuse) {
                (true, _) => PriorUse::LeftAside,
                (false, true) => PriorUse::Measurement,
                (false, false) => PriorUse::Gate,
            },
            innovation_sigmas: off.map(|off| off.chi2.sqrt()),
            angle_deg: off.map(|off| length(off.turn_deg)),
            shift_mm: off.map(|off| length(off.shift_mm)),
        }
    }
}

/// A prior against what the beads of a match alone give: solved again without it, where it counted as a measurement. `own` is the covariance of the
/// match's solution. `None` where they give nothing, or it cannot be told.
fn off_beads(settled: &Settled, own: &DMatrix<f64>, prior: &Prior) -> Option<TelemetryInnovation> {
    let alone = match settled.options.measured {
        None => None,
        Some(_) => {
            let options = Options { measured: None, ..settled.options };
            Some(solve(&settled.matches, &settled.solution.camera_from_lps, &settled.solution.intrinsics, &options)?)
        }
    };
    let solution = alone.as_ref().unwrap_or(&settled.solution);
    let covariance = alone.as_ref().map_or_else(|| own.clone(), |alone| &alone.covariance * settled.chi2_per_dof.max(1.0));
    let back = about(-solution.centroid_mm);
    let about_origin = back * Matrix6::from_fn(|i, j| covariance[(i, j)]) * back.transpose();
    let centroid_lps = solution.camera_from_lps.inverse().transform_point(solution.centroid_mm);
    let off = innovation_of(&solution.camera_from_lps, &rows_of(&about_origin), centroid_lps, prior)?;
    let is_told = off.chi2.is_finite() && off.chi2 >= 0.0 && off.turn_deg.iter().chain(&off.shift_mm).all(|x| x.is_finite());
    is_told.then_some(off)
}
