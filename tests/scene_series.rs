//! DICOM series: what makes a volume, what is refused and why, and that nothing says who was scanned.

use std::path::Path;
use std::process::Command;

use dicom_core::value::DataSetSequence;
use dicom_core::{DataElement, PrimitiveValue, VR};
use dicom_dictionary_std::{tags, uids};
use dicom_object::InMemDicomObject;
use glam::{DAffine3, DVec3};
use sidecarm::reporter::Reporter;
use sidecarm::scene::{VolumeFile, read_volume};

use crate::volume_files::{Sample, affine, number, put, save, save_series};

fn straight() -> DAffine3 {
    affine([DVec3::X, DVec3::Y, DVec3::Z], [2.0, 2.5, 5.0], DVec3::new(-6.0, -7.0, 990.0))
}

fn slices() -> Vec<InMemDicomObject> {
    Sample::block(straight()).slices()
}

fn read(path: &Path) -> Result<VolumeFile, String> {
    read_volume(path, &Reporter::silent()).map_err(|error| error.to_string())
}

fn place(slice: &mut InMemDicomObject, at: [f64; 3]) {
    put(slice, tags::IMAGE_POSITION_PATIENT, VR::DS, &at.map(|x| x.to_string()).join("\\"));
}

/// What is said of a folder of these slices.
fn refused(slices: &[InMemDicomObject]) -> String {
    let folder = tempfile::tempdir().expect("a folder");
    save_series(slices, folder.path());
    let error = read(folder.path()).expect_err("refused");
    assert!(error.starts_with(&folder.path().display().to_string()) && !error.contains('\n'), "{error}");
    for word in ["Quaxwelk", "Annegrund", "PFRIEMK", "2.25", "7777777"] {
        assert!(!error.contains(word), "{word}: {error}");
    }
    error
}

#[test]
fn slices_that_make_no_volume_are_one_sentence_each() {
    type Change = fn(&mut Vec<InMemDicomObject>);
    let cases: [(&str, Change, &[&str]); 15] = [
        (
            "a gap",
            |s| drop(s.remove(2)),
            &["missing, about 1", "10.000 mm lie between slices 2 and 3 of 4", "995.00 and 1005.00"],
        ),
        ("a single slice", |s| s.truncate(1), &["one slice", "two or more"]),
        (
            "uneven",
            |s| place(&mut s[2], [-6.0, -7.0, 1001.0]),
            &["unevenly spaced: 4.000 to 6.000 mm", "slice 3 of 5", "1.00 mm from its place"],
        ),
        (
            "tilt",
            |s| (0..5).for_each(|k| place(&mut s[k], [-6.0, -7.0 + k as f64, 990.0 + 5.0 * k as f64])),
            &["slant of 11.3 deg", "tilted gantry"],
        ),
        ("one aside", |s| place(&mut s[1], [-4.0, -7.0, 995.0]), &["2.00 mm from its place"]),
        (
            "two at one place",
            |s| place(&mut s[1], [-6.0, -7.0, 990.0]),
            &["1 of its 5 slices lie at the place of another", "990.00"],
        ),
        ("copies", |s| s.extend(s.clone()), &["5 of its 10 slices", "copies; remove them"]),
        (
            "size",
            |s| number(&mut s[4], tags::ROWS, 5),
            &["differ in size: 7 x 6 pixels and 7 x 5 pixels (1 of 5)", "export one reconstruction"],
        ),
        ("spacing", |s| put(&mut s[1], tags::PIXEL_SPACING, VR::DS, "2.6\\2"), &["pixel spacing", "2 x 2.6 mm"]),
        (
            "orientation",
            |s| put(&mut s[1], tags::IMAGE_ORIENTATION_PATIENT, VR::DS, "0.6\\0.8\\0\\-0.8\\0.6\\0"),
            &["orientation"],
        ),
        ("no place", |s| drop(s[3].take(tags::IMAGE_POSITION_PATIENT)), &["IM_0194 has no image position (0020,0032)"]),
        ("stretched", |s| put(&mut s[0], tags::IMAGE_ORIENTATION_PATIENT, VR::DS, "2\\0\\0\\0\\1\\0"), &["of length 2.0000"]),
        ("askew", |s| put(&mut s[0], tags::IMAGE_ORIENTATION_PATIENT, VR::DS, "1\\0\\0\\0.6\\0.8\\0"), &["not perpendicular"]),
        ("NaN", |s| put(&mut s[0], tags::IMAGE_POSITION_PATIENT, VR::DS, "nan\\0\\0"), &["has no image position"]),
        ("no slope", |s| put(&mut s[1], tags::RESCALE_SLOPE, VR::DS, "0"), &["slice 2 of 5", "rescale slope"]),
    ];
    for (what, change, words) in cases {
        let mut slices = slices();
        change(&mut slices);
        let error = refused(&slices);
        println!("{what}: {error}");
        assert!(words.iter().all(|word| error.contains(word)), "{what}: {words:?} in {error}");
    }
}

