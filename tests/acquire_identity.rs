//! Forty planted names, identifiers, dates and texts: none comes out of a session, wherever one looks.

use std::path::{Path, PathBuf};

use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_dictionary_std::tags;
use dicom_object::InMemDicomObject;
use serde_json::{Value, json};
use sidecarm::image::{sha256_file, write_tiff_f32};
use sidecarm::record::{Provenance, Recorder};

use crate::acquire_frames::{fluoroscopy, save};
use crate::acquire_live::Room;
use crate::compare_synthetic::{acquired, line_integral, view};
use crate::telemetry_frames::carm;

/// What is planted in headers: attribute, representation, value, and what must not be found (in lower case). Words are long and numbers
/// longer, because compressed files hold every short one by chance; short names are judged by the labels.
const HEADER: [(Tag, VR, &str, &[&str]); 22] = [
    (tags::PATIENT_NAME, VR::PN, "Quaxwelk^Annegrund", &["quaxwelk", "annegrund"]),
    (tags::PATIENT_ID, VR::LO, "PXQ90817", &["pxq90817"]),
    (tags::OTHER_PATIENT_NAMES, VR::PN, "Vormelding", &["vormelding"]),
    (tags::PATIENT_BIRTH_DATE, VR::DA, "19520317", &["19520317", "17031952"]),
    (tags::PATIENT_ADDRESS, VR::LO, "Trullgasse 7", &["trullgasse"]),
    (tags::INSTITUTION_NAME, VR::LO, "Klinikum Borvelde", &["borvelde"]),
    (tags::INSTITUTION_ADDRESS, VR::ST, "Wexstrasse 99", &["wexstrasse"]),
    (tags::INSTITUTIONAL_DEPARTMENT_NAME, VR::LO, "Orthodrom", &["orthodrom"]),
    (tags::REFERRING_PHYSICIAN_NAME, VR::PN, "Drubbelmann^K", &["drubbelmann"]),
    (tags::PERFORMING_PHYSICIAN_NAME, VR::PN, "Zettelhuber", &["zettelhuber"]),
    (tags::OPERATORS_NAME, VR::PN, "Pfriemkötter", &["pfriemk"]),
    (tags::STATION_NAME, VR::SH, "STNQX7", &["stnqx7"]),
    (tags::ACCESSION_NUMBER, VR::SH, "ACC5587123", &["acc5587123"]),
    (tags::STUDY_ID, VR::SH, "STU7731", &["stu7731"]),
    (tags::STUDY_DESCRIPTION, VR::LO, "Huefte Quorbel", &["quorbel"]),
    (tags::SERIES_DESCRIPTION, VR::LO, "Serie Knaspert", &["knaspert"]),
    (tags::IMAGE_COMMENTS, VR::LT, "left hip of Wimmelrath", &["wimmelrath"]),
    (tags::SOP_INSTANCE_UID, VR::UI, "1.2.826.0.1.3680043771239.445566778", &["3680043771239"]),
    (tags::STUDY_INSTANCE_UID, VR::UI, "1.2.826.0.1.99887766554433.1", &["99887766554433"]),
    (tags::SERIES_INSTANCE_UID, VR::UI, "1.2.826.0.1.66554433221100.2", &["66554433221100"]),
    (tags::DEVICE_SERIAL_NUMBER, VR::LO, "SN-KJX-443", &["kjx-443"]),
    (tags::PROTOCOL_NAME, VR::LO, "Brabbelscan", &["brabbelscan"]),
];

/// Free text where the standard has terms.
const CODES: [(Tag, &str, &str); 12] = [
    (tags::FILTER_TYPE, "CU KNORZELFINK", "knorzelfink"),
    (tags::FILTER_MATERIAL, "WUMMERBACH", "wummerbach"),
    (tags::COLLIMATOR_SHAPE, "FRAU ZIPPELT", "zippelt"),
    (tags::SHUTTER_SHAPE, "FRAU PLOMMER", "plommer"),
    (tags::X_RAY_RECEPTOR_TYPE, "HERR VIERTLER", "viertler"),
    (tags::DETECTOR_TYPE, "DOKTOR GRANZ", "granz"),
    (tags::FIELD_OF_VIEW_SHAPE, "ONKEL STRUPP", "strupp"),
    (tags::MODALITY, "XYLOTAN", "xylotan"),
    (tags::IMAGE_TYPE, "ORIGINAL\\GRUMBELT", "grumbelt"),
    (tags::PRESENTATION_INTENT_TYPE, "HERR ZOLPERICH", "zolperich"),
    (tags::PIXEL_INTENSITY_RELATIONSHIP, "NORQUELL", "norquell"),
    (tags::BURNED_IN_ANNOTATION, "BRUXELBART", "bruxelbart"),
];

