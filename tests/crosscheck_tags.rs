//! Filter and field: what telemetry, the frame's tags, its pixels and the scene say of them, each against the others.

use dicom_core::{DataElement, PrimitiveValue, Tag, VR};
use dicom_dictionary_std::tags;
use sidecarm::acquire::{
    CollimatorShape, CollimatorTags, Domain, FilterForm, FilterLayer, FilterMaterial, FilterTags, Frame, FrameTags, read_frame,
};
use sidecarm::geometry::{CarmCalibration, ConsoleGeometry};
use sidecarm::image::Image;
use sidecarm::session::crosscheck::{Finding, Level};
use sidecarm::telemetry::CarmSample;

use crate::acquire_frames::{fluoroscopy, save};
use crate::crosscheck_facts::{calibration, exposure, exposure_of};

fn filter(layers: &[(FilterMaterial, [f64; 2])]) -> Option<FilterTags> {
    let layers = layers.iter().map(|(material, mm)| FilterLayer { material: *material, thickness_mm: Some(*mm) }).collect();
    Some(FilterTags { form: None, layers })
}

/// One warning of `check` is found, in a sentence that has all `words`.
fn warns_once(check: &str, found: &[Finding], words: &[&str]) {
    assert_eq!(found.len(), 1, "{words:?}: {found:#?}");
    let sentence = found[0].to_string();
    assert!(found[0].check == check && found[0].level == Level::Warn, "{sentence}");
    assert!(words.iter().all(|word| sentence.contains(word)), "{words:?} in {sentence}");
}

/// A console that puts copper into the beam by itself, and telemetry that knows nothing of it: only the scene was compared, with telemetry.
#[test]
fn telemetry_s_filter_is_held_against_the_frame_s_tags_and_a_silent_side_says_nothing() {
    use FilterMaterial::{Aluminum, Copper, Lead};
    type Change = fn(&mut FrameTags, &mut CarmSample);
    let with = |change: Change| exposure(|f, b, _, _| change(&mut f.tags, b));
    let cases: [(Change, &[&str]); 6] = [
        (
            |t, _| t.filter = filter(&[(Copper, [0.2; 2])]),
            &["telemetry says 0.00 mm of copper", "tags say 0.20 mm", "belongs to this exposure", "send NaN"],
        ),
        (
            |t, b| (t.filter, b.filter_mm_cu) = (filter(&[(Copper, [0.1; 2]), (Copper, [0.2; 2])]), 0.9),
            &["telemetry says 0.90 mm of copper", "tags say 0.30 mm"],
        ),
        (
            |t, b| {
                t.filter = Some(FilterTags { form: Some(FilterForm::NoFilter), layers: Vec::new() });
                b.filter_mm_cu = 0.3;
            },
            &["telemetry says 0.30 mm of copper", "tags say 0.00 mm"],
        ),
        (|t, _| t.filter = filter(&[(Aluminum, [9.0; 2])]), &["telemetry says 4.30 mm of aluminium", "tags say 9.00 mm"]),
        (|t, _| t.filter = filter(&[(Copper, [0.4, 0.9])]), &["telemetry says 0.00 mm of copper", "tags say 0.40 to 0.90 mm"]),
        // As `check` has it for the newest frame in the folder: nothing was heard of the arm yet.
        (
            |t, b| (t.filter, b.filter_mm_cu) = (filter(&[(Copper, [0.2; 2])]), f64::NAN),
            &["the frame's tags say 0.20 mm of copper", "the scene renders 0.00 mm", "beam.filtration_mm.copper"],
        ),
    ];
    for (change, words) in cases {
        warns_once("filter", &with(change), words);
    }
    let silent: [Change; 10] = [
        |t, _| t.filter = None,
        |t, b| (t.filter, b.filter_mm_al, b.filter_mm_cu) = (None, f64::NAN, f64::NAN),
        // The same sheet, rounded.
        |t, _| t.filter = filter(&[(Copper, [0.0, 0.04])]),
        |t, _| t.filter = filter(&[(Aluminum, [4.25, 4.35])]),
        // Zeros where the console does not know, and a wedge that telemetry's value lies in.
        |t, _| t.filter = filter(&[(Copper, [0.0; 2]), (Aluminum, [0.0; 2])]),
        |t, _| t.filter = filter(&[(Copper, [0.0, 0.6])]),
        // What is fixed in the housing counts with one of the two.
        |t, _| t.filter = filter(&[(Aluminum, [1.0; 2])]),
        |t, b| (t.filter, b.filter_mm_al) = (filter(&[(Aluminum, [1.0; 2])]), f64::NAN),
        // Telemetry has no word for lead, and a material alone is no thickness.
        |t, _| t.filter = filter(&[(Lead, [2.0; 2])]),
        |t, _| {
            let layers = vec![FilterLayer { material: FilterMaterial::Copper, thickness_mm: None }];
            t.filter = Some(FilterTags { form: Some(FilterForm::Flat), layers });
        },
    ];
    for (case, change) in silent.into_iter().enumerate() {
        assert_eq!(with(change), Vec::new(), "case {case}");
    }
}

