//! `IMAGE.tif` with `IMAGE.tif.json` beside it, `IMAGE.tif.valid.png` when some pixel is invalid, and `IMAGE.tif.guessed.png` when a body of
//! the specimen has moved.

use std::path::{Path, PathBuf};

use super::guessed::guessed_share;
use super::{Quantity, RenderError, Rendered};
use crate::image::{Image, ImageFileError, Lasting, beside, write_lasting, write_png_rgb, write_tiff_f32_lasting};
use crate::scene::model::Scene;

/// Writes the pages as 32-bit float TIFF, and beside them what they are and where they come from.
///
/// # Errors
/// When a file cannot be written.
pub fn write_image(path: &Path, rendered: &Rendered, scene: &Scene) -> Result<(), RenderError> {
    write_described(path, rendered, description(rendered, scene), Lasting::AtOnce)
}

/// The same without anything that differs from run to run: how long it took, and how long this machine was expected to take. A session writes one
/// for each frame, which waits for no disk.
///
/// # Errors
/// As [`write_image`].
pub fn write_image_without_times(path: &Path, rendered: &Rendered, scene: &Scene) -> Result<(), RenderError> {
    let mut json = description(rendered, scene);
    take_times_out(&mut json);
    write_described(path, rendered, json, Lasting::Later)
}

/// Costs by which times are predicted are measured anew now and then, and by every machine.
fn take_times_out(description: &mut serde_json::Value) {
    let of: [(&str, &[&str]); 3] =
        [("", &["stages_ms", "gpu_ms"]), ("/predicted", &["ms"]), ("/plan", &["predicted_ms", "typical_ms"])];
    for (place, keys) in of {
        if let Some(map) = description.pointer_mut(place).and_then(serde_json::Value::as_object_mut) {
            map.retain(|key, _| !keys.contains(&key.as_str()));
        }
    }
}

fn write_described(path: &Path, rendered: &Rendered, json: serde_json::Value, lasting: Lasting) -> Result<(), RenderError> {
    let [_, json_path, mask_path, guessed_path] = written_with(path);
    let invalid = rendered.valid.pixels.iter().filter(|valid| **valid == 0).count();
    write_tiff_f32_lasting(path, lasting, &rendered.pages)?;
    let white = |flags: &Image<u8>| flags.map(|flag| [if *flag == 1 { 255 } else { 0 }; 3]);
    for (path, flags) in [(mask_path, (invalid > 0).then_some(&rendered.valid)), (guessed_path, rendered.guessed.as_ref())] {
        match flags {
            Some(flags) => write_png_rgb(&path, &white(flags))?,
            // That of an earlier image of this name.
            None if path.is_file() => remove(&path)?,
            None => {}
        }
    }
    let text = serde_json::to_string_pretty(&json).expect("plain data");
    write_lasting(&json_path, lasting, |file| file.write_all(text.as_bytes()))?;
    Ok(())
}

fn remove(path: &Path) -> Result<(), ImageFileError> {
    std::fs::remove_file(path).map_err(|source| ImageFileError::Io { path: path.to_owned(), source })
}

/// The files that [`write_image`] may write: the image, what it is, which pixels are valid, and which show a guess.
#[must_use]
pub fn written_with(path: &Path) -> [PathBuf; 4] {
    [path.to_owned(), beside(path, "json"), beside(path, "valid.png"), beside(path, "guessed.png")]
}

fn description(rendered: &Rendered, scene: &Scene) -> serde_json::Value {
    let invalid = rendered.valid.pixels.iter().filter(|valid| **valid == 0).count();
    let share_invalid = invalid as f64 / rendered.valid.pixels.len().max(1) as f64;
    let unit = match rendered.quantity {
        Quantity::Intensity => "1 (unattenuated signal)",
        Quantity::LineIntegral => "neper",
        Quantity::AreaDensity => "g/cm2",
        Quantity::Counts => match scene.detector.response {
            crate::scene::model::Response::Energy => "keV times gain, plus offset",
            crate::scene::model::Response::Counting => "photons times gain, plus offset",
        },
    };
    let pages: Vec<&str> = match rendered.quantity {
        Quantity::AreaDensity => scene.materials.iter().map(|material| material.name.as_str()).collect(),
        _ => vec![rendered.quantity.name()],
    };
    let mut json = serde_json::json!({
        "quantity": rendered.quantity,
        "unit": unit,
        "pages": pages,
        "size_px": [rendered.valid.width, rendered.valid.height],
        "stated_error": rendered.stated_error,
        "predicted": {"error": rendered.stated_error, "ms": rendered.plan["predicted_ms"]},
        "share_invalid": share_invalid,
        "notes": rendered.notes,
        "stages_ms": rendered.stages,
        "gpu_ms": rendered.gpu_ms,
        "read_back_bytes": rendered.read_back_bytes,
        "plan": rendered.plan,
        "inputs": scene.inputs,
        "version": env!("CARGO_PKG_VERSION"),
        "adapter": rendered.adapter,
    });
    if let (Some(view), Some(map)) = (&scene.view, json.as_object_mut()) {
        let camera = serde_json::json!({
            "size_px": view.size_px, "intrinsics": view.intrinsics, "camera_from_lps": view.camera_from_lps
        });
        map.insert("view".to_owned(), camera);
    }
    if let (Some(scatter), Some(map)) = (&rendered.scatter, json.as_object_mut()) {
        map.insert("scatter".to_owned(), serde_json::json!(scatter));
    }
    if let (Some((plan, achieved)), Some(map)) = (&rendered.achieved, json.as_object_mut()) {
        let predicted = serde_json::json!({"error": plan.stated_error, "ms": plan.predicted_ms});
        map.insert("fast".to_owned(), serde_json::json!({"plan": plan, "predicted": predicted, "achieved": achieved}));
    }
    if let (Some(guessed), Some(map)) = (&rendered.guessed, json.as_object_mut()) {
        map.insert("share_guessed".to_owned(), serde_json::json!(guessed_share(guessed)));
    }
    if let (Some(counts), Some(map)) = (&rendered.non_finite, json.as_object_mut()) {
        map.insert("non_finite".to_owned(), serde_json::json!(counts));
    }
    json
}

