//! Files that are not whole when they are first seen: half written, paused, full of holes or of zeros.

use sidecarm::acquire::Trouble;

use crate::acquire_frames::{fluoroscopy, save};
use crate::acquire_watch::{Watched, frame_bytes};

#[test]
fn a_half_written_file_waits_is_reported_after_its_patience_and_read_when_whole() {
    let mut watched = Watched::new(true);
    let whole = frame_bytes(1);
    std::fs::write(watched.path("x.dcm"), &whole[..whole.len() - 5]).expect("half");
    for _ in 0..30 {
        watched.step(300_000);
    }
    assert!(watched.frames.is_empty() && watched.troubles.is_empty() && watched.refused.is_empty(), "nine seconds are no reason");
    for _ in 0..10 {
        watched.step(300_000);
    }
    assert!(matches!(watched.troubles.as_slice(), [Trouble::Unfinished { .. }]), "said once: {:?}", watched.troubles);
    std::fs::write(watched.path("x.dcm"), &whole).expect("whole");
    watched.settle();
    assert_eq!(watched.names(), ["x"]);
    assert_eq!(watched.mended, watched.troubles, "it is lost no more");
    // The same again is another matter.
    std::fs::write(watched.path("x.dcm"), frame_bytes(2)).expect("another");
    watched.settle();
    assert_eq!((watched.names().len(), watched.mended.len()), (2, 1));
}

/// As the clock of a share may have it that is behind, or this one once someone has set it.
fn an_hour_back(file: &std::fs::File) {
    let modified = file.metadata().and_then(|metadata| metadata.modified()).expect("a time");
    file.set_modified(modified - std::time::Duration::from_secs(3600)).expect("time is set");
}

#[test]
fn how_old_a_file_claims_to_be_takes_nothing_from_the_patience() {
    let mut watched = Watched::new(true);
    let whole = frame_bytes(1);
    let mut file = std::fs::File::create(watched.path("x.dcm")).expect("created");
    std::io::Write::write_all(&mut file, &whole[..whole.len() - 5]).expect("written");
    an_hour_back(&file);
    drop(file);
    (0..30).for_each(|_| watched.step(300_000));
    assert!(watched.troubles.is_empty(), "nine seconds are no reason: {:?}", watched.troubles);
    watched.outlast();
    assert_eq!(watched.troubles.len(), 1, "control");
}

/// A frame that was cut at 60 % and completed 13 s later was bound, and report and exit code said that it was lost: what was reported of a
/// file is taken back when that file comes whole, and only then.
#[test]
fn what_was_said_to_be_lost_is_taken_back_when_that_very_file_comes_whole() {
    let cut = |watched: &mut Watched, bytes: &[u8]| {
        std::fs::write(watched.path("x.dcm"), &bytes[..bytes.len() - 9]).expect("written");
        watched.outlast();
        assert!(matches!(watched.troubles.as_slice(), [Trouble::Unfinished { .. }]), "{:?}", watched.troubles);
    };
    type Way = fn(&mut Watched, &[u8]);
    let ways: [(&str, Way, usize); 5] = [
        ("completed", |watched, whole| append(&watched.path("x.dcm"), &whole[whole.len() - 9..]), 1),
        (
            "completed in two parts",
            |watched, whole| {
                append(&watched.path("x.dcm"), &whole[whole.len() - 9..whole.len() - 5]);
                watched.outlast();
                append(&watched.path("x.dcm"), &whole[whole.len() - 5..]);
            },
            2,
        ),
        (
            "copied once more",
            |watched, whole| {
                std::fs::remove_file(watched.path("x.dcm")).expect("removed");
                watched.settle();
                std::fs::write(watched.path("x.dcm"), whole).expect("written");
            },
            1,
        ),
        (
            "replaced by itself",
            |watched, whole| {
                std::fs::write(watched.path("x.part"), whole).expect("written");
                std::fs::rename(watched.path("x.part"), watched.path("x.dcm")).expect("renamed");
            },
            1,
        ),
        ("replaced by another", |watched, _| std::fs::write(watched.path("x.dcm"), frame_bytes(77)).expect("written"), 0),
    ];
    for (what, way, mended) in ways {
        let mut watched = Watched::new(true);
        let whole = frame_bytes(1);
        cut(&mut watched, &whole);
        way(&mut watched, &whole);
        watched.settle();
        assert_eq!((watched.names(), watched.mended.len()), (vec!["x"], mended), "{what}: {:?}", watched.troubles);
        assert_eq!(watched.mended.iter().filter(|trouble| watched.troubles.contains(trouble)).count(), mended, "{what}");
    }
}

