//! The same volume in NIfTI, NRRD, MetaImage and as a DICOM series: the same voxels at the same places, the same image.

use std::path::{Path, PathBuf};
use std::process::Command;

use dicom_core::VR;
use dicom_dictionary_std::tags;
use glam::{DAffine3, DVec3};
use serde_json::json;
use sidecarm::image::read_tiff_f32;
use sidecarm::reporter::Reporter;
use sidecarm::scene::{VolumeFile, VolumeSource, read_volume, read_volume_facts};

use crate::volume_files::{Sample, affine, gzip, put, save_series, write, zlib};

const LPS: [f64; 3] = [1.0, 1.0, 1.0];

/// Two turns by 3-4-5 triangles, one after the other: oblique to every axis, and exact with these spacings.
fn oblique() -> DAffine3 {
    let turn_z = [DVec3::new(0.6, 0.8, 0.0), DVec3::new(-0.8, 0.6, 0.0), DVec3::Z];
    let turn_x = |v: DVec3| DVec3::new(v.x, 0.6 * v.y - 0.8 * v.z, 0.8 * v.y + 0.6 * v.z);
    affine(turn_z.map(turn_x), [6.25, 3.125, 6.25], DVec3::new(-5.0, -2.25, 980.5))
}

fn straight() -> DAffine3 {
    affine([DVec3::X, DVec3::Y, DVec3::Z], [2.0, 2.5, 5.0], DVec3::new(-6.0, -7.0, 990.0))
}

/// A coronal one: rows run to the right, slices from the front to the back. Right-handed, as every series of slices is.
fn coronal() -> DAffine3 {
    affine([DVec3::NEG_X, DVec3::NEG_Z, DVec3::NEG_Y], [2.0, 2.5, 5.0], DVec3::new(6.0, 10.0, 1007.0))
}

/// Every way to write `sample`, in a folder of its own: what it is called, and where it is.
fn written(sample: &Sample, folder: &Path) -> Vec<(&'static str, PathBuf)> {
    let at = |name: &str| folder.join(name);
    let mut all = Vec::new();
    sample.nifti(&at("ct.nii.gz"));
    all.push(("NIfTI", at("ct.nii.gz")));
    let header = |space: &str, signs, more: &str| sample.nrrd_header(space, signs, more).into_bytes();
    write(&at("raw.nrrd"), &[&header("LPS", LPS, "endian: little\nencoding: raw\n\n"), &sample.little()]);
    all.push(("NRRD, raw, LPS", at("raw.nrrd")));
    let ras = header("right-anterior-superior", [-1.0, -1.0, 1.0], "endian: big\nencoding: gzip\n\n");
    write(&at("zipped.nrrd"), &[&ras, &gzip(&sample.big())]);
    all.push(("NRRD, gzip, big-endian, RAS", at("zipped.nrrd")));
    let text: Vec<String> = sample.hu.iter().map(i16::to_string).collect();
    let las = header("left-anterior-superior", [1.0, -1.0, 1.0], "encoding: ascii\n\n");
    write(&at("text.nrrd"), &[&las, text.join("\n").as_bytes()]);
    all.push(("NRRD, text, LAS", at("text.nrrd")));
    let beside = "endian: little\nencoding: raw\nline skip: 2\nbyte skip: 5\ndata file: beside.raw\n";
    write(&at("beside.nhdr"), &[&header("left-posterior-superior", LPS, beside)]);
    write(&at("beside.raw"), &[b"two\nlines\nbytes", &sample.little()]);
    all.push(("NRRD, voxels beside it after lines and bytes", at("beside.nhdr")));
    let at_end = header("LPS", LPS, "endian: little\nencoding: raw\nbyteskip: -1\ndatafile: ./at-end.img\n");
    write(&at("at-end.nhdr"), &[&at_end]);
    write(&at("at-end.img"), &[b"anything before", &sample.little()]);
    all.push(("NRRD, voxels at the end of a file", at("at-end.nhdr")));
    let meta = |more: &str, last: &str| format!("{}{last}\n", sample.metaimage_header(more)).into_bytes();
    write(&at("local.mha"), &[&meta("BinaryDataByteOrderMSB = False\n", "ElementDataFile = LOCAL"), &sample.little()]);
    all.push(("MetaImage", at("local.mha")));
    let zipped = zlib(&sample.big());
    let more = format!("BinaryDataByteOrderMSB = True\nCompressedData = True\nCompressedDataSize = {}\n", zipped.len());
    write(&at("zipped.mhd"), &[&meta(&more, "ElementDataFile = zipped.zraw")]);
    write(&at("zipped.zraw"), &[&zipped]);
    all.push(("MetaImage, compressed, big-endian, beside it", at("zipped.mhd")));
    write(&at("skip.mhd"), &[&meta("HeaderSize = 3\n", "ElementDataFile = skip.raw")]);
    write(&at("skip.raw"), &[b"abc", &sample.little()]);
    all.push(("MetaImage, raw, after a header of its own", at("skip.mhd")));
    all
}