fn edges(edges_px: [f64; 4]) -> Option<CollimatorTags> {
    let shapes = vec![CollimatorShape::Rectangular];
    Some(CollimatorTags { shapes, edges_px: Some(edges_px), ..CollimatorTags::default() })
}

fn iris(shapes: &[CollimatorShape], edges_px: Option<[f64; 4]>, radius_px: f64) -> Option<CollimatorTags> {
    let (centre_px, radius_px) = (Some([31.5, 24.5]), Some(radius_px));
    Some(CollimatorTags { shapes: shapes.to_vec(), edges_px, centre_px, radius_px, corners_px: Vec::new() })
}

/// A panel of 186 x 144 mm whose left shutter is 33 mm in, by telemetry, tags and pixels; the findings after `change`.
fn collimated(change: impl FnOnce(&mut Frame, &mut CarmSample, &mut f64)) -> Vec<Finding> {
    let carm = CarmCalibration { pitch_mm: 3.0, ..calibration() };
    exposure_of(&carm, |f, b, _, s| {
        f.tags.pitch_mm = Some([3.0; 2]);
        f.tags.collimator = edges([12.0, 1.0, 62.0, 48.0]);
        f.tags.field_of_view_mm = Some([186.0, 144.0]);
        (b.field_mm, *s) = ([-60.0, -72.0, 93.0, 72.0], 33.0 / 186.0);
        change(f, b, s);
    })
}

