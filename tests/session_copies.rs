//! Pictures that come a second time in another file, and sessions in which nothing ties a frame to its exposure, through `live`.
#![cfg(unix)]

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::time::Duration;

use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_dictionary_std::tags;
use serde_json::{Value, json};
use sidecarm::record::{read_log, topic};

use crate::live_lab::{HANG_S, Lab, Live, Signal, eventually};
use crate::session_names::replay_words;

/// A file that did not change for so long is whole.
const WRITTEN: Duration = Duration::from_millis(1300);

fn pairs(folder: &Path) -> Vec<Value> {
    let text = std::fs::read(folder.join("pairs.json")).expect("pairs");
    serde_json::from_slice::<Value>(&text).expect("JSON")["pairs"].as_array().expect("a list").clone()
}

/// Frames that the mocked detector has written to their end: it copies some in two parts.
fn whole_frames(lab: &Lab) -> Vec<PathBuf> {
    let mut files: Vec<PathBuf> = std::fs::read_dir(lab.frames()).expect("frames").flatten().map(|entry| entry.path()).collect();
    let is_old =
        |path: &PathBuf| path.metadata().is_ok_and(|m| m.modified().is_ok_and(|t| t.elapsed().is_ok_and(|age| age > WRITTEN)));
    files.retain(|path| path.extension().is_some_and(|extension| extension == "dcm") && is_old(path));
    files.sort();
    files
}

/// Writes `object` so that nothing of it is to be seen before it is whole.
fn save(object: &dicom_object::DefaultDicomObject, to: &Path) {
    let part = to.with_extension("part");
    object.write_to_file(&part).expect("written");
    std::fs::rename(part, to).expect("renamed");
}

/// The frame at `from` under other identifiers, of another study, and without what `removed` names.
fn export(from: &Path, to: &Path, uid: &str, removed: &[Tag]) {
    let mut object = dicom_object::open_file(from).expect("a frame");
    object.put(DataElement::new(tags::SOP_INSTANCE_UID, VR::UI, PrimitiveValue::from(uid)));
    object.put(DataElement::new(tags::STUDY_INSTANCE_UID, VR::UI, PrimitiveValue::from(uid)));
    for tag in removed {
        object.remove_element(*tag);
    }
    save(&object, to);
}

/// The frame at `from` as an archive keeps it: under other identifiers, without a number or a time, in 256 grey values that follow a curve.
fn archive(from: &Path, to: &Path) {
    export(from, to, "2.25.123456789", &TIMES);
    let mut object = dicom_object::open_file(to).expect("a frame");
    let white = (1u32 << object.element(tags::BITS_STORED).expect("there").to_int::<u32>().expect("a number")) - 1;
    let values = object.element(tags::PIXEL_DATA).expect("pixels").to_multi_int::<u16>().expect("words");
    let of_256 = |value: &u16| (255.0 * (f64::from(*value) / f64::from(white)).powf(0.6)).round() as u16;
    let values: Vec<u16> = values.iter().map(of_256).collect();
    object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(values.into())));
    save(&object, to);
}

/// A lab that plays a `script`, and a session whose frames come into a folder of their own, which the test fills.
fn exporting(script: &[&str]) -> Option<(Lab, PathBuf, Live)> {
    let lab = Lab::start(&[script, &["--faults", "none", "--await-all", "--idle-s", "300"]].concat())?.without_ct();
    let exported = lab.kit.join("exported");
    std::fs::create_dir(&exported).expect("a folder");
    let session = lab.session("exporting.json", |session| session["frames"]["folder"] = json!(exported));
    let live = Live::start(&session, &lab.kit.with_file_name("session"), &[]);
    Some((lab, exported, live))
}

/// Gives each whole frame of the lab, counted from 1, to `export` once, until there are `count` pairs; then the session ends.
fn exported_until(lab: &Lab, live: &mut Live, count: usize, mut export: impl FnMut(&Live, usize, &Path)) -> Option<i32> {
    let mut seen = BTreeSet::new();
    let all = eventually(HANG_S, || {
        for path in whole_frames(lab) {
            if seen.insert(path.clone()) {
                export(live, seen.len(), &path);
            }
        }
        (live.pairs() == count).then_some(())
    });
    assert!(all.is_some(), "{} of {count} pairs: {}", live.pairs(), live.stderr());
    live.signalled(Signal::INT);
    live.program.end(HANG_S).unwrap_or_else(|| panic!("still there: {}", live.stderr())).code()
}

/// Exports something and waits until it is read.
fn until_read(live: &Live, export: impl FnOnce()) {
    let in_log =
        || read_log(&live.log).map_or(0, |log| log.entries.iter().filter(|entry| &*entry.topic == topic::FRAME_TAGS).count());
    let before = in_log();
    export();
    assert!(eventually(HANG_S, || (in_log() > before).then_some(())).is_some(), "it is never read: {}", live.stderr());
}

