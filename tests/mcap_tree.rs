//! The frames of a log as Foxglove reads them: its own messages, decoded by its own library, and walked from the room to camera and tip.
#![cfg(unix)]

use std::collections::BTreeMap;
use std::path::Path;

use foxglove::Decode;
use foxglove::messages as fg;
use glam::{DQuat, DVec3};
use serde_json::Value;
use sidecarm::geometry::{CarmCalibration, CarmJoints, Intrinsics, Rigid, RobotModel, View};
use sidecarm::record::{ArmInRoom, LogEntry, Provenance, Recorder, placed_in_room, read_log, topic};

use crate::log_lab::{entries, recorded};

/// What rounding leaves of metres and quaternions.
const LIMIT_MM: f64 = 1e-6;
/// What encoders, and the arm that still moves, leave of where the specimen is taken to lie.
const TIED_MM: f64 = 15.0;
/// The same at the focal spot, where a degree is 12 mm.
const LINK_MM: f64 = 50.0;
/// An arm that has moved more than this between two samples moves.
const MOVED_MM: f64 = 1.0;

fn decoded(entry: &LogEntry) -> fg::FrameTransforms {
    assert_eq!((&*entry.schema, &*entry.encoding), ("foxglove.FrameTransforms", "protobuf"));
    fg::FrameTransforms::decode(entry.data.as_slice()).expect("a message of Foxglove's")
}

/// A frame in its parent.
struct Place {
    parent: String,
    /// Millimetres.
    parent_from_child: Rigid,
    host_us: i64,
}

/// Where each frame was last said to be.
#[derive(Default)]
struct Tree(BTreeMap<String, Place>);

impl Tree {
    /// From now on the frames of `message` are where it says, metres. A frame has one parent, or the tree is none.
    fn take(&mut self, message: &fg::FrameTransforms, host_us: i64) {
        for placed in &message.transforms {
            let at = placed.translation.as_ref().expect("a place");
            let turn = placed.rotation.as_ref().expect("a turn");
            let rotation = DQuat::from_xyzw(turn.x, turn.y, turn.z, turn.w);
            assert!((rotation.length() - 1.0).abs() < 1e-9, "{rotation} of {}", placed.child_frame_id);
            let parent_from_child = Rigid { rotation, translation_mm: 1000.0 * DVec3::new(at.x, at.y, at.z) };
            let (parent, child) = (placed.parent_frame_id.clone(), placed.child_frame_id.clone());
            let before = self.0.insert(child, Place { parent, parent_from_child, host_us });
            let same = before.is_none_or(|before| before.parent == placed.parent_frame_id);
            assert!(same, "two parents of {}", placed.child_frame_id);
        }
    }

    /// Where the specimen lies in the room, if arm, camera and specimen are told of one moment.
    fn world_from_lps(&self) -> Option<Rigid> {
        let [carm, camera, lps] = ["carm", "camera", "lps"].map(|name| self.0.get(name).map(|place| place.host_us));
        self.walk("world", "lps").filter(|_| carm == lps && camera == lps)
    }

    /// `root_from_leaf`, where the leaf hangs on the root.
    fn walk(&self, root: &str, leaf: &str) -> Option<Rigid> {
        let (mut name, mut name_from_leaf) = (leaf, Rigid::IDENTITY);
        // No way is longer than there are frames.
        for _ in 0..=self.0.len() {
            if name == root {
                return Some(name_from_leaf);
            }
            let place = self.0.get(name)?;
            (name, name_from_leaf) = (place.parent.as_str(), place.parent_from_child * name_from_leaf);
        }
        None
    }
}

/// How far apart two motions put points within 100 mm, at most.
fn apart_mm(a: &Rigid, b: &Rigid) -> f64 {
    let points = [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z].map(|point| 100.0 * point);
    points.iter().map(|point| a.transform_point(*point).distance(b.transform_point(*point))).fold(0.0, f64::max)
}

fn read<T: serde::de::DeserializeOwned>(value: &Value) -> T {
    serde_json::from_value(value.clone()).unwrap_or_else(|error| panic!("{error}: {value}"))
}

