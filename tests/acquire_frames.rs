//! Frames from made and real files: values, direction, domain, identity, damage.

use std::path::{Path, PathBuf};

use dicom_core::{DataElement, PrimitiveValue, Tag, VR, dicom_value};
use dicom_dictionary_std::{tags, uids};
use dicom_object::{FileMetaTableBuilder, InMemDicomObject};
use sidecarm::acquire::{AcquireError, Domain, Fault, KEPT_TAGS, read_frame, read_frames};
use sidecarm::image::{Image, write_tiff_f32};

/// A 4×2 fluoroscopy frame of 12-bit values 0, 100, …, 600, 4095.
pub fn fluoroscopy() -> InMemDicomObject {
    let values: Vec<u16> = vec![0, 100, 200, 300, 400, 500, 600, 4095];
    let mut object = InMemDicomObject::new_empty();
    let text = |object: &mut InMemDicomObject, tag, vr, value: &str| {
        object.put(DataElement::new(tag, vr, PrimitiveValue::from(value)));
    };
    text(&mut object, tags::SOP_CLASS_UID, VR::UI, uids::X_RAY_ANGIOGRAPHIC_IMAGE_STORAGE);
    text(&mut object, tags::SOP_INSTANCE_UID, VR::UI, "2.25.1");
    text(&mut object, tags::MODALITY, VR::CS, "XA");
    text(&mut object, tags::PATIENT_NAME, VR::PN, "Lovelace^Augusta");
    text(&mut object, tags::PATIENT_ID, VR::LO, "AAL-1815");
    text(&mut object, tags::PATIENT_BIRTH_DATE, VR::DA, "18151210");
    text(&mut object, tags::INSTITUTION_NAME, VR::LO, "Ockham Hospital");
    text(&mut object, tags::REFERRING_PHYSICIAN_NAME, VR::PN, "Babbage^Charles");
    text(&mut object, tags::IMAGE_COMMENTS, VR::LT, "left hip of Augusta");
    text(&mut object, tags::PHOTOMETRIC_INTERPRETATION, VR::CS, "MONOCHROME2");
    text(&mut object, tags::PIXEL_INTENSITY_RELATIONSHIP, VR::CS, "LIN");
    text(&mut object, tags::KVP, VR::DS, "78.5");
    text(&mut object, tags::DISTANCE_SOURCE_TO_DETECTOR, VR::DS, "1020");
    text(&mut object, tags::IMAGER_PIXEL_SPACING, VR::DS, "0.2\\0.3");
    text(&mut object, tags::ACQUISITION_NUMBER, VR::IS, "17");
    text(&mut object, tags::ACQUISITION_DATE, VR::DA, "20261121");
    text(&mut object, tags::ACQUISITION_TIME, VR::TM, "050102.5");
    let number = |object: &mut InMemDicomObject, tag, value: u16| {
        object.put(DataElement::new(tag, VR::US, PrimitiveValue::from(value)));
    };
    number(&mut object, tags::SAMPLES_PER_PIXEL, 1);
    number(&mut object, tags::ROWS, 2);
    number(&mut object, tags::COLUMNS, 4);
    number(&mut object, tags::BITS_ALLOCATED, 16);
    number(&mut object, tags::BITS_STORED, 12);
    number(&mut object, tags::HIGH_BIT, 11);
    number(&mut object, tags::PIXEL_REPRESENTATION, 0);
    object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(values.into())));
    object
}

pub fn save(object: InMemDicomObject, path: &Path) -> PathBuf {
    let meta = FileMetaTableBuilder::new()
        .transfer_syntax(uids::EXPLICIT_VR_LITTLE_ENDIAN)
        .media_storage_sop_class_uid(uids::X_RAY_ANGIOGRAPHIC_IMAGE_STORAGE)
        .media_storage_sop_instance_uid("2.25.1");
    object.with_meta(meta).expect("meta is complete").write_to_file(path).expect("file is written");
    path.to_owned()
}

fn with_text(tag: Tag, vr: VR, value: &str) -> InMemDicomObject {
    let mut object = fluoroscopy();
    object.put(DataElement::new(tag, vr, PrimitiveValue::from(value)));
    object
}

fn fault(path: &Path) -> Fault {
    let error = read_frame(path, None).expect_err("refused");
    error.fault().unwrap_or_else(|| panic!("{error}: not the file's fault")).clone()
}

