//! From a scene file to a scene that renders.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::SceneError;
use super::beam;
use super::ct::LabelledCt;
use super::file::{ScatterFile, SceneFile};
use super::files::{Files, parse_json};
use super::model::{Bodies, Detector, Formation, InputFile, Model, Object, ScatterModel, Scene};
use super::objects;
use super::physics::Spectrum;
use super::view;
use crate::foreign::read_small;
use crate::image::sha256_bytes;
use crate::reporter::Reporter;

/// Source-to-detector distances outside this are mistakes (metres for millimetres, a focal length in mm).
const DISTANCE_MM: (f64, f64) = (1.0, 100_000.0);

/// Loads a scene file and everything that it names. Relative paths are looked up beside the scene file; `calibration/…` then in the current
/// folder, then among the files that come with the program.
///
/// With `need_view` the scene must say where it is seen from; session scenes leave that out.
///
/// # Errors
/// When a file is missing, damaged or holds what it should not: one sentence naming the file, the place and the remedy.
pub fn load(path: &Path, need_view: bool, reporter: &Reporter) -> Result<Scene, SceneError> {
    let bytes = read_small(path).map_err(|source| SceneError::Io { path: path.to_owned(), source })?;
    load_bytes(&bytes, path, &BTreeMap::new(), need_view, reporter)
}

/// Loads the scene `text`, whose files are looked for as if it had been read from `path`.
///
/// # Errors
/// As [`load`].
pub fn load_text(text: &str, path: &Path, need_view: bool, reporter: &Reporter) -> Result<Scene, SceneError> {
    load_bytes(text.as_bytes(), path, &BTreeMap::new(), need_view, reporter)
}

/// [`load_text`], with the files that the scene names at `places`, by name; those not in it are looked for as ever.
///
/// # Errors
/// As [`load`].
pub fn load_text_with(
    text: &str,
    path: &Path,
    places: &BTreeMap<String, PathBuf>,
    need_view: bool,
    reporter: &Reporter,
) -> Result<Scene, SceneError> {
    load_bytes(text.as_bytes(), path, places, need_view, reporter)
}

/// The CTs of the scene file at `path` whose materials are labels, and the files that were read for them.
///
/// # Errors
/// As [`load`].
pub fn load_labelled(path: &Path, reporter: &Reporter) -> Result<(Vec<LabelledCt>, Vec<InputFile>), SceneError> {
    let bytes = read_small(path).map_err(|source| SceneError::Io { path: path.to_owned(), source })?;
    let file: SceneFile = parse_json(path, &bytes)?;
    let mut files = Files::new(path, &BTreeMap::new());
    let mut scene = Scene::plain(Spectrum { bins: Vec::new() });
    let found = objects::labelled_cts(&file.objects, &mut scene, &mut files, reporter)?;
    Ok((found, files.into_inputs()))
}

/// The scene file at `path` and the files that it names, wherever they may lie: what no output may replace.
#[must_use]
pub fn input_files(path: &Path, scene: &Scene) -> Vec<PathBuf> {
    let folder = path.parent().map_or_else(PathBuf::new, Path::to_owned);
    let named = scene.inputs.iter().flat_map(|input| [folder.join(&input.path), PathBuf::from(&input.path)]);
    let parts = scene.inputs.iter().flat_map(|input| input.parts.iter().map(|part| part.path.clone()));
    std::iter::once(path.to_owned()).chain(named).chain(parts).collect()
}

fn load_bytes(
    bytes: &[u8],
    path: &Path,
    places: &BTreeMap<String, PathBuf>,
    need_view: bool,
    reporter: &Reporter,
) -> Result<Scene, SceneError> {
    let file: SceneFile = parse_json(path, bytes)?;
    let mut files = Files::new(path, places);
    files.remember(&path.display().to_string(), sha256_bytes(bytes), Some(path));

    let beam = beam::beam(&file.beam, &mut files, reporter)?;
    let mut detector = beam::detector(&file.detector, &mut files)?;
    let seen = file.view.as_ref().map(|view| view::resolve(view, &mut files)).transpose()?;
    let mut by_projection = false;
    let view = match seen {
        Some(seen) => {
            settle_pitch(&mut detector, seen.pitch_mm, &files)?;
            check_distance(seen.view.intrinsics.source_to_detector_mm(detector.pitch_mm), &files)?;
            by_projection = seen.by_projection;
            check_intensifier(&detector, seen.view.size_px, &files)?;
            if let Some(words) = view::swapped_size(&seen.view) {
                reporter.warn("size_px", words);
            }
            Some(seen.view)
        }
        None if need_view => {
            return Err(SceneError::Keys {
                place: files.place("view"),
                detail: "the scene does not say where it is seen from; add a view".to_owned(),
            });
        }
        None => {
            settle_pitch(&mut detector, None, &files)?;
            None
        }
    };
    let model = Model {
        formation: file.model.formation.unwrap_or(Formation::Deepdrr),
        voxels: file.model.voxels,
        scatter: scatter_model(&file),
        noise: file.model.noise.0,
        seed: file.model.seed.unwrap_or(1),
    };
    if let Some(words) = model.noise_left_out() {
        reporter.warn("noise", words);
    }
    let mut scene = Scene {
        materials: Vec::new(),
        objects: Vec::new(),
        view,
        beam,
        detector,
        model,
        inputs: Vec::new(),
        robot: None,
        bodies: Bodies::default(),
    };
    objects::build(&file.objects, &mut scene, &mut files, reporter)?;
    check_energies(&scene, &files)?;
    if by_projection {
        check_in_front(&scene, &files)?;
    }
    scene.inputs = files.into_inputs();
    Ok(scene)
}

