//! From lumps to beads: candidates, fits, judgement, and once more with the slice profile and the point spread that the beads share.

use std::collections::BTreeSet;

use glam::DVec3;
use rayon::prelude::*;

use super::fit::{Ball, Fitted, Prior, Priors, Problem};
use super::judge::{NotBead, at_sight, of_fit};
use super::lumps::{Lump, METAL_HU, lumps, summits};
use super::slices::{ASKED, PROFILES, Trial, choose, doubt, slice_axis};
use super::sphere::{SliceProfile, VoxelPoints};
use super::window::{Candidate, Window, window};
use crate::geometry::VoxelGrid;

/// Contrast of bead metals at the energies of a CT: titanium 8 000 HU, steel 20 000, tantalum 60 000.
const CONTRAST: Prior = Prior { expected: 16_000.0, sigma_ln: 0.6 };
/// Beads of 0.8 to 4 mm.
const RADIUS_MM: Prior = Prior { expected: 0.9, sigma_ln: 0.6 };
/// Point spreads of 0.5 to 1.5 mm full width at half maximum.
const BLUR_MM: Prior = Prior { expected: 0.40, sigma_ln: 0.4 };
/// The radius of a given bead may be wrong by this.
const GIVEN_RADIUS_SIGMA_LN: f64 = 0.01;
/// Misfit is mostly anatomy that the surroundings do not continue: walls of bone and the like, mm.
const MISFIT_LENGTH_MM: f64 = 1.2;
/// What the surroundings continue wrongly inside a bead, of their own structure: the ball takes up much of that itself, so that the
/// misfit left in the voxels understates it.
const MISFIT_OF_STRUCTURE: f64 = 0.7;
/// A lump with more summits than this is no group of beads.
const MOST_SUMMITS: usize = 6;
/// More lumps than this are not fitted, only counted: dense bone breaks into thousands.
const MOST_FITTED: usize = 1500;
/// A given radius is contradicted when the beads' own differs by more than this share, and by so many of its σ.
const CONTRADICTED: f64 = 0.15;
const CONTRADICTED_SIGMAS: f64 = 3.0;
/// So often each of a few candidates is fitted: under each profile, in four rounds, and for the doubt.
const FITS_EACH: usize = PROFILES.len() + 10;
/// Summits of one lump are beads only where the value between them falls below this share of the lower one's.
const DIP: f64 = 0.8;

/// A bead, before it has a name.
#[derive(Clone, Debug)]
pub(super) struct Found {
    pub fitted: Fitted,
    pub peak_hu: f32,
}

/// Metal that is no bead.
#[derive(Clone, Debug)]
pub(super) struct Other {
    pub lump: Lump,
    pub why: NotBead,
}

/// All that was found.
#[derive(Clone, Debug)]
pub(super) struct Search {
    pub beads: Vec<Found>,
    pub others: Vec<Other>,
    /// Lumps beyond those that are fitted.
    pub left_out: usize,
    /// A radius that was given and that the CT contradicts: given, and as the CT has it with σ of its logarithm.
    pub contradicted_radius: Option<(f64, Prior)>,
    /// Standard deviation of the slices' profile, in slice spacings.
    pub slice_sigma: f64,
}

