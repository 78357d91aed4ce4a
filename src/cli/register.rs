//! `sidecarm register`: one frame, one bead layout, one P (or the reason why there is none).

use std::path::{Path, PathBuf};

use crate::acquire::{AcquireError, DetectorCalibration, DetectorCalibrationError, Domain, Frame, read_frame};
use crate::beads::tags::{TagsError, TagsFileError, find_tags, read_tags};
use crate::beads::{BeadLayout, BeadsError, CorrespondencesError, Landmark, read_correspondences, read_landmarks, read_markups};
use crate::geometry::{AnglesFrom, Intensifier, IntensifierCalibration, IntensifierError, Intrinsics};
use crate::image::{ImageFileError, refuse_overwrite, write_png_rgb};
use crate::mask;
use crate::pose::{
    IntrinsicsFile, Pose, PoseFileError, Prior, Registration, Shadow, intrinsics_of, register_masked, register_tagged,
};
use crate::report;
use crate::reporter::Reporter;

/// Recover the projection matrix of a radiograph from the metal beads in it.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:
  sidecarm register frame.dcm --beads beads.mrk.json --intrinsics K.json --out POSE.json
  sidecarm register frame.dcm --tags tags.json --intrinsics K.json --out POSE.json

Exit code 0: accepted; 1: refused (POSE.json says why and holds no projection).")]
pub struct RegisterArgs {
    /// The radiograph: DICOM, 16-bit PNG or TIFF, float TIFF
    pub frame: PathBuf,
    /// Beads: a 3D Slicer point list (.mrk.json or .fcsv); radius_mm=0.75, sigma_mm=0.1 and body=pelvis are read from descriptions
    #[arg(long, value_name = "BEADS", required_unless_present = "tags")]
    pub beads: Option<PathBuf>,
    /// AprilTags: {"family": "tag36h11", "tags": [{"id": 3, "size_mm": 12.0, "lps_from_tag": 4x4 rows}, …]}; they start the search for
    /// beads and are checked against it; without beads the pose is that of the tags
    #[arg(long, value_name = "TAGS.json")]
    pub tags: Option<PathBuf>,
    /// K: {"intrinsics": 3x3, "size_px": [columns, rows], "pitch_mm": p}; without it from SID and pixel spacing, else solved
    #[arg(long, value_name = "K.json")]
    pub intrinsics: Option<PathBuf>,
    /// Where the pose is expected: a pose file, only camera_from_lps (and covariance) are used
    #[arg(long, value_name = "POSE.json")]
    pub prior: Option<PathBuf>,
    /// Take the prior as a measurement, not only as a gate
    #[arg(long, requires = "prior")]
    pub fuse: bool,
    /// Take a match that contradicts the prior's covariance all the same, with a word
    #[arg(long, requires = "prior", conflicts_with = "fuse")]
    pub ignore_prior: bool,
    /// Take the beads of several bodies as one rigid specimen: a frame in which one has moved is refused
    #[arg(long)]
    pub one_body: bool,
    /// Which shadow is which bead, where you know it: {"correspondences": [{"bead": "B1", "image_px": [310.5, 200]}, …]}
    #[arg(long, value_name = "FILE.json")]
    pub correspondences: Option<PathBuf>,
    /// What the pixel values are: linear, log, display or unknown
    #[arg(long, value_name = "DOMAIN")]
    pub domain: Option<Domain>,
    /// Calibration of the panel, from `calibrate detector`: takes out offset, gain and bad pixels before beads are sought
    #[arg(long, value_name = "DETECTOR.json")]
    pub detector: Option<PathBuf>,
    /// Calibration of an image intensifier, from `calibrate intensifier`: shadows are undistorted before the pose; K is then that of the
    /// undistorted picture
    #[arg(long, value_name = "FILE.json")]
    pub distortion: Option<PathBuf>,
    /// Orbital and angulation angle of the C-arm, for a distortion at several angles; from the header where it was calibrated by those
    #[arg(
        long,
        value_name = "DEG,DEG",
        value_delimiter = ',',
        num_args = 2,
        allow_hyphen_values = true,
        requires = "distortion"
    )]
    pub carm_angles: Vec<f64>,
    /// Radius of beads whose description gives none
    #[arg(long, value_name = "MM")]
    pub bead_radius: Option<f64>,
    /// Points at which the uncertainty is wanted: a 3D Slicer point list
    #[arg(long, value_name = "L.mrk.json")]
    pub landmarks: Option<PathBuf>,
    /// A picture of the frame: masks tinted, shadows (white), beads used (green) and left out (red), where P puts them (yellow), and
    /// residuals 20 times as long as they are
    #[arg(long, value_name = "FILE.png")]
    pub overlay: Option<PathBuf>,
    /// Print what was found in the frame as well: every shadow, and what was made of it
    #[arg(long)]
    pub explain: bool,
    /// Print the pose as JSON instead of a summary
    #[arg(long)]
    pub json: bool,
    /// Where the pose is written, accepted or refused
    #[arg(long, value_name = "POSE.json")]
    pub out: PathBuf,
}

