//! From a wish (an error, or a time) to the cheapest plan that grants it.

use super::costs::{Costs, Work};
use super::pilot::{self, Pilot};
use super::plan::{ErrorParts, Executor, Fitted, Node, Plan, Sampling, noise_applies, response};
use super::prepared::Prepared;
use super::quadrature::{self, NoiseWeights, Quadrature, QuadratureNode, Tolerance};
use super::spectrum::{Bins, whole_spectrum};
use super::{Quantity, RenderError};
use crate::geometry::View;
use crate::scene::model::{Formation, Scene};

/// What a user asks for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Goal {
    /// |Δ line_integral| / max(1, line_integral), 99.9th percentile.
    MaxError(f64),
    /// Wall milliseconds, preparation of volumes aside.
    BudgetMs(f64),
    /// Exactly this, to measure it: sampling, tolerance of the energies (none: every bin) and cast pixels.
    Explicit {
        /// How volumes are sampled.
        sampling: Sampling,
        /// Bound of the energies' part.
        energies: Option<f64>,
        /// Every which pixel.
        step_px: u32,
    },
}

/// Without a wish: what the fast path reaches at nearly no cost.
pub const DEFAULT_MAX_ERROR: f64 = 1e-5;

/// Rounding of the weights, which add up to what they should but for this.
const WEIGHTS_OFF: f64 = 2e-5;
/// Where less is asked for, volumes are not rounded: the bound of fixed point is hardly ever below.
pub const LEAST_FIXED_ERROR: f64 = 5e-5;

/// Rounding of the sum over energies in f32.
const ENERGIES_ROUNDING: f64 = 3e-6;
/// Tolerances at which energies are fitted; few, so that fits are used again.
pub const TOLERANCES: [f64; 9] = [3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 3e-5, 1e-5, 3e-6];

/// Plans scenes and keeps what it fitted.
#[derive(Debug, Default)]
pub struct Planner {
    fits: Vec<(Key, Option<Quadrature>)>,
    costs: Option<Costs>,
}

/// What a fit depends on.
#[derive(Clone, Debug, PartialEq)]
struct Key {
    spectrum: Vec<(f64, f64)>,
    materials: Vec<String>,
    largest_g_per_cm2: Vec<f64>,
    tolerance: f64,
    noise: bool,
}

/// One way to make the image.
#[derive(Clone, Debug)]
struct Candidate {
    sampling: Sampling,
    step_px: u32,
    energies: Option<f64>,
    parts: ErrorParts,
    cost: f64,
}

impl ErrorParts {
    /// The bound of all parts together.
    #[must_use]
    pub fn total(&self) -> f64 {
        self.sampling + self.energies + self.interpolation
    }
}

/// The scene, and how it is looked at.
pub struct Task<'s> {
    /// The scene.
    pub scene: &'s Scene,
    /// The view.
    pub view: View,
    /// What is made.
    pub quantity: Quantity,
    /// Who makes it.
    pub executor: Executor,
    /// Whether all volumes can be crossed slab by slab.
    pub slabs: bool,
    /// The largest step between cast pixels with which they can be crossed in fixed point; 0 when they cannot.
    pub fixed_step_px: u32,
    /// What is asked for.
    pub goal: Goal,
}

