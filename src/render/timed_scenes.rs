//! What is cast to time it: volumes, tubes, a mesh, and views of them.

use crate::geometry::{Intrinsics, Rigid, View};
use crate::random::{Purpose, Stream};
use crate::reporter::Reporter;
use crate::scene::model::{Matter, Mesh, Scene, Shape, Solid, Volume};

/// Cells between rays with which slabs are timed first, and between rays that share none.
pub(super) const NEAR_CELLS: f64 = 0.5;
pub(super) const FAR_CELLS: f64 = 3.0;

/// Voxels along the edge of the volume that is timed, and pixels along the edge of its image.
pub(super) const EDGE: usize = 96;
/// Pixels along the edge of the same image with rays far apart.
pub(super) const FAR_EDGE: usize = 32;

/// Everything but the volume; `beam` is added to the beam's keys.
pub(super) fn test_scene(beam: &str) -> Option<Scene> {
    let text = r#"{ "objects": [
        {"sphere": {"centre_lps_mm": [0,0,0], "radius_mm": 1, "material": "water"}},
        {"sphere": {"centre_lps_mm": [0,0,0], "radius_mm": 1, "material": "bone_cortical"}},
        {"sphere": {"centre_lps_mm": [0,0,0], "radius_mm": 1, "material": "adipose"}},
        {"sphere": {"centre_lps_mm": [0,0,0], "radius_mm": 1, "material": "titanium"}} ],
        "beam": {BEAM "tube_kvp": 120, "anode_angle_deg": 12, "filtration_mm": {"aluminium": 4.3}, "photons_per_pixel": 1e5},
        "detector": {"response": "energy", "pitch_mm": 2.0}, "model": {"formation": "deepdrr"} }"#;
    let mut scene =
        crate::scene::load_text(&text.replace("BEAM", beam), std::path::Path::new("timing"), false, &Reporter::silent()).ok()?;
    let middle = 0.5 * (EDGE as f64 - 1.0);
    let f_px = 1000.0 / NEAR_CELLS;
    let intrinsics = Intrinsics { fx: f_px, fy: f_px, cx: middle, cy: middle, skew: 0.0 };
    let camera_from_lps = Rigid { rotation: camera_from_lps(), translation_mm: glam::DVec3::new(0.0, 0.0, 1000.0) };
    scene.view = Some(View { size_px: [EDGE as u32; 2], intrinsics, camera_from_lps });
    Some(scene)
}

/// A slanted look: axis-aligned rays flatter every rule.
fn camera_from_lps() -> glam::DQuat {
    glam::DQuat::from_rotation_y(0.3) * glam::DQuat::from_rotation_x(0.2)
}

/// Cells that the ray in the middle of the image crosses in a slab of the timed volumes.
pub(super) fn cells_per_slab() -> f64 {
    let along = (camera_from_lps().inverse() * glam::DVec3::Z).abs();
    along.element_sum() / along.max_element()
}

/// The scene with fewer pixels of the same middle, so that their rays share no cells.
pub(super) fn seen_from_afar(scene: &Scene) -> Scene {
    let middle = 0.5 * (FAR_EDGE as f64 - 1.0);
    let f_px = 1000.0 / FAR_CELLS;
    let intrinsics = Intrinsics { fx: f_px, fy: f_px, cx: middle, cy: middle, skew: 0.0 };
    let view = scene.view.map(|view| View { size_px: [FAR_EDGE as u32; 2], intrinsics, ..view });
    let mut far = Scene { view, ..scene.clone() };
    // The detector stays behind the volume.
    far.detector.pitch_mm *= FAR_CELLS / NEAR_CELLS;
    far
}

