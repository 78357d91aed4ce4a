//! `sidecarm log cut`: a part of a log replays as the whole does, whatever of it refers to what lies before.
#![cfg(unix)]

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde_json::Value;
use sidecarm::acquire::Frame;
use sidecarm::record::{LogEntry, topic};

use crate::log_lab::{arrivals_us, count, entries, info, meddled_of_beads, recorded, replay, sidecarm, text, with_other_frames};

/// Messages of the devices, and those that tell of them, by topic.
fn of_devices(all: &[LogEntry], [from_us, to_us]: [i64; 2]) -> Vec<(&str, i64, &[u8])> {
    let topics = [topic::CARM_RAW, topic::ROBOT_RAW, topic::CARM_JOINTS, topic::ROBOT_JOINTS, "/session/clock"];
    let within = all.iter().filter(|entry| topics.contains(&&*entry.topic) && (from_us..=to_us).contains(&entry.host_us));
    within.map(|entry| (&*entry.topic, entry.host_us, &entry.data[..])).collect()
}

/// The tie of the specimen rests on frames of before, and the last frame comes after the end.
#[test]
fn a_part_of_a_log_replays_to_the_same_poses() {
    let Some(session) = recorded() else { return };
    let (log, folder) = (&session.logs[0], tempfile::tempdir().expect("a folder"));
    let (told, all) = (info(log), entries(log));
    let arrivals = arrivals_us(&told);
    let start_us = told["start_us"].as_i64().expect("a time");
    let last = told["frames"].as_array().and_then(|frames| frames.last()).expect("frames");
    let taken_us = last["pose"]["time_us"].as_i64().expect("a time");
    let (from_us, to_us) = (arrivals[2].1 + 20_000, taken_us + 20_000);
    let late = arrivals.last().copied().expect("frames");
    assert!(from_us < to_us && late.1 > to_us, "the last frame comes after its exposure");
    let out = folder.path().join("cut.mcap");
    let from = format!("{:.6}", (from_us - start_us) as f64 * 1e-6);
    let to = sidecarm::time::rfc3339_from_us(to_us);
    let ran = sidecarm(&["log", "cut", text(log), "--from", &from, "--to", &to, "--out", text(&out)]);
    assert_eq!(ran.code, Some(0), "{}{}", ran.stdout, ran.stderr);
    assert!(ran.stdout.contains("rests on them"), "{}", ran.stdout);
    assert!(ran.stdout.contains(&format!("come before or after: {}", late.0)), "{}", ran.stdout);

    let part = entries(&out);
    let span = [from_us, to_us];
    let (before, after) = (of_devices(&all, span), of_devices(&part, span));
    assert!(before == after && before.len() > 200, "{} and {} messages within", before.len(), after.len());
    let numbers = |all: &[LogEntry], topic: &str| -> BTreeSet<u64> {
        let of = all.iter().filter(|entry| &*entry.topic == topic);
        of.map(|entry| entry.json::<Value>().expect("JSON")["number"].as_u64().expect("a number")).collect()
    };
    let kept = numbers(&part, topic::FRAME_TAGS);
    let within: BTreeSet<u64> = arrivals[3..].iter().map(|(number, _)| *number).collect();
    assert!(within.is_subset(&kept) && kept.len() < arrivals.len() && kept.len() > within.len(), "{kept:?} of {arrivals:?}");
    // Every message of a kept frame is the log's.
    for topic in [topic::POSE, topic::FRAME_TAGS, topic::FRAME_PIXELS, topic::SCORES] {
        let of = |all: &[LogEntry]| -> BTreeSet<Vec<u8>> {
            all.iter().filter(|entry| &*entry.topic == topic).map(|entry| entry.data.clone()).collect()
        };
        let (of_part, of_all) = (of(&part), of(&all));
        assert!(of_part.is_subset(&of_all) && of_part.len() >= within.len(), "{topic}");
    }
    // Also those that were taken before the part and came, or are needed, within.
    let shown = part.iter().filter(|entry| &*entry.topic == topic::SHOWN).count();
    assert!(shown >= kept.len() && shown < all.iter().filter(|entry| &*entry.topic == topic::SHOWN).count(), "{shown}");
    let ran = sidecarm(&["log", "verify", text(&out)]);
    assert_eq!(ran.code, Some(0), "{}", ran.stdout);
    let (code, found) = replay(&out, &session.kit, &folder.path().join("replayed"));
    assert_eq!(code, Some(0), "{found:#}");
    assert!(count(&found, "poses_identical") >= kept.len() as u64 && count(&found, "poses_different") == 0, "{found:#}");
    assert!(count(&found, "images_identical") >= 2 && count(&found, "not_in_log") == 0, "{found:#}");
    // The control: without the frames of before, the poses rest on another tie. (That a scene of beads alone changes none,
    // `log_command` holds of this log.)
    let untied = folder.path().join("untied.mcap");
    let mut first = None;
    meddled_of_beads(&out, &untied, &mut |topic, data| {
        let value: Value = serde_json::from_slice(data).unwrap_or_default();
        let number = value["number"].as_u64();
        if topic == "/session/order" {
            first = number;
        }
        !(topic == "/session/order" && number.is_some_and(|number| !within.contains(&number)))
    });
    assert!(first.is_some());
    let (_, found) = replay(&untied, &session.kit, &folder.path().join("untied"));
    assert!(count(&found, "poses_different") > 0, "{found:#}");
    // Another one: without the devices' bytes of before, whose count is told, exposures are counted otherwise.
    let late = folder.path().join("late.mcap");
    let is_early = |entry: &&LogEntry| entry.topic.ends_with("/raw") && entry.host_us < from_us;
    let early: Vec<&LogEntry> = part.iter().filter(is_early).collect();
    let mut left_out = 0;
    meddled_of_beads(&out, &late, &mut |topic, data| {
        let is_early = early.iter().any(|entry| &*entry.topic == topic && entry.data == *data);
        left_out += usize::from(is_early);
        !is_early
    });
    assert!(left_out == early.len() && left_out > 50, "{left_out} of {}", early.len());
    let (_, found) = replay(&late, &session.kit, &folder.path().join("late"));
    assert!(count(&found, "poses_different") > 0, "{found:#}");
    let again = folder.path().join("again.mcap");
    let ran = sidecarm(&["log", "cut", text(log), "--from", &from, "--to", &to, "--out", text(&again), "--json"]);
    let bytes: usize = early.iter().map(|entry| entry.data.len() - 4).sum();
    assert!(ran.code == Some(0) && count(&ran.json(), "serial_bytes_before") == bytes as u64, "{}{}", ran.stdout, ran.stderr);
    let help = sidecarm(&["log", "cut", "--help"]).stdout;
    assert!(help.contains("serial_bytes_before") && help.contains("from the start of the log"), "{help}");
}

