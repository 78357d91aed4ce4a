//! A frame with its pose, and what people are told of it.

use std::sync::Arc;

use super::edit::again;
use super::robot_state::RobotState;
use super::tie::Disagreement;
use crate::acquire::Frame;
use crate::geometry::{CarmJoints, Intensifier, Rigid, View};
use crate::mask::Masks;
use crate::pose::{Pose, Refusal};
use crate::report::{KSource, PoseSource};
use crate::telemetry::CarmSample;
use crate::time::StageTimes;
use crate::timeline::Binding;

/// A frame with everything known about when and where it was taken.
#[derive(Clone, Debug)]
pub struct Posed {
    /// Counts frames of the session from 1, in order of arrival.
    pub number: u32,
    /// How often the frame was posed before: 0, or more where its exposure became clear only later, or where its beads were edited.
    pub development: u32,
    /// The frame.
    pub frame: Arc<Frame>,
    /// When in its exposure it was taken, or the arrival where it is not bound; host time.
    pub time_us: i64,
    /// Which exposure, and why.
    pub binding: Binding,
    /// What registration said.
    pub pose: Pose,
    /// Which of the frame's pixels mean nothing.
    pub masks: Arc<Masks>,
    /// What the import had to say about the frame.
    pub warnings: Vec<String>,
    /// What the image intensifier did to the frame; all places of the pose are those of the undistorted picture.
    pub intensifier: Option<Arc<Intensifier>>,
    /// Which pose is used.
    pub pose_source: PoseSource,
    /// Where K comes from, if not from the beads.
    pub k_source: Option<KSource>,
    /// The view to render; absent without a pose.
    pub view: Option<View>,
    /// The robot, when telemetry covers the exposure.
    pub robot: Option<RobotState>,
    /// C-arm joints at the exposure.
    pub joints: Option<CarmJoints>,
    /// Span of the C-arm samples that were interpolated.
    pub carm_gap_us: Option<i64>,
    /// Camera in the specimen by telemetry, as registration was given it as a prior.
    pub nominal: Option<Rigid>,
    /// The C-arm's sample nearest the middle of the exposure: beam, field, joints.
    pub beam: Option<Box<CarmSample>>,
    /// How far beads and telemetry are apart, where they contradict each other.
    pub telemetry_disagreement: Option<Disagreement>,
    /// That the beads' depth is not that of other frames, which a picture of another scale explains.
    pub other_depth: Option<String>,
    /// Wall time of detection and pose.
    pub stages: StageTimes,
}

impl Posed {
    /// How people are told of the frame.
    #[must_use]
    pub fn label(&self) -> String {
        let again = again(self.pose.edited.is_some(), self.development);
        format!("frame {} ({}){again}", self.number, self.frame.name)
    }

    /// What became of its registration, in a line.
    #[must_use]
    pub fn announcement(&self) -> String {
        let outcome = match &self.pose.reason {
            Some(reason) if matches!(self.pose.refusal, Some(Refusal::Layout { .. })) => format!("not registered, {reason}"),
            Some(reason) => format!("refused, {reason}"),
            None => {
                let unseen = self.pose.unseen.as_ref().map(|unseen| format!(", unseen beads {:.3} px", unseen.rms_px));
                let solved = self.pose.solved_k().map(|words| format!("; {words}"));
                let more = [unseen, solved].into_iter().flatten().collect::<String>();
                format!("accepted, rms {:.3} px{more}", self.pose.rms_px.unwrap_or(f64::NAN))
            }
        };
        format!("{}: {outcome}", self.label())
    }

    pub(super) fn with_telemetry_disagreement(self, telemetry_disagreement: Option<Disagreement>) -> Self {
        Self { telemetry_disagreement, ..self }
    }
}

#[cfg(test)]
impl Posed {
    /// A small frame of which nothing is known, for tests of what is done with pairs.
    pub(super) fn bare(number: u32) -> Self {
        use crate::acquire::Domain;
        use crate::image::Image;
        let mut frame = Frame::from_pixels("a", Image::filled(4, 3, 1.0f32), Domain::Linear).expect("a frame");
        frame.number = number;
        Self {
            number,
            development: 0,
            frame: Arc::new(frame),
            time_us: 0,
            binding: Binding::default(),
            pose: Pose::default(),
            masks: Arc::default(),
            warnings: Vec::new(),
            intensifier: None,
            pose_source: PoseSource::Beads,
            k_source: None,
            view: None,
            robot: None,
            joints: None,
            carm_gap_us: None,
            nominal: None,
            beam: None,
            telemetry_disagreement: None,
            other_depth: None,
            stages: StageTimes::default(),
        }
    }
}