impl Planner {
    /// Turns `plan`, which evaluates everything, into the cheapest one that grants the goal; where none does, into the most accurate or
    /// the fastest. `prepare` looks at the scene from a view.
    ///
    /// # Errors
    /// When attenuation is not tabulated, or the scene cannot be prepared.
    pub fn refine<'a>(
        &mut self,
        mut plan: Plan,
        task: &Task,
        prepare: impl FnMut(View) -> Result<Prepared<'a>, RenderError>,
    ) -> Result<Plan, RenderError> {
        let scene = task.scene;
        let with_energies = task.quantity != Quantity::AreaDensity;
        let fits = with_energies && scene.model.formation == Formation::Deepdrr && quadrature_applies(scene);
        let bins = if with_energies { Some(Bins::new(scene, &whole_spectrum(scene))?) } else { None };
        let compare = match task.goal {
            Goal::MaxError(_) => false,
            Goal::BudgetMs(_) => true,
            Goal::Explicit { step_px, .. } => step_px > 1,
        };
        let sampling = match (task.fixed_step_px > 0, task.slabs) {
            (true, _) => Sampling::FixedSlabs,
            (_, true) => Sampling::ExactSlabs,
            _ => Sampling::ExactCells,
        };
        let pilot = pilot::cast(task.view, bins.as_ref(), compare, sampling, prepare)?;
        let costs = self.costs.get_or_insert_with(Costs::of_this_machine).clone();
        let mut candidates = Vec::new();
        let rounding = match task.fixed_step_px {
            0 => f64::INFINITY,
            _ => rounding_error(&pilot, &attenuation_bounds(task, &pilot)?),
        };
        for (sampling, step_px, sampling_error, interpolation) in ways(task, &pilot, plan.sampling, rounding) {
            for energies in self.tolerances(task, fits, sampling_error + interpolation) {
                let energies_error = if with_energies { ENERGIES_ROUNDING + energies.unwrap_or(0.0) } else { 0.0 };
                let parts = ErrorParts { sampling: sampling_error, energies: energies_error, interpolation };
                candidates.push(Candidate { sampling, step_px, energies, parts, cost: 0.0 });
            }
        }
        // Ranking by typical costs for an error, so that the same scene gets the same plan on any day; by this machine's for a time.
        let ranking = if matches!(task.goal, Goal::BudgetMs(_)) { costs.clone() } else { Costs::default() };
        for candidate in &mut candidates {
            let nodes = match candidate.energies {
                Some(tolerance) => self.fit(task, &pilot, tolerance)?.map_or(plan.energy_nodes.len(), |fit| fit.nodes.len()),
                None => plan.energy_nodes.len(),
            };
            candidate.cost = ranking.predict_ms(&work(task, &pilot, candidate, nodes), candidate.sampling);
        }
        let chosen = choose(&candidates, task.goal).cloned();
        let Some(chosen) = chosen else { return Ok(plan) };
        self.apply(&mut plan, task, &pilot, &chosen)?;
        if task.executor == Executor::Cpu {
            let work = work(task, &pilot, &chosen, plan.energy_nodes.len());
            plan.predicted_ms = Some(costs.predict_ms(&work, chosen.sampling));
            plan.typical_ms = Some(Costs::default().predict_ms(&work, chosen.sampling));
        }
        Ok(plan)
    }

    /// Tolerances worth a look when the rest of the error is spent.
    fn tolerances(&self, task: &Task, fits: bool, spent: f64) -> Vec<Option<f64>> {
        if !fits {
            return vec![None];
        }
        match task.goal {
            Goal::Explicit { energies, .. } => vec![energies],
            Goal::BudgetMs(_) => [1e-2, 1e-3, 1e-4, 1e-5].into_iter().map(Some).chain([None]).collect(),
            Goal::MaxError(error) => {
                let left = error - spent - ENERGIES_ROUNDING;
                TOLERANCES.into_iter().find(|tolerance| *tolerance <= left).map(Some).into_iter().chain([None]).collect()
            }
        }
    }

    /// Nodes fitted to the spectrum and to paths a half longer than the pilot rays'; `None` where none meet `tolerance`.
    fn fit(&mut self, task: &Task, pilot: &Pilot, tolerance: f64) -> Result<Option<Quadrature>, RenderError> {
        let scene = task.scene;
        let nodes = whole_spectrum(scene);
        let key = Key {
            spectrum: nodes.iter().map(|node| (node.energy_kev, node.fraction * response(scene, node))).collect(),
            materials: scene.materials.iter().map(|material| material.name.clone()).collect(),
            largest_g_per_cm2: region(pilot),
            tolerance,
            noise: noise_applies(scene, task.quantity),
        };
        if let Some((_, fit)) = self.fits.iter().find(|(known, _)| *known == key) {
            return Ok(fit.clone());
        }
        let energies_kev: Vec<f64> = nodes.iter().map(|node| node.energy_kev).collect();
        let weights =
            |power: i32| -> Vec<f64> { nodes.iter().map(|node| node.fraction * response(scene, node).powi(power)).collect() };
        let (photons, signal, squares) = (weights(0), weights(1), weights(2));
        let mut cm2_per_g = Vec::new();
        for material in &scene.materials {
            let row: Result<Vec<f64>, _> =
                energies_kev.iter().map(|kev| material.attenuation(*kev).map(|found| found.total_cm2_per_g)).collect();
            cm2_per_g.push(row?);
        }
        let noise_weights = key.noise.then_some(NoiseWeights { photons: &photons, squares: &squares });
        let spectrum =
            quadrature::EnergyBins { energies_kev: &energies_kev, signal_weights: &signal, noise_weights, cm2_per_g: &cm2_per_g };
        let box_ = quadrature::Region { largest_g_per_cm2: &key.largest_g_per_cm2, largest_line_integral: None };
        let wanted = Tolerance::of_signal(tolerance);
        // What cannot be fitted is evaluated bin by bin.
        let fit = quadrature::fit(&spectrum, &box_, wanted)
            .ok()
            .flatten()
            .filter(|fit| fit.meets(wanted) && fit.nodes.len() < nodes.len());
        if self.fits.len() >= 64 {
            self.fits.remove(0);
        }
        self.fits.push((key, fit.clone()));
        Ok(fit)
    }

    fn apply(&mut self, plan: &mut Plan, task: &Task, pilot: &Pilot, chosen: &Candidate) -> Result<(), RenderError> {
        let all = plan.energy_nodes.len();
        plan.sampling = chosen.sampling;
        plan.step_px = chosen.step_px;
        plan.error_parts = chosen.parts;
        if plan.sampling != Sampling::None {
            plan.say("volumes", true, plan.sampling.why().to_owned());
        }
        if chosen.step_px > 1 {
            let n = chosen.step_px;
            plan.say(
                "resolution",
                false,
                format!("every {n}th pixel along columns and rows is cast, the others are interpolated"),
            );
        }
        let fit = match chosen.energies {
            Some(tolerance) => self.fit(task, pilot, tolerance)?,
            None => None,
        };
        match fit {
            Some(fit) => {
                plan.error_parts.energies = ENERGIES_ROUNDING + fit.bound;
                plan.energy_nodes = nodes_of(&fit);
                plan.fitted_up_to_g_per_cm2 = region(pilot);
                let words = format!(
                    "{} fitted nodes stand for {all} bins, within {:.1e}; pixels with longer paths than the fit knows take every bin",
                    fit.nodes.len(),
                    fit.bound
                );
                plan.say("spectrum", true, words);
            }
            None if chosen.energies.is_some() => plan.error_parts.energies = ENERGIES_ROUNDING,
            None => {}
        }
        plan.stated_error = plan.error_parts.total();
        Ok(())
    }
}