fn folder() -> tempfile::TempDir {
    tempfile::tempdir().expect("temporary folder")
}

#[test]
fn a_linear_frame_keeps_its_values_and_tags() {
    let folder = folder();
    let frame = read_frame(&save(fluoroscopy(), &folder.path().join("a.dcm")), None).expect("readable");
    assert_eq!(frame.name, "a");
    assert_eq!(frame.pixels.pixels, [0.0, 100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 4095.0]);
    assert_eq!((frame.pixels.width, frame.pixels.height), (4, 2));
    assert_eq!(frame.domain, Domain::Linear);
    assert!(!frame.inverted);
    assert_eq!(frame.tags.pitch_mm, Some([0.3, 0.2]), "DICOM gives the row spacing first");
    assert_eq!(frame.tags.sid_mm, Some(1020.0));
    assert_eq!(frame.tags.kvp, Some(78.5));
    assert_eq!(frame.tags.exposure_counter, Some(17));
    assert_eq!(frame.tags.acquired_local_us(), Some(1_795_237_262_500_000));
    assert_eq!(frame.clipping.saturated_share, 0.125);
    assert_eq!(frame.clipping.saturated_at, Some(4095.0));
    assert_eq!(frame.clipping.black_share, 0.125);
    assert_eq!(frame.sha256, sidecarm::image::sha256_file(&folder.path().join("a.dcm")).expect("hash"));
}

#[test]
fn direction_and_scale_follow_the_header() {
    let folder = folder();
    let path = folder.path().join("b.dcm");
    let pixels = |object: InMemDicomObject| {
        let frame = read_frame(&save(object, &path), None).expect("readable");
        (frame.pixels.pixels, frame.inverted, frame.domain)
    };
    let (values, inverted, _) = pixels(with_text(tags::PHOTOMETRIC_INTERPRETATION, VR::CS, "MONOCHROME1"));
    assert!(inverted);
    assert_eq!(values[..2], [4095.0, 3995.0]);
    let mut fewer = fluoroscopy();
    fewer.put(DataElement::new(tags::PIXEL_INTENSITY_RELATIONSHIP_SIGN, VR::SS, PrimitiveValue::from(-1i16)));
    let fewer = read_frame(&save(fewer, &path), None).expect("readable");
    assert_eq!((fewer.inverted, fewer.turned_about, fewer.pixels.pixels[1]), (true, Some(4095.0), 3995.0));
    assert!(fewer.notes.iter().any(|note| note.contains("12 bits stored, 0 and 4095")), "{:?}", fewer.notes);
    let (values, inverted, domain) = pixels(with_text(tags::PIXEL_INTENSITY_RELATIONSHIP, VR::CS, "LOG"));
    assert_eq!((inverted, domain), (true, Domain::Log), "log frames grow with attenuation");
    assert_eq!(values[..2], [4095.0, 3995.0]);
    let mut rescaled = with_text(tags::RESCALE_SLOPE, VR::DS, "2");
    rescaled.put(DataElement::new(tags::RESCALE_INTERCEPT, VR::DS, PrimitiveValue::from("-50")));
    assert_eq!(pixels(rescaled).0[..2], [-50.0, 150.0]);
    let mut signed = fluoroscopy();
    signed.put(DataElement::new(tags::PIXEL_REPRESENTATION, VR::US, PrimitiveValue::from(1u16)));
    assert_eq!(pixels(signed).0[6..], [600.0, -1.0], "4095 is -1 in twelve signed bits");
    let mirrored = pixels(with_text(tags::FIELD_OF_VIEW_HORIZONTAL_FLIP, VR::CS, "YES"));
    assert_eq!(mirrored.0[..4], [300.0, 200.0, 100.0, 0.0]);
    let mut overlay = fluoroscopy();
    overlay.put(DataElement::new(tags::PIXEL_DATA, VR::OW, dicom_value!(U16, [0xf064, 1, 2, 3, 4, 5, 6, 7])));
    assert_eq!(pixels(overlay).0[0], 100.0, "bits above the high bit are overlays");
}

