//! The reference senders of `senders/`: whatever they are written in, their frames are the golden ones, byte for byte, and are read here.

use std::path::{Path, PathBuf};
use std::process::Command;

use sidecarm::telemetry::{DeviceKind, Sample};

use crate::telemetry_frames::{GOLDEN_CARM, GOLDEN_METADATA, GOLDEN_ROBOT, bytes, decode, frame};

fn senders() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("senders")
}

/// Name and bytes of each golden frame.
fn golden() -> Vec<(String, Vec<u8>)> {
    let text = std::fs::read_to_string(senders().join("golden.txt")).expect("the golden frames");
    let pair = |line: &str| line.split_once(' ').map(|(name, hex)| (name.to_owned(), bytes(hex))).expect("name and digits");
    text.lines().map(pair).collect()
}

/// What a program writes; `None` (said) where it is not on this machine.
fn written(command: &mut Command) -> Option<String> {
    let program = command.get_program().to_string_lossy().into_owned();
    match command.output() {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            println!("skipped: {program} is not on this machine");
            None
        }
        Err(error) => panic!("{program}: {error}"),
        Ok(output) => {
            let words = String::from_utf8_lossy(&output.stderr);
            assert!(output.status.success() && words.is_empty(), "{program}: {words}");
            Some(String::from_utf8(output.stdout).expect("text"))
        }
    }
}

fn assert_golden(sender: &str, text: &str) {
    let golden = std::fs::read_to_string(senders().join("golden.txt")).expect("the golden frames");
    assert!(golden.lines().count() >= 6);
    for (found, expected) in text.lines().zip(golden.lines()) {
        assert_eq!(found, expected, "{sender}");
    }
    assert_eq!(text, golden, "{sender}: another number of frames");
}

/// The golden frames are those that `mocks/PROTOCOL.md` prints, and those that a third sender makes of the same values.
#[test]
fn the_golden_frames_are_the_protocol_s() {
    let golden = golden();
    let of = |name: &str| golden.iter().find(|(known, _)| known == name).map(|(_, frame)| frame.clone()).expect(name);
    for (name, hex) in [("robot", GOLDEN_ROBOT), ("carm", GOLDEN_CARM), ("metadata", GOLDEN_METADATA)] {
        assert_eq!(of(name), bytes(hex), "{name}");
        let protocol = include_str!("../mocks/PROTOCOL.md");
        assert!(protocol.contains(hex), "{name}");
    }
    let floats = |count: usize, value: f32| value.to_le_bytes().repeat(count);
    let unmeasured =
        [floats(5, 0.0), floats(13, f32::NAN), f64::NAN.to_le_bytes().repeat(7), floats(1, f32::NAN), vec![5, 0, 0, 0]];
    assert_eq!(of("robot_unmeasured"), frame(1, 1, 0, 0, 0, &unmeasured.concat()));
    let dark = [vec![0; 76], floats(4, f32::NAN), vec![255; 4], vec![3, 0, 0, 0]];
    assert_eq!(of("carm_dark"), frame(1, 2, 0, u32::MAX, u64::MAX, &dark.concat()));
    let text = |letter: u8, count: u8| [&[count][..], &vec![letter; usize::from(count)]].concat();
    let head = [&[1, 0, 0, 0][..], &sidecarm::telemetry::SCHEMA_HASH.to_le_bytes()].concat();
    let long = [head, text(b'S', 100), text(b'f', 100), text(b'c', 60), b"\x06mm,deg".to_vec()].concat();
    assert_eq!(of("metadata_long"), frame(1, 3, 0, 7, 1, &long));
}

#[test]
fn the_golden_frames_are_read() {
    let mut read = 0;
    for (name, frame) in golden() {
        let device = if name.starts_with("carm") || name == "metadata" { DeviceKind::Carm } else { DeviceKind::Robot };
        let (events, decoder) = decode(device, &[&[0][..], &frame[..]].concat(), 16);
        assert_eq!((events.len(), decoder.health().frames), (1, 1), "{name}: {events:?}");
        let sidecarm::telemetry::Event::Sample(sample, _) = &events[0] else { panic!("{name}: {events:?}") };
        match sample {
            Sample::Robot(robot) if name == "robot_unmeasured" => {
                assert_eq!((robot.sensed_deg, robot.tracker_from_base, robot.status), (None, None, 5));
                assert!(robot.drill_rpm.is_nan() && robot.tendons[1].tension_n.is_nan());
            }
            Sample::Carm(carm) if name == "carm_dark" => {
                assert_eq!(
                    (carm.exposure_counter, carm.xray_on, carm.sequence, carm.device_us),
                    (None, false, u32::MAX, u64::MAX)
                );
            }
            Sample::Metadata(metadata) if name == "metadata_long" => {
                assert_eq!((metadata.serial_number.len(), metadata.calibration_id.as_str()), (100, &*"c".repeat(60)));
            }
            Sample::Robot(_) | Sample::Carm(_) | Sample::Metadata(_) => assert!(["robot", "carm", "metadata"].contains(&&*name)),
        }
        read += 1;
    }
    assert_eq!(read, 6);
}

#[test]
fn the_sender_in_c_sends_the_golden_frames() {
    let folder = tempfile::tempdir().expect("a folder");
    let program = folder.path().join("golden");
    let sources = ["golden.c", "sidecarm_wire.c"].map(|name| senders().join("c").join(name));
    let strict = ["-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion", "-o"];
    if written(Command::new("cc").args(strict).arg(&program).args(&sources)).is_none() {
        return;
    }
    assert_golden("C", &written(&mut Command::new(&program)).expect("it was just made"));
    // No allocation: nothing of the library asks for memory.
    let source = std::fs::read_to_string(&sources[1]).expect("the source");
    for word in ["malloc", "calloc", "realloc", "alloca", "free("] {
        assert!(!source.contains(word), "{word}");
    }
}

#[test]
fn the_sender_in_python_sends_the_golden_frames() {
    let script = senders().join("python/golden.py");
    if let Some(text) = written(Command::new("python3").arg("-B").arg(script)) {
        assert_golden("Python", &text);
    }
}
