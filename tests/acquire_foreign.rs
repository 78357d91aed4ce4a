//! Hostile and damaged files: each is one refused file with its reason, whatever it does to the helper that decodes it.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::tags;
use serde_json::json;
use sidecarm::acquire::{Fault, Frame, read_frames, read_open};
use sidecarm::foreign::{ForeignFault, ForeignReader, Kind, Limits, open_regular};
use sidecarm::image::{Image, write_tiff_f32};

use crate::acquire_frames::{fluoroscopy, save};
use crate::acquire_live::frame_bytes;
#[cfg(unix)]
use crate::live_lab::{HANG_S, eventually};
use crate::scene_support::NiftiFile;

fn helper() -> ForeignReader {
    ForeignReader::of(env!("CARGO_BIN_EXE_sidecarm"))
}

fn through(reader: &ForeignReader, path: &Path) -> Result<Vec<Frame>, Fault> {
    read_open(reader, open_regular(path, u64::MAX).expect("a file"), path, None)
}

pub fn sidecarm(folder: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_sidecarm")).args(args).current_dir(folder).output().expect("the program starts")
}

/// Exit code 1 and one sentence, perhaps a hint; nothing of the helper's own words.
pub fn assert_one_sentence(what: &str, output: &Output, words: &str) {
    let stderr = String::from_utf8_lossy(&output.stderr);
    let lines: Vec<&str> = stderr.lines().filter(|line| !line.starts_with("hint: ")).collect();
    assert_eq!(output.status.code(), Some(1), "{what}: {stderr}");
    assert!(lines.len() == 1 && lines[0].starts_with("sidecarm: "), "{what}: {stderr}");
    assert!(stderr.contains(words), "{what}: '{words}' in {stderr}");
    for word in ["panicked", "overflowed", "memory allocation", "RUST_BACKTRACE"] {
        assert!(!stderr.contains(word), "{what}: {stderr}");
    }
}

#[test]
fn frames_come_through_a_helper_as_they_are() {
    let folder = tempfile::tempdir().expect("folder");
    let run = folder.path().join("run.dcm");
    let mut object = fluoroscopy();
    object.put(DataElement::new(tags::NUMBER_OF_FRAMES, VR::IS, PrimitiveValue::from("3")));
    object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16((0..24u16).collect::<Vec<_>>().into())));
    save(object, &run);
    let pages = folder.path().join("pages.tif");
    let page = |first: f32| Image { width: 3, height: 2, pixels: vec![first, 0.25, 0.5, 0.75, 1.0, 1.5] };
    write_tiff_f32(&pages, &[page(0.0), page(9.0)]).expect("written");
    std::fs::write(folder.path().join("pages.tif.json"), r#"{"quantity": "line_integral", "unit": "neper"}"#).expect("beside");
    let mut cases = 0;
    for (path, count) in [(run, 3), (pages, 2)] {
        let frames = through(&helper(), &path).expect("readable");
        assert_eq!(frames.len(), count);
        assert_eq!(frames, read_frames(&path, None).expect("readable"), "bit for bit, tags and notes included");
        assert!(frames.iter().enumerate().all(|(index, frame)| frame.image_of_file == [index, count]));
        cases += 1;
    }
    assert_eq!(cases, 2);
}

#[cfg(unix)]
fn script(folder: &Path, name: &str, body: &str) -> ForeignReader {
    use std::os::unix::fs::PermissionsExt;
    let path = folder.join(name);
    std::fs::write(&path, format!("#!/bin/sh\n{body}\n")).expect("script");
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).expect("executable");
    ForeignReader::of(path)
}

