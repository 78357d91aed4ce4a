//! Pipes, devices and files that are far too large, named where a command reads a file.
#![cfg(unix)]

use std::path::Path;
use std::process::{Command, Output, Stdio};

use serde_json::json;
use sidecarm::image::{Image, write_tiff_f32};

use crate::acquire_foreign::{assert_one_sentence, scene_of, write_beads};
use crate::live_lab::{HANG_S, eventually};

/// As `acquire_foreign::sidecarm`; a program that waits for something is ended, and is a failure.
fn unless_it_hangs(folder: &Path, args: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    let piped = command.args(args).current_dir(folder).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = piped.spawn().expect("the program starts");
    let ended = eventually(HANG_S, || child.try_wait().expect("a child can be asked"));
    if ended.is_none() {
        let _ = child.kill();
    }
    let output = child.wait_with_output().expect("its words");
    assert!(ended.is_some(), "{args:?} hangs: {}", String::from_utf8_lossy(&output.stderr));
    output
}

/// Commands that read `name` as beads, scene, pose and session before anything else that they are given.
fn readers_of_small_files(name: &str) -> [Vec<&str>; 4] {
    [
        vec!["register", "frame.png", "--beads", name, "--out", "pose.json"],
        vec!["render", name, "--out", "drr.tif", "--device", "cpu"],
        vec!["compare", "frame.png", "drr.tif", "--pose", name, "--out", "compared"],
        vec!["live", name, "--headless", "--out", "session"],
    ]
}

/// A pipe gives nothing without end, and a device more than there is memory.
#[test]
fn commands_do_not_wait_for_pipes_and_devices() {
    let folder = tempfile::tempdir().expect("folder");
    assert!(Command::new("mkfifo").arg(folder.path().join("pipe.dcm")).status().expect("mkfifo").success());
    std::os::unix::fs::symlink("/dev/zero", folder.path().join("zero.png")).expect("link");
    // A hole: it takes no room.
    let large = std::fs::File::create(folder.path().join("large.json")).expect("created");
    large.set_len((64 << 20) + 1).expect("made longer");
    std::fs::write(folder.path().join("plain.json"), "hello").expect("written");
    write_beads(folder.path());
    let mut cases = 0;
    for (name, words) in [("pipe.dcm", "a named pipe"), ("zero.png", "a device")] {
        let register = ["register", name, "--beads", "beads.mrk.json", "--out", "pose.json"];
        for args in [&["info", name][..], &register, &["compare", name, name, "--out", "compared"]] {
            assert_one_sentence(name, &unless_it_hangs(folder.path(), args), words);
            cases += 1;
        }
        for object in [
            json!({"ct": {"path": name}}),
            json!({"mesh": {"path": name, "material": "titanium", "lps_from_mesh": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}}),
        ] {
            std::fs::write(folder.path().join("scene.json"), scene_of(object)).expect("written");
            let render = ["render", "scene.json", "--out", "drr.tif", "--device", "cpu"];
            assert_one_sentence(name, &unless_it_hangs(folder.path(), &render), &format!("{name} is not there"));
            cases += 1;
        }
    }
    assert_eq!(cases, 10);
    // The last is the control: a plain file is opened, and what is wrong is its content.
    for (name, words) in [
        ("pipe.dcm", "it is a named pipe, expected a file"),
        ("zero.png", "it is a device, expected a file"),
        ("large.json", "the file has 67108865 bytes, at most 67108864 are read"),
        ("plain.json", "this is no JSON text"),
    ] {
        for args in readers_of_small_files(name) {
            let output = unless_it_hangs(folder.path(), &args);
            assert_one_sentence(name, &output, words);
            let named = String::from_utf8_lossy(&output.stderr).starts_with(&format!("sidecarm: {name}: "));
            assert!(named, "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
            cases += 1;
        }
    }
    assert_eq!(cases, 26);
}

/// Commands that read `name`, which may be of any size: as a DRR, as a log, as one of two logs of which each counts once, as the maps of a
/// panel, and as what an interrupted training left.
fn readers_of_large_files(name: &str) -> Vec<Vec<&str>> {
    let mut commands = vec![
        vec!["compare", "frame.tif", name, "--quantity", "line_integral", "--out", "compared"],
        vec!["compare", "frame.tif", "frame.tif", "--quantity", "line_integral", "--detector", "panel.json", "--out", "compared"],
        vec!["replay", name, "--out", "again"],
        vec!["log", "info", name],
        vec!["log", "verify", name],
        vec!["log", "merge", name, "frame.tif", "--out", "joined.mcap"],
        vec!["attach", name, "frame.tif"],
    ];
    if cfg!(feature = "learn") {
        commands.push(vec!["train", "scatter", "set", "--out", name, "--resume"]);
    }
    commands
}

/// `compare` waited for a DRR that was a pipe for ever, and so did all that reads logs, maps and checkpoints.
#[test]
fn large_files_that_are_pipes_and_devices_are_not_opened() {
    let folder = tempfile::tempdir().expect("folder");
    let at = |name: &str| folder.path().join(name);
    let picture = Image { width: 8, height: 8, pixels: (0..64u8).map(|n| 0.01 * f32::from(n)).collect() };
    write_tiff_f32(&at("frame.tif"), &[picture]).expect("written");
    std::fs::write(at("frame.tif.json"), r#"{"quantity": "line_integral", "unit": "neper"}"#).expect("beside");
    let mut cases = 0;
    for (name, words) in [("pipe", "a named pipe"), ("zero", "a device"), ("plain", "")] {
        let maps = json!({"file": name, "sha256": "0", "pages": []});
        let panel = json!({"origin": "made up", "columns_px": 8, "rows_px": 8, "maps": maps});
        std::fs::write(at("panel.json"), panel.to_string()).expect("written");
        for file in [name.to_owned(), format!("{name}.checkpoint")] {
            match name {
                "pipe" => assert!(Command::new("mkfifo").arg(at(&file)).status().expect("mkfifo").success()),
                "zero" => std::os::unix::fs::symlink("/dev/zero", at(&file)).expect("link"),
                _ => std::fs::write(at(&file), "neither log nor picture").expect("written"),
            }
        }
        for args in readers_of_large_files(name) {
            let output = unless_it_hangs(folder.path(), &args);
            if words.is_empty() {
                // The control: it is opened, and what is wrong is its content.
                let stderr = String::from_utf8_lossy(&output.stderr);
                assert!(output.status.code() == Some(1) && !stderr.contains("it was not opened"), "{args:?}: {stderr}");
            } else {
                let file = if args[0] == "train" { format!("{name}.checkpoint") } else { name.to_owned() };
                assert_one_sentence(name, &output, &format!("{file}: it is {words}, expected a file; it was not opened"));
            }
            cases += 1;
        }
    }
    assert!(cases >= 3 * 7);
}
