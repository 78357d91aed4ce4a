//! What a robot's line, and a device's status, say against the session: through `check`, and at each exposure through `live`.
#![cfg(unix)]

use glam::{DQuat, DVec3};
use serde_json::json as value;
use sidecarm::geometry::{Rigid, RobotModel};
use sidecarm::reporter::Reporter;
use sidecarm::scene::Scene;
use sidecarm::session::crosscheck::{Level, LineWatch, Listened, check_listened, check_session};
use sidecarm::session::file::Setup;
use sidecarm::telemetry::{CarmSample, RobotSample, Sample, Tendon};

use crate::crosscheck_facts::{calibration, sample, scene, setup};
use crate::crosscheck_live::live;
use crate::crosscheck_session::{Mock, check, check_unrehearsed, copy, edit, take_ct_away};
use crate::session_demo::mock_is_built;

/// A box of water with the robot beside its middle; `base_mm` is where the scene has the base.
fn scene_json(base_mm: [f64; 3]) -> String {
    let [x, y, z] = base_mm;
    value!({
        "objects": [
            {"box": {"centre_lps_mm": [0, 0, 0], "size_mm": [100, 80, 60], "material": "water"}},
            {"robot": {"model": concat!(env!("CARGO_MANIFEST_DIR"), "/calibration/robot/cdm.json"),
                       "lps_from_base": [[1, 0, 0, x], [0, 1, 0, y], [0, 0, 1, z], [0, 0, 0, 1]]}}
        ],
        "beam": {"tube_kvp": 90, "filtration_mm": {"aluminium": 4.3}}, "detector": {"pitch_mm": 0.388}
    })
    .to_string()
}

fn robot(device_us: u64) -> RobotSample {
    let tendon = Tendon { position_mm: 0.0, velocity_mm_per_s: 0.0, tension_n: 1.0, current_a: 0.1 };
    RobotSample {
        device_us,
        sequence: 0,
        commanded_deg: [1.0, 2.0, 0.5, -1.0, 0.0],
        sensed_deg: Some([1.1, 1.9, 0.5, -1.0, 0.1]),
        tendons: [tendon; 2],
        tracker_from_base: None,
        drill_rpm: 0.0,
        status: 0,
    }
}

/// The room: the specimen stands on its feet at (800, 0, 1000); the tracker looks at it from the wall.
fn in_room() -> [Rigid; 2] {
    let world_from_lps = Rigid { rotation: DQuat::from_rotation_x(1.2), translation_mm: DVec3::new(800.0, 0.0, 1000.0) };
    let world_from_tracker = Rigid { rotation: DQuat::from_rotation_z(-0.7), translation_mm: DVec3::new(-900.0, 1200.0, 1700.0) };
    [world_from_lps, world_from_tracker]
}

/// What `check` says of a robot that said `change` for a second, each as `check: sentence`.
fn listened(change: impl Fn(&mut RobotSample), session: impl FnOnce(&mut Setup)) -> Vec<String> {
    let text = scene_json([0.0, 0.0, 30.0]);
    let (mut setup, scene) = (setup(&text, calibration()), scene(&text));
    session(&mut setup);
    let mut heard = Listened::default();
    for device_us in [0, 500_000, 1_000_000] {
        let mut sample = robot(device_us);
        change(&mut sample);
        heard.take(&Sample::Robot(sample));
    }
    found(&setup, &scene, &heard)
}

fn found(setup: &Setup, scene: &Scene, heard: &Listened) -> Vec<String> {
    let findings = check_listened(setup, Some(scene), heard);
    assert!(findings.iter().all(|finding| finding.level == Level::Warn && finding.remedy.is_some()), "{findings:?}");
    findings.iter().map(ToString::to_string).collect()
}

fn is_said(found: &[String], words: &[&str]) -> bool {
    found.len() == 1 && words.iter().all(|word| found[0].contains(word))
}

#[test]
fn a_robot_that_cannot_be_as_it_says_is_named_and_an_ordinary_one_is_silent() {
    assert_eq!(listened(|_| (), |_| ()), Vec::<String>::new());
    type Change = fn(&mut RobotSample);
    let cases: [(Change, &[&str]); 7] = [
        (|r| r.status = 0b10, &["robot status", "emergency stop", "clear it"]),
        (|r| r.status = 0b1_0000_0100, &["robot status", "homing, status bit 8"]),
        // Half a turn a notch: an angle that is not one of a notch, or radians of something else.
        (
            |r| (r.commanded_deg, r.sensed_deg) = ([0.0, 0.0, 30.0, 0.0, 0.0], Some([0.0, 0.0, 30.0, 0.0, 0.0])),
            &["robot bend", "notches", "clamped to 7.9 degrees", "30.0"],
        ),
        (|r| r.sensed_deg = Some([1.1, 1.9, -2.0, -1.0, 0.1]), &["robot angles", "-2.5 degrees", "control point 3"]),
        (|r| r.sensed_deg = None, &["robot angles", "drawn as commanded"]),
        (|r| r.sensed_deg = Some([1.1, f64::NAN, 0.5, -1.0, 0.1]), &["robot angles", "not all five"]),
        (|r| (r.commanded_deg, r.sensed_deg) = ([f64::NAN; 5], None), &["robot angles", "no control angles"]),
    ];
    for (change, words) in cases {
        let found = listened(change, |_| ());
        assert!(is_said(&found, words), "{words:?}: {found:?}");
    }
    // Behind its command while it moves: that is how it moves.
    let moving = |r: &mut RobotSample| r.commanded_deg[0] += 4.0 + 2.0 * r.device_us as f64 * 1e-6;
    assert_eq!(listened(moving, |_| ()), Vec::<String>::new());
}