/// Looks for beads in `hu`, clipped at `clip_hu`; `step` hears of every fit, and about how many there are.
pub(super) fn search(
    grid: &VoxelGrid,
    hu: &[f32],
    clip_hu: f64,
    radius_mm: &(dyn Fn(DVec3) -> Option<f64> + Sync),
    step: &(dyn Fn(usize) + Sync),
) -> Search {
    let mut lumps = lumps(grid, hu);
    lumps.sort_by(|a, b| b.peak_hu.total_cmp(&a.peak_hu).then(b.voxels.len().cmp(&a.voxels.len())).then(a.voxels.cmp(&b.voxels)));
    let left_out = lumps.len().saturating_sub(MOST_FITTED);
    let mut verdicts: Vec<Option<NotBead>> = lumps.iter().map(|lump| at_sight(lump, grid.spacing_mm())).collect();
    let candidates = candidates(grid, hu, &lumps, &mut verdicts);
    let slices = slice_axis(grid);
    let points = |profile| VoxelPoints::new(grid.lps_from_voxel.matrix3, slices, profile);
    let mut rounds = Rounds {
        fitter: Fitter { grid, hu, clip_hu, points: points(SliceProfile::BOX), radius_mm, step },
        alone: (0..lumps.len()).map(|lump| candidates.iter().filter(|candidate| candidate.lump == lump).count() == 1).collect(),
        fits: vec![None; candidates.len()],
        candidates: &candidates,
        lumps: &lumps,
        verdicts,
        blur: BLUR_MM,
    };
    let at_first = rounds.verdicts.clone();
    rounds.round();
    let asked = rounds.most_certain(ASKED);
    let trials = choose(|profile| rounds.trial(&asked, points(profile)));
    let profile = trials.first().map_or(SliceProfile::BOX, |trial| trial.profile);
    if profile != SliceProfile::BOX {
        // What did not look like a ball under the wrong profile may be one.
        (rounds.verdicts, rounds.fitter.points) = (at_first, points(profile));
        rounds.round();
    }
    // The next round knows which lumps are no beads, the last what beads add to their neighbours and how wide the point spread is.
    for _ in 0..2 {
        rounds.round();
        rounds.share_blur();
    }
    rounds.doubt(&trials[1.min(trials.len())..], points);
    let contradicted_radius = rounds.contradicted_radius();
    let slice_sigma = profile.deviation();
    let Rounds { fits, verdicts, .. } = rounds;
    let beads = candidates
        .iter()
        .zip(fits)
        .filter(|(candidate, _)| verdicts[candidate.lump].is_none())
        .filter_map(|(candidate, fitted)| Some(Found { fitted: fitted?, peak_hu: lumps[candidate.lump].peak_hu }))
        .collect();
    let others = lumps.into_iter().zip(verdicts).take(MOST_FITTED);
    Search {
        beads,
        others: others.filter_map(|(lump, why)| Some(Other { lump, why: why? })).collect(),
        left_out,
        contradicted_radius,
        slice_sigma,
    }
}

/// Fits and judgements, round by round.
struct Rounds<'a> {
    fitter: Fitter<'a>,
    candidates: &'a [Candidate],
    lumps: &'a [Lump],
    /// Of each lump: whether it has one summit.
    alone: Vec<bool>,
    verdicts: Vec<Option<NotBead>>,
    fits: Vec<Option<Fitted>>,
    blur: Prior,
}