/// What the log said last on another topic: of the time of `entry`, of which it is made.
fn said(latest: &BTreeMap<&str, &LogEntry>, topic: &str, entry: &LogEntry) -> Value {
    let source = latest.get(topic).unwrap_or_else(|| panic!("{} without {topic}", entry.topic));
    assert_eq!(source.host_us, entry.host_us, "{} is not of the last message on {topic}", entry.topic);
    source.json().expect("JSON")
}

/// What the tree of a session is held against: the files that the log holds, and the mocked room.
struct Truth {
    carm: CarmCalibration,
    robot: RobotModel,
    lps_from_base: Rigid,
    world_from_lps: Rigid,
}

impl Truth {
    fn of(messages: &[LogEntry]) -> Self {
        let setup = messages.iter().find(|entry| &*entry.topic == "/session/setup").expect("a setup");
        let setup: Value = setup.json().expect("JSON");
        let scene: Value = serde_json::from_str(setup["scene_json"].as_str().expect("text")).expect("JSON");
        let robot = scene["objects"].as_array().expect("a list").iter().find_map(|object| object.get("robot")).expect("a robot");
        let lab = Path::new(env!("CARGO_MANIFEST_DIR")).join("mocks/data/lab.json");
        let lab: Value = serde_json::from_slice(&std::fs::read(lab).expect("the lab's data")).expect("JSON");
        Self {
            carm: read(&setup["carm"]),
            robot: read(&setup["robot"]),
            lps_from_base: read(&robot["lps_from_base"]),
            world_from_lps: read(&lab["world_from_lps"]),
        }
    }

    fn check_arm(&self, tree: &Tree, sample: &Value) {
        let joints: CarmJoints = read(&sample["joints"]);
        let by_joints = self.carm.world_from_camera(&joints).expect("joints are measured");
        let told = tree.walk("world", "carm").expect("the arm stands in the room");
        assert!(apart_mm(&told, &by_joints) < LIMIT_MM, "{told:?} {by_joints:?}");
    }

    fn check_specimen(&self, world_from_lps: &Rigid) {
        let off_mm = apart_mm(world_from_lps, &self.world_from_lps);
        assert!(off_mm < TIED_MM, "the specimen in the room: {off_mm} mm");
    }

    /// Each piece and the tip in the specimen, and in the room once the specimen is tied to that; whether it is.
    fn check_robot(&self, tree: &Tree, sample: &Value) -> bool {
        let sensed: Option<[f64; 5]> = serde_json::from_value(sample["sensed_deg"].clone()).ok();
        let shape = self.robot.shape(&sensed.unwrap_or_else(|| read(&sample["commanded_deg"]))).expect("finite");
        let pieces = shape.base_from_pieces.iter().enumerate().map(|(n, (piece, _))| (format!("piece_{n:02}"), *piece));
        let frames = [("base".to_owned(), Rigid::IDENTITY), ("tip".to_owned(), shape.base_from_tip)];
        let mut checked = 0;
        for (name, base_from_frame) in pieces.chain(frames) {
            let told = tree.walk("lps", &name).unwrap_or_else(|| panic!("{name} hangs nowhere"));
            let off_mm = apart_mm(&told, &(self.lps_from_base * base_from_frame));
            assert!(off_mm < LIMIT_MM, "{name}: {off_mm} mm");
            checked += 1;
        }
        assert_eq!(checked, 30, "base, 28 pieces, tip");
        let parents = ["piece_01", "tip"].map(|name| tree.0[name].parent.as_str());
        assert_eq!(parents, ["piece_00", "piece_27"], "each piece in the one before");
        let Some((world_from_lps, world_from_tip)) = tree.world_from_lps().zip(tree.walk("world", "tip")) else {
            return false;
        };
        let lps_from_tip = self.lps_from_base * shape.base_from_tip;
        assert!(apart_mm(&world_from_tip, &(world_from_lps * lps_from_tip)) < LIMIT_MM);
        let off_mm = apart_mm(&world_from_tip, &(self.world_from_lps * lps_from_tip));
        assert!(off_mm < TIED_MM, "the tip in the room: {off_mm} mm");
        true
    }

