//! Beads that have migrated, and shadows that are not a bead's own.
//!
//! Leaving out an observation that does not belong lowers Σχ² by its left-out χ². So does leaving out a bead's place in the layout, when
//! the bead is elsewhere: that is what all its shadows say. The most surprising of both kinds goes first, and everything is solved again.

use super::setup::{Blocks, Setup, scale_of, solved};
use crate::estimate::{Covariance, Estimate, EstimateError, median};
use crate::pose::together::record::BeadVerdict;

/// Left-out χ² of a shadow (two degrees of freedom) and of a place in the layout (three) beyond which it does not belong: 4 in 10⁶ each.
const SHADOW: f64 = 25.0;
const PLACE: f64 = 27.6;
/// Two explanations of one bead that differ by less than this in χ² are not told apart.
const TOLD_APART: f64 = 9.0;
/// Median of χ² with two degrees of freedom.
const MEDIAN: f64 = 1.386;

/// What one explanation would take away.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Stray {
    /// Index of the observation.
    Shadow(usize),
    /// Index of the bead.
    Place(usize),
}

/// An observation that was left out, and how far off it was, px.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LeftAside {
    pub view: usize,
    pub bead: usize,
    pub off_px: f64,
}

/// What was made of the beads.
#[derive(Clone, Debug)]
pub struct Sorted {
    pub verdicts: Vec<Option<BeadVerdict>>,
    pub aside: Vec<LeftAside>,
}

/// Left-out χ² of a residual; 0 where the others do not predict it.
fn left_out(estimate: &Estimate, covariance: &Covariance, residual: usize) -> f64 {
    estimate.left_out_linear(covariance, residual).map_or(0.0, |left| left.chi2)
}

/// Frees and leaves out until nothing surprises; `setup` is left where it ended.
pub fn sort(setup: &mut Setup) -> Result<Sorted, EstimateError> {
    let mut sorted = Sorted { verdicts: vec![None; setup.layout.beads.len()], aside: Vec::new() };
    for _ in 0..setup.observations.len() {
        let (problem, blocks) = setup.problem();
        let (estimate, covariance) = solved(&problem)?;
        setup.take(&estimate, &blocks);
        let Some(step) = next(setup, &blocks, &estimate, &covariance, &sorted) else { break };
        let off_px = |n: usize| estimate.offset(blocks.images[n]).iter().map(|x| x * x).sum::<f64>().sqrt();
        let mut leave = |setup: &mut Setup, which: &dyn Fn(usize) -> bool| {
            let gone: Vec<usize> = (0..setup.observations.len()).filter(|n| which(*n)).collect();
            sorted.aside.extend(gone.iter().map(|n| {
                let o = setup.observations[*n];
                LeftAside { view: o.view, bead: o.bead, off_px: off_px(*n) }
            }));
            let mut n = 0;
            setup.observations.retain(|_| {
                n += 1;
                !gone.contains(&(n - 1))
            });
        };
        match step {
            Step::Leave(Stray::Shadow(n)) => {
                let bead = setup.observations[n].bead;
                // Of a bead that is nowhere else known, one view says nothing.
                let lost = setup.freed[bead] && setup.seen_in(bead).count() <= 2;
                let of_bead: Vec<bool> = setup.observations.iter().map(|o| o.bead == bead).collect();
                leave(setup, &|other| other == n || (lost && of_bead[other]));
                if lost {
                    sorted.verdicts[bead] = Some(BeadVerdict::Inconsistent);
                }
            }
            Step::Leave(Stray::Place(bead)) => {
                setup.freed[bead] = true;
                sorted.verdicts[bead] = Some(BeadVerdict::Migrated);
            }
            Step::Unclear(bead) => {
                let of_bead: Vec<bool> = setup.observations.iter().map(|o| o.bead == bead).collect();
                leave(setup, &|n| of_bead[n]);
                sorted.verdicts[bead] = Some(BeadVerdict::Unclear);
            }
        }
    }
    Ok(sorted)
}

enum Step {
    Leave(Stray),
    Unclear(usize),
}

fn next(setup: &Setup, blocks: &Blocks, estimate: &Estimate, covariance: &Covariance, sorted: &Sorted) -> Option<Step> {
    let shadows: Vec<f64> = blocks.images.iter().map(|residual| left_out(estimate, covariance, *residual)).collect();
    let places: Vec<f64> =
        blocks.priors.iter().map(|residual| residual.map_or(0.0, |residual| left_out(estimate, covariance, residual))).collect();
    // Most shadows belong: where half of them are worse than stated, so are all.
    let scale = (median(shadows.iter().copied()).unwrap_or(0.0) / MEDIAN).max(1.0);
    let all = shadows.iter().enumerate().map(|(n, chi2)| (Stray::Shadow(n), *chi2, chi2 / SHADOW));
    let all = all.chain(places.iter().enumerate().map(|(n, chi2)| (Stray::Place(n), *chi2, chi2 / PLACE)));
    let (worst, chi2, times) = all.max_by(|a, b| a.2.total_cmp(&b.2))?;
    if !(times > scale) {
        return None;
    }
    let bead = match worst {
        Stray::Shadow(n) => setup.observations[n].bead,
        Stray::Place(bead) => bead,
    };
    let of_bead = setup.observations.iter().zip(&shadows).filter(|(o, _)| o.bead == bead).map(|(_, chi2)| *chi2);
    let other = match worst {
        Stray::Shadow(_) => places[bead],
        Stray::Place(_) => of_bead.fold(0.0, f64::max),
    };
    // One view alone never tells a bead that moved from a shadow that is off; a shadow that is left out claims less.
    let alone = setup.seen_in(bead).count() < 2;
    let unclear = !alone && chi2 - other < TOLD_APART * scale.max(scale_of(estimate)) && sorted.verdicts[bead].is_none();
    Some(if unclear { Step::Unclear(bead) } else { Step::Leave(worst) })
}
