//! Ctrl-C once, twice, SIGTERM, SIGHUP: heard whatever is under way, the log complete, and the session ends in order.
#![cfg(unix)]

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use serde_json::Value;
use sidecarm::record::{LogEntry, LogReader, topic};
use sidecarm::time::Stopwatch;

use crate::live_lab::{HANG_S, Heard, Live, Signal, copies, deliver, eventually, many_images, quiet_lab};

/// The bar, to which `scripts/evaluate burst` holds a session on a machine that does nothing else.
const HEARD_ALONE_MS: f64 = 100.0;
/// Among other tests on two cores it may be tenths of a second more; a session that hears a signal only between two frames takes seconds.
const HEARD_MS: f64 = 2_000.0;
/// Whoever leaves at once waits up to a second for the log and writes the report of the pairs that are there.
const LEFT_ALONE_MS: f64 = 2_000.0;
const LEFT_MS: f64 = 5_000.0;
/// A frame waits up to a second for its exposure; one that has waited for so long may be registered at any moment.
const MAY_BE_TAKEN_US: i64 = 2_000_000;
const CLOCK_TOPIC: &str = "/session/clock";
const ORDER_TOPIC: &str = "/session/order";

/// What a log says of the registration of its frames.
#[derive(Debug, Default)]
pub struct Registrations {
    /// Frames in the order in which they were begun; one whose exposure became clear late is there twice.
    pub begun: Vec<u32>,
    /// Images that came in a file with several.
    pub run_images: usize,
    /// How many of those were begun.
    pub run_images_begun: usize,
    /// Begun, and without a pose where the log ends.
    pub open: Option<u32>,
    /// How often another frame could have been begun as well.
    pub choices: usize,
    /// Where that one was newer, in words.
    pub passed_over: Vec<String>,
}

impl Registrations {
    pub fn of_log(log: &Path) -> Self {
        Self::of(LogReader::open(log).expect("the log opens"))
    }

    fn of(entries: impl IntoIterator<Item = LogEntry>) -> Self {
        let mut found = Self::default();
        // By number: when it came by the session's own clock, and whether its file has other images.
        let mut waiting: BTreeMap<u32, (i64, bool)> = BTreeMap::new();
        let mut clock_us = 0;
        for entry in entries {
            if !matches!(&*entry.topic, CLOCK_TOPIC | ORDER_TOPIC | topic::FRAME_TAGS | topic::POSE) {
                continue;
            }
            if &*entry.topic == CLOCK_TOPIC {
                clock_us = entry.host_us;
                continue;
            }
            let value: Value = entry.json().expect("JSON");
            let number = value["number"].as_u64().and_then(|number| u32::try_from(number).ok()).expect("a number");
            match &*entry.topic {
                topic::FRAME_TAGS => {
                    let is_of_run = value["image_of_file"][1].as_u64().is_some_and(|count| count > 1);
                    found.run_images += usize::from(is_of_run);
                    waiting.insert(number, (clock_us, is_of_run));
                }
                ORDER_TOPIC => {
                    found.run_images_begun += usize::from(waiting.remove(&number).is_some_and(|(_, is_of_run)| is_of_run));
                    let could_be = |(_, (since_us, _)): &(&u32, &(i64, bool))| clock_us - since_us >= MAY_BE_TAKEN_US;
                    found.choices += usize::from(waiting.iter().any(|other| could_be(&other)));
                    if let Some((newer, _)) = waiting.range(number..).find(could_be) {
                        found.passed_over.push(format!("frame {number} before frame {newer}"));
                    }
                    found.begun.push(number);
                    found.open = Some(number);
                }
                // Of an edit, or of the frame that was begun.
                _ => found.open = found.open.filter(|open| *open != number),
            }
        }
        found
    }
}

/// The control: frames that are begun in the order in which they came are found out, and so is one without a pose.
#[test]
fn an_order_that_is_not_newest_first_is_seen() {
    let entry = |topic: &str, host_us: i64, number: u32| LogEntry {
        topic: topic.into(),
        schema: "".into(),
        encoding: "json".into(),
        host_us,
        sequence: 1,
        data: format!("{{\"number\": {number}}}").into_bytes(),
    };
    let burst = |clock_us: i64, order: [u32; 4]| {
        let mut entries: Vec<LogEntry> = (1..=4).map(|number| entry(topic::FRAME_TAGS, 0, number)).collect();
        entries.push(entry(CLOCK_TOPIC, clock_us, 0));
        for number in order {
            entries.extend([entry(ORDER_TOPIC, 0, number), entry(topic::POSE, 0, number)]);
        }
        let whole = Registrations::of(entries.clone());
        assert_eq!((&whole.begun[..], whole.open), (&order[..], None), "{whole:?}");
        entries.pop();
        assert_eq!(Registrations::of(entries).open, Some(order[3]), "the last one has no pose");
        (whole.choices, whole.passed_over.len())
    };
    assert_eq!(burst(MAY_BE_TAKEN_US, [4, 3, 2, 1]), (3, 0));
    assert_eq!(burst(MAY_BE_TAKEN_US, [1, 2, 3, 4]), (3, 3));
    assert_eq!(burst(MAY_BE_TAKEN_US, [4, 2, 3, 1]), (3, 1));
    assert_eq!(burst(MAY_BE_TAKEN_US - 1, [1, 2, 3, 4]), (0, 0), "they may all wait for their exposures");
}

