//! `sidecarm calibrate`: what can be measured; `detector` is a panel's calibration from frames without a specimen.

use std::path::{Path, PathBuf};

use clap::{Args, Subcommand};

use super::calibrate_beads::{self, BeadsArgs, CalibrateBeadsError};
use super::calibrate_carm::{self, CalibrateCarmError, CarmArgs};
use super::calibrate_intensifier::{self, CalibrateIntensifierError, IntensifierArgs};
use super::calibrate_layout::{self, CalibrateLayoutError, LayoutArgs};
use super::calibrate_robot::{self, RobotArgs};
use super::calibrate_robot_error::CalibrateRobotError;
use super::read_aloud::frames_aloud;
use super::spectrum::FilterArg;
use crate::acquire::{AcquireError, AddedFilter, DetectorCalibration, Domain, Frame, MapsFile, PanelResponse, exposure_mas};
use crate::calibrate::detector::{DetectorError, Measurement, PanelFrame, calibrate};
use crate::image::{
    ImageFileError, check_writable, refuse_overwrite, refuse_same_content, refuse_twice, sha256_file, write_atomically,
    write_tiff_f32,
};
use crate::reporter::Reporter;
use crate::scene::physics::{Material, Spectrum};

/// Measure a calibration.
#[derive(Clone, Debug, Args)]
#[command(after_help = "Examples:
  sidecarm calibrate beads CT.nii.gz --radius 0.75 --out beads.mrk.json
  sidecarm calibrate carm pose-*.json --joints joints.csv --calibration nominal.json --out carm.json")]
pub struct CalibrateArgs {
    /// Of what.
    #[command(subcommand)]
    pub what: CalibrateWhat,
}

/// What can be calibrated.
#[derive(Clone, Debug, Subcommand)]
pub enum CalibrateWhat {
    /// The metal beads of a CT: centres with covariance, as a point list for 3D Slicer.
    Beads(BeadsArgs),
    /// A C-arm from a few bead shots: offsets, source to isocentre, detector, axes and gravity sag.
    Carm(CarmArgs),
    /// The panel: offset, gain by photon transfer, air signal by tube voltage and filter, bad pixels, noise power, MTF.
    Detector(DetectorArgs),
    /// A bead layout: measured from shots of a phantom, or scored: does it resemble itself, is it flat, how well will it fix a pose.
    Layout(LayoutArgs),
    /// An image intensifier: distortion by angle of the C-arm from frames of a grid, round mask, veiling glare.
    Intensifier(IntensifierArgs),
    /// The snake robot's base and control-angle offsets from frames in which it is seen; load bend as the tip's discrepancy in mm.
    Robot(RobotArgs),
}

/// The panel: offset, gain by photon transfer, air signal by tube voltage and filter, bad pixels, noise power, MTF.
#[derive(Clone, Debug, Args)]
#[command(after_help = "Examples:
  sidecarm calibrate detector air-*.dcm --dark dark-*.dcm --filter aluminium=4.3 --out detector.json
  sidecarm calibrate detector air-*.tif --dark dark-*.tif --kvp 90 --mas 1,1,2,2,4,4 --bits 14 --out detector.json

Take two or more frames per exposure with nothing in the beam and the collimator open, at three exposures or more, and darks with the tube
off; and that for every tube voltage and filter that is used. Voltage, mAs and filter come from the files where they state them. A frame is
later corrected by air frames of its own filter, and by none of another without a word. DETECTOR.json holds the numbers, DETECTOR.tif beside it the maps; a
session uses them as \"detector\": \"detector.json\". Exit code 1: the frames contradict each other (said which).")]
pub struct DetectorArgs {
    /// Air frames: DICOM, PNG or TIFF with stored values
    #[arg(required = true, value_name = "AIR")]
    pub air: Vec<PathBuf>,
    /// Dark frames; without them the offset comes from three exposures or more
    #[arg(long, num_args = 1.., value_name = "DARK")]
    pub dark: Vec<PathBuf>,
    /// A frame with a straight metal edge on the panel, turned by 2 to 10 degrees: gives the MTF
    #[arg(long, value_name = "FILE")]
    pub edge: Option<PathBuf>,
    /// Tube voltage of air frames that do not state it, kV
    #[arg(long, value_name = "KV")]
    pub kvp: Option<f64>,
    /// mAs of the air frames in order, where they do not state it; several images of one file count singly
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    pub mas: Vec<f64>,
    /// Filtration of the tube: gives photons per quantum; may be given several times. Of a material that is named it is all, what the air
    /// frames state of others comes on top
    #[arg(long, value_name = "MATERIAL=MM")]
    pub filter: Vec<FilterArg>,
    /// What was put into the beam, of air frames that do not state it: none, or as copper=0.2,aluminium=1
    #[arg(long, value_name = "LIST")]
    pub added_filter: Option<AddedFilter>,
    /// The panel counts photons instead of adding up their energy
    #[arg(long)]
    pub counting: bool,
    /// Bits per stored value, where the files do not state it
    #[arg(long, value_name = "BITS", value_parser = clap::value_parser!(u32).range(1..=16))]
    pub bits: Option<u32>,
    /// Pixel pitch, where the files do not state it, mm
    #[arg(long, value_name = "MM")]
    pub pitch_mm: Option<f64>,
    /// Who measured, when, with which instrument; goes into the file
    #[arg(long, value_name = "TEXT")]
    pub origin: Option<String>,
    /// Print the numbers as JSON instead of a table
    #[arg(long)]
    pub json: bool,
    /// The calibration; its maps go beside it with the ending .tif
    #[arg(long, value_name = "DETECTOR.json")]
    pub out: PathBuf,
}

