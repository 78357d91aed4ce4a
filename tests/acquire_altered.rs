//! Pixels that a file calls padding, and pixels that a file stores in another order than it shows them: masked, put in order, and said.

use std::path::Path;
use std::process::Command;

use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_dictionary_std::tags;
use dicom_object::InMemDicomObject;
use sidecarm::acquire::{Domain, Frame, read_frame, read_frames};
use sidecarm::mask;

use crate::acquire_foreign::tiff_directory;
use crate::acquire_frames::{fluoroscopy, save};

/// The made frame (0, 100, …, 600, 4095) with its padding, and perhaps more.
fn padded(elements: &[(Tag, VR, PrimitiveValue)]) -> Frame {
    let folder = tempfile::tempdir().expect("temporary folder");
    let mut object = fluoroscopy();
    for (tag, vr, value) in elements {
        object.put(DataElement::new(*tag, *vr, value.clone()));
    }
    read_frame(&save(object, &folder.path().join("x.dcm")), None).expect("readable")
}

fn masked(frame: &Frame) -> Vec<usize> {
    let blank = (0..frame.pixels.pixels.len()).filter(|at| frame.pixels.pixels[*at].is_nan()).collect();
    let usable = mask::of_frame(frame).usable(frame.size_px[0], frame.size_px[1], &[]);
    assert!(usable.pixels.iter().zip(&frame.pixels.pixels).all(|(usable, value)| !usable || value.is_finite()));
    blank
}

const VALUE: Tag = tags::PIXEL_PADDING_VALUE;
const LIMIT: Tag = tags::PIXEL_PADDING_RANGE_LIMIT;

/// Areas that a console fills in were read as a panel without X-rays, or as its full signal.
#[test]
fn padding_is_masked_and_told() {
    let plain = padded(&[]);
    assert!(masked(&plain).is_empty() && plain.altered.is_empty(), "control: {:?}", plain.altered);
    let black = padded(&[(VALUE, VR::US, 0u16.into())]);
    assert_eq!(masked(&black), [0]);
    assert!(black.altered.iter().any(|words| words.contains("1 pixels (12.50 %) are padding")), "{:?}", black.altered);
    assert!(!black.altered.iter().any(|words| words.contains("infinite")), "said once: {:?}", black.altered);
    assert!(black.notes.iter().any(|note| note.contains("(0028,0120)")), "{:?}", black.notes);
    assert_eq!(black.clipping.black_at, Some(100.0), "what is masked is no end of the scale");
    assert_eq!(masked(&padded(&[(VALUE, VR::US, 150u16.into())])), [0usize; 0], "a value that no pixel has");
    assert_eq!(masked(&padded(&[(VALUE, VR::US, 400u16.into()), (LIMIT, VR::US, 200u16.into())])), [2, 3, 4]);
    let rescaled = [(VALUE, VR::US, 300u16.into()), (tags::RESCALE_SLOPE, VR::DS, PrimitiveValue::from("2"))];
    assert_eq!(masked(&padded(&rescaled)), [3], "padding is a stored value");
    let mirrored = [(VALUE, VR::US, 0u16.into()), (tags::FIELD_OF_VIEW_HORIZONTAL_FLIP, VR::CS, PrimitiveValue::from("YES"))];
    assert_eq!(masked(&padded(&mirrored)), [3], "it moves with its pixel");
    let inverted =
        [(VALUE, VR::US, 100u16.into()), (tags::PHOTOMETRIC_INTERPRETATION, VR::CS, PrimitiveValue::from("MONOCHROME1"))];
    assert_eq!(masked(&padded(&inverted)), [1]);
}

/// 4095 in twelve signed bits is −1, and −2000 in sixteen is 63536: both ways of writing mean the same pixels.
#[test]
fn padding_is_read_with_the_sign_of_the_pixels() {
    let signed = (tags::PIXEL_REPRESENTATION, VR::US, PrimitiveValue::from(1u16));
    for (vr, value) in [(VR::SS, PrimitiveValue::from(-1i16)), (VR::US, PrimitiveValue::from(0xffffu16))] {
        assert_eq!(masked(&padded(&[signed.clone(), (VALUE, vr, value)])), [7]);
    }
    let range = [signed, (VALUE, VR::SS, (-1i16).into()), (LIMIT, VR::SS, 100i16.into())];
    assert_eq!(masked(&padded(&range)), [0, 1, 7], "a range across zero");
    assert_eq!(masked(&padded(&[(VALUE, VR::US, 4095u16.into())])), [7], "control: unsigned");
    let beyond = PrimitiveValue::U16([63536u16, 1, 2, 3, 4, 5, 6, 2096].as_slice().into());
    assert_eq!(masked(&padded(&[(VALUE, VR::US, 63536u16.into()), (tags::PIXEL_DATA, VR::OW, beyond)])), [0], "not 2096");
}

