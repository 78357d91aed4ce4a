//! `sidecarm calibrate layout`: what a bead layout is worth, or a layout measured from shots.

use std::path::{Path, PathBuf};

use clap::Args;
use clap::builder::{PathBufValueParser, TypedValueParser};

use super::calibrate_layout_error::CalibrateShotsError;
use super::calibrate_layout_shots::{self, ShotsArgs};
use super::named;
use crate::beads::{BeadsError, read_landmarks, read_markups};
use crate::calibrate::layout::{LayoutScore, Planned, SelfMatch, map, score};
use crate::image::{ImageFileError, refuse_overwrite, refuse_twice, write_atomically};
use crate::pose::{IntrinsicsFile, PoseFileError};
use crate::reporter::Reporter;

/// Measure the beads of a phantom from several shots, or score a layout: does it resemble itself, is it flat, how well will it fix a pose.
#[derive(Clone, Debug, Args)]
#[command(after_help = "Examples:
  sidecarm calibrate layout shot-*.dcm --joints joints.csv --calibration calibration/carm/lab-3.json --out phantom.mrk.json
  sidecarm calibrate layout shot-*.dcm --joints joints.csv --calibration lab-3.json --distance bead-01 bead-09 120.4 --out phantom.mrk.json
  sidecarm calibrate layout a.dcm b.dcm c.dcm --prior a.json --prior b.json --prior c.json --intrinsics K.json --out phantom.mrk.json
  sidecarm calibrate layout --score beads.mrk.json
  sidecarm calibrate layout --score beads.mrk.json --intrinsics K.json --orbital=-30,0,30,60,90 --angulation=-20,0,20 --map map.svg

SHOTS are three or more frames, better six to eight over 60 degrees or more, of one phantom that lies still. Which shadow is which bead is found out;
roughly where the cameras were must be stated: the joints at the exposures, as `calibrate carm` takes them (frame,lift_mm,wig_wag_deg,
longitudinal_mm,angulation_deg,orbital_deg,detector_rotation_deg,source_to_detector_mm; frame: the file's name without its ending; or JSON)
with the arm, or a pose per shot. An arm that `calibrate carm` has measured gives the scale to some tenths of a percent, one as drawn to a
few percent; --distance between two beads (named as an earlier run named them) or --bead-radius tell it too. LAYOUT.mrk.json opens in 3D
Slicer and serves `register --beads`; beside it stands LAYOUT.report.json. Exit code 1: the shots do not tell the layout without doubt (said
why); 3: shots were left out (said which).

--score: the best motion that puts beads onto other beads is sought, also for the mirror image: where most beads coincide, shadows can be
named in more than one way. Predictions are standard deviations of the pose from the beads that fall into the frame, the isocentre being
their centroid. Exit code 1: something speaks against the layout (said what).")]
pub struct LayoutArgs {
    /// Frames of a phantom that nobody has measured
    #[arg(value_name = "SHOTS", required_unless_present = "score", conflicts_with = "score", requires = "out")]
    pub shots: Vec<PathBuf>,
    /// The layout to be scored: a 3D Slicer point list
    #[arg(long, value_name = "LAYOUT.mrk.json")]
    pub score: Option<PathBuf>,
    /// Beads this close count as coinciding, mm
    #[arg(long, value_name = "MM", default_value_t = 1.0)]
    pub tolerance: f64,
    /// K of the shots (else of the arm, or of their headers); with --score of planned views, with size_px and pitch_mm
    #[arg(long, value_name = "K.json")]
    pub intrinsics: Option<PathBuf>,
    /// Orbital angles of planned views, degrees: 0 looks from the front, 90 from the side
    #[arg(long, value_name = "LIST", value_delimiter = ',', allow_hyphen_values = true, default_value = "-60,-30,0,30,60,90")]
    pub orbital: Vec<f64>,
    /// Angulations of planned views, degrees
    #[arg(long, value_name = "LIST", value_delimiter = ',', allow_hyphen_values = true, default_value = "-20,0,20")]
    pub angulation: Vec<f64>,
    /// From the source to the isocentre, as a share of the distance to the detector
    #[arg(long, value_name = "SHARE", default_value_t = 0.6)]
    pub isocentre: f64,
    /// Standard deviation of a shadow's centre, px
    #[arg(long, value_name = "PX", default_value_t = 0.1)]
    pub sigma_px: f64,
    /// Points at which the uncertainty is wanted: a 3D Slicer point list
    #[arg(long, value_name = "L.mrk.json")]
    pub landmarks: Option<PathBuf>,
    /// With --score and --intrinsics: the predictions over all planned views as a picture
    #[arg(
        long,
        value_name = "MAP.svg",
        requires_all = ["score", "intrinsics"],
        value_parser = PathBufValueParser::new().try_map(named::svg)
    )]
    pub map: Option<PathBuf>,
    /// Print the result as JSON instead of a table
    #[arg(long)]
    pub json: bool,
    /// The layout that was measured; with --score, where the score is written as well
    #[arg(long, value_name = "LAYOUT.mrk.json|SCORE.json")]
    pub out: Option<PathBuf>,
    /// How shots are measured
    #[command(flatten)]
    pub measuring: ShotsArgs,
}