/// Ways to sample, with the step between cast pixels, the sampling's and the interpolation's error.
fn ways(task: &Task, pilot: &Pilot, asked: Sampling, rounding: f64) -> Vec<(Sampling, u32, f64, f64)> {
    if task.executor != Executor::Cpu {
        return vec![(asked, 1, task.executor.stated_error(), 0.0)];
    }
    if asked == Sampling::None {
        return vec![(Sampling::None, 1, 2e-6, 0.0)];
    }
    // f64 positions; f32 interpolation weights and sums.
    let cells = (Sampling::ExactCells, 2e-6);
    let slabs = (Sampling::ExactSlabs, 4e-6);
    let steps = [(1, 0.0), (2, pilot.interpolation_error[0]), (4, pilot.interpolation_error[1])];
    let mut all = if task.slabs { vec![slabs, cells] } else { vec![cells] };
    if task.fixed_step_px > 0 {
        all.push((Sampling::FixedSlabs, rounding));
    }
    let can = |sampling: Sampling, step_px: u32| sampling != Sampling::FixedSlabs || step_px <= task.fixed_step_px;
    match task.goal {
        Goal::MaxError(_) => all.into_iter().map(|(sampling, error)| (sampling, 1, error, 0.0)).collect(),
        Goal::BudgetMs(_) => {
            let every = all.into_iter().flat_map(|(s, error)| steps.map(|(step, between)| (s, step, error, between)));
            every.filter(|(sampling, step_px, ..)| can(*sampling, *step_px)).collect()
        }
        Goal::Explicit { sampling, step_px, .. } => {
            let (sampling, error) =
                all.into_iter().find(|(known, _)| *known == sampling && can(*known, step_px)).unwrap_or(cells);
            let between = steps.into_iter().find(|(step, _)| *step == step_px).unwrap_or(steps[0]);
            vec![(sampling, between.0, error, between.1)]
        }
    }
}

/// Bound of fixed point: the worst of the pilot rays, and half as much again.
fn rounding_error(pilot: &Pilot, cm2_per_g: &[[f64; 2]]) -> f64 {
    let off = |ray: &Vec<[f64; 2]>| {
        let (mut off, mut line) = (0.0, 0.0);
        for ([rounding, path], [least, most]) in ray.iter().zip(cm2_per_g) {
            (off, line) = (off + rounding * most, line + path * least);
        }
        off / if line > 1.0 { line } else { 1.0 }
    };
    // NaN stays, and grants nothing.
    let larger = |worst: f64, off: f64| if off <= worst || worst.is_nan() { worst } else { off };
    let worst = pilot.rounding_g_per_cm2.iter().map(off).fold(0.0, larger);
    1.5 * worst + WEIGHTS_OFF
}