#[test]
fn a_frame_of_nothing_but_padding_is_refused() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let mut object: InMemDicomObject = fluoroscopy();
    object.put(DataElement::new(VALUE, VR::US, PrimitiveValue::from(0u16)));
    object.put(DataElement::new(LIMIT, VR::US, PrimitiveValue::from(4095u16)));
    let error = read_frame(&save(object, &folder.path().join("x.dcm")), None).expect_err("nothing is there").to_string();
    assert!(error.contains("all 8 pixels are NaN, infinite or padding"), "{error}");
}

/// Pages of grey bytes, each of rows of equal length and with an orientation.
fn tiff(pages: &[(&[&[u8]], u16)]) -> Vec<u8> {
    let mut bytes = b"II*\0\0\0\0\0".to_vec();
    let mut link = 4;
    for (rows, orientation) in pages {
        let strip = bytes.len() as u32;
        bytes.extend(rows.concat());
        bytes.resize(bytes.len().next_multiple_of(2), 0);
        let at = (bytes.len() as u32).to_le_bytes();
        bytes[link..link + 4].copy_from_slice(&at);
        let (width, height) = (rows[0].len() as u32, rows.len() as u32);
        let entries: [(u16, u16, u32); 9] = [
            (256, 4, width),
            (257, 4, height),
            (258, 3, 8),
            (259, 3, 1),
            (262, 3, 1),
            (273, 4, strip),
            (274, 3, u32::from(*orientation)),
            (278, 4, height),
            (279, 4, width * height),
        ];
        bytes.extend(tiff_directory(&entries, 0));
        link = bytes.len() - 4;
    }
    bytes
}

/// What each orientation stores of the picture 123/456, written down by hand from TIFF 6.0: "the 0th row represents the … side of the
/// image, and the 0th column the … side".
const STORED: [(u16, &[&[u8]]); 8] = [
    (1, &[&[1, 2, 3], &[4, 5, 6]]),
    (2, &[&[3, 2, 1], &[6, 5, 4]]),
    (3, &[&[6, 5, 4], &[3, 2, 1]]),
    (4, &[&[4, 5, 6], &[1, 2, 3]]),
    (5, &[&[1, 4], &[2, 5], &[3, 6]]),
    (6, &[&[3, 6], &[2, 5], &[1, 4]]),
    (7, &[&[6, 3], &[5, 2], &[4, 1]]),
    (8, &[&[4, 1], &[5, 2], &[6, 3]]),
];

fn written(folder: &Path, pages: &[(&[&[u8]], u16)]) -> std::path::PathBuf {
    let path = folder.join("x.tif");
    std::fs::write(&path, tiff(pages)).expect("written");
    path
}

/// A picture that its file turns was read as it lies there: poses and comparisons were those of another view.
#[test]
fn a_tiff_is_read_as_it_is_shown() {
    let folder = tempfile::tempdir().expect("temporary folder");
    for (orientation, rows) in STORED {
        let frame = read_frame(&written(folder.path(), &[(rows, orientation)]), None).expect("readable");
        assert_eq!(frame.pixels.pixels, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], "{orientation}");
        assert_eq!((frame.size_px, frame.pixels.width), ([3, 2], 3), "{orientation}");
        assert_eq!(frame.altered.len(), usize::from(orientation != 1), "{:?}", frame.altered);
        assert!(frame.altered.iter().all(|words| words.contains(&format!("(tag 274) is {orientation},"))), "{:?}", frame.altered);
    }
    let both = read_frames(&written(folder.path(), &[(STORED[5].1, 6), (STORED[0].1, 1)]), None).expect("readable");
    assert_eq!(both.len(), 2);
    assert_eq!(both[0].pixels, both[1].pixels, "each page has its own");
    let odd = read_frame(&written(folder.path(), &[(STORED[0].1, 9)]), None).expect("readable");
    assert_eq!(odd.pixels.pixels, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    assert!(odd.altered.iter().any(|words| words.contains("is 9, expected 1 to 8")), "{:?}", odd.altered);
}

