//! The main job, end to end: mocked devices on pseudo-terminals, log, replay, a log that was cut.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

use sidecarm::record::{LogEntry, read_log, topic};

use crate::live_lab::drawn;

fn sidecarm(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_sidecarm")).args(args).output().expect("the program starts")
}

pub fn mock_is_built() -> bool {
    let built =
        Path::new(env!("CARGO_BIN_EXE_sidecarm")).with_file_name(format!("mock-lab{}", std::env::consts::EXE_SUFFIX)).exists();
    if !built {
        println!("skipped: mock-lab is not beside sidecarm; cargo build --workspace makes it");
    }
    built
}

fn files_below(folder: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).expect("folder").flatten() {
        match entry.path() {
            path if path.is_dir() => found.extend(files_below(&path)),
            path => found.push(path),
        }
    }
    found
}

fn text(path: &Path) -> &str {
    path.to_str().expect("temporary paths are UTF-8")
}

fn json(bytes: &[u8]) -> serde_json::Value {
    serde_json::from_slice(bytes).expect("JSON")
}

fn words(run: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&run.stdout), String::from_utf8_lossy(&run.stderr))
}

/// A demo's folder and what it said, run once for all tests that read what it left; `None` (said) where mock-lab was not built.
pub fn demo() -> Option<&'static (PathBuf, Output)> {
    static DEMO: OnceLock<Option<(PathBuf, Output)>> = OnceLock::new();
    let run = || {
        let lab = Path::new(env!("CARGO_TARGET_TMPDIR")).join("demo");
        let _ = std::fs::remove_dir_all(&lab);
        let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
        command.args(["demo", "--headless", "--seconds", "10", "--out", text(&lab)]).env("MOCK_LAB_DRAWN", drawn());
        let run = command.output().expect("the program starts");
        assert!(run.status.success(), "{}", words(&run));
        (lab, run)
    };
    DEMO.get_or_init(|| mock_is_built().then(run)).as_ref()
}

