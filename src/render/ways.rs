//! What is asked for, and the ways to cast it that a scene allows: how volumes are sampled, which pixels are skipped.

use super::Quantity;
use super::fits::Wish;
use super::pilot::Pilot;
use super::plan::{Executor, Sampling, noise_applies};
use super::survey::{self, Survey};
use super::tiles::Tiles;
use crate::geometry::View;
use crate::scene::model::Scene;

/// What a user asks for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Goal {
    /// |Δ line_integral| / max(1, line_integral), 99.9th percentile.
    MaxError(f64),
    /// Wall milliseconds, preparation of volumes aside.
    BudgetMs(f64),
    /// This, as far as the scene allows it (where no pixel can be skipped, none is), to measure it: sampling, tolerance of the energies (none: every bin) and cast pixels.
    Explicit {
        /// How volumes are sampled.
        sampling: Sampling,
        /// Bound of the energies' part.
        energies: Option<f64>,
        /// Every which pixel.
        step_px: u32,
    },
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

impl Task<'_> {
    pub(super) fn wish(&self) -> Wish<'_> {
        Wish { scene: self.scene, noise: noise_applies(self.scene, self.quantity) }
    }
}

/// One way to cast it.
#[derive(Clone, Debug)]
pub(super) struct Way {
    pub(super) sampling: Sampling,
    pub(super) step_px: u32,
    /// Tiles that are cast in full, where pixels are skipped.
    pub(super) tiles: Option<Tiles>,
    pub(super) sampling_error: f64,
    pub(super) interpolation: f64,
}

/// Ways to cast every pixel.
pub(super) fn whole_ways(task: &Task, pilot: &Pilot, asked: Sampling, rounding: f64) -> Vec<Way> {
    let way = |sampling, sampling_error| Way { sampling, step_px: 1, tiles: None, sampling_error, interpolation: 0.0 };
    if task.executor != Executor::Cpu {
        return vec![way(asked, task.executor.stated_error())];
    }
    if asked == Sampling::None {
        return vec![way(Sampling::None, 2e-6)];
    }
    // f64 positions; f32 interpolation weights and sums.
    let cells = way(Sampling::ExactCells, 2e-6);
    let mut all = Vec::new();
    // Where no ray can be crossed in slabs, no plan says so.
    if task.slabs && pilot.walked_share < 1.0 {
        all.push(way(Sampling::ExactSlabs, 4e-6));
    }
    all.push(cells.clone());
    if task.fixed_step_px > 0 && pilot.walked_share < 1.0 {
        all.push(way(Sampling::FixedSlabs, rounding));
    }
    match task.goal {
        Goal::MaxError(_) | Goal::BudgetMs(_) => all,
        Goal::Explicit { sampling, .. } => vec![all.into_iter().find(|known| known.sampling == sampling).unwrap_or(cells)],
    }
}

/// Ways to skip pixels, sampling as the ways in `whole` do, which cast all of them.
pub(super) fn skipping_ways<'w>(task: &Task, survey: &Survey, whole: impl Iterator<Item = &'w Way>) -> Vec<Way> {
    let mut samplings: Vec<(Sampling, f64)> = Vec::new();
    for way in whole {
        if !samplings.iter().any(|(known, _)| *known == way.sampling) {
            samplings.push((way.sampling, way.sampling_error));
        }
    }
    let mut ways = Vec::new();
    for skipping in survey.ways() {
        for (step_px, interpolation) in survey::STEPS.into_iter().zip(skipping.errors) {
            let asked = match task.goal {
                Goal::Explicit { step_px: asked, .. } => asked == step_px,
                _ => true,
            };
            for (sampling, sampling_error) in samplings.iter().copied().filter(|_| asked) {
                if sampling != Sampling::FixedSlabs || step_px <= task.fixed_step_px {
                    ways.push(Way { sampling, step_px, tiles: Some(skipping.tiles.clone()), sampling_error, interpolation });
                }
            }
        }
    }
    if let Goal::Explicit { .. } = task.goal {
        // As few pixels as the outlines allow.
        ways.truncate(1);
    }
    ways
}
