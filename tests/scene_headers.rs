//! NRRD and MetaImage files that are damaged, lie, or do not say what they must: each is one sentence with what to do.

use std::path::Path;
use std::process::Command;

use glam::DVec3;
use sidecarm::reporter::Reporter;
use sidecarm::scene::{VolumeFile, read_volume, read_volume_facts};

use crate::scene_support::NiftiFile;
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
    let behind = [&[7_u8; 20][..], &voxels[..]].concat();
    let mut zipped = zlib(&voxels);
    let cases: [(String, &[u8], &str); 26] = [
        (good.clone(), &voxels[..voxels.len() - 1], "cut short"),
        (change("ObjectType = Image", "ObjectType = Tube"), &voxels, "that of 'Tube'"),
        (change("NDims = 3", "NDims = 2"), &voxels, "expected 2 numbers"),
        (change("NDims = 3\n", ""), &voxels, "'NDims'"),
        (change("DimSize = 7 6 5", "DimSize = 7 6 five"), &voxels, "expected 3 numbers"),
        (change("DimSize = 7 6 5", "DimSize = 70000 60000 50000"), &voxels, "70000 x 60000 x 50000 voxels"),
        (change("ElementType = MET_SHORT", "ElementType = MET_STRING"), &voxels, "'MET_STRING'"),
        (change("ElementType = MET_SHORT\n", ""), &voxels, "'ElementType'"),
        (change("ElementSpacing = 2 2.5 5\n", ""), &voxels, "neither 'ElementSpacing' nor 'ElementSize'"),
        (change("ElementSpacing = 2 2.5 5", "ElementSpacing = 0 2.5 5"), &voxels, "singular"),
        (change("ElementSpacing = 2 2.5 5", "ElementSpacing = 2 -2.5 5"), &voxels, "'ElementSpacing' of its header is -2.5"),
        (change("TransformMatrix = 1 0 0", "TransformMatrix = nan 0 0"), &voxels, "not finite"),
        (change("NDims = 3", "NDims = 3\nElementNumberOfChannels = 3"), &voxels, "3 numbers for each voxel"),
        (change("NDims = 3", "NDims = 3\nDistanceUnits = um"), &voxels, "'um', expected mm"),
        (change("NDims = 3", "NDims = 3\nHeaderSize = -5"), &voxels, "'HeaderSize'"),
        // Twenty bytes of something lie before the voxels: they were taken for the first ten.
        (
            change("NDims = 3", "NDims = 3\nHeaderSize = 20"),
            &behind,
            "'HeaderSize' of its header is 20, but 'ElementDataFile = LOCAL'",
        ),
        (change("NDims = 3", "NDims = 3\nHeaderSize = 20"), &voxels, "without HeaderSize"),
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
    // A header that says how long it is itself, or that it has no other, says nothing new.
    let sized = good.replace("NDims = 3", "NDims = 3\nHeaderSize = 0000");
    for header in [sized.replace("0000", &format!("{:04}", sized.len())), sized] {
        let (volume, warnings) = said("a.mha", &header, &voxels);
        assert_eq!((volume.lps_from_voxel, warnings.len()), (sample().lps_from_voxel, 0), "{header}");
    }
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

/// Warnings about the volume at `path`, each with its kind.
fn warned(path: &Path) -> Vec<String> {
    let reporter = Reporter::silent();
    read_volume(path, &reporter).unwrap_or_else(|error| panic!("{error}"));
    reporter.warnings().into_iter().map(|(kind, counted)| format!("{kind}: {}", counted.latest)).collect()
}

/// A type that is too narrow reads half of a file as noise, and what it left behind passed in most formats without a word.
#[test]
fn what_follows_the_voxels_is_said_in_every_format() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    sample().nifti(&at("a.nii"));
    let nifti = std::fs::read(at("a.nii")).expect("bytes");
    let raw = nrrd(END);
    let zipped = raw.replace("raw", "gzip");
    let skipping = raw.replace("endian", "line skip: 1\nendian");
    let detached = raw.replace("endian", "data file: c.raw\nendian");
    let meta = sample().metaimage_header("");
    let meta_zipped = local(&sample().metaimage_header("CompressedData = True\n"));
    let mut cases = 0;
    for (more, words) in [
        (vec![], ""),
        (vec![0; 1], "1 bytes follow the voxels: does the header say their size and type right?"),
        (vec![7; 9000], "9000 bytes follow the voxels: does"),
        (
            vec![0; 420],
            "420 bytes follow the voxels, which is what they would fill with 4 bytes each instead of 2: the type (Int16)",
        ),
    ] {
        let voxels = [&sample().little()[..], &more].concat();
        write(&at("a.nii"), &[&nifti, &more]);
        write(&at("a.nii.gz"), &[&gzip(&[&nifti[..], &more].concat())]);
        write(&at("a.nrrd"), &[raw.as_bytes(), &voxels]);
        write(&at("b.nrrd"), &[zipped.as_bytes(), &gzip(&voxels)]);
        write(&at("c.nrrd"), &[skipping.as_bytes(), b"a line\n", &voxels]);
        write(&at("c.nhdr"), &[detached.as_bytes()]);
        write(&at("c.raw"), &[&voxels]);
        write(&at("a.mha"), &[local(&meta).as_bytes(), &voxels]);
        write(&at("b.mha"), &[meta_zipped.as_bytes(), &zlib(&voxels)]);
        write(&at("c.mhd"), &[meta.as_bytes(), b"ElementDataFile = c.raw\n"]);
        for name in ["a.nii", "a.nii.gz", "a.nrrd", "b.nrrd", "c.nrrd", "c.nhdr", "a.mha", "b.mha", "c.mhd"] {
            let said = warned(&at(name));
            match said.as_slice() {
                [] => assert!(more.is_empty(), "{name}: nothing said of {}", more.len()),
                [only] => assert!(!more.is_empty() && only.starts_with("more bytes: ") && only.contains(words), "{name}: {only}"),
                _ => panic!("{name}: {said:?}"),
            }
            cases += 1;
        }
    }
    assert_eq!(cases, 36);
    // Behind a stream that has ended, and in a text, where only white space is nothing.
    write(&at("b.mha"), &[meta_zipped.as_bytes(), &zlib(&sample().little()), b"more"]);
    assert!(warned(&at("b.mha"))[0].contains("4 bytes follow the compressed voxels"));
    let text = raw.replace("raw", "text");
    let numbers: String = sample().hu.iter().map(|hu| format!("{hu}\n")).collect();
    write(&at("t.nrrd"), &[text.as_bytes(), numbers.as_bytes(), b" \r\n\n"]);
    assert_eq!(warned(&at("t.nrrd")), Vec::<String>::new(), "control");
    write(&at("t.nrrd"), &[text.as_bytes(), numbers.as_bytes(), b"5 6\n"]);
    assert!(warned(&at("t.nrrd"))[0].contains("2 numbers follow the voxels"));
}

