//! The projection matrix from beads.
//!
//! Shadows (`beads`) are matched to named beads, the pose is solved by Levenberg–Marquardt on SE(3) with a covariance that counts the
//! image's noise and the beads' own uncertainty, and the result is accepted, or refused with the reason. "Don't know" is an answer:
//! too few beads, degenerate layouts, accidental and ambiguous matches are refused.

mod accept;
mod artefact;
mod bead_triples;
mod besides;
mod bodies;
mod by_header;
mod case;
mod cautions;
mod doubt;
mod edited;
mod explained;
mod file;
mod flat;
mod frame_k;
mod gate;
mod hand_marks;
mod hand_shadows;
mod innovation;
mod intrinsics_file;
mod isocentre;
mod judge;
mod lag;
mod lens;
mod moved;
mod occupancy;
mod off_depth;
mod on_panel;
mod orientation;
mod other_intrinsics;
mod prior;
mod prior_use;
mod propose;
mod radii;
mod readings;
mod record;
mod refusal;
mod register;
mod request;
mod residual;
mod rivals;
mod search;
mod settle;
mod shadow;
mod side_by_side;
mod solve;
mod span;
mod start;
mod straighten;
mod support;
mod tables;
mod tagged;
mod three;
mod tightness;
mod together;
mod transform;
mod triangle;
mod twin;
mod unseen;
mod unstated_lens;
mod verdict;
mod why_refused;
mod with_tags;

pub use by_header::{Focal, off_header};
pub use case::PRIOR_SIGMA;
pub use edited::register_edited;
pub use explained::{Explained, ExplainedPrior, FoundReading, PriorUse, Reading, Rejected, RejectedReading, Told};
pub use file::PoseFileError;
pub use frame_k::{FrameK, OtherSize, why_other_size};
pub use hand_marks::{ByHand, Edited, HandMark, HandSays};
pub use innovation::{fuse, innovation};
pub use intrinsics_file::{IntrinsicsFile, IntrinsicsSigma, is_pitch};
pub use isocentre::isocentre_of;
pub use on_panel::read_console;
pub use orientation::{Panel, SolvedConsole, solve_console, whole_binning};
pub use prior::Prior;
pub use record::{BodyPose, Covariance, DetectorPose, LandmarkUncertainty, Pose, Status, TelemetryInnovation};
pub use refusal::{IntrinsicsNumber, Points, Refusal, Rival};
pub use register::{Looked, intrinsics_of, look, register, register_looked, register_masked, register_shadows, rough_pose};
pub use request::Registration;
pub use residual::{BeadResidual, TagResidual};
pub use shadow::Shadow;
pub use solve::{Free, IntrinsicsPrior, image_spread, rounded_px};
pub use span::span_mm;
pub use together::{
    Against, BeadVerdict, Bump, SeveralViews, SolvedBead, Together, TogetherRefusal, ViewAlone, register_together,
};
pub use triangle::align as align_triangles;
pub use unseen::{Unseen, UnseenBy, WorstBead};
pub use verdict::extents_mm;
pub use with_tags::register_tagged;