/// A console that writes fourteen bits and says twelve: what is brightest becomes dark.
#[test]
fn what_does_not_fit_the_stored_bits_is_said() {
    let folder = folder();
    let path = folder.path().join("bits.dcm");
    let altered = |words: [u16; 8], signed: u16| {
        let mut object = fluoroscopy();
        object.put(DataElement::new(tags::PIXEL_REPRESENTATION, VR::US, PrimitiveValue::from(signed)));
        object.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(words.to_vec().into())));
        read_frame(&save(object, &path), None).expect("readable").altered
    };
    let beyond = altered([1, 2, 3, 4, 5, 6, 5000, 4096], 0);
    assert!(beyond.len() == 1 && beyond[0].starts_with("2 pixels hold more than the 12 bits"), "{beyond:?}");
    assert_eq!(altered([1, 2, 3, 4, 5, 6, 4095, 0], 0), [""; 0]);
    // A sign may be carried on to the allocated bits or not.
    assert_eq!(altered([1, 2, 3, 4, 5, 6, 0xfff0, 0x0ff0], 1), [""; 0]);
    assert_eq!(altered([1, 2, 3, 4, 5, 6, 0xf7f0, 0x17f0], 1).len(), 1);
}

#[test]
fn eight_bits_and_several_frames() {
    let folder = folder();
    let path = folder.path().join("run.dcm");
    let mut object = fluoroscopy();
    for tag in [tags::BITS_ALLOCATED, tags::BITS_STORED] {
        object.put(DataElement::new(tag, VR::US, PrimitiveValue::from(8u16)));
    }
    object.put(DataElement::new(tags::HIGH_BIT, VR::US, PrimitiveValue::from(7u16)));
    object.put(DataElement::new(tags::NUMBER_OF_FRAMES, VR::IS, PrimitiveValue::from("3")));
    object.put(DataElement::new(tags::PIXEL_DATA, VR::OB, PrimitiveValue::from((0..24u8).collect::<Vec<_>>())));
    save(object, &path);
    let frames = read_frames(&path, None).expect("readable");
    assert_eq!(frames.len(), 3);
    assert_eq!(frames[2].pixels.pixels[0], 16.0);
    assert_eq!(frames[2].name, "run#0002");
    assert_eq!(frames.iter().map(|frame| frame.image_of_file).collect::<Vec<_>>(), [[0, 3], [1, 3], [2, 3]]);
    assert_eq!(fault(&path), Fault::SeveralImages { found: 3 });
}

/// Everything in the made file that names a person or place, in upper and lower case.
const SECRETS: [&str; 7] = ["lovelace", "augusta", "aal-1815", "18151210", "ockham", "babbage", "left hip"];

#[test]
fn identity_stays_outside() {
    let folder = folder();
    let mut object = fluoroscopy();
    // Free text hidden in code strings and numbers must not pass either.
    object.put(DataElement::new(tags::IMAGE_TYPE, VR::CS, PrimitiveValue::from("ORIGINAL\\Lovelace")));
    object.put(DataElement::new(tags::EXPOSURE_TIME, VR::IS, PrimitiveValue::from("babbage")));
    let frame = read_frame(&save(object, &folder.path().join("Lovelace_0001.dcm")), None).expect("readable");
    assert_eq!(frame.tags.image_type, ["ORIGINAL"]);
    let shown = format!("{frame:?} {}", serde_json::to_string_pretty(&frame).expect("JSON")).to_lowercase();
    for secret in SECRETS {
        assert!(!shown.contains(secret), "{secret} in {shown}");
    }
    assert!(shown.contains("xa"), "control: what is kept is found");
    assert!(frame.name.starts_with("frame-"), "{}", frame.name);
    assert!(KEPT_TAGS.iter().all(|kept| kept.tag.group() != 0x0010), "the patient group is never kept");
}

#[test]
fn the_log_form_and_json_give_the_frame_back() {
    let folder = folder();
    let frame = read_frame(&save(fluoroscopy(), &folder.path().join("a.dcm")), None).expect("readable");
    let json = serde_json::to_string(&frame).expect("JSON");
    let mut back: sidecarm::acquire::Frame = serde_json::from_str(&json).expect("own JSON");
    assert!(back.pixels.pixels.is_empty(), "pixels are not in the JSON");
    back.pixels = frame.pixels.clone();
    assert_eq!(back, frame);
}

