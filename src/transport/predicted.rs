//! Scatter that a network says instead of photons.

use super::columns::{CHANNELS, SCALARS};
use super::error::TransportError;
use super::simulation::{Histories, Simulation};
use crate::geometry::View;
use crate::image::Image;
use crate::infer::{CELL_COLUMNS, CELL_ROWS, COLUMNS, InferError, Input, ROWS, ScatterNetwork};
use crate::render::{Origin, Scatter};
use crate::scene::model::Scene;

/// Key of a card's figure: Σ(Ŝ−S)²/ΣS² of what was not trained on.
const ERROR: &str = "nmse";

/// Why a network says nothing about a scene.
#[derive(Debug, thiserror::Error)]
pub enum PredictError {
    /// The scene.
    #[error(transparent)]
    Scene(#[from] TransportError),
    /// The network.
    #[error(transparent)]
    Network(#[from] InferError),
}

/// What a network has to be trained on to be asked here: names of its channels and of its numbers.
#[must_use]
pub fn network_inputs() -> (&'static [&'static str], &'static [&'static str]) {
    (&CHANNELS, &SCALARS)
}

/// Scatter of `scene` seen in `view` as `network` has it, with the error of its card; with one as large as the scatter where the scene is
/// unlike what it was trained on, or nobody knows its error.
///
/// # Errors
/// As [`Simulation::new`]; when the network takes other inputs.
pub fn predicted(network: &dyn ScatterNetwork, scene: &Scene, view: &View) -> Result<Scatter, PredictError> {
    let raster = Histories { count: 1, seed: scene.model.seed, grid_px: [CELL_COLUMNS, CELL_ROWS], ..Histories::default() };
    let simulation = Simulation::new(scene, view, raster)?;
    let columns = simulation.columns([COLUMNS, ROWS]);
    let input = Input { inputs: columns.channels.concat(), scalars: columns.scalars.to_vec(), scale: columns.scale };
    let found = network.predict(&input)?;
    let shares: Vec<f64> = found.single.iter().zip(&found.multiple).map(|(once, more)| once + more).collect();
    let rms = (shares.iter().map(|share| share * share).sum::<f64>() / shares.len() as f64).sqrt();
    let known = network.card().held_out.get(ERROR).map(|nmse| nmse.max(0.0).sqrt());
    let relative_error = if found.outside.is_empty() { known.unwrap_or(1.0) } else { 1.0 };
    let unattenuated = simulation.unattenuated().to_vec();
    let image = |pixels: Vec<f64>| Image { width: CELL_COLUMNS, height: CELL_ROWS, pixels };
    Ok(Scatter {
        signal: image(shares.iter().zip(&unattenuated).map(|(share, unit)| share * unit).collect()),
        error: image(unattenuated.iter().map(|unit| relative_error * rms * unit).collect()),
        unattenuated: image(unattenuated),
        from: Origin::Network { sha256: network.card().weights_sha256.clone(), outside: found.outside },
        relative_error,
    })
}
