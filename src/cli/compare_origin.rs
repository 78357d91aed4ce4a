//! Whether a scene and a pose are those that a simulated image was rendered from: by what `render` wrote beside it.

use std::path::{Path, PathBuf};

use glam::DVec3;
use serde_json::Value;

use crate::compare::farthest_apart_px;
use crate::geometry::{Intrinsics, Rigid, View};
use crate::image::{Image, ImageFileError, sha256_file};
use crate::pose::Pose;
use crate::reporter::Reporter;
use crate::scene::Scene;
use crate::scene::model::ScatterModel;
use crate::transport::NetworkScatter;

/// A pose that shows the field further off than this is another pose: wrong poses are told from right ones by less than a millimetre.
const SAME_POSE_PX: f64 = 1.0;

/// Why a pose is not that of the simulated image.
#[derive(Debug, thiserror::Error)]
pub enum OriginError {
    /// For images of another size.
    #[error(
        "{path}: the pose is for images of {pose:?} px, the simulated image has {simulated:?}; render at the pose's size or a whole fraction of \
         it, or give the pose that was rendered",
        path = path.display()
    )]
    Size {
        /// The pose.
        path: PathBuf,
        /// Columns and rows.
        pose: [u32; 2],
        /// Columns and rows.
        simulated: [u32; 2],
    },
    /// The simulated image was rendered from elsewhere.
    #[error(
        "{path}: the simulated image was rendered from another pose, which shows the specimen up to {apart_px:.1} px from there (at most \
         {limit_px} px); render at this pose, or give the one that was rendered",
        path = path.display()
    )]
    Projection {
        /// The pose.
        path: PathBuf,
        /// The largest distance in the field, in pixels of the simulated image; infinite where one sees from behind.
        apart_px: f64,
        /// [`SAME_POSE_PX`].
        limit_px: f64,
    },
    /// A file whose hash cannot be taken.
    #[error(transparent)]
    Image(#[from] ImageFileError),
}

/// The view of the simulated image: that of the pose, binned where the image is a whole fraction of it; `None` for a refused pose.
///
/// # Errors
/// When the pose is for images of another size.
pub(super) fn view_of(
    (path, pose): (&Path, &Pose),
    simulated: &Image<f32>,
    reporter: &Reporter,
) -> Result<Option<View>, OriginError> {
    let Some((intrinsics, camera_from_lps)) = pose.camera() else {
        let reason = pose.reason.as_deref().unwrap_or("no reason given");
        reporter.warn("pose", format!("the pose is refused ({reason}): no distances in mm, no null, beads and robot not masked"));
        return Ok(None);
    };
    let size_px = [simulated.width as u32, simulated.height as u32];
    let full = pose.size_px.unwrap_or(size_px);
    let factor = full[0].checked_div(size_px[0]).unwrap_or(0);
    if factor == 0 || full[0] / factor != size_px[0] || full[1] / factor != size_px[1] {
        return Err(OriginError::Size { path: path.to_owned(), pose: full, simulated: size_px });
    }
    Ok(Some(View { size_px, intrinsics: intrinsics.binned(f64::from(factor)), camera_from_lps }))
}

/// What was given beside the simulated image.
pub(super) struct Given<'a> {
    pub simulated: &'a Path,
    /// What `render` wrote about it; null where there is nothing.
    pub described: &'a Value,
    pub pose: Option<(&'a Path, Option<View>)>,
    pub scene: Option<&'a Scene>,
    pub centre_lps_mm: Option<DVec3>,
}

