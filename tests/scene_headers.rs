//! NRRD and MetaImage files that are damaged, lie, or do not say what they must: each is one sentence with what to do.

use std::path::Path;
use std::process::Command;

use glam::DVec3;
use sidecarm::reporter::Reporter;
use sidecarm::scene::{VolumeFile, read_volume};

use crate::volume_files::{Sample, affine, gzip, write, zlib};

const LPS: [f64; 3] = [1.0, 1.0, 1.0];
const END: &str = "endian: little\nencoding: raw\n\n";

fn sample() -> Sample {
    Sample::block(affine([DVec3::X, DVec3::Y, DVec3::Z], [2.0, 2.5, 5.0], DVec3::new(1.0, 2.0, 3.0)))
}

fn nrrd(more: &str) -> String {
    sample().nrrd_header("LPS", LPS, more)
}

fn local(header: &str) -> String {
    format!("{header}ElementDataFile = LOCAL\n")
}

fn read(path: &Path) -> Result<VolumeFile, String> {
    read_volume(path, &Reporter::silent()).map_err(|error| error.to_string())
}

/// What is said of a file of this header and these voxels: one sentence that begins with the file and holds nothing of its texts.
fn refused(name: &str, header: &str, voxels: &[u8]) -> String {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join(name);
    write(&path, &[header.as_bytes(), voxels]);
    let error = read(&path).expect_err(header);
    assert!(error.starts_with(&path.display().to_string()) && !error.contains('\n'), "{error}");
    assert!(!error.contains("Quaxwelk"), "{error}");
    error
}

#[test]
fn nrrd_that_cannot_be_used_is_one_sentence() {
    let good = nrrd(END);
    let voxels = sample().little();
    let change = |from: &str, to: &str| {
        assert!(good.contains(from), "{from}");
        good.replace(from, to)
    };
    let zipped = gzip(&voxels);
    let cases: [(String, &[u8], &str); 38] = [
        (good.clone(), &voxels[..voxels.len() - 1], "cut short"),
        (change("space: LPS\n", ""), &voxels, "'space', so that left and right are not known"),
        (change("LPS", "scanner-xyz"), &voxels, "'scanner-xyz', expected left-posterior-superior"),
        (change("LPS", "RAST"), &voxels, "'RAST'"),
        (change("space directions", "spacings"), &voxels, "'space directions'"),
        (change("space origin", "labels"), &voxels, "'space origin'"),
        (change("(1,2,3)", "(1,2)"), &voxels, "'space origin' of its header is '(1,2)', expected vectors"),
        (change("(2,0,0)", "none"), &voxels, "2 axes in space"),
        (change("(2,0,0)", "(0,0,5)"), &voxels, "singular"),
        (change("(2,0,0)", "(nan,0,0)"), &voxels, "not finite"),
        (change("type: short", "type: block"), &voxels, "'block', expected integers"),
        (change("type: short\n", ""), &voxels, "does not have 'type'"),
        (change("endian: little\n", ""), &voxels, "'endian'"),
        (change("raw", "bzip2"), &voxels, "encoded as 'bzip2', expected raw, gzip or text"),
        (change("raw", "Quaxwelk^Annegrund 1952"), &voxels, "encoded as something else"),
        (change("dimension: 3", "dimension: 4"), &voxels, "'sizes' of its header is '7 6 5', expected 4 numbers"),
        (change("dimension: 3", "dimension: 99"), &voxels, "99 axes"),
        (change("7 6 5", "7 0 5"), &voxels, "empty"),
        (change("7 6 5", "7 -6 5"), &voxels, "expected 3 numbers"),
        (change("7 6 5", "70000 60000 50000"), &voxels, "70000 x 60000 x 50000 voxels"),
        (change("7 6 5", "9999999999999 9999999999999 9999999999999"), &voxels, "voxels"),
        (change("domain domain domain", "domain vector domain"), &voxels, "axis 1 is of kind 'vector'"),
        (change("endian", "space units: \"furlong\" \"furlong\" \"furlong\"\nendian"), &voxels, "'furlong'"),
        (change("endian", "byte skip: -2\nendian"), &voxels, "'byte skip' -2"),
        (change("endian", "line skip: 9\nendian"), b"no line", "cut short"),
        (change("endian", "sizes: 7 6 5\nendian"), &voxels, "'sizes' twice"),
        (change("endian", "no colon\nendian"), &voxels, "neither 'field: value'"),
        (change("endian", "data file: LIST\nslice 1.raw\nendian"), &voxels, "several files"),
        (change("endian", "data file: slice%03d.raw 1 5 1\nendian"), &voxels, "several files"),
        (change("endian", "data file: none.raw\nendian"), &voxels, "that its header names for its voxels is not beside it"),
        (change("endian", "data file: ../none.raw\nendian"), &voxels, "in another folder"),
        (change("endian", "data file: /etc/passwd\nendian"), &voxels, "in another folder"),
        (good[..good.len() - 1].to_owned(), &[], "no end"),
        (change("raw", "gzip"), &zipped[..60], "cut short"),
        (change("raw", "gzip"), &voxels, "damaged after 0"),
        (change("raw", "text"), b"1 2 3 four", "voxel 3 of 210 is no number"),
        (change("raw", "text"), b"1 2 3", "cut short"),
        (change("raw", "text"), &[b'1'; 1000], "voxel 0 of 210 is no number"),
    ];
    for (header, voxels, words) in cases {
        let error = refused("a.nrrd", &header, voxels);
        assert!(error.contains(words), "{words}: {error}");
    }
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("good.nrrd");
    write(&path, &[good.as_bytes(), &voxels]);
    assert!(read(&path).is_ok(), "control");
}