#[test]
fn rounding_of_positions_is_no_unevenness() {
    let folder = tempfile::tempdir().expect("a folder");
    let mut slices = slices();
    place(&mut slices[2], [-6.0, -7.0, 1000.05]);
    save_series(&slices, folder.path());
    let volume = read(folder.path()).expect("even but for rounding");
    assert_eq!(volume.lps_from_voxel, straight());
}

fn localizer() -> InMemDicomObject {
    let mut object = slices().remove(0);
    put(&mut object, tags::IMAGE_TYPE, VR::CS, "ORIGINAL\\PRIMARY\\LOCALIZER");
    put(&mut object, tags::SOP_INSTANCE_UID, VR::UI, "2.25.5");
    object
}

fn of_another_series(slices: &[InMemDicomObject]) -> Vec<InMemDicomObject> {
    let mut others = slices.to_vec();
    for slice in &mut others {
        put(slice, tags::SERIES_INSTANCE_UID, VR::UI, "2.25.8888888");
        put(slice, tags::SERIES_NUMBER, VR::IS, "4");
    }
    others
}

#[test]
fn other_files_of_the_folder_are_left_out_and_one_of_two_series_is_chosen_by_a_slice() {
    let folder = tempfile::tempdir().expect("a folder");
    let files = save_series(&slices(), folder.path());
    std::fs::write(folder.path().join("notes.txt"), "no slice").expect("written");
    std::fs::create_dir(folder.path().join("below")).expect("a folder");
    save(&localizer(), &folder.path().join("scout"));
    let mut report = localizer();
    put(&mut report, tags::SOP_CLASS_UID, VR::UI, uids::SECONDARY_CAPTURE_IMAGE_STORAGE);
    save(&report, &folder.path().join("report.dcm"));
    assert_eq!(read(folder.path()).expect("five slices").size, [7, 6, 5]);
    assert!(read(&folder.path().join("scout")).expect_err("a scout").contains("localizer (scout)"));
    assert!(read(&folder.path().join("report.dcm")).expect_err("a report").contains("no CT slice"));

    let others = of_another_series(&slices()[..3]);
    others.iter().enumerate().for_each(|(index, slice)| save(slice, &folder.path().join(format!("Mueller {index}"))));
    let error = read(folder.path()).expect_err("two series");
    for words in ["2 series", "number 3: 5 slices of 7 x 6, as IM_0003", "number 4: 3 slices", "name one file"] {
        assert!(error.contains(words), "{words}: {error}");
    }
    assert!(!error.contains("Mueller") && error.contains("file 6 by name"), "{error}");
    assert_eq!(read(&files[4]).expect("chosen").size, [7, 6, 5]);
    assert_eq!(read(&folder.path().join("Mueller 1")).expect("chosen").size, [7, 6, 3]);

    // A file that is damaged may be a slice.
    std::fs::write(folder.path().join("IM_9999.dcm"), "cut").expect("written");
    assert!(read(&files[4]).expect_err("damaged").contains("1 of 11 DICOM files of the folder are damaged"));
}

#[test]
fn folders_without_slices_and_slices_cut_short_are_said() {
    let folder = tempfile::tempdir().expect("a folder");
    assert!(read(folder.path()).expect_err("empty").contains("no DICOM file"));
    save_series(&slices(), &folder.path().join("below"));
    assert!(read(folder.path()).expect_err("below").contains("1 folders; name that of the slices"));
    save(&localizer(), &folder.path().join("scout.dcm"));
    assert!(read(folder.path()).expect_err("a scout").contains("no CT slice (1 DICOM files, 1 of them localizers)"));
    let files = save_series(&slices(), &folder.path().join("cut"));
    let bytes = std::fs::read(&files[2]).expect("bytes");
    std::fs::write(&files[2], &bytes[..bytes.len() - 20]).expect("cut");
    let error = read(&folder.path().join("cut")).expect_err("cut short");
    assert!(error.contains("slice 3 of 5: ") && error.contains("damaged or cut short"), "{error}");
}

