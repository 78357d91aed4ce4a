//! Pictures off a video output: a monitor's signal through a capture device, or a recording of one.
//!
//! ```text
//! capture (OpenCV) ─ crop ─ what stands still and is new ─ mean of the pictures that stood ─ DICOM file in the watched folder
//! ```
//! A monitor shows a picture until the next one: what stands still is a frame, at the time at which it began to stand. Grabbing runs in a
//! process of its own, and capture in another, the program `sidecarm-video`, because drivers and decoders hang and crash; whoever watches
//! the folder reads its files like all others.

mod blocks;
mod capture;
mod grabber;
mod picture;
mod run;
mod settings;
mod source;
mod stillness;

pub use grabber::{GrabError, GrabOptions, Grabbed, grab};
pub use settings::{Rectangle, VideoSettings};
pub use source::{GrabbedSource, probe};