    /// The camera in the specimen, and in the room once the specimen is tied to that; whether it is.
    fn check_camera(&self, tree: &Tree, pose: &Value) -> bool {
        let camera_from_lps: Rigid = read(&pose["camera_from_lps"]);
        let lps_from_camera = camera_from_lps.inverse();
        let told = tree.walk("camera", "lps").expect("the specimen stands before the camera");
        assert!(apart_mm(&told, &camera_from_lps) < LIMIT_MM, "{told:?} {camera_from_lps:?}");
        assert!(apart_mm(&told, &lps_from_camera) > 100.0, "the control: a child in its parent, not the other way round");
        let Some((world_from_lps, carm_from_camera)) = tree.world_from_lps().zip(tree.walk("carm", "camera")) else {
            return false;
        };
        self.check_specimen(&world_from_lps);
        // Both are of one panel: what the two differ by is what encoders leave.
        let off_mm = apart_mm(&carm_from_camera, &Rigid::IDENTITY);
        assert!(off_mm < LINK_MM, "the camera in the arm: {off_mm} mm");
        true
    }
}

/// Foxglove had a tree of which nobody had looked at more than the names. The specimen is tied to the room by the session's own frames, so its
/// place is that of the mocked room up to what encoders are good for; all else is rounding. It rests there while the arm goes on to the next
/// exposure, though it hangs on the arm's camera.
#[test]
fn the_tree_of_a_session_leads_from_the_room_to_camera_and_tip() {
    let Some(session) = recorded() else { return };
    let (mut arms, mut robots, mut cameras, mut tips, mut rests, mut shifts) = (0, 0, [0, 0], 0, 0, 0);
    for log in &session.logs {
        let mut messages = entries(log);
        // As a viewer takes them; those of one time keep their order.
        messages.sort_by_key(|entry| entry.host_us);
        let truth = Truth::of(&messages);
        let (mut tree, mut latest, mut robot) = (Tree::default(), BTreeMap::new(), Value::Null);
        let mut rested: Option<(Rigid, Rigid)> = None;
        for entry in &messages {
            match &*entry.topic {
                topic::POSE | topic::CARM_JOINTS | topic::ROBOT_JOINTS => {
                    latest.insert(&*entry.topic, entry);
                }
                topic::CARM_TRANSFORMS => {
                    tree.take(&decoded(entry), entry.host_us);
                    truth.check_arm(&tree, &said(&latest, topic::CARM_JOINTS, entry));
                    arms += 1;
                    let now = tree.world_from_lps().zip(tree.walk("world", "carm"));
                    now.iter().for_each(|(world_from_lps, _)| truth.check_specimen(world_from_lps));
                    if let Some(((lps_before, carm_before), (lps, carm))) = rested.zip(now) {
                        let has_moved = apart_mm(&carm_before, &carm) > MOVED_MM;
                        rests += usize::from(has_moved && apart_mm(&lps_before, &lps) < LIMIT_MM);
                        shifts += usize::from(apart_mm(&lps_before, &lps) >= LIMIT_MM);
                    }
                    rested = now;
                }
                topic::ROBOT_TRANSFORMS => {
                    tree.take(&decoded(entry), entry.host_us);
                    robot = said(&latest, topic::ROBOT_JOINTS, entry);
                    truth.check_robot(&tree, &robot);
                    robots += 1;
                }
                topic::TRANSFORMS => {
                    let message = decoded(entry);
                    tree.take(&message, entry.host_us);
                    // Without telemetry of its exposure a frame places nothing, once the camera hangs on the arm.
                    if message.transforms.iter().any(|placed| placed.child_frame_id == "lps") {
                        cameras[usize::from(truth.check_camera(&tree, &said(&latest, topic::POSE, entry)))] += 1;
                    }
                }
                _ => {}
            }
        }
        // A crowded machine may solve its poses when the lines have ended.
        tips += usize::from(truth.check_robot(&tree, &robot));
    }
    println!(
        "{arms} of the arm, {robots} of the robot; {cameras:?} of the camera, untied and tied; {tips} tips in the room; the specimen rests \
         {rests} times while the arm moves, and is put elsewhere {shifts} times"
    );
    assert!(arms > 10 && robots > 10 && cameras[1] > 0 && tips > 0, "{arms} {robots} {cameras:?} {tips}");
    // Frames may tie it anew, once or twice.
    assert!(rests > 0 && shifts < rests, "{rests} {shifts}");
}