fn append(path: &std::path::Path, bytes: &[u8]) {
    let mut file = std::fs::File::options().append(true).open(path).expect("there");
    std::io::Write::write_all(&mut file, bytes).expect("written");
}

/// A TIFF whose table of strips comes first and whose strips come last, as scanners write them.
fn tiff_with_strips_last() -> Vec<u8> {
    let (width, rows, strips) = (64u32, 8u32, 4u32);
    let strip_bytes = width * rows;
    let entries: [(u16, u16, u32, u32); 8] = [
        (256, 4, 1, width),
        (257, 4, 1, rows * strips),
        (258, 3, 1, 8),
        (259, 3, 1, 1),
        (262, 3, 1, 1),
        (273, 4, strips, 110),
        (278, 4, 1, rows),
        (279, 4, strips, 110 + 4 * strips),
    ];
    let mut bytes = b"II*\0\x08\0\0\0".to_vec();
    bytes.extend((entries.len() as u16).to_le_bytes());
    for (tag, kind, count, value) in entries {
        bytes.extend(tag.to_le_bytes());
        bytes.extend(kind.to_le_bytes());
        bytes.extend(count.to_le_bytes());
        bytes.extend(value.to_le_bytes());
    }
    bytes.extend([0; 4]);
    assert_eq!(bytes.len(), 110);
    let data = 110 + 8 * strips;
    (0..strips).for_each(|strip| bytes.extend((data + strip * strip_bytes).to_le_bytes()));
    (0..strips).for_each(|_| bytes.extend(strip_bytes.to_le_bytes()));
    bytes.extend((0..strips * strip_bytes).map(|index| (index % 250) as u8 + 1));
    bytes
}

/// A copy that pauses over 100 ms was delivered half zero and its completion ignored.
#[test]
fn a_copy_that_pauses_is_never_delivered_half() {
    let png = {
        let folder = tempfile::tempdir().expect("folder");
        let path = folder.path().join("x.png");
        let noise: Vec<u16> = (0..64 * 64u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 16) as u16).collect();
        image::ImageBuffer::<image::Luma<u16>, _>::from_raw(64, 64, noise).expect("size").save(&path).expect("png");
        std::fs::read(path).expect("bytes")
    };
    let mut cases = 0;
    for (name, whole) in [("run.dcm", frame_bytes(5)), ("run.tif", tiff_with_strips_last()), ("run.png", png)] {
        for eighths in 1..8 {
            let mut watched = Watched::new(true);
            let cut = whole.len() * eighths / 8;
            std::fs::write(watched.path(name), &whole[..cut]).expect("part");
            watched.settle();
            assert!(watched.frames.is_empty(), "{name}: {eighths}/8 were delivered");
            let mut file = std::fs::File::options().append(true).open(watched.path(name)).expect("file");
            std::io::Write::write_all(&mut file, &whole[cut..]).expect("rest");
            drop(file);
            watched.settle();
            assert_eq!(watched.frames.len(), 1, "{name}: {:?} {:?}", watched.troubles, watched.refused);
            cases += 1;
        }
    }
    assert_eq!(cases, 21);
}

