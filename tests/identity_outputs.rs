//! Planted names, dates and identifiers (`acquire_identity`) in what is made of a session afterwards, in what others hear of it, and in what is
//! said before it: none comes out.
#![cfg(unix)]

use std::io::Read;
use std::net::TcpStream;
use std::path::Path;

use dicom_core::VR;
use dicom_dictionary_std::tags;
use serde_json::json;

use crate::acquire_frames::save;
use crate::acquire_identity::{NAMES, hits, holds_no_canary, plant_header, planted, ran, written};
use crate::acquire_live::Room;
use crate::calibrate_detector::panel;
use crate::crosscheck_session::edit;
use crate::igtl_session::address;
use crate::lab_truth::{hand_on, put, wait_for_pairs};
use crate::live_lab::{HANG_S, Lab, Live, Signal, eventually};
use crate::session_names::{PERSONS, renamed};

type Outputs = Vec<(String, Vec<u8>)>;

/// What each command prints in `folder`, under its words; each ends with 0, or with 3 where the log's session had lost something.
fn printed(folder: &Path, commands: &[&[&str]]) -> Outputs {
    commands.iter().map(|arguments| (arguments.join(" "), ran(folder, arguments, &[0, 3]))).collect()
}

fn is_found(outputs: &Outputs, word: &str, in_what: &str) {
    let found = hits(outputs, word);
    assert!(found.iter().any(|name| name.contains(in_what)), "control: '{word}' is not in {in_what}, but in {found:?}");
}

/// The lab's frames with a person's header, from a folder with a person's name: DRRs with what stands beside them, the strips, what goes over
/// OpenIGTLink, and all that is made of the log.
#[test]
fn nothing_that_identifies_anybody_comes_out_of_a_session_with_poses_or_of_its_log() {
    const FRAMES: usize = 3;
    let Some(lab) = Lab::start(&["--duration-s", "12", "--faults", "none", "--exposures", "3", "--idle-s", "300"]) else {
        return;
    };
    let lab = lab.without_ct();
    let frames = lab.kit.join("Meisterfolder");
    std::fs::create_dir(&frames).expect("a folder");
    let session = lab.session("watched.json", |session| {
        session["frames"]["folder"] = json!("Meisterfolder");
        session["igtl"] = json!({ "port": 0 });
    });
    let home = lab.kit.parent().expect("a folder").to_owned();
    let mut live = Live::launch(&session, &home.join("session"), &[]);
    let address = eventually(HANG_S, || address(&live.stderr())).unwrap_or_else(|| panic!("it listens: {}", live.stderr()));
    let mut stream = TcpStream::connect(address).expect("it listens");
    let listener = std::thread::spawn(move || {
        let mut heard = Vec::new();
        // However the other side lets go: what came is looked at.
        let _ = stream.read_to_end(&mut heard);
        heard
    });
    hand_on(&lab, &frames, FRAMES, |counter, mut object, to| {
        plant_header(&mut object);
        // Of each picture its own, with the canary in it.
        put(&mut object, tags::SOP_INSTANCE_UID, VR::UI, &format!("1.2.826.0.1.3680043771239.{counter}"));
        object.write_to_file(to).expect("written");
    });
    wait_for_pairs(&live, FRAMES);
    live.signalled(Signal::INT);
    let ended = live.program.end(HANG_S);
    assert!(ended.is_some_and(|status| matches!(status.code(), Some(0 | 3))), "{}", live.stderr());

    let mut outputs = written(&live.out);
    outputs.push(("terminal".to_owned(), (live.stdout() + &live.stderr()).into_bytes()));
    outputs.push(("OpenIGTLink".to_owned(), listener.join().expect("it listens to the end")));
    is_found(&outputs, "lpstocamera", "OpenIGTLink");
    is_found(&outputs, "frame-001", "OpenIGTLink");
    let sidecars = outputs.iter().filter(|(name, _)| name.contains("/drr/") && name.ends_with(".tif.json")).count();
    assert!(sidecars >= 2, "{sidecars} of {FRAMES} frames have a DRR: {}", live.stderr());

    for folder in ["cut", "redacted"] {
        std::fs::create_dir(home.join(folder)).expect("a folder");
    }
    let log = "session/session.mcap";
    outputs.extend(printed(
        &home,
        &[
            &["log", "info", log],
            &["log", "info", log, "--json"],
            &["log", "verify", log, "--lines"],
            &["log", "verify", log, "--json"],
            &["log", "csv", log, "--out", "tables"],
            &["log", "cut", log, "--from", "0", "--to", "3600", "--out", "cut/session.mcap"],
            &["log", "redact", log, "--out", "redacted/session.mcap", "--json"],
            &["log", "video", log, "--out", "pairs.avi", "--json"],
        ],
    ));
    for folder in ["tables", "cut", "redacted"] {
        let made = written(&home.join(folder));
        assert!(made.iter().any(|(_, bytes)| bytes.len() > 1000), "{folder} is empty");
        outputs.extend(made);
    }
    is_found(&outputs, "accepted", "log info");
    is_found(&outputs, "orbital_deg", "tables");
    holds_no_canary(&outputs);
}