#[test]
fn every_cut_of_a_file_is_an_error_that_may_still_be_unfinished() {
    let folder = folder();
    let whole = std::fs::read(save(fluoroscopy(), &folder.path().join("whole.dcm"))).expect("bytes");
    let path = folder.path().join("cut.dcm");
    let mut cuts = 0;
    for length in (0..whole.len()).step_by(7) {
        std::fs::write(&path, &whole[..length]).expect("cut file");
        let error = read_frame(&path, None).expect_err("a cut file is no frame");
        assert!(error.fault().is_some_and(Fault::may_be_unfinished) || length < 132, "{length}: {error}");
        assert!(error.to_string().contains("cut.dcm"), "{error}");
        cuts += 1;
    }
    assert!(cuts > 50);
}

#[test]
fn damage_is_named() {
    let folder = folder();
    let path = folder.path().join("bad.dcm");
    let message = |object: InMemDicomObject| read_frame(&save(object, &path), None).expect_err("refused").to_string();
    let mut empty = fluoroscopy();
    empty.put(DataElement::new(tags::ROWS, VR::US, PrimitiveValue::from(0u16)));
    assert!(message(empty).contains("4x0 pixels is empty"));
    let mut tall = fluoroscopy();
    tall.put(DataElement::new(tags::ROWS, VR::US, PrimitiveValue::from(3u16)));
    assert!(message(tall).contains("expected 24"));
    let mut colour = fluoroscopy();
    colour.put(DataElement::new(tags::SAMPLES_PER_PIXEL, VR::US, PrimitiveValue::from(3u16)));
    assert!(message(colour).contains("colour"));
    let mut blank = fluoroscopy();
    blank.remove_element(tags::PIXEL_DATA);
    assert!(message(blank).contains("pixel data (7FE0,0010) is missing"));
    let mut deep = fluoroscopy();
    deep.put(DataElement::new(tags::BITS_STORED, VR::US, PrimitiveValue::from(40u16)));
    assert!(message(deep).contains("bits stored"));

    let meta = FileMetaTableBuilder::new()
        .transfer_syntax(uids::JPEG2000)
        .media_storage_sop_class_uid(uids::X_RAY_ANGIOGRAPHIC_IMAGE_STORAGE)
        .media_storage_sop_instance_uid("2.25.1");
    fluoroscopy().with_meta(meta).expect("meta").write_to_file(&path).expect("file");
    let error = read_frame(&path, None).expect_err("JPEG 2000 is not supported").to_string();
    assert!(error.contains("JPEG 2000") && error.contains("1.2.840.10008.1.2.4.91"), "{error}");

    std::fs::write(&path, b"hello, this is no image").expect("file");
    assert!(matches!(fault(&path), Fault::NotAnImage { .. }));
    assert!(matches!(read_frame(&folder.path().join("none.dcm"), None), Err(AcquireError::Io { .. })));
}

