//! One exposure and one line against what is known besides: each disagreement is named, agreement is silent.

use std::path::Path;

use glam::{DQuat, DVec3};
use sidecarm::acquire::{Domain, Frame};
use sidecarm::geometry::{CarmCalibration, CarmJoints, Rigid};
use sidecarm::image::Image;
use sidecarm::pose::IntrinsicsFile;
use sidecarm::report::Innovation;
use sidecarm::reporter::Reporter;
use sidecarm::scene::{self, Scene};
use sidecarm::session::crosscheck::{
    ExposureFacts, Finding, Level, LineWatch, check_exposure, check_line, check_session, innovation,
};
use sidecarm::session::file::Setup;
use sidecarm::telemetry::{CarmSample, DeviceKind, Limit, Metadata, Sample};

const SCENE: &str = r#"{"objects": [{"box": {"centre_lps_mm": [0, 0, 0], "size_mm": [100, 80, 60], "material": "water"}}],
    "beam": {"tube_kvp": 90, "filtration_mm": {"aluminium": 4.3}}, "detector": {"pitch_mm": 0.388}}"#;

pub fn scene(text: &str) -> Scene {
    scene::load_text(text, Path::new("scene.json"), false, &Reporter::silent()).expect("loads")
}

pub fn calibration() -> CarmCalibration {
    serde_json::from_value(serde_json::json!({
        "origin": "test", "columns_px": 62, "rows_px": 48, "pitch_mm": 0.388, "source_to_isocentre_mm": 630.0,
        "source_to_detector_mm": 1020.0, "column_to_isocentre_mm": [800.0, 0.0, 1000.0]
    }))
    .expect("valid")
}

fn frame() -> Frame {
    let pixels = (0..62 * 48).map(|n| 100.0 + (n % 17) as f32).collect();
    let mut frame =
        Frame::from_pixels("frame", Image::from_pixels(62, 48, pixels).expect("size"), Domain::Linear).expect("finite");
    (frame.tags.kvp, frame.tags.sid_mm, frame.tags.pitch_mm) = (Some(90.0), Some(1020.0), Some([0.388, 0.388]));
    frame
}

pub fn sample() -> CarmSample {
    CarmSample {
        device_us: 0,
        sequence: 0,
        joints: CarmJoints { source_to_detector_mm: 1020.0, ..CarmJoints::ZERO },
        tube_kvp: 90.0,
        tube_ma: 3.0,
        pulse_width_ms: 8.0,
        filter_mm_al: 4.3,
        filter_mm_cu: 0.0,
        field_mm: [-12.028, -9.312, 12.028, 9.312],
        xray_on: true,
        exposure_counter: Some(1),
        status: 0,
    }
}

/// Everything agrees but for what `change` does; the findings.
pub fn exposure(change: impl FnOnce(&mut Frame, &mut CarmSample, &mut Rigid, &mut f64)) -> Vec<Finding> {
    exposure_of(&calibration(), change)
}

pub fn exposure_of(
    carm: &CarmCalibration,
    change: impl FnOnce(&mut Frame, &mut CarmSample, &mut Rigid, &mut f64),
) -> Vec<Finding> {
    told_of(carm, change).0
}

fn told_of(
    carm: &CarmCalibration,
    change: impl FnOnce(&mut Frame, &mut CarmSample, &mut Rigid, &mut f64),
) -> (Vec<Finding>, Option<Innovation>) {
    let (scene, mut frame, mut beam) = (scene(SCENE), frame(), sample());
    let from_beads = Rigid { rotation: DQuat::from_rotation_x(1.5), translation_mm: DVec3::new(2.0, 1.0, 630.0) };
    let (mut nominal, mut shuttered) = (from_beads, 0.0);
    change(&mut frame, &mut beam, &mut nominal, &mut shuttered);
    let facts = ExposureFacts {
        frame: &frame,
        carm: Some(carm),
        scene: &scene,
        scene_json: SCENE,
        beam: Some(&beam),
        from_beads: Some(&from_beads),
        nominal: Some(&nominal),
        centre_lps_mm: Some(DVec3::new(5.0, 5.0, 5.0)),
        shuttered_share: Some(shuttered),
    };
    (check_exposure(&facts), innovation(&facts))
}

