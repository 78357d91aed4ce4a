//! `sidecarm calibrate intensifier`: the distortion of an image intensifier from frames of a grid, or of a bead phantom.

use std::path::{Path, PathBuf};

use serde::Deserialize;

pub use super::calibrate_intensifier_args::IntensifierArgs;
use super::calibrate_intensifier_beads::phantom;
pub use super::calibrate_intensifier_error::CalibrateIntensifierError;
use super::read_aloud::frame_aloud;
use crate::acquire::Frame;
use crate::calibrate::intensifier::{GridFrame, GridOf, GridRequest, calibrate, calibrate_phantom, disc_of, measure_glare};
use crate::foreign::read_small_text;
use crate::geometry::{AnglesDeg, AnglesFrom, DEFAULT_ORDER, Glare, IntensifierCalibration, ORDERS};
use crate::image::{check_writable, refuse_overwrite, refuse_same_content, write_atomically};
use crate::json::parse_json;
use crate::mask::Disc;
use crate::reporter::Reporter;

/// A row of the list of angles.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct AngleRow {
    frame: PathBuf,
    orbital_deg: f64,
    angulation_deg: f64,
}

/// Calibrates, writes, prints; exit code 0.
///
/// # Errors
/// When a file cannot be read or written, an option makes no sense, or no grid or phantom is recognised.
pub fn run(args: &IntensifierArgs, reporter: &Reporter) -> Result<u8, CalibrateIntensifierError> {
    let disc = check(args)?;
    let phantom = phantom(args, reporter)?;
    let listed = args.angles.as_deref().map(read_angles).transpose()?;
    let progress = reporter.progress("reading", args.grid.len() as u64);
    let mut frames = Vec::new();
    for path in &args.grid {
        let frame = frame_aloud(path, args.domain, reporter)?;
        let angles_deg = match (&listed, &args.angles) {
            (Some(rows), Some(list)) => Some(listed_angles(rows, path, list)?),
            _ => frame.tags.primary_deg.zip(frame.tags.secondary_deg).map(|(primary, secondary)| [primary, secondary]),
        };
        frames.push(GridFrame { frame, angles_deg });
        progress.advance(1);
    }
    let angles_from = match (&listed, frames.iter().all(|frame| frame.angles_deg.is_some())) {
        (Some(_), _) => AnglesFrom::Given,
        (None, true) => AnglesFrom::Positioner,
        (None, false) => AnglesFrom::Unknown,
    };
    let opaque: Option<Frame> = args.opaque.as_deref().map(|path| frame_aloud(path, args.domain, reporter)).transpose()?;
    let glare = opaque.map(|frame| measure_glare(&frame, &disc.unwrap_or_else(|| disc_of(&frames, None).0))).transpose()?;
    let said = args.origin.as_deref().unwrap_or("who and with what not stated (--origin)");
    let dates: std::collections::BTreeSet<&str> = frames.iter().filter_map(|f| f.frame.tags.acquired_date.as_deref()).collect();
    let taken = dates.into_iter().collect::<Vec<_>>().join(", ");
    let taken = if taken.is_empty() { "date of the frames not stated".to_owned() } else { format!("frames of {taken}") };
    let origin = format!("{said}; {taken}; calibrate intensifier of sidecarm {}", env!("CARGO_PKG_VERSION"));
    let mut calibration = match &phantom {
        Some(phantom) => {
            let progress = reporter.progress("finding the beads", frames.len() as u64);
            let request = phantom.request(args, &frames, (disc, angles_from, glare, origin))?;
            calibrate_phantom(&frames, &request, &|| progress.advance(1))?
        }
        None => calibrate(&frames, &grid_request(args, disc, angles_from, glare, origin))?,
    };
    calibration.notes.iter().for_each(|note| reporter.note(format_args!("note: {note}")));
    calibration.notes.extend(phantom.into_iter().flat_map(|phantom| phantom.doubts));
    let text = serde_json::to_string_pretty(&calibration).unwrap_or_default();
    write_atomically(&args.out, |file| file.write_all(format!("{text}\n").as_bytes()))?;
    if args.json {
        println!("{text}");
    } else {
        print!("{}", table(&calibration));
    }
    reporter.wrote([&args.out]);
    Ok(0)
}

fn grid_request(
    args: &IntensifierArgs,
    disc: Option<Disc>,
    angles_from: AnglesFrom,
    glare: Option<Glare>,
    origin: String,
) -> GridRequest {
    GridRequest {
        grid: if args.holes { GridOf::Holes } else { GridOf::Beads },
        pitch_mm: args.pitch_mm,
        order: args.order.unwrap_or(DEFAULT_ORDER),
        plate_moved: args.plate_moved,
        disc,
        angles_from,
        glare,
        origin,
    }
}

