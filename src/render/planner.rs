//! From a wish (an error, or a time) to the cheapest plan that grants it.

use super::costs::{Casting, Costs, Work};
use super::cpu::integrate_density::band_rows;
use super::fits::{Fits, nodes_of};
use super::panel_costs::PanelWork;
use super::panel_work::{panel_work, shaped};
use super::pilot::{self, Pilot};
use super::plan::{ErrorParts, Executor, Node, Plan, Sampling, noise_applies};
use super::plan_parts::response;
use super::prepared::Prepared;
use super::quadrature;
use super::spectrum::{Bins, whole_spectrum};
use super::survey;
use super::timed_costs::of_this_machine;
pub use super::ways::{Goal, Task};
use super::ways::{Way, skipping_ways, whole_ways};
use super::{Quantity, RenderError, flood};
use crate::geometry::View;
use crate::scene::model::{Formation, Scene};

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
    /// Energies that were fitted.
    pub fits: Fits,
    costs: Option<Costs>,
}

/// One way to make the image.
#[derive(Clone, Debug)]
struct Candidate {
    way: Way,
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
        mut prepare: impl FnMut(View) -> Result<Prepared<'a>, RenderError>,
    ) -> Result<Plan, RenderError> {
        let scene = task.scene;
        let with_energies = task.quantity != Quantity::AreaDensity;
        let bins = if with_energies { Some(Bins::new(scene, &whole_spectrum(scene))?) } else { None };
        let sampling = match (task.fixed_step_px > 0, task.slabs) {
            (true, _) => Sampling::FixedSlabs,
            (_, true) => Sampling::ExactSlabs,
            _ => Sampling::ExactCells,
        };
        let pilot = pilot::cast(task.view, sampling, &mut prepare)?;
        self.calibrate();
        let costs = self.costs.clone().unwrap_or_default();
        let rounding = match task.fixed_step_px {
            0 => f64::INFINITY,
            _ => rounding_error(&pilot, &attenuation_bounds(task, &pilot)?),
        };
        // Ranking by typical costs for an error, so that the same scene gets the same plan on any day; by this machine's for a time.
        let ranking = if matches!(task.goal, Goal::BudgetMs(_)) { costs.clone() } else { Costs::default() };
        let every_energy = plan.energy_nodes.len();
        // The same for every candidate: of a time it leaves less to cast in.
        let panel = panel_work(scene, &task.view, task.quantity, task.executor);
        let ways = whole_ways(task, &pilot, plan.sampling, rounding);
        let mut candidates = self.candidates(task, &pilot, ways, &ranking, every_energy, panel)?;
        let coarser = match task.goal {
            Goal::MaxError(_) => false,
            // Nothing is as accurate as casting every pixel, as long as there is time.
            Goal::BudgetMs(ms) => !candidates.iter().any(|candidate| candidate.cost <= ms),
            Goal::Explicit { step_px, .. } => step_px > 1,
        };
        if coarser && task.executor == Executor::Cpu {
            let survey = survey::survey(task.view, bins.as_ref(), sampling, &mut prepare)?;
            let ways = skipping_ways(task, &survey, candidates.iter().map(|candidate| &candidate.way));
            if let Goal::Explicit { .. } = task.goal
                && !ways.is_empty()
            {
                candidates.clear();
            }
            candidates.extend(self.candidates(task, &pilot, ways, &ranking, every_energy, panel)?);
        }
        let chosen = choose(&candidates, task.goal).cloned();
        let Some(chosen) = chosen else { return Ok(plan) };
        self.apply(&mut plan, task, &pilot, &chosen)?;
        let work = work(task, &pilot, &chosen.way, plan.energy_nodes.len(), panel);
        if task.executor == Executor::Cpu {
            plan.predicted_ms = Some(costs.predict_ms(&work, chosen.way.sampling));
            plan.typical_ms = Some(Costs::default().predict_ms(&work, chosen.way.sampling));
        }
        if let Goal::BudgetMs(ms) = task.goal
            && let Some(words) = unmet(ms, plan.predicted_ms, costs.panel_ms(&panel))
        {
            plan.say("budget", false, words);
        }
        Ok(plan)
    }

    /// Measures what this machine costs, unless that is known: a second or two, now and then again.
    pub fn calibrate(&mut self) {
        self.costs.get_or_insert_with(of_this_machine);
    }

    /// Each way with all energies worth a look, and what it costs.
    fn candidates(
        &mut self,
        task: &Task,
        pilot: &Pilot,
        ways: Vec<Way>,
        ranking: &Costs,
        every_energy: usize,
        panel: PanelWork,
    ) -> Result<Vec<Candidate>, RenderError> {
        let with_energies = task.quantity != Quantity::AreaDensity;
        let fits = with_energies && task.scene.model.formation == Formation::Deepdrr && quadrature_applies(task.scene);
        let mut candidates = Vec::new();
        for way in ways {
            for energies in self.tolerances(task, fits, way.sampling_error + way.interpolation) {
                let nodes = match energies {
                    Some(tolerance) => {
                        self.fits.get(&task.wish(), pilot, tolerance)?.map_or(every_energy, |(fit, _)| fit.nodes.len())
                    }
                    None => every_energy,
                };
                let energies_error = if with_energies { ENERGIES_ROUNDING + energies.unwrap_or(0.0) } else { 0.0 };
                let parts =
                    ErrorParts { sampling: way.sampling_error, energies: energies_error, interpolation: way.interpolation };
                let cost = ranking.predict_ms(&work(task, pilot, &way, nodes, panel), way.sampling);
                candidates.push(Candidate { way: way.clone(), energies, parts, cost });
            }
        }
        Ok(candidates)
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

    fn apply(&mut self, plan: &mut Plan, task: &Task, pilot: &Pilot, chosen: &Candidate) -> Result<(), RenderError> {
        let all = plan.energy_nodes.len();
        plan.sampling = chosen.way.sampling;
        plan.step_px = chosen.way.step_px;
        plan.full_tiles = chosen.way.tiles.clone();
        plan.error_parts = chosen.parts;
        let in_slabs = matches!(plan.sampling, Sampling::ExactSlabs | Sampling::FixedSlabs);
        if plan.sampling != Sampling::None {
            let mut why = plan.sampling.why().to_owned();
            if in_slabs && pilot.walked_share > 0.0 {
                let share = 100.0 * pilot.walked_share;
                why += &format!("; {share:.0} % of the rays meet another volume or kept air and are walked cell by cell");
            }
            if task.executor == Executor::Cpu && !in_slabs && pilot.walked_share > 0.0 {
                why += "; not in slabs, because rays meet another volume or kept air";
            }
            if in_slabs && pilot.rays.iter().any(|(_, ray)| ray.displacing > 0.0) {
                why += "; where an object lies that the volume displaces, its cells are looked at one by one";
            }
            plan.say("volumes", true, why);
        }
        if let Some(tiles) = &plan.full_tiles {
            let n = plan.step_px;
            let share = 100.0 * tiles.pixels() / (f64::from(plan.size_px[0]) * f64::from(plan.size_px[1]));
            plan.say(
                "resolution",
                false,
                format!(
                    "every {n}th pixel along columns and rows is cast, the others are interpolated; all pixels of tiles with outlines, metal or \
                     the strongest bends are cast ({share:.0} % of the image)"
                ),
            );
        }
        let fit = match chosen.energies {
            Some(tolerance) => self.fits.get(&task.wish(), pilot, tolerance)?,
            None => None,
        };
        match fit {
            Some((fit, up_to)) => {
                plan.error_parts.energies = ENERGIES_ROUNDING + fit.bound;
                plan.energy_nodes = nodes_of(&fit);
                plan.fitted_up_to_g_per_cm2 = up_to;
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

fn work(task: &Task, pilot: &Pilot, way: &Way, energies: usize, panel: PanelWork) -> Work {
    let pixels = f64::from(task.view.size_px[0]) * f64::from(task.view.size_px[1]);
    let materials = pilot.largest_g_per_cm2.iter().filter(|largest| **largest > 0.0).count();
    Work {
        pixels,
        castings: castings(task, pilot, way),
        interpolated: if way.tiles.is_some() { pixels } else { 0.0 },
        materials,
        energies: match task.scene.model.formation {
            // One mean attenuation.
            Formation::Naive => energies.min(1),
            // Heel and bow-tie attenuate in place of the plain pass.
            Formation::Deepdrr if flood::shapes_spectrum(task.scene) => 0,
            Formation::Deepdrr => energies,
        },
        heel: task.quantity != Quantity::AreaDensity && task.scene.beam.shape.heel.is_some(),
        shaped_energies: energies,
        listed: task.scene.materials.len(),
        face_tests: pilot.face_tests,
        shaped: shaped(task.scene, task.quantity),
        moments: noise_applies(task.scene, task.quantity),
        panel,
    }
}

/// Where pixels are skipped: every n-th, then all those of full tiles.
fn castings(task: &Task, pilot: &Pilot, way: &Way) -> Vec<Casting> {
    let [width, height] = task.view.size_px;
    let pixels = f64::from(width) * f64::from(height);
    let bands = |height: usize| height.div_ceil(band_rows(height)) as f64;
    let casting = |rays: f64, step_px: u32, full: bool| {
        let is_cast = |pixel: [u32; 2]| way.tiles.as_ref().is_none_or(|tiles| tiles.is_full_at(pixel) == full);
        let mut drawn: Vec<_> = pilot.rays.iter().filter(|(pixel, _)| is_cast(*pixel)).map(|(_, ray)| *ray).collect();
        // No ray was drawn in so few tiles: those of all.
        if drawn.is_empty() {
            drawn = pilot.rays.iter().map(|(_, ray)| *ray).collect();
        }
        Casting { rays, step_px: f64::from(step_px), bands: bands(height.div_ceil(step_px) as usize), drawn }
    };
    match &way.tiles {
        None => vec![casting(pixels, 1, true)],
        Some(tiles) => {
            let full = tiles.pixels();
            // Rays around full tiles are cast for the tiles beside them.
            let between = 1.2 * (pixels - full) / f64::from(way.step_px).powi(2);
            vec![casting(between, way.step_px, false), casting(full, 1, true)]
        }
    }
}

/// Why an image cannot be made within `budget_ms`, if so. Of what a GPU casts nothing is predicted but what the processor makes of it.
fn unmet(budget_ms: f64, predicted_ms: Option<f64>, panel_ms: f64) -> Option<String> {
    let what = "beam shape, noise and panel";
    match predicted_ms {
        Some(predicted_ms) if !(predicted_ms <= budget_ms) => Some(format!(
            "{budget_ms} ms cannot be met: the fastest plan is predicted to take {predicted_ms:.2} ms, {panel_ms:.2} ms of them for {what}"
        )),
        None if !(panel_ms <= budget_ms) => Some(format!(
            "{budget_ms} ms cannot be met: {what}, which the processor does, are alone predicted to take {panel_ms:.2} ms"
        )),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::unmet;

    #[test]
    fn a_budget_that_cannot_be_met_says_what_the_panel_takes_of_it() {
        let whole = unmet(5.0, Some(20.0), 8.0).expect("too little");
        assert!(whole.contains("take 20.00 ms, 8.00 ms of them"), "{whole}");
        let after = unmet(5.0, None, 8.0).expect("too little, whatever a GPU takes");
        assert!(after.contains("alone predicted to take 8.00 ms"), "{after}");
        assert_eq!([unmet(5.0, Some(5.0), 8.0), unmet(5.0, None, 4.0)], [None, None]);
        assert!(unmet(5.0, Some(f64::NAN), 0.0).is_some());
    }
}