/// The pairs of a replayed session, by the number of their frame.
fn pairs(folder: &Path) -> BTreeMap<u64, Value> {
    let text = std::fs::read(folder.join("pairs.json")).expect("pairs");
    let value: Value = serde_json::from_slice(&text).expect("JSON");
    let all = value["pairs"].as_array().expect("a list").iter();
    all.map(|pair| (pair["number"].as_u64().expect("a number"), pair.clone())).collect()
}

/// What an archive makes of a picture: 256 grey values that follow a curve, and no word of its exposure.
fn archived(frame: &Frame) -> Frame {
    let largest = frame.pixels.pixels.iter().copied().fold(1.0f32, f32::max);
    let grey = |value: &f32| (255.0 * (value.max(0.0) / largest).powf(0.6)).round();
    let mut archived = Frame { sha256: "ab".repeat(32), pixels: frame.pixels.map(grey), ..frame.clone() };
    (archived.tags.exposure_counter, archived.tags.acquired_time) = (None, None);
    archived
}

/// Before the part lie the first picture of a copy in another grey scale that comes within it, and the unfinished file that a frame within it
/// completes.
#[test]
fn frames_of_a_part_are_bound_as_in_the_whole_where_they_refer_to_earlier_ones() {
    let Some(session) = recorded() else { return };
    let (log, folder) = (&session.logs[0], tempfile::tempdir().expect("a folder"));
    let arrivals = arrivals_us(&info(log));
    let [first, completed, last] = [arrivals[2], arrivals[3], arrivals[arrivals.len() - 1]];
    let (copy, torn) = (last.0 + 1, last.0 + 2);
    let from_us = completed.1 - 100_000;
    assert!(first.1 < from_us - 200_000, "{arrivals:?}");
    let whole = folder.path().join("whole.mcap");
    let mut first_seen = None;
    with_other_frames(log, &whole, &mut |frame, host_us, put| {
        let number = u64::from(frame.number);
        if number == first.0 {
            first_seen = Some(frame.clone());
        }
        if number != completed.0 {
            put(&frame, host_us);
        } else {
            let mut half = Frame { number: torn as u32, ..frame.clone() };
            let rows = half.pixels.height;
            half.pixels.pixels[half.pixels.width * (rows / 2)..].fill(0.0);
            half.sha256 = "cd".repeat(32);
            put(&half, from_us - 150_000);
            put(&Frame { completes: Some(torn as u32), ..frame }, host_us);
        }
        if number == last.0 {
            let of = first_seen.as_ref().expect("it came before");
            put(&Frame { number: copy as u32, ..archived(of) }, host_us + 20_000);
        }
    });
    let part = folder.path().join("part.mcap");
    let from = sidecarm::time::rfc3339_from_us(from_us);
    let ran = sidecarm(&["log", "cut", text(&whole), "--from", &from, "--to", "1000", "--out", text(&part)]);
    assert_eq!(ran.code, Some(0), "{}{}", ran.stdout, ran.stderr);
    assert!(ran.stdout.contains("without pixels: what 4 other frames said of exposures"), "{}", ran.stdout);
    let [of_whole, of_part] = [(&whole, "of-whole"), (&part, "of-part")].map(|(log, name)| {
        let out = folder.path().join(name);
        replay(log, &session.kit, &out);
        pairs(&out)
    });
    assert_eq!(of_whole.len(), arrivals.len() + 2);
    assert_eq!(of_part.keys().copied().collect::<Vec<_>>(), (completed.0..=copy).collect::<Vec<_>>());
    for (number, pair) in &of_part {
        for what in ["binding", "binding_evidence", "time_us"] {
            assert_eq!(pair[what], of_whole[number][what], "{what} of frame {number}");
        }
    }
    // The control: both refer to frames of before.
    let words = format!("the same picture as frame {}", first.0);
    assert!(of_whole[&copy]["flags"].to_string().contains(&words), "{:#}", of_whole[&copy]);
    assert!(of_part[&copy]["flags"].to_string().contains(&words), "{:#}", of_part[&copy]);
    let words = format!("frame {} is the whole picture", completed.0);
    assert!(of_whole[&torn].to_string().contains(&words) && of_whole[&completed.0]["binding"] == "counter", "{of_whole:#?}");

    // Pictures that come again afterwards are known as well, whether the log has their pixels or not.
    let exported = folder.path().join("exported");
    std::fs::create_dir(&exported).expect("a folder");
    let mut put = 0;
    with_other_frames(log, &folder.path().join("unused.mcap"), &mut |frame, _, _| {
        let image = archived(&frame).pixels;
        sidecarm::image::write_tiff_f32(&exported.join(format!("{:03}.tif", frame.number)), &[image]).expect("written");
        put += 1;
    });
    let attached = |log: &Path| {
        let ran = sidecarm(&["attach", text(log), text(&exported), "--json"]);
        let json = ran.json();
        let frames = json["frames"].as_array().expect("a list");
        let known = |frame: &&Value| frame["binding"]["evidence"].to_string().contains("the log holds this very frame");
        (frames.len(), frames.iter().filter(known).count())
    };
    assert_eq!(attached(log), (put, put), "the control");
    assert_eq!(attached(&part), (put, put));
}
