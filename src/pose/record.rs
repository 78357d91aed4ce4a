//! `Pose`: what a registration says, and its file.

use std::path::Path;

use glam::DVec3;
use serde::{Deserialize, Serialize};

use super::cautions::{is_of_header_k, is_of_looseness, is_of_round_field};
use super::explained::{Explained, Reading, Rejected, RejectedReading};
use super::file::{PoseFileError, read_json, write_json};
use super::hand_marks::Edited;
use super::intrinsics_file::{MOST_PITCH_MM, is_pitch};
use super::refusal::Refusal;
use super::residual::{BeadResidual, TagResidual};
use super::shadow::Shadow;
use super::unseen::Unseen;
use crate::geometry::{ConsoleGeometry, Intrinsics, Projection, Rigid};

/// P and K with the pose, as a file states them, may put a place apart by this much: digits that were cut off.
const MOST_APART_PX: f64 = 0.5;

/// Accepted or refused.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Status {
    /// The pose may be used.
    #[default]
    Accepted,
    /// It may not; `reason` says why.
    Refused,
}

/// A 6×6 covariance of ξ = (ω, v), rad and mm, in camera_from_lps_true = exp(ξ̂)·camera_from_lps.
pub type Covariance = [[f64; 6]; 6];

/// A rigid part and where it is.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BodyPose {
    /// Its name.
    pub name: String,
    /// Where the body is now; identity for the one that the camera is solved from, and where nothing has moved since the scan.
    pub lps_from_body: Rigid,
    /// Beads it has.
    pub beads: usize,
    /// Beads of it that P rests on.
    pub used: usize,
    /// Of ξ of the body in `camera` about its used beads' centroid, where its place was solved apart from the others'.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub covariance_at_centroid: Option<Covariance>,
}

impl BodyPose {
    /// The bodies of `beads`, in the order in which they come, with how many beads each has; the nth bead's body is at `lps_from_body(n)`.
    pub(super) fn of_beads(beads: &[BeadResidual], lps_from_body: impl Fn(usize) -> Rigid) -> Vec<Self> {
        let mut bodies: Vec<Self> = Vec::new();
        for (n, bead) in beads.iter().enumerate().filter(|(_, bead)| !bead.check) {
            let used = usize::from(bead.used);
            match bodies.iter_mut().find(|body| body.name == bead.body) {
                Some(body) => {
                    body.beads += 1;
                    body.used += used;
                }
                None => bodies.push(Self {
                    name: bead.body.clone(),
                    lps_from_body: lps_from_body(n),
                    beads: 1,
                    used,
                    covariance_at_centroid: None,
                }),
            }
        }
        bodies
    }
}

/// Uncertainty of P at a point of interest.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LandmarkUncertainty {
    /// Label.
    pub name: String,
    /// Its place.
    pub lps_mm: DVec3,
    /// Where P puts it; absent behind the source.
    pub image_px: Option<[f64; 2]>,
    /// Standard deviation of its place along `camera` x, y and z (depth).
    pub sigma_mm: [f64; 3],
    /// Standard deviation of its projection along columns and rows.
    pub sigma_px: Option<[f64; 2]>,
    /// Covariance of its projection, columns and rows.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub covariance_px2: Option<[[f64; 2]; 2]>,
}

/// The pose in the panel's own pixels and axes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DetectorPose {
    /// Pixels of the picture as the console stored it to pixels of the panel, homogeneous rows; centres at integers.
    pub detector_from_image: [[f64; 3]; 3],
    /// Columns and rows of the panel, if known.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub size_px: Option<[u32; 2]>,
    /// P: `lps` mm to `detector` px; absent when refused.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub projection: Option<Projection>,
    /// K of the panel.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub intrinsics: Option<Intrinsics>,
    /// The specimen in the camera whose columns and rows are the panel's.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub camera_from_lps: Option<Rigid>,
    /// Of ξ of that camera.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub covariance: Option<Covariance>,
}

/// Telemetry against the beads alone, where a session fuses the two.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TelemetryInnovation {
    /// Squared distance between the two, in standard deviations of both together.
    pub chi2: f64,
    /// Numbers that `chi2` sums.
    pub degrees_of_freedom: u32,
    /// Telemetry minus beads, about the axes of the camera.
    pub turn_deg: [f64; 3],
    /// The same along them, at the centroid of the beads.
    pub shift_mm: [f64; 3],
    /// Standard deviations of `turn_deg`.
    pub sigma_deg: [f64; 3],
    /// Standard deviations of `shift_mm`.
    pub sigma_mm: [f64; 3],
    /// The specimen in the camera by the beads alone.
    pub camera_from_lps: Rigid,
}

impl TelemetryInnovation {
    /// The root of the largest `chi2` that is no jump: with six degrees of freedom, larger by accident once in a thousand times.
    pub(super) const MOST_SIGMAS: f64 = 4.739;

    /// Whether the two contradict each other: no accident is that large.
    #[must_use]
    pub fn is_jump(&self) -> bool {
        !(self.chi2 <= Self::MOST_SIGMAS.powi(2))
    }
}

