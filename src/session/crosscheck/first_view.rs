//! From where a session's first picture may be taken, as far as its files say it.

use glam::{DMat3, DQuat, DVec3};

use crate::geometry::{CarmCalibration, CarmJoints, Intrinsics, Rigid, View};
use crate::scene::Scene;

/// Where no calibration says it: distance to the detector, to the specimen, and the live size.
const SID_MM: f64 = 1020.0;
const SOD_MM: f64 = 630.0;
const SIZE_PX: [u32; 2] = [620, 480];
/// Shadows closer than this are one.
const APART_PX: f64 = 8.0;

/// The arm's joints in it; where its calibration does not say how far the detector is, telemetry does.
pub fn first_joints(carm: &CarmCalibration) -> CarmJoints {
    CarmJoints { source_to_detector_mm: carm.source_to_detector_mm.unwrap_or(SID_MM), ..CarmJoints::ZERO }
}

/// The view that the arm would have at zero if that shows every bead, else one that does. `carm` is the calibration of the frame's pixels.
///
/// # Errors
/// In words, when the calibration gives no K.
pub fn choose_view(
    carm: Option<&CarmCalibration>,
    world_from_lps: Option<[[f64; 4]; 4]>,
    places: &[DVec3],
    scene: &Scene,
) -> Result<View, String> {
    let (size_px, depth_mm, intrinsics) = match carm {
        Some(carm) => {
            let intrinsics = carm.intrinsics(&first_joints(carm)).map_err(|error| error.to_string())?;
            ([carm.columns_px, carm.rows_px], carm.source_to_isocentre_mm, intrinsics)
        }
        None => {
            let f = SID_MM / scene.detector.pitch_mm;
            let [cx, cy] = SIZE_PX.map(|n| 0.5 * f64::from(n) - 0.5);
            (SIZE_PX, SOD_MM, Intrinsics { fx: f, fy: f, skew: 0.0, cx, cy })
        }
    };
    let centre = places.iter().copied().sum::<DVec3>() / places.len().max(1) as f64;
    let centred = |rotation: DQuat| Rigid { rotation, translation_mm: DVec3::new(0.0, 0.0, depth_mm) - rotation * centre };
    let world_from_lps = world_from_lps.and_then(|rows| Rigid::from_rows(&rows).ok());
    let of_arm = carm.zip(world_from_lps).and_then(|(carm, world_from_lps)| {
        Some((carm.world_from_camera(&CarmJoints::ZERO).ok()?.inverse() * world_from_lps).rotation)
    });
    // From the front: columns to the patient's left, rows to the feet.
    let anterior = DQuat::from_mat3(&DMat3::from_cols(DVec3::X, DVec3::Z, -DVec3::Y));
    let tilts = [(0.0, 0.0), (20.0, 0.0), (-20.0, 5.0), (30.0, -10.0), (0.0, 20.0), (90.0, 0.0), (60.0, 10.0)];
    let tilted = tilts.map(|(orbital, angulation): (f64, f64)| {
        DQuat::from_rotation_y(orbital.to_radians()) * DQuat::from_rotation_x(angulation.to_radians())
    });
    let base = of_arm.unwrap_or(anterior);
    let views = tilted.map(|tilt| View { size_px, intrinsics, camera_from_lps: centred(tilt * base) });
    let shown = |view: &View| beads_apart(view, places);
    views.into_iter().max_by(|a, b| shown(a).cmp(&shown(b)).then(std::cmp::Ordering::Greater)).ok_or_else(|| "no view".to_owned())
}

/// Beads in the frame whose shadows touch no other.
fn beads_apart(view: &View, places: &[DVec3]) -> usize {
    let projection = view.projection();
    let seen: Vec<_> = places.iter().map(|place| projection.project(*place)).filter(|(_, depth_mm)| *depth_mm > 0.0).collect();
    let [width, height] = view.size_px.map(f64::from);
    let inside = |p: &glam::DVec2| p.x > APART_PX && p.y > APART_PX && p.x < width - APART_PX && p.y < height - APART_PX;
    let alone = |p: &glam::DVec2| seen.iter().filter(|(other, _)| other.distance(*p) < APART_PX).count() == 1;
    seen.iter().filter(|(p, _)| inside(p) && alone(p)).count()
}
