//! What the image intensifier does to one frame of a session: its calibration at the arm's angles.

use std::sync::Arc;

use crate::acquire::Frame;
use crate::geometry::{AnglesFrom, CarmJoints, Intensifier, IntensifierCalibration};

/// The intensifier as it was at `frame`'s exposure, in the frame's own pixels. A calibration by positioner angles takes those of the
/// frame's tags, any other the joints of telemetry.
///
/// # Errors
/// In words: when the angle is not known, or the panel's picture is no other size of the one that was calibrated.
pub(super) fn seen_through(
    calibration: &IntensifierCalibration,
    frame: &Frame,
    joints: Option<&CarmJoints>,
) -> Result<Arc<Intensifier>, String> {
    let angles_deg = match calibration.angles_from {
        AnglesFrom::Positioner => {
            frame.tags.primary_deg.zip(frame.tags.secondary_deg).map(|(primary, secondary)| [primary, secondary])
        }
        AnglesFrom::Given | AnglesFrom::Unknown => {
            joints.map(|joints| [joints.orbital_rad.to_degrees(), joints.angulation_rad.to_degrees()])
        }
    };
    let whose = match calibration.angles_from {
        AnglesFrom::Positioner => "the frame's tags",
        AnglesFrom::Given | AnglesFrom::Unknown => "telemetry",
    };
    let at = calibration.at(angles_deg).and_then(|intensifier| frame.seen_through(&intensifier));
    at.map(Arc::new).map_err(|error| format!("{error} (angles come from {whose})"))
}