impl Rounds<'_> {
    /// Candidates whose lump may still be beads.
    fn live(&self) -> Vec<usize> {
        (0..self.candidates.len()).filter(|at| self.verdicts[self.candidates[*at].lump].is_none()).collect()
    }

    /// Fits the candidates of number `which` among all `live` ones.
    fn refits(&self, live: &[usize], which: &[usize], fitter: &Fitter, blur: Prior) -> Vec<Option<(Fitted, f64)>> {
        let foreign: BTreeSet<usize> = self
            .lumps
            .iter()
            .zip(&self.verdicts)
            .filter(|(_, verdict)| verdict.is_some())
            .flat_map(|(lump, _)| lump.voxels.iter().copied())
            .collect();
        let left: Vec<Candidate> = live.iter().map(|at| self.candidates[*at].clone()).collect();
        let known: Vec<Option<Ball>> = live.iter().map(|at| self.fits[*at].as_ref().map(|fitted| fitted.ball)).collect();
        let place = |at: &usize| live.binary_search(at).ok();
        let refit = |at: &usize| place(at).and_then(|at| fitter.fit(&left, at, &known, &foreign, blur));
        which.par_iter().map(refit).collect()
    }

    /// Fits every live candidate and judges it.
    fn round(&mut self) {
        let live = self.live();
        let refits = self.refits(&live, &live, &self.fitter, self.blur);
        for (at, refit) in live.into_iter().zip(refits) {
            let lump = self.candidates[at].lump;
            let verdict = match &refit {
                Some((fitted, middle_hu)) => of_fit(self.fitter.grid, &self.lumps[lump], self.alone[lump], fitted, *middle_hu),
                None => Some(NotBead::Surrounded),
            };
            if self.verdicts[lump].is_none() {
                self.verdicts[lump] = verdict;
            }
            self.fits[at] = refit.map(|(fitted, _)| fitted);
        }
    }

    fn share_blur(&mut self) {
        let live = self.live();
        self.blur = shared_blur(live.iter().filter_map(|at| self.fits[*at].as_ref())).unwrap_or(self.blur);
    }

    /// The beads whose centres are known best, at most `count`; where none is, what looks most like one.
    fn most_certain(&self, count: usize) -> Vec<usize> {
        let live = self.live();
        let shaped = |at: &usize| matches!(self.verdicts[self.candidates[*at].lump], Some(NotBead::Shape { .. }));
        let mut asked = if live.is_empty() { (0..self.candidates.len()).filter(shaped).collect() } else { live };
        asked.retain(|at| self.fits[*at].is_some());
        let missed = |at: &usize| self.fits[*at].as_ref().map_or(f64::INFINITY, |fitted| fitted.missed_share);
        asked.sort_by(|a, b| missed(a).total_cmp(&missed(b)));
        asked.truncate(count);
        asked.sort_unstable();
        asked
    }

    /// Fits of `asked` with voxels that average as `points` say, each with a point spread of its own.
    fn trial(&self, asked: &[usize], points: VoxelPoints) -> Vec<Option<Fitted>> {
        let fitter = Fitter { points, ..self.fitter };
        let mut live = self.live();
        if live.is_empty() {
            live = asked.to_vec();
        }
        self.refits(&live, asked, &fitter, BLUR_MM).into_iter().map(|fit| fit.map(|(fitted, _)| fitted)).collect()
    }

    /// A given radius that the beads contradict, and what they say instead; most beads are of one size.
    fn contradicted_radius(&self) -> Option<(f64, Prior)> {
        let live = self.live();
        let unknown = |_: DVec3| None;
        let fitter = Fitter { radius_mm: &unknown, points: self.fitter.points.clone(), ..self.fitter };
        let given = |at: usize| (self.fitter.radius_mm)(self.candidates[at].centre_lps_mm);
        let given: Vec<usize> = live.iter().copied().filter(|at| given(*at).is_some()).collect();
        let fits = self.refits(&live, &given, &fitter, self.blur);
        let mut off: Vec<(f64, f64, &Fitted)> = given
            .iter()
            .zip(&fits)
            .filter_map(|(at, fit)| {
                let (fitted, _) = fit.as_ref()?;
                let radius_mm = (self.fitter.radius_mm)(self.candidates[*at].centre_lps_mm)?;
                Some(((fitted.ball.radius_mm / radius_mm).ln(), radius_mm, fitted))
            })
            .collect();
        off.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (ln_ratio, given_mm, fitted) = off.get(off.len() / 2)?;
        let sigma_ln = fitted.radius_sigma_ln.max(CONTRADICTED / CONTRADICTED_SIGMAS);
        let contradicted = ln_ratio.abs() > CONTRADICTED_SIGMAS * sigma_ln;
        contradicted.then_some((*given_mm, Prior { expected: fitted.ball.radius_mm, sigma_ln }))
    }

    /// Adds what doubt about the profile leaves to the covariances.
    fn doubt(&mut self, others: &[Trial], points: impl Fn(SliceProfile) -> VoxelPoints) {
        let edges_mm = self.fitter.grid.lps_from_voxel.matrix3;
        let live = self.live();
        let trials: Vec<(f64, Vec<Option<Fitted>>)> =
            others.iter().map(|other| (other.weight, self.trial(&live, points(other.profile)))).collect();
        for (place, at) in live.into_iter().enumerate() {
            let of_bead: Vec<(f64, Fitted)> =
                trials.iter().filter_map(|(weight, fits)| Some((*weight, fits[place].clone()?))).collect();
            if let Some(fitted) = &mut self.fits[at] {
                doubt(fitted, &of_bead, edges_mm);
            }
        }
    }
}

