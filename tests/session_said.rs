//! What a session says of its exposures where one looks, in terminal, `pairs.json` and report: a frame whose tags contradict telemetry, an arm
//! that moves while the beam is on, a cable that falls out around an exposure, and at the end what is left to do. Through `live`.
#![cfg(unix)]

use std::collections::BTreeSet;
use std::time::Duration;

use serde_json::Value;
use sidecarm::image::sha256_file;

use crate::lab_truth::{pairs, prior_is_right, told_frames, wait_for_pairs};
use crate::live_lab::{HANG_S, Lab, Live, Signal, copies, deliver, eventually, quiet_lab};

/// Of what is said where telemetry's beam and a frame's tags contradict each other.
const OF_THE_BEAM: [&str; 3] = ["kVp: ", "filter: ", "field: "];
/// Of what is said where telemetry tells less of an exposure than it should.
const MOVED: &str = " during the exposure (limit ";
const INTERPOLATED: &str = "joints are interpolated over ";
const OPEN_ENDS: &str = "beam on or off fell into a gap of telemetry";
const UNSEEN: &str = "telemetry missed the exposure";

/// A session that has ended.
struct Ended {
    _lab: Lab,
    live: Live,
    code: Option<i32>,
    /// All that was printed.
    words: String,
}

/// Waits for the end of a session that was asked to end, and for the summary up to `last`.
fn ended(lab: Lab, mut live: Live, last: &str) -> Ended {
    let code = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr())).code();
    // What it printed last may still be on its way here.
    let said = eventually(10.0, || live.stdout().contains(last).then_some(()));
    let words = format!("exit code {code:?}\n{}\n{}", live.stdout(), live.stderr());
    assert!(said.is_some(), "{words}");
    Ended { _lab: lab, live, code, words }
}

/// Plays a session of `count` exposures, whose summary goes on at least to `last`.
fn played(script: &[&str], count: usize, last: &str) -> Option<Ended> {
    let exposures = count.to_string();
    let lab = Lab::start(&[script, &["--exposures", &exposures, "--await-all", "--idle-s", "300"]].concat())?.without_ct();
    let live = Live::start(&lab.kit.join("session.json"), &lab.kit.with_file_name("session"), &[]);
    wait_for_pairs(&live, count);
    live.signalled(Signal::INT);
    Some(ended(lab, live, last))
}

fn flags(pair: &Value) -> Vec<&str> {
    pair["flags"].as_array().into_iter().flatten().filter_map(Value::as_str).collect()
}

fn of_the_beam(pair: &Value) -> Vec<&str> {
    flags(pair).into_iter().filter(|flag| OF_THE_BEAM.iter().any(|check| flag.starts_with(check))).collect()
}

/// Warnings in the terminal that are of one frame and say `what`.
fn warnings<'a>(words: &'a str, counter: u32, what: &str) -> Vec<&'a str> {
    let frame = format!("(frame-{counter:03})");
    words.lines().filter(|line| line.starts_with("warning: frame ") && line.contains(&frame) && line.contains(what)).collect()
}

/// The report as it is read.
fn read_report(live: &Live) -> String {
    live.report().replace("&#39;", "'").replace("&quot;", "\"")
}

/// A console that writes another voltage, another filter and another opening into its frames than the arm tells of their exposures: each is said
/// of its own frame and of nothing else. The first frame, whose tags agree, is the control.
#[test]
fn tags_that_contradict_telemetry_are_said_of_their_frame_alone() {
    let script = ["--duration-s", "10", "--faults", "none", "--tags-lie", "kvp@2,filter@3,collimator@4"];
    let Some(Ended { _lab, live, code, words }) = played(&script, 4, " x check: kVp: ") else { return };
    let lies: [&[&str]; 4] = [
        &[],
        &["kVp: telemetry says 90 kVp, the frame 110; check that the frame belongs to this exposure"],
        &[
            "filter: telemetry says 0.00 mm of copper in the beam, the frame's tags say 0.30 mm; check that the frame belongs to this \
             exposure",
        ],
        &[
            "field: telemetry has the left shutter at -120 mm from the panel's middle, the frame's collimator tags have it at -60 mm; check \
             that the frame belongs to this exposure",
        ],
    ];
    let (frames, report) = (told_frames(&live), read_report(&live));
    // A crowded machine may lose packets, which is another matter, and said.
    assert!(frames.len() == 4 && matches!(code, Some(0 | 3)), "{} frames: {words}", frames.len());
    for (pair, pose, counter) in &frames {
        assert_eq!(pose["binding"]["exposure"]["counter"], *counter, "{pair:#}");
        let (said, expected) = (of_the_beam(pair), lies[*counter as usize - 1]);
        let is_told = |(said, expected): (&&str, &&str)| said.starts_with(expected);
        assert!(said.len() == expected.len() && said.iter().zip(expected).all(is_told), "frame {counter}: {said:#?}");
        for sentence in expected {
            assert!(!warnings(&words, *counter, sentence).is_empty(), "'{sentence}' is not said of frame {counter}: {words}");
            assert!(report.contains(sentence), "'{sentence}' is not in the report");
        }
        let warned = OF_THE_BEAM.iter().filter(|check| !warnings(&words, *counter, check).is_empty()).count();
        assert_eq!(warned, expected.len(), "frame {counter}: {words}");
    }
    // Of each kind one, in the summary as well.
    for check in OF_THE_BEAM {
        assert!(words.contains(&format!(" x check: {check}")), "{check}: {words}");
    }
}

