//! The scatter that a scene asks of a render: photons followed until it is good enough, or little; or what a network says.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::path::Path;

use super::following::{Keep, Pace, begin, follow, gpu_or_said, lasting, needed};
use super::network_targets::goodness;
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
/// Photons that are followed at most. The sums have room for ten thousand times as many, but no machine the time: these take a GPU minutes, and
/// make ten times the paper's image.
const MOST_HISTORIES: u64 = 100_000_000_000;
/// Photons after which it is known whether so many will do, and after which scatter may be known to be little.
const ENOUGH_TO_TELL: u64 = 200_000_000;
const ENOUGH_FOR_LITTLE: u64 = 1_000_000;
/// Standard error over all that arrives below which nobody needs more photons.
const NEGLIGIBLE: f64 = 3e-6;

/// Median relative standard error that is good enough, unless somebody says otherwise.
pub const SCATTER_ERROR: f64 = 0.02;

/// Photons by which the cost of many is told.
const PILOT_HISTORIES: u64 = 131_072;
/// What is faster.
const ADVICE: &str = "a larger --scatter-error takes less, model.scatter \"network\" a fraction of a second";

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
    /// Where their sums are kept meanwhile, if anywhere.
    pub keep: Option<Keep<'a>>,
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
                let predicted_ms = photons_cost(scene, view, asked)?.ms;
                if !(predicted_ms <= budget_ms) {
                    let time = lasting(predicted_ms);
                    let words = format!("--budget-ms {budget_ms}: following photons is predicted to take {time}; {ADVICE}");
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
                None => format!("{network_ms:.0} ms; {}", goodness(scatter.relative_error, figures(asked.network).as_ref())),
            };
            (off, network)
        }
        Err(error) => ("nothing; lacks all of it".to_owned(), error.to_string()),
    };
    let photons = match photons_cost(scene, view, asked) {
        Ok(Cost { ms, photons }) => format!("about {}; {}", lasting(ms), reaches(photons, asked.rel_error)),
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

/// The figures in the card of the network `name`, or of the one that comes with the program.
#[cfg(feature = "learn")]
fn figures(name: Option<&Path>) -> Option<BTreeMap<String, f64>> {
    use crate::infer::{LoadedNetwork, ScatterNetwork};
    use crate::transport::{CHANNELS, SCALARS};
    let network = match name {
        Some(name) => LoadedNetwork::load(name, &CHANNELS, &SCALARS),
        None => LoadedNetwork::shipped(&CHANNELS, &SCALARS),
    };
    Some(network.ok()?.card().held_out.clone())
}

#[cfg(not(feature = "learn"))]
fn figures(_: Option<&Path>) -> Option<BTreeMap<String, f64>> {
    None
}

/// Whether nobody need go on after so many photons, for it would take more than anybody follows.
fn is_out_of_reach(histories: u64, needed: f64) -> bool {
    histories >= ENOUGH_TO_TELL && !(needed <= MOST_HISTORIES as f64)
}

/// How good scatter gets that takes so many photons to be good to `wanted`.
fn reaches(photons: f64, wanted: f64) -> String {
    let percent = 100.0 * wanted;
    if photons <= MOST_HISTORIES as f64 {
        format!("{photons:.1e} photons, good to {percent:.2} % in the median cell (--scatter-error)")
    } else if photons.is_finite() {
        format!("{percent:.2} % in the median cell (--scatter-error) is out of reach: {photons:.1e} photons")
    } else {
        format!("most cells saw no scatter of {PILOT_HISTORIES} photons")
    }
}

/// What following photons costs.
struct Cost {
    /// Time on this machine.
    ms: f64,
    /// Photons that the wanted relative standard error takes, whether or not anybody follows so many.
    photons: f64,
}

/// What following photons to the wanted relative standard error costs, by a few.
fn photons_cost(scene: &Scene, view: &View, asked: &Asked<'_>) -> Result<Cost, ScatteredError> {
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
    let photons = needed(tally.histories(), simulation.relative_error(&tally), asked.rel_error);
    let least = if photons <= MOST_HISTORIES as f64 { photons } else { ENOUGH_TO_TELL as f64 };
    // Precision is judged after whole steps.
    let step = if gpu.is_some() { tally.histories() } else { simulation.batches_at_once() * BATCH } as f64;
    let followed = (least / step).ceil().max(1.0) * step;
    Ok(Cost { ms: prepared_ms + watch.ms() / tally.histories() as f64 * followed, photons })
}

/// Follows photons until the scatter is known as well as it is asked for, or it is known that nobody need go on.
fn followed(
    simulation: &Simulation,
    gpu: Option<&mut GpuTransport>,
    asked: &Asked<'_>,
    reporter: &Reporter,
) -> Result<Tally, ScatteredError> {
    let mut tally = begin(simulation, gpu.as_deref(), asked.keep.as_ref(), reporter)?;
    let progress = reporter.progress("scatter: per mille of the photons", 1000);
    let in_all = |tally: &Tally| needed(tally.histories(), simulation.relative_error(tally), asked.rel_error);
    let is_enough = |tally: &Tally| {
        let is_little = |cell: usize| {
            let (found, primary) = (tally.scatter(cell), tally.signal(Page::Primary, cell).mean);
            found.standard_error <= NEGLIGIBLE * (primary + found.mean)
        };
        let histories = tally.histories();
        let little_scatters = histories >= ENOUGH_FOR_LITTLE && (0..simulation.unattenuated().len()).all(is_little);
        little_scatters || is_out_of_reach(histories, in_all(tally))
    };
    // What an interrupted run left may have been its end.
    if is_enough(&tally) {
        return Ok(tally);
    }
    let (mut pace, mut shown) = (Pace::new(&tally), 0);
    let after = |tally: &Tally| {
        let (histories, in_all) = (tally.histories(), in_all(tally));
        let done = (1000.0 * histories as f64 / in_all).min(1000.0) as u64;
        progress.advance(done.saturating_sub(shown));
        shown = done.max(shown);
        if in_all <= MOST_HISTORIES as f64
            && let Some((in_all, left_ms)) = pace.long(histories, || in_all)
        {
            let (percent, time) = (100.0 * asked.rel_error, lasting(left_ms));
            reporter.note(format_args!("scatter to {percent:.2} %: {in_all:.1e} photons, about {time} to go; {ADVICE}"));
        }
        !is_enough(tally)
    };
    follow::<ScatteredError>(simulation, gpu, &mut tally, asked.keep.as_ref(), after)?;
    Ok(tally)
}

fn follow_photons(scene: &Scene, view: &View, asked: &Asked<'_>, reporter: &Reporter) -> Result<Scatter, ScatteredError> {
    let (seed, rel_error) = (scene.model.seed, asked.rel_error);
    let wanted = Histories { count: MOST_HISTORIES, seed, grid_px: GRID_PX, rel_error: Some(rel_error), ..Histories::default() };
    let simulation = Simulation::new(scene, view, wanted)?;
    let cells = 0..simulation.unattenuated().len();
    let (mut found, mut asked) = (None, *asked);
    if let Some(mut gpu) = asked.gpu.and_then(|gpu| gpu_or_said(gpu, &simulation, reporter)) {
        match followed(&simulation, Some(&mut gpu), &asked, reporter) {
            Err(ScatteredError::Device(error)) => {
                reporter.warn("scatter", format_args!("{error}: followed again on {}", cpu_name()));
                asked.keep = asked.keep.map(Keep::anew);
            }
            tally => found = Some((tally?, gpu.adapter().to_owned())),
        }
    }
    let (tally, device) = match found {
        Some(found) => found,
        None => (followed(&simulation, None, &asked, reporter)?, "cpu".to_owned()),
    };
    let (histories, relative_error) = (tally.histories(), simulation.stated_error(&tally));
    let in_all = needed(histories, simulation.relative_error(&tally), rel_error);
    let is_short = histories >= MOST_HISTORIES || is_out_of_reach(histories, in_all);
    if is_short && !(relative_error <= rel_error) {
        let good = if relative_error.is_finite() {
            format!("the scatter is good to {:.2} % in the median cell", 100.0 * relative_error)
        } else {
            "most cells saw too little scatter to tell how good it is".to_owned()
        };
        reporter.warn("scatter", format_args!("after {histories} photons {good}; {:.2} % is out of reach", 100.0 * rel_error));
    }
    let image = |pixels: Vec<f64>| Image { width: GRID_PX[0], height: GRID_PX[1], pixels };
    Ok(Scatter {
        signal: image(cells.clone().map(|cell| tally.scatter(cell).mean).collect()),
        error: image(cells.map(|cell| tally.scatter(cell).told().standard_error).collect()),
        unattenuated: image(simulation.unattenuated().to_vec()),
        from: Origin::Photons { histories, seed, device },
        relative_error,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What can be reached is followed to the end; what cannot ends as soon as that is known.
    #[test]
    fn a_wish_that_can_be_reached_is_followed_to_the_end() {
        // 3 % by four million: 0.19 % takes a thousand million.
        let photons = needed(4_000_000, 0.03, 0.03 / 250.0_f64.sqrt());
        assert!((photons / 1e9 - 1.0).abs() < 1e-9, "{photons}");
        for (histories, needed, ends) in [
            (ENOUGH_TO_TELL, 1e9, false),
            (ENOUGH_TO_TELL, 5e10, false),
            (ENOUGH_TO_TELL, 1e13, true),
            (ENOUGH_TO_TELL, f64::INFINITY, true),
            (ENOUGH_TO_TELL, f64::NAN, true),
            (ENOUGH_FOR_LITTLE, 1e13, false),
        ] {
            assert_eq!(is_out_of_reach(histories, needed), ends, "{histories} of {needed}");
        }
    }

    #[test]
    fn what_photons_cost_is_told_in_times_for_people_and_never_promised_in_vain() {
        let times = [0.4e3, 59e3, 600e3, 9e6].map(lasting);
        assert_eq!(times, ["0.4 s", "59 s", "10 min", "2.5 h"]);
        assert!(reaches(1e9, 0.002).contains("good to 0.20 %"), "{}", reaches(1e9, 0.002));
        assert!(reaches(1e13, 1e-5).contains("out of reach") && !reaches(1e13, 1e-5).contains("good to"));
        assert!(reaches(f64::INFINITY, 0.02).contains("saw no scatter"));
    }

    #[cfg(feature = "learn")]
    #[test]
    fn the_figures_are_those_of_the_card() {
        let card = include_str!("../../calibration/networks/scatter.json");
        let card: serde_json::Value = serde_json::from_str(card).expect("JSON");
        let found = figures(None).expect("the shipped network has figures");
        for key in ["nmse", "mean_rms", "edge_bias", "nmse of pelvis"] {
            assert!(found[key].is_finite() && Some(found[key]) == card["held_out"][key].as_f64(), "{key}: {found:?}");
        }
        // None of them is left out because its key is spelt otherwise.
        assert!(!goodness(0.17, Some(&found)).contains("not in its card"));
        assert_eq!(figures(Some(Path::new("no such network"))), None);
    }
}
