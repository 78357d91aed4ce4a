//! `sidecarm log` with what is no log, half a log or a damaged one, and with outputs that are inputs: exit code, one sentence, nothing written.
#![cfg(unix)]

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use sidecarm::acquire::{Domain, Frame};
use sidecarm::image::Image;
use sidecarm::record::{Level, Provenance, Recorder};

use crate::log_lab::{Ran, count, sidecarm, text};
use crate::telemetry_frames::plain;

const T0_US: i64 = 1_795_255_200_000_000;

/// A log without a session: two devices, frames, events; it is closed.
fn small(folder: &Path) -> PathBuf {
    let path = folder.join("small.mcap");
    let recorder = Recorder::create(&path, &Provenance::of_this_program(T0_US, serde_json::Value::Null)).expect("a log");
    for number in 0..90 {
        let host_us = T0_US + i64::from(number) * 33_000;
        recorder.raw_bytes("carm", 1, host_us, &plain(number)).expect("recorded");
        if number % 30 == 5 {
            let pixels = (0..4096u32).map(|at| (at * (number + 7) % 4093) as f32).collect();
            let frame = Frame::from_pixels("frame", Image { width: 64, height: 64, pixels }, Domain::Linear).expect("a frame");
            recorder.frame(&Frame { number: number / 30 + 1, ..frame }, host_us).expect("recorded");
            recorder.flush_now(std::time::Duration::from_secs(60)).expect("written");
        }
    }
    recorder.event(Level::Warning, "something was told", T0_US + 3_000_000).expect("recorded");
    recorder.finish().expect("finished");
    path
}

fn names(folder: &Path) -> BTreeSet<String> {
    let entries = std::fs::read_dir(folder).expect("lists").flatten();
    entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
}

/// Exit code 1, one sentence that holds `words`, perhaps a hint, and no file that was not there before.
fn assert_refused(what: &str, ran: &Ran, words: &str, folder: &Path, before: &BTreeSet<String>) {
    assert_eq!(ran.code, Some(1), "{what}: {}{}", ran.stdout, ran.stderr);
    assert!(ran.stdout.is_empty(), "{what}: {}", ran.stdout);
    let lines: Vec<&str> = ran.stderr.lines().filter(|line| !line.starts_with("hint: ")).collect();
    assert!(lines.len() == 1 && lines[0].starts_with("sidecarm: ") && lines[0].contains(words), "{what}: {}", ran.stderr);
    assert_eq!(&names(folder), before, "{what}");
}

/// Every command on `log`, by its name.
fn commands<'a>(log: &'a str, other: &'a str, out: &'a str) -> [(&'static str, Vec<&'a str>); 6] {
    [
        ("info", vec!["log", "info", log]),
        ("verify", vec!["log", "verify", log]),
        ("cut", vec!["log", "cut", log, "--from", "0", "--to", "1", "--out", out]),
        ("merge", vec!["log", "merge", log, other, "--out", out]),
        ("csv", vec!["log", "csv", log, "--out", out]),
        ("redact", vec!["log", "redact", log, "--out", out]),
    ]
}

#[test]
fn what_is_no_log_is_refused_by_every_command() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let good = small(folder.path());
    std::fs::write(at("text.mcap"), "this is no log, however it is called").expect("written");
    std::fs::write(at("empty.mcap"), "").expect("written");
    std::fs::create_dir(at("folder.mcap")).expect("a folder");
    let before = names(folder.path());
    let mut refused = 0;
    for (name, words) in [
        ("text.mcap", "not an MCAP log"),
        ("empty.mcap", "an empty file"),
        ("missing.mcap", "No such file"),
        ("folder.mcap", "folder.mcap"),
    ] {
        let (log, out) = (at(name), at("out"));
        for (command, args) in commands(text(&log), text(&good), text(&out)) {
            assert_refused(&format!("{command} {name}"), &sidecarm(&args), words, folder.path(), &before);
            refused += 1;
        }
    }
    assert_eq!(refused, 24);
}

