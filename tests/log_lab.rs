//! Two logs of one session of the mocked lab, recorded once for all tests of `sidecarm log`: the program was stopped and started again.
#![cfg(unix)]

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use serde_json::{Value, json};
use sidecarm::acquire::Frame;
use sidecarm::record::{FrameAssembler, LogEntry, Provenance, Recorder, read_log, topic};

use crate::live_lab::{HANG_S, Lab, Live, Signal, eventually};

/// Names and origins that are planted in the session's files, and reach its log.
pub const CANARIES: [&str; 5] = ["Quaxwelk", "Annegrund", "Pfriemkoetter", "Zettelhuber", "Trullgasse"];
/// What the mocked devices say of themselves, in bytes.
pub const SERIAL_NUMBERS: [&str; 2] = ["MOCK-CARM-1", "MOCK-SNAKE-1"];

/// The session's files, and its two logs in order of time.
pub struct Recorded {
    pub kit: PathBuf,
    pub logs: [PathBuf; 2],
}

impl Recorded {
    /// What a replay of the first log finds, made once.
    pub fn replayed(&self) -> &'static Value {
        static FOUND: OnceLock<Value> = OnceLock::new();
        FOUND.get_or_init(|| {
            let (code, found) = replay(&self.logs[0], &self.kit, &self.kit.with_file_name("replayed"));
            assert_eq!(code, Some(0), "{found:#}");
            found
        })
    }
}

/// What came of a command.
pub struct Ran {
    pub code: Option<i32>,
    pub stdout: String,
    pub stderr: String,
}

impl Ran {
    pub fn json(&self) -> Value {
        serde_json::from_str(&self.stdout).unwrap_or_else(|error| panic!("{error}: {}{}", self.stdout, self.stderr))
    }
}

/// Runs `sidecarm` with `args`.
pub fn sidecarm(args: &[&str]) -> Ran {
    let run = Command::new(env!("CARGO_BIN_EXE_sidecarm")).args(args).output().expect("the program starts");
    let [stdout, stderr] = [run.stdout, run.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    assert!(!stderr.contains("panicked") && !stderr.contains("fault of this program"), "{args:?}: {stderr}");
    Ran { code: run.status.code(), stdout, stderr }
}

pub fn text(path: &Path) -> &str {
    path.to_str().expect("paths of tests are UTF-8")
}

/// Writes a JSON file of the kit anew.
fn change(path: &Path, change: impl FnOnce(&mut Value)) {
    let mut value: Value = serde_json::from_slice(&std::fs::read(path).expect("readable")).expect("JSON");
    change(&mut value);
    std::fs::write(path, value.to_string()).expect("written");
}

fn plant(kit: &Path) {
    let [bead, body, carm, robot, landmark] = CANARIES;
    change(&kit.join("beads.mrk.json"), |beads| {
        let points = beads.pointer_mut("/markups/0/controlPoints").and_then(Value::as_array_mut).expect("beads");
        points[0]["label"] = json!(bead);
        for point in points {
            let description = format!("{} body={body}", point["description"].as_str().unwrap_or_default());
            point["description"] = json!(description);
        }
    });
    change(&kit.join("carm.json"), |arm| arm["origin"] = json!(format!("measured by {carm}")));
    change(&kit.join("robot.json"), |model| model["origin"] = json!(format!("measured by {robot}")));
    let points = json!([{"label": landmark, "position": [1.0, 2.0, 3.0]}]);
    let list = json!({"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": points});
    std::fs::write(kit.join("landmarks.mrk.json"), json!({"markups": [list]}).to_string()).expect("written");
}

fn record() -> Option<Recorded> {
    let home = Path::new(env!("CARGO_TARGET_TMPDIR")).join("log-command");
    let _ = std::fs::remove_dir_all(&home);
    std::fs::create_dir_all(&home).expect("a folder");
    // Goes on long enough for a second session where the first takes its time to end; none sees an exposure and its repetition.
    let lab = Lab::start(&["--duration-s", "120", "--repeat", "10", "--faults", "none"])?;
    plant(&lab.kit);
    // Nobody says where the specimen lies: it is learnt from frames.
    let session = lab.session("session-log.json", |session| {
        session["world_from_lps"] = Value::Null;
        session["landmarks"] = json!("landmarks.mrk.json");
    });
    // The second one ends with its fourth frame.
    let logs = [("first", Some("10")), ("second", None)].map(|(name, seconds)| {
        let limit: Vec<&str> = seconds.into_iter().flat_map(|seconds| ["--seconds", seconds]).collect();
        let mut live = Live::start(&session, &home.join(name), &limit);
        if seconds.is_none() {
            let came = eventually(HANG_S, || (live.heard().images >= 4).then_some(()));
            assert!(came.is_some(), "{} frames: {}", live.heard().images, live.stderr());
            live.signalled(Signal::INT);
        }
        let ended = live.program.end(HANG_S);
        assert!(ended.is_some_and(|status| matches!(status.code(), Some(0 | 3))), "{}", live.stderr());
        assert!(live.pairs() >= 4, "{} pairs: {}", live.pairs(), live.stderr());
        live.log
    });
    let kit = home.join("kit");
    std::fs::create_dir(&kit).expect("a folder");
    for name in ["ct.nii.gz", "robot.json"] {
        std::fs::copy(lab.kit.join(name), kit.join(name)).expect("copied");
    }
    Some(Recorded { kit, logs })
}

/// The logs; `None` (said) where mock-lab was not built.
pub fn recorded() -> Option<&'static Recorded> {
    static RECORDED: OnceLock<Option<Recorded>> = OnceLock::new();
    RECORDED.get_or_init(record).as_ref()
}