/// A fault that comes and goes while the port is listened to is one.
#[test]
fn a_status_bit_of_any_sample_is_said() {
    let text = scene_json([0.0, 0.0, 30.0]);
    let (setup, scene) = (setup(&text, calibration()), scene(&text));
    let said = |words: [u32; 3]| {
        let mut heard = Listened::default();
        words.into_iter().for_each(|status| heard.take(&Sample::Carm(CarmSample { status, ..sample() })));
        found(&setup, &scene, &heard)
    };
    assert_eq!(said([0; 3]), Vec::<String>::new());
    let found = said([0, 0b1, 0]);
    assert!(is_said(&found, &["C-arm status", "the C-arm reports fault", "clear it at the arm"]), "{found:?}");
}

#[test]
fn a_beam_that_the_scene_does_not_have_is_named_before_the_first_exposure() {
    let text = scene_json([0.0, 0.0, 30.0]);
    let (setup, scene) = (setup(&text, calibration()), scene(&text));
    let said = |change: fn(&mut CarmSample)| {
        let mut idle = CarmSample { xray_on: false, ..sample() };
        change(&mut idle);
        let mut heard = Listened::default();
        heard.take(&Sample::Carm(idle));
        found(&setup, &scene, &heard)
    };
    assert_eq!(said(|_| ()), Vec::<String>::new());
    let unmeasured: fn(&mut CarmSample) = |s| {
        (s.tube_kvp, s.filter_mm_al, s.filter_mm_cu) = (f64::NAN, f64::NAN, f64::NAN);
        s.joints.source_to_detector_mm = f64::NAN;
    };
    assert_eq!(said(unmeasured), Vec::<String>::new());
    type Change = fn(&mut CarmSample);
    let cases: [(Change, &[&str]); 6] = [
        (|s| s.filter_mm_cu = 0.3, &["filter", "0.30 mm of copper", "renders 0.00"]),
        (|s| s.filter_mm_al = 0.0, &["filter", "0.00 mm of aluminium", "renders 4.30"]),
        (|s| s.filter_mm_al = -1.5, &["filter", "-1.50 mm of aluminium", "expected 0 to 30"]),
        (|s| s.tube_kvp = 0.0, &["kVp", "0.00 kVp", "expected 20 to 160", "as NaN"]),
        (|s| s.joints.source_to_detector_mm = 980.0, &["SID", "980 mm", "the calibration 1020 mm", "telemetry's is used"]),
        (|s| s.joints.source_to_detector_mm = 1.02, &["SID", "metres", "the calibration's 1020 mm are used"]),
    ];
    for (change, words) in cases {
        let mut heard = Listened::default();
        let mut idle = CarmSample { xray_on: false, ..sample() };
        change(&mut idle);
        heard.take(&Sample::Carm(idle));
        let found: Vec<String> = check_listened(&setup, Some(&scene), &heard).iter().map(ToString::to_string).collect();
        assert!(found.iter().any(|sentence| words.iter().all(|word| sentence.contains(word))), "{words:?}: {found:?}");
    }
}