/// File names and what of them must not be found.
pub const NAMES: [(&str, &[&str]); 9] = [
    ("Quaxwelk_0001.dcm", &["quaxwelk"]),
    ("Pfriemkoetter 2.dcm", &["pfriemkoetter", "pfriemk"]),
    ("XA.1.2.826.0.1.3680043771239.445566778", &["445566778"]),
    ("img_19520317.dcm", &["19520317"]),
    ("img_170352.dcm", &[]),
    ("img_90817.dcm", &[]),
    ("Qz.dcm", &[]),
    ("frame\u{1b}[31mHopfstaedt.dcm", &["hopfstaedt"]),
    ("Borvelde-77.dcm", &["borvelde"]),
];

/// Names, numbers and dates of a person into a header; what it says of the picture stays.
pub fn plant_header(object: &mut InMemDicomObject) {
    for (tag, vr, value, _) in HEADER {
        object.put(DataElement::new(tag, vr, PrimitiveValue::from(value)));
    }
    object.put(DataElement::new(tags::SPECIFIC_CHARACTER_SET, VR::CS, PrimitiveValue::from("ISO_IR 192")));
}

/// A small frame whose header is full of what must not come out; its pixels start with `first`.
pub fn planted(first: u16) -> InMemDicomObject {
    let mut object = fluoroscopy();
    plant_header(&mut object);
    for (tag, value, _) in CODES {
        object.put(DataElement::new(tag, VR::CS, PrimitiveValue::from(value)));
    }
    object.put(DataElement::new(Tag(0x0009, 0x0010), VR::LO, PrimitiveValue::from("PRIVATLOB")));
    object.put(DataElement::new(Tag(0x0009, 0x1001), VR::LO, PrimitiveValue::from("Sesquipedal")));
    object.put(DataElement::new(tags::EXPOSURE_TIME, VR::IS, PrimitiveValue::from("Flunkerbein")));
    for (tag, value) in [(tags::ROWS, 48u16), (tags::COLUMNS, 64)] {
        object.put(DataElement::new(tag, VR::US, PrimitiveValue::from(value)));
    }
    let values: Vec<u16> = (0..64 * 48).map(|index| first + index % 1000).collect();
    object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(values.into())));
    object
}

/// A PNG with a text chunk, and a TIFF with a description.
fn plant_rasters(frames: &Path) {
    let grey =
        |shift: u16| image::ImageBuffer::<image::Luma<u16>, _>::from_fn(64, 48, |x, y| image::Luma([(x * y) as u16 + shift]));
    let path = frames.join("Wunderlich_Ottokar.png");
    grey(1).save(&path).expect("png");
    let png = std::fs::read(&path).expect("bytes");
    let text = b"tEXtAuthor\0Gnadenlos";
    let mut crc = flate2::Crc::new();
    crc.update(text);
    let mut with_text = png[..33].to_vec();
    with_text.extend(((text.len() - 4) as u32).to_be_bytes());
    with_text.extend(text);
    with_text.extend(crc.sum().to_be_bytes());
    with_text.extend(&png[33..]);
    std::fs::write(&path, with_text).expect("png");
    let path = frames.join("Ostruemmler.tif");
    let mut encoder = tiff::encoder::TiffEncoder::new(std::fs::File::create(&path).expect("file")).expect("tiff");
    let mut image = encoder.new_image::<tiff::encoder::colortype::Gray16>(64, 48).expect("image");
    image.encoder().write_tag(tiff::tags::Tag::ImageDescription, "Krautwickel").expect("tag");
    image.write_data(grey(2).as_raw()).expect("data");
}

