//! The whole chain on a real pelvis CT, where the data are at hand: render with noise, register the rendered frame, compare.

use std::path::{Path, PathBuf};

use glam::{DMat3, DQuat, DVec3};
use sidecarm::acquire::{Domain, Frame, read_frame};
use sidecarm::beads::{Bead, BeadLayout, Landmark};
use sidecarm::compare::{CompareInput, Compared, compare};
use sidecarm::geometry::{CarmCalibration, CarmJoints, Rigid, View};
use sidecarm::gpu::DeviceChoice;
use sidecarm::image::write_png_rgb;
use sidecarm::pose::{Pose, Prior, Registration, register};
use sidecarm::render::{Options, Quantity, Renderer};
use sidecarm::report::{PairMarks, Standing, StripInput, score_words, strip};
use sidecarm::reporter::Reporter;
use sidecarm::scene::{self, Scene, model::Matter, model::Noise};

const RADIUS_MM: f64 = 0.75;
/// Around the left hip.
const HALF_BOX_MM: DVec3 = DVec3::new(48.0, 40.0, 34.0);

fn data(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data").join(name);
    if path.exists() {
        return Some(path);
    }
    println!("skipped: {} is not here", path.display());
    None
}

/// Bone voxels with air or soft tissue beside them, in a box around `centre`.
fn bone_surface(scene: &Scene, centre: DVec3) -> Vec<DVec3> {
    let Matter::Volume(volume) = &scene.objects[0].matter else { panic!("the first object is the CT") };
    let bone = |i: usize, j: usize, k: usize| {
        let class = usize::from(volume.class[volume.index(i, j, k)]);
        class > 0 && scene.materials[volume.class_materials[class - 1]].name == "bone_cortical"
    };
    let mut found = Vec::new();
    for k in 1..volume.size[2] - 1 {
        for j in 1..volume.size[1] - 1 {
            for i in 1..volume.size[0] - 1 {
                let p = volume.lps_from_voxel.transform_point3(DVec3::new(i as f64, j as f64, k as f64));
                if bone(i, j, k) && !bone(i, j - 1, k) && (p - centre).abs().cmple(HALF_BOX_MM).all() {
                    found.push(p);
                }
            }
        }
    }
    found
}

/// Eight points of `surface` far from each other.
fn spread(surface: &[DVec3]) -> Vec<DVec3> {
    let mut chosen = vec![surface[0]];
    while chosen.len() < 8 {
        let clearance = |p: &DVec3| chosen.iter().map(|q| p.distance(*q)).fold(f64::INFINITY, f64::min);
        let next = surface.iter().max_by(|a, b| clearance(a).total_cmp(&clearance(b))).expect("not empty");
        chosen.push(*next);
    }
    chosen
}

fn scene_json(ct: &Path, beads: &[DVec3], lps_from_base: &Rigid) -> String {
    let model = Path::new(env!("CARGO_MANIFEST_DIR")).join("calibration/robot/cdm.json");
    let mut objects = vec![
        serde_json::json!({"ct": {"path": ct, "materials": "threshold"}}),
        serde_json::json!({"robot": {"model": model, "lps_from_base": lps_from_base, "control_angles_deg": [1.0, 2.0, 2.0, 1.0, 0.5]}}),
    ];
    for bead in beads {
        objects.push(serde_json::json!({"sphere": {"centre_lps_mm": bead, "radius_mm": RADIUS_MM, "material": "steel_316l"}}));
    }
    serde_json::json!({
        "objects": objects,
        "beam": {"tube_kvp": 120, "anode_angle_deg": 12, "filtration_mm": {"aluminium": 4.3}, "photons_per_pixel": 5e5},
        "detector": {"response": "energy", "pitch_mm": 0.388},
        "model": {"formation": "deepdrr", "scatter": "off", "noise": true, "seed": 1}
    })
    .to_string()
}

