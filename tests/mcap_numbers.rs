//! The numbers of a session's log in other hands: the file read by the `mcap` crate, joints, tree and annotations decoded by Foxglove's own
//! types, and compared with what the packets on the line say by `mocks/PROTOCOL.md`, and with the poses by hand.
#![cfg(unix)]

use std::collections::BTreeMap;

use foxglove::Decode;
use foxglove::messages as fg;
use serde_json::Value;

use crate::session_demo::demo;

/// What rounding leaves.
const LIMIT: f64 = 1e-9;
/// What is left of pixels where a projection is done anew.
const LIMIT_PX: f64 = 1e-6;

/// All messages of the demo's log, in the order of the file; `None` (said) where mock-lab was not built.
fn messages() -> Option<Vec<mcap::Message<'static>>> {
    let (lab, _) = demo()?;
    let bytes = std::fs::read(lab.join("session/session.mcap")).expect("a log");
    let stream = mcap::MessageStream::new(&bytes).expect("an MCAP file");
    Some(stream.map(|message| message.expect("whole")).collect())
}

fn of<'a>(messages: &'a [mcap::Message<'static>], topic: &str) -> Vec<&'a mcap::Message<'static>> {
    let found: Vec<_> = messages.iter().filter(|message| message.channel.topic == topic).collect();
    assert!(!found.is_empty(), "nothing on {topic}");
    found
}

/// A message of Foxglove's, as its channel says that it is one.
fn decoded<M: Decode>(message: &mcap::Message, name: &str) -> M {
    let schema = message.channel.schema.as_ref().expect("a schema");
    let said = (schema.name.as_str(), schema.encoding.as_str(), message.channel.message_encoding.as_str());
    assert_eq!(said, (format!("foxglove.{name}").as_str(), "protobuf", "protobuf"));
    M::decode(&*message.data).expect("a message of Foxglove's")
}

fn is_of_its_time(stamp: Option<fg::Timestamp>, message: &mcap::Message) -> bool {
    stamp.is_some_and(|stamp| stamp.total_nanos() == message.log_time)
}

/// A frame without its delimiter, COBS taken off (Cheshire and Baker 1999): each code says how far on the next zero was.
fn unstuffed(frame: &[u8]) -> Option<Vec<u8>> {
    let (mut packet, mut at) = (Vec::new(), 0);
    while at < frame.len() {
        let code = usize::from(frame[at]);
        packet.extend_from_slice(frame.get(at + 1..at + code)?);
        at += code;
        if code < 255 && at < frame.len() {
            packet.push(0);
        }
    }
    Some(packet)
}

/// Packets with this message number and payload that stand in what came over a line.
fn packets(raw: &[&mcap::Message], number: u8, payload: usize) -> Vec<Vec<u8>> {
    // Four bytes that count the openings of the line stand before those of each read.
    let bytes: Vec<u8> = raw.iter().flat_map(|message| message.data[4..].iter().copied()).collect();
    let frames = bytes.split(|byte| *byte == 0).filter(|frame| !frame.is_empty());
    frames.filter_map(unstuffed).filter(|packet| packet.len() == 16 + payload + 4 && packet[1] == number).collect()
}

fn f64_at(packet: &[u8], at: usize) -> f64 {
    f64::from_le_bytes(packet[16 + at..][..8].try_into().expect("eight bytes"))
}

fn f32_at(packet: &[u8], at: usize) -> f64 {
    f64::from(f32::from_le_bytes(packet[16 + at..][..4].try_into().expect("four bytes")))
}

/// Whether two lists say the same; what is not measured has no position.
fn is_same(told: &fg::JointStates, values: &[f64]) -> bool {
    let same = |(joint, value): (&fg::JointState, &f64)| match joint.position {
        Some(position) => (position - value).abs() < LIMIT,
        None => value.is_nan(),
    };
    told.joints.len() == values.len() && told.joints.iter().zip(values).all(same)
}

