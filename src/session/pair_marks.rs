//! What is marked in the frame of a pair, by how it was posed.

use super::posed::Posed;
pub use crate::report::{BeadMark, LandmarkMark, PairMarks, RobotMark};
use crate::scene::Scene;

/// The marks of a posed frame; the robot is that of the scene that its DRR shows.
pub(super) fn marks_of(posed: &Posed, scene: Option<&Scene>) -> PairMarks {
    let distortion = posed.intensifier.as_deref().map(|intensifier| &intensifier.distortion);
    PairMarks::of(&posed.pose, distortion, posed.view.as_ref(), scene)
}
