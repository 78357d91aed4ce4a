//! `sidecarm calibrate layout SHOTS…`: drawn phantoms are measured, and what is stated of them is true.

use rayon::prelude::*;
use sidecarm::calibrate::phantom::{Phantom, PhantomRefusal};

use crate::phantom_lab::{Compared, Lab};

/// A phantom against the truth, or why there is none.
type Run = Result<(Phantom, Compared), PhantomRefusal>;

fn one(lab: &Lab) -> Run {
    let phantom = lab.measured(&lab.all())?;
    let compared = Compared::new(&phantom, &lab.beads);
    Ok((phantom, compared))
}

/// Over many labs: rms shape error (median, 95 %, largest), rms pull of the shape, share of scales within their 95 %, rms pull of the
/// scale, median stated scale, beads found, refusals.
#[derive(Debug)]
struct Figures {
    shape_mm: [f64; 3],
    shape_pull: f64,
    scale_held: f64,
    scale_pull: f64,
    scale_sigma: f64,
    beads: usize,
    wrong: usize,
    refused: Vec<(u64, String)>,
}

fn figures(seeds: std::ops::Range<u64>, lab: impl Fn(u64) -> Lab + Sync) -> Figures {
    let runs: Vec<(u64, Run)> = seeds.into_par_iter().map(|seed| (seed, one(&lab(seed)))).collect();
    let refused = runs.iter().filter_map(|(seed, run)| Some((*seed, run.as_ref().err()?.to_string()))).collect();
    let good: Vec<&(Phantom, Compared)> = runs.iter().filter_map(|(_, run)| run.as_ref().ok()).collect();
    let mut shape: Vec<f64> = good.iter().map(|(_, compared)| compared.shape_mm).collect();
    shape.sort_by(f64::total_cmp);
    let at = |share: f64| shape[((shape.len() - 1) as f64 * share).round() as usize];
    let n = good.len() as f64;
    let rms = |of: &dyn Fn(&(Phantom, Compared)) -> f64| (good.iter().map(|one| of(one).powi(2)).sum::<f64>() / n).sqrt();
    let pull = |(phantom, compared): &(Phantom, Compared)| compared.larger_by / phantom.scale.sigma;
    let mut stated: Vec<f64> = good.iter().map(|(phantom, _)| phantom.scale.sigma).collect();
    stated.sort_by(f64::total_cmp);
    Figures {
        shape_mm: [at(0.5), at(0.95), at(1.0)],
        shape_pull: rms(&|(_, compared)| compared.shape_pull),
        scale_held: good.iter().filter(|one| pull(one).abs() <= 1.96).count() as f64 / n,
        scale_pull: rms(&pull),
        scale_sigma: stated[stated.len() / 2],
        beads: good.iter().map(|(phantom, _)| phantom.beads.len()).sum(),
        wrong: good.iter().filter(|(_, compared)| compared.shape_mm > 0.5).count(),
        refused,
    }
}

#[test]
fn ten_beads_are_measured_to_a_tenth_of_a_millimetre() {
    let figures = figures(0..24, Lab::new);
    let Figures { shape_mm, shape_pull, scale_held, scale_pull, scale_sigma, beads, wrong, refused } = figures;
    assert!(refused.is_empty(), "{refused:?}");
    assert!(shape_mm[2] <= 0.1 && wrong == 0, "{shape_mm:?}");
    assert!((0.85..=1.15).contains(&shape_pull), "{shape_pull}");
    assert!(scale_held >= 0.8 && scale_pull < 1.5 && scale_sigma < 0.004, "{scale_held} {scale_pull} {scale_sigma}");
    assert!(beads >= 220, "{beads}");
}

#[test]
#[ignore = "minutes long: scripts/evaluate layout runs it"]
fn many_phantoms() {
    let count = std::env::var("SIDECARM_PHANTOMS").ok().and_then(|n| n.parse().ok()).unwrap_or(200);
    let figures = figures(0..count, Lab::new);
    println!("{count} phantoms, encoders ±0.2° ±1 mm: {figures:.3?}");
    let Figures { shape_mm, shape_pull, scale_held, scale_sigma, wrong, refused, .. } = figures;
    // No number is a target of its own. Reached over two hundred: none refused or wrong, shape to 0.008 mm (largest 0.020), its standard
    // deviations true to 0.98, scale stated to 0.2 % and within its 95 % in 97 %.
    assert!(wrong == 0 && refused.len() as u64 * 100 <= count, "{wrong} wrong, {refused:?}");
    assert!(shape_mm[0] <= 0.012 && shape_mm[2] <= 0.04, "{shape_mm:?} mm");
    assert!((0.9..=1.1).contains(&shape_pull), "{shape_pull}");
    assert!(scale_held >= 0.92 && scale_sigma <= 0.003, "{scale_held} held, {scale_sigma}");
}
