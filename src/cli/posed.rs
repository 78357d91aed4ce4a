//! The scene of `render`, seen from a pose that `register` has found.

use std::path::{Path, PathBuf};

use crate::compare::posed_scene;
use crate::geometry::View;
use crate::image::{ImageFileError, sha256_file};
use crate::pose::{Pose, PoseFileError};
use crate::reporter::Reporter;
use crate::scene::SceneError;
use crate::scene::model::{InputFile, Scene};

/// Why a scene cannot be seen from a pose.
#[derive(Debug, thiserror::Error)]
pub enum PosedError {
    /// The pose.
    #[error(transparent)]
    Pose(#[from] PoseFileError),
    /// A pose that says too little.
    #[error("{path}: {detail}", path = path.display())]
    NoView {
        /// The pose.
        path: PathBuf,
        /// What is missing.
        detail: String,
    },
    /// A body that the scene does not know, or an intensifier that does not fit.
    #[error(transparent)]
    Scene(#[from] SceneError),
    /// The pose cannot be hashed.
    #[error(transparent)]
    Hash(#[from] ImageFileError),
}

/// The scene from the pose at `path`.
pub(super) fn posed(scene: &Scene, path: &Path, reporter: &Reporter) -> Result<Scene, PosedError> {
    let pose = Pose::read(path)?;
    let says = |detail: String| PosedError::NoView { path: path.to_owned(), detail };
    let (intrinsics, camera_from_lps) = pose.camera().ok_or_else(|| {
        let why = pose.reason.as_deref().unwrap_or("it has no intrinsics or no camera_from_lps");
        says(format!("gives no camera ({why}); an accepted pose does"))
    })?;
    let size_px = pose.size_px.or(scene.view.map(|view| view.size_px));
    let size_px = size_px.ok_or_else(|| says("has no size_px, and the scene has no view; add either".to_owned()))?;
    let view = View { size_px, intrinsics, camera_from_lps };
    if let Some(words) = other_pitch(scene, &pose, &view) {
        reporter.warn("pitch", format_args!("{}: {words}", path.display()));
    }
    let mut scene = posed_scene(scene, &pose, view)?;
    let sha256 = sha256_file(path)?;
    scene.inputs.push(InputFile { path: path.display().to_string(), sha256, place: Some(path.to_owned()), parts: Vec::new() });
    Ok(scene)
}

/// Pitches that people round differ by less, relatively.
const PITCH_AGREES: f64 = 1e-3;

/// The pose's pixels are of another size than the scene's, and no whole number of them is one of the other's: nobody has binned them.
fn other_pitch(scene: &Scene, pose: &Pose, view: &View) -> Option<String> {
    let own_mm = scene.detector.pitch_mm;
    // A console that binned or enlarged the picture says so in the pose.
    let pitch_mm = pose.pitch_mm.filter(|_| own_mm.is_finite() && pose.console.is_none())?;
    let alike = |a: f64, b: f64| (a / b - 1.0).abs() <= PITCH_AGREES;
    let ratio = pitch_mm / own_mm;
    let binned = match &scene.view {
        // So many pixels fewer as each is larger.
        Some(before) => alike(f64::from(before.size_px[0]) / f64::from(view.size_px[0]), ratio),
        None => alike(ratio.max(1.0 / ratio).round(), ratio.max(1.0 / ratio)),
    };
    (!alike(ratio, 1.0) && !binned).then(|| {
        let distance_mm = |pitch_mm: f64| view.intrinsics.source_to_detector_mm(pitch_mm);
        format!(
            "its pitch_mm is {pitch_mm}, the scene's detector.pitch_mm is {own_mm}: the pose's is taken, which puts the panel {:.0} mm from the \
             focal spot, not {:.0} mm; correct the one that is wrong",
            distance_mm(pitch_mm),
            distance_mm(own_mm)
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Intrinsics, Rigid};
    use crate::scene::physics::Spectrum;

    /// A pose of half the scene's pitch once halved the distance to the panel without a word; pixels binned two by two are the same panel.
    #[test]
    fn pixels_of_another_size_are_said_unless_they_are_binned() {
        let intrinsics = Intrinsics { fx: 500.0, fy: 500.0, skew: 0.0, cx: 31.5, cy: 23.5 };
        let view = View { size_px: [64, 48], intrinsics, camera_from_lps: Rigid::IDENTITY };
        let mut scene = Scene::plain(Spectrum::mono(60.0).expect("inside"));
        scene.detector.pitch_mm = 2.6;
        scene.view = Some(view);
        let pose = |pitch_mm: Option<f64>| Pose { pitch_mm, ..Pose::default() };
        let words = other_pitch(&scene, &pose(Some(1.3)), &view).expect("half of it");
        assert!(
            words.contains("1.3") && words.contains("2.6") && words.contains("650 mm from") && words.contains("1300 mm"),
            "{words}"
        );
        for pitch_mm in [Some(2.6), Some(2.601), None] {
            assert_eq!(other_pitch(&scene, &pose(pitch_mm), &view), None, "{pitch_mm:?}");
        }
        let finer = View { size_px: [128, 96], ..view };
        assert_eq!(other_pitch(&scene, &pose(Some(1.3)), &finer), None, "twice as many pixels");
        scene.view = None;
        assert_eq!(other_pitch(&scene, &pose(Some(1.3)), &view), None, "nothing says how many there were");
        assert!(other_pitch(&scene, &pose(Some(1.7)), &view).is_some());
        scene.detector.pitch_mm = f64::NAN;
        assert_eq!(other_pitch(&scene, &pose(Some(1.7)), &view), None, "the scene has none");
    }
}
