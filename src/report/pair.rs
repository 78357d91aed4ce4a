//! What is kept of each exposure: the entries of `pairs.json`.

use std::collections::BTreeMap;

use super::bead_row::BeadRow;
use super::canvas::Rgb;
use super::colour;
use super::k_source::KSource;
use crate::calibrate::robot::SeenTip;
use crate::compare::{AirReport, Comparison, Disagreement, Elsewhere, NullPlan, NullScore, Scores, ToneFit, elsewhere};
use crate::mask::{Cause, MaskShares};
use crate::pose::{Edited, Pose, Refusal};
use crate::time::StageTimes;
use crate::timeline::NO_EXPOSURE;

/// Where the pose that was rendered came from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseSource {
    /// Registered on beads.
    Beads,
    /// The nominal pose from C-arm telemetry.
    Telemetry,
    /// There was none, and nothing was rendered.
    None,
}

/// What became of the registration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PairStatus {
    /// P is good.
    Accepted,
    /// The beads agree on P, but the image as a whole prefers another pose.
    AcceptedImageDisagrees,
    /// The beads agree on P, but telemetry puts the specimen, or the detector, elsewhere.
    AcceptedTelemetryDisagrees,
    /// The beads agree on P, and something leaves open whether it is this one: another reading, another scale, a mirror image.
    AcceptedInDoubt,
    /// Tried and refused, with a reason.
    Refused,
    /// Not tried: the session names no beads to look for, or its layout was refused.
    NoPose,
}

impl PairStatus {
    /// What became of a frame whose beads gave `pose`; `source` says which is used.
    #[must_use]
    pub fn of(pose: &Pose, source: PoseSource) -> Self {
        match (&pose.refusal, source) {
            _ if pose.is_accepted() => Self::Accepted,
            // Without beads to look for, nothing was tried, whatever telemetry tells.
            (Some(Refusal::Layout { .. }), _) | (None, PoseSource::None) => Self::NoPose,
            _ => Self::Refused,
        }
    }

    /// Whether P rests on beads, doubted or not.
    #[must_use]
    pub fn is_accepted(self) -> bool {
        match self {
            Self::Accepted | Self::AcceptedImageDisagrees | Self::AcceptedTelemetryDisagrees | Self::AcceptedInDoubt => true,
            Self::Refused | Self::NoPose => false,
        }
    }
}

/// Status and fallback in one, as pictures and tables show it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Standing {
    /// Registered on beads.
    Accepted,
    /// Registered on beads; the image as a whole prefers another pose.
    ImageDisagrees,
    /// Registered on beads; telemetry contradicts them.
    TelemetryDisagrees,
    /// Registered on beads; another pose may be the right one.
    InDoubt,
    /// Refused or not tried, shown with the pose from telemetry.
    Telemetry,
    /// Refused, nothing rendered.
    Refused,
    /// No pose, nothing rendered.
    NoPose,
}

impl Standing {
    /// In capitals, as the strip shows it.
    #[must_use]
    pub fn word(self) -> &'static str {
        match self {
            Self::Accepted => "ACCEPTED",
            Self::ImageDisagrees => "ACCEPTED, IMAGE DISAGREES",
            Self::TelemetryDisagrees => "ACCEPTED, TELEMETRY DISAGREES",
            Self::InDoubt => "ACCEPTED, IN DOUBT",
            Self::Telemetry => "POSE FROM TELEMETRY",
            Self::Refused => "REFUSED",
            Self::NoPose => "NO POSE",
        }
    }

    /// In a word or two, where there is little room.
    #[must_use]
    pub fn short(self) -> &'static str {
        match self {
            Self::Accepted => "accepted",
            Self::ImageDisagrees => "image disagrees",
            Self::TelemetryDisagrees => "telemetry disagrees",
            Self::InDoubt => "in doubt",
            Self::Telemetry => "telemetry",
            Self::Refused => "refused",
            Self::NoPose => "no pose",
        }
    }

    /// Its colour on dark ground.
    #[must_use]
    pub fn colour(self) -> Rgb {
        match self {
            Self::Accepted => colour::GOOD,
            Self::ImageDisagrees | Self::TelemetryDisagrees | Self::InDoubt | Self::Telemetry | Self::NoPose => colour::CAUTION,
            Self::Refused => colour::BAD,
        }
    }

    /// Class in the style sheet of the report.
    pub(super) fn class(self) -> &'static str {
        match self {
            Self::Accepted => "good",
            Self::ImageDisagrees | Self::TelemetryDisagrees | Self::InDoubt | Self::Telemetry | Self::NoPose => "caution",
            Self::Refused => "bad",
        }
    }
}