/// Three millimetres are nothing for an arm that nobody measured, and a jump for one that is known to 0.3 mm.
#[test]
fn a_measured_arm_tells_a_jump_from_its_usual_error() {
    let measured = CarmCalibration { camera_sigma_mm: Some(0.3), camera_sigma_deg: Some(0.05), ..calibration() };
    assert_eq!(exposure(|_, _, n, _| n.translation_mm.x += 5.0), Vec::new());
    assert_eq!(exposure_of(&measured, |_, _, n, _| n.translation_mm.x += 1.0), Vec::new());
    let found = exposure_of(&measured, |_, _, n, _| n.translation_mm.x += 5.0);
    assert_eq!(found.len(), 1, "{found:?}");
    assert!(found[0].to_string().contains("7 standard deviations"), "{}", found[0]);
}

#[test]
fn the_innovation_is_telemetry_minus_beads_at_the_centroid() {
    let measured = CarmCalibration { camera_sigma_mm: Some(0.3), camera_sigma_deg: Some(0.05), ..calibration() };
    let turn = |n: &mut Rigid| {
        // About the centroid, so that it stays where it is, and then 2 mm up the picture.
        let centre = n.transform_point(DVec3::splat(5.0));
        let turn = Rigid::rotation(DQuat::from_rotation_z(0.5f64.to_radians()));
        *n = Rigid::translation(centre + DVec3::new(0.0, -2.0, 0.0)) * turn * Rigid::translation(-centre) * *n;
    };
    let (_, told) = told_of(&measured, |_, _, n, _| turn(n));
    let told = told.expect("both have a pose");
    let apart: Vec<f64> = told.shift_mm.iter().zip([0.0, -2.0, 0.0]).map(|(found, expected)| (found - expected).abs()).collect();
    assert!(apart.iter().all(|mm| *mm < 1e-9) && (told.turn_deg - 0.5).abs() < 1e-6, "{told:?}");
    // 0.5 degrees over 0.05, √2 for two frames and √3 for three axes, is more than 2 mm over 0.3.
    assert!(told.sigmas.is_some_and(|sigmas| (sigmas - 10.0 / 6f64.sqrt()).abs() < 1e-6), "{told:?}");
    let (_, unmeasured) = told_of(&calibration(), |_, _, n, _| turn(n));
    assert!(unmeasured.is_some_and(|told| told.sigmas.is_none()), "{unmeasured:?}");
}

