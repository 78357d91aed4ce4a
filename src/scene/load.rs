//! Scene file to scene: files found, values checked, materials and shapes resolved.

use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

use super::SceneError;
use super::file::{BeamEntry, DetectorEntry, ModelEntry, SceneFile, ViewEntry};
use super::model::{Beam, Detector, Formation, InputFile, Model, Noise, Scene};
use super::objects::Resolver;
use super::physics::{Material, Spectrum};
use crate::geometry::{CarmCalibration, CarmJoints, Projection, View};
use crate::image::sha256_bytes;
use crate::reporter::Reporter;

/// Loads a scene file.
///
/// # Errors
/// When the file, or one that it names, is missing, damaged or makes no sense; the message names file and key.
pub fn load(path: &Path, need_view: bool, reporter: &Reporter) -> Result<Scene, SceneError> {
    let text = std::fs::read_to_string(path).map_err(|source| SceneError::Io { path: path.to_owned(), source })?;
    load_text(&text, path, need_view, reporter)
}

/// Loads the scene `text`, whose files are looked for beside `path`.
///
/// # Errors
/// As [`load`].
pub fn load_text(text: &str, path: &Path, need_view: bool, reporter: &Reporter) -> Result<Scene, SceneError> {
    let file: SceneFile = parse_json(path, text)?;
    let inputs = vec![InputFile { path: path.display().to_string(), sha256: sha256_bytes(text.as_bytes()) }];
    let mut resolver = Resolver::new(path, reporter, inputs);
    for (index, entry) in file.objects.iter().enumerate() {
        resolver.object(index, entry)?;
    }
    let beam = beam(&file.beam, &mut resolver)?;
    let detector = detector(&file.detector)?;
    let model = model(&file.model)?;
    let view = match &file.view {
        Some(entry) => Some(view(entry, &mut resolver)?),
        None if need_view => return Err(SceneError::NoView { path: path.to_owned() }),
        None => None,
    };
    if model.formation == Formation::Naive && model.noise != Noise::Off {
        let expected = "false with formation \"naive\" (Eq. 8 has no noise)".to_owned();
        return Err(SceneError::Value { place: "model.noise".to_owned(), found: "on".to_owned(), expected });
    }
    let (materials, objects, inputs, robot) = resolver.finish();
    Ok(Scene { materials, objects, view, beam, detector, model, inputs, robot })
}

/// Parses JSON; the error names the file and the key.
pub(super) fn parse_json<T: DeserializeOwned>(path: &Path, text: &str) -> Result<T, SceneError> {
    let wrong = |place: String, detail: String| SceneError::Json { path: path.to_owned(), place, detail };
    let mut deserializer = serde_json::Deserializer::from_str(text);
    let value = serde_path_to_error::deserialize(&mut deserializer)
        .map_err(|error| wrong(error.path().to_string(), error.inner().to_string()))?;
    deserializer.end().map_err(|error| wrong("the end".to_owned(), error.to_string()))?;
    Ok(value)
}

/// Fails unless `value` is finite and in `range`.
pub(super) fn in_range(place: &str, value: f64, range: std::ops::RangeInclusive<f64>) -> Result<f64, SceneError> {
    if range.contains(&value) {
        return Ok(value);
    }
    let expected = format!("a number from {} to {}", range.start(), range.end());
    Err(SceneError::Value { place: place.to_owned(), found: value.to_string(), expected })
}

fn unavailable(keys: &[(&str, bool)]) -> Result<(), SceneError> {
    match keys.iter().find(|(_, present)| *present) {
        Some((place, _)) => Err(SceneError::NotAvailable { place: (*place).to_owned() }),
        None => Ok(()),
    }
}