/// Half of a series is a volume as well, and what is drawn of it looks whole.
#[test]
fn slices_of_the_series_in_a_folder_below_are_said() {
    let folder = tempfile::tempdir().expect("a folder");
    let (above, below) = (folder.path(), folder.path().join("more"));
    save_series(&slices()[..3], above);
    save_series(&slices()[3..], &below);
    assert!(read(above).expect_err("half").contains("2 more slices of this series lie in folders below"));
    // The same ones again, or those of another series, are no more of it.
    std::fs::remove_dir_all(&below).expect("removed");
    save_series(&slices()[..2], &below);
    save_series(&of_another_series(&slices()), &above.join("other"));
    assert_eq!(read(above).expect("three slices").size, [7, 6, 3]);
}

#[test]
fn every_slice_has_its_own_scale_and_padding_is_not_reconstructed() {
    let folder = tempfile::tempdir().expect("a folder");
    let sample = Sample::block(straight());
    let mut slices = slices();
    // Half the slope on twice the values; signed values of all sixteen bits.
    let slice = 7 * 6;
    let doubled: Vec<u16> = sample.hu[slice..2 * slice].iter().map(|hu| 2 * (hu + 1024) as u16).collect();
    put(&mut slices[1], tags::RESCALE_SLOPE, VR::DS, "0.5");
    number(&mut slices[1], tags::BITS_STORED, 16);
    number(&mut slices[1], tags::HIGH_BIT, 15);
    slices[1].put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(doubled.into())));
    let mut signed: Vec<u16> = sample.hu[2 * slice..3 * slice].iter().map(|hu| *hu as u16).collect();
    (signed[0], signed[1]) = ((-2000i16) as u16, (-1000i16) as u16);
    put(&mut slices[2], tags::RESCALE_INTERCEPT, VR::DS, "0");
    number(&mut slices[2], tags::PIXEL_REPRESENTATION, 1);
    number(&mut slices[2], tags::BITS_STORED, 16);
    number(&mut slices[2], tags::HIGH_BIT, 15);
    number(&mut slices[2], tags::PIXEL_PADDING_VALUE, 63536);
    slices[2].put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(signed.into())));
    // Padding that would pass for air.
    number(&mut slices[3], tags::PIXEL_PADDING_VALUE, 24);
    save_series(&slices, folder.path());
    let volume = read(folder.path()).expect("good");
    let mut expected: Vec<f32> = sample.hu.iter().map(|hu| f32::from(*hu)).collect();
    expected[2 * slice] = -2000.0;
    expected[3 * slice..4 * slice].iter_mut().filter(|hu| **hu == -1000.0).for_each(|hu| *hu = -2000.0);
    assert_eq!(volume.values, expected);

    put(&mut slices[0], tags::RESCALE_TYPE, VR::LO, "MGML");
    // Seven bits do not hold what is stored in sixteen.
    number(&mut slices[0], tags::BITS_STORED, 7);
    number(&mut slices[0], tags::HIGH_BIT, 6);
    slices[0].put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(vec![0x85; slice].into())));
    slices[4].take(tags::RESCALE_SLOPE);
    slices[4].take(tags::RESCALE_INTERCEPT);
    save_series(&slices, folder.path());
    let reporter = Reporter::silent();
    let volume = read_volume(folder.path(), &reporter).expect("good");
    assert_eq!(volume.values[4 * slice], 24.0, "as stored");
    assert_eq!(volume.values[0], 5.0 - 1024.0, "overlays are cut off");
    assert!(reporter.warnings()["stored bits"].latest.contains("42 voxels hold more"));
    assert_eq!(reporter.warnings().get("not HU").map(|counted| counted.count), Some(2));
}

