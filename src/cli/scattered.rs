//! The scatter that a scene asks of a render: photons followed until it is good enough, or little; or what a network says.

use std::convert::Infallible;
use std::path::Path;

use crate::geometry::View;
use crate::gpu::{Gpu, cpu_name};
use crate::image::Image;
use crate::render::{Origin, Scatter};
use crate::reporter::Reporter;
use crate::scene::model::{Formation, ScatterModel, Scene};
use crate::time::Stopwatch;
use crate::transport::{
    BATCH, GpuTransport, GpuTransportError, Histories, NetworkError, NetworkScatter, Page, Simulation, Tally, TransportError,
};

/// Columns and rows of the raster: scatter is smooth over centimetres.
const GRID_PX: [usize; 2] = [16, 12];
/// Photons after which scatter is as good as it is, and after which it may be known to be little.
const MOST_HISTORIES: u64 = 200_000_000;
const ENOUGH_FOR_LITTLE: u64 = 1_000_000;
/// Standard error over all that arrives below which nobody needs more photons.
const NEGLIGIBLE: f64 = 3e-6;

/// Median relative standard error that is good enough, unless somebody says otherwise.
pub const SCATTER_ERROR: f64 = 0.02;

/// Relative error of an image's mean scatter that a network ought to keep.
const MEAN_TARGET: f64 = 0.05;
/// Key of a card's figure: the root mean square of that error over images that the network was not trained on.
#[cfg(feature = "learn")]
const MEAN_ERROR: &str = "mean_rms";

/// Photons by which the cost of many is told.
const PILOT_HISTORIES: u64 = 131_072;
/// What is faster.
const ADVICE: &str = "a larger --scatter-error takes less, model.scatter \"network\" a fraction of a second";

/// Why no more photons are followed.
enum Stop {
    LittleScatters,
    Device(GpuTransportError),
}

impl From<GpuTransportError> for Stop {
    fn from(error: GpuTransportError) -> Self {
        Self::Device(error)
    }
}

