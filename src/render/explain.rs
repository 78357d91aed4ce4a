//! Why an image is empty, and which objects are not in it.

use std::sync::Arc;

use glam::{DAffine3, DVec2, DVec3};

use super::bounds::sphere_bounds;
use super::cpu::shapes::intersect;
use super::mesh_tree::MeshTree;
use super::prepared::Prepared;
use crate::geometry::View;
use crate::scene::model::{Matter, Mesh, Object, Scene, Shape, Solid, Volume};

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
        return "the image is empty: objects are in view, but no ray meets matter (all air, or between or beside the rays)"
            .to_owned();
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

/// What to say of objects that `view` does not show, or cuts off at the detector, that are too small for anything, or that hold the focal spot: one
/// sentence for each kind of fault. Beads outside are not spoken of: some lie outside most views.
#[must_use]
pub fn explain_unseen(scene: &Scene, view: &View) -> Vec<String> {
    let detector_mm = view.intrinsics.source_to_detector_mm(scene.detector.pitch_mm);
    let (mut outside, mut tiny, mut cut, mut some_seen) = (Vec::new(), Vec::new(), Vec::new(), false);
    for object in &scene.objects {
        let Some((centre, radius)) = bounding_sphere(object) else { continue };
        if radius < SMALLEST_MM {
            tiny.push(format!("{} ({:.1e} mm)", object.name, 2.0 * radius));
        } else if in_view(view, detector_mm, centre, radius) {
            some_seen = true;
            let is_cut = |far_mm: f64| far_mm > detector_mm + SMALLEST_MM && is_shown_beyond(scene, object, view, detector_mm);
            if let Some((near_mm, far_mm)) = depths(object, view).filter(|(_, far_mm)| is_cut(*far_mm)) {
                let share = 100.0 * (far_mm - detector_mm.max(near_mm)) / (far_mm - near_mm);
                cut.push(format!("{} ({share:.0} % of its depth, up to {far_mm:.0} mm)", object.name));
            }
        } else if !object.name.ends_with(".sphere") {
            outside.push(format!("{} around ({:.0}, {:.0}, {:.0}) mm in lps", object.name, centre.x, centre.y, centre.z));
        }
    }
    let mut words = Vec::new();
    // Why nothing at all is seen is said by the image.
    if !outside.is_empty() && some_seen {
        words.push(format!("not in view: {}", outside.join("; ")));
    }
    if !cut.is_empty() {
        words.push(format!(
            "cut off by the detector at {detector_mm:.0} mm from the source, behind which nothing is seen: {}",
            cut.join("; ")
        ));
    }
    if !tiny.is_empty() {
        words.push(format!("too small to be seen: {}: in metres where millimetres are expected?", tiny.join("; ")));
    }
    let source = view.source_in_lps();
    let holds_source = |object: &&Object| match &object.matter {
        Matter::Volume(_) | Matter::Parts(_) => object.matter.volumes().iter().any(|volume| holds(volume, source)),
        Matter::Solids(solids) => solids.iter().filter(|solid| !scene.is_air(solid.material)).any(|solid| {
            let local_from_lps = solid.lps_from_local.inverse();
            let (place, way) = (local_from_lps.transform_point(source), local_from_lps.rotation * ANY_WAY);
            runs_inside(intersect(&solid.shape, place, way).as_slice())
        }),
        Matter::Mesh(mesh) if scene.is_air(mesh.material) => false,
        Matter::Mesh(mesh) => {
            let within = bounding_sphere(object).is_some_and(|(centre, radius)| centre.distance(source) < radius);
            within && mesh_holds(mesh, source)
        }
    };
    let holding: Vec<&str> = scene.objects.iter().filter(holds_source).map(|object| object.name.as_str()).collect();
    if !holding.is_empty() {
        let names = holding.join(" and ");
        words.push(format!(
            "the focal spot lies within {names}, as no C-arm's does: is the pose in metres, or the inverse of one?"
        ));
    }
    words
}

/// Along no axis, and in no plane of two.
const ANY_WAY: DVec3 = DVec3::new(0.48, 0.36, 0.8);

/// Whether the origin of a ray lies inside what it meets, and not only on its surface.
fn runs_inside(spans: &[(f64, f64)]) -> bool {
    spans.iter().any(|(from, to)| *from < -SMALLEST_MM && *to > SMALLEST_MM)
}

fn mesh_holds(mesh: &Mesh, p_in_lps: DVec3) -> bool {
    let mut spans = Vec::new();
    MeshTree::new(&mesh.vertices_lps_mm, &mesh.triangles).inside(p_in_lps, ANY_WAY, &mut spans);
    runs_inside(&spans)
}

/// Rays of the picture that are asked, along each axis.
const ACROSS: u32 = 17;