/// Exposures of 0.8 s. In the second the arm moves; the C-arm's cable falls out in the middle of the third, and again while the fourth ends. The
/// first, of which telemetry tells all, is the control.
#[test]
fn motion_and_gaps_of_telemetry_are_flagged_at_the_exposures_that_they_fell_into() {
    let faults = "carm:unplug@0.3,carm:unplug@0.432";
    let script = ["--duration-s", "14", "--exposure-s", "0.8", "--arm-moves", "2", "--faults", faults, "--unplugged-s", "0.35"];
    let Some(Ended { _lab, live, code, words }) = played(&script, 4, "lost: ") else { return };
    let (frames, report) = (told_frames(&live), read_report(&live));
    assert!(frames.len() == 4, "{} frames: {words}", frames.len());
    assert!(code == Some(3) && words.contains("missed while it was unplugged"), "what was not heard is lost: {words}");
    for (pair, pose, counter) in &frames {
        let exposure = &pose["binding"]["exposure"];
        assert!(pair["binding"] == "counter" && exposure["counter"] == *counter, "{pair:#} {words}");
        let of = |what: &str| flags(pair).into_iter().filter(|flag| flag.contains(what)).collect::<Vec<_>>();
        let logged = |word: &str| pose["binding"]["flags"].as_array().into_iter().flatten().find(|flag| flag["flag"] == word);
        let moved = of(MOVED);
        let is_moved = *counter == 2;
        assert_eq!((moved.len(), logged("moved").is_some()), (usize::from(is_moved), is_moved), "{pair:#} {pose:#}");
        assert_eq!(warnings(&words, *counter, MOVED).is_empty(), !is_moved, "{words}");
        let (interpolated, open) = (of(INTERPOLATED), of(OPEN_ENDS));
        match counter {
            1 => assert!(interpolated.is_empty() && open.is_empty() && of(UNSEEN).is_empty(), "{pair:#}"),
            2 => {
                assert!(interpolated.is_empty() && open.is_empty(), "{pair:#}");
                // Two degrees, less what the first sample came late, and what the encoder's noise could make of it.
                let deg = moved[0].strip_prefix("orbital moved by ").and_then(|rest| rest.split(' ').next()?.parse::<f64>().ok());
                assert!(deg.is_some_and(|deg| (1.0..2.4).contains(&deg)) && moved[0].ends_with("(limit 0.2)"), "{moved:?}");
                assert_eq!(logged("moved").map(|flag| &flag["joint"]), Some(&"orbital".into()), "{pose:#}");
                assert!(words.contains(" x moved during the exposure: ") && report.contains(moved[0]), "{words}");
            }
            3 => {
                let s =
                    interpolated.first().and_then(|flag| flag.strip_prefix(INTERPOLATED)?.strip_suffix(" s without telemetry"));
                let s: f64 = s.and_then(|s| s.parse().ok()).unwrap_or_else(|| panic!("{pair:#} {words}"));
                assert!(
                    (0.3..1.0).contains(&s) && pair["gap_us"].as_f64().is_some_and(|us| (1e-6 * us - s).abs() < 1e-3),
                    "{pair:#}"
                );
                assert!(logged("telemetry_gap").is_some() && report.contains(interpolated[0]), "{pose:#}");
            }
            _ => assert!(open.len() == 1 && logged("open_ends").is_some() && report.contains(open[0]), "{pair:#} {pose:#}"),
        }
        if pair["pose_source"] == "beads" {
            // Also of the arm that moved: it was there in the middle.
            prior_is_right(pair);
        }
        // A console that writes what the arm tells gives no cause for a word.
        assert!(of_the_beam(pair).is_empty(), "{pair:#}");
    }
    assert!(OF_THE_BEAM.iter().all(|check| !words.contains(&format!("check: {check}"))), "{words}");
}

/// `finishing 2 of 6; …`: how many are done.
fn finished(line: &str, all: usize) -> Option<usize> {
    let (done, rest) = line.strip_prefix("finishing ")?.split_once(" of ")?;
    let of = rest.split(';').next()?;
    assert_eq!(of.parse(), Ok(all), "{line}");
    Some(done.parse().unwrap_or_else(|_| panic!("{line}")))
}