/// A noisy frame of the pelvis, the pose of its beads, and the comparison with the DRR at that pose.
struct Taken {
    frame: Frame,
    pose: Pose,
    scene: Scene,
    compared: Compared,
    /// From where it was taken: by its pose, and really.
    seen: View,
    truth: View,
    centre: DVec3,
}

/// The pelvis from two sides; `None` (said) where it is not.
fn taken() -> Option<Vec<Taken>> {
    let folder = data("ct-pelvis")?;
    let reporter = Reporter::silent();
    let ct = std::fs::canonicalize(folder.join("ct.nii.gz")).expect("exists");
    let here = Path::new("pelvis.json");
    let bare = scene::load_text(&scene_json(&ct, &[], &Rigid::IDENTITY), here, false, &reporter).expect("loads");
    let Matter::Volume(volume) = &bare.objects[0].matter else { panic!("the first object is the CT") };
    // A point in the left hip joint's region: a quarter to the left of the middle, low in the scan.
    let fraction = DVec3::new(0.28, 0.5, 0.3);
    let index = fraction * DVec3::from_array(volume.size.map(|n| n as f64));
    let centre = volume.lps_from_voxel.transform_point3(index);
    let beads = spread(&bone_surface(&bare, centre));
    let lps_from_base = Rigid { rotation: DQuat::from_rotation_y(1.2), translation_mm: beads[0] + DVec3::new(-30.0, -6.0, 4.0) };
    let full = scene::load_text(&scene_json(&ct, &beads, &lps_from_base), here, false, &reporter).expect("loads");
    let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("calibration/carm/live-620x480.json"));
    let carm: CarmCalibration = serde_json::from_str(&text.expect("shipped")).expect("valid");
    let supine = DQuat::from_mat3(&DMat3::from_cols(DVec3::X, -DVec3::Z, DVec3::Y));
    let world_from_lps = Rigid { rotation: supine, translation_mm: DVec3::new(800.0, 0.0, 1000.0) - supine * centre };
    let layout = BeadLayout {
        beads: (0..)
            .zip(&beads)
            .map(|(i, p)| Bead { radius_mm: Some(RADIUS_MM), sigma_mm: Some(0.0), ..Bead::new(format!("B{i}"), *p) })
            .collect(),
        source: "test".to_owned(),
        ..BeadLayout::none()
    };
    let mut renderer = Renderer::new(DeviceChoice::Cpu, &reporter).expect("CPU");
    let mut found = Vec::new();
    for (orbital_deg, angulation_deg) in [(-20.0f64, 5.0f64), (25.0, -10.0)] {
        let joints = CarmJoints {
            orbital_rad: orbital_deg.to_radians(),
            angulation_rad: angulation_deg.to_radians(),
            source_to_detector_mm: 1020.0,
            ..CarmJoints::ZERO
        };
        let camera_from_lps = carm.world_from_camera(&joints).expect("measured").inverse() * world_from_lps;
        let intrinsics = carm.intrinsics(&joints).expect("measured");
        let view = View { size_px: [620, 480], intrinsics, camera_from_lps };
        let scene = full.with_view(view);
        let rendered =
            renderer.render(&scene, &Options { quantity: Quantity::Intensity, ..Options::default() }).expect("renders");
        let frame = Frame::from_pixels("pelvis", rendered.pages[0].clone(), Domain::Linear).expect("finite");
        let off = Rigid::exp(DVec3::new(0.03, -0.02, 0.02), DVec3::new(4.0, -5.0, 6.0)) * camera_from_lps;
        let prior = Prior { camera_from_lps: off, covariance: None };
        let pose = register(
            &Registration {
                intrinsics: Some(intrinsics),
                pitch_mm: Some(0.388),
                prior: Some(&prior),
                landmarks: &[Landmark { name: "left hip".to_owned(), lps_mm: centre }],
                ..Registration::new(frame.size_px.map(|n| n as u32), &layout)
            },
            &frame,
        );
        assert!(pose.is_accepted(), "{orbital_deg}/{angulation_deg}: {:?}", pose.reason);
        let (intrinsics, camera_from_lps) = pose.intrinsics.zip(pose.camera_from_lps).expect("accepted");
        let seen = View { size_px: view.size_px, intrinsics, camera_from_lps };
        let mut quiet = full.with_view(seen);
        quiet.model.noise = Noise::Off;
        let clean =
            renderer.render(&quiet, &Options { quantity: Quantity::LineIntegral, ..Options::default() }).expect("renders");
        let mut input = CompareInput::new(&frame, &clean.pages[0]);
        input.valid = Some(&clean.valid);
        (input.view, input.centre_lps_mm) = (Some(&seen), Some(centre));
        let compared = compare(&input).expect("compares");
        found.push(Taken { frame, pose, scene, compared, seen, truth: view, centre });
    }
    Some(found)
}

