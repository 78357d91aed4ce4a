//! What is typed after `sidecarm register`, and the files that it names besides the frames.

use std::path::{Path, PathBuf};

use clap::builder::{PathBufValueParser, TypedValueParser};

use super::named;
use super::register_error::RegisterError;
use super::session_ask::NONE;
use super::shot_files::read_priors;
use crate::acquire::Domain;
use crate::beads::{BeadLayout, Landmark, read_landmarks, read_markups};
use crate::image::{refuse_overwrite, refuse_twice};
use crate::pose::{IntrinsicsFile, Pose, Prior};
use crate::reporter::Reporter;

/// Recover the projection matrix of a radiograph from the metal beads in it.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Example:
  sidecarm register frame.dcm --beads beads.mrk.json --intrinsics K.json --out POSE.json
  sidecarm register frame.dcm --tags tags.json --intrinsics K.json --out POSE.json
  sidecarm register ap.dcm lateral.dcm oblique.dcm --together --beads beads.mrk.json --intrinsics K.json --out POSES.json

Exit code 0: accepted; 1: refused (POSE.json says why and holds no projection); 3: with --together, accepted but for some views (said
which, and why).")]
pub struct RegisterArgs {
    /// The radiograph: DICOM, 16-bit PNG or TIFF, float TIFF; with --together several of one specimen, in the order they were taken
    #[arg(required = true, value_name = "FRAME")]
    pub frames: Vec<PathBuf>,
    /// Solve the frames together: each is registered alone, then all at once with K and bead positions in common, which tells beads that
    /// have migrated, bodies that were bumped between two frames, and single shadows that are off from each other
    #[arg(long, conflicts_with_all = ["fuse", "tags", "correspondences", "overlay", "explain"])]
    pub together: bool,
    /// Beads: a 3D Slicer point list (.mrk.json or .fcsv); radius_mm=0.75, sigma_mm=0.1, covariance_mm2=xx:xy:xz:yy:yz:zz, body=pelvis and role=check (P does not rest on it, its error is told) are read from descriptions
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
    /// undistorted picture. Of a picture that the console cropped, binned, enlarged or turned, say with --console how. none: there is none, the
    /// detector is flat, which is all that can be said with --together
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
    /// A picture of the frame: masks tinted, shadows (white, grey where flagged), beads used (green) and left out (red), where P puts them (yellow), and
    /// residuals 20 times as long as they are
    #[arg(long, value_name = "FILE.png", value_parser = PathBufValueParser::new().try_map(named::png))]
    pub overlay: Option<PathBuf>,
    /// Print also which beads P rests on, what was made of the prior, which other readings of the frame were looked at and why they do not
    /// stand, and every shadow with what was made of it
    #[arg(long)]
    pub explain: bool,
    /// Print the pose as JSON instead of a summary
    #[arg(long)]
    pub json: bool,
    /// Where the pose is written, accepted or refused; with --together POSES.json, or a folder for it and every frame's own NN-NAME.json
    #[arg(long, value_name = "POSE.json")]
    pub out: PathBuf,
}

impl RegisterArgs {
    /// The image intensifier's calibration.
    pub(super) fn distortion_file(&self) -> Option<&Path> {
        self.distortion.as_deref().filter(|path| *path != Path::new(NONE))
    }

    /// Whether the detector is said to be flat.
    pub(super) fn is_flat(&self) -> bool {
        self.distortion.is_some() && self.distortion_file().is_none()
    }
}

/// What is read before any frame is.
pub(super) struct Given {
    pub layout: BeadLayout,
    pub landmarks: Vec<Landmark>,
    /// None, or one for each frame.
    pub priors: Vec<Prior>,
    /// Of each prior, why the pose it is read from is in doubt.
    doubts: Vec<Option<String>>,
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
        refuse_twice(outputs)?;
        refuse_overwrite(outputs, &args.frames.iter().chain(&args.prior).chain(named).collect::<Vec<_>>())?;
        if let Some(found) = args.bead_radius.filter(|radius| !(*radius > 0.0 && radius.is_finite())) {
            return Err(RegisterError::Radius { found });
        }
        let (priors, frames) = (args.prior.len(), args.frames.len());
        if !(priors == 0 || priors == frames) {
            return Err(RegisterError::Priors { priors, frames });
        }
        let (priors, doubts) = read_priors(&args.prior)?;
        Ok(Self {
            layout: args.beads.as_deref().map_or_else(|| Ok(BeadLayout::none()), read_markups)?,
            landmarks: args.landmarks.as_deref().map(read_landmarks).transpose()?.unwrap_or_default(),
            priors,
            doubts,
            file: args.intrinsics.as_deref().map(IntrinsicsFile::read).transpose()?,
        })
    }

    /// Says what the beads' descriptions probably mean and do not say.
    pub fn tell_doubts(&self, reporter: &Reporter) {
        if !self.layout.doubts.is_empty() {
            reporter.warn("bead descriptions", self.layout.doubts.join("; "));
        }
    }

    /// Says with a pose that what its prior, of this number, is read from is in doubt. A pose that the prior is part of is in doubt with it.
    pub fn pass_doubt_on(&self, number: usize, pose: &mut Pose) {
        let Some(words) = self.doubts.get(number).and_then(Option::as_ref) else { return };
        let words = format!("the pose that the prior is read from is in doubt: {words}");
        if pose.fused && pose.is_accepted() {
            pose.doubt(words);
        } else {
            pose.notes.push(words);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Intrinsics, Projection, Rigid};

    #[test]
    fn a_prior_in_doubt_is_told_and_doubts_what_it_is_part_of() {
        let doubts = vec![None, Some("a mirror image".to_owned())];
        let given = Given { layout: BeadLayout::none(), landmarks: Vec::new(), priors: Vec::new(), doubts, file: None };
        let k = Intrinsics { fx: 1.0, fy: 1.0, skew: 0.0, cx: 0.0, cy: 0.0 };
        let projection = Projection::compose(&k, &Rigid::IDENTITY);
        let told = |number: usize, fused: bool| {
            let mut pose = Pose { projection: Some(projection), fused, ..Pose::default() };
            given.pass_doubt_on(number, &mut pose);
            pose
        };
        let gated = told(1, false);
        assert!(gated.doubt.is_none() && gated.notes.concat().contains("a mirror image"), "{:?}", gated.notes);
        assert!(told(1, true).doubt.is_some_and(|words| words.contains("a mirror image")));
        let sure = told(0, true);
        assert!(sure.doubt.is_none() && sure.notes.is_empty(), "the control");
    }
}