/// [`written`], and the series, as its folder and as one of its slices.
fn written_with_series(sample: &Sample, folder: &Path) -> Vec<(&'static str, PathBuf)> {
    let mut all = written(sample, folder);
    let slices = save_series(&sample.slices(), &folder.join("series"));
    all.push(("a DICOM series by its folder", folder.join("series")));
    all.push(("a DICOM series by a slice", slices[3].clone()));
    all
}

fn read(path: &Path) -> VolumeFile {
    read_volume(path, &Reporter::silent()).unwrap_or_else(|error| panic!("{error}"))
}

#[test]
fn every_format_gives_the_same_voxels_at_the_same_places() {
    let mut cases = 0;
    for lps_from_voxel in [straight(), coronal(), oblique()] {
        let (folder, sample) = (tempfile::tempdir().expect("a folder"), Sample::block(lps_from_voxel));
        let hu: Vec<f32> = sample.hu.iter().map(|hu| f32::from(*hu)).collect();
        for (what, path) in written_with_series(&sample, folder.path()) {
            let volume = read(&path);
            assert_eq!(volume.size, sample.size, "{what}");
            assert_eq!(volume.lps_from_voxel, lps_from_voxel, "{what}: bit for bit");
            assert_eq!(volume.values, hu, "{what}");
            cases += 1;
        }
    }
    assert_eq!(cases, 33);
}

/// Slices have no handedness but their own: a left-handed volume comes with its slices in the other order, the others as it is.
#[test]
fn a_left_handed_volume_keeps_its_place() {
    let (folder, sample) = (tempfile::tempdir().expect("a folder"), Sample::block(oblique()).turned_round());
    assert!(sample.lps_from_voxel.matrix3.determinant() < 0.0);
    let mut cases = 0;
    for (what, path) in written(&sample, folder.path()) {
        let volume = read(&path);
        assert_eq!(volume.lps_from_voxel, sample.lps_from_voxel, "{what}");
        cases += 1;
    }
    assert_eq!(cases, 9);
    save_series(&sample.slices(), &folder.path().join("series"));
    let (volume, turned) = (read(&folder.path().join("series")), sample.turned_round());
    assert_eq!(volume.lps_from_voxel, turned.lps_from_voxel);
    assert_eq!(volume.values, turned.hu.iter().map(|hu| f32::from(*hu)).collect::<Vec<_>>());
}

fn scene(path: &Path) -> String {
    json!({
        "objects": [{"ct": {"path": path}}],
        "view": {"size_px": [24, 20], "intrinsics": [[1000, 0, 11.5], [0, 1000, 9.5], [0, 0, 1]],
                 "camera_from_lps": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]},
        "beam": {"mono_kev": 50, "photons_per_pixel": 1e5},
        "detector": {"pitch_mm": 2.0}
    })
    .to_string()
}

