//! The projection matrix from beads.
//!
//! Shadows (`beads`) are matched to named beads, the pose is solved by Levenberg–Marquardt on SE(3) with a covariance that counts the
//! image's noise and the beads' own uncertainty, and the result is accepted, or refused with the reason. "Don't know" is an answer:
//! too few beads, degenerate layouts, accidental and ambiguous matches are refused.

mod doubt;
mod flat;
mod judge;
mod record;
mod register;
mod search;
mod solve;
mod start;
mod transform;
mod triangle;
mod verdict;

pub use record::{BeadResidual, BodyPose, Covariance, IntrinsicsFile, LandmarkUncertainty, Pose, PoseFileError, Prior, Status};
pub use register::{Matching, PRIOR_SIGMA, Registration, intrinsics_of, register, register_detections, register_masked};
pub use solve::{Free, IntrinsicsPrior};
