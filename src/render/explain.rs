//! Why an image is empty, and which objects are not in it.

use std::sync::Arc;

use glam::{DAffine3, DVec3};

use super::bounds::sphere_bounds;
use super::prepared::Prepared;
use crate::geometry::View;
use crate::scene::model::{Matter, Object, Scene, Volume};

/// One sentence on why no ray meets anything.
#[must_use]
pub fn explain_empty(scene: &Scene, prepared: &Prepared) -> String {
    let spheres: Vec<(DVec3, f64)> = scene.objects.iter().filter_map(bounding_sphere).collect();
    if scene.objects.is_empty() || spheres.is_empty() {
        return "the image is empty: the scene holds no matter".to_owned();
    }
    let view = &prepared.view;
    let (centre, radius) = enclosing(&spheres);
    let seen = |centre: DVec3, radius: f64| in_view(view, prepared.detector_mm, centre, radius);
    let in_camera = view.camera_from_lps.transform_point(centre);
    let place = format!("the objects lie around ({:.0}, {:.0}, {:.0}) mm in lps", centre.x, centre.y, centre.z);
    if spheres.iter().any(|(centre, radius)| seen(*centre, *radius)) {
        return "the image is empty: objects are in view, but no ray meets matter (all air, or between the rays)".to_owned();
    }
    // Units are suspected only of scenes whose size no patient and no tool has.
    let (tiny, huge) = (radius < 10.0 && centre.length() < 10.0, radius > 2_000.0 || centre.length() > 10_000.0);
    let suspects = [
        (tiny, 1000.0, "in metres where millimetres are expected"),
        (huge, 1e-3, "in micrometres, or a thousand times too large"),
    ];
    for (_, scale, words) in suspects.into_iter().filter(|(suspected, ..)| *suspected) {
        if spheres.iter().any(|(centre, radius)| seen(*centre * scale, *radius * scale)) {
            return format!("the image is empty: {place}; scaled by {scale} they would be in view: is something {words}?");
        }
    }
    let flip = DVec3::new(-1.0, -1.0, 1.0);
    if spheres.iter().any(|(centre, radius)| seen(*centre * flip, *radius)) {
        return format!("the image is empty: {place}; with x and y negated they would be in view: RAS and LPS mixed up?");
    }
    if in_camera.z + radius <= 0.0 {
        return format!(
            "the image is empty: {place}, behind the source (depth {:.0} mm): the camera looks the other way, or the pose is inverted",
            in_camera.z
        );
    }
    if in_camera.z - radius >= prepared.detector_mm {
        return format!(
            "the image is empty: {place}, at {:.0} mm from the source, behind the detector at {:.0} mm (fx times pitch): check pitch_mm and intrinsics",
            in_camera.z, prepared.detector_mm
        );
    }
    let (pixel, _) = view.projection().project(centre);
    let [width, height] = view.size_px;
    format!("the image is empty: {place} and project to pixel ({:.0}, {:.0}), outside {width} x {height}", pixel.x, pixel.y)
}

/// Objects smaller than this are nobody's.
const SMALLEST_MM: f64 = 0.05;