#[test]
fn telemetry_s_field_is_held_against_the_frame_s_tags_and_a_silent_side_says_nothing() {
    use CollimatorShape::{Circular, Polygonal, Rectangular};
    type Change = fn(&mut Frame, &mut CarmSample, &mut f64);
    let cases: [(Change, &[&str]); 6] = [
        // The frame was taken with all shutters open.
        (
            |f, _, _| f.tags.collimator = edges([1.0, 1.0, 62.0, 48.0]),
            &["the left shutter at -60 mm", "tags have it at -93 mm", "in mm at the detector"],
        ),
        // Telemetry's field is another: the pixels would tell as well, but not which shutter.
        (
            |_, b, _| b.field_mm = [-60.0, -72.0, 45.0, 72.0],
            &["the right shutter at +45 mm", "tags have it at +93 mm", "belongs to this exposure"],
        ),
        // Shutters within an iris that no tag has.
        (
            |f, b, s| {
                f.tags.collimator = iris(&[Circular], None, 20.0);
                (b.field_mm, *s) = ([-30.0, -72.0, 93.0, 72.0], 63.0 / 186.0);
            },
            &["the left shutter at -30 mm", "tags have it at -60 mm"],
        ),
        // Between the iris and the shutters that the tags have, telemetry's could be anywhere; beyond them not.
        (
            |f, b, s| {
                f.tags.collimator = iris(&[Rectangular, Circular], Some([12.0, 1.0, 62.0, 48.0]), 10.0);
                (b.field_mm, *s) = ([-93.0, -72.0, 93.0, 72.0], 0.0);
            },
            &["the left shutter at -93 mm", "tags have it at -60 mm"],
        ),
        // The console shows the middle of the panel, enlarged.
        (
            |f, _, _| f.tags.field_of_view_mm = Some([100.0, 100.0]),
            &["covers 153 x 144 mm", "shows 100 x 100 mm", "declare `console`"],
        ),
        // Mirrored at import, the tags are those of the file.
        (|f, _, _| f.unmirrored = true, &["shutter at", "mm from the panel's middle"]),
    ];
    for (change, words) in cases {
        warns_once("field", &collimated(change), words);
    }
    let silent: [Change; 14] = [
        |_, _, _| (),
        |f, _, _| (f.tags.collimator, f.tags.field_of_view_mm) = (None, None),
        // Shutters beyond the panel are as open as those at its edge.
        |f, b, s| {
            f.tags.collimator = edges([-40.0, 0.0, 90.0, 49.0]);
            (b.field_mm, *s) = ([-400.0, -72.0, 93.0, f64::INFINITY], 0.0);
        },
        // Within 2 % of the distance to the detector.
        |f, _, _| f.tags.collimator = edges([6.0, 1.0, 62.0, 48.0]),
        // Not measured at all, and one shutter that is not.
        |_, b, _| b.field_mm = [f64::NAN; 4],
        |f, b, _| (f.tags.field_of_view_mm, b.field_mm) = (Some([100.0; 2]), [f64::NAN, -72.0, 93.0, 72.0]),
        |_, b, s| (b.field_mm, *s) = ([f64::NAN; 4], 0.6),
        // Zeros in place of a field; the pixels are all behind shutters, too.
        |_, b, s| (b.field_mm, *s) = ([0.0; 4], 1.0),
        // Row and column exchanged, and a field that is smaller than the picture.
        |f, _, _| f.tags.field_of_view_mm = Some([144.0, 186.0]),
        |f, b, s| {
            (f.tags.collimator, f.tags.field_of_view_mm) = (None, Some([186.0, 144.0]));
            (b.field_mm, *s) = ([-20.0, -20.0, 20.0, 20.0], 0.94);
        },
        // An iris within open shutters, alone and beside them, and one around all.
        |f, _, _| f.tags.collimator = iris(&[Circular], None, 12.0),
        |f, _, _| f.tags.collimator = iris(&[Rectangular, Circular], Some([12.0, 1.0, 62.0, 48.0]), 12.0),
        // A polygon is no box.
        |f, _, _| f.tags.collimator = iris(&[Polygonal, Rectangular], Some([1.0, 1.0, 30.0, 48.0]), 12.0),
        // Mirrored at import: the shutter is on the other side of the file's picture.
        |f, _, _| (f.unmirrored, f.tags.collimator) = (true, edges([1.0, 1.0, 51.0, 48.0])),
    ];
    for (case, change) in silent.into_iter().enumerate() {
        assert_eq!(collimated(change), Vec::new(), "case {case}");
    }
}

/// Tags are in the pixels of the file, telemetry in mm of the panel: between them lies what the console did.
#[test]
fn the_field_of_a_turned_and_of_a_cropped_picture_is_found_on_the_panel() {
    let turned = |edges_px| {
        collimated(|f, _, _| {
            // Clockwise: the panel's left side is the picture's top.
            let console = ConsoleGeometry { rotation_deg: 90.0, ..ConsoleGeometry::default() };
            let stored = Frame::from_pixels("turned", Image::filled(48, 62, 1.0f32), Domain::Linear).expect("finite");
            let tags = FrameTags { collimator: edges(edges_px), ..f.tags.clone() };
            *f = Frame { tags, ..stored.oriented(&console, Some([62, 48])) };
        })
    };
    assert_eq!(turned([1.0, 12.0, 48.0, 62.0]), Vec::new());
    assert_eq!(turned([12.0, 1.0, 48.0, 62.0]).len(), 1, "control: as if it had not been turned");

    let console = ConsoleGeometry { crop_px: Some([20, 0, 42, 48]), ..ConsoleGeometry::default() };
    let panel = CarmCalibration { pitch_mm: 3.0, ..calibration() };
    let carm = console.calibration_of(&panel, [42, 48]).expect("fits");
    let cropped = |console: &ConsoleGeometry, left_px: f64| {
        exposure_of(&carm, |f, b, _, s| {
            let stored = Frame::from_pixels("cropped", Image::filled(42, 48, 1.0f32), Domain::Linear).expect("finite");
            let tags = FrameTags {
                pitch_mm: Some([3.0; 2]),
                collimator: edges([left_px, 1.0, 42.0, 48.0]),
                field_of_view_mm: Some([126.0, 144.0]),
                ..f.tags.clone()
            };
            *f = Frame { tags, ..stored.oriented(console, Some([62, 48])) };
            // One column of the crop, which begins 33 mm left of the panel's middle.
            (b.field_mm, *s) = ([-30.0, -72.0, 93.0, 72.0], 1.0 / 42.0);
        })
    };
    assert_eq!(cropped(&console, 2.0), Vec::new());
    assert_eq!(cropped(&console, 12.0).len(), 1, "control: 30 mm further in");
    let elsewhere = ConsoleGeometry { crop_px: Some([0, 0, 42, 48]), ..ConsoleGeometry::default() };
    assert_eq!(cropped(&elsewhere, 2.0).len(), 1, "control: of another part of the panel");
}