/// The parent against helpers that hang, crash, talk nonsense, or do not exist.
#[cfg(unix)]
#[test]
fn whatever_a_helper_does_it_is_one_refused_file() {
    let folder = tempfile::tempdir().expect("folder");
    let path = save(fluoroscopy(), &folder.path().join("x.dcm"));
    let quick = Limits { wall_s: 0.5, ..Limits::of(Kind::Frames) };
    let fault = |reader: ForeignReader| match through(&reader.with_limits(quick.clone()), &path) {
        Err(Fault::Helper(fault)) => fault,
        other => panic!("{other:?}"),
    };
    let pid = folder.path().join("pid");
    let hangs = format!("echo $$ > {}; exec sleep 600", pid.display());
    assert_eq!(fault(script(folder.path(), "hangs", &hangs)), ForeignFault::Time { limit_s: 0.5 });
    // One that was killed before it wrote its number is gone as well.
    let number = || std::fs::read_to_string(&pid).ok().and_then(|text| rustix::process::Pid::from_raw(text.trim().parse().ok()?));
    let gone = || number().is_none_or(|pid| rustix::process::test_kill_process(pid).is_err()).then_some(());
    assert!(eventually(HANG_S, gone).is_some(), "a helper that hangs is killed");
    assert_eq!(fault(script(folder.path(), "dies", "kill -SEGV $$")), ForeignFault::Crashed);
    assert_eq!(fault(script(folder.path(), "busy", "kill -XCPU $$")), ForeignFault::Time { limit_s: 15.0 });
    assert_eq!(
        fault(script(folder.path(), "deep", "echo thread has overflowed its stack >&2; kill -ABRT $$")),
        ForeignFault::TooDeep
    );
    let big = fault(script(folder.path(), "big", "echo memory allocation of 9 bytes failed >&2; kill -ABRT $$"));
    assert!(matches!(big, ForeignFault::Memory { .. }), "{big:?}");
    assert!(matches!(fault(script(folder.path(), "talks", "echo hello world")), ForeignFault::Answer { .. }));
    assert!(matches!(fault(ForeignReader::of(folder.path().join("none"))), ForeignFault::Start { .. }));
    assert_eq!(through(&helper(), &path).expect("control: the file is good").len(), 1);
}

/// The processes of `parent`'s that read foreign files, or wait for one.
#[cfg(target_os = "linux")]
pub fn readers(parent: u32) -> Vec<rustix::process::Pid> {
    let found = std::fs::read_dir("/proc").into_iter().flatten().flatten().filter_map(|entry| {
        let pid = entry.file_name().to_str()?.parse().ok()?;
        let words = std::fs::read(entry.path().join("cmdline")).ok()?;
        let stat = std::fs::read_to_string(entry.path().join("stat")).ok()?;
        // Behind the name in parentheses: state, then the parent.
        let of: u32 = stat.rsplit_once(") ")?.1.split(' ').nth(1)?.parse().ok()?;
        (of == parent && words.split(|byte| *byte == 0).nth(1)? == b"read-foreign")
            .then(|| rustix::process::Pid::from_raw(pid))?
    });
    found.collect()
}

/// A helper that stands ready reads what a fresh one reads; one that was killed meanwhile is replaced; none is left behind.
#[cfg(target_os = "linux")]
#[test]
fn a_helper_that_stands_ready_is_as_good_as_a_fresh_one() {
    use rustix::process::{Signal, kill_process, test_kill_process};
    let folder = tempfile::tempdir().expect("folder");
    let path = save(fluoroscopy(), &folder.path().join("x.dcm"));
    let fresh = through(&helper(), &path).expect("readable");
    let (before, reader) = (readers(std::process::id()), helper().with_reserve());
    // Other tests of this process have their own.
    let waiting = |reader: &ForeignReader| reader.waiting().and_then(|pid| rustix::process::Pid::from_raw(pid as i32));
    let first = waiting(&reader).expect("it stands ready");
    let begun = || readers(std::process::id()).contains(&first).then_some(());
    assert!(!before.contains(&first) && eventually(HANG_S, begun).is_some());
    for _ in 0..3 {
        assert_eq!(through(&reader, &path).expect("readable"), fresh, "bit for bit, tags and notes included");
    }
    assert_eq!(waiting(&reader), Some(first), "one reads them all");
    kill_process(first, Signal::KILL).expect("it is there");
    let stat = format!("/proc/{}/stat", first.as_raw_nonzero());
    let dead = || std::fs::read_to_string(&stat).is_ok_and(|stat| stat.contains(") Z")).then_some(());
    assert!(eventually(HANG_S, dead).is_some(), "it was killed");
    assert_eq!(through(&reader, &path).expect("readable"), fresh, "by another");
    // One that ends while it reads a file is no fault of that file, unless a fresh one ends as well.
    let used = waiting(&reader).expect("another stands ready");
    let long = folder.path().join("long.tif");
    std::fs::write(&long, tiff_pages(16, 4000, 4000, 16_000_000)).expect("written");
    let pages = std::thread::scope(|scope| {
        let reading = scope.spawn(|| through(&reader, &long).map(|pages| pages.len()));
        assert!(eventually(HANG_S, || waiting(&reader).is_none().then_some(())).is_some(), "it is taken");
        kill_process(used, Signal::KILL).expect("it is there");
        reading.join().expect("no panic")
    });
    assert_eq!(pages, Ok(16));
    let last = waiting(&reader).expect("another stands ready");
    assert_ne!(last, used);
    let copy = reader.clone();
    drop(reader);
    assert_eq!(waiting(&copy), Some(last));
    drop(copy);
    assert!(test_kill_process(last).is_err(), "it ended with whom it served");
    // Files that break a helper break the ready one alike.
    let broken =
        script(folder.path(), "breaks", "head -c 8 > /dev/null; echo thread has overflowed its stack >&2; kill -ABRT $$")
            .with_reserve();
    assert_eq!(through(&broken, &path), Err(Fault::Helper(ForeignFault::TooDeep)));
}