#[test]
fn an_exposure_in_which_all_agrees_is_silent_and_each_disagreement_is_named() {
    assert_eq!(exposure(|_, _, _, _| ()), Vec::new());
    type Change = fn(&mut Frame, &mut CarmSample, &mut Rigid, &mut f64);
    let cases: [(&str, Change, &[&str]); 13] = [
        ("frame size", |f, _, _, _| f.size_px = [31, 24], &["31 x 24", "62 x 48", "binned 2 x 2"]),
        ("frame size", |f, _, _, _| f.size_px = [48, 62], &["turned it by 90 degrees"]),
        ("pitch", |f, _, _, _| f.tags.pitch_mm = Some([0.194, 0.194]), &["0.194", "0.388"]),
        ("SID", |f, _, _, _| f.tags.sid_mm = Some(740.0), &["740", "1020", "telemetry"]),
        ("SID", |_, b, _, _| b.joints.source_to_detector_mm = 1.02, &["1.02", "metres", "the calibration's 1020 mm are used"]),
        ("kVp", |f, _, _, _| f.tags.kvp = Some(74.0), &["telemetry says 90", "the frame 74"]),
        ("kVp", |f, b, _, _| (f.tags.kvp, b.tube_kvp) = (Some(74.0), f64::NAN), &["of the frame 74", "the scene renders 90"]),
        ("kVp", |_, b, _, _| b.tube_kvp = 0.0, &["0 kVp while the beam is on", "the frame 90", "send NaN"]),
        ("filter", |_, b, _, _| b.filter_mm_cu = 0.2, &["0.20 mm of copper", "the scene renders 0.00"]),
        ("filter", |_, b, _, _| b.filter_mm_al = 6.0, &["6.00 mm of aluminium", "4.30"]),
        ("field", |_, b, _, _| b.field_mm = [-6.0, -9.312, 12.028, 9.312], &["25 % of the frame", "shows 0 %"]),
        ("telemetry and beads", |_, _, n, _| n.translation_mm.z += 93.0, &["+93 mm in depth", "focal length"]),
        ("telemetry and beads", |_, _, n, _| n.translation_mm.x += 40.0, &["40 mm across", "world_from_lps"]),
    ];
    for (check, change, words) in cases {
        let found = exposure(change);
        assert_eq!(found.len(), 1, "{check}: {found:#?}");
        let sentence = found[0].to_string();
        assert!(found[0].check == check && found[0].level == Level::Warn || check == "SID", "{sentence}");
        assert!(words.iter().all(|word| sentence.contains(word)), "{words:?} in {sentence}");
    }
    assert_eq!(
        exposure(|_, b, _, _| (b.field_mm, b.filter_mm_al, b.filter_mm_cu) = ([f64::NAN; 4], f64::NAN, f64::NAN)),
        Vec::new()
    );
    assert_eq!(exposure(|_, _, n, _| n.translation_mm.z = f64::NAN).len(), 1, "a pose that is no number does not agree");
}

pub fn setup(scene_json: &str, carm: CarmCalibration) -> Setup {
    let robot: serde_json::Value = serde_json::from_str(include_str!("../calibration/robot/cdm.json")).expect("a model");
    let mut setup: Setup = serde_json::from_value(serde_json::json!({
        "session": {
            "carm": {"port": "x", "calibration": "x"}, "robot": {"port": "x", "model": "x"}, "frames": {"folder": "x"}, "scene": "x"
        },
        "carm": null, "robot": robot, "scene_json": scene_json, "scene_path": "x", "beads": null
    }))
    .expect("a setup");
    setup.carm = Some(carm);
    setup
}

#[test]
fn a_line_is_held_against_the_session_s_models() {
    let metadata = |device, limits: Vec<[f64; 2]>| Metadata {
        device_us: 0,
        sequence: 0,
        device,
        schema: 0,
        serial_number: String::new(),
        firmware: String::new(),
        calibration_id: String::new(),
        units: "mm,deg".to_owned(),
        limits: limits.into_iter().map(|[min, max]| Limit { min, max }).collect(),
    };
    let setup = setup(SCENE, calibration());
    let scene = scene(SCENE);
    let named = |metadata: &Metadata, sample: &CarmSample| -> Vec<String> {
        check_line(&setup, Some(&scene), Some(metadata), Some(sample)).into_iter().map(|finding| finding.check).collect()
    };
    let robot = metadata(DeviceKind::Robot, vec![[-7.9, 7.9]; 5]);
    let mut arm = metadata(DeviceKind::Carm, vec![[-180.0, 180.0]; 6]);
    arm.limits.push(Limit { min: 900.0, max: 1200.0 });
    assert!(named(&robot, &sample()).is_empty() && named(&arm, &sample()).is_empty());
    assert_eq!(named(&metadata(DeviceKind::Robot, vec![[-9.0, 9.0]; 5]), &sample()), ["robot limits"]);
    arm.limits[6].min = 1100.0;
    assert_eq!(named(&arm, &sample()), ["SID"]);
    assert_eq!(named(&Metadata { units: "m,rad".into(), ..robot.clone() }, &sample()), ["units on the wire"]);
    assert_eq!(named(&robot, &CarmSample { tube_kvp: 120.0, ..sample() }), ["kVp"]);
    assert_eq!(named(&robot, &CarmSample { field_mm: [-120.0, -93.0, 120.0, 93.0], ..sample() }), ["panel size"]);
}

