//! Acquired frames.

use std::path::Path;

use serde_json::{Value, json};

use super::found::{Found, InfoError, object};
use crate::acquire::{Frame, read_frames};

/// Percentiles that are shown.
const PERCENTS: [f64; 7] = [0.0, 1.0, 5.0, 50.0, 95.0, 99.0, 100.0];

pub(super) fn examine(path: &Path) -> Result<Found, InfoError> {
    let images: Vec<Value> = read_frames(path, None)?.iter().map(facts).collect();
    Ok(("frame", object(json!({ "images": images })), Vec::new()))
}

fn facts(frame: &Frame) -> Value {
    let mut sorted: Vec<f32> = frame.pixels.pixels.iter().copied().filter(|value| value.is_finite()).collect();
    sorted.sort_by(f32::total_cmp);
    let at = |percent: f64| sorted[((sorted.len() - 1) as f64 * percent / 100.0).round() as usize];
    let percentiles: serde_json::Map<String, Value> =
        PERCENTS.iter().map(|&percent| (format!("{percent}"), json!(at(percent)))).collect();
    let mut facts = object(serde_json::to_value(frame).unwrap_or_default());
    facts.insert("percentiles".into(), percentiles.into());
    Value::Object(facts)
}