fn beam(entry: &BeamEntry, resolver: &mut Resolver) -> Result<Beam, SceneError> {
    unavailable(&[
        ("beam.bowtie", entry.bowtie.is_some()),
        ("beam.heel", entry.heel.is_some()),
        ("beam.focal_spot_mm", entry.focal_spot_mm.is_some()),
        ("beam.field", entry.field.is_some()),
    ])?;
    let physics = |place: &str| {
        let place = place.to_owned();
        move |source| SceneError::Physics { place, source }
    };
    let mut filtration = Vec::new();
    for (name, thickness_mm) in &entry.filtration_mm {
        let place = format!("beam.filtration_mm.{name}");
        filtration.push((Material::parse(name).map_err(physics(&place))?, *thickness_mm));
    }
    let spectrum = match (entry.tube_kvp, entry.mono_kev, &entry.spectrum_csv) {
        (Some(kvp), None, None) => {
            Spectrum::tungsten(kvp, entry.anode_angle_deg.unwrap_or(12.0), &filtration).map_err(physics("beam"))?
        }
        (None, Some(energy_kev), None) => Spectrum::mono(energy_kev).map_err(physics("beam.mono_kev"))?,
        (None, None, Some(named)) => {
            let path = resolver.locate("beam.spectrum_csv", named)?;
            let spectrum = Spectrum::from_csv(&path).map_err(physics("beam.spectrum_csv"))?;
            let behind = spectrum.filtered(&filtration).and_then(|spectrum| spectrum.normalised());
            behind.map_err(physics("beam.filtration_mm"))?
        }
        _ => {
            let found = "none or several of tube_kvp, mono_kev and spectrum_csv".to_owned();
            return Err(SceneError::Value { place: "beam".to_owned(), found, expected: "exactly one of them".to_owned() });
        }
    };
    let photons_per_pixel = in_range("beam.photons_per_pixel", entry.photons_per_pixel, 1e-6..=1e12)?;
    Ok(Beam { spectrum, photons_per_pixel })
}

fn detector(entry: &DetectorEntry) -> Result<Detector, SceneError> {
    unavailable(&[
        ("detector.scintillator", entry.scintillator.is_some()),
        ("detector.blur_fwhm_mm", entry.blur_fwhm_mm.is_some()),
        ("detector.bits", entry.bits.is_some()),
        ("detector.saturation", entry.saturation.is_some()),
        ("detector.grid", entry.grid.is_some()),
        ("detector.intensifier", entry.intensifier.is_some()),
    ])?;
    let pitch_mm = in_range("detector.pitch_mm", entry.pitch_mm, 1e-4..=100.0)?;
    let crosstalk = entry.crosstalk.clone().unwrap_or_else(|| vec![vec![1.0]]);
    let side = crosstalk.len();
    let sum: f64 = crosstalk.iter().flatten().sum();
    if side % 2 == 0 || crosstalk.iter().any(|row| row.len() != side) || !((sum - 1.0).abs() < 1e-6) {
        let found = format!("{side} rows with the sum {sum}");
        let expected = "an odd square of numbers with the sum 1".to_owned();
        return Err(SceneError::Value { place: "detector.crosstalk".to_owned(), found, expected });
    }
    if let Some(noise) = &entry.readout_noise {
        in_range("detector.readout_noise.sigma", noise.sigma, 0.0..=1e6)?;
        in_range("detector.readout_noise.row_correlation", noise.row_correlation, 0.0..=0.999_999)?;
    }
    let gain = in_range("detector.gain", entry.gain, 1e-30..=1e30)?;
    let offset = in_range("detector.offset", entry.offset, -1e30..=1e30)?;
    Ok(Detector { response: entry.response, pitch_mm, crosstalk, readout_noise: entry.readout_noise, gain, offset })
}