/// Of each message on `topic`: names, time, and that a packet had these values. How many messages there are.
fn joints_are_those_of(messages: &[mcap::Message<'static>], topic: &str, names: &[&str], sent: &[Vec<f64>]) -> usize {
    assert!(sent.len() > 20, "{} packets on the line of {topic}", sent.len());
    let told = of(messages, topic);
    for message in &told {
        let states: fg::JointStates = decoded(message, "JointStates");
        assert!(states.joints.iter().map(|joint| joint.name.as_str()).eq(names.iter().copied()), "{:?}", states.joints);
        assert!(is_of_its_time(states.timestamp, message), "{:?} {}", states.timestamp, message.log_time);
        assert!(sent.iter().any(|values| is_same(&states, values)), "no packet said so on {topic}: {states:?}");
    }
    told.len()
}

/// Names alone were looked at: angles in degrees or lengths in millimetres would have passed.
#[test]
fn joints_are_those_of_the_packets_in_metres_and_radians() {
    let Some(messages) = messages() else { return };
    let arm: Vec<[f64; 7]> = packets(&of(&messages, "/carm/raw"), 2, 100)
        .iter()
        .map(|packet| std::array::from_fn(|joint| f64_at(packet, 8 * joint)))
        .collect();
    let names = ["lift", "wig_wag", "longitudinal", "angulation", "orbital", "detector_rotation", "source_to_detector"];
    // Lift, longitudinal and the distance to the detector are lengths.
    let of_foxglove = |joint: usize, value: f64| if [0, 2, 6].contains(&joint) { value / 1e3 } else { value.to_radians() };
    let converted =
        |joints: &[f64; 7]| -> Vec<f64> { joints.iter().enumerate().map(|(joint, value)| of_foxglove(joint, *value)).collect() };
    let sent: Vec<Vec<f64>> = arm.iter().map(converted).collect();
    let arms = joints_are_those_of(&messages, "/carm/joint_states", &names, &sent);
    let as_sent: Vec<Vec<f64>> = arm.iter().map(|joints| joints.to_vec()).collect();
    let states: Vec<fg::JointStates> =
        of(&messages, "/carm/joint_states").into_iter().map(|message| decoded(message, "JointStates")).collect();
    assert!(!states.iter().any(|states| as_sent.iter().any(|values| is_same(states, values))), "control: not in mm and degrees");

    let robot: Vec<Vec<f64>> = packets(&of(&messages, "/robot/raw"), 1, 136)
        .iter()
        .map(|packet| {
            let [commanded, sensed] = [0, 20].map(|from| (0..5).map(|n| f32_at(packet, from + 4 * n)).collect::<Vec<f64>>());
            let is_sensed = packet[2] & 1 == 1 && sensed.iter().all(|angle| angle.is_finite());
            let angles = if is_sensed { sensed } else { commanded };
            angles.into_iter().map(f64::to_radians).collect()
        })
        .collect();
    let names = ["control_1", "control_2", "control_3", "control_4", "control_5"];
    let robots = joints_are_those_of(&messages, "/robot/joint_states", &names, &robot);
    // Ten a second of each are told.
    assert!(arms > 10 && robots > 10, "{arms} of the arm, {robots} of the robot");
}

/// The last pose before each message of a topic, where both are of one time and the pose is that of beads.
fn with_poses<'a>(messages: &'a [mcap::Message<'static>], topic: &str) -> Vec<(&'a mcap::Message<'static>, Value)> {
    let (mut latest, mut found) = (BTreeMap::new(), Vec::new());
    for message in messages {
        match &*message.channel.topic {
            "/pose" => {
                let pose: Value = serde_json::from_slice(&message.data).expect("JSON");
                latest.insert(message.log_time, pose);
            }
            own if own == topic => {
                let pose = latest.get(&message.log_time).filter(|pose| pose["pose_source"] == "beads");
                found.extend(pose.map(|pose| (message, pose.clone())));
            }
            _ => {}
        }
    }
    found
}

fn numbers<const N: usize>(value: &Value) -> [f64; N] {
    let list = value.as_array().unwrap_or_else(|| panic!("no list: {value}"));
    assert_eq!(list.len(), N, "{value}");
    std::array::from_fn(|n| list[n].as_f64().expect("a number"))
}

fn dot(row: &[f64], [x, y, z]: [f64; 3]) -> f64 {
    row[0] * x + row[1] * y + row[2] * z
}

/// Foxglove counts from the corner of the first pixel: beads are marked half a pixel on from where the pose has them, and where P puts them.
#[test]
fn annotations_stand_where_the_pose_sees_and_puts_its_beads() {
    let Some(messages) = messages() else { return };
    let (mut marked, mut frames) = (0, 0);
    for (message, pose) in with_poses(&messages, "/camera/annotations") {
        let drawn: fg::ImageAnnotations = decoded(message, "ImageAnnotations");
        assert!(is_of_its_time(drawn.timestamp, message));
        let circle_at = |[u, v]: [f64; 2], is_green: bool| {
            let there = drawn.circles.iter().filter(|circle| {
                let at = circle.position.as_ref().expect("a place");
                let colour = circle.outline_color.as_ref().expect("a colour");
                (at.x - u).hypot(at.y - v) < LIMIT_PX && (colour.g > colour.r) == is_green
            });
            there.count()
        };
        let rows: [[f64; 4]; 3] = std::array::from_fn(|row| numbers(&pose["projection"][row]));
        let (mut seen, mut put) = (0, 0);
        for bead in pose["pose"]["beads"].as_array().expect("beads") {
            let lps_mm = numbers(&bead["lps_mm"]);
            let [u, v, depth] = rows.map(|row| dot(&row[..3], lps_mm) + row[3]);
            let (u, v) = (u / depth, v / depth);
            assert!(depth > 0.0);
            assert_eq!(circle_at([u + 0.5, v + 0.5], false), 1, "{}", bead["name"]);
            assert_eq!(circle_at([u, v], false), 0, "control: our own pixels");
            let is_named = |text: &&fg::TextAnnotation| bead["name"] == text.text.as_str();
            let label = drawn.texts.iter().find(is_named).and_then(|text| text.position.as_ref()).expect("its name");
            assert!((label.x - u).hypot(label.y - v) < 40.0, "{label:?} {u} {v}");
            put += 1;
            if bead["image_px"].is_array() {
                let [u, v] = numbers(&bead["image_px"]);
                assert_eq!(circle_at([u + 0.5, v + 0.5], true), 1, "{}", bead["name"]);
                seen += 1;
            }
        }
        assert_eq!((drawn.circles.len(), drawn.texts.len()), (seen + put, put));
        (marked, frames) = (marked + seen, frames + 1);
    }
    assert!(frames >= 5 && marked >= 5 * frames, "{marked} beads in {frames} frames");
}

/// `x' = x + 2 w (q × x) + 2 q × (q × x)`.
fn turned(quaternion: &fg::Quaternion, x: [f64; 3]) -> [f64; 3] {
    let cross = |a: [f64; 3], b: [f64; 3]| [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    let axis = [quaternion.x, quaternion.y, quaternion.z];
    let once = cross(axis, x);
    let twice = cross(axis, once);
    std::array::from_fn(|n| x[n] + 2.0 * quaternion.w * once[n] + 2.0 * twice[n])
}

/// The specimen in the camera is the pose, in metres and as a quaternion; the whole tree is walked by `mcap_tree.rs`.
#[test]
fn the_specimen_stands_before_the_camera_as_its_pose_says() {
    let Some(messages) = messages() else { return };
    let mut checked = 0;
    for (message, pose) in with_poses(&messages, "/tf") {
        let tree: fg::FrameTransforms = decoded(message, "FrameTransforms");
        let Some(lps) = tree.transforms.iter().find(|placed| placed.child_frame_id == "lps") else { continue };
        assert_eq!(lps.parent_frame_id, "camera");
        assert!(is_of_its_time(lps.timestamp, message));
        let at = lps.translation.as_ref().expect("a place");
        let turn = lps.rotation.as_ref().expect("a turn");
        let rows: [[f64; 4]; 4] = std::array::from_fn(|row| numbers(&pose["camera_from_lps"][row]));
        for point in [[0.0; 3], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]] {
            // A decimetre, in millimetres for our rows.
            let expected_mm: [f64; 3] =
                std::array::from_fn(|n| dot(&rows[n][..3], point.map(|metres| 1e3 * metres)) + rows[n][3]);
            let told = turned(turn, point);
            let told_mm = [told[0] + at.x, told[1] + at.y, told[2] + at.z].map(|metres| 1e3 * metres);
            let off_mm = (0..3).map(|n| (told_mm[n] - expected_mm[n]).abs()).fold(0.0, f64::max);
            assert!(off_mm < 1e-6, "{point:?}: {told_mm:?} {expected_mm:?}");
        }
        assert!(1e3 * at.z > 100.0, "control: in front of the camera, and not its inverse");
        checked += 1;
    }
    assert!(checked >= 3, "{checked} poses in the tree");
}