/// The disc that was typed, if any.
fn check(args: &IntensifierArgs) -> Result<Option<Disc>, CalibrateIntensifierError> {
    let known = args.beads.iter().chain(&args.intrinsics).chain(&args.prior);
    let inputs = args.grid.iter().chain(&args.angles).chain(&args.opaque).chain(known);
    refuse_overwrite(&[&args.out], &inputs.collect::<Vec<_>>())?;
    refuse_same_content(&args.grid)?;
    check_writable(&args.out)?;
    let wrong = |option, found: String, expected| Err(CalibrateIntensifierError::Option { option, found, expected });
    if let Some(found) = args.pitch_mm.filter(|pitch| !(*pitch > 0.1 && *pitch < 200.0)) {
        return wrong("--pitch-mm", found.to_string(), "0.1 to 200 mm");
    }
    // The polynomial's linear part is the grid's own.
    if let Some(found) = args.order.filter(|order| *order < 2 || !ORDERS.contains(order)) {
        return wrong("--order", found.to_string(), "2 to 9");
    }
    if let Some(found) = args.bead_radius.filter(|radius| !(*radius > 0.0 && radius.is_finite())) {
        return wrong("--bead-radius", found.to_string(), "a positive number of millimetres");
    }
    match args.disc.as_slice() {
        [] => Ok(None),
        [u, v, r] if [u, v, r].iter().all(|n| n.is_finite()) && *r > 10.0 => {
            Ok(Some(Disc { centre: glam::DVec2::new(*u, *v), radius_px: *r }))
        }
        other => wrong("--disc", format!("{other:?}"), "column and row of the centre and a radius above 10 px, as 511,512,480"),
    }
}

fn read_angles(path: &Path) -> Result<Vec<AngleRow>, CalibrateIntensifierError> {
    let fault = |detail: String| CalibrateIntensifierError::Angles { path: path.to_owned(), detail };
    let text = read_small_text(path).map_err(|error| fault(format!("cannot be read ({error})")))?;
    let rows: Vec<AngleRow> = parse_json(text.as_bytes()).map_err(|wrong| fault(wrong.to_string()))?;
    match rows.iter().find(|row| !(row.orbital_deg.abs() <= 360.0 && row.angulation_deg.abs() <= 360.0)) {
        Some(row) => Err(fault(format!("{} has no angle within 360 degrees", row.frame.display()))),
        None => Ok(rows),
    }
}

fn listed_angles(rows: &[AngleRow], frame: &Path, list: &Path) -> Result<AnglesDeg, CalibrateIntensifierError> {
    let row = rows.iter().find(|row| row.frame.file_name() == frame.file_name());
    row.map(|row| [row.orbital_deg, row.angulation_deg]).ok_or_else(|| CalibrateIntensifierError::Angles {
        path: list.to_owned(),
        detail: format!("{} is not in it", frame.display()),
    })
}

fn table(calibration: &IntensifierCalibration) -> String {
    let number = |value: Option<f64>, digits: usize| value.map_or_else(|| "-".to_owned(), |value| format!("{value:.digits$}"));
    let [u, v] = calibration.disc_centre_px;
    let mut text = format!(
        "held-out spots: {} px rms; order {}, disc of radius {:.1} px about ({u:.1}, {v:.1})\n",
        number(calibration.held_out_rms_px, 3),
        calibration.order,
        calibration.disc_radius_px
    );
    text += "frame                orbital°  angulation°   spots  left out   raw mean px   held-out rms px   reach\n";
    for view in &calibration.views {
        text += &format!(
            "{:<20} {:>8} {:>12} {:>7} {:>9} {:>13} {:>17} {:>7}\n",
            view.frame,
            number(view.orbital_deg, 1),
            number(view.angulation_deg, 1),
            view.spots,
            view.left_out,
            number(view.raw_mean_px, 2),
            number(view.held_out_rms_px, 3),
            number(view.reach, 2)
        );
    }
    if let Some(pitch_mm) = calibration.plate_pitch_mm {
        text += &format!("an undistorted pixel is {pitch_mm:.5} mm wide on the plate\n");
    }
    if let Some(glare) = calibration.veiling_glare {
        text += &format!("veiling glare: {:.1} % of the light, scale {:.0} px\n", 100.0 * glare.fraction, glare.scale_px);
    }
    text
}