/// Whether rays of the picture would run within matter of the object behind the detector: what ends beside the field is not cut there.
fn is_shown_beyond(scene: &Scene, object: &Object, view: &View, detector_mm: f64) -> bool {
    let (source, [width, height]) = (view.source_in_lps(), view.size_px.map(f64::from));
    // Distances along such a way are depths.
    let way = |n: u32| {
        let share = |n: u32| f64::from(n) / f64::from(ACROSS - 1);
        let at_px = DVec2::new(width * share(n % ACROSS) - 0.5, height * share(n / ACROSS) - 0.5);
        view.camera_from_lps.rotation.inverse() * view.intrinsics.unproject(at_px)
    };
    let is_beyond = |spans: &[(f64, f64)]| spans.iter().any(|(_, to)| *to > detector_mm + SMALLEST_MM);
    let mut ways = (0..ACROSS * ACROSS).map(way);
    match &object.matter {
        Matter::Volume(_) | Matter::Parts(_) => false,
        Matter::Solids(solids) => ways.any(|way| {
            solids.iter().filter(|solid| !scene.is_air(solid.material)).any(|solid| {
                let local_from_lps = solid.lps_from_local.inverse();
                let (place, way) = (local_from_lps.transform_point(source), local_from_lps.rotation * way);
                is_beyond(intersect(&solid.shape, place, way).as_slice())
            })
        }),
        Matter::Mesh(mesh) if scene.is_air(mesh.material) => false,
        Matter::Mesh(mesh) => {
            let tree = MeshTree::new(&mesh.vertices_lps_mm, &mesh.triangles);
            ways.any(|way| {
                let mut spans = Vec::new();
                tree.inside(source, way, &mut spans);
                is_beyond(&spans)
            })
        }
    }
}

/// The least and largest depth of a shape or mesh in the camera, mm; `None` for volumes, whose grids reach beyond their matter.
// By the support of each shape along the axis of the camera.
fn depths(object: &Object, view: &View) -> Option<(f64, f64)> {
    let depth = |p_in_lps: DVec3| view.camera_from_lps.transform_point(p_in_lps).z;
    let around = |(near, far): (f64, f64), (low, high): (f64, f64)| (near.min(low), far.max(high));
    let nothing = (f64::INFINITY, f64::NEG_INFINITY);
    let (near, far) = match &object.matter {
        Matter::Volume(_) | Matter::Parts(_) => nothing,
        Matter::Mesh(mesh) => mesh.vertices_lps_mm.iter().map(|vertex| (depth(*vertex), depth(*vertex))).fold(nothing, around),
        Matter::Solids(solids) => {
            let reach = |solid: &Solid| {
                let axis = solid.lps_from_local.rotation.inverse() * (view.camera_from_lps.rotation.inverse() * DVec3::Z);
                let half = match solid.shape {
                    Shape::Ellipsoid { semi_axes_mm } => (semi_axes_mm * axis).length(),
                    Shape::Cuboid { half_size_mm } => half_size_mm.dot(axis.abs()),
                    Shape::Cylinder { length_mm, radius_mm, .. } => {
                        0.5 * length_mm * axis.z.abs() + radius_mm * axis.truncate().length()
                    }
                };
                let middle = depth(solid.lps_from_local.transform_point(solid.shape.bounding_sphere().0));
                (middle - half, middle + half)
            };
            solids.iter().map(reach).fold(nothing, around)
        }
    };
    (far > near).then_some((near, far))
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Intrinsics, Rigid};
    use crate::scene::physics::Spectrum;

    /// A sphere half behind the detector, and a source within matter, passed without a word.
    #[test]
    fn what_the_detector_cuts_and_what_holds_the_source_is_said_by_name() {
        let view = View {
            intrinsics: Intrinsics { fx: 1000.0, fy: 1000.0, skew: 0.0, cx: 31.5, cy: 31.5 },
            camera_from_lps: Rigid::IDENTITY,
            size_px: [64, 64],
        };
        let words = |shape: Shape, depth_mm: f64| {
            let mut scene = Scene::plain(Spectrum { bins: Vec::new() });
            scene.detector.pitch_mm = 1.0;
            let lps_from_local = Rigid::translation(DVec3::new(0.0, 0.0, depth_mm));
            let solid = Solid { shape, lps_from_local, material: 0, density_g_per_cm3: 1.0 };
            scene.objects.push(Object {
                name: "objects[0].box".to_owned(),
                body: "specimen".to_owned(),
                matter: Matter::Solids(vec![solid]),
            });
            explain_unseen(&scene, &view).join("\n")
        };
        let sphere = Shape::Ellipsoid { semi_axes_mm: DVec3::splat(20.0) };
        assert_eq!(words(sphere, 600.0), "", "the control");
        let cut = words(sphere, 1000.0);
        assert!(cut.contains("cut off by the detector at 1000 mm") && cut.contains("objects[0].box (50 % of its depth"), "{cut}");
        // Its bounding sphere reaches through, the plate does not.
        assert_eq!(words(Shape::Cuboid { half_size_mm: DVec3::new(200.0, 200.0, 5.0) }, 990.0), "", "a plate on the panel");
        assert!(words(sphere, 10.0).contains("the focal spot lies within objects[0].box"));
        assert_eq!(words(sphere, 20.0), "", "on its surface");
        let tube = Shape::Cylinder { length_mm: 400.0, radius_mm: 20.0, inner_radius_mm: 10.0 };
        assert_eq!(words(tube, -100.0), "", "in a lumen");
    }
}