#[test]
fn metaimage_that_cannot_be_used_is_one_sentence() {
    let good = local(&sample().metaimage_header(""));
    let voxels = sample().little();
    let change = |from: &str, to: &str| {
        assert!(good.contains(from), "{from}");
        good.replace(from, to)
    };
    let compressed = change("BinaryData = True", "BinaryData = True\nCompressedData = True");
    let mut zipped = zlib(&voxels);
    let cases: [(String, &[u8], &str); 24] = [
        (good.clone(), &voxels[..voxels.len() - 1], "cut short"),
        (change("ObjectType = Image", "ObjectType = Tube"), &voxels, "that of 'Tube'"),
        (change("NDims = 3", "NDims = 2"), &voxels, "expected 2 numbers"),
        (change("NDims = 3\n", ""), &voxels, "'NDims'"),
        (change("DimSize = 7 6 5", "DimSize = 7 6 five"), &voxels, "expected 3 numbers"),
        (change("DimSize = 7 6 5", "DimSize = 70000 60000 50000"), &voxels, "70000 x 60000 x 50000 voxels"),
        (change("ElementType = MET_SHORT", "ElementType = MET_STRING"), &voxels, "'MET_STRING'"),
        (change("ElementType = MET_SHORT\n", ""), &voxels, "'ElementType'"),
        (change("ElementSpacing = 2 2.5 5\n", ""), &voxels, "'ElementSize'"),
        (change("ElementSpacing = 2 2.5 5", "ElementSpacing = 0 2.5 5"), &voxels, "singular"),
        (change("ElementSpacing = 2 2.5 5", "ElementSpacing = 2 -2.5 5"), &voxels, "'ElementSpacing' of its header is -2.5"),
        (change("TransformMatrix = 1 0 0", "TransformMatrix = nan 0 0"), &voxels, "not finite"),
        (change("NDims = 3", "NDims = 3\nElementNumberOfChannels = 3"), &voxels, "3 numbers for each voxel"),
        (change("NDims = 3", "NDims = 3\nDistanceUnits = um"), &voxels, "'um', expected mm"),
        (change("NDims = 3", "NDims = 3\nHeaderSize = -5"), &voxels, "'HeaderSize'"),
        (change("NDims = 3", "NDims = 3\nNDims = 3"), &voxels, "'NDims' twice"),
        (change("LOCAL", "LIST"), &voxels, "several files"),
        (change("LOCAL", "none.raw"), &voxels, "is not beside it"),
        (change("LOCAL", "C:/../none.raw"), &voxels, "in another folder"),
        (sample().metaimage_header(""), &[], "does not say where its voxels are"),
        (compressed.clone(), &zipped[..60], "cut short"),
        (compressed.clone(), &voxels, "damaged after 0"),
        (compressed.replace("BinaryData = True", "BinaryData = False"), &voxels, "text and compressed"),
        (change("Offset", "Quaxwelk"), &voxels[..9], "cut short"),
    ];
    for (header, voxels, words) in cases {
        let error = refused("a.mha", &header, voxels);
        assert!(error.contains(words), "{words}: {error}");
    }
    // A byte that was changed on the way is seen by the checksum at the end.
    *zipped.last_mut().expect("a byte") ^= 1;
    assert!(refused("a.mha", &compressed, &zipped).contains("damaged"));
}