/// What a strip says above its pictures. Of one comparison, strips that say the same are the same.
#[derive(Clone, Debug, PartialEq)]
pub struct Heading {
    /// Colour and word.
    pub standing: Standing,
    /// Residuals, or the reason.
    pub status: String,
    /// Scores, each short.
    pub scores: Vec<String>,
}

/// The error against a known truth, at landmarks.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct TruthError {
    /// Mean over the landmarks in the frame, px.
    pub mean_px: f64,
    /// The same at the isocentre, mm.
    pub mean_mm: Option<f64>,
}

/// How far telemetry puts the camera from where the beads have it: what a filter that trusts both would call the innovation.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Innovation {
    /// Telemetry minus beads at the centroid of the beads, along the camera's axes, mm.
    pub shift_mm: [f64; 3],
    /// Between the two attitudes, degrees.
    pub turn_deg: f64,
    /// The larger of both in standard deviations of the calibrated arm; `None` where its calibration states none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sigmas: Option<f64>,
}

/// Where the robot is drawn, frame and DRR correlate better than this if it is there: 0.98 in drawn frames, up to 0.55 where it is not.
const SEEN_ZNCC: f64 = 0.6;

/// One exposure.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Pair {
    /// Counts the frames of a session from 1, in order of arrival; 0 outside one.
    #[serde(default)]
    pub number: u32,
    /// Label of the acquired frame; several frames may share it.
    pub frame: String,
    /// SHA-256 of the frame's file.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub sha256: String,
    /// Host time of the middle of the exposure, else of the frame's arrival, µs since the Unix epoch.
    pub time_us: Option<i64>,
    /// How the frame was bound to an exposure: `counter`, `time` or `none`.
    pub binding: String,
    /// What the binding rests on.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub binding_evidence: Vec<String>,
    /// The frame of which this is the picture, exported again.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub copy_of: Option<u32>,
    /// Which pose was rendered.
    pub pose_source: PoseSource,
    /// What became of the registration.
    pub status: PairStatus,
    /// Why it was refused, not tried, or doubted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// What of the pose comes from a hand; absent where nothing does.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub edited: Option<Edited>,
    /// What a person noted of the exposure in the window.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
    /// √mean(dx² + dy²) over the used beads, px.
    pub rms_px: Option<f64>,
    /// The same at the isocentre, mm.
    pub rms_mm: Option<f64>,
    /// Where K comes from; absent where there is none.
    #[serde(default, skip_serializing_if = "Option::is_none", deserialize_with = "super::k_source::known")]
    pub k_source: Option<KSource>,
    /// Beads of the layout, in its order; empty where none were looked for.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub beads: Vec<BeadRow>,
    /// Telemetry against the beads, where both have a pose.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub innovation: Option<Innovation>,
    /// Where the frame shows the drill's tip, against where the DRR draws it; absent where the robot is not seen.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tip: Option<SeenTip>,
    /// How the images agree.
    pub scores: Scores,
    /// What plainly disagrees between the images, whatever the pose.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub disagreements: Vec<Disagreement>,
    /// Each score against its null; empty when it was not made.
    pub null: BTreeMap<String, NullScore>,
    /// How the null was made.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub null_plan: Option<NullPlan>,
    /// The pose that the image prefers, where it disagrees with the beads.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub image_prefers: Option<Elsewhere>,
    /// What was left out of the scores.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub masks: Option<MaskShares>,
    /// The declared tone as fitted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tone: Option<ToneFit>,
    /// Scores without tone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scores_without_tone: Option<Scores>,
    /// Scores of the robot alone.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scores_tool: Option<Scores>,
    /// Where the air level came from.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub air: Option<AirReport>,
    /// What to beware of.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub flags: Vec<String>,
    /// Where the robot's shape came from: `sensed`, `commanded`, `scene` or `none`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot_source: Option<String>,
    /// Why the robot may be otherwise than it is drawn, though telemetry tells of it.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub robot_cautions: Vec<String>,
    /// Largest gap between telemetry samples that an interpolated answer spans, µs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gap_us: Option<i64>,
    /// Stated error of the render: |Δ line integral| / max(1, line integral).
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub render_error: Option<f64>,
    /// Error against truth, where a demo or a test knows it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub truth: Option<TruthError>,
    /// The strip, relative to the session's folder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub strip: Option<String>,
    /// The DRR, relative to the session's folder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub drr: Option<String>,
    /// Milliseconds per stage.
    pub stages_ms: StageTimes,
}