/// A classic TIFF of `pages` pages that all show the same strip of `strip_bytes` zeros.
pub fn tiff_pages(pages: u32, width: u32, height: u32, strip_bytes: u32) -> Vec<u8> {
    let mut bytes = b"II*\0".to_vec();
    bytes.extend((8 + strip_bytes).to_le_bytes());
    bytes.resize(8 + strip_bytes as usize, 0);
    for page in 0..pages {
        let entries: [(u16, u16, u32); 8] = [
            (256, 4, width),
            (257, 4, height),
            (258, 3, 8),
            (259, 3, 1),
            (262, 3, 1),
            (273, 4, 8),
            (278, 4, height),
            (279, 4, strip_bytes),
        ];
        let behind = (bytes.len() + tiff_directory(&entries, 0).len()) as u32;
        bytes.extend(tiff_directory(&entries, if page + 1 < pages { behind } else { 0 }));
    }
    bytes
}

/// A directory of a classic TIFF: entries `(tag, type, value)` of one value each, and where the next directory is.
pub fn tiff_directory(entries: &[(u16, u16, u32)], next: u32) -> Vec<u8> {
    let mut bytes = (entries.len() as u16).to_le_bytes().to_vec();
    for (tag, kind, value) in entries {
        bytes.extend(tag.to_le_bytes());
        bytes.extend(kind.to_le_bytes());
        bytes.extend(1u32.to_le_bytes());
        bytes.extend(value.to_le_bytes());
    }
    bytes.extend(next.to_le_bytes());
    bytes
}

/// A PNG header of this size and nothing that fills it.
pub fn png_of_size(width: u32, height: u32) -> Vec<u8> {
    let mut bytes = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR".to_vec();
    bytes.extend(width.to_be_bytes());
    bytes.extend(height.to_be_bytes());
    bytes.extend([1, 0, 0, 0, 0, 0, 0, 0, 0]);
    bytes.extend(b"\0\0\0\0IEND\xae\x42\x60\x82");
    bytes
}

/// A PNG of 64 x 48 grey pixels in 64 kB that inflate to 64 MiB. They begin with a filter that no PNG has: whoever stops at the 3 kB that
/// are declared refuses it as well.
fn png_that_inflates() -> Vec<u8> {
    let mut packer = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::best());
    packer.write_all(&vec![0xff_u8; 64 << 20]).expect("packs");
    let packed = packer.finish().expect("packs");
    assert!(packed.len() < 1 << 18, "64 MiB in {} bytes", packed.len());
    let mut bytes = b"\x89PNG\r\n\x1a\n".to_vec();
    let header = [0u8, 0, 0, 64, 0, 0, 0, 48, 8, 0, 0, 0, 0];
    for (kind, content) in [(b"IHDR", &header[..]), (b"IDAT", &packed[..]), (b"IEND", &b""[..])] {
        let summed = [&kind[..], content].concat();
        bytes.extend((content.len() as u32).to_be_bytes());
        bytes.extend(&summed);
        bytes.extend(crc32fast::hash(&summed).to_be_bytes());
    }
    bytes
}

