//! The beads of a phantom that nobody has measured, from several shots of it.
//!
//! Given are, of each shot, round shadows that may be beads, K, and roughly where the camera was: from the C-arm's joints, or a prior pose.
//! Unknown are which shadow is which bead, the beads' places and the cameras. Three shots are matched first (`seeds`), the others join one
//! by one (`grow`), then everything is solved at once by the one least-squares core (`adjust`), in which the rough cameras count as
//! measurements with their standard deviations. A shadow that others do not predict, a bead in fewer than three shots, and a shot that
//! its joints contradict are left out (`prune`).
//!
//! Images alone tell shape, not size: the scale comes from how far the cameras are known to have moved, from a stated distance between two
//! beads, or from the shadows' radii, and its standard deviation is stated beside that of the shape. Shots that are alike, too few or
//! too far away also fit the cloud mirrored in depth; that image is sought and refused.

mod shot;
mod structure;
mod refusal;
mod adjust;
mod seeds;
mod grow;
mod prune;
mod gauge;
mod mirrored;
mod scale;
mod report;
mod solve;

pub use refusal::PhantomRefusal;
pub use report::{LeftOutBead, LeftOutShot, MeasuredBead, Phantom, ShotUsed, markups};
pub use scale::{Distance, Scale, ScaleSource};
pub use shot::{ArmSigma, CameraErrors, Cameras, PhantomShot, ShotShadow};
pub use solve::{Asked, measure};
