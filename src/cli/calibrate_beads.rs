//! `sidecarm calibrate beads`: the metal beads of a CT, as a point list for 3D Slicer.

use std::path::PathBuf;
use std::sync::OnceLock;

use clap::Args;

use crate::beads::{BeadsError, read_markups};
use crate::calibrate::beads::{BeadsInCtError, CtBeads, Known, NAME_TOLERANCE_MM, find_beads, markups};
use crate::image::{ImageFileError, check_writable, refuse_overwrite, write_atomically};
use crate::reporter::Reporter;
use crate::scene::{SceneError, read_volume};

/// Metal that is no bead: this many pieces are shown in the table, all of them with --json.
const SHOWN: usize = 12;

/// The metal beads of a CT: centres with covariance, as a point list for 3D Slicer.
#[derive(Clone, Debug, Args)]
#[command(after_help = "Examples:
  sidecarm calibrate beads ct.nii.gz --out beads.mrk.json
  sidecarm calibrate beads ct.nii.gz --radius 0.75 --names rough.mrk.json --out beads.mrk.json

Every metal ball of 0.8 to 10 mm is found, clipped at 3071 HU or not; screws, wires, plates and fillings are listed as no beads, with
why. Beads are named bead-01 and on from the feet up, or as the nearest point of --names, whose body= and radius_mm= are kept.
BEADS.mrk.json opens in 3D Slicer, where points can be renamed, moved and deleted; sigma_mm in a description is the standard deviation
of the centre per axis. Thin slices help: voxels of 4 mm and more are refused. Exit code 1: no bead was found (said why).")]
pub struct BeadsArgs {
    /// The CT in Hounsfield units: NIfTI, NRRD, MetaImage, or the folder (or one slice) of a DICOM series
    #[arg(value_name = "CT")]
    pub ct: PathBuf,
    /// Radius of the beads, mm; measured where the CT tells it, if absent
    #[arg(long, value_name = "MM")]
    pub radius: Option<f64>,
    /// Names by place: points placed roughly in Slicer, or an earlier list
    #[arg(long, value_name = "BEADS")]
    pub names: Option<PathBuf>,
    /// How far a bead may lie from its point in --names, mm
    #[arg(long, value_name = "MM", default_value_t = NAME_TOLERANCE_MM)]
    pub tolerance: f64,
    /// Print the result as JSON instead of a table
    #[arg(long)]
    pub json: bool,
    /// The point list
    #[arg(long, value_name = "BEADS.mrk.json")]
    pub out: PathBuf,
}

/// Why there is no point list.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateBeadsError {
    /// The CT cannot be read.
    #[error(transparent)]
    Volume(#[from] SceneError),
    /// The names cannot be read.
    #[error(transparent)]
    Names(#[from] BeadsError),
    /// Nothing was found.
    #[error("{ct}: {source}", ct = ct.display())]
    Find {
        /// The CT.
        ct: PathBuf,
        /// Why.
        source: BeadsInCtError,
    },
    /// The output.
    #[error(transparent)]
    Output(#[from] ImageFileError),
    /// A number that was typed.
    #[error("{option} is {found} mm, expected {expected}")]
    Option {
        /// As typed.
        option: &'static str,
        /// Found.
        found: f64,
        /// What would be right.
        expected: &'static str,
    },
    /// The output has an ending that Slicer does not open.
    #[error("{path}: the point list ends in .mrk.json, as 3D Slicer expects", path = path.display())]
    Extension {
        /// The output.
        path: PathBuf,
    },
}

/// Finds, writes, prints; exit code 0.
///
/// # Errors
/// When a file cannot be read or written, an option makes no sense, or no bead is found.
pub fn run(args: &BeadsArgs, reporter: &Reporter) -> Result<u8, CalibrateBeadsError> {
    check(args)?;
    let names = args.names.as_deref().map(read_markups).transpose()?;
    let ct = read_volume(&args.ct, reporter)?;
    let known = Known { radius_mm: args.radius, names, tolerance_mm: Some(args.tolerance) };
    // How many places there are to look at is known only on the way.
    let progress = OnceLock::new();
    let step = |total: usize| progress.get_or_init(|| reporter.progress("fitting beads", total as u64)).advance(1);
    let found = find_beads(&ct.grid(), &ct.values, &known, &step);
    let found = found.map_err(|source| CalibrateBeadsError::Find { ct: args.ct.clone(), source })?;
    let text = serde_json::to_string_pretty(&markups(&found.beads)).unwrap_or_default();
    write_atomically(&args.out, |file| file.write_all(format!("{text}\n").as_bytes()))?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&found).unwrap_or_default());
    } else {
        print!("{}", table(&found));
    }
    for name in &found.names_without_bead {
        reporter.warn("no bead", format_args!("{name}: no bead within {} mm of its place", args.tolerance));
    }
    found.notes.iter().for_each(|note| reporter.note(format_args!("note: {note}")));
    reporter.wrote([&args.out]);
    Ok(0)
}

fn check(args: &BeadsArgs) -> Result<(), CalibrateBeadsError> {
    if let Some(found) = args.radius.filter(|radius| !(*radius >= 0.2 && *radius <= 5.0)) {
        return Err(CalibrateBeadsError::Option { option: "--radius", found, expected: "0.2 to 5 mm" });
    }
    if !(args.tolerance > 0.0 && args.tolerance <= 100.0) {
        return Err(CalibrateBeadsError::Option {
            option: "--tolerance",
            found: args.tolerance,
            expected: "above 0, at most 100 mm",
        });
    }
    if !args.out.to_string_lossy().to_lowercase().ends_with(".mrk.json") {
        return Err(CalibrateBeadsError::Extension { path: args.out.clone() });
    }
    // A list may be measured again into its own file, a CT may not.
    refuse_overwrite(&[&args.out], &[&args.ct])?;
    check_writable(&args.out)?;
    Ok(())
}

fn table(found: &CtBeads) -> String {
    let clip = found.clip_hu.map_or_else(|| "not clipped".to_owned(), |hu| format!("clipped at {hu:.0} HU"));
    let mut text = format!("{} beads, CT {clip}\n", found.beads.len());
    text += "name                 x, y, z in lps, mm             sigma mm   radius mm        contrast HU  spread mm\n";
    for bead in &found.beads {
        let [x, y, z] = bead.lps_mm;
        let sure = if bead.radius_stated { ' ' } else { '?' };
        text += &format!(
            "{:<16} {x:>9.3} {y:>9.3} {z:>9.3} {:>12.4} {:>10.3} ± {:<5.3}{sure} {:>10.0} {:>10.2}\n",
            bead.name, bead.sigma_mm, bead.radius_mm, bead.radius_sigma_mm, bead.contrast_hu, bead.point_spread_fwhm_mm
        );
    }
    for other in found.not_beads.iter().take(SHOWN) {
        let [x, y, z] = other.lps_mm;
        text += &format!("not a bead       {x:>9.1} {y:>9.1} {z:>9.1}  {}\n", other.reason);
    }
    if found.not_beads.len() > SHOWN {
        text += &format!("and {} more that are no beads (--json lists them)\n", found.not_beads.len() - SHOWN);
    }
    text
}