/// Why nothing was scored.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateLayoutError {
    /// Layout or landmarks.
    #[error(transparent)]
    Beads(#[from] BeadsError),
    /// K.
    #[error(transparent)]
    Intrinsics(#[from] PoseFileError),
    /// The output.
    #[error(transparent)]
    Output(#[from] ImageFileError),
    /// Shots.
    #[error(transparent)]
    Shots(#[from] CalibrateShotsError),
    /// K for frames of unknown size.
    #[error("{path}: says nothing of {key}, which planned views need", path = path.display())]
    Missing {
        /// The file of K.
        path: PathBuf,
        /// What is missing.
        key: &'static str,
    },
    /// A number that was typed.
    #[error("{option} is {found}, expected {expected}")]
    Option {
        /// As typed.
        option: &'static str,
        /// Found.
        found: f64,
        /// What would be right.
        expected: &'static str,
    },
}

/// Measures or scores, prints, writes. Exit code 1 where something speaks against a layout that is scored, 3 where shots were left out.
///
/// # Errors
/// When a file cannot be read or written, or an option makes no sense.
pub fn run(args: &LayoutArgs, reporter: &Reporter) -> Result<u8, CalibrateLayoutError> {
    let Some(layout) = &args.score else {
        let out = args.out.as_deref().unwrap_or(Path::new("layout.mrk.json"));
        return Ok(calibrate_layout_shots::run(
            &args.shots,
            &args.measuring,
            args.intrinsics.as_deref(),
            out,
            args.json,
            reporter,
        )?);
    };
    let inputs: Vec<&PathBuf> = std::iter::once(layout).chain(&args.intrinsics).chain(&args.landmarks).collect();
    let outputs: Vec<&PathBuf> = args.out.iter().chain(&args.map).collect();
    refuse_twice(&outputs)?;
    refuse_overwrite(&outputs, &inputs)?;
    let limits = [
        ("--tolerance", args.tolerance, 0.0, 50.0, "above 0, at most 50 mm"),
        ("--isocentre", args.isocentre, 0.0, 1.0, "between 0 and 1"),
        ("--sigma-px", args.sigma_px, 0.0, 20.0, "above 0, at most 20 px"),
    ];
    for (option, found, above, most, expected) in limits {
        if !(found > above && found <= most) {
            return Err(CalibrateLayoutError::Option { option, found, expected });
        }
    }
    for (option, list) in [("--orbital", &args.orbital), ("--angulation", &args.angulation)] {
        if let Some(found) = list.iter().copied().find(|angle| !(angle.abs() <= 360.0)) {
            return Err(CalibrateLayoutError::Option { option, found, expected: "degrees, at most a whole turn" });
        }
    }
    let layout = read_markups(layout)?;
    let planned = args.intrinsics.as_ref().map(|path| planned(args, path)).transpose()?;
    let found = score(&layout, args.tolerance, planned.as_ref());
    let text = serde_json::to_string_pretty(&found).unwrap_or_default();
    if let Some(out) = &args.out {
        write_atomically(out, |file| file.write_all(format!("{text}\n").as_bytes()))?;
    }
    let drawn = args.map.as_ref().zip(map(&found.views));
    if let Some((path, svg)) = &drawn {
        write_atomically(path, |file| file.write_all(svg.as_bytes()))?;
    }
    if args.json {
        println!("{text}");
    } else {
        print!("{}", table(&found));
    }
    found.notes.iter().for_each(|note| reporter.note(format_args!("note: {note}")));
    found.warnings.iter().for_each(|warning| reporter.note(format_args!("warning: {warning}")));
    reporter.wrote(args.out.iter().chain(drawn.map(|(path, _)| path)));
    Ok(u8::from(!found.warnings.is_empty()))
}

fn planned(args: &LayoutArgs, path: &Path) -> Result<Planned, CalibrateLayoutError> {
    let file = IntrinsicsFile::read(path)?;
    let missing = |key| CalibrateLayoutError::Missing { path: path.to_owned(), key };
    let pitch_mm = file.pitch_mm.ok_or_else(|| missing("pitch_mm"))?;
    Ok(Planned {
        intrinsics: file.intrinsics,
        size_px: file.size_px.ok_or_else(|| missing("size_px"))?,
        source_to_isocentre_mm: args.isocentre * file.intrinsics.source_to_detector_mm(pitch_mm),
        orbital_deg: args.orbital.clone(),
        angulation_deg: args.angulation.clone(),
        sigma_px: args.sigma_px,
        landmarks: args.landmarks.as_deref().map(read_landmarks).transpose()?.unwrap_or_default(),
    })
}

fn table(found: &LayoutScore) -> String {
    let [first, second, third] = found.extents_mm;
    let mut text = format!(
        "{} beads, extents {first:.1}, {second:.1}, {third:.1} mm, third over first {:.2}\n",
        found.beads, found.flatness
    );
    for (which, image) in [(&found.self_match, "the layout"), (&found.mirrored_match, "its mirror image")] {
        text += &match which {
            Some(SelfMatch { beads, angle_deg, rms_mm, .. }) => {
                format!("{beads} beads fall on beads of {image} turned by {angle_deg:.1}°, to {rms_mm:.2} mm\n")
            }
            None => format!("no three beads fall on three of {image}\n"),
        };
    }
    let has_landmarks = found.views.iter().any(|view| !view.landmarks_mm.is_empty());
    if !found.views.is_empty() {
        text += "orbital  angulation  beads   turn about x, y, z, deg   centroid x, y, along, mm";
        text += if has_landmarks { "   worst landmark mm\n" } else { "\n" };
        text += "    deg         deg              standard deviations in that view\n";
    }
    for view in &found.views {
        let numbers = |values: Option<[f64; 3]>| match values {
            Some([x, y, z]) => format!("{x:7.3} {y:7.3} {z:7.3}"),
            None => format!("{:>23}", "no pose"),
        };
        let worst = view
            .landmarks_mm
            .iter()
            .map(|(_, sigma)| *sigma)
            .fold(None, |worst: Option<f64>, sigma| Some(worst.map_or(sigma, |worst| worst.max(sigma))));
        let worst = worst.map_or_else(String::new, |sigma| format!("{sigma:8.3}"));
        let [turn, centroid] = [view.turn_deg, view.centroid_mm].map(numbers);
        let row =
            format!("{:7.1}  {:10.1}  {:5}   {turn}   {centroid}   {worst}", view.orbital_deg, view.angulation_deg, view.in_view);
        text += row.trim_end();
        text.push('\n');
    }
    text += &verdict(found);
    text
}

/// What the score comes to, in a line.
fn verdict(found: &LayoutScore) -> String {
    let without = found.views.iter().filter(|view| view.centroid_mm.is_none()).count();
    let views = match (found.views.len(), without) {
        (0, _) => String::new(),
        (all, 0) => format!(", and gives a pose in all {all} views"),
        (all, without) => format!(", but gives no pose in {without} of {all} views"),
    };
    match found.warnings.len() {
        0 => format!("good: neither flat nor like itself{views}\n"),
        _ => format!("not good, for what is said below{views}\n"),
    }
}
