//! How wrong nodes are: on given paths, and on those that a climb from the worst of them finds.

use super::bins::Bins;
use super::mixture::{Mixture, SUMS, worst};
use super::paths::Paths;

/// Climbs start from this many of the worst paths, and from the worst of each of so many runs of paths, which are other hills.
const HIGHEST: usize = 8;
const RUNS: usize = 16;

/// First step of a climb, as a part of each length; it is halved this often.
const FIRST_STEP: f64 = 0.6;
const HALVINGS: usize = 6;

/// Shortest length a climb can start a material with, as a part of its largest, times the step.
const SPROUT: f64 = 0.03;

/// (−ln of nodes + ln of bins) / max(1, −ln of bins) a path, for the first `sums` sums.
pub(super) fn errors(mixture: &Mixture, paths: &Paths, sums: usize) -> Vec<[f64; SUMS]> {
    let mut depths = Vec::new();
    let of_path = |index: usize| {
        let (found, exact) = (mixture.line_integrals(paths.path(index), &mut depths), paths.exact[index]);
        let mut error = [0.0; SUMS];
        for sum in 0..sums {
            error[sum] = (found[sum] - exact[sum]) / exact[sum].max(1.0);
        }
        error
    };
    (0..paths.len()).map(of_path).collect()
}

/// The worst error of one sum: that of `errors` or, where these keep to `limit`, what climbs from the worst paths reach. NaN if any
/// error is.
// With many materials no affordable grid finds the top of each hill of the error, but it does find the hills.
pub(super) fn worst_nearby(bins: &Bins, mixture: &Mixture, paths: &Paths, errors: &[[f64; SUMS]], sum: usize, limit: f64) -> f64 {
    let on_paths = worst(errors.iter().map(|error| error[sum]));
    if !(on_paths <= limit) {
        return on_paths;
    }
    let height = |index: &usize| errors[*index][sum].abs();
    let mut starts: Vec<usize> = (0..errors.len()).collect();
    starts.sort_by(|a, b| height(b).total_cmp(&height(a)));
    starts.truncate(HIGHEST);
    let run = errors.len().div_ceil(RUNS).max(1);
    starts.extend(
        (0..errors.len())
            .step_by(run)
            .filter_map(|first| (first..errors.len().min(first + run)).max_by(|a, b| height(a).total_cmp(&height(b)))),
    );
    let climbs = starts.iter().map(|index| climb(bins, mixture, paths.path(*index), height(index), sum));
    worst(climbs.chain([on_paths]))
}

/// Pattern search for a larger error, one material at a time: to nothing, to the largest, and by steps down and up.
fn climb(bins: &Bins, mixture: &Mixture, start: &[f64], error: f64, sum: usize) -> f64 {
    let (mut path, mut highest, mut depths) = (start.to_vec(), error, Vec::new());
    for halving in 0..=HALVINGS {
        let step = FIRST_STEP * 0.5f64.powi(halving as i32);
        for (material, largest) in bins.reach.largest_g_per_cm2.iter().enumerate() {
            let here = path[material];
            let up = (here * (1.0 + step)).max(SPROUT * step * largest).min(*largest);
            for length in [here / (1.0 + step), up, 0.0, *largest] {
                let mut trial = path.clone();
                trial[material] = length;
                bins.reach.shorten(&bins.mixture, &mut trial, &mut depths);
                let exact = bins.mixture.line_integrals(&trial, &mut depths)[sum];
                let found = mixture.line_integrals(&trial, &mut depths)[sum];
                let error = (found - exact).abs() / exact.max(1.0);
                if error > highest {
                    (path, highest) = (trial, error);
                }
            }
        }
    }
    highest
}