#[test]
fn filter_and_field_are_read_as_terms_and_numbers_alone() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let read = |values: &[(Tag, VR, &str)]| {
        let mut object = fluoroscopy();
        for (tag, vr, value) in values {
            object.put(DataElement::new(*tag, *vr, PrimitiveValue::from(*value)));
        }
        let frame = read_frame(&save(object, &folder.path().join("a.dcm")), None).expect("readable");
        let json = serde_json::to_value(&frame).expect("JSON");
        assert_eq!(serde_json::from_value::<FrameTags>(json["tags"].clone()).expect("own JSON"), frame.tags);
        (frame.tags, json)
    };
    let (told, json) = read(&[
        (tags::FILTER_TYPE, VR::SH, "FLAT"),
        (tags::FILTER_MATERIAL, VR::CS, "COPPER\\ALUMINUM"),
        (tags::FILTER_THICKNESS_MINIMUM, VR::DS, "0.19\\1"),
        (tags::FILTER_THICKNESS_MAXIMUM, VR::DS, "0.21\\1"),
        (tags::COLLIMATOR_SHAPE, VR::CS, "RECTANGULAR\\CIRCULAR"),
        (tags::COLLIMATOR_LEFT_VERTICAL_EDGE, VR::IS, "1"),
        (tags::COLLIMATOR_RIGHT_VERTICAL_EDGE, VR::IS, "4"),
        (tags::COLLIMATOR_UPPER_HORIZONTAL_EDGE, VR::IS, "0"),
        (tags::COLLIMATOR_LOWER_HORIZONTAL_EDGE, VR::IS, "3"),
        (tags::CENTER_OF_CIRCULAR_COLLIMATOR, VR::IS, "2\\3"),
        (tags::RADIUS_OF_CIRCULAR_COLLIMATOR, VR::IS, "2"),
        (tags::FIELD_OF_VIEW_DIMENSIONS, VR::IS, "100\\150"),
    ]);
    let layers = filter(&[(FilterMaterial::Copper, [0.19, 0.21]), (FilterMaterial::Aluminum, [1.0; 2])]).expect("made").layers;
    assert_eq!(told.filter, Some(FilterTags { form: Some(FilterForm::Flat), layers }));
    assert_eq!(
        told.collimator,
        Some(CollimatorTags {
            shapes: vec![CollimatorShape::Rectangular, CollimatorShape::Circular],
            edges_px: Some([1.0, 0.0, 4.0, 3.0]),
            centre_px: Some([3.0, 2.0]),
            radius_px: Some(2.0),
            corners_px: Vec::new(),
        }),
        "DICOM gives the row first"
    );
    assert_eq!(told.field_of_view_mm, Some([150.0, 100.0]), "DICOM gives the row dimension first");
    assert_eq!([&json["tags"]["filter"]["form"], &json["tags"]["filter"]["layers"][0]["material"]], ["FLAT", "COPPER"]);

    let (told, json) = read(&[
        (tags::FILTER_TYPE, VR::SH, "CU_0.2 Krummholz"),
        (tags::FILTER_MATERIAL, VR::CS, "WEIDENBART\\COPPER"),
        (tags::FILTER_THICKNESS_MAXIMUM, VR::DS, "0.1\\0.2"),
        (tags::COLLIMATOR_SHAPE, VR::CS, "HERR SCHLOTTER"),
        (tags::COLLIMATOR_LEFT_VERTICAL_EDGE, VR::IS, "Quendel"),
        (tags::CENTER_OF_CIRCULAR_COLLIMATOR, VR::IS, "18151210\\1"),
        (tags::FIELD_OF_VIEW_DIMENSIONS, VR::IS, "0\\0"),
    ]);
    let one_unknown = filter(&[(FilterMaterial::Other, [0.1; 2]), (FilterMaterial::Copper, [0.2; 2])]);
    assert_eq!(told.filter, one_unknown, "the second thickness is the second material's");
    let notes = json["notes"].to_string();
    assert!(notes.contains("(0018,7050) has 1 of 2 words that are no filter material of the standard"), "{notes}");
    // As consoles write them, beside the standard's terms; and nothing but a word that nobody knows.
    let (told, _) = read(&[(tags::FILTER_MATERIAL, VR::CS, "Cu\\ALUMINIUM")]);
    let materials = told.filter.map(|filter| filter.layers.iter().map(|layer| layer.material).collect::<Vec<_>>());
    assert_eq!(materials, Some(vec![FilterMaterial::Copper, FilterMaterial::Aluminum]));
    let (told, unknown) = read(&[(tags::FILTER_MATERIAL, VR::CS, "WEIDENBART")]);
    let layers = vec![FilterLayer { material: FilterMaterial::Other, thickness_mm: None }];
    assert_eq!(told.filter, Some(FilterTags { form: None, layers }));
    assert!(unknown["notes"].to_string().contains("1 of 1 words") && !unknown.to_string().contains("WEIDENBART"), "{unknown}");
    assert_eq!((told.collimator, told.field_of_view_mm), (None, None));
    let shown = json.to_string().to_lowercase();
    for secret in ["krummholz", "weidenbart", "schlotter", "quendel", "18151210"] {
        assert!(!shown.contains(secret), "{secret} in {shown}");
    }
    assert!(shown.contains("copper"), "control: what is kept is found");

    // "None" beside a material is of wedges; alone it is of all that can be put into the beam.
    let none = |material: &str| read(&[(tags::FILTER_TYPE, VR::SH, "NONE"), (tags::FILTER_MATERIAL, VR::CS, material)]).0.filter;
    assert_eq!(none(""), Some(FilterTags { form: Some(FilterForm::NoFilter), layers: Vec::new() }));
    assert!(none("COPPER").is_some_and(|filter| filter.form.is_none() && filter.layers[0].thickness_mm.is_none()));

    let (told, json) = read(&[
        (tags::SHUTTER_SHAPE, VR::CS, "POLYGONAL\\BITMAP"),
        (tags::VERTICES_OF_THE_POLYGONAL_SHUTTER, VR::IS, "1\\2\\1\\4\\2\\3"),
        (tags::SHUTTER_LEFT_VERTICAL_EDGE, VR::IS, "3"),
        (tags::VERTICES_OF_THE_POLYGONAL_COLLIMATOR, VR::IS, "1\\2\\1\\4\\2"),
        (tags::PIXEL_ASPECT_RATIO, VR::IS, "12\\11"),
        (tags::ESTIMATED_RADIOGRAPHIC_MAGNIFICATION_FACTOR, VR::DS, "1.5"),
        (tags::X_RAY_RECEPTOR_TYPE, VR::CS, "IMG_INTENSIFIER"),
        (tags::DETECTOR_TYPE, VR::CS, "SCINTILLATOR"),
        (tags::FIELD_OF_VIEW_SHAPE, VR::CS, "QUENDEL"),
    ]);
    let shutter = told.display_shutter.expect("a display shutter");
    assert_eq!(shutter.shapes, [CollimatorShape::Polygonal, CollimatorShape::Bitmap]);
    assert_eq!(
        (shutter.corners_px, shutter.edges_px),
        (vec![[2.0, 1.0], [4.0, 1.0], [3.0, 2.0]], None),
        "DICOM gives the row first"
    );
    assert_eq!(told.collimator, None, "half a corner is none");
    assert_eq!((told.pixel_aspect, told.magnification), (Some([11.0, 12.0]), Some(1.5)), "DICOM gives the height first");
    assert_eq!((told.receptor.as_deref(), told.detector_type.as_deref()), (Some("IMG_INTENSIFIER"), Some("SCINTILLATOR")));
    assert!(told.field_of_view_shape.is_none() && !json.to_string().contains("QUENDEL"), "{json}");

    let (_, json) = read(&[]);
    let keys = json["tags"].as_object().expect("an object");
    assert!(
        ["filter", "collimator", "display_shutter", "receptor", "pixel_aspect", "field_of_view_mm"]
            .iter()
            .all(|key| !keys.contains_key(*key)),
        "{keys:?}"
    );
}
