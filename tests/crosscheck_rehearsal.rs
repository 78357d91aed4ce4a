//! What `check` makes of a frame that lies in the folder already, and of the exposure that it rehearses.
#![cfg(unix)]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use serde_json::{Value, json as value};

use crate::crosscheck_image::json;
use crate::crosscheck_session::{check_unrehearsed, check_within, copy, edit, move_beads};
use crate::live_lab::Lab;

/// Check, level, words.
type Row = (String, String, String);

/// The one row of a check.
fn row<'a>(rows: &'a [Row], check: &str) -> &'a Row {
    let found: Vec<&Row> = rows.iter().filter(|row| row.0 == check).collect();
    assert_eq!(found.len(), 1, "{check}: {rows:#?}");
    found[0]
}

fn lab() -> Option<Lab> {
    let lab = Lab::start(&["--kit-only", "--exposures", "1"])?;
    edit(&lab.kit, "session.json", |session| session["robot"] = Value::Null);
    Some(lab)
}

/// Every file below a folder with its length and time.
fn state(folder: &Path, found: &mut BTreeMap<PathBuf, (u64, SystemTime)>) {
    for entry in std::fs::read_dir(folder).expect("a folder").flatten() {
        let metadata = entry.metadata().expect("there");
        if metadata.is_dir() {
            state(&entry.path(), found);
        }
        found.insert(entry.path(), (metadata.len(), metadata.modified().expect("a time")));
    }
}

/// A newest frame that could not be read was passed over without a word, and none was ever registered before the session.
#[test]
fn the_newest_frame_is_registered_as_a_live_one_and_damaged_ones_are_named() {
    let Some(lab) = lab() else { return };
    let frame = lab.frames().join("frame-001.dcm");
    let temporary = tempfile::tempdir().expect("a folder");
    let mut before = BTreeMap::new();
    state(&lab.kit, &mut before);
    let (rows, _) = check_within(&lab.kit, temporary.path());
    let mut after = BTreeMap::new();
    state(&lab.kit, &mut after);
    assert!(before == after && before.len() > 5, "something was written: {after:?}");
    let (_, level, words) = row(&rows, "newest frame's pose");
    assert!(level == "pass" && words.contains("frame-001: ") && words.contains("without telemetry"), "{words}");
    assert!(rows.iter().all(|row| row.0 != "unreadable frame"), "{rows:#?}");

    // Half a file, and one of another kind, are newer; the frame behind them is looked at all the same.
    let bytes = std::fs::read(&frame).expect("readable");
    std::fs::write(lab.frames().join("frame-002.dcm"), &bytes[..bytes.len() / 2]).expect("written");
    std::fs::write(lab.frames().join("notes.txt"), "two shots tomorrow").expect("written");
    let (rows, _) = check_unrehearsed(&lab.kit);
    let (_, level, words) = row(&rows, "unreadable frame");
    assert!(level == "warn" && words.contains("frame-002") && words.contains("export it again"), "{words}");
    assert_eq!(row(&rows, "newest frame's pose").1, "pass");
    assert!(!format!("{rows:?}").contains("two shots") && !format!("{rows:?}").contains("notes"), "{rows:#?}");

    // A picture of an intensifier, by its header, of a session that names none: as good a pose, and in doubt.
    let mut object = dicom_object::open_file(&frame).expect("opens");
    object.put(DataElement::new(tags::INTENSIFIER_SIZE, VR::DS, PrimitiveValue::from("229")));
    object.write_to_file(lab.frames().join("frame-003.dcm")).expect("written");
    let (rows, _) = check_unrehearsed(&lab.kit);
    let (_, level, words) = row(&rows, "newest frame's pose");
    let parts = ["frame-003", "in doubt", "(0018,1162) is 229 mm", "\"intensifier\" in a session"];
    assert!(level == "warn" && parts.iter().all(|part| words.contains(part)), "{words}");

    // What its header says of the arm is held against the calibration, and beads that are elsewhere give no pose.
    let mut object = dicom_object::open_file(&frame).expect("opens");
    object.put(DataElement::new(tags::DISTANCE_SOURCE_TO_DETECTOR, VR::DS, PrimitiveValue::from("740")));
    object.write_to_file(lab.frames().join("frame-003.dcm")).expect("written");
    move_beads(&lab.kit, |[x, y, z]| [z, x, y]);
    let (rows, _) = check_unrehearsed(&lab.kit);
    let (_, level, words) = row(&rows, "SID");
    assert!(level == "warn" && words.contains("740") && words.contains("1020"), "{words}");
    let (_, level, words) = row(&rows, "newest frame's pose");
    assert!(level == "warn" && words.contains("frame-003") && words.contains("every frame is refused"), "{words}");
}