/// What to say of objects that `view` does not show, that are too small for anything, or that hold the focal spot: one sentence for each kind of fault. Beads are not
/// spoken of, of which some lie outside most views.
#[must_use]
pub fn explain_unseen(scene: &Scene, view: &View) -> Vec<String> {
    let detector_mm = view.intrinsics.source_to_detector_mm(scene.detector.pitch_mm);
    let (mut outside, mut tiny, mut some_seen) = (Vec::new(), Vec::new(), false);
    for object in &scene.objects {
        let Some((centre, radius)) = bounding_sphere(object) else { continue };
        if radius < SMALLEST_MM {
            tiny.push(format!("{} ({:.1e} mm)", object.name, 2.0 * radius));
        } else if in_view(view, detector_mm, centre, radius) {
            some_seen = true;
        } else if !object.name.ends_with(".sphere") {
            outside.push(format!("{} around ({:.0}, {:.0}, {:.0}) mm in lps", object.name, centre.x, centre.y, centre.z));
        }
    }
    let mut words = Vec::new();
    // Why nothing at all is seen is said by the image.
    if !outside.is_empty() && some_seen {
        words.push(format!("not in view: {}", outside.join("; ")));
    }
    if !tiny.is_empty() {
        words.push(format!("too small to be seen: {}: in metres where millimetres are expected?", tiny.join("; ")));
    }
    let holds_source = |object: &&Object| object.matter.volumes().iter().any(|volume| holds(volume, view.source_in_lps()));
    words.extend(scene.objects.iter().find(holds_source).map(|object| {
        let name = &object.name;
        format!("the focal spot lies within {name}, as no C-arm's does: is the pose in metres, or the inverse of one?")
    }));
    words
}

/// Whether a point lies within the grid of a CT.
fn holds(volume: &Volume, p_in_lps: DVec3) -> bool {
    let voxel = volume.lps_from_voxel.inverse().transform_point3(p_in_lps);
    volume.truncated_at_faces && (0..3).all(|axis| voxel[axis] > -0.5 && voxel[axis] < volume.size[axis] as f64 - 0.5)
}

fn in_view(view: &View, detector_mm: f64, centre: DVec3, radius: f64) -> bool {
    let in_camera = view.camera_from_lps.transform_point(centre);
    in_camera.z + radius > 0.0 && in_camera.z - radius < detector_mm && !sphere_bounds(view, in_camera, radius).is_empty()
}

fn bounding_sphere(object: &Object) -> Option<(DVec3, f64)> {
    match &object.matter {
        Matter::Volume(_) | Matter::Parts(_) => {
            let around = |volume: &Arc<Volume>| {
                let last = DVec3::from_array(volume.size.map(|n| n as f64));
                let affine: &DAffine3 = &volume.lps_from_voxel;
                (affine.transform_point3(0.5 * last - 0.5), corners_reach(affine, last))
            };
            let spheres: Vec<_> = object.matter.volumes().iter().map(around).collect();
            match spheres.as_slice() {
                [one] => Some(*one),
                several => (!several.is_empty()).then(|| enclosing(several)),
            }
        }
        Matter::Solids(solids) => {
            let spheres: Vec<_> = solids
                .iter()
                .map(|solid| {
                    let (centre, radius) = solid.shape.bounding_sphere();
                    (solid.lps_from_local.transform_point(centre), radius)
                })
                .collect();
            (!spheres.is_empty()).then(|| enclosing(&spheres))
        }
        Matter::Mesh(mesh) => {
            let points: Vec<_> = mesh.vertices_lps_mm.iter().map(|vertex| (*vertex, 0.0)).collect();
            (!points.is_empty()).then(|| enclosing(&points))
        }
    }
}

fn corners_reach(affine: &DAffine3, size: DVec3) -> f64 {
    let sign = |bit: usize| if bit == 0 { -0.5 } else { 0.5 };
    let reach = |corner: usize| {
        let half = size * DVec3::new(sign(corner & 1), sign(corner >> 1 & 1), sign(corner >> 2 & 1));
        affine.transform_vector3(half).length()
    };
    (0..8).map(reach).fold(0.0, f64::max)
}

/// A sphere around spheres: centre of their box, and the farthest reach from there.
fn enclosing(spheres: &[(DVec3, f64)]) -> (DVec3, f64) {
    let (lo, hi) = spheres
        .iter()
        .fold((DVec3::INFINITY, DVec3::NEG_INFINITY), |(lo, hi), (centre, r)| (lo.min(*centre - *r), hi.max(*centre + *r)));
    let middle = 0.5 * (lo + hi);
    (middle, spheres.iter().map(|(centre, radius)| centre.distance(middle) + radius).fold(0.0, f64::max))
}
