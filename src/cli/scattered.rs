//! The scatter that a scene asks of a render: photons followed until it is good enough, or little; or what a network says.

use std::path::Path;

use crate::geometry::View;
use crate::image::Image;
use crate::render::{Origin, Scatter};
use crate::reporter::Reporter;
use crate::scene::model::{Formation, ScatterModel, Scene};
use crate::transport::{BATCH, Histories, Page, Simulation, TransportError};

/// Columns and rows of the raster: scatter is smooth over centimetres.
const GRID_PX: [usize; 2] = [16, 12];
/// Photons after which scatter is as good as it is, and after which it may be known to be little.
const MOST_HISTORIES: u64 = 200_000_000;
const ENOUGH_FOR_LITTLE: u64 = 1_000_000;
/// Standard error over all that arrives below which nobody needs more photons.
const NEGLIGIBLE: f64 = 3e-6;

/// Why no more photons are followed.
struct LittleScatters;

/// Why nobody knows the scatter.
#[derive(Debug, thiserror::Error)]
pub enum ScatteredError {
    /// The scene.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The network.
    #[cfg(feature = "learn")]
    #[error(transparent)]
    Network(#[from] crate::transport::PredictError),
    /// None is there.
    #[error("model.scatter is \"network\": {0}")]
    NoNetwork(&'static str),
}

/// Scatter of `scene` from `view`: with a median relative standard error of `rel_error` where photons are followed, as `network` has it where
/// the scene asks one; `None` where the scene asks for none, or its formation has none.
///
/// # Errors
/// As [`Simulation::new`]; when there is no such network.
pub fn scattered(
    scene: &Scene,
    view: &View,
    rel_error: f64,
    network: Option<&Path>,
    reporter: &Reporter,
) -> Result<Option<Scatter>, ScatteredError> {
    match scene.model.scatter {
        ScatterModel::Off => Ok(None),
        _ if scene.model.formation == Formation::Naive => Ok(None),
        ScatterModel::MonteCarlo => Ok(Some(follow_photons(scene, view, rel_error, reporter)?)),
        ScatterModel::Network => ask_network(scene, view, network, reporter).map(Some),
    }
}

#[cfg(feature = "learn")]
fn ask_network(scene: &Scene, view: &View, network: Option<&Path>, reporter: &Reporter) -> Result<Scatter, ScatteredError> {
    use crate::transport::{PredictError, network_inputs, predicted};
    const NONE: &str = "none comes with this version; --scatter-network NAME names one that `sidecarm train scatter` has made";
    let (channels, scalars) = network_inputs();
    let name = network.ok_or(ScatteredError::NoNetwork(NONE))?;
    let network = crate::infer::LoadedNetwork::load(name, channels, scalars).map_err(PredictError::Network)?;
    let scatter = predicted(&network, scene, view)?;
    if let Origin::Network { outside, .. } = &scatter.from
        && !outside.is_empty()
    {
        let what = outside.join("; ");
        reporter.warn("scatter", format_args!("the network was not trained for this scene, its scatter may be anything: {what}"));
    }
    Ok(scatter)
}

#[cfg(not(feature = "learn"))]
fn ask_network(_: &Scene, _: &View, _: Option<&Path>, _: &Reporter) -> Result<Scatter, ScatteredError> {
    Err(ScatteredError::NoNetwork("this program was built without the feature `learn`"))
}

fn follow_photons(scene: &Scene, view: &View, rel_error: f64, reporter: &Reporter) -> Result<Scatter, TransportError> {
    let seed = scene.model.seed;
    let asked = Histories { count: MOST_HISTORIES, seed, grid_px: GRID_PX, rel_error: Some(rel_error), ..Histories::default() };
    let simulation = Simulation::new(scene, view, asked)?;
    let cells = 0..simulation.unattenuated().len();
    let mut tally = simulation.tally();
    let progress = reporter.progress("scatter: per mille of the photons", 1000);
    let mut shown = 0;
    // What stops it early is no error.
    let _ = simulation.run(&mut tally, |tally| {
        let done = (1000.0 * (rel_error / simulation.relative_error(tally)).powi(2)).min(1000.0) as u64;
        progress.advance(done.saturating_sub(shown));
        shown = done.max(shown);
        let is_little = |cell: usize| {
            let (found, primary) = (tally.scatter(cell, BATCH), tally.signal(Page::Primary, cell, BATCH).mean);
            found.standard_error <= NEGLIGIBLE * (primary + found.mean)
        };
        match tally.batches * BATCH >= ENOUGH_FOR_LITTLE && cells.clone().all(is_little) {
            true => Err(LittleScatters),
            false => Ok(()),
        }
    });
    let (histories, relative_error) = (tally.batches * BATCH, simulation.relative_error(&tally));
    if histories >= MOST_HISTORIES && !(relative_error <= rel_error) {
        let good = 100.0 * relative_error;
        reporter.warn("scatter", format_args!("after {histories} photons the scatter is good to {good:.1} % in the median cell"));
    }
    let image = |pixels: Vec<f64>| Image { width: GRID_PX[0], height: GRID_PX[1], pixels };
    Ok(Scatter {
        signal: image(cells.clone().map(|cell| tally.scatter(cell, BATCH).mean).collect()),
        error: image(cells.map(|cell| tally.scatter(cell, BATCH).standard_error).collect()),
        unattenuated: image(simulation.unattenuated().to_vec()),
        from: Origin::Photons { histories, seed },
        relative_error,
    })
}