#[test]
fn inputs_and_files_that_are_there_are_never_written_over() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let log = small(folder.path());
    std::fs::copy(&log, at("other.mcap")).expect("copied");
    std::fs::write(at("there.mcap"), "mine").expect("written");
    std::fs::hard_link(&log, at("hard.mcap")).expect("linked");
    std::os::unix::fs::symlink("small.mcap", at("soft.mcap")).expect("linked");
    std::os::unix::fs::symlink("nothing", at("dangling.mcap")).expect("linked");
    let (before, bytes) = (names(folder.path()), std::fs::read(&log).expect("the log"));
    let mut refused = 0;
    for (out, words) in [
        ("small.mcap", "small.mcap"),
        ("hard.mcap", "hard.mcap"),
        ("soft.mcap", "soft.mcap"),
        ("there.mcap", "exists already"),
        ("dangling.mcap", "exists already"),
    ] {
        let out = at(out);
        for (command, args) in commands(text(&log), text(&at("other.mcap")), text(&out)) {
            if ["cut", "merge", "redact"].contains(&command) {
                assert_refused(&format!("{command} {}", out.display()), &sidecarm(&args), words, folder.path(), &before);
                refused += 1;
            }
        }
    }
    assert_eq!(refused, 15);
    assert_eq!(std::fs::read(&log).expect("the log"), bytes);
    assert_eq!(std::fs::read(at("there.mcap")).expect("there"), b"mine");
    // A table's folder that is a file.
    let ran = sidecarm(&["log", "csv", text(&log), "--out", text(&at("there.mcap"))]);
    assert_refused("csv into a file", &ran, "there.mcap", folder.path(), &before);
}

#[test]
fn what_cannot_be_meant_is_a_usage_error_and_nothing_lies_in_an_empty_span() {
    let folder = tempfile::tempdir().expect("a folder");
    let (log, out) = (small(folder.path()), folder.path().join("out.mcap"));
    let before = names(folder.path());
    let (log, out) = (text(&log), text(&out));
    let usage: [&[&str]; 7] = [
        &["log"],
        &["log", "info"],
        &["log", "cut", log, "--from", "1", "--to", "2"],
        &["log", "cut", log, "--from", "noon", "--to", "2", "--out", out],
        &["log", "cut", log, "--from", "2026-11-21T10:00:00", "--to", "2", "--out", out],
        &["log", "merge", log, "--out", out],
        &["log", "redact", log],
    ];
    for args in usage {
        let ran = sidecarm(args);
        assert_eq!(ran.code, Some(2), "{args:?}: {}", ran.stderr);
    }
    for (from, to) in [("2", "1"), ("1", "1"), ("50", "60"), ("2020-01-01T00:00:00Z", "2020-01-02T00:00:00Z")] {
        let ran = sidecarm(&["log", "cut", log, "--from", from, "--to", to, "--out", out]);
        assert_refused(&format!("{from} to {to}"), &ran, "nothing lies between", folder.path(), &before);
    }
    // Logs without a session are told, checked, cut and tabulated; there is nothing to join.
    std::fs::copy(log, folder.path().join("other.mcap")).expect("copied");
    let other = folder.path().join("other.mcap");
    let ran = sidecarm(&["log", "merge", log, text(&other), "--out", out]);
    assert!(ran.code == Some(1) && ran.stderr.contains("same"), "{}", ran.stderr);
    let part = folder.path().join("part.mcap");
    let ran = sidecarm(&["log", "cut", log, "--from", "0.5", "--to", "1.5", "--out", text(&part)]);
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    let ran = sidecarm(&["log", "merge", log, text(&part), "--out", out]);
    assert!(ran.code == Some(1) && ran.stderr.contains("no session"), "{}", ran.stderr);
    let ran = sidecarm(&["log", "verify", text(&part)]);
    assert_eq!(ran.code, Some(0), "{}", ran.stdout);
}

/// Cut anywhere, a log is read up to the cut, and the loss is said by all.
#[test]
fn half_a_log_is_read_with_its_loss() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = small(folder.path());
    let bytes = std::fs::read(&log).expect("the log");
    let whole = sidecarm(&["log", "info", text(&log), "--json"]);
    assert!(whole.code == Some(0) && whole.json()["closed"] == true, "{}", whole.stderr);
    let cut = folder.path().join("cut.mcap");
    let mut read = 0;
    for at in (1..12).map(|part| bytes.len() * part / 12).chain([3, 8, 60, bytes.len() - 1, bytes.len() - 40]) {
        std::fs::write(&cut, &bytes[..at]).expect("written");
        for command in ["info", "verify"] {
            let ran = sidecarm(&["log", command, text(&cut), "--json"]);
            assert_eq!(ran.code, Some(3), "{command} at {at}: {}{}", ran.stdout, ran.stderr);
            let lost = if command == "info" { "damage" } else { "faults" };
            assert!(count(&ran.json(), lost) >= 1, "{command} at {at}");
        }
        read += 1;
    }
    assert_eq!(read, 16);
    std::fs::write(&cut, &bytes[..bytes.len() * 2 / 3]).expect("written");
    let (part, tables, given) = (folder.path().join("part.mcap"), folder.path().join("tables"), folder.path().join("given.mcap"));
    for args in [
        &["log", "cut", text(&cut), "--from", "0", "--to", "1", "--json", "--out", text(&part)][..],
        &["log", "csv", text(&cut), "--json", "--out", text(&tables)],
        &["log", "redact", text(&cut), "--json", "--out", text(&given)],
    ] {
        let ran = sidecarm(args);
        assert!(ran.code == Some(3) && ran.stderr.contains("lost from the log"), "{args:?}: {}", ran.stderr);
        assert!(count(&ran.json(), "losses") >= 1, "{args:?}: {}", ran.stdout);
    }
    // What was made of it is whole by itself.
    for made in [&part, &given] {
        assert_eq!(sidecarm(&["log", "verify", text(made)]).code, Some(0), "{}", made.display());
    }
}