/// The made frame's file up to its pixel data, then `rest`.
pub fn dicom_ending_in(folder: &Path, transfer_syntax: Option<&str>, rest: &[u8]) -> Vec<u8> {
    let path = folder.join("start.dcm");
    let mut object = fluoroscopy();
    object.remove_element(tags::PIXEL_DATA);
    let syntax = transfer_syntax.unwrap_or(dicom_dictionary_std::uids::EXPLICIT_VR_LITTLE_ENDIAN);
    let meta = dicom_object::FileMetaTableBuilder::new()
        .transfer_syntax(syntax)
        .media_storage_sop_class_uid("1.2.840.10008.5.1.4.1.1.12.1")
        .media_storage_sop_instance_uid("2.25.1");
    object.with_meta(meta).expect("meta").write_to_file(&path).expect("written");
    let mut bytes = std::fs::read(path).expect("bytes");
    bytes.extend(rest);
    bytes
}

pub fn nested(depth: usize) -> Vec<u8> {
    let mut bytes = Vec::new();
    for _ in 0..depth {
        // (0040,A730) of undefined length, and an item of undefined length.
        bytes
            .extend([0x40, 0, 0x30, 0xa7, b'S', b'Q', 0, 0, 0xff, 0xff, 0xff, 0xff, 0xfe, 0xff, 0, 0xe0, 0xff, 0xff, 0xff, 0xff]);
    }
    bytes
}

/// Compressed pixels in one fragment of an even size.
fn compressed(fragment: &[u8]) -> Vec<u8> {
    let mut bytes = vec![0xe0, 0x7f, 0x10, 0, b'O', b'B', 0, 0, 0xff, 0xff, 0xff, 0xff, 0xfe, 0xff, 0, 0xe0, 0, 0, 0, 0];
    bytes.extend([0xfe, 0xff, 0, 0xe0]);
    bytes.extend((fragment.len() as u32).to_le_bytes());
    bytes.extend(fragment);
    bytes.extend([0xfe, 0xff, 0xdd, 0xe0, 0, 0, 0, 0]);
    bytes
}

fn run_length(planes: u8) -> Vec<u8> {
    let mut fragment = [0u8; 80];
    (fragment[0], fragment[4], fragment[8]) = (planes, 64, 70);
    compressed(&fragment)
}

/// A JPEG of the made frame's size that begins and ends as it should, with nothing in between that a decoder could decode.
fn jpeg_without_a_scan() -> Vec<u8> {
    compressed(&[0xff, 0xd8, 0xff, 0xc0, 0, 11, 8, 0, 2, 0, 4, 1, 1, 0x11, 0, 0xff, 0xd9, 0])
}

/// Beads for the commands that want some.
pub fn write_beads(folder: &Path) {
    let markups = r#"{"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "controlPoints": [
        {"label": "b1", "position": [0, 0, 0]}, {"label": "b2", "position": [9, 0, 0]}, {"label": "b3", "position": [0, 9, 0]},
        {"label": "b4", "position": [0, 0, 9]}, {"label": "b5", "position": [9, 9, 0]}, {"label": "b6", "position": [9, 0, 9]}]}]}"#;
    std::fs::write(folder.join("beads.mrk.json"), markups).expect("written");
}