/// Numbers by hand: 700 mm are 0.7 m, and arm, camera and specimen of one moment put camera and specimen where they are in the room.
#[test]
fn what_is_recorded_in_millimetres_is_read_in_metres() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("s.mcap");
    let recorder = Recorder::create(&path, &Provenance::of_this_program(1_000, Value::Null)).expect("begun");
    let world_from_lps = Rigid { rotation: DQuat::from_rotation_z(-1.2), translation_mm: DVec3::new(800.0, -20.5, 1000.0) };
    let view = View {
        size_px: [8, 6],
        intrinsics: Intrinsics { fx: 5000.0, fy: 5000.0, skew: 0.0, cx: 3.5, cy: 2.5 },
        camera_from_lps: Rigid { rotation: DQuat::from_rotation_x(0.3), translation_mm: DVec3::new(1.0, 2.0, 600.0) },
    };
    let world_from_carm = Rigid { rotation: DQuat::from_rotation_y(0.4), translation_mm: DVec3::new(700.0, 3.0, 400.0) };
    let arm = ArmInRoom { world_from_carm, world_from_lps: Some(world_from_lps) };
    let placed = placed_in_room(Some(arm), Some(view.camera_from_lps));
    recorder.pose_geometry(&view, placed.as_slice(), &[], 7_000).expect("recorded");
    recorder.finish().expect("finished");
    let log = read_log(&path).expect("readable");
    let entry = log.entries.iter().find(|entry| &*entry.topic == topic::TRANSFORMS).expect("transforms");
    let message = decoded(entry);
    let carm = message.transforms.iter().find(|placed| placed.child_frame_id == "carm").expect("the arm");
    assert_eq!(carm.parent_frame_id, "world");
    assert_eq!(carm.translation, Some(fg::Vector3 { x: 0.7, y: 0.003, z: 0.4 }));
    let mut tree = Tree::default();
    tree.take(&message, 7_000);
    let walked = tree.walk("world", "camera").expect("by way of the arm");
    assert!(apart_mm(&walked, &(world_from_lps * view.camera_from_lps.inverse())) < LIMIT_MM);
    assert!(apart_mm(&tree.world_from_lps().expect("of one moment"), &world_from_lps) < LIMIT_MM);
    assert!(tree.walk("camera", "world").is_none() && tree.walk("world", "tip").is_none(), "the control");
}

/// Nothing stands in for a link that is not known: the part below it stands by itself, under no other parent.
#[test]
fn what_is_not_known_of_the_room_leaves_a_tree_of_two_parts() {
    let somewhere = Rigid::translation(DVec3::new(1.0, 2.0, 3.0));
    let arm = |world_from_lps| ArmInRoom { world_from_carm: somewhere, world_from_lps };
    let links = |arm: Option<ArmInRoom>, camera_from_lps: Option<Rigid>| -> Vec<String> {
        placed_in_room(arm, camera_from_lps).iter().map(|placed| format!("{} {}", placed.parent, placed.child)).collect()
    };
    let whole = links(Some(arm(Some(somewhere))), Some(somewhere));
    assert_eq!(whole, ["world carm", "carm camera", "camera lps"]);
    assert_eq!(links(Some(arm(None)), Some(somewhere)), ["world carm", "camera lps"], "nobody knows where the specimen lies");
    assert_eq!(links(None, Some(somewhere)), ["camera lps"], "no telemetry");
    assert_eq!(links(Some(arm(Some(somewhere))), None), ["world carm"], "no pose");
    assert!(links(None, None).is_empty());
}
