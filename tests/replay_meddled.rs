//! A log in which someone changed what a replay makes again, rewritten with right checksums: each change is seen, and nothing else is.
#![cfg(unix)]

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::Value;
use sidecarm::record::topic;

use crate::log_lab::{entries, recorded, replay};

/// Rewrites `log` to `out`; `change` alters a message of a topic, or leaves it out (false).
pub fn meddled(log: &Path, out: &Path, change: &mut dyn FnMut(&str, &mut Vec<u8>) -> bool) {
    let bytes = std::fs::read(log).expect("log");
    let mut writer = mcap::Writer::new(std::fs::File::create(out).expect("file")).expect("a log");
    for message in mcap::MessageStream::new(&bytes).expect("a log") {
        let mut message = message.expect("a whole log");
        let mut data = message.data.into_owned();
        if change(&message.channel.topic, &mut data) {
            message.data = data.into();
            writer.write(&message).expect("written");
        }
    }
    writer.finish().expect("finished");
}

fn length(answer: &Value, key: &str) -> usize {
    answer[key].as_array().map_or(usize::MAX, Vec::len)
}

/// Before a score that is put to another one.
const SCORE: &str = "\"gradient_ncc\":0.";

/// Puts the digit behind the first occurrence of `key` to another one.
fn another_digit(data: &mut [u8], key: &str) {
    let at = data.windows(key.len()).position(|window| window == key.as_bytes()).expect("the key is there") + key.len();
    let at = at + data[at..].iter().position(u8::is_ascii_digit).expect("a number");
    data[at] = if data[at] == b'1' { b'2' } else { b'1' };
}

/// The frame of whose scores this tells, where that is accepted and has the score.
fn accepted(data: &[u8]) -> Option<u64> {
    let pair: Value = serde_json::from_slice(data).expect("JSON");
    let has_score = data.windows(SCORE.len()).any(|window| window == SCORE.as_bytes());
    pair["number"].as_u64().filter(|_| has_score && pair["status"] == "accepted")
}

fn lost(answer: &Value, words: &str) -> bool {
    answer["losses"].to_string().contains(words)
}

/// How many losses are of messages that cannot be understood.
fn malformed(answer: &Value) -> usize {
    let losses = answer["losses"].as_array().into_iter().flatten().filter_map(Value::as_str);
    losses.filter(|loss| loss.starts_with("1 message is malformed and was skipped: /pose, message ")).count()
}

/// Alters a message of a topic, the how-manieth; false leaves it out.
type Change<'a> = &'a mut dyn FnMut(&str, usize, &mut Vec<u8>) -> bool;

/// What a replay says of `log` with `change` in messages of `topics`: where there is one that something differs or is lost, and never poses or
/// pictures.
fn altered(log: &Path, kit: &Path, path: &Path, topics: &[&str], change: Change<'_>) -> Value {
    let mut seen: BTreeMap<String, usize> = BTreeMap::new();
    meddled(log, path, &mut |topic, data| {
        let count = seen.entry(topic.to_owned()).or_default();
        *count += 1;
        !topics.contains(&topic) || change(topic, *count - 1, data)
    });
    for topic in topics {
        assert!(seen.get(*topic).is_some_and(|count| *count > 1), "{topic}: {seen:?}");
    }
    let (code, answer) = replay(path, kit, &path.with_extension("replayed"));
    assert_eq!(code, Some(if topics.is_empty() { 0 } else { 3 }), "{topics:?}: {answer:#}");
    let different = ["poses_different", "images_different"].map(|key| length(&answer, key));
    assert_eq!(different, [0, 0], "{topics:?}: {answer:#}");
    answer
}

/// Of a session that lost nothing. Changes that the answer tells apart are made in one log.
#[test]
fn what_is_changed_in_a_log_is_seen_and_nothing_else() {
    let Some(session) = recorded() else { return };
    let (log, folder) = (&session.logs[1], tempfile::tempdir().expect("a folder"));
    let kit = &session.kit;
    let at = |name: &str| folder.path().join(format!("{name}.mcap"));

    // The control.
    let nothing = altered(log, kit, &at("nothing"), &[], &mut |_, _, _| true);
    assert!(length(&nothing, "losses") == 0 && nothing["scores_identical"].as_u64() >= Some(2), "{nothing:#}");

    let good: Vec<u64> =
        entries(log).iter().filter(|entry| &*entry.topic == topic::SCORES).filter_map(|entry| accepted(&entry.data)).collect();
    let (Some(first), Some(last)) = (good.iter().min(), good.iter().max()) else { panic!("no frame is accepted: {nothing:#}") };
    assert!(first < last, "two frames are accepted: {good:?}");
    let scores = altered(log, kit, &at("scores"), &["/scores"], &mut |_, _, data| {
        match accepted(data) {
            Some(number) if number == *first => another_digit(data, SCORE),
            Some(number) if number == *last => {
                *data = String::from_utf8_lossy(data).replace("\"accepted\"", "\"refused\"").into_bytes();
            }
            _ => {}
        }
        true
    });
    assert_eq!(length(&scores, "scores_different"), 2, "a score and a status: {scores:#}");

    let joints = altered(log, kit, &at("joints"), &["/carm/joints"], &mut |_, nth, data| {
        if nth % 10 == 0 {
            another_digit(data, "orbital_deg\":");
        }
        true
    });
    assert!(joints["samples_different"].as_u64() > Some(5), "{joints:#}");

    let left_out = ["/robot/joints", "/frames/drr", "/frames/drr_sha256"];
    let left_out = altered(log, kit, &at("left-out"), &left_out, &mut |topic, nth, _| {
        // A DRR whose hash is gone is taken for that of the next hash where it is not followed by a DRR.
        let which = if topic == "/robot/joints" { 100 } else { usize::from(topic == "/frames/drr_sha256") };
        nth != which
    });
    assert_eq!(left_out["samples_different"], 1, "{left_out:#}");
    assert!(lost(&left_out, "gone from the log; its hash is there"), "a DRR: {left_out:#}");
    assert!(lost(&left_out, "is gone from the log; its plan is there"), "a DRR's hash: {left_out:#}");

    let mut is_cut = false;
    let pose = altered(log, kit, &at("pose"), &["/pose"], &mut |_, _, data| {
        let pose: Value = serde_json::from_slice(data).expect("JSON");
        if pose["number"] == *last && !is_cut {
            data.truncate(data.len() / 2);
            is_cut = true;
        }
        true
    });
    // Once by itself, and once as what the DRR beside it was made with; all other poses are the same.
    let (identical, frames) = (pose["poses_identical"].as_u64(), pose["frames"].as_u64());
    let went_on = identical.zip(frames).is_some_and(|(identical, frames)| frames >= 3 && identical + 1 >= frames);
    assert!(went_on && malformed(&pose) == 1, "{pose:#}");
    assert_eq!(length(&pose, "losses") + length(&pose, "not_in_log"), 2, "{pose:#}");
}