/// Rendered by the program, whose helper reads the volume.
fn rendered(path: &Path, folder: &Path) -> Vec<f32> {
    std::fs::write(folder.join("scene.json"), scene(path)).expect("written");
    let args = ["render", "scene.json", "--out", "drr.tif", "--device", "cpu", "--quantity", "line_integral"];
    let output = Command::new(env!("CARGO_BIN_EXE_sidecarm")).args(args).current_dir(folder).output().expect("starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    read_tiff_f32(&folder.join("drr.tif")).expect("an image").remove(0).pixels
}

#[test]
fn every_format_renders_to_the_same_image() {
    let (folder, sample) = (tempfile::tempdir().expect("a folder"), Sample::block(oblique()));
    let all = written_with_series(&sample, folder.path());
    let expected = rendered(&all[0].1, folder.path());
    assert!(expected.iter().any(|value| *value > 0.3), "there is something to see");
    let mut cases = 0;
    for (what, path) in &all[1..] {
        assert!(rendered(path, folder.path()) == expected, "{what}: bit-identical");
        cases += 1;
    }
    assert_eq!(cases, 10);
    // The control: a twentieth of a voxel to the side is another image.
    let mut moved = sample.clone();
    moved.lps_from_voxel.translation.x += 0.125;
    moved.nifti(&folder.path().join("moved.nii"));
    assert_ne!(rendered(&folder.path().join("moved.nii"), folder.path()), expected);
    // The same matter counted from the other end differs by rounding alone.
    sample.turned_round().nifti(&folder.path().join("turned.nii"));
    let turned = rendered(&folder.path().join("turned.nii"), folder.path());
    let apart = turned.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(apart < 1e-4, "{apart}");
}

/// The hash of a series does not hang on names, and every file of a volume counts.
#[test]
fn content_is_every_file_and_no_name() {
    let folder = tempfile::tempdir().expect("a folder");
    let sample = Sample::block(oblique());
    let hash = |path: &Path| VolumeSource::open(path).and_then(|source| source.content()).expect("readable");
    let files = save_series(&sample.slices(), &folder.path().join("a"));
    let whole = hash(&folder.path().join("a"));
    assert_eq!(whole.parts.len(), 5);
    assert!(whole.parts.is_sorted_by_key(|part| &part.sha256));
    assert_eq!(hash(&files[2]), whole, "by a slice");
    let other = folder.path().join("b");
    std::fs::create_dir(&other).expect("a folder");
    for (index, file) in files.iter().enumerate() {
        std::fs::copy(file, other.join(format!("{index}"))).expect("copied");
    }
    assert_eq!(hash(&other).sha256, whole.sha256, "other names");
    let mut changed = sample.slices();
    put(&mut changed[1], tags::RESCALE_SLOPE, VR::DS, "2");
    save_series(&changed, &folder.path().join("c"));
    assert_ne!(hash(&folder.path().join("c")).sha256, whole.sha256);

    let headers = written(&sample, folder.path());
    let before: Vec<_> = headers.iter().map(|(_, path)| hash(path)).collect();
    let beside = headers.iter().position(|(what, _)| what.contains("after lines")).expect("there");
    assert_eq!(before[beside].parts.len(), 2);
    let mut bytes = std::fs::read(folder.path().join("beside.raw")).expect("bytes");
    *bytes.last_mut().expect("a byte") ^= 1;
    std::fs::write(folder.path().join("beside.raw"), bytes).expect("written");
    assert_ne!(hash(&headers[beside].1).sha256, before[beside].sha256, "the voxels are a part of it");
    assert!(before[1].parts.is_empty() && before[1].sha256 == sidecarm::image::sha256_file(&headers[1].1).expect("hash"));
}

#[test]
fn facts_name_the_format_and_what_placed_it() {
    let (folder, sample) = (tempfile::tempdir().expect("a folder"), Sample::block(straight()));
    let mut seen = std::collections::BTreeSet::new();
    for (what, path) in written_with_series(&sample, folder.path()) {
        let facts = read_volume_facts(&path).expect("readable");
        assert!(what.contains(facts.format.words()), "{what}: {:?}", facts.format);
        assert_eq!(facts.range, Some([-1000.0, 900.0 + (4 + 7 * 3 + 42 * 3) as f32]), "{what}");
        seen.insert(facts.placed_by.words());
    }
    assert_eq!(seen.len(), 4, "{seen:?}");
}

#[test]
fn labels_of_slicer_and_every_type_of_number_are_read() {
    let (folder, sample) = (tempfile::tempdir().expect("a folder"), Sample::block(straight()));
    let path = folder.path().join("seg.seg.nrrd");
    let segments = "encoding: raw\nendian: little\nSegment0_LabelValue:=7\nSegment0_Name:=hip left\nSegment1_Name:=none\n\n";
    write(&path, &[sample.nrrd_header("LPS", LPS, segments).as_bytes(), &sample.little()]);
    assert_eq!(read(&path).label_names, [(7, "hip left".to_owned())]);
    let cases: [(&str, &str, Vec<u8>, f32); 10] = [
        ("int8", "MET_CHAR", vec![200], -56.0),
        ("uchar", "MET_UCHAR", vec![200], 200.0),
        ("short", "MET_SHORT", (-500i16).to_be_bytes().to_vec(), -500.0),
        ("uint16", "MET_USHORT", 65000u16.to_be_bytes().to_vec(), 65000.0),
        ("int", "MET_INT", (-70000i32).to_be_bytes().to_vec(), -70000.0),
        ("unsigned int", "MET_ULONG", 70000u32.to_be_bytes().to_vec(), 70000.0),
        ("longlong", "MET_LONG_LONG", (-70000i64).to_be_bytes().to_vec(), -70000.0),
        ("uint64", "MET_ULONG_LONG", 70000u64.to_be_bytes().to_vec(), 70000.0),
        ("float", "MET_FLOAT", 0.5f32.to_be_bytes().to_vec(), 0.5),
        ("double", "MET_DOUBLE", (-0.25f64).to_be_bytes().to_vec(), -0.25),
    ];
    for (nrrd, meta, bytes, value) in &cases {
        let voxels = bytes.repeat(7 * 6 * 5);
        let header = sample.nrrd_header("LPS", LPS, "endian: big\nencoding: raw\n\n").replace("short", nrrd);
        write(&path, &[header.as_bytes(), &voxels]);
        assert!(read(&path).values.iter().all(|found| found == value), "{nrrd}");
        let header = sample.metaimage_header("ElementByteOrderMSB = True\n").replace("MET_SHORT", meta);
        let path = folder.path().join("a.mha");
        write(&path, &[header.as_bytes(), b"ElementDataFile = LOCAL\n", &voxels]);
        assert!(read(&path).values.iter().all(|found| found == value), "{meta}");
    }
}

/// Files that ITK, GDCM and pynrrd wrote (`tests/data/volumes/README.md`), whose conventions nobody here has chosen.
#[test]
fn what_other_tools_write_lies_where_they_say() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/volumes");
    let turn = glam::DMat3::from_rotation_z(0.3) * glam::DMat3::from_rotation_x(-0.5);
    let spacing = DVec3::new(0.7, 0.8, 2.5);
    let expected =
        DAffine3 { matrix3: turn * glam::DMat3::from_diagonal(spacing), translation: DVec3::new(-12.5, 33.25, -700.125) };
    let hu: Vec<f32> = (0..60).map(|n| (n % 5 + n / 5 % 4 * 10 + n / 20 * 100 - 200) as f32).collect();
    let mut cases = 0;
    for name in ["itk.mha", "itk.nrrd", "pynrrd.nhdr", "gdcm"] {
        let volume = read(&folder.join(name));
        assert_eq!((volume.size, &volume.values), ([5, 4, 3], &hu), "{name}");
        let corner = DVec3::new(4.0, 3.0, 2.0);
        for at in [DVec3::ZERO, DVec3::X, DVec3::Y, DVec3::Z, corner] {
            let apart_mm = volume.lps_from_voxel.transform_point3(at).distance(expected.transform_point3(at));
            assert!(apart_mm < 2e-6, "{name}: {at} is {apart_mm} mm from its place");
        }
        cases += 1;
    }
    assert_eq!(cases, 4);
}