impl Pair {
    /// A frame of which nothing else is known yet.
    #[must_use]
    pub fn unmatched(frame: &str, reason: &str) -> Self {
        Self {
            number: 0,
            frame: frame.to_owned(),
            sha256: String::new(),
            time_us: None,
            binding: "none".into(),
            binding_evidence: Vec::new(),
            copy_of: None,
            pose_source: PoseSource::None,
            status: PairStatus::NoPose,
            reason: Some(reason.to_owned()),
            edited: None,
            note: None,
            rms_px: None,
            rms_mm: None,
            k_source: None,
            beads: Vec::new(),
            innovation: None,
            tip: None,
            scores: Scores::default(),
            disagreements: Vec::new(),
            null: BTreeMap::new(),
            null_plan: None,
            image_prefers: None,
            masks: None,
            tone: None,
            scores_without_tone: None,
            scores_tool: None,
            air: None,
            flags: Vec::new(),
            robot_source: None,
            robot_cautions: Vec::new(),
            gap_us: None,
            render_error: None,
            truth: None,
            strip: None,
            drr: None,
            stages_ms: StageTimes::default(),
        }
    }

    /// Takes over what a comparison found; flags are added to those there are.
    pub fn set_comparison(&mut self, comparison: &Comparison) {
        self.scores = comparison.scores.clone();
        self.disagreements = comparison.disagreements.clone();
        self.null = comparison.null.clone();
        self.null_plan = comparison.null_plan.clone();
        self.masks = Some(comparison.masks.clone());
        self.tone = Some(comparison.tone.clone());
        self.scores_without_tone = Some(comparison.scores_without_tone.clone());
        self.scores_tool = comparison.scores_tool.clone();
        self.air = Some(comparison.air.clone());
        for flag in &comparison.flags {
            if !self.flags.contains(flag) {
                self.flags.push(flag.clone());
            }
        }
    }

    /// Turns an accepted pair into one whose image disagrees, where its null says so, or nothing of one image is seen in the other.
    pub fn judge_image(&mut self) {
        if !self.is_from_beads() {
            return;
        }
        let another =
            |found: &&Disagreement| matches!(found, Disagreement::Unrelated { .. } | Disagreement::InvertedContrast { .. });
        if let Some(found) = elsewhere(&self.null) {
            self.status = PairStatus::AcceptedImageDisagrees;
            self.reason = Some(found.to_string());
            self.image_prefers = Some(found);
        } else if let Some(found) = self.disagreements.iter().find(another) {
            self.status = PairStatus::AcceptedImageDisagrees;
            self.reason = Some(found.to_string());
        }
    }

    /// Turns an accepted pair into one that telemetry contradicts, with the reason.
    pub fn doubt_by_telemetry(&mut self, reason: &str) {
        if matches!(self.status, PairStatus::Accepted | PairStatus::AcceptedInDoubt) {
            self.status = PairStatus::AcceptedTelemetryDisagrees;
            self.reason = Some(reason.to_owned());
        }
    }

    /// Turns an accepted pair into one whose pose may be another, with the reason.
    pub fn doubt(&mut self, reason: &str) {
        if self.status == PairStatus::Accepted {
            self.status = PairStatus::AcceptedInDoubt;
            self.reason = Some(reason.to_owned());
        }
    }

    /// That the frame does not show the robot where the DRR draws it, by the scores of that place: the kind of warning, and its words.
    #[must_use]
    pub fn robot_unseen(&self) -> Option<(&'static str, String)> {
        let drawn = self.masks.as_ref()?.causes.get(&Cause::Tool).copied().unwrap_or(0.0);
        if !(drawn > 0.0) {
            let words = "the robot is drawn outside what the frame shows: nothing tells whether it is there";
            return Some(("robot outside the frame", words.to_owned()));
        }
        let zncc = self.scores_tool.as_ref()?.zncc?;
        let words = format!(
            "the frame does not show the robot where the DRR draws it (correlation there {zncc:.2}): check its base, its tracking and its angles"
        );
        (zncc < SEEN_ZNCC).then_some(("robot not seen", words))
    }