#[test]
fn nifti_without_its_end_or_axes_and_sizes_that_contradict_are_said_plainly() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("a.nii");
    let good = NiftiFile::int16([2, 2, 2], &[40; 8]);
    let refused = |bytes: &[u8]| {
        write(&path, &[bytes]);
        read(&path).expect_err("refused")
    };
    let zipped = gzip(&good.bytes());
    let error = refused(&zipped[..zipped.len() - 8]);
    assert!(error.contains("cut short behind the last of 8 voxels"), "{error}");
    for length in [0, 10] {
        let error = refused(&good.bytes()[..length]);
        assert!(error.contains("no NIfTI-1 header (it ends too early)"), "{error}");
    }
    for big_endian in [false, true] {
        let mut file = NiftiFile { big_endian, ..good.clone() };
        file.dim[0] = 8;
        let error = refused(&file.bytes());
        assert!(error.contains("8 axes (dim[0]), expected 3"), "{error}");
    }
    let remarks = |pixdim: [f32; 3]| {
        let [i, j, k] = pixdim;
        let file = NiftiFile { pixdim: [1.0, i, j, k, 1.0, 1.0, 1.0, 1.0], ..good.clone() };
        write(&path, &[&file.bytes()]);
        read_volume_facts(&path).expect("good").remarks
    };
    for alike in [[1.0; 3], [1.0, 1.005, 1.0], [0.0; 3]] {
        assert_eq!(remarks(alike), Vec::<String>::new(), "{alike:?}");
    }
    let said = remarks([1.0, 2.0, 1.0]);
    assert!(said.len() == 1 && said[0].contains("1.0000 units long along axis 2 by the sform and 2.0000 by pixdim"), "{said:?}");
}

#[test]
fn segments_in_a_layer_that_the_file_does_not_have_are_said() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("a.seg.nrrd");
    let segment = |number: u32, layer: u32| {
        format!("Segment{number}_LabelValue:=1\nSegment{number}_Name:=part {number}\nSegment{number}_Layer:={layer}\n")
    };
    let named = |layer: u32| {
        write(&path, &[nrrd(&format!("{}{}{END}", segment(0, 0), segment(1, layer))).as_bytes(), &sample().little()]);
        (read(&path).expect("good").label_names.len(), warned(&path))
    };
    assert_eq!(named(0), (2, Vec::new()), "control");
    let (names, said) = named(1);
    assert!(
        names == 1 && said.len() == 1 && said[0].starts_with("labels: ") && said[0].contains("1 segments lie in a layer"),
        "{said:?}"
    );
}

/// `render` read what `info` did not know, where it had another ending.
#[test]
fn info_knows_a_volume_by_its_content() {
    let folder = tempfile::tempdir().expect("a folder");
    let nifti = NiftiFile::int16([2, 2, 2], &[40; 8]).bytes();
    let info = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        write(&path, &[bytes]);
        let output = Command::new(env!("CARGO_BIN_EXE_sidecarm")).arg("info").arg(&path).output().expect("starts");
        (output.status.code(), String::from_utf8_lossy(&output.stdout).into_owned())
    };
    let meta = [local(&sample().metaimage_header("")).as_bytes(), &sample().little()].concat();
    for (name, bytes, format) in [("a.dat", nifti.clone(), "NIfTI"), ("b", gzip(&nifti), "NIfTI"), ("c.csv", meta, "MetaImage")] {
        let (code, words) = info(name, &bytes);
        assert!(code == Some(0) && words.contains(format), "{name}: {code:?} {words}");
    }
    assert_ne!(info("d.dat", &nifti[..340]).0, Some(0), "control");
}
