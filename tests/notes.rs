//! What persons noted, in a log that is given away.

use std::path::Path;

use serde_json::{Value, json};
use sidecarm::record::{Provenance, Recorder, read_log};
use sidecarm::reporter::Reporter;
use sidecarm::session::logbook::{RedactOptions, redact};

const TOPIC: &str = "/session/notes";
const WORDS: &str = "Quaxwelk coughed";

fn holds_note(log: &Path) -> bool {
    let says_so = |data: &[u8]| data.windows(WORDS.len()).any(|part| part == WORDS.as_bytes());
    read_log(log).expect("readable").entries.iter().any(|entry| &*entry.topic == TOPIC || says_so(&entry.data))
}

#[test]
fn a_log_that_is_given_away_holds_no_note() {
    let folder = tempfile::tempdir().expect("folder");
    let (log, out) = (folder.path().join("session.mcap"), folder.path().join("redacted.mcap"));
    let recorder = Recorder::create(&log, &Provenance::of_this_program(1_000, Value::Null)).expect("begun");
    recorder.json("/session/clock", 2_000, &json!({"host_us": 2_000})).expect("recorded");
    recorder.json(TOPIC, 3_000, &json!({"number": 1, "host_us": 3_000, "words": WORDS})).expect("recorded");
    recorder.finish().expect("finished");
    let report = redact(&log, RedactOptions::default(), &out, &Reporter::silent()).expect("redacted");
    assert_eq!((report.notes, report.unknown_topics.len(), report.losses.len()), (1, 0, 0), "{report:?}");
    assert!(!holds_note(&out));
    assert!(holds_note(&log), "control");
    let kept = read_log(&out).expect("readable").entries;
    assert!(kept.iter().any(|entry| &*entry.topic == "/session/clock"), "all else is kept");
}