#[test]
fn what_is_odd_but_can_be_read_is_said() {
    let folder = tempfile::tempdir().expect("a folder");
    let said = |name: &str, header: &str, voxels: &[u8]| {
        let path = folder.path().join(name);
        write(&path, &[header.as_bytes(), voxels]);
        let reporter = Reporter::silent();
        let volume = read_volume(&path, &reporter).unwrap_or_else(|error| panic!("{error}"));
        (volume, reporter.warnings().keys().map(ToString::to_string).collect::<Vec<_>>())
    };
    let voxels = sample().little();
    let good = local(&sample().metaimage_header(""));
    assert!(said("a.mha", &good, &voxels).1.is_empty(), "control");
    let (volume, warnings) = said("a.mha", &good.replace("TransformMatrix", "Comment"), &voxels);
    assert_eq!((volume.lps_from_voxel, warnings), (sample().lps_from_voxel, vec!["no orientation".to_owned()]));
    assert_eq!(said("a.mha", &good, &[&voxels[..], &[0; 9000]].concat()).1, ["more bytes"]);
    let micron = nrrd(END).replace("endian", "space units: \"um\" \"um\" \"um\"\nendian");
    let (volume, warnings) = said("a.nrrd", &micron, &voxels);
    assert!(volume.spacing_mm.iter().zip([0.002, 0.0025, 0.005]).all(|(found, mm)| (found - mm).abs() < 1e-12));
    assert_eq!(warnings, ["voxel size"]);
    // An axis of one sample that does not lie in space changes nothing.
    let four = nrrd(END).replace("dimension: 3", "dimension: 4").replace("7 6 5", "1 7 6 5");
    let four = four.replace("(2,0,0)", "none (2,0,0)").replace("kinds: ", "kinds: list ");
    assert_eq!(said("a.nrrd", &four, &voxels).0.size, [7, 6, 5]);
}

/// A header that promises gigabytes, and a compressed stream of them, through the helper of the program.
#[test]
fn bombs_are_refused_through_the_helper() {
    let folder = tempfile::tempdir().expect("a folder");
    let run = |name: &str| {
        let program = Command::new(env!("CARGO_BIN_EXE_sidecarm")).args(["info", name]).current_dir(folder.path()).output();
        let output = program.expect("starts");
        (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    let at = |name: &str| folder.path().join(name);
    let lying = nrrd(END).replace("7 6 5", "500 500 900");
    write(&at("lying.nrrd"), &[lying.as_bytes(), &sample().little()]);
    let bomb = nrrd("endian: little\nencoding: gzip\n\n");
    write(&at("bomb.nrrd"), &[bomb.as_bytes(), &gzip(&vec![0u8; 64 << 20])]);
    let text = local(&sample().metaimage_header("")).replace("BinaryData = True", "BinaryData = False");
    write(&at("text.mha"), &[text.as_bytes(), &vec![b'7'; 8 << 20]]);
    let header = vec![b'#'; 4 << 20];
    write(&at("header.nrrd"), &[b"NRRD0004\n", &header]);
    let mut cases = 0;
    for (name, words) in [
        ("lying.nrrd", "cut short"),
        ("bomb.nrrd", "bytes follow the 210 voxels"),
        ("text.mha", "is no number"),
        ("header.nrrd", "no end"),
    ] {
        let (code, stderr) = run(name);
        assert!(code == Some(1) && stderr.contains(words) && stderr.lines().count() == 1, "{name}: {code:?} {stderr}");
        cases += 1;
    }
    assert_eq!(cases, 4);
    write(&at("good.nrrd"), &[nrrd(END).as_bytes(), &sample().little()]);
    assert_eq!(run("good.nrrd").0, Some(0), "control");
}