/// The least and the most by which g/cm² of each material raises −ln of the signal: the mean attenuation where the beam arrives, and farther
/// in, where it is harder. 1 where there is no signal.
fn attenuation_bounds(task: &Task, pilot: &Pilot) -> Result<Vec<[f64; 2]>, RenderError> {
    let materials = &task.scene.materials;
    if task.quantity == Quantity::AreaDensity {
        return Ok(vec![[1.0; 2]; materials.len()]);
    }
    let mut bounds = vec![[f64::INFINITY, 0.0]; materials.len()];
    let nodes = whole_spectrum(task.scene);
    let mut cm2_per_g = Vec::new();
    for node in &nodes {
        let row: Result<Vec<f64>, _> =
            materials.iter().map(|material| material.attenuation(node.energy_kev).map(|found| found.total_cm2_per_g)).collect();
        cm2_per_g.push(row?);
    }
    for depth in [0.0, 0.25, 0.5, 1.0] {
        let arrives = |(node, row): (&Node, &Vec<f64>)| {
            let paths = pilot.largest_g_per_cm2.iter().zip(row).map(|(g_per_cm2, cm2_per_g)| depth * g_per_cm2 * cm2_per_g);
            node.fraction * response(task.scene, node) * (-paths.sum::<f64>()).exp()
        };
        let weights: Vec<f64> = nodes.iter().zip(&cm2_per_g).map(arrives).collect();
        let all: f64 = weights.iter().sum();
        for (m, [least, most]) in bounds.iter_mut().enumerate() {
            let mean = weights.iter().zip(&cm2_per_g).map(|(weight, row)| weight * row[m]).sum::<f64>() / all;
            // Nothing arrives: NaN, and nothing is granted.
            *least = if mean >= *least { *least } else { mean };
            *most = if mean <= *most { *most } else { mean };
        }
    }
    Ok(bounds)
}

/// The cheapest that grants an error, else the most accurate; the most accurate within a time, else the fastest.
fn choose(candidates: &[Candidate], goal: Goal) -> Option<&Candidate> {
    let cheapest = |a: &&Candidate, b: &&Candidate| a.cost.total_cmp(&b.cost);
    let best = |a: &&Candidate, b: &&Candidate| a.parts.total().total_cmp(&b.parts.total());
    match goal {
        Goal::MaxError(error) => {
            let within = candidates.iter().filter(|candidate| candidate.parts.total() <= error);
            within.min_by(cheapest).or_else(|| candidates.iter().min_by(best))
        }
        Goal::BudgetMs(ms) => {
            let within = candidates.iter().filter(|candidate| candidate.cost <= ms);
            within.min_by(|a, b| best(a, b).then(cheapest(a, b))).or_else(|| candidates.iter().min_by(cheapest))
        }
        Goal::Explicit { .. } => candidates.first(),
    }
}

/// Whether energies are all that decides about a pixel's spectrum.
fn quadrature_applies(scene: &Scene) -> bool {
    // Heel and bow-tie change the weights from pixel to pixel.
    scene.materials.len() <= quadrature::MOST_MATERIALS && !scene.beam.shape.varies()
}

/// Paths that a fit covers: a half longer than the pilot rays', rounded up so that neighbouring views share fits.
fn region(pilot: &Pilot) -> Vec<f64> {
    let grow = |largest: &f64| if *largest > 0.0 { 1.25f64.powf((1.5 * largest).max(0.1).log(1.25).ceil()) } else { 0.0 };
    pilot.largest_g_per_cm2.iter().map(grow).collect()
}

fn nodes_of(fit: &Quadrature) -> Vec<Node> {
    // Where no noise is asked for, photons are not fitted; signal over energy is near enough for people to read.
    let photon =
        |node: &QuadratureNode| if node.photon_weight > 0.0 { node.photon_weight } else { node.signal_weight / node.energy_kev };
    let signal: f64 = fit.nodes.iter().map(|node| node.signal_weight).sum();
    let photons: f64 = fit.nodes.iter().map(photon).sum();
    let squares: f64 = fit.nodes.iter().map(|node| node.square_weight).sum();
    fit.nodes
        .iter()
        .map(|node| Node {
            energy_kev: node.energy_kev,
            fraction: photon(node) / photons,
            fitted: Some(Fitted {
                signal_share: node.signal_weight / signal,
                square_share: if squares > 0.0 { node.square_weight / squares } else { 0.0 },
                cm2_per_g: node.cm2_per_g.clone(),
            }),
        })
        .collect()
}

fn work(task: &Task, pilot: &Pilot, candidate: &Candidate, energies: usize) -> Work {
    let pixels = f64::from(task.view.size_px[0]) * f64::from(task.view.size_px[1]);
    let materials = pilot.largest_g_per_cm2.iter().filter(|largest| **largest > 0.0).count();
    Work {
        pixels,
        rays: pixels / f64::from(candidate.step_px).powi(2),
        slabs_per_ray: pilot.slabs_per_ray,
        filled_per_ray: pilot.filled_per_ray,
        solids_per_ray: pilot.solids_per_ray,
        materials,
        energies,
        noise: noise_applies(task.scene, task.quantity),
    }
}