#[test]
fn a_noisy_pelvis_frame_gives_its_projection_back() {
    let Some(taken) = taken() else { return };
    assert_eq!(taken.len(), 2);
    for (index, Taken { pose, compared, truth, centre, .. }) in taken.iter().enumerate() {
        let (found, truth) = (pose.projection.expect("accepted"), truth.projection());
        let landmarks = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z, -DVec3::X, -DVec3::Z].map(|d| *centre + 25.0 * d);
        let shift = |p: &DVec3| found.project(*p).0.distance(truth.project(*p).0);
        let mean_px = landmarks.iter().map(shift).sum::<f64>() / landmarks.len() as f64;
        println!("pelvis, side {}: mean over landmarks {mean_px:.3} px, rms {:?} px", index + 1, pose.rms_px);
        assert!(mean_px < 0.1, "{mean_px} px");
        let zncc = compared.comparison.scores.zncc.expect("scored");
        assert!(zncc > 0.99, "{zncc}");
    }
}

/// The strip of the first side as a session would draw it: `docs/strip-pelvis.png`.
#[test]
#[ignore = "makes a picture: scripts/evaluate gallery runs it"]
fn strip_of_the_pelvis() {
    let Some(taken) = taken() else { return };
    let Taken { frame, pose, scene, compared, seen, .. } = &taken[0];
    let comparison = &compared.comparison;
    let status = format!("rms {:.3} px ({:.3} mm)", pose.rms_px.expect("accepted"), pose.rms_mm.expect("accepted"));
    let picture = strip(&StripInput {
        acquired: frame,
        pictures: Some(&*compared.pictures),
        masks: None,
        without: None,
        marks: Some(&PairMarks::of(pose, None, Some(seen), Some(scene))),
        standing: Standing::Accepted,
        status: &status,
        scores: &score_words(&comparison.scores, &comparison.null),
        mm_per_px: comparison.mm_per_px,
    });
    let folder = std::env::var("SIDECARM_OUT").unwrap_or_else(|_| concat!(env!("CARGO_MANIFEST_DIR"), "/docs").to_owned());
    let path = Path::new(&folder).join("strip-pelvis.png");
    write_png_rgb(&path, &picture).expect("written");
    println!("written: {}", path.display());
}

#[test]
fn real_fluoroscopy_is_display_and_is_refused() {
    let Some(folder) = data("fluoroscopy-hip") else { return };
    let layout = BeadLayout {
        beads: (0..8)
            .map(|i| {
                let at =
                    DVec3::new(f64::from(i % 2) * 80.0 - 40.0, f64::from(i / 2 % 2) * 70.0 - 35.0, f64::from(i) * 9.0 - 30.0);
                Bead { radius_mm: Some(RADIUS_MM), ..Bead::new(format!("B{i}"), at) }
            })
            .collect(),
        source: "test".to_owned(),
        ..BeadLayout::none()
    };
    let frame = read_frame(&folder.join("frame-04.dcm"), None).expect("reads");
    assert_eq!(frame.domain, Domain::Display);
    let pose = register(&Registration::new(frame.size_px.map(|n| n as u32), &layout), &frame);
    assert!(!pose.is_accepted() && pose.reason.as_ref().is_some_and(|reason| !reason.is_empty()), "{:?}", pose.rms_px);
}