/// What an arm says of its own reach, in mm and degrees.
fn ranges_of_the_arm() -> Sample {
    let ranges = [[0.0, 400.0], [-10.0, 10.0], [0.0, 200.0], [-190.0, 190.0], [-90.0, 90.0], [-180.0, 180.0], [900.0, 1200.0]];
    Sample::Metadata(Metadata {
        device_us: 0,
        sequence: 0,
        device: DeviceKind::Carm,
        schema: 0,
        serial_number: String::new(),
        firmware: String::new(),
        calibration_id: String::new(),
        units: "mm,deg".to_owned(),
        limits: ranges.map(|[min, max]| Limit { min, max }).to_vec(),
    })
}

/// An arm whose encoder has slipped reports what it says itself that it cannot reach; that was taken as it came.
#[test]
fn joints_beyond_the_arm_s_own_ranges_are_told_once() {
    let setup = setup(SCENE, calibration());
    let (reporter, mut watch) = (Reporter::silent(), LineWatch::default());
    let at = |orbital_deg: f64, lift_mm: f64| {
        let joints = CarmJoints { orbital_rad: orbital_deg.to_radians(), lift_mm, ..sample().joints };
        Sample::Carm(CarmSample { joints, ..sample() })
    };
    watch.take(&setup, &at(120.0, 0.0), &reporter);
    assert!(reporter.warnings().is_empty(), "nothing is known of the arm's reach yet");
    watch.take(&setup, &ranges_of_the_arm(), &reporter);
    watch.take(&setup, &at(90.9, f64::NAN), &reporter);
    assert!(reporter.warnings().is_empty(), "{:?}", reporter.warnings());
    (0..3).for_each(|_| watch.take(&setup, &at(120.0, -50.0), &reporter));
    let said = format!("{:?}", reporter.warnings());
    assert!(said.contains("orbital_deg 120.0") && said.contains("lift_mm -50.0"), "{said}");
    assert_eq!(reporter.warnings().values().map(|warning| warning.count).sum::<u64>(), 2, "{said}");
}

/// Whole turns are none: an arm that counts from 0 to 360 was told to home an encoder that was right.
#[test]
fn angles_are_held_against_the_arm_s_ranges_whichever_turn_they_are_counted_in() {
    let setup = setup(SCENE, calibration());
    let (reporter, mut watch) = (Reporter::silent(), LineWatch::default());
    watch.take(&setup, &ranges_of_the_arm(), &reporter);
    let mut at = |orbital_deg: f64| {
        let joints = CarmJoints {
            orbital_rad: orbital_deg.to_radians(),
            wig_wag_rad: 360f64.to_radians(),
            angulation_rad: (-358.0f64).to_radians(),
            detector_rotation_rad: 360f64.to_radians(),
            ..sample().joints
        };
        watch.take(&setup, &Sample::Carm(CarmSample { joints, ..sample() }), &reporter);
        format!("{:?}", reporter.warnings())
    };
    for deg in [360.0, 359.0, -275.0, 720.0] {
        let said = at(deg);
        assert!(!said.contains("out of range"), "{deg}: {said}");
    }
    let said = at(480.0);
    assert!(said.contains("orbital_deg 120.0"), "{said}");
}