#[test]
fn a_tracked_base_is_held_against_the_session_and_the_scene() {
    let [world_from_lps, world_from_tracker] = in_room();
    let tied = |setup: &mut Setup| {
        setup.session.world_from_lps = Some(world_from_lps.to_rows());
        setup.session.world_from_tracker = Some(world_from_tracker.to_rows());
    };
    let lps_from_base = Rigid { rotation: DQuat::from_rotation_y(0.4), translation_mm: DVec3::new(20.0, -10.0, 40.0) };
    let right = world_from_tracker.inverse() * world_from_lps * lps_from_base;
    let at = |base: Rigid| move |r: &mut RobotSample| r.tracker_from_base = Some(base);
    let scaled = |base: Rigid, factor: f64| Rigid { translation_mm: factor * base.translation_mm, ..base };
    assert_eq!(listened(at(right), tied), Vec::<String>::new());
    // Neither a tracker nor a place for one: an ordinary session. A place that is not known yet is none to judge by.
    let only_tracker = |setup: &mut Setup| setup.session.world_from_tracker = Some(world_from_tracker.to_rows());
    assert_eq!(listened(at(scaled(right, 1e-3)), only_tracker), Vec::<String>::new());

    let untied = listened(at(right), |_| ());
    assert!(
        is_said(&untied, &["robot base", "no world_from_tracker", "at the scene's base", "give world_from_tracker"]),
        "{untied:?}"
    );
    let unseen = listened(|_| (), only_tracker);
    assert!(is_said(&unseen, &["robot base", "has world_from_tracker", "not tracked"]), "{unseen:?}");
    let zero = listened(at(Rigid::IDENTITY), tied);
    assert!(is_said(&zero, &["robot base", "exactly at the tracker's origin"]), "{zero:?}");

    let metres = listened(at(scaled(right, 1e-3)), tied);
    assert!(is_said(&metres, &["robot base", "mm from all else", "fits if it is in metres"]), "{metres:?}");
    let moved = Rigid { translation_mm: right.translation_mm + DVec3::new(0.0, 0.0, 400.0), ..right };
    let far = listened(at(moved), tied);
    assert!(is_said(&far, &["robot base", "the tracker puts the robot", "check world_from_tracker"]), "{far:?}");
    let inverted = |setup: &mut Setup| {
        tied(setup);
        setup.session.world_from_tracker = Some(world_from_tracker.inverse().to_rows());
    };
    let inverse = listened(at(right), inverted);
    assert!(is_said(&inverse, &["the inverse of world_from_tracker"]), "{inverse:?}");
    let in_metres = |setup: &mut Setup| {
        tied(setup);
        setup.session.world_from_tracker = Some(scaled(world_from_tracker, 1e-3).to_rows());
    };
    let short = listened(at(right), in_metres);
    assert!(is_said(&short, &["world_from_tracker is in metres"]), "{short:?}");
}

/// Every replay of a redacted log said that the session's robot is not the scene's: a redacted log has no origins.
#[test]
fn the_robot_is_the_one_that_the_scene_draws_whoever_measured_it() {
    let text = scene_json([0.0, 0.0, 30.0]);
    let levels = |change: fn(&mut RobotModel)| {
        let mut setup = setup(&text, calibration());
        change(setup.robot.as_mut().expect("a robot"));
        let found = check_session(&setup, &scene(&text), None);
        found.iter().filter(|finding| finding.check == "robot").map(|finding| finding.level).collect::<Vec<_>>()
    };
    assert_eq!(levels(|_| ()), [Level::Pass]);
    assert_eq!(levels(|model| "removed".clone_into(&mut model.origin)), [Level::Pass]);
    assert_eq!(levels(|model| model.max_bend_deg += 0.1), [Level::Warn], "the control");
}

#[test]
fn a_scene_that_puts_the_robot_far_from_the_specimen_says_so() {
    let said = |base_mm: [f64; 3], tracked: bool| {
        let text = scene_json(base_mm);
        let mut setup = setup(&text, calibration());
        setup.session.world_from_tracker = tracked.then(|| in_room()[1].to_rows());
        let found = check_session(&setup, &scene(&text), None);
        found.iter().filter(|finding| finding.check == "robot base").map(ToString::to_string).collect::<Vec<_>>()
    };
    assert_eq!(said([0.0, 0.0, 30.0], false), Vec::<String>::new());
    assert_eq!(said([190.0, 0.0, 0.0], false), Vec::<String>::new());
    let far = said([0.0, -600.0, 0.0], false);
    // The box ends at -40; the robot, 35 mm long along y and bent, at -566.
    assert!(is_said(&far, &["lps_from_base puts the robot 52", " mm from all else", "in millimetres"]), "{far:?}");
    assert_eq!(said([0.0, -600.0, 0.0], true), Vec::<String>::new(), "the tracker will tell");
}

/// Angles that were no longer sensed, and a base that the tracker had lost, changed the drawn robot without a word.
#[test]
fn what_the_robot_s_line_stops_telling_is_said_once_per_ending() {
    let text = scene_json([0.0, 0.0, 30.0]);
    let mut setup = setup(&text, calibration());
    setup.session.world_from_tracker = Some(in_room()[1].to_rows());
    let (reporter, mut watch) = (Reporter::silent(), LineWatch::default());
    let mut say = |from_ms: u64, to_ms: u64, sensed: bool, tracked: bool| {
        for ms in (from_ms..to_ms).step_by(10) {
            let mut sample = robot(1000 * ms);
            sample.sensed_deg = sample.sensed_deg.filter(|_| sensed);
            sample.tracker_from_base = tracked.then_some(in_room()[1]);
            watch.take(&setup, &Sample::Robot(sample), &reporter);
        }
        reporter.warnings().into_iter().map(|(kind, counted)| (kind, counted.count)).collect::<Vec<_>>()
    };
    assert_eq!(say(0, 1000, true, true), []);
    assert_eq!(say(1000, 1300, false, false), [], "a blink");
    assert_eq!(say(1300, 2000, true, true), []);
    let lost = ("check: robot base lost".to_owned(), 1);
    assert_eq!(say(2000, 4000, true, false), std::slice::from_ref(&lost));
    assert_eq!(say(4000, 6000, false, true), [("check: robot angles".to_owned(), 1), lost]);
    say(6000, 7000, true, true);
    assert_eq!(say(7000, 9000, false, false).iter().map(|(_, count)| count).sum::<u64>(), 4, "again");
}

