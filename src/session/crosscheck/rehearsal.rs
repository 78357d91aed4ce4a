//! One synthetic exposure through the whole path: the scene rendered with noise from where the arm would look, its beads found and
//! registered, the pose compared with the one that was rendered, the matched DRR with the frame.

use glam::{DMat3, DQuat, DVec3};

use super::exposure::{PoseDifference, pose_difference};
use super::finding::Finding;
use super::metal::bead_spheres;
use crate::acquire::{Domain, Frame};
use crate::beads::BeadLayout;
use crate::compare::{AirLevel, CompareInput, compare};
use crate::geometry::{CarmJoints, Intrinsics, Rigid, View};
use crate::pose::{Pose, Prior, Registration, register};
use crate::render::{Options, Quantity, Renderer};
use crate::scene::Scene;
use crate::scene::model::{Noise, ScatterModel};
use crate::session::file::Setup;
use crate::time::Stopwatch;

const CHECK: &str = "synthetic exposure";
/// Where no calibration says it: distance to the detector, to the specimen, and the live size.
const SID_MM: f64 = 1020.0;
const SOD_MM: f64 = 630.0;
const SIZE_PX: [u32; 2] = [620, 480];
/// Radius of beads that name none.
const BEAD_RADIUS_MM: f64 = 0.75;
/// A pose from eight beads is a tenth of this off: degrees, mm across, mm in depth.
const TOLERANCE: (f64, f64, f64) = (0.5, 0.5, 5.0);
/// Noise and truncation leave more than this of a matched DRR.
const LEAST_ZNCC: f64 = 0.5;
/// Shadows closer than this are one.
const APART_PX: f64 = 8.0;

/// Rehearses an exposure.
#[must_use]
pub fn rehearse(setup: &Setup, scene: &Scene, layout: &BeadLayout, renderer: &mut Renderer) -> Finding {
    match expose(setup, scene, layout, renderer) {
        Ok(finding) => finding,
        Err(detail) => {
            Finding::fail(CHECK, detail, "correct the scene or the calibration; `sidecarm render --explain` says more")
        }
    }
}

