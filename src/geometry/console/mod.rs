//! What a console did to the panel's picture before it stored it, and how that is undone.
//!
//! The console crops the panel's picture, bins and enlarges it, turns it clockwise, then mirrors it (the order of DICOM's field of view
//! rotation and flip). Quarter turns and mirroring are undone on the pixels, exactly; the rest of a turn, cropping, binning and enlarging
//! are folded into K and the camera's axes ([`PanelWindow`](super::PanelWindow)), because resampled pixels would be worse ones. What an
//! image intensifier does lies in the panel's pixels and is folded alike ([`Intensifier::through_window`](super::Intensifier)): a place of
//! the frame goes through the window to the panel, through the distortion there, and by K to the camera.

mod declared;
mod orientation;
mod placement;

pub use declared::{ConsoleError, ConsoleGeometry, Flip, homogeneous_rows};
pub use orientation::quarters_and_rest;
