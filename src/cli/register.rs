//! `sidecarm register`: a frame, a bead layout, a P (or the reason why there is none); with `--together` several frames.

use std::path::PathBuf;

use super::register_error::RegisterError;
use super::register_seen::{Console, Seen};
use super::register_together;
use crate::acquire::{Domain, read_frame};
use crate::beads::tags::{find_tags, read_tags};
use crate::beads::{BeadLayout, Landmark, read_correspondences, read_landmarks, read_markups};
use crate::image::{refuse_overwrite, write_png_rgb};
use crate::mask;
use crate::pose::{IntrinsicsFile, Pose, Prior, Registration, Shadow, register_masked, register_tagged};
use crate::report;
use crate::reporter::Reporter;

/// Recover the projection matrix of a radiograph from the metal beads in it.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:
  sidecarm register frame.dcm --beads beads.mrk.json --intrinsics K.json --out POSE.json
  sidecarm register frame.dcm --tags tags.json --intrinsics K.json --out POSE.json
  sidecarm register ap.dcm lateral.dcm oblique.dcm --together --beads beads.mrk.json --intrinsics K.json --out POSES.json

Exit code 0: accepted; 1: refused (POSE.json says why and holds no projection).")]
pub struct RegisterArgs {
    /// The radiograph: DICOM, 16-bit PNG or TIFF, float TIFF; with --together several of one specimen, in the order they were taken
    #[arg(required = true, value_name = "FRAME")]
    pub frames: Vec<PathBuf>,
    /// Solve the frames together: each is registered alone, then all at once with K and bead positions in common, which tells beads that
    /// have migrated, bodies that were bumped between two frames, and single shadows that are off from each other
    #[arg(long, conflicts_with_all = ["fuse", "tags", "correspondences", "overlay", "explain"])]
    pub together: bool,
    /// Beads: a 3D Slicer point list (.mrk.json or .fcsv); radius_mm=0.75, sigma_mm=0.1, body=pelvis and role=check (P does not rest on it, its error is told) are read from descriptions
    #[arg(long, value_name = "BEADS", required_unless_present = "tags")]
    pub beads: Option<PathBuf>,
    /// AprilTags: {"family": "tag36h11", "tags": [{"id": 3, "size_mm": 12.0, "lps_from_tag": 4x4 rows}, …]}; they start the search for
    /// beads and are checked against it; without beads the pose is that of the tags
    #[arg(long, value_name = "TAGS.json")]
    pub tags: Option<PathBuf>,
    /// K: {"intrinsics": 3x3, "size_px": [columns, rows], "pitch_mm": p}; without it from SID and pixel spacing, else solved. With
    /// "sigma": {"source_to_detector_mm": 3, "principal_point_px": 5, "pitch_mm": 0.0002} K is solved too, with what is stated as priors
    #[arg(long, value_name = "K.json")]
    pub intrinsics: Option<PathBuf>,
    /// Where the pose is expected: a pose file, only camera_from_lps (and covariance) are used; with --together once per frame, in their
    /// order
    #[arg(long, value_name = "POSE.json")]
    pub prior: Vec<PathBuf>,
    /// What the console did to the panel's picture: a file with the keys of a session's "console" (rotation_deg, flip, crop_px, binning,
    /// zoom, or detector_from_image as 3x3 rows), or `solve`: found from the beads, with K of the panel and a prior; K and prior are then
    /// those of the panel
    #[arg(long, value_name = "FILE.json|solve")]
    pub console: Option<PathBuf>,
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
    #[arg(long, value_name = "FILE.json", conflicts_with = "together")]
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
    /// Where the pose is written, accepted or refused; with --together POSES.json, or a folder for it and every frame's own NN-NAME.json
    #[arg(long, value_name = "POSE.json")]
    pub out: PathBuf,
}

