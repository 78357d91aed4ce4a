//! What does not belong to the others is left out, the worst first: shadows, beads, shots.

use glam::DVec3;

use super::adjust::{Adjustment, Blocks, solved};
use super::gauge::{sigma_mm, spread, worst_mm};
use super::grow::FEWEST_SHOTS;
use super::refusal::PhantomRefusal;
use super::scale::Measured;
use super::shot::{CameraErrors, PhantomShot};
use super::structure::Structure;
use crate::estimate::{Covariance, Estimate, EstimateError, median};

/// χ² of a shadow that the others do not predict, of two numbers.
const STRAY: f64 = 30.0;
/// χ² of a camera that its rough place contradicts, of six numbers.
const ELSEWHERE: f64 = 60.0;
/// Median of χ² of two numbers.
const MEDIAN: f64 = 1.386;
/// A bead so many times worse known than most is left out.
const WORSE: f64 = 6.0;
const WORSE_MM: f64 = 0.3;
/// Shadows that miss a point by so many times what most beads' do, and by so much, are not those of a ball: the end of a rod has no
/// centre that all views share.
const MISSED: f64 = 8.0;
const MISSED_PX: f64 = 0.3;

/// What is left, and what was left out.
#[derive(Clone, Debug)]
pub(super) struct Pruned {
    pub structure: Structure,
    /// √mean(dx² + dy²) of its shadows, K as solved, px.
    pub rms_px: f64,
    /// Shots that their rough cameras contradict, and by how many standard deviations.
    pub shots: Vec<(usize, f64)>,
    /// Where beads were that are left out, in how many shots, and why.
    pub beads: Vec<(DVec3, usize, &'static str)>,
}

pub(super) fn unsolved(error: EstimateError) -> PhantomRefusal {
    PhantomRefusal::Unsolved { detail: error.to_string() }
}

/// Leaves out, the worst first, until all that is left agrees.
pub(super) fn pruned(shots: &[PhantomShot], structure: Structure, errors: CameraErrors) -> Result<Pruned, PhantomRefusal> {
    let mut left = Pruned { structure, rms_px: f64::INFINITY, shots: Vec::new(), beads: Vec::new() };
    loop {
        if left.structure.points.len() < 4 || left.structure.shots().count() < FEWEST_SHOTS {
            return Ok(left);
        }
        let structure = left.structure.clone();
        let (problem, blocks) = Adjustment { errors, ..Adjustment::plain(shots, &structure) }.problem();
        let (estimate, covariance) = solved(&problem).map_err(unsolved)?;
        let mut next = blocks.taken(&structure, &estimate);
        let elsewhere = worst_camera(&blocks, &estimate);
        if let Some((bead, shot)) = worst_shadow(&blocks, &estimate, &covariance) {
            next.tracks[bead][shot] = None;
        } else if let Some((shot, chi2)) = elsewhere {
            next.without_shot(shot);
            left.shots.push((shot, (chi2 / 6.0).sqrt()));
        } else if let Some(bead) = worst_bead(&blocks, &next, &covariance) {
            let shots = next.shadows_of(bead).count();
            left.beads.push((next.points[bead], shots, "its beams are too much alike"));
            next.tracks[bead].fill(None);
        } else if let Some(bead) = worst_fitting(&blocks, &estimate, next.points.len()) {
            let shots = next.shadows_of(bead).count();
            left.beads.push((next.points[bead], shots, "its shadows are not those of one point: is it a ball?"));
            next.tracks[bead].fill(None);
        } else {
            let squares: f64 = blocks.images.iter().flat_map(|(.., n)| estimate.offset(*n)).map(|px| px * px).sum();
            left.rms_px = (squares / blocks.images.len().max(1) as f64).sqrt();
            left.structure = next;
            return Ok(left);
        }
        let rare = next.drop_rare(FEWEST_SHOTS).into_iter().filter(|(_, shots)| *shots > 0);
        left.beads.extend(rare.map(|(at, shots)| (at, shots, "too few shots show it where the others have it")));
        left.structure = next;
    }
}

/// The shadow that the others predict worst: bead and shot.
fn worst_shadow(blocks: &Blocks, estimate: &Estimate, covariance: &Covariance) -> Option<(usize, usize)> {
    let off = |residual: usize| estimate.left_out_linear(covariance, residual).map_or(0.0, |left| left.chi2);
    let all: Vec<(f64, usize, usize)> = blocks.images.iter().map(|(bead, shot, n)| (off(*n), *bead, *shot)).collect();
    let usual = (median(all.iter().map(|(chi2, ..)| *chi2)).unwrap_or(0.0) / MEDIAN).max(1.0);
    let worst = all.into_iter().max_by(|a, b| a.0.total_cmp(&b.0))?;
    (worst.0 > STRAY * usual).then_some((worst.1, worst.2))
}

/// The shot whose rough camera is contradicted most, and its χ².
fn worst_camera(blocks: &Blocks, estimate: &Estimate) -> Option<(usize, f64)> {
    let own = blocks.priors.iter().enumerate().filter_map(|(shot, prior)| Some((shot, estimate.chi2((*prior)?))));
    own.max_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, chi2)| *chi2 > ELSEWHERE)
}

/// The bead that is known far worse than most.
fn worst_bead(blocks: &Blocks, structure: &Structure, covariance: &Covariance) -> Option<usize> {
    let ids: Vec<_> = blocks.points.iter().map(crate::estimate::VectorBlock::id).collect();
    let shape = spread(&structure.points, &covariance.of(&ids)).shape;
    let usual = median(shape.iter().map(sigma_mm)).unwrap_or(0.0);
    let worst = (0..shape.len()).max_by(|a, b| worst_mm(&shape[*a]).total_cmp(&worst_mm(&shape[*b])))?;
    (worst_mm(&shape[worst]) > (WORSE * usual).max(WORSE_MM)).then_some(worst)
}

/// The bead whose shadows miss it by far more than most beads' do.
fn worst_fitting(blocks: &Blocks, estimate: &Estimate, beads: usize) -> Option<usize> {
    let mut squares = vec![(0.0, 0usize); beads];
    for (bead, _, n) in &blocks.images {
        squares[*bead].0 += estimate.offset(*n).iter().map(|px| px * px).sum::<f64>();
        squares[*bead].1 += 1;
    }
    let rms: Vec<f64> = squares.into_iter().map(|(sum, count)| (sum / count.max(1) as f64).sqrt()).collect();
    let usual = median(rms.iter().copied()).unwrap_or(0.0);
    let worst = (0..beads).max_by(|a, b| rms[*a].total_cmp(&rms[*b]))?;
    (rms[worst] > (MISSED * usual).max(MISSED_PX)).then_some(worst)
}

/// The whole problem once more, with evidence of the size.
pub(super) fn whole<'a>(
    shots: &'a [PhantomShot],
    structure: &'a Structure,
    errors: CameraErrors,
    measured: Measured,
) -> Adjustment<'a> {
    Adjustment { errors, measured, ..Adjustment::plain(shots, structure) }
}