/// The result of a registration; the file of DESIGN §7. Refused poses carry no projection.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Pose {
    /// Accepted or refused.
    pub status: Status,
    /// Why it is refused: a word, a colon, a sentence.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// The same in parts: what was expected and what was found.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub refusal: Option<Refusal>,
    /// What a person should look at before an accepted pose is used.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub cautions: Vec<String>,
    /// The first of the cautions that leaves open whether the pose is this one: another reading, another scale, a mirror image; else that it is
    /// uncertain at a landmark.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub doubt: Option<String>,
    /// P: `lps` mm to `image` px, third coordinate the depth in mm.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub projection: Option<Projection>,
    /// K.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub intrinsics: Option<Intrinsics>,
    /// Where K comes from: `given`, `solved`, or `solved with priors`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub intrinsics_source: Option<String>,
    /// Standard deviations of solved (fx, fy, cx, cy), px.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub intrinsics_sigma_px: Option<[f64; 4]>,
    /// Columns and rows of the frame.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub size_px: Option<[u32; 2]>,
    /// Side of a pixel at the detector, if known.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub pitch_mm: Option<f64>,
    /// The specimen in the camera.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub camera_from_lps: Option<Rigid>,
    /// Rigid parts.
    pub bodies: Vec<BodyPose>,
    /// √mean(dx² + dy²) over used beads.
    pub rms_px: Option<f64>,
    /// The same in mm: rms_px · depth / f, at the isocentre where its depth is known, else at the mean depth of the used beads.
    pub rms_mm: Option<f64>,
    /// Depth of the isocentre, at which errors are told in mm; absent where it is not known, or where the beads are not near it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source_to_isocentre_mm: Option<f64>,
    /// The error at beads that P has not seen.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub unseen: Option<Unseen>,
    /// Weighted square residual over its degrees of freedom, with the 3D uncertainty of the beads.
    pub chi2_per_dof: Option<f64>,
    /// Expected number of matches as good as this by accident.
    pub chance: Option<f64>,
    /// Of ξ about the focal spot.
    pub covariance: Option<Covariance>,
    /// Of ξ about the bead centroid (axes of `camera`): translation is that of the beads.
    pub covariance_at_centroid: Option<Covariance>,
    /// Mean of the used beads.
    pub centroid_lps_mm: Option<DVec3>,
    /// Uncertainty where it was asked for.
    pub landmarks: Vec<LandmarkUncertainty>,
    /// All beads of the layout, in its order, then those of role `check`.
    pub beads: Vec<BeadResidual>,
    /// The tags that were seen, by id.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub tags: Vec<TagResidual>,
    /// Shadows found.
    pub detections: usize,
    /// The shadows, best first.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub shadows: Vec<Shadow>,
    /// Whether the prior entered as a measurement.
    pub fused: bool,
    /// Telemetry against the beads, where a session fuses the two.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub innovation: Option<TelemetryInnovation>,
    /// The picture was stored mirrored; `image` is the un-mirrored one.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub mirrored: bool,
    /// What the console did to the picture, where it was stated or solved; `image` is the picture with quarter turns and mirroring undone.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub console: Option<ConsoleGeometry>,
    /// The same pose in the panel's own pixels and axes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub detector: Option<DetectorPose>,
    /// What was looked at besides: the prior, other readings and why they do not stand.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub explained: Option<Explained>,
    /// What of its observations comes from a hand; absent where nothing does.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub edited: Option<Edited>,
    /// Assumptions and warnings.
    pub notes: Vec<String>,
    /// Software that wrote it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub version: Option<String>,
}

impl Pose {
    /// The same, refused for another reason.
    #[must_use]
    pub fn refused_for(self, refusal: Refusal) -> Self {
        Self { status: Status::Refused, reason: Some(refusal.to_string()), refusal: Some(refusal), ..self }
    }

    /// Whether it is in doubt, and not only for how loosely the beads hold it, or for what K moves beside them.
    #[must_use]
    pub fn may_be_another(&self) -> bool {
        self.doubt.as_deref().is_some_and(|words| !(is_of_looseness(words) || is_of_header_k(words)))
    }

    /// A caution that leaves open whether the pose is this one; the first stands for all, but one that several views or
    /// telemetry tell anew gives way to any other.
    pub fn doubt(&mut self, words: String) {
        let is_told_anew = |words: &str| is_of_looseness(words) || is_of_round_field(words) || is_of_header_k(words);
        if self.doubt.as_deref().is_none_or(is_told_anew) {
            self.doubt = Some(words.clone());
        }
        self.cautions.push(words);
    }

    /// That a reading which came to no pose of its own does not stand.
    pub(super) fn reject(&mut self, reading: Reading, why: Rejected) {
        self.explained.get_or_insert_default().readings.push(RejectedReading { reading, found: None, why: why.finite() });
    }

    /// Says where the prior came from, if there was one and nobody has said so.
    pub fn prior_from(&mut self, source: &str) {
        if let Some(prior) = self.explained.as_mut().and_then(|explained| explained.prior.as_mut()) {
            prior.source.get_or_insert_with(|| source.to_owned());
        }
    }