fn model(entry: &ModelEntry) -> Result<Model, SceneError> {
    match entry.scatter.as_str() {
        "off" => {}
        "network" | "monte_carlo" => {
            return Err(SceneError::NotAvailable { place: format!("model.scatter \"{}\"", entry.scatter) });
        }
        other => {
            let expected = "\"off\"".to_owned();
            return Err(SceneError::Value { place: "model.scatter".to_owned(), found: format!("\"{other}\""), expected });
        }
    }
    let noise = match &entry.noise {
        serde_json::Value::Bool(false) => Noise::Off,
        serde_json::Value::Bool(true) => Noise::True,
        serde_json::Value::String(word) if word == "paper" => Noise::Paper,
        other => {
            let expected = "false, true or \"paper\"".to_owned();
            return Err(SceneError::Value { place: "model.noise".to_owned(), found: other.to_string(), expected });
        }
    };
    Ok(Model { formation: entry.formation, noise, seed: entry.seed })
}

fn view(entry: &ViewEntry, resolver: &mut Resolver) -> Result<View, SceneError> {
    let wrong = |found: &str, expected: &str| SceneError::Value {
        place: "view".to_owned(),
        found: found.to_owned(),
        expected: expected.to_owned(),
    };
    let camera = |source| SceneError::Camera { place: "view".to_owned(), source };
    let no_size = || wrong("without size_px", "size_px: [columns, rows]");
    let found = match (&entry.projection, &entry.carm, entry.intrinsics, entry.camera_from_lps) {
        (None, None, Some(intrinsics), Some(camera_from_lps)) => {
            View { size_px: entry.size_px.ok_or_else(no_size)?, intrinsics, camera_from_lps }
        }
        (Some(rows), None, None, None) => {
            let (intrinsics, camera_from_lps) = Projection(*rows).decompose().map_err(camera)?;
            View { size_px: entry.size_px.ok_or_else(no_size)?, intrinsics, camera_from_lps }
        }
        (None, Some(joints), None, None) => {
            let named =
                entry.calibration.as_ref().ok_or_else(|| wrong("carm without calibration", "a file of calibration/carm/"))?;
            let (path, text) = resolver.text("view.calibration", named)?;
            let calibration: CarmCalibration = parse_json(&path, &text)?;
            let world_from_lps = entry.world_from_lps.ok_or_else(|| wrong("carm without world_from_lps", "a 4x4 transform"))?;
            // Joints that the scene leaves out stand at zero; the distance comes from the calibration.
            let zeroed: [f64; 7] = joints.to_array().map(|value| if value.is_finite() { value } else { 0.0 });
            let mut joints = CarmJoints { source_to_detector_mm: joints.source_to_detector_mm, ..CarmJoints::from_array(zeroed) };
            if !joints.source_to_detector_mm.is_finite() {
                joints.source_to_detector_mm = f64::NAN;
            }
            let carm = |source| SceneError::Carm { place: "view.carm".to_owned(), source };
            let world_from_camera = calibration.world_from_camera(&joints).map_err(carm)?;
            let intrinsics = calibration.intrinsics(&joints).map_err(carm)?;
            let size_px = entry.size_px.unwrap_or([calibration.columns_px, calibration.rows_px]);
            View { size_px, intrinsics, camera_from_lps: world_from_camera.inverse() * world_from_lps }
        }
        _ => {
            let expected = "either intrinsics and camera_from_lps, or projection, or carm with calibration and world_from_lps";
            return Err(wrong("incomplete or contradictory", expected));
        }
    };
    let [width, height] = found.size_px;
    if width == 0 || height == 0 || width > 32_768 || height > 32_768 {
        let expected = "1 to 32768 columns and rows".to_owned();
        return Err(SceneError::Value { place: "view.size_px".to_owned(), found: format!("{width}x{height}"), expected });
    }
    Ok(found)
}

/// Finds a file beside the scene, else in the current folder.
pub(super) fn locate(scene: &Path, place: &str, named: &Path) -> Result<PathBuf, SceneError> {
    let beside = scene.parent().unwrap_or(Path::new(".")).join(named);
    [beside, named.to_owned()].into_iter().find(|path| path.exists()).ok_or_else(|| SceneError::Missing {
        scene: scene.to_owned(),
        place: place.to_owned(),
        named: named.display().to_string(),
    })
}