/// Registers, writes the pose, prints a summary. Returns the exit code: 0 accepted, 1 refused.
///
/// # Errors
/// When an input cannot be read or does not fit the others, or an output cannot be written.
pub fn run(args: &RegisterArgs, reporter: &Reporter) -> Result<u8, RegisterError> {
    if args.together {
        return register_together::run(args, reporter);
    }
    let [path] = args.frames.as_slice() else { return Err(RegisterError::Frames { found: args.frames.len() }) };
    let outputs: Vec<&PathBuf> = std::iter::once(&args.out).chain(&args.overlay).collect();
    let given = Given::read(args, &outputs)?;
    let tags = args.tags.as_deref().map(read_tags).transpose()?;
    let correspondences = args.correspondences.as_deref().map(read_correspondences).transpose()?.unwrap_or_default();
    let stored = read_frame(path, args.domain)?;
    let mut notes = Vec::new();
    let declared = match Console::of(args, &given, &stored, &mut notes)? {
        Ok(declared) => declared,
        Err(pose) => {
            if let Some(path) = &args.overlay {
                write_png_rgb(path, &report::overlay(&stored, &pose, &mask::of_frame(&stored)))?;
            }
            return answer(args, &pose, reporter);
        }
    };
    let mut seen = Seen::of(args, path, &stored, given.file.as_ref(), declared.as_ref())?;
    notes.append(&mut seen.notes);
    let prior = given.priors.first().map(|prior| prior.turned(seen.turn_rad));
    let intensifier = args.distortion.as_deref().map(|path| seen.intensifier(path, &args.carm_angles)).transpose()?;
    let request = Registration {
        distortion: intensifier.as_ref().map(|intensifier| &intensifier.distortion),
        fuse: args.fuse,
        correspondences: &correspondences,
        ..given.request(args, &seen, prior.as_ref())
    };
    let masks = mask::of_frame(&seen.frame);
    let mut pose = match &tags {
        Some(tags) => register_tagged(&request, &seen.frame, &masks, tags, &find_tags(&seen.frame, tags.family)?),
        None => register_masked(&request, &seen.frame, &masks),
    };
    pose.notes.extend(notes);
    if tags.is_some() && seen.prior.is_some() {
        pose.notes.push("where tags are used K is taken as stated: its sigma is left aside".to_owned());
    }
    if let (Some(path), Some(intensifier)) = (&args.distortion, &intensifier) {
        pose.notes.push(format!("all places are those of the picture undistorted by {}", path.display()));
        pose.notes.extend(intensifier.note.clone());
    }
    let drawn = request.distortion.map(|distortion| pose.drawn_on_distorted(distortion));
    if let Some(path) = &args.overlay {
        write_png_rgb(path, &report::overlay(&seen.frame, drawn.as_ref().unwrap_or(&pose), &masks))?;
    }
    answer(args, &pose, reporter)
}

/// Writes and prints.
fn answer(args: &RegisterArgs, pose: &Pose, reporter: &Reporter) -> Result<u8, RegisterError> {
    pose.write(&args.out)?;
    if args.json {
        match serde_json::to_string_pretty(pose) {
            Ok(text) => println!("{text}"),
            Err(error) => reporter.warn("json", format!("the pose cannot be printed: {error}")),
        }
    } else {
        print!("{}", summary(pose, args.explain));
    }
    Ok(u8::from(!pose.is_accepted()))
}

/// What is read before any frame is.
pub(super) struct Given {
    pub layout: BeadLayout,
    pub landmarks: Vec<Landmark>,
    /// None, or one for each frame.
    pub priors: Vec<Prior>,
    /// K.
    pub file: Option<IntrinsicsFile>,
}

impl Given {
    /// Checks that no output is an input, and that numbers make sense.
    pub fn read(args: &RegisterArgs, outputs: &[&PathBuf]) -> Result<Self, RegisterError> {
        let named = [
            &args.intrinsics,
            &args.landmarks,
            &args.detector,
            &args.correspondences,
            &args.beads,
            &args.tags,
            &args.console,
            &args.distortion,
        ]
        .into_iter()
        .flatten();
        refuse_overwrite(outputs, &args.frames.iter().chain(&args.prior).chain(named).collect::<Vec<_>>())?;
        if let Some(found) = args.bead_radius.filter(|radius| !(*radius > 0.0 && radius.is_finite())) {
            return Err(RegisterError::Radius { found });
        }
        let (priors, frames) = (args.prior.len(), args.frames.len());
        if !(priors == 0 || priors == frames) {
            return Err(RegisterError::Priors { priors, frames });
        }
        Ok(Self {
            layout: args.beads.as_deref().map_or_else(|| Ok(BeadLayout::none()), read_markups)?,
            landmarks: args.landmarks.as_deref().map(read_landmarks).transpose()?.unwrap_or_default(),
            priors: args.prior.iter().map(|path| Prior::read(path)).collect::<Result<_, _>>()?,
            file: args.intrinsics.as_deref().map(IntrinsicsFile::read).transpose()?,
        })
    }

    /// The request for one frame.
    pub fn request<'a>(&'a self, args: &RegisterArgs, seen: &Seen, prior: Option<&'a Prior>) -> Registration<'a> {
        Registration {
            intrinsics: seen.intrinsics,
            intrinsics_prior: seen.prior,
            pitch_mm: seen.pitch_mm,
            prior,
            ignore_prior: args.ignore_prior,
            one_body: args.one_body,
            landmarks: &self.landmarks,
            bead_radius_mm: args.bead_radius,
            ..Registration::new(seen.frame.size_px.map(|n| n as u32), &self.layout)
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
                pose.beads.iter().filter(|bead| !bead.check).count(),
                pose.chance.map_or("?".to_owned(), |chance| format!("{chance:.0e}"))
            ));
        }
        lines.extend(pose.unseen.as_ref().map(ToString::to_string));
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
            let sigma = pose.intrinsics_sigma_px.map_or(String::new(), |[f, _, x, y]| format!(" (± {f:.1}; {x:.1}, {y:.1})"));
            lines.push(format!("K {source}: f {:.1}, {:.1} px, principal point {:.1}, {:.1} px{sigma}", k.fx, k.fy, k.cx, k.cy));
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
