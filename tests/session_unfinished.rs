//! Files that get their size before their content, through `live`: what is still open is waited for, what was delivered too early is
//! taken back when the whole picture comes.
#![cfg(target_os = "linux")]

use std::collections::BTreeSet;
use std::fs::File;
use std::io::Write;
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::time::Duration;

use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use serde_json::{Value, json};
use sidecarm::image::{Image, sha256_bytes, write_tiff_f32};

use crate::acquire_watch::age;
use crate::calibrate_session::write_png16;
use crate::live_lab::{HANG_S, Lab, Live, Signal, eventually, quiet_lab};
use crate::session_names::replay_words;

/// How a frame gets into the watched folder.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Way {
    /// Under another name, then renamed.
    Whole,
    /// Size and a third of the content at once, the rest 2 s later; open all the time.
    KeptOpen,
    /// The same, closed in between.
    Closed,
    /// The same, and the time of change is set back afterwards.
    ClosedAndSetBack,
    /// All but the middle third at once, that 2 s later; closed in between.
    Hole,
}

fn relay(from: &Path, to: &Path, way: Way) {
    // The mocked detector itself copies one of its frames in two parts.
    let mut whole = Vec::new();
    while whole.is_empty() || std::fs::metadata(from).expect("a frame").len() != whole.len() as u64 {
        whole = std::fs::read(from).expect("a frame");
        std::thread::sleep(Duration::from_millis(1200));
    }
    if way == Way::Whole {
        let beside = to.with_extension("part");
        std::fs::write(&beside, &whole).expect("written");
        return std::fs::rename(beside, to).expect("renamed");
    }
    let file = File::create(to).expect("created");
    let mut torn = whole.clone();
    let third = whole.len() / 3;
    torn[third..if way == Way::Hole { 2 * third } else { whole.len() }].fill(0);
    file.write_all_at(&torn, 0).expect("size and first part");
    let modified = file.metadata().expect("metadata").modified().expect("a time");
    let file = if way == Way::KeptOpen {
        file
    } else {
        drop(file);
        std::thread::sleep(Duration::from_millis(1500));
        File::options().write(true).open(to).expect("opened again")
    };
    std::thread::sleep(Duration::from_millis(500));
    file.write_all_at(&whole, 0).expect("all");
    if way == Way::ClosedAndSetBack {
        file.set_modified(modified).expect("time is set");
    }
}

/// Half of a file had come when the session was told to end: it was left out without a word, and the report said that nothing was lost.
#[test]
fn what_is_being_written_at_the_end_is_waited_for_or_said() {
    for completes in [true, false] {
        let Some((lab, frame, folder)) = quiet_lab("60") else { return };
        let lab = lab.without_ct();
        let whole = std::fs::read(&frame).expect("a frame");
        let mut live = Live::start(&lab.kit.join("session.json"), &folder.path().join("session"), &[]);
        let mut file = File::create(lab.frames().join("half.dcm")).expect("created");
        let (first, second) = whole.split_at(whole.len() / 2);
        file.write_all(first).expect("half of it");
        std::thread::sleep(Duration::from_millis(300));
        live.signalled(Signal::INT);
        let waits = eventually(HANG_S, || live.stderr().contains("a frame is still being written").then_some(()));
        assert!(waits.is_some(), "it is said why the session does not end: {}", live.stderr());
        if completes {
            file.write_all(second).expect("the rest");
            drop(file);
        }
        let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr()));
        let words = live.stdout() + &live.stderr();
        let heard = live.heard();
        assert_eq!((status.code(), heard.frames.len()), (Some(3), usize::from(completes)), "{words}");
        assert_eq!(live.lacks_exposures_alone(status.code()), completes, "{words}");
        assert!(live.stdout().contains("lost: "), "{words}");
        assert_eq!(live.report().contains("the file "), !completes, "{words}");
        assert!(heard.losses.is_empty() && heard.end_us.is_some(), "{:?}", heard.losses);
        // No replay can miss a file of which it has nothing: it said that nothing was lost.
        let again = folder.path().join("again");
        let words = replay_words(&live.log, &again);
        let report = std::fs::read_to_string(again.join("report.html")).expect("a report");
        let is_told = words.lines().any(|line| line.contains("lost in the session: ") && line.contains("the file "));
        assert_eq!((is_told, report.contains("the file ")), (!completes, !completes), "{words}");
    }
}

