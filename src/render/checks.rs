//! What a scene and a plan must be before anything is rendered.

use super::plan::{Executor, Plan};
use super::{RenderError, chain};
use crate::scene::model::{Scene, Voxels};

/// The first number of the scene that makes no sense.
pub(super) fn check(scene: &Scene) -> Result<(), RenderError> {
    if let Some(view) = &scene.view {
        view.check()?;
    }
    chain::check(scene)?;
    let n0 = scene.beam.photons_per_pixel;
    if !(n0 > 0.0 && n0.is_finite()) {
        return Err(RenderError::Number { what: "beam.photons_per_pixel", value: n0, expected: "a positive number" });
    }
    let kernel = &scene.detector.crosstalk;
    if kernel.iter().any(|row| row.len() != kernel.len()) || (!kernel.is_empty() && kernel.len().is_multiple_of(2)) {
        return Err(RenderError::Number {
            what: "detector.crosstalk: rows",
            value: kernel.len() as f64,
            expected: "an odd square",
        });
    }
    if let Some(weight) = kernel.iter().flatten().find(|weight| !(**weight >= 0.0)) {
        return Err(RenderError::Number { what: "detector.crosstalk: a number", value: *weight, expected: "0 or more" });
    }
    let sum: f64 = kernel.iter().flatten().sum();
    if !kernel.is_empty() && !((sum - 1.0).abs() <= 1e-6) {
        return Err(RenderError::Number { what: "detector.crosstalk: the sum", value: sum, expected: "1 within 1e-6" });
    }
    if let Some(readout) = scene.detector.readout_noise
        && !(readout.row_correlation >= 0.0 && readout.row_correlation < 1.0)
    {
        let value = readout.row_correlation;
        return Err(RenderError::Number { what: "detector.readout_noise.row_correlation", value, expected: "from 0 to below 1" });
    }
    Ok(())
}

/// Whether a logged plan was made for this scene.
pub(super) fn check_plan(plan: &Plan, scene: &Scene) -> Result<(), RenderError> {
    if scene.model.voxels == Voxels::PiecewiseConstant && plan.executor != Executor::Reference {
        return Err(RenderError::ReferenceOnly { what: "model.voxels \"piecewise_constant\"" });
    }
    let names: Vec<String> = scene.materials.iter().map(|material| material.name.clone()).collect();
    if plan.materials != names {
        return Err(RenderError::PlanMismatch { what: "materials", planned: plan.materials.join(", "), found: names.join(", ") });
    }
    let size = scene.view.map_or([0, 0], |view| view.size_px);
    if plan.size_px != size {
        return Err(RenderError::PlanMismatch {
            what: "size_px",
            planned: format!("{:?}", plan.size_px),
            found: format!("{size:?}"),
        });
    }
    if let Some(tiles) = plan.full_tiles.as_ref().filter(|tiles| tiles.size_px() != size) {
        let planned = format!("{:?}", tiles.size_px());
        return Err(RenderError::PlanMismatch { what: "full_tiles.size_px", planned, found: format!("{size:?}") });
    }
    let step = plan.step_px;
    if !matches!(step, 1 | 2 | 4) {
        let found = "nothing; expected 1, 2 or 4".to_owned();
        return Err(RenderError::PlanMismatch { what: "step_px", planned: step.to_string(), found });
    }
    Ok(())
}