/// One file with all slices, their places in its functional groups.
#[test]
fn an_enhanced_ct_is_read_as_its_slices_are() {
    let folder = tempfile::tempdir().expect("a folder");
    let sample = Sample::block(straight());
    let slices = slices();
    let item = |object: InMemDicomObject| DataSetSequence::from(vec![object]);
    let sequence = |tag, of: &InMemDicomObject, keep: &[dicom_core::Tag]| {
        let mut inside = InMemDicomObject::new_empty();
        keep.iter().for_each(|tag| drop(inside.put(of.element(*tag).expect("there").clone())));
        DataElement::new(tag, VR::SQ, item(inside))
    };
    let mut whole = slices[0].clone();
    let (mut groups, mut pixels) = (Vec::new(), Vec::new());
    // From the last to the first: their order is that of their places.
    for slice in slices.iter().rev() {
        let mut group = InMemDicomObject::new_empty();
        group.put(sequence(tags::PLANE_POSITION_SEQUENCE, slice, &[tags::IMAGE_POSITION_PATIENT]));
        let scale = [tags::RESCALE_SLOPE, tags::RESCALE_INTERCEPT];
        group.put(sequence(tags::PIXEL_VALUE_TRANSFORMATION_SEQUENCE, slice, &scale));
        groups.push(group);
        pixels.extend(slice.element(tags::PIXEL_DATA).expect("there").to_multi_int::<u16>().expect("numbers"));
    }
    let mut shared = InMemDicomObject::new_empty();
    shared.put(sequence(tags::PLANE_ORIENTATION_SEQUENCE, &slices[0], &[tags::IMAGE_ORIENTATION_PATIENT]));
    shared.put(sequence(tags::PIXEL_MEASURES_SEQUENCE, &slices[0], &[tags::PIXEL_SPACING]));
    for moved in [tags::IMAGE_POSITION_PATIENT, tags::IMAGE_ORIENTATION_PATIENT, tags::PIXEL_SPACING, tags::RESCALE_SLOPE] {
        whole.take(moved);
    }
    whole.take(tags::RESCALE_INTERCEPT);
    put(&mut whole, tags::SOP_CLASS_UID, VR::UI, uids::ENHANCED_CT_IMAGE_STORAGE);
    put(&mut whole, tags::NUMBER_OF_FRAMES, VR::IS, "5");
    whole.put(DataElement::new(tags::SHARED_FUNCTIONAL_GROUPS_SEQUENCE, VR::SQ, item(shared)));
    whole.put(DataElement::new(tags::PER_FRAME_FUNCTIONAL_GROUPS_SEQUENCE, VR::SQ, DataSetSequence::from(groups)));
    whole.put(DataElement::new(tags::PIXEL_DATA, VR::OW, PrimitiveValue::U16(pixels.into())));
    let path = folder.path().join("enhanced.dcm");
    save(&whole, &path);
    let volume = read(&path).expect("good");
    assert_eq!(volume.lps_from_voxel, sample.lps_from_voxel);
    assert_eq!(volume.values, sample.hu.iter().map(|hu| f32::from(*hu)).collect::<Vec<_>>());
}