/// Of a session whose K had twice the focal length of its frames' headers, `check` gave advice on beads.
#[test]
fn k_of_twice_the_headers_focal_length_is_said_with_both_and_is_what_to_correct() {
    let Some(lab) = lab() else { return };
    edit(&lab.kit, "session.json", |session| {
        session["carm"] = Value::Null;
        session["intrinsics"] = value!("k.json");
    });
    let (rows, _) = check_unrehearsed(&lab.kit);
    let (_, level, words) = row(&rows, "newest frame's pose");
    assert!(level == "pass" && !words.contains("K says"), "the control: {words}");
    edit(&lab.kit, "k.json", |k| {
        for axis in [0usize, 1] {
            k["intrinsics"][axis][axis] = value!(2.0 * k["intrinsics"][axis][axis].as_f64().expect("a number"));
        }
    });
    let (rows, _) = check_unrehearsed(&lab.kit);
    let (_, level, words) = row(&rows, "newest frame's pose");
    let parts = ["K says f 5258 px, the header's SID and pitch say 2629 px", "correct K"];
    assert!(level == "warn" && parts.iter().all(|part| words.contains(part)), "{words}");
    assert!(!words.contains("open the collimator"), "{words}");
}

type Case = (&'static str, fn(&Path), &'static str, &'static [&'static str]);

/// Sessions, and what the rehearsed exposure makes of them.
const CASES: [Case; 5] = [
    // Through a console that turns, mirrors and crops, and a panel with its own offset.
    (
        "console",
        |session| {
            std::fs::create_dir(session.join("none")).expect("a folder");
            edit(session, "session.json", |s| {
                s["frames"]["folder"] = value!("none");
                s["console"] = value!({"rotation_deg": 90, "flip": "horizontal", "crop_px": [40, 20, 540, 440]});
                s["detector"] = value!("panel.json");
            });
        },
        "pass",
        &["beads found", "ZNCC", "read ", "strip "],
    ),
    (
        "another panel",
        |session| {
            edit(session, "panel.json", |panel| panel["columns_px"] = value!(64));
            edit(session, "session.json", |s| s["detector"] = value!("panel.json"));
        },
        "warn",
        &["detector calibration", "[64, 480]", "says so of every frame"],
    ),
    (
        "exchanged",
        |session| move_beads(session, |[x, y, z]| [z, x, y]),
        "fail",
        &["the pose found is 120.0 degrees", "not where the scene has them"],
    ),
    (
        "shifted",
        |session| {
            move_beads(session, |[x, y, z]| [x + 14.0, y, z - 9.0]);
            edit(session, "session.json", |s| s["world_from_lps"] = Value::Null);
        },
        "fail",
        &["from the one that was rendered", "not where the scene has them"],
    ),
    (
        "dark",
        |session| edit(session, "scene.json", |scene| scene["beam"]["photons_per_pixel"] = value!(2)),
        "fail",
        &["gave no pose", "photons_per_pixel"],
    ),
];

/// The exposure went by a path of its own: no bytes, no file, no import, no strip.
#[test]
fn a_rehearsed_exposure_goes_the_session_s_way_and_leaves_nothing_behind() {
    let Some(lab) = lab() else { return };
    let panel = value!({"origin": "test", "columns_px": 620, "rows_px": 480, "offset_value": 212.0, "air_value": 30212.0,
        "saturation_value": 65535.0});
    let run = |(name, spoil, level, words): &Case| {
        let (session, temporary) = (copy(&lab.kit, name), tempfile::tempdir().expect("a folder"));
        std::fs::write(session.join("panel.json"), panel.to_string()).expect("written");
        spoil(&session);
        let (rows, _) = check_within(&session, temporary.path());
        let (_, found, said) = row(&rows, "synthetic exposure");
        assert_eq!(found, level, "{name}: {said}");
        words.iter().for_each(|word| assert!(said.contains(word), "{name}: '{word}' is not in: {said}"));
        assert!(said.ends_with("→ ") == (*level == "pass"), "{name}: {said}");
        let left: Vec<_> = std::fs::read_dir(temporary.path()).expect("a folder").flatten().collect();
        assert!(left.is_empty(), "{name}: {left:?}");
    };
    std::thread::scope(|scope| {
        let threads: Vec<_> = CASES.chunks(3).map(|chunk| scope.spawn(move || chunk.iter().for_each(run))).collect();
        threads.into_iter().for_each(|thread| thread.join().expect("as it should be"));
    });
    // Without a place for its files it says so.
    let (rows, _) = check_within(&lab.kit, &lab.kit.join("nowhere"));
    let (_, level, words) = row(&rows, "synthetic exposure");
    assert!(level == "fail" && words.contains("no temporary folder") && words.contains("TMPDIR"), "{words}");
    assert!(json(&lab.kit.join("session.json"))["detector"].is_null(), "the control: the kit's own session is as it was");
}
