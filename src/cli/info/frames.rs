//! Acquired frames.

use std::path::Path;

use serde_json::{Map, Value, json};

use super::described;
use super::found::{Found, InfoError, object};
use crate::acquire::{Frame, read_frames};

/// Percentiles that are shown.
const PERCENTS: [f64; 7] = [0.0, 1.0, 5.0, 50.0, 95.0, 99.0, 100.0];

pub(super) fn examine(path: &Path) -> Result<Found, InfoError> {
    let frames = read_frames(path, None)?;
    let pages = described::pages(path, frames.len());
    let images: Vec<Value> = frames.iter().enumerate().map(|(index, frame)| facts(frame, pages.get(index))).collect();
    Ok(("frame", object(json!({ "images": images })), Vec::new()))
}

/// Of a frame, and of what its page shows where that is told.
fn facts(frame: &Frame, page: Option<&String>) -> Value {
    let mut sorted: Vec<f32> = frame.pixels.pixels.iter().copied().filter(|value| value.is_finite()).collect();
    sorted.sort_by(f32::total_cmp);
    let at = |percent: f64| sorted[((sorted.len() - 1) as f64 * percent / 100.0).round() as usize];
    let percentiles: Map<String, Value> = PERCENTS.iter().map(|&percent| (format!("{percent}"), json!(at(percent)))).collect();
    let mut facts = Map::new();
    facts.extend(page.map(|page| ("page".to_owned(), Value::from(page.as_str()))));
    // Frames are counted in sessions only.
    let told = object(serde_json::to_value(frame).unwrap_or_default());
    facts.extend(told.into_iter().filter(|(key, _)| key != "number"));
    facts.insert("percentiles".into(), percentiles.into());
    Value::Object(facts)
}
