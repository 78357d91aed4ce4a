//! Nulls and frames on the same cores, through `live`: nobody looks at a null while a frame is on its way, and none is lost for that.
//! Registration is slow because it is asked to (`src/session/fault.rs`, which only a build with debug assertions hears).
#![cfg(all(unix, debug_assertions))]

use std::collections::BTreeMap;

use serde_json::Value;
use sidecarm::record::{LogEntry, read_log, topic};

use crate::live_lab::{HANG_S, Live, Signal, deliver, eventually, many_images, quiet_lab};

const FRAMES: usize = 4;
/// A pair and its null are made in less on a machine that does nothing else.
const BREAKS: &str = "slow-register:2500";

/// What a log says of a burst, in its order: frames that came, that were posed, and those of which a null was made.
#[derive(Debug, Default, PartialEq)]
struct Burst {
    came: usize,
    posed: usize,
    /// Nulls that were there before the last frame had its pose.
    early: Vec<u64>,
    /// Of each frame, how many scores were put against a null.
    nulls: BTreeMap<u64, usize>,
    /// All of them had come before the first was posed.
    is_one_burst: bool,
}

impl Burst {
    fn of(entries: &[LogEntry], frames: usize) -> Self {
        let mut burst = Self { is_one_burst: true, ..Self::default() };
        for entry in entries {
            match &*entry.topic {
                topic::FRAME_TAGS => burst.came += 1,
                topic::POSE => {
                    burst.is_one_burst &= burst.came == frames;
                    burst.posed += 1;
                }
                topic::SCORES => {
                    let pair: Value = entry.json().expect("JSON");
                    let number = pair["number"].as_u64().expect("a number");
                    if burst.posed < frames {
                        burst.early.push(number);
                    }
                    burst.nulls.insert(number, pair["null"].as_object().map_or(0, serde_json::Map::len));
                }
                _ => {}
            }
        }
        burst
    }
}

/// The control: a null between two poses of a burst is found.
#[test]
fn a_null_that_is_made_while_a_frame_is_registered_is_seen() {
    let entry = |topic: &str, text: &str| LogEntry {
        topic: topic.into(),
        schema: "".into(),
        encoding: "json".into(),
        host_us: 0,
        sequence: 1,
        data: text.as_bytes().to_vec(),
    };
    let [tags, pose, scores] =
        [(topic::FRAME_TAGS, "{}"), (topic::POSE, "{}"), (topic::SCORES, r#"{"number": 2, "null": {"zncc": 1}}"#)];
    let burst = |order: &[(&str, &str)]| {
        let entries: Vec<LogEntry> = order.iter().map(|(topic, text)| entry(topic, text)).collect();
        let burst = Burst::of(&entries, 2);
        (burst.early.len(), burst.is_one_burst)
    };
    assert_eq!(burst(&[tags, tags, pose, scores, pose]), (1, true));
    assert_eq!(burst(&[tags, tags, pose, pose, scores]), (0, true));
    assert_eq!(burst(&[tags, pose, tags, pose, scores]), (0, false));
}

/// Only frames that waited for their DRR put nulls off: one that was being registered shared the cores with the null of the frame before.
#[test]
fn nulls_wait_for_frames_that_are_on_their_way_and_all_are_made_afterwards() {
    let Some((lab, frame, folder)) = quiet_lab("300") else { return };
    let run = folder.path().join("run.dcm");
    many_images(&frame, FRAMES, &run);
    let mut live = Live::breaking(&lab.kit.join("session.json"), &folder.path().join("session"), BREAKS).recording();
    deliver(&[run], &lab);
    let log = live.log.clone();
    let burst = || Burst::of(&read_log(&log).expect("the log opens").entries, FRAMES);
    let complete = eventually(HANG_S, || (burst().nulls.len() == FRAMES).then_some(()));
    let found = burst();
    assert!(complete.is_some(), "{found:?}: {}", live.stderr());
    live.signalled(Signal::INT);
    let code = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr())).code();
    let words = format!("{found:?}: {} {}", live.stdout(), live.stderr());
    assert!(live.lacks_exposures_alone(code), "{words}");
    assert!(found.is_one_burst, "images of one file came one after the other: {words}");
    assert_eq!((found.came, found.posed, found.early.as_slice()), (FRAMES, FRAMES, &[][..]), "{words}");
    assert!(found.nulls.values().all(|scores| *scores > 0), "a null was left out: {words}");
}