/// Why nothing was calibrated.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateError {
    /// The beads of a CT.
    #[error(transparent)]
    Beads(#[from] CalibrateBeadsError),
    /// A C-arm.
    #[error(transparent)]
    Carm(#[from] CalibrateCarmError),
    /// A bead layout.
    #[error(transparent)]
    Layout(#[from] CalibrateLayoutError),
    /// An image intensifier.
    #[error(transparent)]
    Intensifier(#[from] CalibrateIntensifierError),
    /// The robot.
    #[error(transparent)]
    Robot(#[from] CalibrateRobotError),
    /// A frame cannot be read.
    #[error(transparent)]
    Frame(#[from] AcquireError),
    /// The frames do not give a calibration.
    #[error(transparent)]
    Detector(#[from] DetectorError),
    /// An output.
    #[error(transparent)]
    Image(#[from] ImageFileError),
    /// A number that was typed.
    #[error("{option} is {found}, expected {expected}")]
    Option {
        /// As typed.
        option: &'static str,
        /// Found.
        found: String,
        /// What would be right.
        expected: String,
    },
}

/// Calibrates; exit code 0.
///
/// # Errors
/// When a frame cannot be read, the frames do not determine the panel, or the files cannot be written.
pub fn run(args: &CalibrateArgs, reporter: &Reporter) -> Result<u8, CalibrateError> {
    match &args.what {
        CalibrateWhat::Beads(args) => Ok(calibrate_beads::run(args, reporter)?),
        CalibrateWhat::Carm(args) => Ok(calibrate_carm::run(args, reporter)?),
        CalibrateWhat::Layout(args) => Ok(calibrate_layout::run(args, reporter)?),
        CalibrateWhat::Detector(args) => detector(args, reporter),
        CalibrateWhat::Intensifier(args) => Ok(calibrate_intensifier::run(args, reporter)?),
        CalibrateWhat::Robot(args) => Ok(calibrate_robot::run(args, reporter)?),
    }
}

fn detector(args: &DetectorArgs, reporter: &Reporter) -> Result<u8, CalibrateError> {
    let maps_path = args.out.with_extension("tif");
    let frames: Vec<&PathBuf> = args.air.iter().chain(&args.dark).collect();
    refuse_twice(&[&args.out, &maps_path])?;
    refuse_overwrite(&[&args.out, &maps_path], &frames.iter().copied().chain(&args.edge).collect::<Vec<_>>())?;
    // A pair of equal frames has no noise, which is what the gain is measured by.
    refuse_same_content(&frames)?;
    check_writable(&args.out)?;
    check_number("--kvp", args.kvp, 20.0..=200.0, "20 to 200 kV")?;
    check_number("--pitch-mm", args.pitch_mm, 0.01..=5.0, "0.01 to 5 mm")?;
    let total = args.air.len() + args.dark.len() + usize::from(args.edge.is_some());
    let progress = reporter.progress("reading", total as u64);
    let read = |paths: &[PathBuf]| -> Result<Vec<Frame>, AcquireError> {
        let mut frames = Vec::new();
        for path in paths {
            // Stored values are wanted as they are, whatever the header thinks of them.
            frames.extend(frames_aloud(path, Some(Domain::Linear), reporter)?);
            progress.advance(1);
        }
        Ok(frames)
    };
    let (air, dark) = (read(&args.air)?, read(&args.dark)?);
    let edge = read(args.edge.as_slice())?.into_iter().next();
    let first = air.first();
    let bits_of = |frame: &Frame| frame.tags.bits_stored.filter(|bits| *bits < 16);
    let pitch = args.pitch_mm.or_else(|| first.and_then(|frame| frame.tags.pitch_mm).map(|pitch| pitch[0]));
    let filter: Vec<String> = args.filter.iter().map(|filter| format!("{}={}", filter.material, filter.thickness_mm)).collect();
    let origin = origin(args, &air);
    let measurement = Measurement {
        air: air_frames(args, &air)?,
        dark: dark.iter().map(|frame| panel_frame(frame, None, None, None)).collect(),
        edge: edge.map(|frame| panel_frame(&frame, None, None, args.added_filter.as_ref())),
        filter: (!filter.is_empty()).then(|| filter.join(",")),
        spectrum_moments_kev,
        bits: args.bits.or_else(|| first.and_then(bits_of)),
        pitch_mm: pitch,
        response: if args.counting { PanelResponse::Counting } else { PanelResponse::Energy },
        origin,
    };
    if let (Some(filter), Some(kvp)) = (&measurement.filter, measurement.air.first().and_then(|frame| frame.tube_kvp))
        && spectrum_moments_kev(kvp, filter).is_none()
    {
        return Err(CalibrateError::Option {
            option: "--filter",
            found: filter.clone(),
            expected: format!("known materials with thicknesses of a tube at {kvp:.0} kV (40 to 140 kV), as aluminium=4.3"),
        });
    }
    let mut calibration = calibrate(&measurement)?;
    write(&mut calibration, &args.out, &maps_path)?;
    if args.json {
        println!("{}", serde_json::to_string_pretty(&calibration.record).unwrap_or_default());
    } else {
        print!("{}", table(&calibration));
    }
    calibration.record.notes.iter().for_each(|note| reporter.note(format!("note: {note}")));
    reporter.wrote([&args.out, &maps_path]);
    Ok(0)
}

fn check_number(
    option: &'static str,
    value: Option<f64>,
    range: std::ops::RangeInclusive<f64>,
    expected: &str,
) -> Result<(), CalibrateError> {
    match value.filter(|value| !range.contains(value)) {
        Some(found) => Err(CalibrateError::Option { option, found: found.to_string(), expected: expected.to_owned() }),
        None => Ok(()),
    }
}

/// What was said, and when the frames were taken, as far as they say it.
fn origin(args: &DetectorArgs, air: &[Frame]) -> String {
    let mut dates: Vec<&str> = air.iter().filter_map(|frame| frame.tags.acquired_date.as_deref()).collect();
    dates.sort_unstable();
    dates.dedup();
    let said = args.origin.as_deref().unwrap_or("who and with what not stated (--origin)");
    let taken = match (dates.first(), dates.last()) {
        (Some(first), Some(last)) if first != last => format!("frames of {first} to {last}"),
        (Some(first), _) => format!("frames of {first}"),
        _ => "date of the frames not stated".to_owned(),
    };
    format!("{said}; {taken}; calibrate detector of sidecarm {}", env!("CARGO_PKG_VERSION"))
}

fn panel_frame(frame: &Frame, kvp: Option<f64>, mas: Option<f64>, filter: Option<&AddedFilter>) -> PanelFrame {
    PanelFrame {
        label: frame.name.clone(),
        pixels: frame.pixels.clone(),
        tube_kvp: frame.tags.kvp.or(kvp),
        filter: AddedFilter::of(&frame.tags, None).or_else(|| filter.cloned()),
        exposure_mas: mas.or_else(|| exposure_mas(&frame.tags)),
        source_to_detector_mm: frame.tags.sid_mm,
    }
}

fn air_frames(args: &DetectorArgs, air: &[Frame]) -> Result<Vec<PanelFrame>, CalibrateError> {
    if !args.mas.is_empty() && args.mas.len() != air.len() {
        return Err(CalibrateError::Option {
            option: "--mas",
            found: format!("a list of {}", args.mas.len()),
            expected: format!("one value for each of the {} air frames, in order", air.len()),
        });
    }
    if let Some(wrong) = args.mas.iter().find(|mas| !(**mas > 0.0 && mas.is_finite())) {
        return Err(CalibrateError::Option { option: "--mas", found: wrong.to_string(), expected: "positive numbers".into() });
    }
    let filter = args.added_filter.as_ref();
    Ok(air.iter().enumerate().map(|(at, frame)| panel_frame(frame, args.kvp, args.mas.get(at).copied(), filter)).collect())
}

/// ⟨E⟩ and ⟨E²⟩ of a tungsten tube behind `filter` (`aluminium=4.3,copper=0.1`); anode angle 12 degrees, to which they hardly respond.
fn spectrum_moments_kev(kvp: f64, filter: &str) -> Option<[f64; 2]> {
    let layer = |text: &str| {
        let filter: FilterArg = text.parse().ok()?;
        Some((Material::parse(&filter.material).ok()?, filter.thickness_mm))
    };
    let layers = filter.split(',').map(layer).collect::<Option<Vec<_>>>()?;
    let spectrum = Spectrum::tungsten(kvp, 12.0, &layers).ok()?;
    let moment = |power: i32| spectrum.bins.iter().map(|bin| bin.fluence * bin.energy_kev.powi(power)).sum::<f64>();
    let photons = moment(0);
    let moments = [moment(1) / photons, moment(2) / photons];
    moments.iter().all(|value| value.is_finite() && *value > 0.0).then_some(moments)
}

/// Writes the maps, then the JSON that names them.
fn write(calibration: &mut DetectorCalibration, path: &Path, maps_path: &Path) -> Result<(), CalibrateError> {
    let record = &mut calibration.record;
    let size_px = [record.columns_px as usize, record.rows_px as usize];
    write_tiff_f32(maps_path, &calibration.maps.pages(size_px))?;
    let mut pages = vec!["offset_value".to_owned(), "bad pixels: 1 dead, 2 hot, 4 unstable, added".to_owned()];
    pages.extend(record.beams.iter().map(|beam| {
        let kvp = beam.tube_kvp.map_or_else(|| "tube voltage not stated".to_owned(), |kvp| format!("{kvp:.0} kVp"));
        let added = beam.added_filter.as_ref().map(|filter| format!(", {}", filter.words())).unwrap_or_default();
        format!("air signal relative to its median, {kvp}{added}, filter {}", beam.filter.as_deref().unwrap_or("not stated"))
    }));
    let file = PathBuf::from(maps_path.file_name().unwrap_or_default());
    record.maps = Some(MapsFile { file, sha256: sha256_file(maps_path)?, pages });
    let text = serde_json::to_string_pretty(&record).unwrap_or_default();
    write_atomically(path, |file| file.write_all(format!("{text}\n").as_bytes()))?;
    Ok(())
}

fn table(calibration: &DetectorCalibration) -> String {
    let record = &calibration.record;
    let number = |value: Option<f64>, digits: usize| value.map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}"));
    let mut text = format!(
        "panel {} x {} px, offset {} ± {} ({}), electronic noise {}, saturates at {}\n",
        record.columns_px,
        record.rows_px,
        number(record.offset_value, 2),
        number(record.offset_sigma_value, 2),
        record.offset_from.as_deref().unwrap_or("-"),
        number(record.readout_sigma_value, 2),
        number(record.saturation_value, 0)
    );
    text += &format!(
        "bad pixels: {} dead, {} hot, {} unstable\n",
        record.bad_pixels.dead, record.bad_pixels.hot, record.bad_pixels.unstable
    );
    for beam in &record.beams {
        let percent = |value: Option<f64>| value.map_or_else(|| "-".to_owned(), |value| format!("{:.2} %", 100.0 * value));
        text += &format!(
            "{} kVp{}: gain {} per quantum ± {}, air {} per mAs ± {}, {} quanta ({} photons) per pixel and mAs, heel {}\n",
            number(beam.tube_kvp, 0),
            beam.added_filter.as_ref().map(|filter| format!(" with {}", filter.words())).unwrap_or_default(),
            number(beam.gain_value_per_quantum, 4),
            percent(beam.gain_relative_sigma),
            number(beam.air_value_per_mas, 2),
            percent(Some(beam.air_relative_sigma)),
            number(beam.quanta_per_pixel_per_mas, 1),
            number(beam.photons_per_pixel_per_mas, 1),
            percent(beam.heel_share)
        );
        beam.frames_left_out.iter().for_each(|reason| text += &format!("  left out: {reason}\n"));
    }
    match &record.mtf {
        Some(mtf) => {
            text += &format!(
                "MTF from an edge at {:.1} degrees: half at {} lp/mm\n",
                mtf.edge_angle_deg,
                mtf.half_lp_per_mm.map_or_else(|| "more than the pixels resolve".to_owned(), |half| format!("{half:.2}"))
            );
        }
        None => text += "MTF: no edge frame was given (--edge)\n",
    }
    text
}
