//! Where telemetry puts arm and robot, for whoever looks on: OpenIGTLink, and Foxglove's frame tree in the log.

use super::file::Setup;
use crate::geometry::{CarmCalibration, CarmJoints, Rigid, RobotShape};
use crate::scene::Robot;
use crate::telemetry::{AngleSource, RobotSample};

/// See the module.
#[derive(Clone, Debug)]
pub(super) struct Whereabouts {
    carm: Option<CarmCalibration>,
    robot: Option<Robot>,
    world_from_tracker: Option<Rigid>,
}

/// A robot by one sample.
pub(super) struct RobotPlace {
    pub(super) lps_from_base: Rigid,
    /// Its shape; absent where an angle is not known.
    pub(super) shape: Option<RobotShape>,
    pub(super) source: AngleSource,
}

impl Whereabouts {
    /// `robot` is the scene's.
    pub(super) fn new(setup: &Setup, robot: Option<&Robot>) -> Self {
        let world_from_tracker = setup.session.world_from_tracker.and_then(|rows| Rigid::from_rows(&rows).ok());
        Self { carm: setup.carm.clone(), robot: robot.cloned(), world_from_tracker }
    }

    /// `world_from_camera`, nominal, of the panel's own axes. Joints without encoders have no pose; that is said with each frame.
    pub(super) fn world_from_camera(&self, joints: &CarmJoints) -> Option<Rigid> {
        self.carm.as_ref()?.world_from_camera(joints).ok()
    }

    /// The robot; `world_from_lps` is what is known of the specimen now.
    pub(super) fn robot(&self, sample: &RobotSample, world_from_lps: Option<Rigid>) -> Option<RobotPlace> {
        let robot = self.robot.as_ref()?;
        let lps_from_base = self.lps_from_base(robot, sample, world_from_lps)?;
        let (angles_deg, source) = sample.control_angles_deg();
        Some(RobotPlace { lps_from_base, shape: robot.shape_at(&angles_deg).ok(), source })
    }

    /// The base by this sample alone: tracked, or the scene's where nothing is tracked. A base that the tracker does not see now, or that is
    /// not tied to the specimen, is nowhere.
    fn lps_from_base(&self, robot: &Robot, sample: &RobotSample, world_from_lps: Option<Rigid>) -> Option<Rigid> {
        match (sample.tracker_from_base, self.world_from_tracker) {
            (None, None) => Some(robot.lps_from_base),
            (Some(tracker_from_marker), Some(world_from_tracker)) => {
                Some(world_from_lps?.inverse() * world_from_tracker * tracker_from_marker * robot.marker_from_base)
            }
            _ => None,
        }
    }
}