/// Copies the file at `from` into `folder` so that nothing of it is to be seen before it is whole.
fn export_as_it_is(from: &Path, folder: &Path) {
    let to = folder.join(from.file_name().expect("a name"));
    let part = to.with_extension("part");
    std::fs::copy(from, &part).expect("copied");
    std::fs::rename(part, to).expect("renamed");
}

/// Whatever numbers or dates a frame.
const TIMES: [Tag; 7] = [
    tags::ACQUISITION_NUMBER,
    tags::ACQUISITION_DATE,
    tags::ACQUISITION_TIME,
    tags::ACQUISITION_DATE_TIME,
    tags::CONTENT_DATE,
    tags::CONTENT_TIME,
    tags::INSTANCE_NUMBER,
];

/// The frame at `from` with letters of 5 × 7 dots at the end of its scale, as a console writes them into a corner.
fn write_upon(from: &Path, to: &Path) {
    let mut object = dicom_object::open_file(from).expect("a frame");
    let number = |tag: Tag| object.element(tag).expect("there").to_int::<usize>().expect("a number");
    let (columns, white) = (number(tags::COLUMNS), (1u32 << number(tags::BITS_STORED)) - 1);
    let mut values = object.element(tags::PIXEL_DATA).expect("pixels").to_multi_int::<u16>().expect("words");
    for letter in 0..12usize {
        for bit in (0..35usize).filter(|bit| (0x005A_3C96_E7B1_u64 >> ((bit + 7 * letter) % 36)) & 1 == 1) {
            for (u, v) in (0..9usize).map(|dot| (dot % 3, dot / 3)) {
                let (column, row) = (12 + (letter * 6 + bit % 5) * 3 + u, 12 + bit / 5 * 3 + v);
                values[row * columns + column] = white as u16;
            }
        }
    }
    object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(values.into())));
    save(&object, to);
}

/// The same picture exported twice under new identifiers was a second frame: posed without its joints, its robot drawn as in the scene file,
/// and not a word.
#[test]
fn the_same_picture_exported_again_is_said_to_be_a_copy() {
    // The last is the collimated one.
    let script = ["--duration-s", "14", "--exposures", "5", "--stands", "1,2,3,4,7"];
    let Some((lab, exported, mut live)) = exporting(&script) else { return };
    let code = exported_until(&lab, &mut live, 5 + 2, |live, count, path| {
        until_read(live, || match count {
            2 => write_upon(path, &exported.join(path.file_name().expect("a name"))),
            _ => export_as_it_is(path, &exported),
        });
        if count == 3 {
            until_read(live, || export(path, &exported.join("again.dcm"), "2.25.987654321", &[]));
        }
        if count == 4 {
            let kept = lab.kit.join("kept.dcm");
            archive(path, &kept);
            until_read(live, || std::fs::rename(kept, exported.join("kept.dcm")).expect("renamed"));
        }
    });
    assert!(matches!(code, Some(0 | 3)), "{}", live.stderr());
    let pairs = pairs(&live.out);
    assert_eq!(pairs.len(), 5 + 2, "{}", live.stderr());
    let copies: Vec<&Value> =
        pairs.iter().filter(|pair| pair["flags"].to_string().contains("the same picture as frame")).collect();
    assert!(copies.len() == 2 && copies.iter().all(|copy| copy["binding"] == "none"), "{copies:#?}");
    assert!(live.stderr().contains("the same picture as frame"), "{}", live.stderr());
    // A frame whose shutters are in the picture is among them, and no writing is in that.
    let written: Vec<&Value> = pairs.iter().filter(|pair| pair["flags"].to_string().contains("masked as writing")).collect();
    assert!(
        written.len() == 1 && written[0]["number"] == 2,
        "{:?} {}",
        pairs.iter().map(|p| &p["flags"]).collect::<Vec<_>>(),
        live.stderr()
    );
    assert!(live.stderr().contains("burned in"), "{}", live.stderr());
    let others: Vec<&Value> = pairs.iter().filter(|pair| pair["flags"].to_string().contains("of another study")).collect();
    assert!(others.len() == 2 && live.stderr().contains("is of another study than frame 1"), "{others:#?} {}", live.stderr());

    // Exported for the archive afterwards, frames that the log holds keep the exposures that they have there, and none takes another's.
    let afterwards = lab.kit.join("afterwards");
    std::fs::create_dir(&afterwards).expect("a folder");
    let whole = whole_frames(&lab);
    for path in &whole {
        archive(path, &afterwards.join(path.file_name().expect("a name")));
    }
    let output = std::process::Command::new(env!("CARGO_BIN_EXE_sidecarm"))
        .arg("attach")
        .arg(&live.log)
        .arg(&afterwards)
        .arg("--json")
        .output()
        .expect("runs");
    let json: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let frames = json["frames"].as_array().expect("a list");
    assert_eq!(frames.len(), whole.len(), "{json:#}");
    for frame in frames {
        assert!(frame["binding"]["evidence"].to_string().contains("the log holds this very frame"), "{frame:#}");
    }
}