/// Exit code and answer of a replay.
pub fn replay(log: &Path, kit: &Path, out: &Path) -> (Option<i32>, Value) {
    let ran = sidecarm(&["replay", text(log), "--data", text(kit), "--json", "--out", text(out)]);
    (ran.code, ran.json())
}

pub fn count(value: &Value, key: &str) -> u64 {
    value[key].as_u64().unwrap_or_else(|| value[key].as_array().map_or(u64::MAX, |list| list.len() as u64))
}

/// What `sidecarm log info` says.
pub fn info(log: &Path) -> Value {
    let ran = sidecarm(&["log", "info", text(log), "--json"]);
    assert_eq!(ran.code, Some(0), "{}{}", ran.stdout, ran.stderr);
    ran.json()
}

/// Number and arrival of each frame of which it tells.
pub fn arrivals_us(told: &Value) -> Vec<(u64, i64)> {
    let frames = told["frames"].as_array().expect("a list").iter();
    frames.map(|frame| (frame["number"].as_u64().expect("a number"), frame["arrival_us"].as_i64().expect("a time"))).collect()
}

/// The messages of a log that loses nothing.
pub fn entries(log: &Path) -> Vec<LogEntry> {
    let contents = read_log(log).expect("a log");
    assert!(contents.losses.is_empty(), "{:?}", contents.losses);
    contents.entries
}

/// Rewrites `log` to `out`; `change` alters a message, or leaves it out (false).
pub fn meddled(log: &Path, out: &Path, change: &mut dyn FnMut(&str, &mut Vec<u8>) -> bool) {
    crate::replay_meddled::meddled(log, out, change);
}

/// Leaves of a setup's scene nothing but the beads. Poses and bindings are made without the scene; what is drawn of it costs next to nothing then.
pub fn beads_alone(setup: &mut Value) {
    let mut scene: Value = serde_json::from_str(setup["scene_json"].as_str().expect("a scene")).expect("JSON");
    let objects = scene["objects"].as_array_mut().expect("a list");
    let count = objects.len();
    objects.retain(|object| !object["sphere"].is_null());
    assert!(!objects.is_empty() && objects.len() < count, "beads, and what is none");
    setup["scene_json"] = json!(scene.to_string());
}

/// As [`meddled`], of a setup with [`beads_alone`]: for controls in which poses tell.
pub fn meddled_of_beads(log: &Path, out: &Path, change: &mut dyn FnMut(&str, &mut Vec<u8>) -> bool) {
    meddled(log, out, &mut |topic, data| {
        if topic == "/session/setup" {
            let mut setup = serde_json::from_slice(data).expect("JSON");
            beads_alone(&mut setup);
            *data = setup.to_string().into_bytes();
        }
        change(topic, data)
    });
}

/// Takes a frame to record.
type Put<'a> = &'a mut dyn FnMut(&Frame, i64);

/// Records the inputs of `log` anew in `out`, without what was made of them, and with [`beads_alone`]: `change` is given each frame and its
/// arrival, and puts frames in its place.
pub fn with_other_frames(log: &Path, out: &Path, change: &mut dyn FnMut(Frame, i64, Put<'_>)) {
    let mut recorder = None;
    let mut assembler = FrameAssembler::default();
    for entry in entries(log) {
        let host_us = entry.host_us;
        let recorder = recorder
            .get_or_insert_with(|| Recorder::create(out, &Provenance::of_this_program(host_us, Value::Null)).expect("a log"));
        match &*entry.topic {
            "/session/setup" | "/session/clock" | "/session/end" => {
                let mut value = entry.json::<Value>().expect("JSON");
                if &*entry.topic == "/session/setup" {
                    beads_alone(&mut value);
                }
                recorder.json(&entry.topic, host_us, &value).expect("recorded");
            }
            topic::CARM_RAW | topic::ROBOT_RAW => {
                let device = entry.topic.trim_matches('/').trim_end_matches("/raw");
                let raw = entry.raw_bytes().expect("sound").expect("bytes");
                recorder.raw_bytes(device, raw.epoch, host_us, raw.bytes).expect("recorded");
            }
            topic::FRAME_TAGS | topic::FRAME_PIXELS => {
                if let Some(frame) = assembler.push(&entry).expect("a frame") {
                    change(frame, host_us, &mut |frame, host_us| recorder.frame(frame, host_us).expect("recorded"));
                }
            }
            _ => {}
        }
    }
    recorder.expect("a log with messages").finish().expect("finished");
}