#[test]
fn check_says_what_odd_devices_say() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let odd = ["--duration-s", "60", "--exposures", "1", "--faults", "none", "--start-delay-s", "0", "--odd"];
    let odd = [&odd[..], &["carm-stopped,copper,robot-homing,tracked,apart"]].concat();
    let mock = Mock::start(folder.path(), &odd);
    let (rows, code) = check(&copy(&mock.lab, "odd"));
    assert_eq!(code, 0, "they are warnings: {rows:#?}");
    let warned = |rows: &[(String, String, String)], name: &str, words: &[&str]| {
        let row = rows.iter().find(|row| row.0 == name && row.1 == "warn");
        let row = row.unwrap_or_else(|| panic!("no '{name}' in {rows:#?}"));
        assert!(words.iter().all(|word| row.2.contains(word)) && !row.2.ends_with("→ "), "{}", row.2);
    };
    warned(&rows, "C-arm status", &["emergency stop, status bit 5"]);
    warned(&rows, "robot status", &["homing"]);
    warned(&rows, "filter", &["0.30 mm of copper"]);
    warned(&rows, "robot angles", &["-3.0 degrees"]);
    warned(&rows, "robot base", &["no world_from_tracker"]);
    // With the tracker in the room's origin, the base is where it is in the tracker: half a metre above the specimen.
    let far = copy(&mock.lab, "far");
    let identity = value!([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]);
    edit(&far, "session.json", |session| session["world_from_tracker"] = identity);
    let (rows, _) = check_unrehearsed(&far);
    warned(&rows, "robot base", &["the tracker puts the robot", "mm from all else"]);
}

/// Through `live`: a tracker that nobody tied to the room, angles that are no longer sensed, a robot that sways while the beam is on.
#[test]
fn a_robot_that_is_drawn_otherwise_than_it_may_be_is_said_in_each_pair() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let (pairs, report, words) = live(folder.path(), &["--odd", "tracked,sensed-at-first,apart,swaying"], take_ct_away);
    let cautions: Vec<String> = pairs.iter().map(|pair| pair["robot_cautions"].to_string()).collect();
    assert!(cautions.iter().all(|said| said.contains("no world_from_tracker")), "{cautions:#?}");
    assert!(cautions.iter().all(|said| said.contains("the robot bent by ")), "{cautions:#?}");
    let (sensed, commanded): (Vec<_>, Vec<_>) =
        pairs.iter().zip(&cautions).partition(|(pair, _)| pair["robot_source"] == "sensed");
    assert!(!sensed.is_empty() && !commanded.is_empty(), "{cautions:#?}");
    assert!(sensed.iter().all(|(_, said)| said.contains("sensed -3.") || said.contains("sensed -2.")), "{cautions:#?}");
    assert!(commanded.iter().all(|(_, said)| said.contains("commanded angles")), "{cautions:#?}");
    for said in ["does not sense its angles any more", "give world_from_tracker", "let the robot come to rest", "home the robot"]
    {
        assert!(words.contains(said), "'{said}' is not in {words}");
    }
    assert!(report.contains("robot drawn at the scene's base"));
}

#[test]
fn a_base_that_the_tracker_loses_is_said_and_drawn_where_the_scene_has_it() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let (pairs, _, words) = live(folder.path(), &["--odd", "tracked-at-first"], |lab| {
        take_ct_away(lab);
        let identity = value!([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]);
        edit(lab, "session.json", |session| session["world_from_tracker"] = identity);
    });
    let lost = |pair: &serde_json::Value| pair["robot_cautions"].to_string().contains("the tracker did not see it");
    let (without, with): (Vec<_>, Vec<_>) = pairs.iter().partition(|pair| lost(pair));
    assert!(!without.is_empty() && !with.is_empty(), "{pairs:#?}");
    assert!(with.iter().all(|pair| pair["robot_cautions"].is_null()), "{with:#?}");
    assert!(words.contains("base is not tracked any more") && words.contains("clear the tracker's view"), "{words}");
}
