//! The projection matrix from beads.
//!
//! Shadows (`beads`) are matched to named beads, the pose is solved by Levenberg–Marquardt on SE(3) with a covariance that counts the
//! image's noise and the beads' own uncertainty, and the result is accepted, or refused with the reason. "Don't know" is an answer:
//! too few beads, degenerate layouts, accidental and ambiguous matches are refused.

mod accept;
mod bodies;
mod case;
mod doubt;
mod flat;
mod judge;
mod propose;
mod record;
mod refusal;
mod register;
mod request;
mod straighten;
mod search;
mod settle;
mod solve;
mod start;
mod tagged;
mod transform;
mod triangle;
mod verdict;
mod with_tags;

pub use case::PRIOR_SIGMA;
pub use record::{
    BeadResidual, BodyPose, Covariance, IntrinsicsFile, LandmarkUncertainty, Pose, PoseFileError, Prior, Shadow, Status,
    TagResidual,
};
pub use refusal::{Points, Refusal, Rival};
pub use register::{intrinsics_of, register, register_masked, register_shadows};
pub use request::Registration;
pub use solve::{Free, IntrinsicsPrior};
pub use with_tags::register_tagged;