/// Why nobody knows the scatter.
#[derive(Debug, thiserror::Error)]
pub enum ScatteredError {
    /// The scene.
    #[error(transparent)]
    Transport(#[from] TransportError),
    /// The GPU.
    #[error(transparent)]
    Device(#[from] GpuTransportError),
    /// The network.
    #[error(transparent)]
    Network(#[from] NetworkError),
}

/// What is asked beside the scene.
#[derive(Clone, Copy, Debug)]
pub struct Asked<'a> {
    /// Median relative standard error that photons are followed to.
    pub rel_error: f64,
    /// The network, a path without ending; else the one that comes with the program.
    pub network: Option<&'a Path>,
    /// Warn where photons will take longer.
    pub budget_ms: Option<f64>,
    /// What follows them, where it can; else the processor.
    pub gpu: Option<&'a Gpu>,
}

/// Scatter of `scene` from `view`, as the scene asks for it; `None` where it asks for none, or its formation has none.
///
/// # Errors
/// As [`Simulation::new`]; when there is no such network.
pub fn scattered(scene: &Scene, view: &View, asked: &Asked<'_>, reporter: &Reporter) -> Result<Option<Scatter>, ScatteredError> {
    match scene.model.possible_scatter() {
        ScatterModel::Off => Ok(None),
        ScatterModel::MonteCarlo => {
            if let Some(budget_ms) = asked.budget_ms {
                let predicted_ms = photons_ms(scene, view, asked)?;
                if !(predicted_ms <= budget_ms) {
                    let seconds = predicted_ms / 1e3;
                    let words =
                        format!("--budget-ms {budget_ms}: following photons is predicted to take {seconds:.1} s; {ADVICE}");
                    reporter.warn("budget", words);
                }
            }
            Ok(Some(follow_photons(scene, view, asked, reporter)?))
        }
        ScatterModel::Network => Ok(Some(NetworkScatter::open(asked.network)?.say(scene, view, reporter)?)),
    }
}

/// Cost and error of every way to the scatter of `scene` from `view` on this machine, for people; why not, where there is none.
#[must_use]
pub fn ways(scene: &Scene, view: &View, asked: &Asked<'_>) -> String {
    if scene.model.formation == Formation::Naive {
        return "scatter: naive formation has none".to_owned();
    }
    let quiet = Reporter::silent();
    let watch = Stopwatch::start();
    let said = NetworkScatter::open(asked.network).and_then(|network| network.say(scene, view, &quiet));
    let network_ms = watch.ms();
    let (off, network) = match said {
        Ok(scatter) => {
            let sum = |image: &Image<f64>| image.pixels.iter().sum::<f64>();
            let percent = 100.0 * sum(&scatter.signal) / sum(&scatter.unattenuated);
            let off = format!("nothing; lacks what the network takes for {percent:.2} % of the unattenuated signal");
            let network = match scatter.unlike() {
                Some(words) => format!("{network_ms:.0} ms; {words}"),
                None => format!("{network_ms:.0} ms; {}", goodness(scatter.relative_error, mean_error(asked.network))),
            };
            (off, network)
        }
        Err(error) => ("nothing; lacks all of it".to_owned(), error.to_string()),
    };
    let photons = match photons_ms(scene, view, asked) {
        Ok(ms) => {
            format!("about {:.1} s; good to {:.0} % in the median cell (--scatter-error)", ms / 1e3, 100.0 * asked.rel_error)
        }
        Err(error) => error.to_string(),
    };
    let rows = [
        (ScatterModel::Off, "off", off),
        (ScatterModel::Network, "network", network),
        (ScatterModel::MonteCarlo, "monte_carlo", photons),
    ];
    let line = |(model, name, words): &(ScatterModel, &str, String)| {
        let asked = if *model == scene.model.scatter { " (asked for)" } else { "" };
        format!("\n  {name}{asked}: {words}")
    };
    format!("scatter, cost and error of each way:{}", rows.iter().map(line).collect::<String>())
}

/// How good a network is by its card, and whether that is as good as it ought to be.
fn goodness(relative_error: f64, mean_error: Option<f64>) -> String {
    let cells = format!("good to {:.0} % of the scatter's root mean square", 100.0 * relative_error);
    let Some(error) = mean_error else { return format!("{cells}; its card does not say how good an image's mean is") };
    let (percent, target, met) = (100.0 * error, 100.0 * MEAN_TARGET, if error <= MEAN_TARGET { "met" } else { "missed" });
    format!("{cells}, and to {percent:.0} % of an image's mean scatter (the target of {target:.0} % is {met})")
}

/// What the card of the network `name`, or of the one that comes with the program, says of the mean scatter of images.
#[cfg(feature = "learn")]
fn mean_error(name: Option<&Path>) -> Option<f64> {
    use crate::infer::{LoadedNetwork, ScatterNetwork};
    use crate::transport::{CHANNELS, SCALARS};
    let network = match name {
        Some(name) => LoadedNetwork::load(name, &CHANNELS, &SCALARS),
        None => LoadedNetwork::shipped(&CHANNELS, &SCALARS),
    };
    network.ok()?.card().held_out.get(MEAN_ERROR).copied()
}

#[cfg(not(feature = "learn"))]
fn mean_error(_: Option<&Path>) -> Option<f64> {
    None
}

/// `simulation` on `gpu`; where it cannot be, the processor follows the photons, which is said.
pub fn gpu_or_said<'a>(gpu: &'a Gpu, simulation: &Simulation, reporter: &Reporter) -> Option<GpuTransport<'a>> {
    let told = |error: GpuTransportError| {
        reporter.note(format_args!("photons are followed on {}: {error}", cpu_name()));
    };
    GpuTransport::new(gpu, simulation).map_err(told).ok()
}

/// How long following photons to the wanted relative standard error takes, by a few.
fn photons_ms(scene: &Scene, view: &View, asked: &Asked<'_>) -> Result<f64, ScatteredError> {
    let watch = Stopwatch::start();
    let pilot = Histories { count: PILOT_HISTORIES, seed: scene.model.seed, grid_px: GRID_PX, ..Histories::default() };
    let simulation = Simulation::new(scene, view, pilot)?;
    let mut gpu = asked.gpu.and_then(|gpu| gpu_or_said(gpu, &simulation, &Reporter::silent()));
    let mut tally = gpu.as_ref().map_or_else(|| simulation.tally(), GpuTransport::tally);
    let prepared_ms = watch.ms();
    let watch = Stopwatch::start();
    match &mut gpu {
        Some(gpu) => gpu.advance(&mut tally)?,
        None => {
            let run = simulation.run(&mut tally, |_| Ok::<(), Infallible>(()));
            let Ok(()) = run;
        }
    }
    let needed = tally.histories() as f64 * (simulation.relative_error(&tally) / asked.rel_error).powi(2);
    let needed = if needed <= MOST_HISTORIES as f64 { needed } else { MOST_HISTORIES as f64 };
    // Precision is judged after whole steps.
    let step = if gpu.is_some() { tally.histories() } else { simulation.batches_at_once() * BATCH } as f64;
    let followed = (needed / step).ceil().max(1.0) * step;
    Ok(prepared_ms + watch.ms() / tally.histories() as f64 * followed)
}