/// The whole size is reserved first, the content comes later: zeros that were never written are no image.
#[cfg(target_os = "linux")]
#[test]
fn a_file_with_holes_waits_until_it_is_filled() {
    let mut watched = Watched::new(true);
    let image = sidecarm::image::Image { width: 256, height: 256, pixels: (0..65536).map(|i| 1.0 + i as f32).collect() };
    let beside = tempfile::tempdir().expect("folder");
    sidecarm::image::write_tiff_f32(&beside.path().join("x.tif"), &[image]).expect("written");
    let whole = std::fs::read(beside.path().join("x.tif")).expect("bytes");
    let path = watched.path("x.tif");
    let mut file = std::fs::File::create(&path).expect("file");
    file.set_len(whole.len() as u64).expect("reserved");
    // Header and the table at the end are there, the middle is not.
    use std::os::unix::fs::FileExt;
    file.write_all_at(&whole[..4096], 0).expect("start");
    file.write_all_at(&whole[whole.len() - 4096..], whole.len() as u64 - 4096).expect("end");
    std::io::Write::flush(&mut file).expect("flushed");
    watched.settle();
    assert!(watched.frames.is_empty(), "half an image was delivered");
    file.write_all_at(&whole, 0).expect("all");
    drop(file);
    watched.settle();
    assert_eq!(watched.names(), ["x"]);
}

/// Size first, content later, without holes: half an image looks whole.
#[cfg(target_os = "linux")]
#[test]
fn zeros_at_the_end_are_waited_for_while_the_file_is_open_and_taken_back_otherwise() {
    use std::os::unix::fs::FileExt;
    let whole = {
        let folder = tempfile::tempdir().expect("folder");
        let values: Vec<u16> = (0..64 * 64).map(|n| 100 + n % 900).collect();
        use dicom_core::{DataElement, PrimitiveValue, VR};
        use dicom_dictionary_std::tags;
        let mut object = fluoroscopy();
        object.put(DataElement::new(tags::ROWS, VR::US, PrimitiveValue::from(64u16)));
        object.put(DataElement::new(tags::COLUMNS, VR::US, PrimitiveValue::from(64u16)));
        object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(values.into())));
        std::fs::read(save(object, &folder.path().join("x.dcm"))).expect("bytes")
    };
    let mut torn = whole.clone();
    torn[whole.len() / 2..].fill(0);

    // Open: nothing is delivered before it is closed, and at once then.
    let mut watched = Watched::new(true);
    let file = std::fs::File::create(watched.path("b.dcm")).expect("file");
    file.write_all_at(&torn, 0).expect("size and half");
    an_hour_back(&file);
    watched.step(1);
    std::thread::sleep(std::time::Duration::from_millis(100));
    (0..30).for_each(|_| watched.step(120_000));
    assert!(watched.frames.is_empty(), "half an image was delivered");
    file.write_all_at(&whole, 0).expect("all");
    drop(file);
    std::thread::sleep(std::time::Duration::from_millis(100));
    watched.settle();
    assert_eq!((watched.names(), watched.unfinished.len()), (vec!["b"], 0));

    // Closed: it may be all black below, and is delivered; the whole one says that it was not.
    let mut watched = Watched::new(true);
    std::fs::write(watched.path("c.dcm"), &torn).expect("written");
    std::thread::sleep(std::time::Duration::from_millis(100));
    watched.settle();
    assert_eq!(watched.names(), ["c"]);
    let modified = std::fs::metadata(watched.path("c.dcm")).and_then(|metadata| metadata.modified()).expect("a time");
    let file = std::fs::File::options().write(true).open(watched.path("c.dcm")).expect("file");
    file.write_all_at(&whole, 0).expect("all");
    // Neither size nor time of change tell.
    file.set_modified(modified).expect("time is set");
    drop(file);
    std::thread::sleep(std::time::Duration::from_millis(100));
    watched.settle();
    assert_eq!((watched.names(), watched.unfinished.clone()), (vec!["c", "c"], vec!["c".to_owned()]));

    // The control: another picture under the same name.
    let mut another = whole.clone();
    let last = another.len() - 10;
    another[last] ^= 1;
    std::fs::write(watched.path("c.dcm"), &another).expect("written");
    std::thread::sleep(std::time::Duration::from_millis(100));
    watched.settle();
    assert_eq!((watched.names().len(), watched.unfinished.len()), (3, 1));
}