/// Why nothing was registered.
#[derive(Debug, thiserror::Error)]
pub enum RegisterError {
    /// The frame.
    #[error(transparent)]
    Frame(#[from] AcquireError),
    /// The detector calibration cannot be read, or does not apply to the frame.
    #[error(transparent)]
    Detector(#[from] DetectorCalibrationError),
    /// Beads or landmarks.
    #[error(transparent)]
    Beads(#[from] BeadsError),
    /// The list of tags.
    #[error(transparent)]
    TagsFile(#[from] TagsFileError),
    /// The tag decoder.
    #[error(transparent)]
    Tags(#[from] TagsError),
    /// Correspondences.
    #[error(transparent)]
    Correspondences(#[from] CorrespondencesError),
    /// The calibration of the image intensifier cannot be read, or does not fit the frame.
    #[error("{path}: {source}{hint}", path = path.display(), hint = angles_hint(source))]
    Distortion {
        /// Its file.
        path: PathBuf,
        /// What does not fit.
        source: Box<IntensifierError>,
    },
    /// K, prior, or the result.
    #[error(transparent)]
    Pose(#[from] PoseFileError),
    /// An output.
    #[error(transparent)]
    Output(#[from] ImageFileError),
    /// The radius typed is impossible.
    #[error("--bead-radius is {found} mm, it must be positive")]
    Radius {
        /// What was typed.
        found: f64,
    },
    /// K is for another frame.
    #[error("{path}: K is for frames of {expected:?} px, {frame} has {found:?} px, which no binning gives: the console cropped or zoomed it; give K of the frame as it is", path = path.display(), frame = frame.display())]
    Size {
        /// File of K.
        path: PathBuf,
        /// Its size.
        expected: [u32; 2],
        /// The frame.
        frame: PathBuf,
        /// The frame's size.
        found: [u32; 2],
    },
}

/// Registers, writes the pose, prints a summary. Returns the exit code: 0 accepted, 1 refused.
///
/// # Errors
/// When an input cannot be read or does not fit the others, or an output cannot be written.
pub fn run(args: &RegisterArgs, reporter: &Reporter) -> Result<u8, RegisterError> {
    let named = [
        args.intrinsics.as_ref(),
        args.prior.as_ref(),
        args.landmarks.as_ref(),
        args.detector.as_ref(),
        args.distortion.as_ref(),
        args.correspondences.as_ref(),
        args.beads.as_ref(),
        args.tags.as_ref(),
    ];
    let inputs = std::iter::once(&args.frame).chain(named.into_iter().flatten());
    let outputs: Vec<&PathBuf> = std::iter::once(&args.out).chain(&args.overlay).collect();
    refuse_overwrite(&outputs, &inputs.collect::<Vec<_>>())?;
    if let Some(found) = args.bead_radius
        && !(found > 0.0 && found.is_finite())
    {
        return Err(RegisterError::Radius { found });
    }
    let layout = args.beads.as_deref().map_or_else(|| Ok(BeadLayout::none()), read_markups)?;
    let tags = args.tags.as_deref().map(read_tags).transpose()?;
    let landmarks: Vec<Landmark> = args.landmarks.as_deref().map(read_landmarks).transpose()?.unwrap_or_default();
    let correspondences = args.correspondences.as_deref().map(read_correspondences).transpose()?.unwrap_or_default();
    let prior = args.prior.as_deref().map(Prior::read).transpose()?;
    let mut frame = read_frame(&args.frame, args.domain)?;
    if let Some(path) = &args.detector {
        frame = DetectorCalibration::apply_file(path, &frame)?;
    }
    let mut note = None;
    let (intrinsics, pitch_mm) = match &args.intrinsics {
        Some(path) => {
            let file = IntrinsicsFile::read(path)?;
            let found = frame.size_px.map(|n| n as u32);
            let tagged_pitch_mm = frame.tags.pitch_mm.map(|pitch| pitch[0]);
            match file.size_px.filter(|expected| *expected != found) {
                None => (Some(file.intrinsics), file.pitch_mm.or(tagged_pitch_mm)),
                Some(expected) => {
                    let size = RegisterError::Size { path: path.clone(), expected, frame: args.frame.clone(), found };
                    let factor = binning(expected, found).ok_or(size)?;
                    note = Some(format!("K is for {expected:?} px: the frame is taken as binned {factor} x {factor}"));
                    let pitch_mm = file.pitch_mm.map(|pitch| pitch * f64::from(factor)).or(tagged_pitch_mm);
                    (Some(file.intrinsics.binned(f64::from(factor))), pitch_mm)
                }
            }
        }
        None => from_header(&frame, &mut note),
    };
    let intensifier = args.distortion.as_deref().map(|path| intensifier(path, &args.carm_angles, &frame)).transpose()?;
    let request = Registration {
        intrinsics,
        pitch_mm,
        distortion: intensifier.as_ref().map(|intensifier| &intensifier.distortion),
        prior: prior.as_ref(),
        fuse: args.fuse,
        ignore_prior: args.ignore_prior,
        one_body: args.one_body,
        correspondences: &correspondences,
        landmarks: &landmarks,
        bead_radius_mm: args.bead_radius,
        ..Registration::new(frame.size_px.map(|n| n as u32), &layout)
    };
    let masks = mask::of_frame(&frame);
    let mut pose = match &tags {
        Some(tags) => register_tagged(&request, &frame, &masks, tags, &find_tags(&frame, tags.family)?),
        None => register_masked(&request, &frame, &masks),
    };
    pose.notes.extend(note);
    if let (Some(path), Some(intensifier)) = (&args.distortion, &intensifier) {
        pose.notes.push(format!("all places are those of the picture undistorted by {}", path.display()));
        pose.notes.extend(intensifier.note.clone());
    }
    pose.write(&args.out)?;
    if let Some(path) = &args.overlay {
        let drawn = request.distortion.map(|distortion| pose.drawn_on_distorted(distortion));
        write_png_rgb(path, &report::overlay(&frame, drawn.as_ref().unwrap_or(&pose), &masks))?;
    }
    if args.json {
        match serde_json::to_string_pretty(&pose) {
            Ok(text) => println!("{text}"),
            Err(error) => reporter.warn("json", format!("the pose cannot be printed: {error}")),
        }
    } else {
        print!("{}", summary(&pose, args.explain));
    }
    Ok(u8::from(!pose.is_accepted()))
}

/// What the intensifier did to `frame`.
fn intensifier(path: &Path, typed_deg: &[f64], frame: &Frame) -> Result<Intensifier, RegisterError> {
    let at = || {
        let calibration = IntensifierCalibration::read(path)?;
        let tagged =
            frame.tags.primary_deg.zip(frame.tags.secondary_deg).filter(|_| calibration.angles_from == AnglesFrom::Positioner);
        let angles_deg = match typed_deg {
            [orbital, angulation] => Some([*orbital, *angulation]),
            _ => tagged.map(|(primary, secondary)| [primary, secondary]),
        };
        calibration.at(angles_deg)?.for_size(frame.size_px.map(|n| n as u32))
    };
    at().map_err(|source| RegisterError::Distortion { path: path.to_owned(), source: Box::new(source) })
}

fn angles_hint(error: &IntensifierError) -> &'static str {
    if matches!(error, IntensifierError::AngleUnknown { .. }) { " (--carm-angles ORBITAL,ANGULATION)" } else { "" }
}

/// Whole number of panel pixels along the side of one of the frame's, if that is what makes the sizes differ.
fn binning(panel: [u32; 2], frame: [u32; 2]) -> Option<u32> {
    (2..=8).find(|factor| panel.map(|n| n / factor) == frame && panel.iter().zip(frame).all(|(n, m)| n - m * factor < *factor))
}

fn from_header(frame: &Frame, note: &mut Option<String>) -> (Option<Intrinsics>, Option<f64>) {
    match intrinsics_of(frame) {
        Some((intrinsics, pitch_mm, words)) => {
            *note = Some(words);
            (Some(intrinsics), Some(pitch_mm))
        }
        None => {
            *note = Some("no --intrinsics, and no SID with pixel spacing in the header: K is solved from the beads".to_owned());
            (None, frame.tags.pitch_mm.map(|pitch| pitch[0]))
        }
    }
}

/// Human words for a pose.
#[must_use]
pub fn summary(pose: &Pose, explain: bool) -> String {
    let mut lines = Vec::new();
    let used = pose.beads.iter().filter(|bead| bead.used).count();
    if pose.is_accepted() {
        let number = |value: Option<f64>, digits: usize| value.map_or("?".to_owned(), |v| format!("{v:.digits$}"));
        let with_caution = if pose.cautions.is_empty() { "" } else { " with caution" };
        let (rms_px, rms_mm) = (number(pose.rms_px, 3), number(pose.rms_mm, 3));
        if used == 0 {
            let tags = pose.tags.iter().filter(|tag| tag.used).count();
            lines
                .push(format!("accepted{with_caution}: {tags} tags, no beads, corners to {rms_px} px = {rms_mm} mm at the tags"));
        } else {
            lines.push(format!(
                "accepted{with_caution}: {used} of {} beads, rms {rms_px} px = {rms_mm} mm at the beads, {} accidental matches expected",
                pose.beads.len(),
                pose.chance.map_or("?".to_owned(), |chance| format!("{chance:.0e}"))
            ));
        }
        if let Some(rows) = &pose.covariance_at_centroid {
            let sigma = |n: usize| rows[n][n].sqrt();
            lines.push(format!(
                "uncertainty at the beads: {:.3}°, {:.3}°, {:.3}° about x, y, z; {:.3}, {:.3} mm across and {:.3} mm along the beam",
                sigma(0).to_degrees(),
                sigma(1).to_degrees(),
                sigma(2).to_degrees(),
                sigma(3),
                sigma(4),
                sigma(5)
            ));
        }
        if let (Some(k), Some(source)) = (&pose.intrinsics, &pose.intrinsics_source) {
            lines.push(format!("K {source}: f {:.1}, {:.1} px, principal point {:.1}, {:.1} px", k.fx, k.fy, k.cx, k.cy));
        }
    } else {
        lines.push(format!("refused: {}", pose.reason.as_deref().unwrap_or("no reason given")));
        lines.push(format!("{} bead-like shadows in the frame, {} beads in the layout", pose.detections, pose.beads.len()));
    }
    if pose.is_accepted() {
        lines.push(format!("{:16} {:>10} {:>10} {:>9} {:>9} {:>8}", "bead", "u px", "v px", "du px", "dv px", "sigma px"));
        for bead in &pose.beads {
            match (bead.image_px, bead.residual_px) {
                (Some(at), Some(off)) => lines.push(format!(
                    "{:16} {:10.3} {:10.3} {:9.3} {:9.3} {:8.3}{}",
                    bead.name,
                    at[0],
                    at[1],
                    off[0],
                    off[1],
                    bead.sigma_px.unwrap_or(f64::NAN),
                    bead.reason.as_deref().map_or(String::new(), |why| format!("  not used: {why}"))
                )),
                _ => lines.push(format!("{:16} not used: {}", bead.name, bead.reason.as_deref().unwrap_or("no shadow"))),
            }
        }
    }
    for tag in &pose.tags {
        let [[u, v], ..] = tag.corners_px;
        let off = tag.residual_px.map_or(String::new(), |off| format!(", corners {off:.2} px from where P puts them"));
        let why = tag.reason.as_deref().map_or(String::new(), |why| format!("  not used: {why}"));
        let mirrored = if tag.mirrored { ", mirrored" } else { "" };
        lines.push(format!(
            "tag {} {}: first corner {u:.2}, {v:.2} px, margin {:.0}{mirrored}{off}{why}",
            tag.family, tag.id, tag.margin
        ));
    }
    if pose.is_accepted() {
        for landmark in &pose.landmarks {
            let [x, y, z] = landmark.sigma_mm;
            let px = landmark.sigma_px.map_or(String::new(), |[u, v]| format!(", {u:.2}, {v:.2} px"));
            lines.push(format!("landmark {}: ± {x:.3}, {y:.3} mm across, {z:.3} mm along the beam{px}", landmark.name));
        }
    }
    lines.extend(pose.cautions.iter().map(|caution| format!("caution: {caution}")));
    if explain {
        lines.push(format!(
            "{:>4} {:>10} {:>10} {:>9} {:>9} {:>8}  shadows, best first",
            "", "u px", "v px", "sigma px", "radius px", "snr"
        ));
        lines.extend(pose.shadows.iter().enumerate().map(|(n, shadow)| {
            let [u, v] = shadow.image_px;
            let made_of_it = shadow.bead.as_deref().unwrap_or("belongs to no bead");
            let Shadow { sigma_px, radius_px, snr, .. } = shadow;
            format!("{:>4} {u:10.3} {v:10.3} {sigma_px:9.3} {radius_px:9.2} {snr:8.1}  {made_of_it}", n + 1)
        }));
    }
    lines.extend(pose.notes.iter().map(|note| format!("note: {note}")));
    lines.join("\n") + "\n"
}