    /// Takes back what was said of a picture whose file was written on or anew: `by` is the whole one, and has the exposure.
    pub fn replace_by(&mut self, by: u32) {
        let reason = format!("the file was written on, or anew, after it was read: frame {by} is the whole picture");
        self.status = PairStatus::Refused;
        self.reason = Some(reason.clone());
        self.binding = "none".to_owned();
        self.binding_evidence = vec![reason];
        (self.rms_px, self.rms_mm, self.innovation, self.tip) = (None, None, None, None);
        self.beads.clear();
    }

    /// What to say of the robot's shape where telemetry does not tell it.
    #[must_use]
    pub fn robot_words(&self) -> Option<&'static str> {
        let untold = self.robot_source.as_deref() == Some("scene");
        // Telemetry may well be there: which of its exposures the frame is of is not known.
        let unbound = self.binding == "none" && self.binding_evidence.iter().any(|words| words != NO_EXPOSURE);
        untold.then_some(match unbound {
            true => "robot drawn as in the scene file: the frame is bound to no exposure",
            false => "robot drawn as in the scene file: no telemetry covers the exposure",
        })
    }

    /// Whether P rests on beads, agreed with by the image or not.
    #[must_use]
    pub fn is_from_beads(&self) -> bool {
        self.status.is_accepted()
    }

    /// Status and fallback in one.
    #[must_use]
    pub fn standing(&self) -> Standing {
        match (self.status, self.pose_source) {
            (PairStatus::Accepted, _) => Standing::Accepted,
            (PairStatus::AcceptedImageDisagrees, _) => Standing::ImageDisagrees,
            (PairStatus::AcceptedTelemetryDisagrees, _) => Standing::TelemetryDisagrees,
            (PairStatus::AcceptedInDoubt, _) => Standing::InDoubt,
            (_, PoseSource::Telemetry) => Standing::Telemetry,
            (PairStatus::Refused, _) => Standing::Refused,
            (PairStatus::NoPose, _) => Standing::NoPose,
        }
    }

    /// The status line of the strip: residuals, or the reason.
    #[must_use]
    pub fn status_line(&self) -> String {
        let mut parts: Vec<String> = self.edited.iter().map(ToString::to_string).collect();
        if let Some(px) = self.rms_px.filter(|_| self.is_from_beads()) {
            let mm = self.rms_mm.map(|mm| format!(" ({mm:.3} mm)")).unwrap_or_default();
            parts.push(format!("rms {px:.3} px{mm}"));
        }
        parts.extend(self.robot_words().map(str::to_owned));
        parts.extend(self.robot_cautions.iter().cloned());
        parts.extend(self.reason.clone());
        parts.join(" · ")
    }

    /// What its strip says.
    #[must_use]
    pub fn heading(&self) -> Heading {
        Heading { standing: self.standing(), status: self.status_line(), scores: self.score_words() }
    }

    /// Scores for the strip's header, each short.
    #[must_use]
    pub fn score_words(&self) -> Vec<String> {
        score_words(&self.scores, &self.null)
    }
}

/// The most telling scores in a few words each; those that do not discriminate carry a question mark.
#[must_use]
pub fn score_words(scores: &Scores, null: &BTreeMap<String, NullScore>) -> Vec<String> {
    let doubt = |name: &str| if null.get(name).is_some_and(|n| !n.discriminating) { "?" } else { "" };
    let mut words = Vec::new();
    if let Some(zncc) = scores.zncc {
        words.push(format!("ZNCC {zncc:.3}{}", doubt("zncc")));
    }
    if let Some(gradient) = scores.gradient_ncc {
        words.push(format!("gradient {gradient:.3}{}", doubt("gradient_ncc")));
    }
    if let Some(rmse) = scores.rmse_nepers {
        words.push(format!("RMSE {rmse:.3} nepers{}", doubt("rmse_nepers")));
    } else if let Some(mm) = scores.edge_distance_mm {
        words.push(format!("edges {mm:.2} mm{}", doubt("edge_distance_px")));
    }
    words
}
