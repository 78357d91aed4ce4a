//! What this program has written beside its images and maps of dose, `FILE.json`, about them.

use std::path::Path;

use serde_json::{Map, Value};

use super::kinds::recognise;
use crate::image::beside;
use crate::json::parse_json;
use crate::regular;

/// Of the standard errors beside a map of dose, `DOSE.nii.gz.error.nii.gz`; they share its description.
const OF_ERRORS: &str = ".error.nii.gz";

/// The description of `path`.
fn description(path: &Path) -> Option<Map<String, Value>> {
    let text = regular::read_small_text(&beside(path, "json")).ok()?;
    let Ok(Value::Object(map)) = parse_json::<Value>(text.as_bytes()) else { return None };
    (recognise(&map) == Some("image_description")).then_some(map)
}

/// What each of the `count` images of the file at `path` shows, of one that has several; empty where that is not told of each.
pub(super) fn pages(path: &Path, count: usize) -> Vec<String> {
    let named = || serde_json::from_value::<Vec<String>>(description(path)?.get("pages")?.clone()).ok();
    if count > 1 { named().filter(|names| names.len() == count).unwrap_or_default() } else { Vec::new() }
}

/// What a volume of `size` is that `scatter --dose` has written; `None` of any other.
pub(super) fn dose(path: &Path, size: [usize; 3]) -> Option<&'static str> {
    let (map, quantity) = match path.to_str().and_then(|name| name.strip_suffix(OF_ERRORS)) {
        Some(dose) => (Path::new(dose), "standard error of the dose"),
        None => (path, "dose"),
    };
    let told = description(map)?;
    let is_dose = told.get("quantity")? == "dose" && told.get("unit")? == "Gy";
    let sizes: [usize; 3] = serde_json::from_value(told.get("size")?.clone()).ok()?;
    (is_dose && sizes == size).then_some(quantity)
}