/// Little-endian TIFF whose photometric interpretation (tag 262, one SHORT) is made "white is zero".
fn zero_is_white(path: &Path) {
    let mut bytes = std::fs::read(path).expect("readable");
    let entry = [6, 1, 3, 0, 1, 0, 0, 0, 1, 0];
    let at = bytes.windows(entry.len()).position(|window| window == entry).expect("black is zero");
    bytes[at + 8] = 0;
    std::fs::write(path, bytes).expect("written");
}

/// The decoder turns such values round without a word: integers about the ends of their type, floats about one half, whatever they mean.
#[test]
fn a_tiff_whose_zero_is_white_says_so_and_keeps_what_is_measured() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let path = written(folder.path(), &[(STORED[0].1, 1)]);
    zero_is_white(&path);
    let grey = read_frame(&path, Some(Domain::Linear)).expect("readable");
    assert_eq!(grey.pixels.pixels, [254.0, 253.0, 252.0, 251.0, 250.0, 249.0]);
    assert!(grey.inverted && grey.turned_about == Some(255.0), "{:?}", grey.turned_about);
    assert!(grey.altered.iter().any(|words| words.contains("(tag 262) is 0, white is zero: turned round")), "{:?}", grey.altered);
    let log = read_frame(&path, Some(Domain::Log)).expect("readable");
    assert_eq!(log.pixels.pixels, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0], "larger is more attenuation, as stored");
    assert!(!log.inverted && log.altered.iter().any(|words| words.contains("taken as they are")), "{:?}", log.altered);

    let line_integrals = sidecarm::image::Image { width: 3, height: 1, pixels: vec![0.25f32, 3.0, 8.5] };
    let path = folder.path().join("float.tif");
    sidecarm::image::write_tiff_f32(&path, std::slice::from_ref(&line_integrals)).expect("written");
    assert!(read_frame(&path, Some(Domain::Log)).expect("readable").altered.is_empty(), "control: black is zero");
    zero_is_white(&path);
    for domain in [Domain::Log, Domain::Linear] {
        let float = read_frame(&path, Some(domain)).expect("readable");
        assert_eq!(float.pixels.pixels, line_integrals.pixels);
        assert!(float.altered.iter().any(|words| words.contains("white is zero")), "{:?}", float.altered);
    }
    let complaint = sidecarm::image::read_tiff_f32(&path).expect_err("turned round").to_string();
    assert!(complaint.contains("white is zero, expected 1"), "{complaint}");
}

/// Images of this program have no orientation; one that got it elsewhere is refused, since nobody would hear of a note.
#[test]
fn a_simulated_image_is_not_turned_unasked() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let complaint = |orientation: u16| {
        let path = written(folder.path(), &[(STORED[0].1, orientation)]);
        sidecarm::image::read_tiff_f32(&path).expect_err("bytes, and perhaps turned").to_string()
    };
    assert!(complaint(6).contains("orientation (tag 274) is 6, expected 1"), "{}", complaint(6));
    assert!(complaint(1).contains("expected one 32-bit float per pixel"), "control: {}", complaint(1));
}

/// Whoever registers hears of both; the frame itself has no beads, which is another matter.
#[test]
fn commands_say_what_was_altered() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let beads = r#"{"markups": [{"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": [
        {"label": "a", "position": [0, 0, 0]}, {"label": "b", "position": [9, 0, 0]}, {"label": "c", "position": [0, 9, 0]},
        {"label": "d", "position": [0, 0, 9]}, {"label": "e", "position": [9, 9, 0]}, {"label": "f", "position": [9, 0, 9]}]}]}"#;
    std::fs::write(folder.path().join("beads.mrk.json"), beads).expect("beads");
    let row: Vec<u8> = (0..64).collect();
    let rows = vec![row.as_slice(); 48];
    let said = |orientation: u16| {
        written(folder.path(), &[(&rows, orientation)]);
        let ran = Command::new(env!("CARGO_BIN_EXE_sidecarm"))
            .args([
                "register",
                "x.tif",
                "--beads",
                "beads.mrk.json",
                "--bead-radius",
                "0.75",
                "--domain",
                "linear",
                "--out",
                "pose.json",
            ])
            .current_dir(folder.path())
            .output()
            .expect("the program starts");
        String::from_utf8_lossy(&ran.stderr).into_owned()
    };
    let turned = said(6);
    assert!(turned.contains("warning: x.tif: TIFF orientation (tag 274) is 6"), "{turned}");
    assert!(!said(1).contains("orientation"), "control: stored as shown");
}