/// The places to fit; lumps that cannot be a few balls get their verdict.
fn candidates(grid: &VoxelGrid, hu: &[f32], lumps: &[Lump], verdicts: &mut [Option<NotBead>]) -> Vec<Candidate> {
    let mut candidates = Vec::new();
    for (number, lump) in lumps.iter().enumerate() {
        if verdicts[number].is_some() {
            continue;
        }
        if number >= MOST_FITTED {
            verdicts[number] = Some(NotBead::Faint { contrast_hu: f64::from(lump.peak_hu) });
            continue;
        }
        let tops = summits(grid, hu, lump);
        let parted = tops.len() <= MOST_SUMMITS && all_parted(grid, hu, &tops);
        if !parted && tops.len() > MOST_SUMMITS {
            verdicts[number] = Some(NotBead::Large { longest_mm: lump.extent_mm[0] });
            continue;
        }
        let tops = if parted { tops } else { vec![lump.centre_lps_mm] };
        for top in &tops {
            let own = |place: &DVec3| tops.iter().all(|other| other.distance_squared(*place) >= top.distance_squared(*place));
            let places = lump.voxels.iter().map(|index| grid.centre(*index)).filter(own);
            let reach_mm = places.map(|place| place.distance(*top)).fold(0.0, f64::max);
            candidates.push(Candidate { lump: number, centre_lps_mm: *top, reach_mm });
        }
    }
    candidates
}

/// Whether the values fall between every two summits that have none nearer to both between them.
fn all_parted(grid: &VoxelGrid, hu: &[f32], tops: &[DVec3]) -> bool {
    let voxel_from_lps = grid.lps_from_voxel.inverse();
    let at = |place: DVec3| {
        let voxel = voxel_from_lps.transform_point3(place).round();
        let inside = (0..3).all(|axis| voxel[axis] >= 0.0 && voxel[axis] < grid.size[axis] as f64);
        inside.then(|| hu[grid.index(voxel.to_array().map(|n| n as usize))])
    };
    tops.iter().enumerate().all(|(number, a)| {
        tops[..number].iter().all(|b| {
            let lower = at(*a).zip(at(*b)).map_or(0.0, |(a, b)| a.min(b));
            let lowest = (1..20).filter_map(|n| at(a.lerp(*b, f64::from(n) / 20.0))).fold(f32::INFINITY, f32::min);
            f64::from(lowest) < DIP * f64::from(lower)
        })
    })
}

struct Fitter<'a> {
    grid: &'a VoxelGrid,
    hu: &'a [f32],
    clip_hu: f64,
    points: VoxelPoints,
    radius_mm: &'a (dyn Fn(DVec3) -> Option<f64> + Sync),
    step: &'a (dyn Fn(usize) + Sync),
}