/// What keeps scene and pose from being known as those of the simulated image, in words; empty where they are its very files.
///
/// # Errors
/// When the pose is another.
pub(super) fn doubts(given: &Given) -> Result<Vec<String>, OriginError> {
    if given.pose.is_none() && given.scene.is_none() {
        return Ok(Vec::new());
    }
    let name = given.simulated.display();
    let rendered = rendered_view(given.described);
    // One that was binned since is not looked at: nothing says how.
    if let (Some((path, Some(view))), Some(rendered)) = (given.pose, rendered)
        && view.size_px == rendered.size_px
    {
        let centre = given.centre_lps_mm.unwrap_or(DVec3::ZERO);
        let depth_mm = rendered.camera_from_lps.transform_point(centre).z.max(1.0);
        let apart_px = farthest_apart_px(&rendered, &view, depth_mm);
        if !(apart_px <= SAME_POSE_PX) {
            return Err(OriginError::Projection { path: path.to_owned(), apart_px, limit_px: SAME_POSE_PX });
        }
    }
    let Some(inputs) = given.described["inputs"].as_array() else {
        return Ok(vec![format!(
            "nothing beside {name} says what it was rendered from: whether scene and pose are its own is known only from how it looks"
        )]);
    };
    let is_input = |sha256: &str| inputs.iter().any(|input| input["sha256"].as_str() == Some(sha256));
    let mut found = Vec::new();
    if let Some((path, _)) = given.pose
        && !is_input(&sha256_file(path)?)
    {
        let rest =
            if rendered.is_some() { "its camera is the same; bodies were not compared" } else { "its camera is not known" };
        found.push(format!("{} is not the file that {name} was rendered from ({rest})", path.display()));
    }
    found.extend(given.scene.and_then(|scene| other_scatter(given.described, scene)));
    let others: Vec<&str> = given
        .scene
        .iter()
        .flat_map(|scene| &scene.inputs)
        .filter(|input| !is_input(&input.sha256))
        .map(|input| input.path.as_str())
        .collect();
    if !others.is_empty() {
        found.push(format!("{name} was not rendered from {} as it is now: the null renders what it says now", others.join(", ")));
    }
    Ok(found)
}

/// What to say where the scatter in the simulated image is not what the null has; of photons only whether there is any is known.
fn other_scatter(described: &Value, scene: &Scene) -> Option<String> {
    let from = &described["scatter"]["from"];
    let network = from["network"]["sha256"].as_str();
    let there = match (network, from["photons"].is_object()) {
        (Some(_), _) => ScatterModel::Network,
        (None, true) => ScatterModel::MonteCarlo,
        (None, false) => ScatterModel::Off,
    };
    let here = scene.model.possible_scatter();
    if there != here {
        return Some(format!("the simulated image's scatter is {there:?}, the null's {here:?}: scores differ by that too"));
    }
    let asked = network.and_then(|_| NetworkScatter::open(None).ok())?.sha256();
    let words =
        "the simulated image has the scatter of another network than the one that comes with the program, which the null has";
    (network != Some(asked.as_str())).then(|| words.to_owned())
}

/// From where an image was rendered, as `render` wrote it.
fn rendered_view(described: &Value) -> Option<View> {
    let view = described.get("view")?;
    let read = |key: &str| view.get(key).cloned();
    Some(View {
        size_px: serde_json::from_value(read("size_px")?).ok()?,
        intrinsics: serde_json::from_value::<Intrinsics>(read("intrinsics")?).ok()?,
        camera_from_lps: serde_json::from_value::<Rigid>(read("camera_from_lps")?).ok()?,
    })
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;
    use crate::scene::model::Formation;
    use crate::scene::physics::Spectrum;

    /// No, another, and the same scatter in the simulated image as in the null; a naive scene has none.
    #[test]
    fn scatter_that_the_null_has_otherwise_is_doubted() {
        let mut scene = Scene::plain(Spectrum::mono(60.0).expect("inside"));
        let said = |described: &Value, scene: &Scene| other_scatter(described, scene).unwrap_or_default();
        let photons = json!({"scatter": {"from": {"photons": {"histories": 1}}}});
        assert_eq!(said(&json!({}), &scene), "");
        assert!(said(&photons, &scene).contains("MonteCarlo, the null's Off"), "{}", said(&photons, &scene));
        scene.model.scatter = ScatterModel::MonteCarlo;
        assert_eq!(said(&photons, &scene), "");
        scene.model.scatter = ScatterModel::Network;
        assert!(said(&json!({"scatter": null}), &scene).contains("Off, the null's Network"));
        let by = |sha256: &str| json!({"scatter": {"from": {"network": {"sha256": sha256}}}});
        if let Ok(network) = NetworkScatter::open(None) {
            assert_eq!(said(&by(&network.sha256()), &scene), "");
            assert!(said(&by("a1"), &scene).contains("another network"));
        }
        scene.model.formation = Formation::Naive;
        assert_eq!(said(&json!({}), &scene), "");
    }
}
