//! Poses that fit and may be another one: a session says so and shows nothing in green.
#![cfg(unix)]

use std::collections::BTreeSet;
use std::path::Path;

use serde_json::{Value, json};
use sidecarm::record::{LogEntry, topic};

use crate::crosscheck_live::live;
use crate::crosscheck_session::edit;
use crate::log_lab::entries;
use crate::scene_support::tell_costs;
use crate::session_demo::mock_is_built;
use crate::session_names::replay;

/// In which order frames are registered, and which of them have an image that disagrees.
const ORDER: &str = "/session/order";
const DISAGREES: &str = "/session/image_disagrees";

/// What a frame says whose pose is telemetry's where the one before it with beads contradicts that.
const ALONE: &str = "the pose is telemetry's alone, and the latest frame with beads contradicts where that has the specimen";

fn number_of(message: &[u8]) -> u64 {
    let value: Value = serde_json::from_slice(message).expect("JSON");
    value["number"].as_u64().expect("a number")
}

/// The numbers in a log's messages of a topic, in their order.
fn numbers(log: &[LogEntry], topic: &str) -> Vec<u64> {
    log.iter().filter(|entry| &*entry.topic == topic).map(|entry| number_of(&entry.data)).collect()
}

/// Frames of which it was not known at some time where the arm stood: their beads may say nothing of where the specimen lies in
/// the room.
fn unbound(log: &[LogEntry]) -> BTreeSet<u64> {
    let poses = log.iter().filter(|entry| &*entry.topic == topic::POSE);
    let unbound = poses.filter(|entry| entry.json::<Value>().expect("JSON")["binding"]["exposure"]["joints"].is_null());
    unbound.map(|entry| number_of(&entry.data)).collect()
}

/// Copies `log` to `out`. That the images of `frames` disagree, and of no others, is heard in this order before `last` is
/// registered, or at the end where there is none.
fn with_disagreements(log: &Path, out: &Path, frames: &[u64], last: Option<u64>) {
    let bytes = std::fs::read(log).expect("the log");
    let messages = mcap::MessageStream::new(&bytes).expect("a log");
    let messages: Vec<mcap::Message> = messages.map(|message| message.expect("a whole log")).collect();
    let one = messages.iter().find(|message| message.channel.topic == DISAGREES).expect("an image disagrees");
    let said = |number: &u64| mcap::Message { data: json!({"number": number}).to_string().into_bytes().into(), ..one.clone() };
    let said: Vec<mcap::Message> = frames.iter().map(said).collect();
    let is_last = |message: &mcap::Message| message.channel.topic == ORDER && Some(number_of(&message.data)) == last;
    let (before, after) = messages.split_at(messages.iter().position(is_last).unwrap_or(messages.len()));
    let mut writer = mcap::Writer::new(std::fs::File::create(out).expect("a file")).expect("a log");
    for message in before.iter().filter(|message| message.channel.topic != DISAGREES).chain(&said) {
        writer.write(message).expect("written");
    }
    for message in after.iter().filter(|message| message.channel.topic != DISAGREES) {
        writer.write(message).expect("written");
    }
    writer.finish().expect("finished");
}

/// That the engine heard of every frame whose image disagrees, and what it makes of that. Whether a tie rests on a frame by the time
/// it hears of it hangs on how fast nulls are made: in a replay it hears of it when the first two have tied the specimen, and before
/// the third is posed.
fn a_tie_is_given_up(lab: &Path, pairs: &[Value]) {
    let log = lab.join("session/session.mcap");
    let entries = entries(&log);
    let told: BTreeSet<u64> = numbers(&entries, DISAGREES).into_iter().collect();
    let disagreeing: BTreeSet<u64> = pairs.iter().filter_map(|pair| pair["number"].as_u64()).collect();
    assert_eq!(told, disagreeing, "the engine hears of each");
    let unbound = unbound(&entries);
    let mut order: Vec<u64> = Vec::new();
    for number in numbers(&entries, ORDER) {
        if !unbound.contains(&number) && !order.contains(&number) {
            order.push(number);
        }
    }
    let [first, second, others @ ..] = &order[..] else { panic!("{order:?}, without {unbound:?}") };
    let last = others.first().copied();
    // The tie does not rest on the third, which is not posed yet, and no more on the second once it is given up.
    let frames: Vec<u64> = last.into_iter().chain([*first, *second]).collect();
    let (early, again) = (lab.join("early.mcap"), lab.join("again"));
    with_disagreements(&log, &early, &frames, last);
    tell_costs(&lab.join("cache"));
    let (_, words) = replay(&early, Some(lab), &lab.join("cache"), &again);
    let said: Vec<&str> = words.lines().filter(|line| line.contains("no longer tied to the room")).collect();
    let expected = format!(
        "warning: frame {first}: the specimen is no longer tied to the room: the image of this frame, on which the tie rested, \
         prefers another pose"
    );
    assert_eq!(said, [expected], "{words}");
    let replayed: Value = serde_json::from_slice(&std::fs::read(again.join("pairs.json")).expect("pairs.json")).expect("JSON");
    let is_last = |pair: &&Value| last.is_some_and(|last| pair["number"] == last);
    for pair in replayed["pairs"].as_array().expect("a list").iter().filter(is_last) {
        // Telemetry expects nothing of a specimen that is not tied.
        assert!(pair["pose_source"] == "beads" && pair["innovation"].is_null(), "{pair:#}");
    }
}