/// An 8-bit picture for eyes: the 0.5th to 99.5th percentile of the first page from black to white.
///
/// # Errors
/// When the file cannot be written.
pub fn write_picture(path: &Path, rendered: &Rendered) -> Result<(), ImageFileError> {
    let page = rendered.pages.first().cloned().unwrap_or(Image { width: 0, height: 0, pixels: Vec::new() });
    let mut sorted: Vec<f32> = page.pixels.iter().copied().filter(|value| value.is_finite()).collect();
    sorted.sort_unstable_by(f32::total_cmp);
    let at = |share: f64| sorted.get(((sorted.len().saturating_sub(1)) as f64 * share) as usize).copied().unwrap_or(0.0);
    let (low, high) = (at(0.005), at(0.995));
    let scale = if high > low { 255.0 / (high - low) } else { 0.0 };
    write_png_rgb(path, &page.map(|value| [((value - low) * scale).clamp(0.0, 255.0) as u8; 3]))
}

#[cfg(test)]
mod tests {
    use super::super::plan::{Executor, Plan};
    use super::*;
    use crate::reporter::Reporter;
    use crate::scene::load_text;
    use crate::time::StageTimes;
    use serde_json::Value;

    /// Keys that name milliseconds, wherever they stand.
    fn times(value: &Value) -> Vec<String> {
        match value {
            Value::Object(map) => {
                let own = map.keys().filter(|key| *key == "ms" || key.ends_with("_ms")).cloned();
                own.chain(map.values().flat_map(times)).collect()
            }
            Value::Array(list) => list.iter().flat_map(times).collect(),
            _ => Vec::new(),
        }
    }

    /// Plans of a killed log are made anew, with costs measured on another day: two replays differed in them.
    #[test]
    fn what_a_session_writes_beside_a_drr_holds_no_times() {
        let scene = r#"{
            "objects": [{"sphere": {"centre_lps_mm": [0, 0, 0], "radius_mm": 5, "material": "water"}}],
            "beam": {"mono_kev": 60}, "detector": {"pitch_mm": 0.2}
        }"#;
        let scene = load_text(scene, Path::new("scene.json"), false, &Reporter::silent()).expect("a scene");
        let quantity = Quantity::LineIntegral;
        let plan = Plan::new(&scene, [2, 2], quantity, Executor::Cpu, 1, None);
        let plan = Plan { predicted_ms: Some(3.5), typical_ms: Some(4.5), ..plan };
        let mut stages = StageTimes::default();
        stages.add("cast", 5.0);
        let rendered = Rendered {
            pages: vec![Image::filled(2, 2, 0.0)],
            quantity,
            valid: Image::filled(2, 2, 1),
            guessed: None,
            plan: serde_json::to_value(&plan).expect("plain data"),
            adapter: "cpu".to_owned(),
            stages,
            gpu_ms: StageTimes::default(),
            read_back_bytes: 0,
            stated_error: 1e-5,
            notes: Vec::new(),
            scatter: None,
            non_finite: None,
            achieved: None,
            made: Default::default(),
        };
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("001.tif");
        let read = || -> Value { serde_json::from_slice(&std::fs::read(beside(&path, "json")).expect("written")).expect("JSON") };
        write_image(&path, &rendered, &scene).expect("written");
        let told = read();
        assert_eq!(times(&told), ["stages_ms", "gpu_ms", "ms", "predicted_ms", "typical_ms"], "the control");
        write_image_without_times(&path, &rendered, &scene).expect("written");
        let apart = read();
        assert_eq!(times(&apart), Vec::<String>::new());
        assert_eq!(apart["predicted"], serde_json::json!({"error": 1e-5}));
        let all_but_times = |plan: &Value| {
            let mut plan = plan.clone();
            plan.as_object_mut().expect("a map").retain(|key, _| !key.ends_with("_ms"));
            plan
        };
        assert_eq!(apart["plan"], all_but_times(&told["plan"]), "nothing else is left out");
    }
}