#[test]
fn a_mocked_session_matches_its_frames_and_replays_byte_for_byte() {
    let Some((lab, run)) = demo() else { return };
    let folder = tempfile::tempdir().expect("temporary folder");
    let session = lab.join("session");
    let pairs = json(&std::fs::read(session.join("pairs.json")).expect("pairs"));
    let pairs = pairs["pairs"].as_array().expect("a list");
    assert!(pairs.len() >= 6, "{} pairs", pairs.len());
    assert_foxglove_shows(&session.join("session.mcap"));
    let accepted: Vec<_> = pairs.iter().filter(|pair| pair["status"] == "accepted").collect();
    assert!(accepted.len() >= 5, "{} accepted", accepted.len());
    // On a crowded machine the session may end before the seventh exposure's frame.
    let told: Vec<_> = pairs.iter().map(|pair| format!("{} {} {}", pair["frame"], pair["status"], pair["reason"])).collect();
    let collimated = pairs.iter().find(|pair| pair["frame"] == "frame-007");
    assert!(pairs.len() < 8 || collimated.is_some(), "{told:#?}");
    // There it may also come before two others have tied the specimen to the room, and then nothing else gives it a pose.
    let refused =
        |pair: &serde_json::Value| pair["status"] == "refused" || (pair["status"] == "no_pose" && pair["pose_source"] == "none");
    assert!(collimated.is_none_or(refused), "the collimated frame is refused: {told:#?}");
    for pair in pairs {
        assert_eq!(pair["binding"], "counter", "every exposure's frame is bound when it is developed: {pair}");
    }
    for pair in &accepted {
        let number = |value: &serde_json::Value| value.as_f64().unwrap_or(f64::NAN);
        assert!(number(&pair["truth"]["mean_px"]) < 0.2, "{}: {}", pair["frame"], pair["truth"]);
        assert!(number(&pair["scores"]["zncc"]) > 0.99, "{}: {}", pair["frame"], pair["scores"]["zncc"]);
        assert_eq!(pair["binding"], "counter");
    }
    // The mocked robot is where telemetry has it, and the frames show it there.
    let tips: Vec<&serde_json::Value> = accepted.iter().map(|pair| &pair["tip"]).filter(|tip| tip.is_object()).collect();
    assert!(tips.len() + 1 >= accepted.len(), "{} of {} frames show the tip", tips.len(), accepted.len());
    for tip in tips {
        assert!(tip["length_mm"].as_f64().is_some_and(|mm| mm < 0.6), "{tip}");
    }
    // Once two frames have tied the specimen to the room, telemetry is measured against the beads of each.
    let turns: Vec<f64> = accepted.iter().filter_map(|pair| pair["innovation"]["turn_deg"].as_f64()).collect();
    assert!(turns.len() + 3 >= accepted.len() && turns.iter().all(|deg| *deg < 1.0), "{turns:?} of {} accepted", accepted.len());
    for file in ["report.html", "strips/001.png", "drr/001.tif", "drr/001.tif.json"] {
        assert!(session.join(file).exists(), "{file}");
    }
    let report = std::fs::read_to_string(session.join("report.html")).expect("report");
    // The truth is read after the session; the report was written before that, and never had it.
    assert!(report.contains("truth error"), "the report tells the error against the truth");
    assert!(!report.contains("Mockpatient") && !report.contains("MOCK-ID-4711"));
    // A page of ten frames with its small pictures is no larger than a megabyte.
    let held = report.matches("data:image/jpeg;base64,").count();
    assert!(
        held == pairs.len() && report.len() <= 100_000 * held,
        "{} bytes for {held} pictures of {}",
        report.len(),
        pairs.len()
    );

    let log = session.join("session.mcap");
    let replayed = sidecarm(&["replay", text(&log), "--json", "--out", text(&folder.path().join("replayed"))]);
    assert_eq!(replayed.status.code(), Some(0), "{}", words(&replayed));
    let found = json(&replayed.stdout);
    assert_losses_are_told(&report, &String::from_utf8_lossy(&run.stdout), &found);
    // A frame that is bound late, as on a crowded machine, is posed and drawn once more.
    for what in ["poses", "images"] {
        let identical = found[format!("{what}_identical")].as_u64().expect("a count");
        assert!(identical >= pairs.len() as u64, "{identical} {what} of {} pairs", pairs.len());
        assert_eq!(found[format!("{what}_different")].as_array().map(Vec::len), Some(0), "{what}");
    }
    assert_eq!(found["poses_missing"].as_array().map_or(0, Vec::len), 0);

    // Whatever is derived is the same byte for byte in a second replay, on whatever day; how long it took stands apart.
    let again = sidecarm(&["replay", text(&log), "--json", "--out", text(&folder.path().join("again"))]);
    assert_eq!(again.status.code(), Some(0), "{}", words(&again));
    let mut compared = 0;
    for file in files_below(&folder.path().join("replayed")) {
        if file.file_name().is_some_and(|name| name == "timings.json") {
            continue;
        }
        let inside = file.strip_prefix(folder.path().join("replayed")).expect("inside");
        let (one, other) = (std::fs::read(&file).expect("file"), std::fs::read(folder.path().join("again").join(inside)));
        assert!(other.is_ok_and(|other| other == one), "{} differs between two replays", inside.display());
        compared += 1;
    }
    assert!(compared >= 2 + 3 * pairs.len(), "{compared} files");
    // A replay never writes into the session's folder, not even the same bytes.
    let state_of = |path: PathBuf| {
        let modified = std::fs::metadata(&path).and_then(|about| about.modified()).expect("a time");
        let bytes = std::fs::read(&path).expect("readable");
        (path, (modified, bytes))
    };
    let state = || files_below(&session).into_iter().map(state_of).collect::<BTreeMap<_, _>>();
    let before = state();
    let own = sidecarm(&["replay", text(&log), "--out", text(&session)]);
    assert_eq!(own.status.code(), Some(1), "{}", words(&own));
    let reason = format!("{}: holds a session's own files", text(&session));
    assert!(words(&own).contains(&reason) && words(&own).contains("choose another --out"), "{}", words(&own));
    assert!(before.contains_key(&log) && before == state(), "a replay has changed the session's folder");

    // A log cut in the middle: what is there is replayed, the loss is said, exit code 3.
    let bytes = std::fs::read(&log).expect("log");
    assert!(!bytes.windows(11).any(|window| window == b"Mockpatient"), "identity is not in the log");
    let cut = folder.path().join("cut.mcap");
    std::fs::write(&cut, &bytes[..bytes.len() / 2]).expect("written");
    let replayed = sidecarm(&["replay", text(&cut), "--json", "--out", text(&folder.path().join("cut"))]);
    let found = json(&replayed.stdout);
    assert_eq!(replayed.status.code(), Some(3), "{found}");
    assert!(found["losses"].as_array().is_some_and(|losses| !losses.is_empty()));
    assert_eq!(found["poses_different"].as_array().map(Vec::len), Some(0), "{found}");
}

/// A count in the report's table of lines.
fn counter_of(report: &str, device: &str, counter: &str) -> Option<u64> {
    let head = report.split("<th class=\"l\">link</th>").nth(1)?;
    let column = head.split("</tr>").next()?.split("<th>").position(|name| name.starts_with(&format!("{counter}<")))?;
    let row = head.split(&format!("<td class=\"l\">{device}</td>")).nth(1)?;
    row.split("<td>").nth(column)?.split('<').next()?.parse().ok()
}

