//! Cameras in the words of other programs, as `sidecarm pose convert` writes and reads them.

use std::path::Path;

use serde_json::json;

use super::found::{Found, InfoError, object};
use crate::geometry::formats::{self, Format, FormatError, Known};
use crate::table::unmarked;

/// Where a format leaves the panel to its reader: of a camera with this one, only the pose is that of the file.
const ANY_PANEL: Known = Known { intrinsics: None, size_px: Some([1, 1]), pitch_mm: Some([1.0, 1.0]) };

/// The camera that `text` is, by its content; `None` where it is none.
pub(super) fn examine(path: &Path, text: &str) -> Result<Option<Found>, InfoError> {
    let text = unmarked(text);
    let Some(format) = formats::recognise(text, "").map(|format| named(format, text)) else { return Ok(None) };
    let read = |known: &Known| formats::read(format, text, format.usual_axes(), known);
    let (camera, is_whole) = match read(&Known::default()) {
        Err(FormatError::Needs { .. }) => (read(&ANY_PANEL), false),
        other => (other, true),
    };
    let camera = match camera {
        Ok(camera) => camera,
        // Any list begins as a matrix does.
        Err(_) if text.trim_start().starts_with('[') => return Ok(None),
        Err(error) => {
            let detail = error.to_string();
            return Err(InfoError::Damaged { path: path.to_owned(), kind: "camera of another program", detail });
        }
    };
    let facts = json!({
        "format": format.name(),
        "convention": format.convention(),
        "lacks": format.loses(),
        "size_px": camera.size_px.filter(|_| is_whole),
        "pitch_mm": camera.pitch_mm.filter(|_| is_whole),
        "intrinsics": camera.intrinsics.filter(|_| is_whole),
        "camera_from_lps": camera.camera_from_lps,
        "notes": camera.notes,
    });
    Ok(Some(("camera", object(facts), Vec::new())))
}

/// xReg's formats differ in the frame that the file names.
fn named(format: Format, text: &str) -> Format {
    let is_named = |other: &Format| matches!(other, Format::Xreg(frame) if text.contains(frame.name()));
    match format {
        Format::Xreg(_) => Format::ALL.into_iter().find(is_named).unwrap_or(format),
        other => other,
    }
}