/// A PNG and a TIFF of grains that no compression shortens, by name.
fn rasters(folder: &Path) -> [(&'static str, Vec<u8>); 2] {
    let grains = (0..96 * 80u32).map(|index| (index.wrapping_mul(2_654_435_761) >> 17) as f32).collect();
    let picture = Image { width: 96, height: 80, pixels: grains };
    let read = |name: &'static str| (name, std::fs::read(folder.join(name)).expect("a picture"));
    write_png16(&folder.join("frame-901.png"), &picture);
    write_tiff_f32(&folder.join("frame-902.tif"), &[picture.map(|value| value + 1.0)]).expect("written");
    ["frame-901.png", "frame-902.tif"].map(read)
}

/// A frame that was cut and completed 13 s later was bound, and the session ended with "lost: … copy the file again" all the same. A PNG and
/// a TIFF that are completed before anybody misses them are not said to be lost at all.
#[test]
fn a_cut_file_that_is_completed_later_is_no_loss() {
    let Some((lab, frame, folder)) = quiet_lab("60") else { return };
    let lab = lab.without_ct();
    let whole = std::fs::read(&frame).expect("a frame");
    let (first, second) = whole.split_at(whole.len() * 6 / 10);
    let mut live = Live::start(&lab.kit.join("session.json"), &folder.path().join("session"), &[]);
    let (beside, path) = (lab.kit.join("part"), lab.frames().join("frame-900.dcm"));
    std::fs::write(&beside, first).expect("written");
    // Nobody waits for the rest of what was written so long ago.
    age(&beside, 60);
    std::fs::rename(&beside, &path).expect("renamed");
    let rasters = rasters(folder.path());
    for (name, whole) in &rasters {
        std::fs::write(lab.frames().join(name), &whole[..whole.len() / 2]).expect("half of it, closed");
    }
    std::thread::sleep(Duration::from_millis(1500));
    assert!(!live.stderr().contains("(frame-90"), "nothing comes of a half: {}", live.stderr());
    for (name, whole) in &rasters {
        let mut file = File::options().append(true).open(lab.frames().join(name)).expect("there");
        file.write_all(&whole[whole.len() / 2..]).expect("the rest");
    }
    let says = |live: &Live, words: &str| {
        let said = eventually(HANG_S, || live.stderr().contains(words).then_some(()));
        assert!(said.is_some(), "{words}: {}", live.stderr());
    };
    says(&live, "frame-900: the file has not been completed");
    File::options().append(true).open(&path).expect("there").write_all(second).expect("the rest");
    says(&live, "frame-900: the file has been completed after all");
    ["(frame-900): ", "(frame-901): ", "(frame-902): "].into_iter().for_each(|frame| says(&live, frame));
    live.signalled(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr()));
    let words = live.stdout() + &live.stderr();
    let heard = live.heard();
    let all = rasters.iter().map(|(_, whole)| whole).chain([&whole]);
    let hashes: BTreeSet<String> = all.map(|bytes| sha256_bytes(bytes)).collect();
    assert!(live.lacks_exposures_alone(status.code()) && heard.images == 3, "each comes once: {words}");
    assert_eq!(heard.frames, hashes, "and as it was when it was whole: {words}");
    assert!(live.report().contains("completed after all"), "{words}");
    assert!(live.stdout().contains("1 x unfinished frame: frame-900: the file has been completed after all"), "{words}");
}