/// Nothing tied a frame to its exposure, every robot was drawn as in the scene file, and the session ended with "nothing was lost".
#[test]
fn a_session_in_which_no_frame_is_tied_to_an_exposure_ends_with_loss() {
    let Some((lab, exported, mut live)) = exporting(&["--duration-s", "8", "--exposures", "5", "--no-counter"]) else { return };
    assert!(eventually(HANG_S, || (whole_frames(&lab).len() == 5).then_some(())).is_some(), "{}", live.stderr());
    // Longer than a frame may come after its exposure to be taken for that one's by its arrival.
    std::thread::sleep(Duration::from_secs(6));
    let code = exported_until(&lab, &mut live, 3, |_, count, path| {
        if count <= 3 {
            export(path, &exported.join(format!("f{count}.dcm")), &format!("2.25.{count}77"), &TIMES);
        }
    });
    assert_eq!(code, Some(3), "{}", live.stderr());
    let pairs = pairs(&live.out);
    assert!(pairs.len() == 3 && pairs.iter().all(|pair| pair["binding"] == "none"), "{pairs:#?}");
    assert!(live.stdout().contains("not one of 3 frames could be tied"), "{}", live.stdout());
    let report = std::fs::read_to_string(live.out.join("report.html")).expect("a report");
    assert!(report.contains("not one of 3 frames could be tied"));
    let again = replay_words(&live.log, &lab.kit.with_file_name("again"));
    assert!(again.contains("lost in the session: not one of 3 frames could be tied"), "{again}");
}

/// A console that exports a picture without number or time before the file that has them: the file took no exposure, as a copy of that
/// picture, and the session ended with "nothing was lost".
#[test]
fn a_picture_without_a_word_of_its_exposure_is_the_copy_though_it_came_first() {
    const FRAMES: usize = 4;
    let frames = FRAMES.to_string();
    // Exposures eight seconds apart: all that is exported of one is read before the next, and arrival tells them.
    let Some((lab, exported, mut live)) = exporting(&["--duration-s", "56", "--exposures", &frames]) else { return };
    let code = exported_until(&lab, &mut live, 2 * FRAMES + 1, |live, count, path| {
        until_read(live, || export(path, &exported.join(format!("preview-{count}.dcm")), &format!("2.25.77{count}"), &TIMES));
        until_read(live, || export_as_it_is(path, &exported));
        if count == 2 {
            // A third time: the copy of the file, and no reason to take the first for the copy of this one.
            until_read(live, || export(path, &exported.join("again.dcm"), "2.25.987654321", &[]));
        }
    });
    assert!(matches!(code, Some(0 | 3)), "{}", live.stderr());
    let pairs = pairs(&live.out);
    assert_eq!(pairs.len(), 2 * FRAMES + 1, "{}", live.stderr());
    let (copies, frames): (Vec<&Value>, Vec<&Value>) = pairs.iter().partition(|pair| copy_of(pair).is_some());
    assert!(copies.len() == FRAMES + 1 && copies.iter().all(|copy| copy["binding"] == "none"), "{copies:#?}");
    for frame in &frames {
        assert!(frame["binding"] != "none" && frame["robot_source"] == "sensed", "{frame:#}");
    }
    // Each names a frame that has an exposure, which came after it but for the third export of one.
    let numbers: BTreeSet<u64> = frames.iter().filter_map(|frame| frame["number"].as_u64()).collect();
    assert!(copies.iter().all(|copy| copy_of(copy).is_some_and(|of| numbers.contains(&of))), "{numbers:?} {copies:#?}");
    let first = copies.iter().filter(|copy| copy_of(copy) > copy["number"].as_u64());
    assert!(first.count() == FRAMES, "{copies:#?}");
    // Copies count as such, and as nothing else.
    assert!(copies.iter().all(|copy| copy["copy_of"].as_u64() == copy_of(copy)), "{copies:#?}");
    assert!(frames.iter().all(|frame| frame["copy_of"].is_null()), "{frames:#?}");
    let (words, report) = (live.stdout(), live.report());
    let told =
        words.starts_with(&format!("{} frames, ", 2 * FRAMES + 1)) && words.contains(&format!(", {} copies: ", FRAMES + 1));
    assert!(told && report.contains(&format!(">{FRAMES}</b><span>exposures</span>")), "{words}");
    assert!(report.contains(&format!(">{}</b><span>copies</span>", FRAMES + 1)), "{words}");
    let again = replay_words(&live.log, &lab.kit.with_file_name("again"));
    assert_eq!(again.matches(", 0 different").count(), 3, "poses, images and scores: {again}");
}

/// The frame that has the same picture, by the flags of a pair.
fn copy_of(pair: &Value) -> Option<u64> {
    let flags = pair["flags"].as_array()?.iter().filter_map(Value::as_str);
    let mut named = flags.filter_map(|flag| flag.strip_prefix("the same picture as frame ")?.split(',').next());
    named.next()?.parse().ok()
}
