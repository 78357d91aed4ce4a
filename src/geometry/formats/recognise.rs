//! Which format a text is in.

use serde_json::Value;

use super::numbers::rows;
use super::{Format, XregFrame};
use crate::table::unmarked;

/// The format of a text by its content; by its name's ending where the content alone does not tell.
#[must_use]
pub fn recognise(text: &str, name: &str) -> Option<Format> {
    let text = unmarked(text);
    let head: String = text.chars().take(4096).collect();
    let name = name.to_lowercase();
    if head.trim_start().starts_with("#Insight Transform File") {
        return Some(Format::Slicer);
    }
    if head.contains("<RTKThreeDCircularGeometry") || head.contains("<!DOCTYPE RTKGEOMETRY") {
        return Some(Format::Rtk);
    }
    if head.trim_start().starts_with("%YAML") || head.contains("!!opencv-matrix") {
        return Some(Format::OpenCv);
    }
    if head.trim_start().starts_with('{') {
        return by_keys(text);
    }
    let by_shape = if head.trim_start().starts_with('[') { Some(Format::Matrix) } else { by_rows(text) };
    by_shape.or_else(|| {
        let endings = [(".tfm", Format::Slicer), (".xml", Format::Rtk), (".yml", Format::OpenCv), (".yaml", Format::OpenCv)];
        endings.into_iter().find(|(ending, _)| name.ends_with(ending)).map(|(_, format)| format)
    })
}

fn by_keys(text: &str) -> Option<Format> {
    let Ok(Value::Object(map)) = serde_json::from_str::<Value>(text) else { return None };
    let has = |key: &str| map.contains_key(key);
    if has("cam-coord-frame-type") {
        Some(Format::Xreg(XregFrame::DetectorPositiveZ))
    } else if has("intrinsic") && has("extrinsic") {
        Some(Format::DeepDrr)
    } else if (has("K") || has("intrinsics")) && ["R", "Rt", "extrinsics"].into_iter().any(has) {
        Some(Format::KrJson)
    } else {
        None
    }
}

fn by_rows(text: &str) -> Option<Format> {
    let lengths: Vec<usize> = rows(text, "").ok()?.iter().map(Vec::len).collect();
    match lengths[..] {
        [4, 4, 4] => Some(Format::Matrix),
        [3, 3, 3, 4, 4, 4] | [3, 3, 3, 4, 4, 4, 4] => Some(Format::Kr),
        _ => None,
    }
}