/// Frames in names that identify and in one that does not, and files that are refused, whose names are in warnings.
fn plant_folder(frames: &Path) {
    for (number, (name, _)) in NAMES.iter().enumerate() {
        save(planted(10 + number as u16), &frames.join(name));
    }
    save(planted(90), &frames.join("phantom run-07.dcm"));
    plant_rasters(frames);
    std::fs::write(frames.join("Schlonz.dcm"), b"no image at all").expect("written");
    let whole = std::fs::read(frames.join(NAMES[0].0)).expect("bytes");
    // One that never becomes whole.
    std::fs::write(frames.join("Annegrund-cut.dcm"), &whole[..whole.len() - 9]).expect("written");
}

/// Frames that come in it and can be read.
const READABLE: usize = NAMES.len() + 3;

/// All that must not be found, in lower case.
fn canaries() -> Vec<String> {
    let mut found: Vec<String> = Vec::new();
    HEADER.iter().for_each(|(_, _, _, words)| found.extend(words.iter().map(|word| (*word).to_owned())));
    CODES.iter().for_each(|(_, _, word)| found.push((*word).to_owned()));
    NAMES.iter().for_each(|(_, words)| found.extend(words.iter().map(|word| (*word).to_owned())));
    for word in [
        "privatlob",
        "sesquipedal",
        "flunkerbein",
        "wunderlich",
        "ottokar",
        "gnadenlos",
        "ostruemmler",
        "krautwickel",
        "meisterfolder",
        "schlonz",
        "lovelace",
        "augusta",
    ] {
        found.push(word.to_owned());
    }
    found.sort();
    found.dedup();
    found
}

/// Every text that a session gives: what it printed, every file it wrote, every message and attachment of its log.
fn outputs(room: &Room, printed: &[&[u8]]) -> Vec<(String, Vec<u8>)> {
    let mut all: Vec<(String, Vec<u8>)> = printed.iter().map(|bytes| ("printed".to_owned(), bytes.to_vec())).collect();
    all.extend(written(&room.out()));
    all
}

/// Every file of a session's folder, and every message and attachment of its log, if it has one.
pub fn written(out: &Path) -> Vec<(String, Vec<u8>)> {
    let mut all = Vec::new();
    let mut folders = vec![out.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).expect("lists").flatten() {
            if entry.path().is_dir() {
                folders.push(entry.path());
            } else {
                let name = entry.file_name().to_string_lossy().into_owned();
                all.push((name.clone(), name.into_bytes()));
                all.push((entry.path().display().to_string(), std::fs::read(entry.path()).expect("readable")));
            }
        }
    }
    let log = out.join("session.mcap");
    if !log.exists() {
        return all;
    }
    let log = sidecarm::record::read_log(&log).expect("a log");
    assert!(log.losses.is_empty(), "{:?}", log.losses);
    for entry in log.entries {
        // Pixels hold no text, and by chance any short one.
        if &*entry.topic != sidecarm::record::topic::FRAME_PIXELS && &*entry.topic != sidecarm::record::topic::DRR {
            all.push((entry.topic.to_string(), entry.data));
        }
    }
    all.extend(log.attachments.into_iter().map(|file| (file.name, file.data)));
    all
}

/// Where `word` (in lower case) is found.
pub fn hits(outputs: &[(String, Vec<u8>)], word: &str) -> Vec<String> {
    let contains = |bytes: &[u8]| bytes.to_ascii_lowercase().windows(word.len()).any(|window| window == word.as_bytes());
    outputs.iter().filter(|(_, bytes)| contains(bytes)).map(|(name, _)| name.clone()).collect()
}

pub fn holds_no_canary(outputs: &[(String, Vec<u8>)]) {
    let canaries = canaries();
    assert!(canaries.len() >= 40, "{}", canaries.len());
    let found: Vec<_> = canaries.iter().map(|word| (word, hits(outputs, word))).filter(|(_, hits)| !hits.is_empty()).collect();
    assert!(found.is_empty(), "{found:?}");
}

/// What the program prints with these arguments in a folder; it ends with one of the `codes`.
pub fn ran(folder: &Path, arguments: &[&str], codes: &[i32]) -> Vec<u8> {
    let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    let output = command.args(arguments).current_dir(folder).output().expect("starts");
    let printed = [output.stdout, output.stderr].concat();
    let is_expected = output.status.code().is_some_and(|code| codes.contains(&code));
    assert!(is_expected, "{arguments:?}: {:?}: {}", output.status, String::from_utf8_lossy(&printed));
    printed
}