/// One byte anywhere: whatever it is in, it is said where.
#[test]
fn a_damaged_byte_is_found_wherever_it_is() {
    let folder = tempfile::tempdir().expect("a folder");
    let log = small(folder.path());
    let bytes = std::fs::read(&log).expect("the log");
    let damaged = folder.path().join("damaged.mcap");
    let mut found = 0;
    // Behind the magic and the header; a prime step, so that it falls into records of all kinds.
    for at in (40..bytes.len() - 8).step_by((bytes.len() / 23) | 1) {
        let mut bytes = bytes.clone();
        bytes[at] ^= 0x40;
        std::fs::write(&damaged, &bytes).expect("written");
        let ran = sidecarm(&["log", "verify", text(&damaged), "--json"]);
        let told = ran.json();
        assert_eq!(ran.code, Some(3), "byte {at}: {told:#}");
        let faults = told["faults"].as_array().expect("a list");
        assert!(
            faults.iter().any(|fault| fault["at_byte"].as_u64().is_some_and(|of| of <= bytes.len() as u64)),
            "byte {at}: {told:#}"
        );
        found += 1;
    }
    assert!(found >= 20, "{found}");
    // The control: the undamaged log is whole, and says what it holds.
    let ran = sidecarm(&["log", "verify", text(&log), "--json"]);
    assert!(ran.code == Some(0) && count(&ran.json(), "frames") == 3 && count(&ran.json(), "packets") == 90, "{}", ran.stdout);
}

/// Where the records with this opcode begin, and where the record after each.
fn records(bytes: &[u8], opcode: u8) -> Vec<(usize, usize)> {
    let (mut at, mut found) = (8, Vec::new());
    while at + 9 <= bytes.len() - 8 {
        let length = u64::from_le_bytes(bytes[at + 1..at + 9].try_into().expect("eight bytes")) as usize;
        if bytes[at] == opcode {
            found.push((at, at + 9 + length));
        }
        at += 9 + length;
    }
    found
}

/// The help named LOG.replay; of session.mcap the folder is session.replay.
#[test]
fn the_help_of_a_replay_names_the_folder_that_it_writes() {
    let told = sidecarm(&["replay", "--help"]);
    let words = told.stdout.split_whitespace().collect::<Vec<_>>().join(" ");
    assert!(words.contains("session.replay for session.mcap") && !words.contains("LOG.replay"), "{words}");
}

#[test]
fn chunks_that_changed_places_are_a_fault() {
    let folder = tempfile::tempdir().expect("a folder");
    let [log, swapped] = ["line.mcap", "swapped.mcap"].map(|name| folder.path().join(name));
    let recorder = Recorder::create(&log, &Provenance::of_this_program(T0_US, serde_json::Value::Null)).expect("a log");
    for number in 0..90 {
        recorder.raw_bytes("carm", 1, T0_US + i64::from(number) * 33_000, &plain(number)).expect("recorded");
        if number % 30 == 29 {
            recorder.flush_now(std::time::Duration::from_secs(60)).expect("written");
        }
    }
    recorder.finish().expect("finished");
    assert_eq!(sidecarm(&["log", "verify", text(&log)]).code, Some(0));
    let bytes = std::fs::read(&log).expect("the log");
    let chunks = records(&bytes, 0x06);
    let end = records(&bytes, 0x0f).first().expect("the end of the data").0;
    let starts: Vec<usize> = chunks.iter().map(|(at, _)| *at).chain([end]).collect();
    let mut behind = 0;
    for three in starts.windows(3) {
        let [first, second, third] = *three else { panic!("two chunks and what follows") };
        let mut parts = [&bytes[..first], &bytes[second..third], &bytes[first..second], &bytes[third..]].concat();
        // A checksum of all that nobody computed says nothing.
        parts[end + 9..end + 13].fill(0);
        std::fs::write(&swapped, parts).expect("written");
        let ran = sidecarm(&["log", "verify", text(&swapped)]);
        if ran.stdout.contains("/carm/raw") && ran.stdout.contains("stands behind message") {
            assert_eq!(ran.code, Some(3), "{}", ran.stdout);
            behind += 1;
        }
    }
    assert!(behind >= 2, "{behind}: bytes of a line in another order are seen; {} chunks", chunks.len());
}