#[test]
fn a_frame_that_is_not_finished_is_waited_for_or_taken_back() {
    let ways = [Way::Whole, Way::KeptOpen, Way::Closed, Way::Hole, Way::ClosedAndSetBack];
    let exposures = ways.len().to_string();
    let Some(lab) = Lab::start(&["--duration-s", "16", "--faults", "none", "--exposures", &exposures, "--idle-s", "300"]) else {
        return;
    };
    let lab = lab.without_ct();
    let relayed = lab.kit.join("relayed");
    std::fs::create_dir(&relayed).expect("a folder");
    let session = lab.session("session-relayed.json", |session| session["frames"]["folder"] = json!(relayed));
    let home = tempfile::tempdir().expect("a folder");
    let mut live = Live::launch(&session, &home.path().join("session"), &[]);
    let mut seen = BTreeSet::new();
    // Three are closed unfinished, and come once more.
    let all = eventually(HANG_S, || {
        for entry in std::fs::read_dir(lab.frames()).expect("listed").flatten() {
            let path = entry.path();
            if path.extension().is_some_and(|extension| extension == "dcm") && seen.insert(entry.file_name()) {
                let way = ways[seen.len() - 1];
                let to = relayed.join(entry.file_name());
                std::thread::spawn(move || relay(&path, &to, way));
            }
        }
        (live.pairs() == ways.len() + 3).then_some(())
    });
    assert!(all.is_some(), "{} pairs of {} frames: {}", live.pairs(), seen.len(), live.stderr());
    live.signalled(Signal::INT);
    let ended = live.program.end(HANG_S);
    assert!(ended.is_some_and(|status| matches!(status.code(), Some(0 | 3))), "{}", live.stderr());

    let read = |folder: &Path| -> Vec<Value> {
        let text = std::fs::read(folder.join("pairs.json")).expect("pairs");
        serde_json::from_slice::<Value>(&text).expect("JSON")["pairs"].as_array().expect("a list").clone()
    };
    let pairs = read(&live.out);
    let torn: Vec<&Value> = pairs.iter().filter(|pair| said(pair).contains("after it was read")).collect();
    assert_eq!((pairs.len(), torn.len()), (seen.len() + 3, 3), "three were closed unfinished: {}", live.stderr());
    for pair in &torn {
        assert!(pair["status"] == "refused" && pair["binding"] == "none", "{pair:#}");
        let flags = pair["flags"].to_string() + &said(pair);
        let by = pairs.iter().find(|other| said(pair).contains(&format!("frame {} is", other["number"])));
        let by = by.unwrap_or_else(|| panic!("no frame replaces it: {flags}"));
        assert!(by["frame"] == pair["frame"] && by["binding"] != "none" && by["status"] != "refused", "{by:#}");
    }
    // Whatever was relayed whole, and what was waited for, is bound and has its pose.
    let unbound = |pair: &&Value| !said(pair).contains("after it was read") && pair["binding"] == "none";
    assert_eq!(pairs.iter().filter(unbound).count(), 0, "{}", live.stderr());
    let refused = pairs.iter().filter(|pair| pair["status"] == "refused" && !said(pair).contains("after it was read"));
    assert_eq!(refused.count(), 0, "{}", live.stderr());
    assert!(live.stderr().contains("before it was written to its end"), "{}", live.stderr());

    let again = home.path().join("again");
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    let output = command.arg("replay").arg(&live.log).arg("--out").arg(&again).output().expect("starts");
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    let of = |pairs: &[Value]| -> Vec<[String; 3]> {
        pairs.iter().map(|pair| [&pair["number"], &pair["status"], &pair["binding"]].map(Value::to_string)).collect()
    };
    assert_eq!(of(&read(&again)), of(&pairs), "a replay tells the same");
}

fn said(pair: &Value) -> String {
    pair["reason"].as_str().unwrap_or_default().to_owned()
}

/// The picture that a console was still writing over, in a file as large as before, kept the exposure, and the whole one got none.
#[test]
fn a_file_that_is_written_anew_for_the_same_exposure_replaces_its_picture() {
    let Some((lab, frame, folder)) = quiet_lab("60") else { return };
    let lab = lab.without_ct();
    let path = lab.frames().join("frame.dcm");
    // The frame with another pixel, and with another time of its exposure.
    let write = |first: u16, time: &str| {
        let mut object = dicom_object::open_file(&frame).expect("a frame");
        let mut values = object.element(tags::PIXEL_DATA).expect("pixels").to_multi_int::<u16>().expect("words");
        values[0] = first;
        object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(values.into())));
        object.put(DataElement::new(tags::ACQUISITION_DATE, VR::DA, PrimitiveValue::from("20261121")));
        object.put(DataElement::new(tags::ACQUISITION_TIME, VR::TM, PrimitiveValue::from(time)));
        let whole = folder.path().join("whole.dcm");
        object.write_to_file(&whole).expect("written");
        std::fs::rename(whole, &path).expect("renamed");
    };
    let mut live = Live::start(&lab.kit.join("session.json"), &folder.path().join("session"), &[]);
    for (count, first, time) in [(1, 1, "101112.250000"), (2, 2, "101112.250000"), (3, 3, "101112.750000"), (4, 4, "101113")] {
        write(first, time);
        let read = eventually(HANG_S, || (live.pairs() == count).then_some(()));
        assert!(read.is_some(), "{} of {count}: {}", live.pairs(), live.stderr());
    }
    live.signalled(Signal::INT);
    let status = live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr()));
    let words = live.stdout() + &live.stderr();
    assert!(live.lacks_exposures_alone(status.code()), "{words}");
    let replaced = "frame 2: the file of frame 1 was rewritten with a picture of the same exposure, which replaces it";
    assert!(words.contains(replaced), "{words}");
    // Another time is another exposure, whatever the file is called.
    for (number, before) in [(3, 2), (4, 3)] {
        let other = format!("frame {number}: its file was rewritten; an earlier version of it was frame {before}");
        assert!(words.contains(&other), "{words}");
    }
    let pairs = std::fs::read(live.out.join("pairs.json")).expect("pairs");
    let pairs: Value = serde_json::from_slice(&pairs).expect("JSON");
    let of_first = pairs["pairs"].as_array().expect("a list").iter().find(|pair| pair["number"] == 1).expect("the first");
    assert!(said(of_first).contains("frame 2 is the whole picture"), "{of_first:#}");
}
