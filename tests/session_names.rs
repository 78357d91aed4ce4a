//! Names of files and folders that a session reads: none reaches what it writes, and a replay finds the files by their content. Through `live`.
#![cfg(unix)]

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::{Value, json};
use sidecarm::gpu::DeviceChoice;
use sidecarm::reporter::Reporter;
use sidecarm::session::Workshop;

use crate::acquire_identity::{hits, written};
use crate::crosscheck_facts::{calibration, setup};
use crate::lab_truth::wait_for_pairs;
use crate::live_lab::{HANG_S, Lab, Live, Signal};
use crate::scene_support::NiftiFile;

/// Folders and files are named after these persons.
pub const PERSONS: [&str; 7] = ["quaxwelk", "annegrund", "pfriemk", "wimmelrath", "zettelhuber", "trullgasse", "borvelde"];

/// Moves the kit's files to folders and names of persons; gives the session file.
pub fn renamed(lab: &Lab) -> PathBuf {
    let folder = lab.kit.join("Quaxwelk^Annegrund");
    std::fs::create_dir(&folder).expect("a folder");
    let link = |from: &str, to: &str| std::fs::copy(lab.kit.join(from), folder.join(to)).map(|_| ()).expect("copied");
    link("ct.nii.gz", "Pfriemk 19520317.nii.gz");
    link("beads.mrk.json", "Wimmelrath.mrk.json");
    link("carm.json", "Zettelhuber.json");
    link("robot.json", "Trullgasse.json");
    let mut scene: Value = serde_json::from_slice(&std::fs::read(lab.kit.join("scene.json")).expect("a scene")).expect("JSON");
    for object in scene["objects"].as_array_mut().expect("a list") {
        if let Some(path) = object.pointer_mut("/ct/path") {
            *path = json!("Pfriemk 19520317.nii.gz");
        }
        if let Some(model) = object.pointer_mut("/robot/model") {
            *model = json!(folder.join("Trullgasse.json"));
        }
    }
    std::fs::write(folder.join("Borvelde.json"), scene.to_string()).expect("written");
    lab.session("session-names.json", |session| {
        session["scene"] = json!("Quaxwelk^Annegrund/Borvelde.json");
        session["beads"] = json!(folder.join("Wimmelrath.mrk.json"));
        session["carm"]["calibration"] = json!("Quaxwelk^Annegrund/Zettelhuber.json");
        session["robot"]["model"] = json!("Quaxwelk^Annegrund/Trullgasse.json");
    })
}

/// A replay that remembers nothing but what lies in `cache`: its exit code and all that it printed.
pub fn replay(log: &Path, data: Option<&Path>, cache: &Path, out: &Path) -> (Option<i32>, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    command.arg("replay").arg(log).arg("--json").arg("--out").arg(out).env("XDG_CACHE_HOME", cache);
    if let Some(data) = data {
        command.arg("--data").arg(data);
    }
    let output = command.output().expect("starts");
    let words = [output.stdout, output.stderr].concat();
    (output.status.code(), String::from_utf8_lossy(&words).into_owned())
}

/// What a replay says to a person.
pub fn replay_words(log: &Path, out: &Path) -> String {
    let output =
        Command::new(env!("CARGO_BIN_EXE_sidecarm")).arg("replay").arg(log).arg("--out").arg(out).output().expect("starts");
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// A copy of the log in a folder from which nothing leads back to the session's files.
pub fn far_copy(log: &Path, home: &Path) -> PathBuf {
    let far = home.join("far/away/from/anything/session.mcap");
    std::fs::create_dir_all(far.parent().expect("folders")).expect("folders");
    std::fs::copy(log, &far).expect("copied");
    far
}

/// The terminal showed the whole path of a CT whose numbers are no Hounsfield units.
#[test]
fn what_a_session_says_of_a_ct_does_not_tell_its_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let ct = folder.path().join("Pfriemk 19520317.nii.gz");
    let values: Vec<i16> = (0..512).map(|n| n % 256).collect();
    NiftiFile::int16([8, 8, 8], &values).write(&ct);
    let scene = json!({
        "objects": [{"ct": {"path": ct, "materials": "threshold"}}], "beam": {"mono_kev": 60}, "detector": {"pitch_mm": 0.2}
    });
    let reporter = Reporter::silent();
    Workshop::open(&setup(&scene.to_string(), calibration()), DeviceChoice::Cpu, &reporter).expect("opens");
    let warned = reporter.warnings();
    let said = &warned.get("not HU").expect("8 bits are no Hounsfield units").latest;
    assert!(said.starts_with("input-") && said.contains(".nii.gz: ") && said.contains("8 bits"), "{said}");
    let all = format!("{warned:?}");
    assert!(!all.contains("Pfriemk") && !all.contains(&folder.path().display().to_string()), "{all}");
}

#[test]
fn a_session_writes_no_name_of_its_files_and_a_replay_finds_them_by_content() {
    let Some(lab) = Lab::start(&["--duration-s", "8", "--faults", "none", "--exposures", "3", "--idle-s", "300"]) else { return };
    let session = renamed(&lab);
    let home = tempfile::tempdir().expect("a folder");
    let out = home.path().join("session");
    let mut live = Live::launch(&session, &out, &["--include-existing"]);
    wait_for_pairs(&live, 3);
    live.signalled(Signal::INT);
    let ended = live.program.end(HANG_S);
    assert!(ended.is_some_and(|status| matches!(status.code(), Some(0 | 3))), "{}", live.stderr());

    let outputs = written(&out);
    let found: Vec<_> = PERSONS.iter().map(|word| (word, hits(&outputs, word))).filter(|(_, hits)| !hits.is_empty()).collect();
    assert!(found.is_empty(), "{found:?}");
    // The control: the hash of the CT stands in log, report and beside every DRR.
    let ct = lab.kit.join("ct.nii.gz");
    let sha256 = sidecarm::image::sha256_file(&ct).expect("readable");
    assert!(hits(&outputs, &sha256).len() >= 3, "{:?}", hits(&outputs, &sha256));

    // Where nothing is remembered and the CT lies far away, a replay asks for it; by content it finds it under another name.
    let (elsewhere, nothing) = (tempfile::tempdir().expect("a folder"), tempfile::tempdir().expect("a folder"));
    let log = far_copy(&live.log, home.path());
    let (code, words) = replay(&log, None, nothing.path(), &elsewhere.path().join("none"));
    assert!(code == Some(1) && words.contains("--data") && words.contains(&sha256), "{code:?}: {words}");
    let data = elsewhere.path().join("data/below");
    std::fs::create_dir_all(&data).expect("folders");
    for (from, to) in [("ct.nii.gz", "moved.nii.gz"), ("robot.json", "a.json")] {
        std::fs::copy(lab.kit.join(from), data.join(to)).expect("copied");
    }
    let mut derived = Vec::new();
    for (name, data) in [("one", Some(elsewhere.path())), ("two", Some(data.as_path()))] {
        let to = elsewhere.path().join(name);
        let (code, words) = replay(&log, data, nothing.path(), &to);
        assert!(code == Some(0), "{words}");
        let mut files: Vec<_> = written(&to).into_iter().filter(|(name, _)| !name.ends_with("timings.json")).collect();
        files.iter_mut().for_each(|(name, _)| *name = name.replace(&to.display().to_string(), ""));
        files.sort();
        derived.push(files);
    }
    assert!(derived[0] == derived[1] && derived[0].len() > 8, "two replays are byte-identical wherever the CT lies");
}