/// The console had turned the picture, and the words sent people to world_from_lps and the encoders.
#[test]
fn a_picture_that_is_turned_by_quarters_is_the_console_s_first() {
    let turned = |about: DVec3, deg: f64| {
        exposure(|_, _, n, _| {
            let centre = n.transform_point(DVec3::splat(5.0));
            let turn = Rigid::rotation(DQuat::from_scaled_axis(about * deg.to_radians()));
            *n = Rigid::translation(centre) * turn * Rigid::translation(-centre) * *n;
        })
    };
    for (deg, said) in
        [(180.0, "turned by 180 degrees at the console"), (-90.0, "turned by 90 degrees"), (268.0, "turned by 90 degrees")]
    {
        let found = turned(DVec3::Z, deg);
        let sentence = found.first().map(ToString::to_string).unwrap_or_default();
        let named = sentence.find("rotation_deg").zip(sentence.find("world_from_lps"));
        assert!(found.len() == 1 && sentence.contains(said), "{found:#?}");
        assert!(named.is_some_and(|(console, room)| console < room), "{sentence}");
    }
    let mut cases = 0;
    for (about, deg) in [(DVec3::Z, 30.0), (DVec3::X, 180.0), (DVec3::Y, 90.0), (DVec3::Z, 100.0)] {
        let found = turned(about, deg);
        assert!(found.len() == 1 && !found[0].to_string().contains("console"), "{about} {deg}: {found:#?}");
        cases += 1;
    }
    assert_eq!(cases, 4);
}

fn stated(f_px: f64, size_px: [u32; 2], pitch_mm: f64) -> Option<IntrinsicsFile> {
    let k = [[f_px, 0.0, 309.5], [0.0, f_px, 239.5], [0.0, 0.0, 1.0]];
    serde_json::from_value(serde_json::json!({"intrinsics": k, "size_px": size_px, "pitch_mm": pitch_mm})).ok()
}

#[test]
fn implausible_calibrations_and_rooms_are_named_and_plausible_ones_pass() {
    let with = |change: fn(&mut CarmCalibration, &mut Setup)| {
        let mut carm = calibration();
        (carm.columns_px, carm.rows_px) = (620, 480);
        let mut setup = setup(SCENE, carm.clone());
        change(&mut carm, &mut setup);
        setup.carm = Some(carm);
        let found = check_session(&setup, &scene(SCENE), None);
        let bad: Vec<String> =
            found.iter().filter(|f| f.level > Level::Pass && f.check != "robot").map(|f| f.to_string()).collect();
        assert!(found.iter().any(|finding| finding.check == "robot"), "the scene has no robot, the session has");
        bad
    };
    assert_eq!(
        with(|_, setup| setup.session.world_from_lps =
            Some([[1.0, 0.0, 0.0, 800.0], [0.0, 0.0, 1.0, 10.0], [0.0, -1.0, 0.0, 990.0], [0.0, 0.0, 0.0, 1.0]])),
        Vec::<String>::new()
    );
    assert_eq!(with(|_, setup| setup.intrinsics = stated(2600.0, [620, 480], 0.388)), Vec::<String>::new());
    type Change = fn(&mut CarmCalibration, &mut Setup);
    let cases: [(Change, &str); 9] = [
        (|_, setup| setup.intrinsics = stated(5000.0, [620, 480], 0.2), "that of the intrinsics 0.2 mm"),
        (|_, setup| setup.intrinsics = stated(260.0, [620, 480], 0.388), "fx times pitch_mm is 100"),
        (|_, setup| setup.intrinsics = stated(2600.0, [640, 480], 0.388), "they are for 640 x 480 px"),
        (|carm, _| carm.source_to_detector_mm = Some(1.02), "source_to_detector_mm is 1.02 mm"),
        (|carm, _| carm.source_to_isocentre_mm = 63.0, "centimetres"),
        (|carm, _| carm.source_to_isocentre_mm = 1100.0, "not behind the isocentre"),
        (|carm, _| carm.source_to_isocentre_mm = f64::NAN, "source_to_isocentre_mm is NaN"),
        (|carm, _| carm.principal_point_px = Some([767.5, 767.5]), "outside the frame"),
        (
            |_, setup| {
                setup.session.world_from_lps =
                    Some([[1.0, 0.0, 0.0, 0.8], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 1.0], [0.0, 0.0, 0.0, 1.0]]);
            },
            "its translation fits if it is in metres",
        ),
    ];
    for (change, words) in cases {
        let found = with(change);
        assert!(found.iter().any(|sentence| sentence.contains(words)), "{words}: {found:?}");
    }
}