/// All beads 3 % farther apart than they are, and nothing in the room tells: the beads fit 3 % deeper, the image does not.
#[test]
fn a_layout_of_another_scale_is_amber() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let (pairs, report, words) = live(folder.path(), &["--no-robot"], |lab| {
        edit(lab, "beads.mrk.json", |beads| {
            for point in beads["markups"][0]["controlPoints"].as_array_mut().expect("a list") {
                for mm in point["position"].as_array_mut().expect("three numbers") {
                    *mm = json!(mm.as_f64().expect("a number") * 1.03);
                }
            }
        });
        edit(lab, "session.json", |session| session["world_from_lps"] = Value::Null);
    });
    for pair in &pairs {
        assert_eq!((&pair["status"], &pair["pose_source"]), (&json!("accepted_image_disagrees"), &json!("beads")), "{pair:#}");
        assert!(pair["reason"].as_str().is_some_and(|reason| reason.contains("image disagrees")), "{pair:#}");
    }
    assert!(pairs.len() >= 2 && words.contains(" 0 accepted") && !report.contains("badge good"), "{words}");
    a_tie_is_given_up(&folder.path().join("lab"), &pairs);
}

/// The session says that the specimen lies a hand's breadth from where it does. The third frame shows too few beads, and has the
/// pose that telemetry gives it.
#[test]
fn a_pose_far_from_where_it_is_expected_is_amber() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let (pairs, report, words) = live(folder.path(), &["--no-robot", "--stands", "1,2,7"], |lab| {
        edit(lab, "session.json", |session| {
            let mm = session["world_from_lps"][1][3].as_f64().expect("a number");
            session["world_from_lps"][1][3] = json!(mm + 120.0);
        });
    });
    let (collimated, others): (Vec<&Value>, Vec<&Value>) = pairs.iter().partition(|pair| pair["frame"] == "frame-003");
    for pair in &others {
        assert_eq!(
            (&pair["status"], &pair["pose_source"]),
            (&json!("accepted_telemetry_disagrees"), &json!("beads")),
            "{pair:#}"
        );
        // What the pose itself doubts is not lost behind what telemetry says.
        assert!(pair["flags"].to_string().contains("away from it: check the prior"), "{pair:#}");
        assert!(!pair["flags"].to_string().contains(ALONE), "{pair:#}");
    }
    let entries = entries(&folder.path().join("lab/session/session.mcap"));
    let (order, unbound) = (numbers(&entries, ORDER), unbound(&entries));
    let [pair] = collimated[..] else { panic!("{} of the third frame: {words}", collimated.len()) };
    assert_eq!((&pair["status"], &pair["pose_source"]), (&json!("refused"), &json!("telemetry")), "{pair:#}");
    // Where the machine is so crowded that it is registered first, nothing contradicts telemetry yet.
    let at = order.iter().rposition(|number| pair["number"] == *number).expect("it is registered");
    let contradicted = order[..at].iter().any(|number| pair["number"] != *number && !unbound.contains(number));
    assert_eq!(pair["flags"].to_string().contains(ALONE), contradicted, "{order:?}: {pair:#}");
    assert!(!others.is_empty() && words.contains(" 0 accepted") && !report.contains("badge good"), "{words}");
    assert!(words.contains("doubtful pose"), "{words}");
}
