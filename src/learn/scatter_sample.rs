//! One sample: a drawn scene, what its rays meet, and the scatter that photons find.

use std::convert::Infallible;

use super::{Shard, Specimen, drawn};
use crate::infer::{CELL_COLUMNS, CELL_ROWS, COLUMNS, ROWS};
use crate::scene::physics::PhysicsError;
use crate::transport::{Columns, Histories, Page, Simulation, TransportError};

/// Columns and rows of what a network is told, and of what it says.
pub const GRID_PX: [usize; 2] = [COLUMNS, ROWS];
/// See [`GRID_PX`].
pub const TRUTH_PX: [usize; 2] = [CELL_COLUMNS, CELL_ROWS];
/// What a sample without a specimen is called.
pub const PHANTOM: &str = "phantom";
/// Batches of photons from which a spread can be told.
pub const LEAST_BATCHES: u64 = 4;
/// Matter lower above the detector than this is through it.
const LOWEST_MM: f32 = 10.0;
/// Mean thickness of what scatters in the open field below which the specimen is not in view.
const IN_VIEW: f64 = 0.15;
/// Median relative standard error beyond which a sample says nothing.
const NOISIEST: f64 = 0.5;

/// What is drawn from.
#[derive(Clone, Copy, Debug)]
pub struct Sampling<'a> {
    /// Specimens, all alike.
    pub specimens: &'a [Specimen],
    /// Share of phantoms among the samples.
    pub phantoms: f64,
    /// Photons that are followed for each.
    pub histories: u64,
}

/// What became of a seed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sampled {
    /// A sample more.
    Kept,
    /// The specimen is not in view, or reaches through the panel.
    NotInView,
    /// Too few photons scatter for a word about it.
    TooNoisy,
}

/// Why there is no sample.
#[derive(Debug, thiserror::Error)]
pub enum SampleError {
    /// A material of the scene.
    #[error(transparent)]
    Physics(#[from] PhysicsError),
    /// The transport.
    #[error(transparent)]
    Transport(#[from] TransportError),
}

/// Adds the sample of `seed` to `shard`, unless there is nothing in view or too little arrives.
///
/// # Errors
/// When a material is not in the tables, or a specimen cannot be simulated.
pub fn sample(from: &Sampling<'_>, seed: u64, shard: &mut Shard) -> Result<Sampled, SampleError> {
    let specimens = from.specimens;
    let turn = |times: f64| (seed as f64 * times).fract();
    // Evenly over the seeds, whatever their number.
    let is_phantom = specimens.is_empty() || turn(0.618_033_988_749_895) < from.phantoms;
    let specimen = (!is_phantom).then(|| &specimens[(turn(0.754_877_666_246_693) * specimens.len() as f64) as usize]);
    let (scene, view) = drawn(specimen, seed)?;
    let asked = Histories { count: from.histories, seed, grid_px: TRUTH_PX, ..Histories::default() };
    let simulation = Simulation::new(&scene, &view, asked)?;
    let columns = simulation.columns(GRID_PX);
    if !(scattering(&columns) > IN_VIEW) || reaches_the_panel(&columns) {
        return Ok(Sampled::NotInView);
    }
    let mut tally = simulation.tally();
    let run = simulation.run(&mut tally, |_| Ok::<(), Infallible>(()));
    let Ok(()) = run;
    if !(simulation.relative_error(&tally) < NOISIEST) {
        return Ok(Sampled::TooNoisy);
    }
    let cells = 0..TRUTH_PX[0] * TRUTH_PX[1];
    let unit = simulation.unshaped();
    let signal = |page: Page, cell: usize| tally.signal(page, cell);
    for cell in cells.clone() {
        let once = signal(Page::Compton, cell).mean + signal(Page::Rayleigh, cell).mean;
        shard.truth.push((once / unit[cell]) as f32);
    }
    shard.truth.extend(cells.clone().map(|cell| (signal(Page::Multiple, cell).mean / unit[cell]) as f32));
    for cell in cells.clone() {
        let once = signal(Page::Compton, cell).standard_error.hypot(signal(Page::Rayleigh, cell).standard_error);
        shard.truth_error.push((once / unit[cell]) as f32);
    }
    shard.truth_error.extend(cells.clone().map(|cell| (signal(Page::Multiple, cell).standard_error / unit[cell]) as f32));
    shard.truth_error.extend(cells.map(|cell| (tally.scatter(cell).standard_error / unit[cell]) as f32));
    columns.channels.iter().for_each(|channel| shard.inputs.extend(channel));
    shard.scalars.extend(columns.scalars);
    shard.scale.push(columns.scale);
    shard.specimens.push(specimen.map_or(PHANTOM, |specimen| &specimen.name).to_owned());
    shard.seeds.push(seed);
    Ok(Sampled::Kept)
}

/// Mean over the open field of the thickness of what scatters.
fn scattering(columns: &Columns) -> f64 {
    let [_, compton, rayleigh, _, _, _, open, ..] = &columns.channels;
    let (mut sum, mut all) = (0.0, 0.0);
    for ((compton, rayleigh), open) in compton.iter().zip(rayleigh).zip(open) {
        sum += f64::from(open * (compton + rayleigh));
        all += f64::from(*open);
    }
    sum / all
}

/// Whether matter that scatters goes on to the detector plane: no C-arm can be so.
fn reaches_the_panel(columns: &Columns) -> bool {
    let [_, compton, _, _, height_mm, spread_mm, ..] = &columns.channels;
    // A slab's half thickness is √3 of its standard deviation.
    let lowest = height_mm.iter().zip(spread_mm).map(|(height_mm, spread_mm)| height_mm - 1.73 * spread_mm);
    lowest.zip(compton).any(|(lowest_mm, compton)| *compton > 0.05 && !(lowest_mm > LOWEST_MM))
}