#[test]
fn nothing_that_identifies_anybody_comes_out_of_a_session() {
    let room = Room::new("Meisterfolder/frames");
    plant_folder(&room.frames);
    std::fs::create_dir(room.frames.join("Zettelhuber.dcm")).expect("folder");
    let ended = room.end(room.start(9.0));
    let stderr = String::from_utf8_lossy(&ended.stderr);
    assert!(matches!(ended.code, Some(0 | 3)), "{:?}: {stderr}", ended.code);
    assert_eq!(ended.pairs.len(), READABLE, "{stderr}");

    let mut outputs = outputs(&room, &[&ended.stdout, &ended.stderr]);
    // What a replay says and makes of its log.
    let printed = ran(room.folder.path(), &["replay", "out/session.mcap", "--json", "--out", "replayed"], &[0, 3]);
    let replayed = written(&room.folder.path().join("replayed"));
    assert!(hits(&replayed, "phantom run-07").len() >= 2, "control: {:?}", hits(&replayed, "phantom run-07"));
    outputs.extend(replayed);
    outputs.push(("printed by replay".to_owned(), printed));
    // The control: what may be shown is found by the same search, in the log and on paper.
    for allowed in ["phantom run-07", "unreadable frame"] {
        assert!(hits(&outputs, allowed).len() >= 2, "{allowed} in {:?}", hits(&outputs, allowed));
    }
    holds_no_canary(&outputs);
    let texts: Vec<_> = outputs.iter().filter(|(_, bytes)| std::str::from_utf8(bytes).is_ok()).cloned().collect();
    assert!(texts.len() > 10 && hits(&texts, "\u{1b}").is_empty(), "{:?}", hits(&texts, "\u{1b}"));
    for pair in &ended.pairs {
        let label = pair["frame"].as_str().expect("a label");
        let hashed =
            label.strip_prefix("frame-").is_some_and(|hash| hash.len() == 12 && hash.bytes().all(|b| b.is_ascii_hexdigit()));
        assert!(hashed || label == "phantom run-07", "{label}");
    }
}

/// `info` is asked for a file by a person who knows its name; the header stays closed all the same.
#[test]
fn info_shows_nothing_of_the_header_that_identifies() {
    let folder = tempfile::tempdir().expect("folder");
    let path = save(planted(1), &folder.path().join("frame\u{1b}[31m.dcm"));
    for arguments in [vec!["info", path.to_str().expect("text")], vec!["info", path.to_str().expect("text"), "--json"]] {
        let output = std::process::Command::new(env!("CARGO_BIN_EXE_sidecarm")).args(arguments).output().expect("starts");
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        let outputs = [("printed".to_owned(), [output.stdout, output.stderr].concat())];
        let mut searched = 0;
        for (_, _, _, words) in HEADER {
            for word in words {
                assert!(hits(&outputs, word).is_empty(), "{word}");
                searched += 1;
            }
        }
        assert!(hits(&outputs, "\u{1b}").is_empty(), "what a terminal obeys is escaped");
        assert!(searched > 20 && !hits(&outputs, "78.5").is_empty(), "control: the tube voltage is shown");
    }
}

/// A log of an arm with a few exposures and no frame.
fn arm_log(path: &Path) {
    const T0_US: i64 = 1_795_255_200_000_000;
    let recorder = Recorder::create(path, &Provenance::of_this_program(T0_US, Value::Null)).expect("a log");
    for number in 0..500 {
        let at_us = i64::from(number) * 40_000;
        let packet = carm(number, 1_000 + at_us as u64, [0.0, 0.0, 0.0, 0.0, 9.0, 0.0, 1020.0], number % 100 >= 90, None);
        recorder.raw_bytes("carm", 1, T0_US + at_us + 800, &packet).expect("recorded");
    }
    recorder.finish().expect("finished");
}