/// Panics in decoders, a stack overflow by nesting, gigabytes from small files: each ended the program.
#[test]
fn made_bombs_are_refused_with_their_reason() {
    let folder = tempfile::tempdir().expect("folder");
    let (rle, jpeg) = (Some("1.2.840.10008.1.2.5"), Some(dicom_dictionary_std::uids::JPEG_BASELINE8_BIT));
    let mut endless_element = vec![0xe1, 0x7f, 0x10, 0, b'O', b'B', 0, 0];
    endless_element.extend(0xffff_fffeu32.to_le_bytes());
    let cases: [(&str, Vec<u8>, &str); 9] = [
        ("pages.tif", tiff_pages(100, 4000, 4000, 4), "pixels, at most"),
        ("many.tif", tiff_pages(5000, 1, 4, 4), "images, at most"),
        ("wide.tif", tiff_pages(1, 100_000, 100_000, 4), "larger than the limit"),
        ("wide.png", png_of_size(60_000, 60_000), "larger than the limit"),
        ("inflates.png", png_that_inflates(), "its compressed pixels do not decode"),
        ("nested.dcm", dicom_ending_in(folder.path(), None, &nested(20_000)), "nested too deeply"),
        ("planes.dcm", dicom_ending_in(folder.path(), rle, &run_length(200)), "200 run-length planes"),
        ("scan.dcm", dicom_ending_in(folder.path(), jpeg, &jpeg_without_a_scan()), "damaged or cut short (in its pixel data)"),
        ("element.dcm", dicom_ending_in(folder.path(), None, &endless_element), ""),
    ];
    let (ready, good) = (helper().with_reserve(), save(fluoroscopy(), &folder.path().join("good.dcm")));
    write_beads(folder.path());
    let register = |name: &str| sidecarm(folder.path(), &["register", name, "--beads", "beads.mrk.json", "--out", "pose.json"]);
    let mut refused = 0;
    for (name, bytes, words) in cases {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).expect("written");
        assert_eq!(through(&ready, &path), through(&helper(), &path), "{name}: by one that stands ready");
        assert_eq!(through(&ready, &good), through(&helper(), &good), "{name} leaves nothing behind");
        let fault = through(&helper(), &path).map(|frames| frames.len()).expect_err(name);
        assert!(!matches!(fault, Fault::Helper(ForeignFault::Time { .. })), "{name} is seen before its time is over");
        let fault = fault.to_string();
        println!("{name}: {fault}");
        assert!(fault.contains(words) && !fault.contains('\n'), "{name}: {fault}");
        // Whoever looks into the file says so, and whoever wants a pose of it.
        for said in [sidecarm(folder.path(), &["info", name]), register(name)] {
            assert_one_sentence(name, &said, words);
            let stderr = String::from_utf8_lossy(&said.stderr);
            assert!(stderr.contains(&fault), "{name}: what the helper found, '{fault}', in {stderr}");
        }
        refused += 1;
    }
    assert_eq!(refused, 9);
    let pose = folder.path().join("pose.json");
    assert!(!pose.exists(), "no pose is written of what cannot be read");
    std::fs::write(folder.path().join("fine.dcm"), frame_bytes(10)).expect("written");
    let said = register("fine.dcm");
    assert!(pose.exists(), "control: of what can be read, refused as it is: {}", String::from_utf8_lossy(&said.stderr));
}

/// The helper's own limits: memory and processor time.
#[cfg(target_os = "linux")]
#[test]
fn memory_and_time_of_a_helper_are_limited() {
    let folder = tempfile::tempdir().expect("folder");
    let path = folder.path().join("x.png");
    image::GrayImage::new(7000, 7000).save(&path).expect("png");
    let with = |path: &Path, memory_bytes, cpu_s| {
        let limits = Limits { memory_bytes, cpu_s, ..Limits::of(Kind::Frames) };
        through(&helper().with_limits(limits), path).map(|frames| frames.len())
    };
    let usual = Limits::of(Kind::Frames);
    assert_eq!(with(&path, usual.memory_bytes, usual.cpu_s), Ok(1), "control: the usual limits suffice");
    // One strip: the file and its pixels are in memory at once, 64 MB each.
    let large = folder.path().join("large.tif");
    std::fs::write(&large, tiff_pages(1, 8000, 8000, 64_000_000)).expect("written");
    let fault = with(&large, 150 << 20, usual.cpu_s).expect_err("too large for 150 MiB");
    assert!(fault.to_string().contains("memory"), "{fault}");
    assert_eq!(with(&large, usual.memory_bytes, usual.cpu_s), Ok(1), "control: it is the memory");
    let ready = helper().with_limits(Limits { memory_bytes: 150 << 20, ..usual.clone() }).with_reserve();
    let small = save(fluoroscopy(), &folder.path().join("small.dcm"));
    for _ in 0..2 {
        assert!(through(&ready, &small).is_ok(), "control: it fits");
        let fault = through(&ready, &large).expect_err("too large for 150 MiB, whatever was read before");
        assert!(fault.to_string().contains("memory"), "{fault}");
    }
    // Sixteen times the same 4000 x 4000 pixels: within all sizes, but not within a moment.
    let long = folder.path().join("x.tif");
    std::fs::write(&long, tiff_pages(16, 4000, 4000, 16_000_000)).expect("written");
    let hasty = Limits { wall_s: 0.02, ..usual.clone() };
    let hurried = through(&helper().with_limits(hasty), &long).map(|frames| frames.len());
    assert_eq!(hurried, Err(Fault::Helper(ForeignFault::Time { limit_s: 0.02 })));
    assert_eq!(with(&long, usual.memory_bytes, usual.cpu_s), Ok(16), "control: it is the time");
}

