//! Which of this program's JSON files a file is, by the keys that only its kind has.

use serde_json::{Map, Value};

/// Kinds in the order in which they are tried: a file is of the first whose keys it all has.
const KINDS: [(&str, &[&str]); 23] = [
    ("markups", &["markups"]),
    ("scene", &["objects"]),
    ("pairs", &["pairs"]),
    ("truth", &["frames", "landmarks", "air_value"]),
    ("poses", &["status", "views"]),
    ("pose", &["status", "projection"]),
    ("pose", &["status", "reason"]),
    ("pose", &["status", "beads"]),
    ("image_description", &["quantity", "pages"]),
    ("comparison", &["acquired", "simulated", "comparison"]),
    ("trade", &["judged_rays", "rows"]),
    ("layout_score", &["extents_mm", "flatness", "views"]),
    ("phantom_report", &["beads", "shots", "scale"]),
    ("attachment", &["exposures", "frames_in_log", "frames"]),
    ("tags", &["family", "tags"]),
    ("correspondences", &["correspondences"]),
    ("network", &["weights_sha256"]),
    ("scatter_checkpoint", &["tally", "histories_per_batch"]),
    ("calibration_report", &["shots", "left_out", "chi2_per_dof"]),
    ("prior", &["camera_from_lps"]),
    ("intrinsics", &["intrinsics"]),
    ("adapter", &["origin", "format"]),
    ("calibration", &["origin"]),
];

/// Keys of what a console does; none of them must be there.
const CONSOLE: [&str; 7] = ["rotation_deg", "flip", "crop_px", "binning", "zoom", "detector_from_image", "burned_in_px"];

/// The kind, if it is one of ours.
pub(super) fn recognise(map: &Map<String, Value>) -> Option<&'static str> {
    let known = || KINDS.iter().find(|(_, keys)| keys.iter().all(|key| map.contains_key(*key))).map(|(kind, _)| *kind);
    // A session names the folder of its frames; of other files `frames` is a list.
    match map.get("frames") {
        Some(Value::Object(source)) if source.contains_key("folder") => Some("session"),
        Some(Value::Array(frames)) => {
            let is_timed = frames.iter().all(|frame| frame.get("stages_ms").is_some());
            known().or((is_timed && map.len() == 1).then_some("timings"))
        }
        _ => known().or((!map.is_empty() && map.keys().all(|key| CONSOLE.contains(&key.as_str()))).then_some("console")),
    }
}

/// Keys whose values are shown as they are.
pub(super) fn shown(kind: &str) -> &'static [&'static str] {
    match kind {
        "image_description" => &["quantity", "unit", "pages", "size_px", "stated_error", "adapter", "version"],
        "comparison" => &["acquired", "simulated", "version"],
        "trade" => &["size_px", "adapter", "judged_rays", "judged"],
        "layout_score" => &["beads", "extents_mm", "flatness", "warnings", "notes"],
        "attachment" => &["exposures", "frames_in_log", "console", "losses"],
        "network" => &["weights_sha256", "training_seed", "training_epochs", "kept_epoch", "sample_count", "specimens"],
        "scatter_checkpoint" => &["version", "device", "seed", "grid_px", "histories_per_batch"],
        "phantom_report" => &["frame", "scale", "rms_px", "left_out_px", "beams_deg", "warnings", "version"],
        "calibration_report" => {
            &["origin", "held_out_piercing_mm", "held_out_ray_deg", "chi2_per_dof", "directions_deg", "parameters", "version"]
        }
        "truth" => &["landmarks", "world_from_lps"],
        "poses" => &["status", "reason", "frames", "intrinsics", "chi2_per_dof", "cautions"],
        "calibration" => &["origin"],
        "tags" => &["family"],
        _ => &[],
    }
}

/// Lists whose length alone is shown.
pub(super) const COUNTED: [&str; 10] =
    ["pairs", "frames", "views", "rows", "tags", "correspondences", "beads", "shots", "left_out", "landmarks"];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_kind_can_be_reached() {
        for (place, (kind, keys)) in KINDS.iter().enumerate() {
            let map: Map<String, Value> = keys.iter().map(|key| ((*key).to_owned(), Value::Array(Vec::new()))).collect();
            assert_eq!(recognise(&map), Some(*kind), "{place}: a kind before it has the same keys");
        }
    }
}