/// Two sessions of planted frames, joined.
#[test]
fn nothing_that_identifies_anybody_comes_out_of_logs_that_are_joined() {
    let room = Room::new("Meisterfolder/frames");
    let home = room.folder.path();
    let mut outputs = Outputs::new();
    for (number, session) in ["first", "second"].into_iter().enumerate() {
        save(planted(10 + 40 * number as u16), &room.frames.join(NAMES[number].0));
        let ended = room.end(room.start(6.0));
        let words = String::from_utf8_lossy(&ended.stderr).into_owned();
        assert_eq!(ended.pairs.len(), number + 1, "{words}");
        outputs.push((session.to_owned(), [ended.stdout, ended.stderr].concat()));
        std::fs::rename(room.out(), home.join(session)).expect("renamed");
    }
    std::fs::create_dir(home.join("merged")).expect("a folder");
    let join = ["log", "merge", "first/session.mcap", "second/session.mcap", "--out", "merged/session.mcap"];
    outputs.extend(printed(home, &[&join, &["log", "info", "merged/session.mcap", "--json"]]));
    outputs.extend(written(&home.join("merged")));
    assert!(outputs.iter().any(|(name, bytes)| name.ends_with("merged/session.mcap") && bytes.len() > 1000), "it was joined");
    holds_no_canary(&outputs);
}

/// Folders and files called after persons, none of which `check` names: it printed the paths of frames, calibrations and the session's folder.
#[test]
fn a_check_does_not_name_the_folders_and_files_of_a_session() {
    let Some(mut lab) = Lab::start(&["--kit-only", "--exposures", "1"]) else { return };
    lab.mock.end(HANG_S).expect("the kit is written");
    let session = renamed(&lab);
    let name = session.file_name().and_then(|name| name.to_str()).expect("a name").to_owned();
    std::fs::rename(lab.frames(), lab.kit.join("Wimmelrath")).expect("renamed");
    edit(&lab.kit, &name, |session| {
        session["frames"]["folder"] = json!("Wimmelrath");
        session["out"] = json!("Borvelde/run");
        session["carm"]["port"] = json!("Quaxwelk^Annegrund/ttyCARM");
        session["robot"]["port"] = json!("Quaxwelk^Annegrund/ttyROBOT");
    });
    std::fs::create_dir(lab.kit.join("Borvelde")).expect("a folder");
    let checked = || {
        let printed = ran(&lab.kit, &["check", &name, "--limit", "300"], &[1]);
        let words = String::from_utf8_lossy(&printed).into_owned();
        let outputs = [("printed".to_owned(), printed)];
        let found: Vec<&str> = PERSONS.into_iter().filter(|person| !hits(&outputs, person).is_empty()).collect();
        assert!(found.is_empty(), "{found:?} in {words}");
        words
    };
    let words = checked();
    // The control: each is told under a name that may be shown, and all checks were made.
    for label in ["carm.json: ", "robot.json: ", "ttyCARM: ", "frames: a folder", "beads in beads.mrk.json", "GB free where"] {
        assert!(words.contains(label), "'{label}' is not in {words}");
    }
    assert!(words.contains("synthetic exposure") && !words.contains("not all checks"), "{words}");
    // A scene that cannot be loaded does not tell which files it names; the error did.
    std::fs::remove_file(lab.kit.join("Quaxwelk^Annegrund/Pfriemk 19520317.nii.gz")).expect("removed");
    let words = checked();
    for told in ["scene.json: objects[", "file.nii.gz is not there", "looked in the scene's folder"] {
        assert!(words.contains(told), "'{told}' is not in {words}");
    }
}

/// Air frames of a panel and a picture without a tag, with a person's header.
#[test]
fn nothing_that_identifies_anybody_comes_out_of_a_panel_s_calibration_or_a_search_for_tags() {
    let Some(panel) = panel(&["--seed", "101"]) else { return };
    let folder = panel.folder.path();
    let mut frames = Vec::new();
    for path in panel.files("air-").into_iter().chain(panel.files("dark-")) {
        let mut object = dicom_object::open_file(&path).expect("a DICOM file");
        plant_header(&mut object);
        object.write_to_file(&path).expect("written");
        frames.push(path.file_name().and_then(|name| name.to_str()).expect("a name").to_owned());
    }
    let (air, dark): (Vec<&String>, Vec<&String>) = frames.iter().partition(|name| name.starts_with("air-"));
    let mut command = vec!["calibrate", "detector"];
    command.extend(air.iter().map(|name| name.as_str()));
    command.extend(["--out", "detector.json", "--bits", "14", "--counting", "--dark"]);
    command.extend(dark.iter().map(|name| name.as_str()));
    let mut outputs = vec![("calibrate detector".to_owned(), ran(folder, &command, &[0]))];
    outputs.push(("tags".to_owned(), ran(folder, &["tags", air[0], "--json"], &[1])));
    let record = std::fs::read(folder.join("detector.json")).expect("the calibration");
    assert!(record.len() > 500 && folder.join("detector.tif").is_file(), "it was calibrated");
    outputs.push(("detector.json".to_owned(), record));
    outputs.push(("detector.tif".to_owned(), std::fs::read(folder.join("detector.tif")).expect("the maps")));
    is_found(&outputs, "20261121", "detector.json");
    holds_no_canary(&outputs);
}