    /// An accepted pose, refused after all: what was found stays, what must not be used goes.
    pub(super) fn without_pose(self, refusal: Refusal) -> Self {
        let Self { size_px, pitch_mm, intrinsics, intrinsics_source, beads, detections, shadows, explained, .. } = self;
        let beads = beads.into_iter().map(|bead| BeadResidual { used: false, ..bead }).collect();
        let kept = Self {
            size_px,
            pitch_mm,
            intrinsics,
            intrinsics_source,
            beads,
            detections,
            shadows,
            explained,
            notes: self.notes,
            version: self.version,
            ..Self::default()
        };
        kept.refused_for(refusal)
    }

    /// With the shadows that another pose of the same frame has.
    pub(super) fn with_shadows_of(self, other: &Self) -> Self {
        Self { shadows: other.shadows.clone(), detections: other.detections, ..self }
    }

    /// Whether the pose may be used.
    #[must_use]
    pub fn is_accepted(&self) -> bool {
        self.status == Status::Accepted && self.projection.is_some()
    }

    /// K and the specimen's place, of an accepted pose.
    #[must_use]
    pub fn camera(&self) -> Option<(Intrinsics, Rigid)> {
        if self.status != Status::Accepted {
            return None;
        }
        Some((self.intrinsics?, self.camera_from_lps?))
    }

    /// What the stated σ leave out where K and the layout were taken as stated: how far one wrong by so much moves the specimen, which the
    /// beads do not show. `None` where K was solved for, or nothing was accepted.
    #[must_use]
    pub fn beyond_sigma(&self) -> Option<String> {
        let (k, camera_from_lps) = self.camera().filter(|_| self.intrinsics_sigma_px.is_none())?;
        let depth_mm = camera_from_lps.transform_point(self.centroid_lps_mm?).z;
        let counts_k = self.notes.iter().chain(&self.cautions).any(|words| is_of_header_k(words));
        let what = if counts_k { "the stated sigma of the pose itself" } else { "the stated sigma" };
        Some(format!(
            "{what} hold for K and the layout of the beads as given: f, or the layout's scale, wrong by 1 % moves the specimen {:.1} mm along the beam, a principal point wrong by 10 px {:.1} mm across",
            0.01 * depth_mm,
            10.0 * depth_mm / k.fx
        ))
    }

    /// K that the beads alone told, in words; `None` where it was given or stated, or nothing was accepted.
    #[must_use]
    pub fn solved_k(&self) -> Option<String> {
        let (k, _) = self.camera().filter(|_| self.intrinsics_source.as_deref() == Some("solved"))?;
        let sigma = self.intrinsics_sigma_px.map_or(String::new(), |[sigma_px, ..]| format!(" ± {sigma_px:.0}"));
        Some(format!("K solved from the beads (f {:.0}{sigma} px)", k.fx))
    }

    /// Reads a file.
    ///
    /// # Errors
    /// When it cannot be read, is not JSON, holds unknown keys, states its camera twice and differently, has two bodies of one name, or pixels
    /// of a size that no panel has.
    pub fn read(path: &Path) -> Result<Self, PoseFileError> {
        let pose: Self = read_json(path)?;
        let form = |place: &str, message: String| PoseFileError::Form { path: path.to_owned(), place: place.to_owned(), message };
        let is_named_before = |(n, body): &(usize, &BodyPose)| pose.bodies[..*n].iter().any(|earlier| earlier.name == body.name);
        if let Some((n, body)) = pose.bodies.iter().enumerate().find(is_named_before) {
            let message = format!("body {:?} stands there twice, and lies in one place only; remove one of the two", body.name);
            return Err(form(&format!("bodies[{n}].name"), message));
        }
        if let Some(pitch_mm) = pose.pitch_mm.filter(|pitch_mm| !is_pitch(*pitch_mm)) {
            return Err(form("pitch_mm", format!("pitch is {pitch_mm} mm, expected above 0, at most {MOST_PITCH_MM} mm")));
        }
        match pose.contradiction_px() {
            Some(off_px) if !(off_px <= MOST_APART_PX) => Err(PoseFileError::Contradiction { path: path.to_owned(), off_px }),
            _ => Ok(pose),
        }
    }

    /// How far P and K with the pose put places about the patient's origin apart, at most; `None` where the file has only one of them.
    fn contradiction_px(&self) -> Option<f64> {
        let (stated, (intrinsics, camera_from_lps)) = (self.projection?, self.camera()?);
        let composed = Projection::compose(&intrinsics, &camera_from_lps);
        let places = [DVec3::ZERO, 50.0 * DVec3::X, 50.0 * DVec3::Y, 50.0 * DVec3::Z];
        let apart = |p: DVec3| stated.project(p).0.distance(composed.project(p).0);
        places.into_iter().filter(|p| camera_from_lps.transform_point(*p).z > 1.0).map(apart).max_by(f64::total_cmp)
    }

    /// Writes a file, all or nothing.
    ///
    /// # Errors
    /// When the folder is missing or not writable, or the disk is full.
    pub fn write(&self, path: &Path) -> Result<(), PoseFileError> {
        write_json(path, self)
    }
}
