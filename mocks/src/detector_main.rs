//! The `mock-detector` program: air, dark and edge frames of a flat panel, and the truth about it.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::Parser;

use mock_lab::detector::{Panel, Response, Series, write};

/// Frames that a detector calibration needs, and `truth.json`.
#[derive(Debug, Parser)]
#[command(name = "mock-detector", version, after_help = "Example:\n  mock-detector --out /tmp/panel --seed 3 --broken 20 --edge")]
struct Args {
    /// Folder for the frames.
    #[arg(long)]
    out: PathBuf,
    /// Of everything random.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Columns.
    #[arg(long, default_value_t = 256)]
    columns: usize,
    /// Rows.
    #[arg(long, default_value_t = 192)]
    rows: usize,
    /// Stored value per quantum, or per keV with --energy.
    #[arg(long, default_value_t = 0.37)]
    gain: f64,
    /// Stored value without X-rays.
    #[arg(long, default_value_t = 212.0)]
    offset: f64,
    /// Detected quanta per pixel and mAs.
    #[arg(long, default_value_t = 2000.0)]
    quanta_per_mas: f64,
    /// Add up the energy of photons instead of counting quanta.
    #[arg(long)]
    energy: bool,
    /// Scatter of the tube's output from exposure to exposure, as a share.
    #[arg(long, default_value_t = 0.002)]
    output_sigma: f64,
    /// Noise that a whole column has in common in a frame, stored value.
    #[arg(long, default_value_t = 0.0)]
    line_sigma: f64,
    /// Share of a pixel's light that each neighbour sees.
    #[arg(long, default_value_t = 0.0)]
    spread: f64,
    /// Broken pixels of each kind.
    #[arg(long, default_value_t = 0)]
    broken: usize,
    /// Exposures, mAs.
    #[arg(long, value_delimiter = ',', default_values_t = [1.0, 2.0, 4.0, 8.0, 16.0])]
    levels_mas: Vec<f64>,
    /// Tube voltages.
    #[arg(long, value_delimiter = ',', default_values_t = [90.0])]
    kvps: Vec<f64>,
    /// Thicknesses of a copper filter, mm, each at every voltage; the frames state them. Without it they state no filter.
    #[arg(long, value_delimiter = ',')]
    coppers_mm: Vec<f64>,
    /// Air frames per exposure.
    #[arg(long, default_value_t = 4)]
    frames: usize,
    /// Dark frames.
    #[arg(long, default_value_t = 8)]
    darks: usize,
    /// Air frames with a bead left in the beam.
    #[arg(long, default_value_t = 0)]
    beads: usize,
    /// Also an edge frame.
    #[arg(long)]
    edge: bool,
    /// Also a frame of a wedge, at the middle exposure.
    #[arg(long)]
    wedge: bool,
}

fn main() -> ExitCode {
    let args = Args::parse();
    if args.columns < 16 || args.rows < 16 || args.levels_mas.is_empty() || args.kvps.is_empty() {
        eprintln!("mock-detector: expected at least 16 columns and rows, one exposure and one tube voltage");
        return ExitCode::FAILURE;
    }
    let panel = Panel {
        size_px: [args.columns, args.rows],
        response: if args.energy { Response::Energy } else { Response::Counting },
        gain: args.gain,
        offset: args.offset,
        quanta_per_mas: args.quanta_per_mas,
        output_sigma: args.output_sigma,
        line_sigma: args.line_sigma,
        spread: args.spread,
        broken: args.broken,
        seed: args.seed,
        ..Panel::default()
    };
    let series = Series {
        levels_mas: args.levels_mas,
        kvps: args.kvps,
        coppers_mm: args.coppers_mm,
        frames: args.frames,
        darks: args.darks,
        beads: args.beads,
        edge: args.edge,
        wedge: args.wedge,
    };
    match write(&args.out, &panel, &series) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("mock-detector: {error}");
            ExitCode::FAILURE
        }
    }
}
