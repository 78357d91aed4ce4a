//! Bead layouts and bead detection.
//!
//! A layout is what is known of the beads in the specimen (a 3D Slicer markups file); a detection is the shadow of a sphere found in a
//! frame. Which detection is which bead is decided in `pose`.
//!
//! Detection takes no hand-set parameter: candidates are blobs of any size in a robustly normalised line-integral image, each is fitted
//! with the blurred shadow of a sphere on a curved background, and what does not look like a sphere's shadow is dropped.

mod candidates;
mod centre_noise;
mod correspondences;
mod correlation;
mod description;
mod detect;
mod fit;
mod fitted;
mod flags;
mod layout;
mod markups;
mod markups_error;
mod model;
mod noise;
mod place_covariance;
mod probe;
mod products;
mod profile;
mod radius_sigma;
mod several;
mod shadow;
mod window;
pub mod tags;

pub use centre_noise::{is_covariance_px2, known_at_best};
pub use correspondences::{Correspondence, CorrespondencesError, read_correspondences};
pub use detect::{Detection, Detections, Expectation, Polarity, Signal, detect, detect_image};
pub use flags::Flags;
pub use layout::{Bead, BeadLayout, DEFAULT_BODY, DEFAULT_SIGMA_MM, Landmark};
pub use markups::{parse_landmarks, parse_markups, read_landmarks, read_markups, says_ras};
pub use markups_error::BeadsError;
pub use place_covariance::{CovarianceFault, PlaceCovariance};
pub use probe::Probe;
