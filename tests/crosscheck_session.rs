//! Sessions whose files contradict each other, through `check`.
#![cfg(unix)]

use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use serde_json::{Value, json as value};
use serialport::{SerialPort, TTYPort};

use crate::crosscheck_image::{json, kit};
use crate::session_demo::mock_is_built;

fn write(path: &Path, value: &Value) {
    std::fs::write(path, format!("{value:#}")).expect("written");
}

/// A copy of the kit's small files in a folder beside it; the CT and the frames are linked.
pub fn copy(lab: &Path, name: &str) -> PathBuf {
    let to = lab.with_file_name(name);
    std::fs::create_dir(&to).expect("new");
    for file in ["beads.mrk.json", "landmarks.mrk.json", "carm.json", "robot.json", "scene.json", "session.json"] {
        std::fs::copy(lab.join(file), to.join(file)).expect("copied");
    }
    for linked in ["ct.nii.gz", "frames", "ttyCARM", "ttyROBOT"] {
        std::os::unix::fs::symlink(lab.join(linked), to.join(linked)).expect("linked");
    }
    to
}

pub fn edit(folder: &Path, file: &str, change: impl FnOnce(&mut Value)) {
    let path = folder.join(file);
    let mut content = json(&path);
    change(&mut content);
    write(&path, &content);
}

/// Changes every bead's position.
pub fn move_beads(folder: &Path, change: impl Fn([f64; 3]) -> [f64; 3]) {
    edit(folder, "beads.mrk.json", |beads| {
        let points = beads["markups"][0]["controlPoints"].as_array_mut().expect("points");
        assert!(points.len() >= 6);
        for point in points {
            let position: [f64; 3] = serde_json::from_value(point["position"].clone()).expect("three");
            point["position"] = value!(change(position));
        }
    });
}

/// Takes the CT out of the scene, which costs a pair most and says nothing of beads and robot.
pub fn take_ct_away(folder: &Path) {
    edit(folder, "scene.json", |scene| scene["objects"].as_array_mut().expect("a list").retain(|object| object["ct"].is_null()));
}

/// What `sidecarm check --json` says, by check, level and words, and its exit code.
pub fn check(folder: &Path) -> (Vec<(String, String, String)>, i32) {
    check_within(folder, &std::env::temp_dir())
}

/// The same without the exposure that is rehearsed, which has no place for its files: for faults that other checks name. Its exit code is always
/// 1.
pub fn check_unrehearsed(folder: &Path) -> (Vec<(String, String, String)>, i32) {
    check_within(folder, &folder.join("nowhere"))
}

/// The same; its temporary files go to `temporary`.
pub fn check_within(folder: &Path, temporary: &Path) -> (Vec<(String, String, String)>, i32) {
    let session = folder.join("session.json");
    let run = Command::new(env!("CARGO_BIN_EXE_sidecarm"))
        .arg("check")
        .arg(session)
        .args(["--json", "--limit", "200"])
        .env("TMPDIR", temporary)
        .output()
        .expect("runs");
    let found: Value = serde_json::from_slice(&run.stdout).unwrap_or_else(|_| panic!("{}", String::from_utf8_lossy(&run.stderr)));
    let word = |row: &Value, key: &str| row[key].as_str().unwrap_or_default().to_owned();
    let rows = found["checks"].as_array().expect("a list");
    let rows = rows
        .iter()
        .map(|row| (word(row, "check"), word(row, "level"), format!("{} → {}", word(row, "detail"), word(row, "remedy"))));
    (rows.collect(), run.status.code().unwrap_or(-1))
}