/// What the commands read that take a frame by its name: planted frames in harmless names, a picture of something and its DRR,
/// beads.
fn plant_named(folder: &Path) {
    save(planted(1), &folder.join("small.dcm"));
    plant_rasters(folder);
    for (from, to) in [("Wunderlich_Ottokar.png", "scan.png"), ("Ostruemmler.tif", "scan.tif")] {
        std::fs::rename(folder.join(from), folder.join(to)).expect("renamed");
    }
    let simulated = line_integral(&view());
    let mut picture = planted(0);
    for (tag, side) in [(tags::ROWS, simulated.height), (tags::COLUMNS, simulated.width)] {
        picture.put(DataElement::new(tag, VR::US, PrimitiveValue::from(side as u16)));
    }
    let values: Vec<u16> = acquired(&simulated, 0.01).pixels.pixels.iter().map(|value| (3000.0 * value) as u16).collect();
    picture.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(values.into())));
    save(picture, &folder.join("frame.dcm"));
    write_tiff_f32(&folder.join("drr.tif"), &[simulated]).expect("written");
    let places = [[0, 0, 0], [40, 5, -10], [-35, 12, 20], [8, -30, 31], [-20, 27, -33], [26, 38, 14], [-44, -18, -7]];
    let point = |(index, place): (usize, &[i32; 3])| {
        let label = format!("B{index}");
        json!({"label": label, "position": place, "description": "radius_mm=0.75"})
    };
    let points: Vec<Value> = places.iter().enumerate().map(point).collect();
    let list = json!({"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": points});
    std::fs::write(folder.join("beads.mrk.json"), json!({"markups": [list]}).to_string()).expect("written");
}

/// All bytes that `register`, `compare`, `attach` and `check` print and write of planted frames.
#[test]
fn nothing_that_identifies_anybody_comes_out_of_the_commands_that_read_frames() {
    let room = Room::new("frames");
    let folder = room.folder.path();
    let out = room.out();
    std::fs::create_dir(&out).expect("folder");
    plant_folder(&room.frames);
    plant_named(folder);
    arm_log(&folder.join("arm.mcap"));
    let mut outputs: Vec<(String, Vec<u8>)> = Vec::new();
    // What is typed is harmless; the control is a word that each command says of the planted frame.
    for (frame, pose) in [("small.dcm", "of-dicom.json"), ("scan.png", "of-png.json"), ("scan.tif", "of-tiff.json")] {
        let path: PathBuf = out.join(pose);
        let arguments = ["register", frame, "--beads", "beads.mrk.json", "--explain", "--out", path.to_str().expect("UTF-8")];
        outputs.push((frame.to_owned(), ran(folder, &arguments, &[1])));
        let pose: Value = serde_json::from_slice(&std::fs::read(&path).expect("a pose")).expect("JSON");
        assert!(pose["status"] == "refused" && pose["reason"].is_string(), "{frame}: {pose:#}");
        assert!(hits(&outputs, "bead-like shadows in the frame").contains(&frame.to_owned()), "{frame}");
    }
    let compare = ["compare", "frame.dcm", "drr.tif", "--domain", "linear", "--quantity", "line_integral", "--json"];
    outputs.push(("compare".to_owned(), ran(folder, &[&compare[..], &["--out", "out/compared"]].concat(), &[0])));
    assert!(hits(&outputs, "declared by the user: linear").contains(&"compare".to_owned()), "control");
    let attach = ["attach", "arm.mcap", "frames", "--json", "--out", "out/bindings.json"];
    let printed = ran(folder, &attach, &[3]);
    let attached: Value = serde_json::from_slice(&std::fs::read(out.join("bindings.json")).expect("bindings")).expect("JSON");
    assert_eq!(attached["frames"].as_array().map(Vec::len), Some(READABLE), "{attached:#}");
    assert!(attached["losses"].to_string().contains("file "), "the damaged one: {:#}", attached["losses"]);
    outputs.push(("attach".to_owned(), printed));
    assert!(hits(&outputs, "phantom run-07").contains(&"attach".to_owned()), "control");
    // The newest frame of the folder is looked at: it has a name that identifies.
    let other = Room::new("frames");
    let newest = save(planted(2), &other.frames.join(NAMES[0].0));
    outputs.push(("check".to_owned(), ran(other.folder.path(), &["check", "session.json", "--json"], &[0, 1])));
    let label = format!("frame-{}", &sha256_file(&newest).expect("readable")[..12]);
    assert!(hits(&outputs, &label).contains(&"check".to_owned()), "control: {label}");

    outputs.extend(written(&out));
    for file in ["of-dicom.json", "compare.json", "strip.png", "bindings.json"] {
        assert!(outputs.iter().any(|(name, bytes)| name.ends_with(file) && bytes.len() > 100), "{file}");
    }
    holds_no_canary(&outputs);
}
