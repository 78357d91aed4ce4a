//! What the devices said at an exposure, for whoever looks at it when they have long said other things.

use super::robot_state::RobotState;
use crate::geometry::CarmJoints;
use crate::telemetry::CarmSample;

/// See the module. What telemetry does not tell of the exposure is absent.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AtExposure {
    /// The arm's joints in the middle of the exposure.
    pub joints: Option<CarmJoints>,
    /// The arm's sample nearest that.
    pub beam: Option<Box<CarmSample>>,
    /// The robot, as the DRR draws it.
    pub robot: Option<RobotState>,
}
