//! Text files: markups and this program's own JSON.

use std::path::Path;

use glam::DVec3;
use serde_json::{Map, Value, json};

use super::cameras;
use super::found::{Found, InfoError, object};
use super::kinds::{COUNTED, recognise, shown};
use crate::beads::parse_markups;
use crate::pose::{extents_mm, span_mm};
use crate::regular;
use crate::table::{cells_of, unmarked};

pub(super) fn examine(path: &Path, name: &str) -> Result<Found, InfoError> {
    let text = regular::read_text(path).map_err(|source| InfoError::Io { path: path.to_owned(), source })?;
    let text = unmarked(&text);
    if name.ends_with(".fcsv") {
        return Ok(("markups", with_doubts(path, text, fcsv(path, text)?), Vec::new()));
    }
    let json: Value = serde_json::from_str(text).map_err(|error| InfoError::Damaged {
        path: path.to_owned(),
        kind: "JSON file",
        detail: error.to_string(),
    })?;
    let Value::Object(map) = json else {
        return Err(InfoError::Unknown { path: path.to_owned(), found: "JSON that is no object".into() });
    };
    // Before ours: one of theirs has the keys of our K, and more.
    if let Some(camera) = cameras::examine(path, text)? {
        return Ok(camera);
    }
    match recognise(&map) {
        Some("markups") => Ok(("markups", with_doubts(path, text, markups(path, &map)?), Vec::new())),
        Some(kind) => Ok((kind, facts(kind, &map), Vec::new())),
        None => {
            let keys = map.keys().take(8).cloned().collect::<Vec<_>>().join(", ");
            Err(InfoError::Unknown { path: path.to_owned(), found: format!("JSON with the keys {keys}") })
        }
    }
}

fn facts(kind: &str, map: &Map<String, Value>) -> Map<String, Value> {
    let pick = |keys: &[&str]| -> Map<String, Value> {
        keys.iter().filter_map(|&key| Some((key.to_owned(), map.get(key)?.clone()))).collect()
    };
    let mut facts = match kind {
        "scene" => {
            let kinds: Vec<Value> = map
                .get("objects")
                .and_then(Value::as_array)
                .map(|objects| {
                    objects.iter().filter_map(|object| object.as_object()?.keys().next().cloned().map(Value::from)).collect()
                })
                .unwrap_or_default();
            let mut facts = object(json!({"objects": kinds.len(), "object_kinds": kinds, "has_view": map.contains_key("view")}));
            facts.extend(pick(&["beam", "detector", "model"]));
            facts
        }
        "pose" => {
            let mut facts =
                pick(&["status", "reason", "size_px", "rms_px", "rms_mm", "projection", "intrinsics", "camera_from_lps"]);
            let used = |bead: &&Value| bead.get("used").and_then(Value::as_bool) == Some(true);
            if let Some(beads) = map.get("beads").and_then(Value::as_array) {
                facts.insert("beads".into(), json!({"listed": beads.len(), "used": beads.iter().filter(used).count()}));
            }
            facts
        }
        "adapter" => adapter(map),
        "session" | "intrinsics" | "prior" | "console" => map.clone(),
        _ => {
            let mut facts = pick(shown(kind));
            for key in COUNTED {
                if let (Some(Value::Array(list)), false) = (map.get(key), facts.contains_key(key)) {
                    facts.insert(key.to_owned(), list.len().into());
                }
            }
            facts
        }
    };
    if kind == "calibration" {
        facts.insert("keys".into(), map.keys().cloned().collect::<Vec<_>>().into());
    }
    facts.insert("format".into(), "JSON".into());
    facts
}

/// Of a device's lines: of what form they are, whose time they have, and what of a device they tell.
fn adapter(map: &Map<String, Value>) -> Map<String, Value> {
    let keys = |key: &str| -> Option<Vec<String>> { Some(map.get(key)?.as_object()?.keys().cloned().collect()) };
    object(json!({
        "origin": map.get("origin"),
        "lines": keys("format").and_then(|forms| forms.into_iter().next()),
        "time": if map.contains_key("device_time") { "of the device's clock" } else { "of arrival" },
        "carm": keys("carm"),
        "robot": keys("robot"),
    }))
}

/// `facts` of a list of points, how far those that are beads reach, and what their descriptions probably mean and do not say.
fn with_doubts(path: &Path, text: &str, mut facts: Map<String, Value>) -> Map<String, Value> {
    // Points that are no beads have no doubts either.
    let Ok(layout) = parse_markups(path, text.as_bytes()) else { return facts };
    let places: Vec<DVec3> = layout.beads.iter().map(|bead| bead.lps_mm).collect();
    let (count, span_mm, extents_mm) = (places.len(), readable(span_mm(&places)), extents_mm(&places).map(readable));
    let [first, second, third] = extents_mm;
    let extent = format!(
        "{count} beads, {span_mm} mm between the two farthest; {first} x {second} x {third} mm (standard deviations) along the principal axes"
    );
    facts.extend(object(json!({"beads": count, "span_mm": span_mm, "extents_mm": extents_mm, "extent": extent})));
    if !layout.doubts.is_empty() {
        facts.insert("doubts".into(), layout.doubts.into());
    }
    facts
}

/// A length in mm without the digits that nobody measured.
fn readable(mm: f64) -> f64 {
    (1e3 * mm).round() / 1e3
}

fn markups(path: &Path, map: &Map<String, Value>) -> Result<Map<String, Value>, InfoError> {
    let damaged = |detail: &str| InfoError::Damaged { path: path.to_owned(), kind: "markups file", detail: detail.into() };
    let lists = map.get("markups").and_then(Value::as_array).ok_or_else(|| damaged("`markups` is no list"))?;
    let mut listed = Vec::new();
    for (index, list) in lists.iter().enumerate() {
        let points = list
            .get("controlPoints")
            .and_then(Value::as_array)
            .ok_or_else(|| damaged(&format!("markups[{index}] has no controlPoints")))?;
        let names: Vec<&str> = points.iter().map(|point| point.get("label").and_then(Value::as_str).unwrap_or("?")).collect();
        listed.push(json!({
            "type": list.get("type"),
            "coordinate_system": list.get("coordinateSystem"),
            "units": list.get("coordinateUnits"),
            "points": points.len(),
            "names": names,
        }));
    }
    Ok(object(json!({"format": "3D Slicer markups", "lists": listed})))
}

fn fcsv(path: &Path, text: &str) -> Result<Map<String, Value>, InfoError> {
    let header = |key: &str| {
        text.lines().find_map(|line| {
            let (name, value) = line.strip_prefix('#')?.split_once('=')?;
            (name.trim() == key).then(|| value.trim().to_owned())
        })
    };
    let columns: Vec<String> = header("columns").unwrap_or_default().split(',').map(|column| column.trim().to_owned()).collect();
    let label = columns.iter().position(|column| column == "label").unwrap_or(11);
    let mut names = Vec::new();
    for (index, line) in text.lines().enumerate().filter(|(_, line)| !line.starts_with('#') && !line.trim().is_empty()) {
        let cells = cells_of(line);
        if !(1..4).all(|at| cells.get(at).is_some_and(|cell| cell.parse::<f64>().is_ok())) {
            let detail = format!("line {} has no position in its second to fourth column", index + 1);
            return Err(InfoError::Damaged { path: path.to_owned(), kind: "fcsv file", detail });
        }
        names.push(cells.get(label).unwrap_or("?").to_owned());
    }
    Ok(object(json!({
        "format": "3D Slicer fcsv",
        "coordinate_system": header("CoordinateSystem"),
        "points": names.len(),
        "names": names,
    })))
}