/// Slices of one series by its number may be those of two patients, of two scans, or half of a scan: all of that was drawn without a word.
#[test]
fn what_headers_say_against_one_whole_scan_is_refused_or_said_without_a_name() {
    type Change = fn(&mut Vec<InMemDicomObject>);
    fn changed(change: Change) -> Vec<InMemDicomObject> {
        let mut slices = slices();
        change(&mut slices);
        slices
    }
    let mut cases = 0;
    for (change, words) in [
        ((|s| put(&mut s[4], tags::PATIENT_ID, VR::LO, "PFRIEMK-78")) as Change, "its slices are of 2 patients"),
        (
            |s| {
                s.iter_mut().for_each(|slice| put(slice, tags::FRAME_OF_REFERENCE_UID, VR::UI, "2.25.41"));
                put(&mut s[3], tags::FRAME_OF_REFERENCE_UID, VR::UI, "2.25.42");
            },
            "2 frames of reference (0020,0052)",
        ),
        (
            |s| {
                s.iter_mut().for_each(|slice| put(slice, tags::PATIENT_POSITION, VR::CS, "HFS"));
                put(&mut s[1], tags::PATIENT_POSITION, VR::CS, "FFP");
            },
            "2 postures of the patient (0018,5100)",
        ),
    ] {
        let error = refused(&changed(change));
        assert!(error.contains(words), "{words}: {error}");
        cases += 1;
    }
    let said = |slices: &[InMemDicomObject]| {
        let folder = tempfile::tempdir().expect("a folder");
        save_series(slices, folder.path());
        let reporter = Reporter::silent();
        read_volume(folder.path(), &reporter).unwrap_or_else(|error| panic!("{error}"));
        let said: Vec<String> =
            reporter.warnings().into_iter().map(|(kind, counted)| format!("{kind}: {}", counted.latest)).collect();
        for word in ["Quaxwelk", "Annegrund", "PFRIEMK", "2.25", "7777777"] {
            assert!(!said.concat().contains(word), "{word}: {said:?}");
        }
        said
    };
    // Slices that overlap, and a word that is left out of one: nothing to say.
    let usual = changed(|s| {
        for (k, slice) in s.iter_mut().enumerate() {
            put(slice, tags::SLICE_THICKNESS, VR::DS, "6");
            put(slice, tags::SPACING_BETWEEN_SLICES, VR::DS, "5");
            put(slice, tags::INSTANCE_NUMBER, VR::IS, &(9 - k).to_string());
            put(slice, tags::STUDY_INSTANCE_UID, VR::UI, "2.25.51");
            put(slice, tags::PATIENT_POSITION, VR::CS, "HFS");
        }
        s[2].take(tags::PATIENT_POSITION);
        s[3].take(tags::PATIENT_ID);
    });
    assert_eq!(said(&usual), Vec::<String>::new(), "the control");
    for (change, kind, words) in [
        ((|s| put(&mut s[4], tags::STUDY_INSTANCE_UID, VR::UI, "2.25.52")) as Change, "several studies", "of 2 studies"),
        (|s| put(&mut s[4], tags::SOP_INSTANCE_UID, VR::UI, "2.25.1001"), "same image", "1 of its 5 slices are the same image"),
        (|s| put(&mut s[0], tags::MODALITY, VR::CS, "MR"), "not HU", "1 of 5 files are of another modality"),
        (
            |s| put(&mut s[0], tags::IMAGE_TYPE, VR::CS, "DERIVED\\SECONDARY\\AXIAL\\CSA MIP"),
            "projections",
            "1 of 5 files are projections",
        ),
        (
            |s| s.iter_mut().for_each(|slice| put(slice, tags::SLICE_THICKNESS, VR::DS, "2.5")),
            "slices left out",
            "slices lie 5.000 mm apart, but are 2.500 mm thick (0018,0050)",
        ),
        (
            |s| s.iter_mut().for_each(|slice| put(slice, tags::SPACING_BETWEEN_SLICES, VR::DS, "2.5")),
            "slices left out",
            "but lie 2.500 mm apart by their own word (0018,0088)",
        ),
        (|s| put(&mut s[2], tags::RESCALE_INTERCEPT, VR::DS, "0"), "rescale", "1 of 5 slices jump"),
        (
            |s| {
                let own = |(k, slice)| put(slice, tags::FRAME_OF_REFERENCE_UID, VR::UI, &format!("2.25.7{k}"));
                s.iter_mut().enumerate().for_each(own);
            },
            "frames of reference",
            "a frame of reference of its own",
        ),
    ] {
        let mut slices = usual.clone();
        change(&mut slices);
        let said = said(&slices);
        let [only] = said.as_slice() else { panic!("{kind}: {said:?}") };
        assert!(only.starts_with(&format!("{kind}: ")) && only.contains(words), "{words}: {only}");
        cases += 1;
    }
    assert_eq!(cases, 11);
}

/// Through the program and its helper: `info` of a folder, of a slice, and of a slice whose series is no volume.
#[test]
fn info_tells_of_the_series_and_of_nobody() {
    let folder = tempfile::tempdir().expect("a folder");
    let files = save_series(&slices(), folder.path());
    let info = |path: &Path| {
        let output = Command::new(env!("CARGO_BIN_EXE_sidecarm")).arg("info").arg(path).arg("--json").output().expect("starts");
        let words = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
        for word in ["Quaxwelk", "Annegrund", "PFRIEMK", "2.25.", "7777777"] {
            assert!(!words.contains(word), "{word}: {words}");
        }
        (output.status.code(), words)
    };
    for path in [folder.path(), &files[1]] {
        let (code, words) = info(path);
        assert!(code == Some(0) && words.contains("DICOM series") && words.contains("\"LPS\""), "{code:?}: {words}");
    }
    std::fs::remove_file(&files[2]).expect("removed");
    let (code, words) = info(folder.path());
    assert!(code == Some(1) && words.contains("no volume: slices are missing"), "{code:?}: {words}");
    let (code, words) = info(&files[1]);
    assert!(code == Some(3) && words.contains("percentiles") && words.contains("slices are missing"), "{code:?}: {words}");
}