/// The view that is rehearsed: the arm's own if it shows every bead, else one that does.
pub fn choose_view(setup: &Setup, places: &[DVec3], scene: &Scene) -> Result<View, String> {
    let carm = setup.carm.as_ref();
    let at_zero = CarmJoints { source_to_detector_mm: f64::NAN, ..CarmJoints::ZERO };
    let (size_px, depth_mm, intrinsics) = match carm {
        Some(carm) => {
            let intrinsics = carm.intrinsics(&at_zero).map_err(|error| error.to_string())?;
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
    let world_from_lps = setup.session.world_from_lps.and_then(|rows| Rigid::from_rows(&rows).ok());
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

fn expose(setup: &Setup, scene: &Scene, layout: &BeadLayout, renderer: &mut Renderer) -> Result<Finding, String> {
    let spheres = bead_spheres(scene);
    let points: Vec<DVec3> = layout.beads.iter().map(|bead| bead.lps_mm).collect();
    let drawn_by_scene = spheres.len() >= 4;
    let places = if drawn_by_scene { &spheres } else { &points };
    let view = choose_view(setup, places, scene)?;
    let mut exposed = scene.with_view(view);
    if !drawn_by_scene {
        let radius = |index: usize| layout.radius_mm(index, None).unwrap_or(BEAD_RADIUS_MM);
        let balls: Vec<(DVec3, f64)> = points.iter().enumerate().map(|(index, p)| (*p, radius(index))).collect();
        exposed.add_beads(&balls, "steel_316l").map_err(|error| error.to_string())?;
    }
    exposed.model.noise = Noise::True;
    let watch = Stopwatch::start();
    let options = Options { quantity: Quantity::Intensity, ..Options::default() };
    let rendered = renderer.render(&exposed, &options).map_err(|error| error.to_string())?;
    let page = rendered.pages.into_iter().next().ok_or("nothing was rendered")?;
    let mut frame = Frame::from_pixels("synthetic", page, Domain::Linear).map_err(|error| error.to_string())?;
    frame.unit = Some("1".to_owned());
    let first_render_ms = watch.ms();

    let watch = Stopwatch::start();
    let layout = BeadLayout { refused: None, ..layout.clone() };
    let prior = Prior { camera_from_lps: view.camera_from_lps, covariance: None };
    let attempt = |prior: Option<&Prior>| {
        let request = Registration {
            intrinsics: Some(view.intrinsics),
            pitch_mm: setup.carm.as_ref().map(|carm| carm.pitch_mm),
            prior,
            ..Registration::new(view.size_px, &layout)
        };
        register(&request, &frame)
    };
    let blind = attempt(None);
    let register_ms = watch.ms();
    let (pose, how) = if blind.is_accepted() { (blind, "") } else { (attempt(Some(&prior)), ", with telemetry's prior") };
    let Some((intrinsics, camera_from_lps)) = pose.camera().filter(|_| pose.is_accepted()) else {
        return Ok(refused(&pose));
    };
    let PoseDifference { angle_deg, shift_mm } =
        pose_difference(&camera_from_lps, &view.camera_from_lps, layout.centroid_lps_mm());
    let across_mm = shift_mm.truncate().length();
    let (most_deg, most_across_mm, most_depth_mm) = TOLERANCE;
    if !(angle_deg <= most_deg && across_mm <= most_across_mm && shift_mm.z.abs() <= most_depth_mm) {
        let detail = format!(
            "the pose found is {angle_deg:.1} degrees, {across_mm:.1} mm across and {:.1} mm in depth from the one that was rendered",
            shift_mm.z.abs()
        );
        return Ok(Finding::fail(
            CHECK,
            detail,
            "the beads are not where the scene has them, or their layout is nearly symmetric: see the other checks",
        ));
    }
    let watch = Stopwatch::start();
    let matched = exposed.with_view(View { intrinsics, camera_from_lps, ..view });
    let options = Options { quantity: Quantity::LineIntegral, ..Options::default() };
    let mut quiet = matched;
    quiet.model.noise = Noise::Off;
    quiet.model.scatter = ScatterModel::Off;
    let drr = renderer.render(&quiet, &options).map_err(|error| error.to_string())?;
    let render_ms = watch.ms();
    let watch = Stopwatch::start();
    let mut input = CompareInput::new(&frame, &drr.pages[0]);
    input.valid = Some(&drr.valid);
    input.air = AirLevel::Value(1.0);
    let zncc = compare(&input).map_err(|error| error.to_string()).map(|compared| compared.comparison.scores.zncc);
    let times = format!(
        "register {register_ms:.0} ms, render {render_ms:.0} ms (first {first_render_ms:.0} ms), compare {:.0} ms",
        watch.ms()
    );
    let found = format!(
        "{} of {} beads found, pose {angle_deg:.3} degrees and {across_mm:.3} mm from the one rendered{how}",
        pose.beads.iter().filter(|bead| bead.used).count(),
        layout.beads.len()
    );
    Ok(match zncc {
        Ok(Some(zncc)) if zncc >= LEAST_ZNCC => Finding::pass(CHECK, format!("{found}, ZNCC {zncc:.3}; {times}")),
        Ok(zncc) => {
            let value = zncc.map_or("absent".to_owned(), |zncc| format!("{zncc:.3}"));
            let remedy = "check photons_per_pixel and tube_kvp of the scene: the frames would be mostly noise";
            Finding::warn(CHECK, format!("{found}, but its ZNCC with the matched DRR is {value}; {times}"), remedy)
        }
        Err(reason) => Finding::warn(
            CHECK,
            format!("{found}, but not compared: {reason}; {times}"),
            "check that the CT covers the field of view",
        ),
    })
}

fn refused(pose: &Pose) -> Finding {
    let reason = pose.reason.clone().unwrap_or_else(|| "no reason given".to_owned());
    let remedy = "check the beads against the scene, photons_per_pixel, and the calibration's pitch and distances";
    Finding::fail(CHECK, format!("the scene's beads gave no pose: {reason}"), remedy)
}
