//! Cameras in the words of other tools: one text in, one camera out, and back.
//!
//! Ours: `camera_from_lps` maps patient millimetres (`lps`) to the focal spot's frame (+z to the detector, +x to increasing column, +y
//! to increasing row); K maps that to pixels, the centre of the first pixel is (0, 0). What differs is converted here and nowhere else:
//!
//! | format | patient axes | camera axes | centre of the first pixel | keeps |
//! |---|---|---|---|---|
//! | `matrix` | lps | – (P = K [R\|t], any positive scale) | (0, 0) | K, pose |
//! | `kr` | lps | ours | (0, 0) | K, pose |
//! | `kr-json` | lps | ours | (0, 0) | all |
//! | `opencv` | lps | ours | (0, 0) | all |
//! | `rtk` | lps, as ITK reads the volume | +y up, +z to the source; detector in mm, v upwards | in mm: (−(c−1)/2 · p, +(r−1)/2 · p) | K, pose; needs pitch and size |
//! | `deepdrr` | ras (`--axes lps` for volumes loaded as LPS) | ours | (½, ½) | all |
//! | `xreg` | lps | three, named in the file; two of them see the picture mirrored | (0, 0) | all |
//! | `slicer` | lps, as every ITK file | ours | – | pose only |
//!
//! No input or output: text comes in, text goes out.

mod deepdrr;
mod error;
mod exchanged;
mod format;
mod json;
mod matrix;
mod numbers;
mod opencv;
mod recognise;
mod rtk;
mod slicer;
mod xreg;
mod yaml;

pub use error::FormatError;
pub use exchanged::{ExchangedCamera, Known};
pub use format::{Format, PatientAxes, XregFrame};
pub use recognise::recognise;
pub use rtk::RtkParameters;

use crate::table::unmarked;

/// Reads a camera; what `text` does not say is taken from `known`.
///
/// # Errors
/// When the text is not of the format, holds unknown keys, wrong shapes, numbers that are not finite, or mirrors.
pub fn read(format: Format, text: &str, axes: PatientAxes, known: &Known) -> Result<ExchangedCamera, FormatError> {
    let text = unmarked(text);
    let mut camera = match format {
        Format::Matrix => matrix::read_projection(text)?,
        Format::Kr => matrix::read_kr(text)?,
        Format::KrJson => matrix::read_kr_json(text)?,
        Format::OpenCv => opencv::read(text)?,
        Format::Rtk => rtk::read(text, known)?,
        Format::DeepDrr => deepdrr::read(text)?,
        Format::Xreg(_) => xreg::read(text)?,
        Format::Slicer => slicer::read(text)?,
    };
    camera.camera_from_lps = camera.camera_from_lps * axes.rotation_from_lps();
    camera.intrinsics = camera.intrinsics.or(known.intrinsics);
    camera.size_px = camera.size_px.or(known.size_px);
    camera.pitch_mm = camera.pitch_mm.or(known.pitch_mm);
    Ok(camera)
}

/// Writes a camera.
///
/// # Errors
/// When the format needs K, size or pitch and the camera has none, or cannot express it.
pub fn write(format: Format, camera: &ExchangedCamera, axes: PatientAxes) -> Result<String, FormatError> {
    let mut camera = camera.clone();
    camera.camera_from_lps = camera.camera_from_lps * axes.rotation_from_lps();
    match format {
        Format::Matrix => matrix::write_projection(&camera),
        Format::Kr => matrix::write_kr(&camera),
        Format::KrJson => matrix::write_kr_json(&camera),
        Format::OpenCv => opencv::write(&camera),
        Format::Rtk => rtk::write(&camera),
        Format::DeepDrr => deepdrr::write(&camera),
        Format::Xreg(frame) => xreg::write(&camera, frame),
        Format::Slicer => Ok(slicer::write(&camera)),
    }
}