/// How many milliseconds after a signal the session began to end, by the stamp of its end in the log: the thread that hears a signal may say so
/// while the session's own, which acts on it, is at something else.
fn acted_after(heard: &Heard, signal_us: i64) -> f64 {
    heard.end_us.map_or(f64::NAN, |end_us| (end_us - signal_us) as f64 * 1e-3)
}

/// Sends a signal; gives its host time, and how many milliseconds later the program has said that it heard it.
fn heard_after(live: &Live, signal: Signal) -> (i64, f64) {
    let watch = Stopwatch::start();
    let signal_us = live.signalled(signal);
    (signal_us, watch.ms())
}

/// Forty images in one file are being registered. Ctrl-C is heard before they are, and the telemetry is complete up to then; a second
/// Ctrl-C leaves without them. (It was 219 of 504 packets, and Ctrl-C took 89 s.)
#[test]
fn a_second_interrupt_leaves_at_once_and_nothing_recorded_is_lost() {
    let Some((lab, frame, folder)) = quiet_lab("40") else { return };
    let file = folder.path().join("run.dcm");
    many_images(&frame, 40, &file);
    let mut live = Live::start(&lab.kit.join("session.json"), &folder.path().join("session"), &[]);
    deliver(&[file], &lab);
    std::thread::sleep(Duration::from_secs(3));
    let begun = || {
        std::thread::sleep(Duration::from_millis(50));
        (!Registrations::of_log(&live.log).begun.is_empty()).then_some(())
    };
    assert!(eventually(HANG_S, begun).is_some(), "no image is ever registered: {}", live.stderr());
    let (first_us, heard_ms) = heard_after(&live, Signal::INT);
    let unfinished = "Ctrl-C again leaves at once";
    let told = eventually(HANG_S, || (live.stderr().contains(unfinished) || live.program.end(0.0).is_some()).then_some(()));
    assert!(
        told.is_some() && live.stderr().contains(unfinished),
        "it was heard before the images were finished: {}",
        live.stderr()
    );
    let watch = Stopwatch::start();
    live.program.signal(Signal::INT);
    let status = live.program.end(HANG_S);
    let left_ms = watch.ms();
    let words = live.stderr();
    assert!(status.is_some(), "still there: {words}");
    assert!(!words.contains("panicked"), "{words}");
    let registrations = Registrations::of_log(&live.log);
    println!("Ctrl-C heard after {heard_ms:.0} ms, gone {left_ms:.0} ms after the second; begun: {:?}", registrations.begun);
    assert!(heard_ms <= HEARD_MS, "Ctrl-C is heard after {heard_ms:.0} ms, {HEARD_MS} allowed: {words}");
    assert!(words.contains("leaving at once") && left_ms <= LEFT_MS, "gone after {left_ms:.0} ms, {LEFT_MS} allowed: {words}");
    assert!((1..40).contains(&registrations.begun.len()), "nothing was being registered: {registrations:?}");
    assert!(registrations.passed_over.is_empty(), "the newest is not registered first: {:?}", registrations.passed_over);
    let heard = live.heard();
    assert_eq!(heard.images, 40, "every image delivered is in the log: {words}");
    assert!(heard.end_us.is_some() && heard.losses.is_empty(), "the log has its end: {:?}", heard.losses);
    let acted_ms = acted_after(&heard, first_us);
    println!("the session began to end {acted_ms:.0} ms after Ctrl-C");
    assert!(acted_ms <= HEARD_MS, "the session began to end {acted_ms:.0} ms after Ctrl-C, {HEARD_MS} allowed: {words}");
    assert!(matches!(status.and_then(|status| status.code()), Some(3)), "what was not finished is said: {status:?} {words}");
    // The summary counts what the log holds, and how much of it is not finished, as the loss does.
    let summary = live.stdout();
    let lost = summary.split("left at once: ").nth(1).and_then(|lost| lost.split(' ').next()).expect("the loss");
    let first = summary.lines().next().unwrap_or_default();
    assert!(first.starts_with("40 frames, ") && first.contains(&format!(", {lost} not finished")), "{summary}");
    let missing = heard.missing(&lab.sent(), live.recording_us, first_us);
    println!("{} images in the log; telemetry {missing:?}", heard.images);
    assert_eq!(missing.lost, 0, "{missing:?}");
    assert!(missing.sent > 300, "{missing:?}");
}