#[test]
fn the_bad_files_are_one_sentence_each() {
    let shared = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/bad-files");
    let Ok(list) = std::fs::read_dir(&shared) else {
        println!("skipped: {} is absent", shared.display());
        return;
    };
    let mut refused = 0;
    let frames = list.flatten().map(|entry| entry.path()).filter(|path| path.extension().is_some_and(|ending| ending != "mcap"));
    for path in frames.collect::<std::collections::BTreeSet<PathBuf>>() {
        let output = sidecarm(&shared, &["info", path.to_str().expect("text")]);
        println!("{}", String::from_utf8_lossy(&output.stderr).trim());
        assert_one_sentence(&path.display().to_string(), &output, "");
        refused += 1;
    }
    assert!(refused >= 8, "{refused}");
}

pub fn scene_of(object: serde_json::Value) -> String {
    json!({
        "objects": [object],
        "view": {"size_px": [8, 8], "intrinsics": [[500, 0, 3.5], [0, 500, 3.5], [0, 0, 1]],
                 "camera_from_lps": [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 600], [0, 0, 0, 1]]},
        "beam": {"tube_kvp": 80, "filtration_mm": {"aluminium": 3}, "photons_per_pixel": 1e5},
        "detector": {"response": "energy", "pitch_mm": 2.0}
    })
    .to_string()
}

#[test]
fn hostile_volumes_and_meshes_are_refused_by_render_and_info() {
    let folder = tempfile::tempdir().expect("folder");
    let write = |name: &str, file: &NiftiFile| file.write(&folder.path().join(name));
    let mut huge = NiftiFile::int16([4, 4, 4], &[0; 64]);
    huge.dim = [3, 1290, 1290, 1290, 1, 1, 1, 1];
    write("huge.nii.gz", &huge);
    let mut types = NiftiFile::int16([4, 4, 4], &[0; 64]).bytes();
    types[72..74].copy_from_slice(&8i16.to_le_bytes());
    std::fs::write(folder.path().join("types.nii"), types).expect("written");
    let mut trailing = NiftiFile::int16([4, 4, 4], &[0; 64]);
    trailing.voxels.resize(4 << 20, 0);
    write("trailing.nii.gz", &trailing);
    let mut cut = vec![0u8; 80];
    cut.extend(5u32.to_le_bytes());
    cut.resize(200, 0);
    std::fs::write(folder.path().join("cut.stl"), cut).expect("written");
    let mut lying = vec![0u8; 80];
    lying.extend(u32::MAX.to_le_bytes());
    std::fs::write(folder.path().join("lying.stl"), lying).expect("written");
    let mut cases = 0;
    for (name, words) in [
        ("huge.nii.gz", "1290 x 1290 x 1290 voxels"),
        ("types.nii", "16 bits by one field"),
        ("trailing.nii.gz", "bytes follow"),
        ("cut.stl", "cut.stl: "),
        ("lying.stl", "lying.stl: "),
    ] {
        let object = if name.ends_with("stl") {
            json!({"mesh": {"path": name, "material": "titanium", "lps_from_mesh": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}})
        } else {
            json!({"ct": {"path": name}})
        };
        std::fs::write(folder.path().join("scene.json"), scene_of(object)).expect("written");
        let output = sidecarm(folder.path(), &["render", "scene.json", "--out", "drr.tif", "--device", "cpu"]);
        assert_one_sentence(name, &output, words);
        assert_one_sentence(name, &sidecarm(folder.path(), &["info", name]), words);
        cases += 1;
    }
    assert_eq!(cases, 5);
}