#[test]
fn tiff_and_png_take_their_meaning_from_the_sidecar_or_the_user() {
    let folder = folder();
    let path = folder.path().join("image.tif");
    let image = Image { width: 3, height: 2, pixels: vec![0.0, 0.25, 0.5, 0.75, 1.0, 1.5] };
    write_tiff_f32(&path, std::slice::from_ref(&image)).expect("written");
    let unknown = read_frame(&path, None).expect("readable");
    assert_eq!((unknown.domain, unknown.pixels.clone()), (Domain::Unknown, image.clone()));
    assert_eq!(read_frame(&path, Some(Domain::Log)).expect("readable").domain, Domain::Log);
    let quantities = [
        ("intensity", Domain::Linear),
        ("counts", Domain::Linear),
        ("line_integral", Domain::Log),
        ("scatter", Domain::Linear),
        ("area_density", Domain::Unknown),
        ("weather", Domain::Unknown),
    ];
    for (quantity, domain) in quantities {
        let sidecar = serde_json::json!({"quantity": quantity, "unit": "u", "detector": {"pitch_mm": 0.2}});
        std::fs::write(folder.path().join("image.tif.json"), sidecar.to_string()).expect("sidecar");
        let frame = read_frame(&path, None).expect("readable");
        assert_eq!(frame.domain, domain, "{quantity}");
        let is_named = frame.domain_evidence.iter().any(|line| line.ends_with(&format!("says quantity {quantity}")));
        assert_eq!(is_named, quantity != "weather", "{quantity}: {:?}", frame.domain_evidence);
        assert_eq!(frame.tags.pitch_mm, Some([0.2, 0.2]));
    }
    // By the names that `render` and others write.
    for (named, unit) in [("1 (unattenuated signal)", Some("1")), ("1", Some("1")), ("nepers", Some("neper")), ("furlongs", None)]
    {
        let sidecar = serde_json::json!({"quantity": "intensity", "unit": named});
        std::fs::write(folder.path().join("image.tif.json"), sidecar.to_string()).expect("sidecar");
        assert_eq!(read_frame(&path, None).expect("readable").unit.as_deref(), unit, "{named}");
    }
    std::fs::write(folder.path().join("image.tif.json"), "{").expect("sidecar");
    let damaged = read_frame(&path, None).expect("the image itself is sound");
    assert!(damaged.domain_evidence.iter().any(|line| line.contains("not valid JSON")), "{:?}", damaged.domain_evidence);

    let png = folder.path().join("grey.png");
    image::ImageBuffer::<image::Luma<u16>, _>::from_raw(2, 1, vec![7u16, 65535]).expect("two pixels").save(&png).expect("png");
    assert_eq!(read_frame(&png, None).expect("readable").pixels.pixels, [7.0, 65535.0]);
    let rgb = folder.path().join("colour.png");
    image::RgbImage::from_raw(1, 1, vec![1, 2, 3]).expect("one pixel").save(&rgb).expect("png");
    assert!(matches!(fault(&rgb), Fault::Colour { .. }));
}

#[test]
fn pixels_that_are_not_finite_are_masked_and_told() {
    let folder = folder();
    let path = folder.path().join("nan.tif");
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let image = Image { width: 2, height: 2, pixels: vec![0.0, 1.0, 2.0, bad] };
        write_tiff_f32(&path, &[image]).expect("written");
        let frame = read_frame(&path, None).expect("ordinary");
        assert!(frame.altered.iter().any(|words| words.contains("1 pixels (25.00 %)")), "{:?}", frame.altered);
        let masks = sidecarm::mask::of_frame(&frame);
        assert_eq!(masks.usable(2, 2, &[]).pixels, [true, true, true, false]);
        write_tiff_f32(&path, &[Image::filled(2, 2, bad)]).expect("written");
        let error = read_frame(&path, None).expect_err("nothing is there").to_string();
        assert!(error.contains("all 4 pixels"), "{error}");
    }
}

fn shared(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data").join(name);
    if path.exists() {
        return Some(path);
    }
    println!("skipped: {} is absent", path.display());
    None
}

#[test]
fn real_fluoroscopy_is_display() {
    let Some(folder) = shared("fluoroscopy-hip") else { return };
    for number in 1..=6 {
        let frame = read_frame(&folder.join(format!("frame-{number:02}.dcm")), None).expect("readable");
        assert_eq!(frame.domain, Domain::Display, "{:?}", frame.domain_evidence);
        assert!(!frame.inverted);
        assert_eq!(frame.size_px, [1024, 1024]);
        assert_eq!(frame.tags.sid_mm, Some(1000.0));
        assert!(frame.tags.kvp.is_some_and(|kvp| (74.0..=89.0).contains(&kvp)));
        assert!(frame.clipping.black_share > 0.1, "the area outside the intensifier");
    }
}

#[test]
fn real_radiographs_keep_air_bright_and_names_out() {
    let Some(folder) = shared("xray-cr") else { return };
    for name in ["chest-pa", "distal-tibia"] {
        let frame = read_frame(&folder.join(format!("{name}.dcm")), None).expect("readable");
        assert_eq!(frame.domain, Domain::Display, "{:?}", frame.domain_evidence);
        assert!(!frame.inverted, "MONOCHROME1 film values grow with exposure already");
        let shown = format!("{frame:?}");
        for secret in ["CompressedSamples", "RG1", "RG3", "19400305", "19790408", "Hamburg", "HIGASHI", "fibroma", "ward"] {
            assert!(!shown.contains(secret), "{secret} in {shown}");
        }
        assert_eq!(frame.tags.pitch_mm, None, "a pixel spacing of 0 is no pitch");
    }
}