/// Which scatter.
fn scatter_model(file: &SceneFile) -> ScatterModel {
    match file.model.scatter {
        ScatterFile::Off => ScatterModel::Off,
        ScatterFile::MonteCarlo => ScatterModel::MonteCarlo,
        ScatterFile::Network => ScatterModel::Network,
    }
}

/// The pitch from the scene or the C-arm's calibration; both only if they agree.
fn settle_pitch(detector: &mut Detector, calibrated_mm: Option<f64>, files: &Files) -> Result<(), SceneError> {
    let given_mm = detector.pitch_mm;
    match calibrated_mm {
        Some(calibrated_mm) if given_mm.is_nan() => detector.pitch_mm = calibrated_mm,
        Some(calibrated_mm) if !((given_mm / calibrated_mm - 1.0).abs() <= 1e-6) => {
            return Err(SceneError::Value {
                place: files.place("detector.pitch_mm"),
                found: given_mm.to_string(),
                expected: format!("{calibrated_mm} of the C-arm's calibration, or no pitch"),
            });
        }
        None if given_mm.is_nan() => {
            return Err(SceneError::Keys {
                place: files.place("detector"),
                detail: "pitch_mm is missing; with the focal length it says where the detector is".to_owned(),
            });
        }
        _ => {}
    }
    Ok(())
}

fn check_intensifier(detector: &Detector, size_px: [u32; 2], files: &Files) -> Result<(), SceneError> {
    let fits = detector.panel.intensifier.as_ref().map_or(Ok(()), |intensifier| intensifier.for_size(size_px).map(drop));
    fits.map_err(|source| SceneError::Intensifier { place: files.place("detector.intensifier"), source: Box::new(source) })
}

fn check_distance(distance_mm: f64, files: &Files) -> Result<(), SceneError> {
    let (low, high) = DISTANCE_MM;
    if !(distance_mm >= low && distance_mm <= high) {
        return Err(SceneError::Value {
            place: files.place("view and detector.pitch_mm"),
            found: format!("a source-to-detector distance (fx times pitch) of {distance_mm:.3e} mm"),
            expected: format!("{low} to {high} mm; is the focal length in px, the pitch in mm?"),
        });
    }
    Ok(())
}

/// The sign of P is chosen so that both focal lengths are positive. Where then everything lies behind the focal spot, one of them is
/// negative in the P given: the image is mirrored.
fn check_in_front(scene: &Scene, files: &Files) -> Result<(), SceneError> {
    let Some(view) = &scene.view else { return Ok(()) };
    let depth = |point: glam::DVec3| view.camera_from_lps.transform_point(point).z;
    let corners: Vec<glam::DVec3> = scene.objects.iter().flat_map(Object::corners_in_lps).collect();
    if corners.is_empty() || corners.iter().any(|corner| !(depth(*corner) < 0.0)) {
        return Ok(());
    }
    let nearest_mm = corners.iter().map(|corner| depth(*corner)).fold(f64::NEG_INFINITY, f64::max);
    Err(SceneError::Value {
        place: files.place("view.projection"),
        found: format!("a camera with all matter behind its focal spot (depth {nearest_mm:.0} mm and less)"),
        expected: "fx and fy of one sign; un-mirror the image, or turn the camera round".to_owned(),
    })
}

/// Every energy of the beam must be inside the tables for every material.
fn check_energies(scene: &Scene, files: &Files) -> Result<(), SceneError> {
    let Spectrum { bins } = &scene.beam.spectrum;
    for material in &scene.materials {
        for bin in bins.first().into_iter().chain(bins.last()) {
            material.attenuation(bin.energy_kev).map_err(|source| SceneError::Physics { place: files.place("beam"), source })?;
        }
    }
    Ok(())
}
