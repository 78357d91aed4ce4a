//! `sidecarm log` on the logs of a session: what is told, checked, joined, tabulated and redacted, and that replays agree.
#![cfg(unix)]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde_json::Value;
use sidecarm::record::{read_log, topic};

use crate::acquire_identity::hits;
use crate::live_lab::Heard;
use crate::log_lab::{
    CANARIES, SERIAL_NUMBERS, arrivals_us, count, entries, info, meddled, meddled_of_beads, recorded, replay, sidecarm, text,
};

/// As a table has it.
fn cell(value: &Value) -> String {
    value.to_string()
}

#[test]
fn a_log_tells_what_is_in_it() {
    let Some(session) = recorded() else { return };
    let log = &session.logs[0];
    let (told, all) = (info(log), entries(log));
    let mut topics: BTreeMap<&str, u64> = BTreeMap::new();
    all.iter().for_each(|entry| *topics.entry(&entry.topic).or_default() += 1);
    for (topic, messages) in &topics {
        assert_eq!(told["topics"][topic]["messages"].as_u64(), Some(*messages), "{topic}");
    }
    assert!(topics.len() > 10 && count(&told, "messages") == all.len() as u64);
    let heard = Heard::of(log);
    let packets: u64 = told["devices"].as_array().expect("a list").iter().map(|device| count(device, "packets")).sum();
    assert!(packets > 500 && packets >= heard.packets.len() as u64, "{packets} of {}", heard.packets.len());
    let frames = told["frames"].as_array().expect("a list");
    assert_eq!(frames.len(), heard.images);
    for frame in frames {
        assert_eq!(frame["pose"]["binding"], "counter", "{frame}");
        assert!(frame["pose"]["exposure"].is_u64() && frame["pixels"] == "there" && frame["size_px"][0] == 620, "{frame}");
    }
    assert!(frames.iter().filter(|frame| frame["pose"]["accepted"] == true).count() >= 3, "{told:#}");
    assert!(told["closed"] == true && told["ended"] == true && count(&told, "damage") == 0, "{told:#}");
    let ran = sidecarm(&["log", "info", text(log)]);
    for words in ["/carm/raw", "the session came to its end", "exposure", "620x480", "accepted, rms"] {
        assert!(ran.stdout.contains(words), "{words}: {}", ran.stdout);
    }
}