/// Counts how often each picture of a session's folder is put in its place, as the system tells.
#[cfg(target_os = "linux")]
struct Written([(&'static str, std::os::fd::OwnedFd); 2]);

#[cfg(target_os = "linux")]
impl Written {
    fn watch(out: &std::path::Path) -> Self {
        use rustix::fs::inotify::{CreateFlags, WatchFlags, add_watch, init};
        Self(["strips", "drr"].map(|part| {
            let inotify = init(CreateFlags::NONBLOCK | CreateFlags::CLOEXEC).expect("the system tells");
            add_watch(&inotify, out.join(part).as_path(), WatchFlags::MOVED_TO).expect("the system tells of this folder");
            (part, inotify)
        }))
    }

    /// Up to now, by path.
    fn counts(&self) -> std::collections::BTreeMap<String, usize> {
        use rustix::fs::inotify::{ReadFlags, Reader};
        let mut counts = std::collections::BTreeMap::new();
        for (part, inotify) in &self.0 {
            let mut buffer = [std::mem::MaybeUninit::uninit(); 1 << 14];
            let mut reader = Reader::new(inotify, &mut buffer);
            while let Ok(event) = reader.next() {
                assert!(!event.events().contains(ReadFlags::QUEUE_OVERFLOW), "more was written than the system counts");
                let name = event.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
                *counts.entry(format!("{part}/{name}")).or_default() += 1;
            }
        }
        counts
    }

    /// A DRR is written once, and so is a strip, unless its null changes what it says and other frames came before that.
    fn are_once(&self, rows: &[Value]) {
        let written = self.counts();
        let mut again = 0;
        for pair in rows {
            let count = |what: &str| written.get(pair[what].as_str().expect("a path")).copied().unwrap_or_default();
            let last = if pair["scores"]["rmse_nepers"].is_f64() { "rmse_nepers" } else { "edge_distance_px" };
            let is_questioned = |score: &str| pair["null"][score]["discriminating"].as_bool() == Some(false);
            let says_more = pair["image_prefers"].is_object() || ["zncc", "gradient_ncc", last].into_iter().any(is_questioned);
            let (strip, drr) = (count("strip"), count("drr"));
            assert_eq!(drr, 1, "{written:?}: {pair:#}");
            assert!(strip == 1 || says_more && strip == 2, "{written:?}: {pair:#}");
            again += strip - 1;
        }
        assert!(again < rows.len(), "every strip is written twice: {written:?}");
    }
}

/// Six frames come shortly before the end. They are finished, how far that has come is said while it goes on, and each has its pair. Its DRR
/// is written once, and so is its strip, unless its null comes late and changes what that says.
#[test]
fn what_waits_at_the_end_is_finished_and_counted() {
    const COUNT: usize = 6;
    let Some((lab, frame, folder)) = quiet_lab("60") else { return };
    let files = copies(&frame, COUNT, &folder.path().join("copies"));
    let live = Live::start(&lab.kit.join("session.json"), &folder.path().join("session"), &[]);
    #[cfg(target_os = "linux")]
    let written = Written::watch(&live.out);
    deliver(&files, &lab);
    let recorded = eventually(HANG_S, || {
        std::thread::sleep(Duration::from_millis(50));
        (live.heard().images == COUNT).then_some(())
    });
    assert!(recorded.is_some(), "{} of {COUNT} images: {}", live.heard().images, live.stderr());
    live.signalled(Signal::INT);
    let Ended { _lab, live, code, words } = ended(lab, live, "/report.html");
    assert!(matches!(code, Some(0 | 3)) && !words.contains("not finished"), "{words}");
    let lines: Vec<&str> = words.lines().filter(|line| line.starts_with("finishing ")).collect();
    let done: Vec<usize> = lines.iter().filter_map(|line| finished(line, COUNT)).collect();
    assert!(done.len() == lines.len() && done.len() >= 2, "{lines:?}");
    assert!(lines[0].ends_with("; Ctrl-C again leaves at once, the log is complete"), "{lines:?}");
    assert!(done.is_sorted_by(|a, b| a < b) && done.iter().all(|done| *done <= COUNT), "it goes up: {done:?}");

    let rows = pairs(&live);
    assert!(words.contains(&format!("{COUNT} frames, ")) && rows.len() == COUNT, "{} pairs: {words}", rows.len());
    let found: BTreeSet<&str> = rows.iter().filter_map(|pair| pair["sha256"].as_str()).collect();
    let sent: Vec<String> = files.iter().map(|file| sha256_file(file).expect("readable")).collect();
    assert_eq!(found, sent.iter().map(String::as_str).collect(), "each frame once");
    for pair in &rows {
        let is_ranked = pair["null"].as_object().is_some_and(|null| !null.is_empty());
        assert!(pair["scores"]["zncc"].is_f64() && is_ranked, "compared with its DRR, and with those of wrong poses: {pair:#}");
        for what in ["strip", "drr"] {
            assert!(pair[what].as_str().is_some_and(|path| live.out.join(path).exists()), "{what}: {pair:#}");
        }
    }
    #[cfg(target_os = "linux")]
    written.are_once(&rows);
}
