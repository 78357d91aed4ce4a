//! Two replays of one log on machines of another speed: whatever they make is the same, byte for byte, but for how long it took.
#![cfg(all(unix, debug_assertions))]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use sidecarm::record::{read_log, topic};

use crate::acquire_identity::written;
use crate::live_lab::{HANG_S, Live, copies, deliver, eventually, quiet_lab};
use crate::session_names::replay;

const FRAMES: usize = 3;
/// How many times as slow the second machine is.
const SLOWER: f64 = 3.0;

/// Where a build with debug assertions keeps what this machine costs.
fn costs(cache: &Path) -> PathBuf {
    cache.join("sidecarm/costs-debug.json")
}

/// Multiplies every number of nanoseconds or milliseconds, and says that they were measured often enough to be believed for an hour.
fn slower(costs: &Value) -> Value {
    let mut costs = costs.clone();
    costs["rounds"] = json!(10);
    let mut changed = 0;
    for (key, value) in costs.as_object_mut().expect("a map") {
        if !key.ends_with("_ns") && !key.ends_with("_ms") {
            continue;
        }
        let numbers = match value {
            Value::Array(list) => list.iter_mut().collect(),
            number => vec![number],
        };
        for number in numbers {
            *number = json!(SLOWER * number.as_f64().expect("a number"));
            changed += 1;
        }
    }
    assert!(changed > 15, "{changed} costs: {costs}");
    costs
}

/// Files that a replay wrote, by their place below its folder, and what its plans were predicted to take.
type Made = (BTreeMap<String, Vec<u8>>, Vec<f64>);

fn made(out: &Path) -> Made {
    let below = format!("{}/", out.display());
    let files = written(out).into_iter().filter_map(|(name, bytes)| Some((name.strip_prefix(&below)?.to_owned(), bytes)));
    let mut files: BTreeMap<String, Vec<u8>> = files.collect();
    let timings: Value = serde_json::from_slice(&files.remove("timings.json").expect("times")).expect("JSON");
    let predicted = timings["frames"].as_array().expect("a list").iter().filter_map(|frame| frame["predicted_ms"].as_f64());
    (files, predicted.collect())
}

/// A killed session's log has no plans: replays make them anew, with costs that are measured now and then. They stood beside every DRR.
#[test]
fn two_replays_of_a_killed_log_are_byte_identical_whatever_the_machines_cost() {
    let Some((lab, frame, folder)) = quiet_lab("300") else { return };
    let lab = lab.without_ct();
    let files = copies(&frame, FRAMES, &folder.path().join("copies"));
    // Who would plan dies with the first frame.
    let mut live = Live::breaking(&lab.kit.join("session.json"), &folder.path().join("session"), "workshop:1").recording();
    let log = live.log.clone();
    let count = |of: &str| read_log(&log).expect("the log opens").entries.iter().filter(|entry| &*entry.topic == of).count();
    for posed in [1, FRAMES] {
        deliver(&files[count(topic::POSE)..posed], &lab);
        let are_posed = eventually(HANG_S, || (count(topic::POSE) == posed).then_some(()));
        assert!(are_posed.is_some(), "{} of {posed} poses: {}", count(topic::POSE), live.stderr());
    }
    live.kill();
    assert_eq!((count(topic::PLAN), count("/session/end")), (0, 0), "the log of a session that was killed before any DRR");

    let mut results = Vec::new();
    for name in ["one", "two"] {
        let cache = folder.path().join(format!("{name}-cache"));
        std::fs::create_dir_all(costs(&cache).parent().expect("a folder")).expect("a folder");
        if name == "two" {
            let measured = std::fs::read(costs(&folder.path().join("one-cache"))).expect("the first replay measured costs");
            let measured: Value = serde_json::from_slice(&measured).expect("JSON");
            std::fs::write(costs(&cache), slower(&measured).to_string()).expect("written");
        }
        let out = folder.path().join(name);
        let (code, words) = replay(&log, Some(&lab.kit), &cache, &out);
        assert_eq!(code, Some(3), "a log without its end: {words}");
        results.push(made(&out));
    }
    let results: [Made; 2] = results.try_into().expect("two replays");
    let [(one, fast_ms), (two, slow_ms)] = results;
    // A GPU's plans predict nothing.
    let is_cpu = String::from_utf8_lossy(&one["drr/001.tif.json"]).contains("\"executor\": \"cpu\"");
    let plans = if is_cpu { FRAMES } else { 0 };
    assert_eq!((fast_ms.len(), slow_ms.len()), (plans, plans), "each DRR had a plan");
    for (fast, slow) in fast_ms.iter().zip(&slow_ms) {
        assert!(slow / fast > 0.5 * (1.0 + SLOWER), "control: costs were others: {fast} and {slow} ms");
    }
    assert_eq!(one.keys().collect::<Vec<_>>(), two.keys().collect::<Vec<_>>());
    assert!(one.len() >= 3 * FRAMES + 2, "{:?}", one.keys());
    let differ: Vec<&String> = one.iter().filter(|(name, bytes)| two[*name] != **bytes).map(|(name, _)| name).collect();
    assert!(differ.is_empty(), "{differ:?}");
}