type Fault = (&'static str, fn(&Path), &'static str, &'static str, &'static [&'static str]);

/// Faults of files: name, how, the check that names it, its level, words that it uses.
const FILE_FAULTS: [Fault; 19] = [
    (
        "ras",
        |lab| edit(lab, "beads.mrk.json", |b| b["markups"][0]["coordinateSystem"] = value!("RAS")),
        "beads and spheres",
        "fail",
        &["RAS and LPS were swapped", "says RAS but its numbers are LPS", "set its coordinateSystem to \"LPS\""],
    ),
    (
        "lps",
        |lab| move_beads(lab, |[x, y, z]| [-x, -y, z]),
        "beads and spheres",
        "fail",
        &["RAS and LPS were swapped", "says LPS but its numbers are RAS", "set its coordinateSystem to \"RAS\""],
    ),
    ("mirrored", |lab| move_beads(lab, |[x, y, z]| [-x, y, z]), "beads and spheres", "fail", &["mirrored (x negated)"]),
    ("exchanged", |lab| move_beads(lab, |[x, y, z]| [z, x, y]), "beads and spheres", "fail", &["axes were exchanged"]),
    (
        "shifted",
        |lab| move_beads(lab, |[x, y, z]| [x + 14.0, y, z - 9.0]),
        "beads and spheres",
        "fail",
        &["shifted by (14.0, 0.0, -9.0) mm"],
    ),
    (
        "metres",
        |lab| move_beads(lab, |p| p.map(|v| v * 1e-3)),
        "bead units",
        "fail",
        &["metres", "millimetres", "\"coordinateUnits\": \"m\""],
    ),
    (
        "centimetres",
        |lab| move_beads(lab, |p| p.map(|v| v * 0.1)),
        "beads and spheres",
        "fail",
        &["they were in centimetres", "\"coordinateUnits\": \"cm\""],
    ),
    (
        "other specimen",
        |lab| {
            edit(lab, "scene.json", |scene| {
                scene["objects"].as_array_mut().expect("a list").retain(|object| object["sphere"].is_null())
            });
            move_beads(lab, |[x, y, z]| [x + 400.0, y, z]);
        },
        "beads in specimen",
        "fail",
        &["more than 8 mm from any matter", "same specimen"],
    ),
    (
        "sid",
        |lab| edit(lab, "carm.json", |c| c["source_to_detector_mm"] = value!(1.02)),
        "calibration",
        "fail",
        &["source_to_detector_mm is 1.02", "metres"],
    ),
    (
        "pitch",
        |lab| edit(lab, "carm.json", |c| c["pitch_mm"] = value!(194.0)),
        "calibration",
        "fail",
        &["pitch_mm is 194", "microns"],
    ),
    ("half pitch", |lab| edit(lab, "carm.json", |c| c["pitch_mm"] = value!(0.194)), "scene pitch", "warn", &["0.388", "0.194"]),
    (
        "size",
        |lab| edit(lab, "carm.json", |c| (c["columns_px"], c["rows_px"]) = (value!(1240), value!(960))),
        "frame size",
        "warn",
        &["[620, 480]", "[1240, 960]", "\"binning\": 2"],
    ),
    (
        "room",
        |lab| {
            edit(lab, "session.json", |s| {
                for row in 0..3 {
                    let mm = s["world_from_lps"][row][3].as_f64().expect("a number");
                    s["world_from_lps"][row][3] = value!(mm * 1e-3);
                }
            })
        },
        "specimen in room",
        "fail",
        &["world_from_lps", "metres"],
    ),
    ("kvp", |lab| edit(lab, "scene.json", |s| s["beam"]["tube_kvp"] = value!(120)), "kVp", "warn", &["90", "120"]),
    (
        "out",
        |lab| edit(lab, "session.json", |s| s["out"] = value!("carm.json/session")),
        "disk",
        "fail",
        &["cannot be written", "choose another --out"],
    ),
    (
        "among frames",
        |lab| edit(lab, "session.json", |s| s["out"] = value!("frames/run")),
        "own folder",
        "warn",
        &["lies in the folder in which frames are looked for", "choose another --out"],
    ),
    (
        "frames among strips",
        |lab| {
            std::fs::create_dir_all(lab.join("session/strips")).expect("a folder");
            edit(lab, "session.json", |s| s["frames"]["folder"] = value!("session/strips"));
        },
        "own folder",
        "fail",
        &["among what the session writes", "choose another --out"],
    ),
    (
        "frames' folder",
        |lab| edit(lab, "session.json", |s| s["out"] = value!("frames/../frames")),
        "own folder",
        "fail",
        &["is the folder in which frames are looked for", "choose another --out"],
    ),
    (
        "misspelt",
        |lab| {
            edit(lab, "beads.mrk.json", |beads| {
                beads["markups"][0]["controlPoints"][0]["description"] = value!("radious_mm=0.75, sat well");
            })
        },
        "bead descriptions",
        "warn",
        &["radious_mm= in the description", "write it as in radius_mm=0.75", "docs/beads.md"],
    ),
];

/// Those that one run of the check can name beside each other: neither hides the other, and different checks find them.
const TOGETHER: [&[&str]; 11] = [
    &["ras", "kvp"],
    &["lps", "out"],
    &["mirrored", "among frames"],
    &["exchanged", "frames among strips"],
    &["shifted", "frames' folder"],
    &["metres", "half pitch"],
    &["other specimen", "size"],
    &["sid", "misspelt"],
    &["pitch"],
    &["centimetres"],
    &["room"],
];

#[test]
fn faults_of_files_are_each_named_with_their_remedy() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let lab = kit(folder.path(), &["--exposures", "1"]);
    edit(&lab, "session.json", |session| session["robot"] = Value::Null);
    // Without a robot's line the check says so; without ports it says so: both are in every run, and are none of the seeded faults.
    let (good, _) = check(&copy(&lab, "good"));
    let doubtful =
        |row: &&(String, String, String)| row.1 != "pass" && row.0 != "robot" && row.0 != "C-arm port" && row.0 != "disk space";
    assert_eq!(good.iter().filter(doubtful).collect::<Vec<_>>(), Vec::<&(String, String, String)>::new());
    for named in ["beads and spheres", "beads in specimen", "calibration", "specimen in room", "synthetic exposure", "disk", "CT"]
    {
        assert!(good.iter().any(|row| row.0 == named && row.1 == "pass"), "{named} is missing: {good:#?}");
    }
    let mut named = TOGETHER.concat();
    named.sort_unstable();
    let mut all = FILE_FAULTS.map(|fault| fault.0);
    all.sort_unstable();
    assert_eq!(named, all, "each once");
    let run = |names: &&[&str]| {
        let spoiled = copy(&lab, &names.join(" and "));
        let faults: Vec<&Fault> = FILE_FAULTS.iter().filter(|fault| names.contains(&fault.0)).collect();
        for (_, spoil, ..) in faults.iter().copied() {
            spoil(&spoiled);
        }
        let (rows, _) = check_unrehearsed(&spoiled);
        for (name, _, check_name, level, words) in faults {
            let row = rows.iter().find(|row| row.0 == *check_name && row.1 == *level);
            let row = row.unwrap_or_else(|| panic!("{name}: no {level} of '{check_name}' in {rows:#?}"));
            for word in *words {
                assert!(row.2.contains(word), "{name}: '{word}' is not in: {}", row.2);
            }
            assert!(!row.2.ends_with("→ "), "{name}: no remedy");
        }
        assert!(rows.iter().any(|row| row.0 == "C-arm port" && row.1 == "fail"), "{names:?}: {rows:#?}");
    };
    let run = &run;
    std::thread::scope(|scope| {
        let threads: Vec<_> = TOGETHER.chunks(3).map(|chunk| scope.spawn(move || chunk.iter().for_each(run))).collect();
        threads.into_iter().for_each(|thread| thread.join().expect("every fault is named"));
    });
}

/// The mocked laboratory in real time; stopped when dropped.
pub struct Mock {
    child: Child,
    pub lab: PathBuf,
}

impl Mock {
    pub fn start(folder: &Path, options: &[&str]) -> Self {
        let program =
            Path::new(env!("CARGO_BIN_EXE_sidecarm")).with_file_name(format!("mock-lab{}", std::env::consts::EXE_SUFFIX));
        let lab = folder.join("lab");
        let mut command = Command::new(program);
        command.arg("--out").arg(&lab).arg("--drawn").arg(crate::live_lab::drawn()).args(options);
        let mut child = command.stdout(Stdio::piped()).spawn().expect("starts");
        let mut line = String::new();
        let mut lines = BufReader::new(child.stdout.take().expect("piped"));
        lines.read_line(&mut line).expect("an event");
        assert!(line.contains("ready"), "{line}");
        std::thread::spawn(move || std::io::copy(&mut lines, &mut std::io::sink()));
        Self { child, lab }
    }
}

impl Drop for Mock {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[test]
fn faults_of_ports_and_telemetry_are_each_named_with_their_remedy() {
    if !mock_is_built() {
        return;
    }
    let folder = tempfile::tempdir().expect("temporary folder");
    let mock =
        Mock::start(folder.path(), &["--duration-s", "60", "--exposures", "1", "--faults", "none", "--start-delay-s", "0"]);
    let (good, code) = check(&copy(&mock.lab, "good"));
    let doubtful: Vec<_> = good.iter().filter(|row| row.1 != "pass" && row.0 != "disk space").collect();
    assert!(doubtful.is_empty() && code == 0, "{doubtful:#?}");
    let port = |rows: &[(String, String, String)], name: &str| rows.iter().find(|row| row.0 == name).expect("listed").clone();

    let swapped = copy(&mock.lab, "swapped");
    edit(&swapped, "session.json", |s| (s["carm"]["port"], s["robot"]["port"]) = (value!("ttyROBOT"), value!("ttyCARM")));
    let (rows, code) = check(&swapped);
    for name in ["C-arm port", "robot port"] {
        let (_, level, words) = port(&rows, name);
        assert!(level == "fail" && words.contains("the two ports are swapped"), "{words}");
    }
    assert_eq!(code, 1);

    let limits = copy(&mock.lab, "limits");
    edit(&limits, "robot.json", |robot| robot["max_bend_deg"] = value!(5.0));
    edit(&limits, "scene.json", |scene| scene["beam"]["tube_kvp"] = value!(120));
    let (rows, code) = check(&limits);
    let (_, level, words) = port(&rows, "robot limits");
    assert!(level == "warn" && words.contains("-7.90 to 7.90") && words.contains("clamps at 5"), "{words}");
    let (_, level, words) = port(&rows, "kVp");
    assert!(level == "warn" && words.contains("by telemetry 90") && words.contains("renders 120"), "{words}");
    assert_eq!(code, 0, "warnings alone do not fail: {rows:#?}");

    // A port that is open and silent, and one with another baud rate: bytes that mean nothing.
    let pty = || TTYPort::pair().expect("pseudo-terminals are there");
    let ((_silent, silent_end), (mut noisy, noisy_end)) = (pty(), pty());
    let path = |mut end: TTYPort| {
        end.set_exclusive(false).expect("can be shared");
        end.name().expect("a path")
    };
    let (silent_path, noisy_path) = (path(silent_end), path(noisy_end));
    let stop = Arc::new(AtomicBool::new(false));
    let stopped = Arc::clone(&stop);
    let noise = std::thread::spawn(move || {
        let mut n = 1u32;
        while !stopped.load(Ordering::Relaxed) {
            n = n.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let _ = noisy.write_all(&[(n >> 24) as u8, (n >> 16) as u8, 0]);
            std::thread::sleep(Duration::from_millis(1));
        }
    });
    let broken = copy(&mock.lab, "broken");
    edit(&broken, "session.json", |s| (s["carm"]["port"], s["robot"]["port"]) = (value!(silent_path), value!(noisy_path)));
    let (rows, _) = check_unrehearsed(&broken);
    stop.store(true, Ordering::Relaxed);
    noise.join().expect("ends");
    let (_, level, words) = port(&rows, "C-arm port");
    assert!(level == "fail" && words.contains("silent"), "{words}");
    let (_, level, words) = port(&rows, "robot port");
    assert!(level == "fail" && words.contains("no robot sample") && words.contains("baud rate"), "{words}");
}
