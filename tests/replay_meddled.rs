//! A log in which someone changed what a replay makes again, rewritten with right checksums: each change is seen, and nothing else is.

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

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

/// Exit code and answer of a replay.
fn replayed(log: &Path) -> (Option<i32>, Value) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    let run = command.arg("replay").arg(log).arg("--json").arg("--out").arg(log.with_extension("replayed")).output();
    let run = run.expect("the program starts");
    let answer =
        serde_json::from_slice(&run.stdout).unwrap_or_else(|error| panic!("{error}: {}", String::from_utf8_lossy(&run.stderr)));
    (run.status.code(), answer)
}

fn length(answer: &Value, key: &str) -> usize {
    answer[key].as_array().map_or(usize::MAX, Vec::len)
}

/// A change: its name, what it does to a topic's message the how-manieth, and whether the answer shows it.
type Change = (&'static str, &'static str, fn(usize, &mut Vec<u8>) -> bool, fn(&Value) -> bool);

/// Puts the digit behind the first occurrence of `key` to another one.
fn another_digit(data: &mut [u8], key: &[u8]) {
    let at = data.windows(key.len()).position(|window| window == key).expect("the key is there") + key.len();
    let at = at + data[at..].iter().position(u8::is_ascii_digit).expect("a number");
    data[at] = if data[at] == b'1' { b'2' } else { b'1' };
}

/// Whether these are the scores of that frame, accepted; pairs are finished in any order, and one of the frames is refused.
fn is_accepted(data: &[u8], number: u32) -> bool {
    let pair: Value = serde_json::from_slice(data).expect("JSON");
    pair["number"] == number && pair["status"] == "accepted"
}

fn lost(answer: &Value, words: &str) -> bool {
    answer["losses"].to_string().contains(words)
}

/// How many losses are of messages that cannot be understood.
fn malformed(answer: &Value) -> usize {
    let losses = answer["losses"].as_array().into_iter().flatten().filter_map(Value::as_str);
    losses.filter(|loss| loss.starts_with("1 message is malformed and was skipped: /pose, message ")).count()
}

const CHANGES: [Change; 8] = [
    ("nothing", "", |_, _| true, |answer| length(answer, "losses") == 0 && answer["scores_identical"] != 0),
    (
        "a score",
        "/scores",
        |_, data| {
            if is_accepted(data, 2) {
                another_digit(data, b"\"gradient_ncc\":0.");
            }
            true
        },
        |answer| length(answer, "scores_different") == 1,
    ),
    (
        "a status",
        "/scores",
        |_, data| {
            if is_accepted(data, 2) {
                let text = String::from_utf8_lossy(data).replace("\"accepted\"", "\"refused\"");
                *data = text.into_bytes();
            }
            true
        },
        |answer| length(answer, "scores_different") == 1,
    ),
    (
        "joints",
        "/carm/joints",
        |nth, data| {
            if nth % 10 == 0 {
                another_digit(data, b"orbital_deg\":");
            }
            true
        },
        |answer| answer["samples_different"].as_u64().is_some_and(|count| count > 5),
    ),
    ("a sample left out", "/robot/joints", |nth, _| nth != 100, |answer| answer["samples_different"] == 1),
    ("a DRR left out", "/frames/drr", |nth, _| nth != 1, |answer| lost(answer, "gone from the log; its hash is there")),
    (
        "a DRR's hash left out",
        "/frames/drr_sha256",
        |nth, _| nth != 1,
        |answer| lost(answer, "is gone from the log; its plan is there"),
    ),
    (
        "a pose that is no JSON",
        "/pose",
        |nth, data| {
            if nth == 1 {
                data.truncate(data.len() / 2);
            }
            true
        },
        // Once by itself, and once as what the DRR beside it was made with; all other poses are the same.
        |answer| {
            let (identical, frames) = (answer["poses_identical"].as_u64(), answer["frames"].as_u64());
            let went_on = identical.zip(frames).is_some_and(|(identical, frames)| frames >= 6 && identical + 1 >= frames);
            went_on && malformed(answer) == 1 && length(answer, "losses") + length(answer, "not_in_log") == 2
        },
    ),
];

/// Tries every change on the log of a session that lost nothing.
pub fn every_change_is_seen(log: &Path, folder: &Path) {
    for (name, topic, change, shows) in CHANGES {
        let path: PathBuf = folder.join(format!("{}.mcap", name.replace(' ', "-")));
        let mut seen = 0;
        meddled(log, &path, &mut |of, data| {
            let ours = of == topic;
            seen += usize::from(ours);
            !ours || change(seen - 1, data)
        });
        assert!(topic.is_empty() || seen > 1, "{name}: {seen} messages of {topic}");
        let (code, answer) = replayed(&path);
        let unchanged = topic.is_empty();
        assert_eq!(code, Some(if unchanged { 0 } else { 3 }), "{name}: {answer}");
        assert!(shows(&answer), "{name}: {answer}");
        assert_eq!((length(&answer, "poses_different"), length(&answer, "images_different")), (0, 0), "{name}: {answer}");
    }
}