fn follow_photons(scene: &Scene, view: &View, asked: &Asked<'_>, reporter: &Reporter) -> Result<Scatter, ScatteredError> {
    let (seed, rel_error) = (scene.model.seed, asked.rel_error);
    let wanted = Histories { count: MOST_HISTORIES, seed, grid_px: GRID_PX, rel_error: Some(rel_error), ..Histories::default() };
    let simulation = Simulation::new(scene, view, wanted)?;
    let cells = 0..simulation.unattenuated().len();
    let progress = reporter.progress("scatter: per mille of the photons", 1000);
    let mut shown = 0;
    let mut after = |tally: &Tally| {
        let done = (1000.0 * (rel_error / simulation.relative_error(tally)).powi(2)).min(1000.0) as u64;
        progress.advance(done.saturating_sub(shown));
        shown = done.max(shown);
        let is_little = |cell: usize| {
            let (found, primary) = (tally.scatter(cell), tally.signal(Page::Primary, cell).mean);
            found.standard_error <= NEGLIGIBLE * (primary + found.mean)
        };
        match tally.histories() >= ENOUGH_FOR_LITTLE && cells.clone().all(is_little) {
            true => Err(Stop::LittleScatters),
            false => Ok(()),
        }
    };
    let mut found = None;
    if let Some(mut gpu) = asked.gpu.and_then(|gpu| gpu_or_said(gpu, &simulation, reporter)) {
        let mut tally = gpu.tally();
        match gpu.run(&simulation, &mut tally, &mut after) {
            Err(Stop::Device(error)) => reporter.warn("scatter", format_args!("{error}: followed again on {}", cpu_name())),
            _ => found = Some((tally, gpu.adapter().to_owned())),
        }
    }
    let (tally, device) = found.unwrap_or_else(|| {
        let mut tally = simulation.tally();
        // What stops it early is no error.
        let _ = simulation.run(&mut tally, &mut after);
        (tally, "cpu".to_owned())
    });
    let (histories, relative_error) = (tally.histories(), simulation.relative_error(&tally));
    if histories >= MOST_HISTORIES && !(relative_error <= rel_error) {
        let good = 100.0 * relative_error;
        reporter.warn("scatter", format_args!("after {histories} photons the scatter is good to {good:.1} % in the median cell"));
    }
    let image = |pixels: Vec<f64>| Image { width: GRID_PX[0], height: GRID_PX[1], pixels };
    Ok(Scatter {
        signal: image(cells.clone().map(|cell| tally.scatter(cell).mean).collect()),
        error: image(cells.map(|cell| tally.scatter(cell).standard_error).collect()),
        unattenuated: image(simulation.unattenuated().to_vec()),
        from: Origin::Photons { histories, seed, device },
        relative_error,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Only the error of the cells was told, not that of the mean, which misses its target.
    #[test]
    fn how_good_a_network_is_is_told_with_its_target() {
        let good = "good to 17 % of the scatter's root mean square";
        for (error, words) in [
            (Some(0.1265), "and to 13 % of an image's mean scatter (the target of 5 % is missed)"),
            (Some(0.04), "and to 4 % of an image's mean scatter (the target of 5 % is met)"),
            (Some(f64::NAN), "is missed"),
            (None, "its card does not say"),
        ] {
            let said = goodness(0.17, error);
            assert!(said.starts_with(good) && said.contains(words), "{said}");
        }
    }

    #[cfg(feature = "learn")]
    #[test]
    fn the_figure_is_that_of_the_card() {
        let card = include_str!("../../calibration/networks/scatter.json");
        let card: serde_json::Value = serde_json::from_str(card).expect("JSON");
        let error = mean_error(None).expect("the shipped network has figures");
        assert_eq!(Some(error), card["held_out"][MEAN_ERROR].as_f64());
        assert_eq!(mean_error(Some(Path::new("no such network"))), None);
    }
}
