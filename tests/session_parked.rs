//! More large frames at once than the memory is given for them: those that wait lie on the disk.
#![cfg(unix)]

use std::path::{Path, PathBuf};

use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use serde_json::Value;

use crate::live_lab::{HANG_S, Live, deliver, eventually, quiet_lab};
use crate::scene_support::tell_costs;
use crate::session_names::replay;

/// 36 MiB each: of 12, five are more than may wait in memory.
const EDGE_PX: u16 = 3072;
const FRAMES: usize = 12;

/// `frame` with noise in place of its picture, another for each `seed`.
fn large(frame: &Path, seed: u32, folder: &Path) -> PathBuf {
    let mut object = dicom_object::open_file(frame).expect("a DICOM file");
    let mut state = seed.wrapping_mul(2_654_435_761).max(1);
    let words = std::iter::repeat_with(|| {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        3000 + (state >> 24) as u16
    });
    let count = usize::from(EDGE_PX) * usize::from(EDGE_PX);
    object.put(DataElement::new(tags::ROWS, VR::US, PrimitiveValue::from(EDGE_PX)));
    object.put(DataElement::new(tags::COLUMNS, VR::US, PrimitiveValue::from(EDGE_PX)));
    object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(words.take(count).collect())));
    let path = folder.join(format!("large-{seed:02}.dcm"));
    object.write_to_file(&path).expect("written");
    path
}

/// A file without a name in `folder` that the program has open and has written to.
fn unnamed_file(pid: u32, folder: &Path) -> Option<PathBuf> {
    let open = std::fs::read_dir(format!("/proc/{pid}/fd")).ok()?.flatten();
    open.map(|entry| entry.path()).find(|path| {
        let target = std::fs::read_link(path).unwrap_or_default();
        let is_there = target.starts_with(folder) && target.as_os_str().as_encoded_bytes().ends_with(b"(deleted)");
        is_there && std::fs::metadata(path).is_ok_and(|metadata| metadata.len() > 0)
    })
}

fn reasons(out: &Path) -> Vec<String> {
    let bytes = std::fs::read(out.join("pairs.json")).expect("pairs");
    let value: Value = serde_json::from_slice(&bytes).expect("JSON");
    value["pairs"].as_array().expect("a list").iter().map(|pair| pair["reason"].as_str().unwrap_or_default().to_owned()).collect()
}

/// A picture that could not be read back was posed as one of NaN, with a warning, and the session said that nothing was lost.
#[test]
fn frames_that_wait_on_the_disk_come_back_and_one_that_does_not_is_a_loss() {
    let Some((lab, frame, folder)) = quiet_lab("200") else { return };
    let session = lab.session("large.json", |session| {
        let named = session.as_object_mut().expect("an object");
        named.remove("carm");
        named.remove("robot");
    });
    let files: Vec<PathBuf> = (1..=FRAMES as u32).map(|seed| large(&frame, seed, folder.path())).collect();
    let out = lab.kit.with_file_name("session");
    let mut live = Live::launch(&session, &out, &[]);
    assert!(eventually(HANG_S, || live.log.exists().then_some(())).is_some(), "{}", live.stderr());
    let environment = std::fs::read(format!("/proc/{}/environ", live.program.id())).expect("readable");
    assert!(String::from_utf8_lossy(&environment).contains("MIMALLOC_PURGE_DELAY="), "memory is given back after each frame");
    deliver(&files, &lab);
    let unnamed = eventually(HANG_S, || unnamed_file(live.program.id(), &out)).expect("frames wait on the disk");
    // What is written there meanwhile lies behind a gap.
    std::fs::OpenOptions::new().write(true).truncate(true).open(unnamed).expect("emptied");
    let seen = eventually(HANG_S, || (live.pairs() == FRAMES).then_some(()));
    assert!(seen.is_some(), "{} pairs: {} {:?}", live.pairs(), live.stderr(), live.stdout());
    live.program.signal(rustix::process::Signal::INT);
    assert_eq!(live.program.end(HANG_S).and_then(|status| status.code()), Some(3), "{}", live.stderr());
    let lost = reasons(&out).iter().filter(|reason| reason.contains("cannot be read back")).count();
    assert!((1..FRAMES).contains(&lost), "{:#?}", reasons(&out));
    assert!(live.stdout().contains("which waited on the disk, cannot be read back"), "{}", live.stdout());
    assert!(live.report().contains("which waited on the disk, cannot be read back"));

    let again = lab.kit.with_file_name("again");
    tell_costs(folder.path());
    let (_, words) = replay(&live.log, None, folder.path(), &again);
    let reasons = reasons(&again);
    assert!(reasons.len() == FRAMES && !reasons.iter().any(|reason| reason.contains("cannot be read back")), "{reasons:#?}");
    assert!(words.contains(&format!("\"poses_identical\": {}", FRAMES - lost)), "{lost} lost: {words}");
}
