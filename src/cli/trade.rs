//! `sidecarm trade`: what accuracy costs in a scene.

use std::path::PathBuf;

use crate::cli::render::DeviceArg;
use crate::image::plot::PlotError;
use crate::image::{ImageFileError, refuse_overwrite, write_atomically};
use crate::render::{RenderError, Renderer, trade};
use crate::reporter::Reporter;
use crate::scene::{self, SceneError};

/// Measure what accuracy costs: sampling, energies, resolution and displacement, each against the f64 yardstick.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:
  sidecarm trade scene.json --out trade

DIR gets trade.json, trade.txt and trade.svg. Rows marked * are on the Pareto front: nothing else is both faster and closer. Errors are
those of line integrals before the panel: noise, collimation and blur are left out.")]
pub struct TradeArgs {
    /// The scene
    pub scene: PathBuf,
    /// Folder for table, plot and JSON
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// What renders
    #[arg(long, value_enum, default_value = "cpu")]
    pub device: DeviceArg,
    /// Print JSON instead of the table
    #[arg(long)]
    pub json: bool,
}

/// Why nothing was measured.
#[derive(Debug, thiserror::Error)]
pub enum TradeError {
    /// The scene.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The renderer.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The plot.
    #[error(transparent)]
    Plot(#[from] PlotError),
    /// An output.
    #[error(transparent)]
    File(#[from] ImageFileError),
    /// The folder.
    #[error("{}: cannot be made: {source}; choose another --out", path.display())]
    Folder {
        /// The folder.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
}

/// Sweeps and writes; 0 on success.
///
/// # Errors
/// When the scene is wrong, or a file cannot be written.
pub fn run(args: &TradeArgs, reporter: &Reporter) -> Result<u8, TradeError> {
    let scene = scene::load(&args.scene, true, reporter)?;
    let outputs = ["trade.json", "trade.txt", "trade.svg"].map(|name| args.out.join(name));
    refuse_overwrite(&outputs, &scene::input_files(&args.scene, &scene))?;
    std::fs::create_dir_all(&args.out).map_err(|source| TradeError::Folder { path: args.out.clone(), source })?;
    let mut renderer = Renderer::new(args.device.into(), reporter)?;
    let trade = trade::sweep(&scene, &mut renderer, reporter)?;
    let table = trade.table();
    let json = serde_json::to_string_pretty(&trade).expect("plain data");
    let plot = trade.plot()?;
    for (path, text) in outputs.iter().zip([&json, &table, &plot]) {
        write_atomically(path, |file| file.write_all(text.as_bytes()))?;
    }
    print!("{}", if args.json { &json } else { &table });
    Ok(0)
}