/// The number before `what` in a sentence; 0 where it says nothing of it.
fn count_of(sentence: &str, what: &str) -> u64 {
    let Some((before, _)) = sentence.split_once(what) else { return 0 };
    before.rsplit(' ').next().and_then(|number| number.parse().ok()).unwrap_or_else(|| panic!("{what}: {sentence}"))
}

/// What the mocks spoil on purpose is told by the terminal, the report and the replay (`found`) with the same counts, and nobody says that
/// nothing was lost.
fn assert_losses_are_told(report: &str, printed: &str, found: &serde_json::Value) {
    assert!(!report.to_lowercase().contains("nothing was lost"), "{printed}");
    let of_replay = found["session_losses"].as_array().expect("a list");
    for (device, key) in [("C-arm", "carm"), ("robot", "robot")] {
        let start = format!("lost    {device}: ");
        let line = printed.lines().find(|line| line.starts_with(&start)).unwrap_or_else(|| panic!("{start}: {printed}"));
        let sentence = line.trim_start_matches("lost    ").trim_end_matches(" (faults that the demo injects)");
        assert!(report.contains(sentence), "not in the report: {sentence}");
        assert!(of_replay.iter().any(|loss| loss == sentence), "{sentence}: {of_replay:?}");
        let told = [
            ("lost", " packets lost on the line"),
            ("missed_unplugged", " packets missed while it was unplugged"),
            ("corrupt", " corrupt packets"),
        ]
        .map(|(counter, what)| {
            let count = count_of(sentence, what);
            assert_eq!(counter_of(report, key, counter), Some(count), "{counter}: {sentence}");
            count
        });
        // Each line has a packet dropped and one in which a bit is wrong, and is unplugged.
        assert!(told[0] >= 2 && told[1] >= 1 && told[2] >= 1, "{sentence}");
    }
}

/// Foxglove's annotations lay 0.6 s beside the only image that there was, the tree had one frame, and joints had no message of theirs.
fn assert_foxglove_shows(log: &Path) {
    let entries = read_log(log).expect("the log").entries;
    let of = |name: &str| entries.iter().filter(|entry| &*entry.topic == name).collect::<Vec<_>>();
    let times = |name: &str| of(name).iter().map(|entry| entry.host_us).collect::<BTreeSet<_>>();
    let (shown, annotated) = (times(topic::SHOWN), times(topic::ANNOTATIONS));
    assert!(annotated.len() >= 5 && annotated.is_subset(&shown), "{annotated:?} {shown:?}");
    // A frame whose exposure becomes clear late is posed again, and shown at that time as well.
    assert!(of(topic::SHOWN).len() >= of(topic::FRAME_TAGS).len(), "each frame is shown");
    let names = |name: &str, wanted: &[&str]| {
        let messages = of(name);
        assert!(!messages.is_empty(), "{name}");
        for word in wanted {
            let says = |entry: &&&LogEntry| entry.data.windows(word.len()).any(|part| part == word.as_bytes());
            assert!(messages.iter().any(|entry| says(&entry)), "{name}: {word}");
        }
    };
    names(topic::TRANSFORMS, &["lps", "camera", "world"]);
    names(topic::CARM_TRANSFORMS, &["world", "carm"]);
    names(topic::ROBOT_TRANSFORMS, &["lps", "base", "piece_27", "tip"]);
    names(topic::CARM_JOINT_STATES, &["orbital"]);
    names(topic::ROBOT_JOINT_STATES, &["control_5"]);
}

#[test]
fn a_session_that_cannot_start_says_why_in_one_sentence() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = folder.path().join("session.json");
    let mut cases = 0;
    for (content, says) in [
        ("{", "session.json"),
        (r#"{"frames": {"folder": "f"}, "scene": "s.json", "colour": 1}"#, "colour"),
        (r#"{"frames": {"folder": "f"}, "scene": "s.json"}"#, "s.json"),
        (
            r#"{"frames": {"folder": "f"}, "scene": "s.json", "world_from_lps": [[2,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}"#,
            "world_from_lps",
        ),
    ] {
        std::fs::write(&path, content).expect("written");
        let run = sidecarm(&["live", text(&path), "--headless", "--seconds", "1"]);
        let words = String::from_utf8_lossy(&run.stderr).into_owned();
        assert_eq!(run.status.code(), Some(1), "{words}");
        assert!(words.contains(says) && !words.contains("panicked"), "{content}: {words}");
        cases += 1;
    }
    assert_eq!(cases, 4);
}
