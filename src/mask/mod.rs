//! Which pixels of a frame mean anything: the open field, saturation, writing, dead pixels, each cause by itself.
//!
//! Everything that looks at pixels looks at the same ones: beads are sought and scores are taken inside the same masks.
//!
//! *The open field* (`find_field`): where the collimator, or the intensifier's input window, lets the beam through. The shut part is
//! recognised by what physics leaves there (leakage, glare and readout noise, or a console's paint) and by its shape: the open field is
//! an intersection of half planes and at most one disc.
//!
//! *Dead pixels* are those of the detector calibration, and those that a raw frame shows by itself.

mod shape;
mod signal;
mod cells;
mod contour;
mod fit;
mod refusal;
mod profile;
mod penumbra;
mod edge;
mod outline;
mod field;
mod fill;
mod told;
mod text;
mod local_noise;
mod dead_lines;
mod dead;
mod layers;
mod frame;

pub use field::{Field, find_field, find_told_field};
pub use fill::fill;
pub use frame::{of_frame, of_told_frame};
pub use layers::{Cause, MaskShares, Masks, REQUIRED_SHARE, any_in_block, discs};
pub use shape::{Disc, FieldShape, HalfPlane};
pub use text::{Component, components};
pub use told::opening_in_frame;