/// One Ctrl-C, SIGTERM, SIGHUP: the same end, with a report, everything in the log and the pairs that were begun.
#[test]
fn every_signal_ends_the_session_in_order() {
    let mut cases = 0;
    for signal in [Signal::INT, Signal::TERM, Signal::HUP] {
        // A lab of its own: what an earlier reader left in the line's buffer is lost, and would be said.
        let Some((lab, frame, folder)) = quiet_lab("60") else { return };
        let lab = lab.without_ct();
        let name = format!("{cases}");
        let files = copies(&frame, 2, &folder.path().join(format!("copies-{name}")));
        let mut live = Live::start(&lab.kit.join("session.json"), &folder.path().join(&name), &[]);
        deliver(&files, &lab);
        std::thread::sleep(Duration::from_millis(1_500));
        let (signal_us, heard_ms) = heard_after(&live, signal);
        println!("{signal:?} heard after {heard_ms:.0} ms");
        assert!(heard_ms <= HEARD_MS, "{signal:?} is heard after {heard_ms:.0} ms, {HEARD_MS} allowed: {}", live.stderr());
        let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("{signal:?}: still there: {}", live.stderr()));
        let words = live.stderr();
        assert!(live.lacks_exposures_alone(status.code()), "{signal:?}: {words} {}", live.stdout());
        assert!(live.report().contains("</html>"), "{signal:?}: no report");
        let heard = live.heard();
        let acted_ms = acted_after(&heard, signal_us);
        println!("{signal:?}: the session began to end {acted_ms:.0} ms after it");
        assert!((0.0..=HEARD_MS).contains(&acted_ms), "{signal:?}: {acted_ms:.0} ms to the end, {HEARD_MS} allowed: {words}");
        assert!(heard.losses.is_empty(), "{signal:?}: {:?}", heard.losses);
        let missing = heard.missing(&lab.sent(), live.recording_us, signal_us);
        assert_eq!(missing.lost, 0, "{signal:?}: {missing:?}");
        assert_eq!(heard.frames.len(), 2, "{signal:?}: frames");
        assert_eq!(live.pairs(), 2, "{signal:?}: {words}");
        cases += 1;
    }
    assert_eq!(cases, 3);
}

/// Ctrl-C was heard while the scene was loaded, and the session began all the same; so was the second one.
#[cfg(target_os = "linux")]
#[test]
fn an_interrupt_while_the_scene_is_loaded_ends_the_program() {
    let Some((lab, _, folder)) = quiet_lab("60") else { return };
    let slow = lab.kit.join("slow.nii.gz");
    nothing_but_air(&slow, [512, 512, 500]);
    let text = std::fs::read_to_string(lab.kit.join("scene.json")).expect("the scene");
    std::fs::write(lab.kit.join("slow.json"), text.replace("ct.nii.gz", "slow.nii.gz")).expect("written");
    let session = lab.session("session-slow.json", |session| session["scene"] = "slow.json".into());
    let mut live = Live::launch(&session, &folder.path().join("session"), &[]);
    let catches = || {
        let status = std::fs::read_to_string(format!("/proc/{}/status", live.program.id())).unwrap_or_default();
        let caught = status.lines().find_map(|line| u64::from_str_radix(line.strip_prefix("SigCgt:")?.trim(), 16).ok());
        caught.is_some_and(|mask| mask & (1 << (Signal::INT.as_raw() - 1)) != 0).then_some(())
    };
    assert!(eventually(HANG_S, catches).is_some(), "it listens: {}", live.stderr());
    live.program.signal(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr()));
    let words = live.stderr();
    assert!(status.code() == Some(1) && words.contains("ended before the session began"), "{status:?} {words}");
    assert!(!live.log.exists(), "nothing was recorded");
}