impl Fitter<'_> {
    /// The ball at candidate `at`, and the middle value of what surrounds it.
    fn fit(
        &self,
        all: &[Candidate],
        at: usize,
        known: &[Option<Ball>],
        foreign: &BTreeSet<usize>,
        blur: Prior,
    ) -> Option<(Fitted, f64)> {
        let window = window(self.grid, self.hu, all, at, foreign);
        (self.step)(FITS_EACH * all.len());
        let mut window = window?;
        let own = &all[at];
        let near_mm = 2.0 * own.window_mm(self.points.half_diagonal_mm) + 4.0;
        let others: Vec<&Ball> = known
            .iter()
            .enumerate()
            .filter(|(other, _)| *other != at)
            .filter_map(|(_, ball)| ball.as_ref())
            .filter(|ball| ball.centre_lps_mm.distance(own.centre_lps_mm) < near_mm)
            .collect();
        for sample in &mut window.samples {
            sample.background_hu += others.iter().map(|ball| ball.adds_hu(sample.place_lps_mm, &self.points)).sum::<f64>();
        }
        let given = |radius_mm| Prior { expected: radius_mm, sigma_ln: GIVEN_RADIUS_SIGMA_LN };
        let radius = (self.radius_mm)(own.centre_lps_mm).map_or(RADIUS_MM, given);
        let start = known[at].unwrap_or_else(|| self.first_guess(own, radius, blur));
        let middle_hu = window.middle_hu;
        self.solve(&window, start, own, (radius, blur)).map(|fitted| (fitted, middle_hu))
    }

    fn first_guess(&self, own: &Candidate, radius: Prior, blur: Prior) -> Ball {
        let radius_mm = if radius.sigma_ln < RADIUS_MM.sigma_ln {
            radius.expected
        } else {
            (own.reach_mm - 0.9 * self.points.half_diagonal_mm).clamp(0.4, 4.0)
        };
        Ball {
            centre_lps_mm: own.centre_lps_mm,
            mass_hu_mm3: CONTRAST.expected * 4.0 / 3.0 * std::f64::consts::PI * radius_mm.powi(3),
            radius_mm,
            blur_mm: blur.expected,
        }
    }

    fn solve(&self, window: &Window, start: Ball, own: &Candidate, (radius, blur): (Prior, Prior)) -> Option<Fitted> {
        let loose_hu = 20.0 + 0.5 * window.structure_hu;
        let mut problem = Problem {
            samples: &window.samples,
            points: &self.points,
            clip_hu: self.clip_hu,
            noise_hu: window.noise_hu,
            misfit_hu: MISFIT_OF_STRUCTURE * window.structure_hu,
            misfit_length_mm: MISFIT_LENGTH_MM,
            priors: Priors {
                contrast_hu: CONTRAST,
                radius_mm: radius,
                blur_mm: blur,
                offset_hu: loose_hu,
                gradient_hu_per_mm: loose_hu / own.window_mm(self.points.half_diagonal_mm),
            },
        };
        let mut fitted = problem.solve(start)?;
        for _ in 0..2 {
            let measured_hu = (fitted.rms_hu.powi(2) - window.noise_hu.powi(2)).max(0.0).sqrt();
            problem.misfit_hu = measured_hu.max(MISFIT_OF_STRUCTURE * window.structure_hu);
            fitted = problem.solve(fitted.ball)?;
        }
        Some(fitted)
    }
}

/// Middle of the beads' point spreads, weighted by how well each knows its own.
fn shared_blur<'a>(beads: impl Iterator<Item = &'a Fitted>) -> Option<Prior> {
    let mut known: Vec<(f64, f64)> =
        beads.map(|fitted| (fitted.ball.blur_mm.ln(), fitted.blur_sigma_ln.max(0.01).powi(-2))).collect();
    known.sort_by(|a, b| a.0.total_cmp(&b.0));
    let total: f64 = known.iter().map(|(_, weight)| weight).sum();
    let mut sum = 0.0;
    let middle = known.iter().find(|(_, weight)| {
        sum += weight;
        sum >= 0.5 * total
    })?;
    // Beads at different depths and places are not blurred alike: scanners differ by some percent over their field.
    let sigma_ln = (1.0 / total).sqrt().max(0.05);
    Some(Prior { expected: middle.0.exp(), sigma_ln })
}

/// The value from which on the CT is clipped: the largest, where enough voxels have exactly it and it is above the threshold.
pub(super) fn clip_hu(hu: &[f32]) -> f64 {
    let most = hu.par_iter().copied().reduce(|| f32::NEG_INFINITY, f32::max);
    let count = hu.par_iter().filter(|value| **value >= most).count();
    if most >= METAL_HU && count >= 3 { f64::from(most) } else { f64::INFINITY }
}