/// Noise of so many materials in `edge`³ voxels, each in blocks of `block`³; [`EDGE`] mm wide.
pub(super) fn test_volume(edge: usize, materials: usize, block: usize) -> Volume {
    let mut stream = Stream::new(1, 0, 0, Purpose::Evaluation);
    let voxels = edge * edge * edge;
    let (mut density, mut class) = (Vec::with_capacity(voxels), Vec::with_capacity(voxels));
    let mut of_block = std::collections::HashMap::new();
    for voxel in 0..voxels {
        let random = stream.next_u32();
        density.push(0.5 + (random % 1000) as f32 * 1e-3);
        let drawn = (random / 1000 % materials as u32) as u8 + 1;
        let at = [voxel % edge, voxel / edge % edge, voxel / (edge * edge)].map(|n| n / block);
        class.push(if block == 1 { drawn } else { *of_block.entry(at).or_insert(drawn) });
    }
    let voxel_mm = EDGE as f64 / edge as f64;
    let centre = glam::DVec3::splat(-0.5 * (EDGE as f64 - voxel_mm));
    Volume {
        size: [edge; 3],
        lps_from_voxel: glam::DAffine3::from_scale_rotation_translation(
            glam::DVec3::splat(voxel_mm),
            glam::DQuat::IDENTITY,
            centre,
        ),
        density_g_per_cm3: density,
        class,
        class_materials: (0..materials).collect(),
        truncated_at_faces: false,
        unknown: Vec::new(),
    }
}

/// A body from face to face.
pub(super) fn cut_volume() -> Volume {
    let mut volume = test_volume(EDGE, 1, 1);
    let from_middle = |index: usize| (index as f64 + 0.5) / EDGE as f64 - 0.5;
    for (voxel, density) in volume.density_g_per_cm3.iter_mut().enumerate() {
        let place = glam::DVec3::from_array([voxel % EDGE, voxel / EDGE % EDGE, voxel / (EDGE * EDGE)].map(from_middle));
        if place.truncate().length() > 0.46 {
            *density = 0.0;
        }
    }
    Volume { truncated_at_faces: true, ..volume }
}

/// Tubes when shapes are timed.
const TUBES: usize = 16;

/// Tubes that most rays meet, or as many that are too thin for almost any.
pub(super) fn timed_tubes(are_met: bool) -> Matter {
    let [radius_mm, inner_radius_mm] = if are_met { [60.0, 55.0] } else { [0.06, 0.055] };
    let tube = |index: usize| Solid {
        shape: Shape::Cylinder { length_mm: 200.0, radius_mm, inner_radius_mm },
        lps_from_local: Rigid {
            rotation: glam::DQuat::from_rotation_x(0.3 + 0.1 * index as f64),
            translation_mm: glam::DVec3::new(0.0, 0.0, -100.0 + 10.0 * index as f64),
        },
        material: 0,
        density_g_per_cm3: 1.0,
    };
    Matter::Solids((0..TUBES).map(tube).collect())
}

/// A ball of some thousand triangles.
pub(super) fn timed_mesh() -> Mesh {
    const ROUND: u32 = 96;
    const RINGS: u32 = 48;
    let point = |index: u32| {
        let (polar, azimuth) = (
            std::f64::consts::PI * (0.5 + f64::from(index / ROUND)) / f64::from(RINGS),
            std::f64::consts::TAU * f64::from(index % ROUND) / f64::from(ROUND),
        );
        60.0 * glam::DVec3::new(polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos())
    };
    let square = |index: u32| {
        let (ring, place) = (index / ROUND, index % ROUND);
        let next = (place + 1) % ROUND;
        let [a, b, c, d] = [ring * ROUND + place, ring * ROUND + next, (ring + 1) * ROUND + next, (ring + 1) * ROUND + place];
        [[a, c, b], [a, d, c]]
    };
    // The two holes at the poles are never looked through.
    let triangles = (0..ROUND * (RINGS - 1)).flat_map(square).collect();
    Mesh { vertices_lps_mm: (0..ROUND * RINGS).map(point).collect(), triangles, material: 0, density_g_per_cm3: 1.0 }
}