#[test]
fn a_whole_log_is_whole_and_each_change_is_a_fault_with_its_place() {
    let Some(session) = recorded() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let verify = |log: &Path| {
        let ran = sidecarm(&["log", "verify", text(log), "--json"]);
        (ran.code, ran.json())
    };
    let (code, whole) = verify(&session.logs[0]);
    assert!(code == Some(0) && count(&whole, "faults") == 0, "{whole:#}");
    assert!(count(&whole, "frames") >= 4 && count(&whole, "drrs") >= 3 && count(&whole, "packets") > 500, "{whole:#}");
    type Change = (&'static str, &'static str, fn(&mut Vec<u8>) -> bool, &'static str);
    let changes: [Change; 7] = [
        ("a read", "/carm/raw", |_| false, "is missing before this"),
        (
            "letters in a read",
            "/robot/raw",
            |data| {
                data.iter_mut().skip(20).take(4).all(|byte| {
                    *byte ^= 0x11;
                    true
                })
            },
            "samples of the devices",
        ),
        (
            "a pixel",
            "/frames/acquired",
            |data| {
                data.last_mut().is_some_and(|byte| {
                    *byte ^= 1;
                    true
                })
            },
            "not those that were recorded",
        ),
        ("a frame's tags", "/frames/tags", |_| false, "pixels without their tags"),
        (
            "a DRR",
            "/frames/drr",
            |data| {
                let middle = data.len() / 2;
                data[middle] ^= 1;
                true
            },
            "is not the one that its hash names",
        ),
        (
            "a pose",
            "/pose",
            |data| {
                data.truncate(40);
                true
            },
            "EOF while parsing",
        ),
        ("the end", "/session/end", |_| false, "it was cut short"),
    ];
    let mut seen = 0;
    for (name, of, change, words) in changes {
        let path = folder.path().join(format!("{seen}.mcap"));
        let mut nth = 0;
        meddled(&session.logs[0], &path, &mut |topic, data| {
            nth += usize::from(topic == of);
            // The second message of its topic; of the end, the only one.
            let ours = topic == of && (nth == 2 || of == "/session/end");
            !ours || change(data)
        });
        let (code, found) = verify(&path);
        let faults = found["faults"].as_array().expect("a list");
        assert_eq!(code, Some(3), "{name}: {found:#}");
        let fault = faults.iter().find(|fault| fault["what"].as_str().is_some_and(|what| what.contains(words)));
        let fault = fault.unwrap_or_else(|| panic!("{name}: {found:#}"));
        assert!(fault["at_byte"].is_u64() && fault["topic"].is_string(), "{name}: {fault}");
        seen += 1;
    }
    assert_eq!(seen, 7);
}

/// Such a log was whole, and replayed to other poses without a word of the reason.
#[test]
fn a_log_that_was_put_in_order_of_time_is_no_whole_log() {
    let Some(session) = recorded() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("by-time.mcap");
    let bytes = std::fs::read(&session.logs[0]).expect("the log");
    let messages = mcap::MessageStream::new(&bytes).expect("a log").map(|message| message.expect("a message"));
    let mut messages: Vec<mcap::Message> = messages.collect();
    messages.sort_by_key(|message| message.log_time);
    let mut writer = mcap::Writer::new(std::fs::File::create(&out).expect("file")).expect("a log");
    messages.iter().for_each(|message| writer.write(message).expect("written"));
    writer.finish().expect("finished");
    let ran = sidecarm(&["log", "verify", text(&out)]);
    assert_eq!(ran.code, Some(3), "{}{}", ran.stdout, ran.stderr);
    assert!(ran.stdout.contains("messages are not in the order in which they were recorded"), "{}", ran.stdout);
    let (code, replayed) = replay(&out, &session.kit, &folder.path().join("replayed"));
    assert_eq!(code, Some(3), "{replayed:#}");
    assert!(replayed["losses"].to_string().contains("replay the original"), "{replayed:#}");
}

#[test]
fn logs_of_one_session_join_and_replay_as_each_alone() {
    let Some(session) = recorded() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let out = folder.path().join("day.mcap");
    let [first, second] = &session.logs;
    // In whatever order they are named.
    let ran = sidecarm(&["log", "merge", text(second), text(first), "--json", "--out", text(&out)]);
    assert_eq!(ran.code, Some(0), "{}{}", ran.stdout, ran.stderr);
    assert_eq!(count(&ran.json(), "logs"), 2, "{}", ran.stdout);
    let told = [info(first), info(second), info(&out)];
    let frames: Vec<Vec<(u64, i64)>> = told.iter().map(arrivals_us).collect();
    let last = frames[0].last().expect("frames").0;
    let expected: Vec<(u64, i64)> =
        frames[0].iter().copied().chain(frames[1].iter().map(|(number, us)| (number + last, *us))).collect();
    assert_eq!(frames[2], expected);
    assert_eq!(count(&told[2], "joined"), 1);
    let ran = sidecarm(&["log", "verify", text(&out)]);
    assert_eq!(ran.code, Some(0), "{}", ran.stdout);
    let alone = |log: &Path, name: &str| {
        let (code, found) = replay(log, &session.kit, &folder.path().join(name));
        assert_eq!(code, Some(0), "{found:#}");
        found
    };
    let (a, [b, both]) = (session.replayed(), [alone(second, "b"), alone(&out, "both")]);
    for what in ["frames", "poses_identical", "images_identical", "scores_identical"] {
        assert_eq!(count(a, what) + count(&b, what), count(&both, what), "{what}: {both:#}");
    }
    assert!(count(&both, "poses_different") == 0 && count(&both, "poses_identical") >= 7, "{both:#}");
    // A part of the second log, whose devices began before it does.
    let (middle, part) = (frames[2][frames[2].len() - 2], folder.path().join("part.mcap"));
    let from = sidecarm::time::rfc3339_from_us(middle.1 - 10_000);
    let ran = sidecarm(&["log", "cut", text(&out), "--from", &from, "--to", "1000", "--out", text(&part)]);
    assert!(ran.code == Some(0) && sidecarm(&["log", "verify", text(&part)]).code == Some(0), "{}{}", ran.stdout, ran.stderr);
    let (code, found) = replay(&part, &session.kit, &folder.path().join("part"));
    assert_eq!(code, Some(0), "{found:#}");
    assert!(count(&found, "poses_different") == 0 && count(&found, "poses_identical") >= 2, "{found:#}");
    // Exposures before and after the seam may have the same number.
    let ran = sidecarm(&["attach", text(&out), text(folder.path())]);
    assert!(ran.code == Some(1) && ran.stderr.contains("joined of several logs"), "{}", ran.stderr);
    // The control: without the seam the second log's poses would rest on what the first had learnt. The first's are as they were, also in a scene
    // of beads alone.
    let seamless = folder.path().join("seamless.mcap");
    meddled_of_beads(&out, &seamless, &mut |topic, _| topic != "/session/restart");
    let (_, found) = replay(&seamless, &session.kit, &folder.path().join("seamless"));
    let different = found["poses_different"].as_array().expect("a list");
    assert!(!different.is_empty() && different.iter().all(|number| number.as_u64() > Some(last)), "{found:#}");
}

#[test]
fn logs_that_do_not_belong_together_are_not_joined() {
    let Some(session) = recorded() else { return };
    let folder = tempfile::tempdir().expect("a folder");
    let [first, second] = &session.logs;
    let other = |name: &str, from: &str, to: &str| {
        let path = folder.path().join(name);
        let mut changed = 0;
        meddled(second, &path, &mut |topic, data| {
            let found = String::from_utf8_lossy(data).into_owned();
            if topic == "/session/setup" && found.contains(from) {
                *data = found.replacen(from, to, 1).into_bytes();
                changed += 1;
            }
            true
        });
        assert_eq!(changed, 1, "{name}");
        path
    };
    let part = folder.path().join("part.mcap");
    let ran = sidecarm(&["log", "cut", text(first), "--from", "0", "--to", "4", "--out", text(&part)]);
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    let cases: [(PathBuf, &str); 4] = [
        (
            other("calibration.mcap", "\"source_to_isocentre_mm\":631.8", "\"source_to_isocentre_mm\":632.8"),
            "carm.source_to_isocentre_mm",
        ),
        (other("scene.mcap", "\"sha256\":\"", "\"sha256\":\"0"), "sha256"),
        (part, "ends"),
        (first.clone(), "same"),
    ];
    let out = folder.path().join("day.mcap");
    let mut refused = 0;
    for (with, words) in &cases {
        let ran = sidecarm(&["log", "merge", text(first), text(with), "--out", text(&out)]);
        assert_eq!(ran.code, Some(1), "{}: {}", with.display(), ran.stdout);
        assert!(ran.stderr.contains(words) && !out.exists(), "{}: {}", with.display(), ran.stderr);
        refused += 1;
    }
    assert_eq!(refused, 4);
    // Ports may be others after a restart.
    let ported = other("port.mcap", "\"port\":\"", "\"port\":\"x");
    let ran = sidecarm(&["log", "merge", text(first), text(&ported), "--out", text(&out)]);
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
}

/// The rows of a table by column.
fn table(path: &Path) -> Vec<BTreeMap<String, String>> {
    let mut reader = csv::Reader::from_path(path).expect("a table");
    let head: Vec<String> = reader.headers().expect("a head").iter().map(str::to_owned).collect();
    reader.records().map(|row| head.iter().cloned().zip(row.expect("a row").iter().map(str::to_owned)).collect()).collect()
}

#[test]
fn tables_hold_what_the_log_holds() {
    let Some(session) = recorded() else { return };
    let (log, folder) = (&session.logs[0], tempfile::tempdir().expect("a folder"));
    let out = folder.path().join("tables");
    let ran = sidecarm(&["log", "csv", text(log), "--out", text(&out)]);
    assert_eq!(ran.code, Some(0), "{}{}", ran.stdout, ran.stderr);
    let told = info(log);
    let number = |row: &BTreeMap<String, String>, column: &str| row[column].parse::<f64>().unwrap_or(f64::NAN);
    // Every packet is a row, with what the session had decoded.
    for (name, topic, angle, place) in [
        ("carm.csv", topic::CARM_JOINTS, "orbital_deg", "/joints/orbital_deg"),
        ("robot.csv", topic::ROBOT_JOINTS, "commanded_1_deg", "/commanded_deg/0"),
    ] {
        let rows = table(&out.join(name));
        let said: BTreeMap<u64, Value> = entries(log)
            .iter()
            .filter(|entry| &*entry.topic == topic)
            .map(|entry| entry.json::<Value>().expect("JSON"))
            .map(|sample| (sample["sequence"].as_u64().expect("a number"), sample))
            .collect();
        assert!(rows.len() >= said.len() && rows.len() < said.len() + 20 && said.len() > 100, "{name}: {}", rows.len());
        let mut compared = 0;
        for row in &rows {
            let Some(sample) = said.get(&(number(row, "sequence") as u64)) else { continue };
            let expected = sample.pointer(place).and_then(Value::as_f64).unwrap_or(f64::NAN);
            assert!((number(row, angle) - expected).abs() < 1e-9, "{name}: {row:?} {sample}");
            assert!((number(row, "host_us") - number(row, "arrival_us")).abs() < 5e5, "{row:?}");
            compared += 1;
        }
        assert!(compared > 100, "{name}: {compared}");
    }
    let exposures = table(&out.join("exposures.csv"));
    assert_eq!(exposures.len() as u64, count(&told, "exposures"));
    let frames = told["frames"].as_array().expect("a list");
    for frame in frames {
        let shown = frame["number"].to_string();
        let bound = exposures.iter().find(|row| row["frames"].split(' ').any(|of| of == shown));
        let bound = bound.unwrap_or_else(|| panic!("{frame}"));
        assert_eq!(bound["counter"], frame["pose"]["exposure_counter"].to_string());
        assert!(number(bound, "tube_kvp") > 20.0 && number(bound, "source_to_detector_mm") > 900.0, "{bound:?}");
        assert!(
            bound["binding"] == "counter" && bound["start_utc"].ends_with('Z') && number(bound, "segment") >= 0.0,
            "{bound:?}"
        );
    }
    let poses = table(&out.join("poses.csv"));
    assert_eq!(poses.len(), frames.len());
    let mut solved = 0;
    for (row, frame) in poses.iter().zip(frames) {
        assert!(row["frame"] == cell(&frame["number"]) && row["label"] == frame["label"], "{row:?} {frame}");
        let Some(pose) = frame["pose"].as_object().filter(|pose| pose["accepted"] == true) else { continue };
        let bound = exposures.iter().find(|exposure| exposure["number"] == row["exposure"]).expect("an exposure");
        let turned = number(row, "orbital_deg") - number(bound, "orbital_deg");
        assert!(row["pose_source"] == "beads" && row["rms_px"] == cell(&pose["rms_px"]) && turned.abs() < 1e-9, "{row:?}");
        assert!(row["status"].starts_with("accepted") && !row["intrinsics_source"].is_empty(), "{row:?}");
        // P = K camera_from_lps, row by row.
        for column in 0..4 {
            let [x, y, z] = [0, 1, 2].map(|line| number(row, &format!("camera_from_lps_{line}{column}")));
            let [u, v, w] = [0, 1, 2].map(|line| number(row, &format!("p{line}{column}")));
            let (in_u, in_v) =
                (number(row, "fx_px") * x + number(row, "cx_px") * z, number(row, "fy_px") * y + number(row, "cy_px") * z);
            assert!((u - in_u).abs() < 1e-3 && (v - in_v).abs() < 1e-3 && (w - z).abs() < 1e-6, "{column}: {row:?}");
        }
        solved += 1;
    }
    assert!(solved > 0, "{poses:?}");
    let beads = table(&out.join("beads.csv"));
    assert!(beads.len() >= 6 * frames.len(), "{}", beads.len());
    let used: Vec<_> = beads.iter().filter(|row| row["used"] == "1").collect();
    assert!(used.len() >= 12, "{}", used.len());
    for row in used {
        let missed = number(row, "image_u_px") - number(row, "predicted_u_px") - number(row, "residual_u_px");
        assert!(missed.abs() < 1e-9 && number(row, "residual_u_px").abs() < 2.0, "{row:?}");
    }
    let scores = table(&out.join("scores.csv"));
    assert_eq!(scores.len(), frames.len());
    for row in scores.iter().chain(&beads) {
        assert!(frames.iter().any(|frame| row["frame"] == cell(&frame["number"]) && row["label"] == frame["label"]), "{row:?}");
    }
    let accepted: Vec<_> = scores.iter().filter(|row| row["status"] == "accepted").collect();
    assert!(
        accepted.iter().any(|row| number(row, "gradient_ncc") > 0.5 && number(row, "gradient_ncc_null_margin") > 0.0),
        "{scores:?}"
    );
    // Nothing is written over.
    let ran = sidecarm(&["log", "csv", text(log), "--out", text(&out)]);
    assert!(ran.code == Some(1) && ran.stderr.contains("exists already"), "{}", ran.stderr);
}

/// Every message and attachment as text; of the devices' bytes, all of a line together.
fn outputs(log: &Path) -> Vec<(String, Vec<u8>)> {
    let contents = read_log(log).expect("a log");
    let mut found: BTreeMap<String, Vec<u8>> = BTreeMap::new();
    for entry in &contents.entries {
        let data = if entry.topic.ends_with("/raw") { &entry.data[4..] } else { &entry.data[..] };
        if ![topic::FRAME_PIXELS, topic::DRR].contains(&&*entry.topic) {
            found.entry(entry.topic.to_string()).or_default().extend_from_slice(data);
        }
    }
    found.extend(contents.attachments.into_iter().map(|file| (file.name, file.data)));
    found.into_iter().collect()
}

#[test]
fn a_redacted_log_tells_no_names_and_replays_to_the_same_poses() {
    let Some(session) = recorded() else { return };
    let (log, folder) = (&session.logs[0], tempfile::tempdir().expect("a folder"));
    let out = folder.path().join("given.mcap");
    let ran = sidecarm(&["log", "redact", text(log), "--out", text(&out)]);
    assert_eq!(ran.code, Some(0), "{}{}", ran.stdout, ran.stderr);
    let (before, after) = (outputs(log), outputs(&out));
    // Of a label, a port, a machine and an origin as well; redacted labels are made of digits of the content, which may begin so.
    let others = ["frame-001\"", "frame-002\"", "ttycarm", "\"linux ", "measured by", "mock 1.0"];
    let mut planted = 0;
    for word in CANARIES.iter().chain(&SERIAL_NUMBERS).chain(&others).map(|word| word.to_lowercase()) {
        assert!(!hits(&before, &word).is_empty(), "the control: {word} is in the log");
        assert!(hits(&after, &word).is_empty(), "{word}: {:?}", hits(&after, &word));
        planted += 1;
    }
    assert_eq!(planted, 13);
    let events = |log: &Path| entries(log).iter().filter_map(|entry| entry.event().expect("sound")).collect::<Vec<_>>();
    assert!(events(log).iter().any(|event| !event.starts_with("DRR of frame ")), "the control: events were told");
    assert!(events(&out).iter().all(|event| event.starts_with("DRR of frame ")), "{:?}", events(&out));
    // Pixels are those of the log, and so are the numbers.
    let pixels = |log: &Path| -> Vec<Vec<u8>> {
        let all = entries(log).into_iter().filter(|entry| &*entry.topic == topic::FRAME_PIXELS);
        all.map(|entry| entry.data).collect()
    };
    assert_eq!(pixels(log), pixels(&out));
    let ran = sidecarm(&["log", "verify", text(&out)]);
    assert_eq!(ran.code, Some(0), "{}", ran.stdout);
    let original = session.replayed();
    let (code, found) = replay(&out, &session.kit, &folder.path().join("replayed"));
    assert_eq!(code, Some(0), "{found:#}");
    for what in ["poses_identical", "images_identical", "scores_identical"] {
        assert!(count(&found, what) == count(original, what) && count(&found, what) >= 3, "{what}: {found:#}");
    }
    let report = std::fs::read_to_string(folder.path().join("replayed/report.html")).expect("a report");
    assert!(!report.contains("not the one that the scene draws"), "the robot is that of the session, whoever measured it");
    // Numbers of the poses are those of the log; its names are others.
    let poses = |log: &Path| -> Vec<Value> {
        let all = entries(log).into_iter().filter(|entry| &*entry.topic == topic::POSE);
        all.map(|entry| entry.json::<Value>().expect("JSON")["projection"].clone()).collect()
    };
    assert_eq!(poses(log), poses(&out));
}

#[test]
fn without_pixels_nothing_is_posed_and_a_replay_says_so() {
    let Some(session) = recorded() else { return };
    let (log, folder) = (&session.logs[0], tempfile::tempdir().expect("a folder"));
    let out = folder.path().join("numbers.mcap");
    let ran = sidecarm(&["log", "redact", text(log), "--no-pixels", "--out", text(&out)]);
    assert_eq!(ran.code, Some(0), "{}{}", ran.stdout, ran.stderr);
    assert!(entries(&out).iter().all(|entry| &*entry.schema != "foxglove.RawImage"), "no picture is left");
    let ran = sidecarm(&["log", "verify", text(&out)]);
    assert!(ran.code == Some(0) && ran.stdout.contains("left out of this log on purpose"), "{}", ran.stdout);
    let (code, found) = replay(&out, &session.kit, &folder.path().join("replayed"));
    assert_eq!(code, Some(3), "{found:#}");
    assert!(found["losses"].to_string().contains("left out of this log on purpose"), "{found:#}");
    for what in ["poses_different", "poses_missing", "images_missing", "samples_different"] {
        assert_eq!(count(&found, what), 0, "{what}: {found:#}");
    }
    // Exposures are bound as before.
    let tables = folder.path().join("tables");
    let ran = sidecarm(&["log", "csv", text(&out), "--out", text(&tables)]);
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    let bound = table(&tables.join("exposures.csv")).iter().filter(|row| !row["frames"].is_empty()).count();
    assert!(bound >= 4, "{bound}");
}