/// A volume of air alone, which takes seconds to load.
#[cfg(target_os = "linux")]
fn nothing_but_air(path: &std::path::Path, size: [i16; 3]) {
    use std::io::Write;
    let mut header = vec![0u8; 352];
    header[..4].copy_from_slice(&348i32.to_le_bytes());
    for (n, extent) in [3, size[0], size[1], size[2], 1, 1, 1, 1].into_iter().enumerate() {
        header[40 + 2 * n..42 + 2 * n].copy_from_slice(&extent.to_le_bytes());
    }
    // int16, 16 bits.
    header[70..72].copy_from_slice(&4i16.to_le_bytes());
    header[72..74].copy_from_slice(&16i16.to_le_bytes());
    (0..4).for_each(|n| header[76 + 4 * n..80 + 4 * n].copy_from_slice(&1f32.to_le_bytes()));
    header[108..112].copy_from_slice(&352f32.to_le_bytes());
    // One slope, the sform in scanner coordinates, millimetres.
    header[112..116].copy_from_slice(&1f32.to_le_bytes());
    header[123] = 2;
    header[254..256].copy_from_slice(&1i16.to_le_bytes());
    for row in 0..3 {
        header[280 + 20 * row..284 + 20 * row].copy_from_slice(&1f32.to_le_bytes());
    }
    header[344..348].copy_from_slice(b"n+1\0");
    let mut packed = flate2::write::GzEncoder::new(std::fs::File::create(path).expect("created"), flate2::Compression::fast());
    packed.write_all(&header).expect("written");
    let slice: Vec<u8> =
        (0..usize::from(size[0] as u16) * usize::from(size[1] as u16)).flat_map(|_| (-1000i16).to_le_bytes()).collect();
    (0..size[2]).for_each(|_| packed.write_all(&slice).expect("written"));
    packed.finish().expect("written");
}

/// How long a session took to hear Ctrl-C, to begin to end, and to be gone after the second, ms.
struct Ended {
    heard_ms: f64,
    acted_ms: f64,
    left_ms: f64,
}

/// `count` frames at once, then Ctrl-C: telemetry is complete whatever the workshop does, so are the frames, the newest come first, and
/// pairs are made meanwhile.
fn burst(count: usize, record_s: f64) -> Option<Ended> {
    let (lab, frame, folder) = quiet_lab("300")?;
    let files = copies(&frame, count, &folder.path().join("copies"));
    let mut live = Live::start(&lab.kit.join("session.json"), &folder.path().join("session"), &[]);
    deliver(&files, &lab);
    std::thread::sleep(Duration::from_secs_f64(record_s));
    let pairs_before = live.pairs();
    let (signal_us, heard_ms) = heard_after(&live, Signal::INT);
    std::thread::sleep(Duration::from_millis(500));
    let watch = Stopwatch::start();
    if live.program.end(0.0).is_none() {
        live.program.signal(Signal::INT);
    }
    let ended = live.program.end(HANG_S);
    let left_ms = watch.ms();
    let heard = live.heard();
    let registrations = Registrations::of_log(&live.log);
    let missing = heard.missing(&lab.sent(), live.recording_us, signal_us);
    let pairs = live.pairs();
    println!(
        "{count} frames delivered at once, {record_s} s of session: {} of {} packets lost, {} frames in the log, {pairs} pairs, {pairs_before} \
         of them before Ctrl-C",
        missing.lost, missing.sent, heard.images
    );
    let acted_ms = acted_after(&heard, signal_us);
    println!(
        "Ctrl-C heard after {heard_ms:.0} ms, acted on after {acted_ms:.0} ms, gone {left_ms:.0} ms after the second; {} registrations begun, \
         with a choice {} times, the newest passed over {} times; the first of them {:?}",
        registrations.begun.len(),
        registrations.choices,
        registrations.passed_over.len(),
        registrations.begun.iter().take(16).collect::<Vec<_>>()
    );
    assert!(ended.is_some(), "{}", live.stderr());
    assert_eq!((heard.images, heard.frames.len()), (count, count), "every frame delivered is in the log: {}", live.stderr());
    assert!(pairs_before > 0, "no pair while the frames came: {}", live.stderr());
    assert!(registrations.choices >= 20, "hardly ever could another frame have been begun: {registrations:?}");
    assert!(registrations.passed_over.is_empty(), "the newest is not registered first: {:?}", registrations.passed_over);
    assert_eq!(missing.lost, 0, "{missing:?}");
    assert!(missing.sent as f64 > 80.0 * record_s, "{missing:?}");
    Some(Ended { heard_ms, acted_ms, left_ms })
}

#[test]
#[ignore = "minutes long: scripts/evaluate burst runs it"]
fn bursts_of_frames_leave_the_telemetry_alone() {
    let ended: Vec<Ended> = [burst(200, 40.0), burst(500, 60.0)].into_iter().flatten().collect();
    for Ended { heard_ms, acted_ms, left_ms } in ended {
        assert!(heard_ms <= HEARD_ALONE_MS, "Ctrl-C is heard after {heard_ms:.0} ms, {HEARD_ALONE_MS} allowed");
        assert!(acted_ms <= HEARD_ALONE_MS, "the session begins to end {acted_ms:.0} ms after Ctrl-C, {HEARD_ALONE_MS} allowed");
        assert!(left_ms <= LEFT_ALONE_MS, "gone {left_ms:.0} ms after the second Ctrl-C, {LEFT_ALONE_MS} allowed");
    }
}
