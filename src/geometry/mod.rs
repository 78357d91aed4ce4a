//! Frames, cameras and the two kinematic chains.
//!
//! The frame catalogue (`a_from_b` maps points in `b` to points in `a`):
//!
//! | frame | origin and axes | unit |
//! |---|---|---|
//! | `lps` | the CT's patient axes: +x left, +y posterior, +z superior | mm |
//! | `body` | a rigid part of the specimen; coordinates are `lps` at scan time | mm |
//! | `world` | the room: C-arm base at zero, z up, right-handed | mm |
//! | `tracker` | an optical tracker, if there is one | mm |
//! | `camera` | X-ray focal spot; +z to the detector, +x to increasing column, +y to increasing row | mm |
//! | `image` | continuous pixels (u, v) = (column, row); the centre of the first pixel is (0, 0) | px |
//! | `detector` | the panel's own pixels | px |
//! | `base`, `tip` | robot: origin of piece 0, +z along the shaft at rest; drill tip | mm |
//! | `voxel` | continuous index (i, j, k), voxel centres at integers | – |

mod angles;
mod camera;
mod joints;
mod sag;
mod voxel_grid;
mod carm;
mod panel_window;
mod console;
mod convert;
mod distortion;
pub mod formats;
mod intensifier;
mod rigid;
mod robot;
mod robot_calibration;

pub use angles::{AngleConvention, CarmAngles, PatientPosition};
pub use camera::{CameraError, Intrinsics, Projection, View};
pub use carm::{CarmCalibration, CarmCalibrationError, JointOffsets};
pub use console::{ConsoleError, ConsoleGeometry, Flip, homogeneous_rows, quarters_and_rest};
pub use convert::{RAS_FROM_LPS, dicom_angles_deg, lps_from_ras, ras_from_lps};
pub use distortion::{DEFAULT_ORDER, Distortion, DistortionError, ORDERS, noise_through, shift_slopes, term_count, terms};
pub use intensifier::{
    AnglesDeg, AnglesFrom, Glare, Intensifier, IntensifierCalibration, IntensifierError, IntensifierView, same_angle,
};
pub use joints::{CarmJoints, JOINT_KEYS};
pub use panel_window::{PanelWindow, seen_through, turned_camera};
pub use rigid::{Rigid, RigidError};
pub use robot::{CONTROL_COUNT, RobotModel, RobotModelError, RobotShape, TubeSize};
pub use robot_calibration::{RobotCalibration, RobotCalibrationError};
pub use sag::{GravitySag, Misalignment, SAG_TERMS, sag_terms};
pub use voxel_grid::VoxelGrid;
