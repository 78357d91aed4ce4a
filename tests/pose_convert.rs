//! Poses in other tools' formats: against numbers and files that the tools made themselves (`tests/data/pose_convert/make.py`), there and
//! back, in all octants and patient positions, and what is refused.

use glam::{DQuat, DVec2, DVec3};
use serde_json::Value;
use sidecarm::geometry::formats::{ExchangedCamera, Format, Known, PatientAxes, XregFrame, read, recognise, write};
use sidecarm::geometry::{Intrinsics, Projection, Rigid};

/// Numbers of a file below `tests/data/pose_convert`.
pub fn data(name: &str) -> Value {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/pose_convert/").to_owned() + name;
    serde_json::from_str(&std::fs::read_to_string(path).expect("reference file")).expect("JSON")
}

/// A value of a reference file.
pub fn get<T: serde::de::DeserializeOwned>(value: &Value, key: &str) -> T {
    serde_json::from_value(value[key].clone()).unwrap_or_else(|error| panic!("{key}: {error}"))
}

/// The asymmetric phantom that every tool projected.
pub fn phantom(file: &Value) -> Vec<DVec3> {
    get::<Vec<[f64; 3]>>(file, "phantom_lps_mm").into_iter().map(DVec3::from_array).collect()
}

fn camera(case: &Value) -> ExchangedCamera {
    let pitch: f64 = get(case, "pitch_mm");
    ExchangedCamera {
        intrinsics: Some(get(case, "intrinsics")),
        size_px: Some(get(case, "size_px")),
        pitch_mm: Some([pitch, pitch]),
        ..ExchangedCamera::placed(get(case, "camera_from_lps"))
    }
}

/// What a caller may know besides the file.
pub fn known(camera: &ExchangedCamera) -> Known {
    Known { intrinsics: camera.intrinsics, size_px: camera.size_px, pitch_mm: camera.pitch_mm }
}

fn cases(file: &Value) -> &[Value] {
    let cases = file["cases"].as_array().expect("cases");
    assert_eq!(cases.len(), 8);
    cases
}

/// Largest difference of two projections, relative to the largest entry.
fn difference(a: &ExchangedCamera, b: &ExchangedCamera) -> f64 {
    let (a, b) = (a.projection().expect("K is known").0, b.projection().expect("K is known").0);
    let largest = a.iter().flatten().fold(0.0f64, |largest, x| largest.max(x.abs()));
    a.iter().flatten().zip(b.iter().flatten()).map(|(x, y)| (x - y).abs() / largest).fold(0.0, f64::max)
}

fn worst_px(projection: &Projection, phantom: &[DVec3], pixels: &[[f64; 2]]) -> f64 {
    assert_eq!(phantom.len(), pixels.len());
    let off = phantom.iter().zip(pixels).map(|(point, pixel)| {
        let (found, depth) = projection.project(*point);
        assert!(depth > 0.0, "{point} lies behind the source");
        found.distance(DVec2::from_array(*pixel))
    });
    off.fold(0.0, f64::max)
}

/// Reads what a tool wrote, compares the camera with the one it was given, and our pixels with the tool's.
fn agrees(file: &str, text: impl Fn(&Value) -> String, format: Format, pixels: &str, relative: f64, px: f64) {
    let file = data(file);
    let phantom = phantom(&file);
    for (n, case) in cases(&file).iter().enumerate() {
        let truth = camera(case);
        let text = text(case);
        assert_eq!(recognise(&text, ""), Some(format), "case {n}");
        let found = read(format, &text, format.usual_axes(), &known(&truth)).unwrap_or_else(|error| panic!("case {n}: {error}"));
        let off = difference(&truth, &found);
        assert!(off <= relative, "case {n}: P off by {off:.2e}");
        if format != Format::Slicer {
            let seen = worst_px(&found.projection().expect("K"), &phantom, &get::<Vec<[f64; 2]>>(case, pixels));
            assert!(seen <= px, "case {n}: {seen} px");
        }
        assert_eq!(found.size_px, truth.size_px);
    }
}

#[test]
fn files_that_opencv_wrote_are_the_cameras_it_was_given() {
    agrees("opencv.json", |case| get(case, "yaml"), Format::OpenCv, "image_px", 1e-9, 1e-8);
}

#[test]
fn files_that_rtk_wrote_draw_spheres_where_we_project_them() {
    // RTK prints 15 digits; its drawn shadows are centres of mass of sampled spheres.
    agrees("rtk.json", |case| get(case, "xml"), Format::Rtk, "drawn_px", 1e-9, 0.05);
}

#[test]
fn configurations_of_deepdrr_project_where_deepdrr_does() {
    // DeepDRR holds K in single precision (6e-8) and computes in it: 500 px of 24 bits, a few operations.
    agrees("deepdrr.json", |case| case["config"].to_string(), Format::DeepDrr, "image_px", 1e-7, 2e-4);
}

#[test]
fn transforms_that_itk_wrote_map_points_as_itk_does() {
    agrees("itk.json", |case| get(case, "tfm"), Format::Slicer, "", 1e-9, 0.0);
    let file = data("itk.json");
    for case in cases(&file) {
        let found = read(Format::Slicer, &get::<String>(case, "tfm"), PatientAxes::Lps, &Known::default()).expect("a transform");
        for (point, mapped) in phantom(&file).iter().zip(get::<Vec<[f64; 3]>>(case, "mapped_mm")) {
            let off = found.camera_from_lps.transform_point(*point).distance(DVec3::from_array(mapped));
            assert!(off <= 1e-9, "{off} mm");
        }
        assert!(found.intrinsics.is_none());
    }
}

#[test]
fn the_tools_read_what_we_write() {
    let file = data("read_by_tools.json");
    let phantom = phantom(&file);
    for (n, case) in cases(&file).iter().enumerate() {
        let camera = camera(case);
        let projection = camera.projection().expect("K");
        let texts: std::collections::BTreeMap<String, String> = get(case, "texts");
        let pairs = [("yml", Format::OpenCv), ("xml", Format::Rtk), ("tfm", Format::Slicer), ("deepdrr.json", Format::DeepDrr)];
        for (ending, format) in pairs {
            let written = write(format, &camera, format.usual_axes()).expect("can be written");
            assert_eq!(
                written, texts[ending],
                "case {n}: {format} is no longer what the tool has read; make the reference again"
            );
        }
        for (tool, px) in [("opencv", 1e-8), ("rtk", 1e-8), ("deepdrr", 2e-4)] {
            let off = worst_px(&projection, &phantom, &get::<Vec<[f64; 2]>>(&case[tool], "image_px"));
            assert!(off <= px, "case {n}: {tool} is {off} px off");
        }
        for tool in ["opencv", "deepdrr"] {
            assert_eq!(Some(get::<[u32; 2]>(&case[tool], "size_px")), camera.size_px);
        }
        let source = camera.camera_from_lps.inverse().translation_mm;
        assert!(source.distance(DVec3::from_array(get(&case["rtk"], "source_mm"))) <= 1e-8);
        assert_eq!(case["itk"]["class"], "AffineTransform");
        for (point, mapped) in phantom.iter().zip(get::<Vec<[f64; 3]>>(&case["itk"], "mapped_mm")) {
            assert!(camera.camera_from_lps.transform_point(*point).distance(DVec3::from_array(mapped)) <= 1e-9);
        }
    }
}

/// SplitMix64 as numbers in [−1, 1).
pub struct Draw(pub u64);

impl Draw {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    /// A camera, turned anyhow or as said.
    pub fn camera(&mut self, turn: Option<DQuat>) -> ExchangedCamera {
        let free = DQuat::from_xyzw(self.next(), self.next(), self.next(), self.next()).normalize();
        let pitch = 0.3 + 0.2 * self.next();
        let fx = (1000.0 + 200.0 * self.next()) / pitch;
        let size_px = [600 + (100.0 * self.next()) as u32, 500 + (100.0 * self.next()) as u32];
        let intrinsics = Intrinsics {
            fx,
            fy: fx * (1.0 + 0.05 * self.next()),
            skew: 0.0,
            cx: 300.0 + 30.0 * self.next(),
            cy: 250.0 + 30.0 * self.next(),
        };
        let translation_mm = DVec3::new(40.0 * self.next(), 40.0 * self.next(), 600.0 + 100.0 * self.next());
        ExchangedCamera {
            intrinsics: Some(intrinsics),
            size_px: Some(size_px),
            pitch_mm: Some([pitch, pitch * intrinsics.fx / intrinsics.fy]),
            ..ExchangedCamera::placed(Rigid { rotation: turn.unwrap_or(free), translation_mm })
        }
    }
}

/// A camera seen in a mirror: its columns in reverse order.
fn columns_reversed(point: DVec2, size_px: [u32; 2]) -> DVec2 {
    DVec2::new(f64::from(size_px[0]) - 1.0 - point.x, point.y)
}

#[test]
fn every_format_gives_back_what_it_was_given() {
    let mut draw = Draw(9);
    let half = std::f64::consts::FRAC_PI_2;
    // Turns at which angles are not unique, rotation vectors reach half a turn, or a camera is not turned at all.
    let special = [
        DQuat::IDENTITY,
        DQuat::from_rotation_x(half),
        DQuat::from_rotation_x(-half) * DQuat::from_rotation_y(0.3),
        DQuat::from_rotation_y(half),
        DQuat::from_xyzw(0.0, 1.0, 0.0, 0.0),
        DQuat::from_scaled_axis(DVec3::new(1e-10, -2e-10, 1e-10)),
    ];
    let turns = special.into_iter().map(Some).chain(std::iter::repeat_n(None, 200));
    let mut worst = 0.0f64;
    for turn in turns {
        let truth = draw.camera(turn);
        for format in Format::ALL {
            for axes in [PatientAxes::Lps, PatientAxes::Ras] {
                let text = write(format, &truth, axes).expect("can be written");
                let recognised = recognise(&text, "").expect("is recognised");
                assert_eq!(std::mem::discriminant(&recognised), std::mem::discriminant(&format), "{format}");
                // What a format keeps must come from the file, what it loses from elsewhere.
                let help = if format.loses().is_some() { known(&truth) } else { Known::default() };
                let help = if matches!(format, Format::Matrix | Format::Kr | Format::Rtk) {
                    Known { intrinsics: None, ..help }
                } else {
                    help
                };
                let found = read(format, &text, axes, &help).unwrap_or_else(|error| panic!("{format}: {error}\n{text}"));
                let off = difference(&truth, &found);
                assert!(off <= 1e-9, "{format}, {axes:?}: {off:.2e}\n{text}");
                worst = worst.max(off);
                assert_eq!(found.size_px, truth.size_px, "{format}");
                let pitches = found.pitch_mm.into_iter().flatten().zip(truth.pitch_mm.into_iter().flatten());
                assert_eq!(pitches.filter(|(a, b)| (a / b - 1.0).abs() <= 1e-9).count(), 2, "{format}");
            }
        }
    }
    assert!(worst > 0.0, "some rounding must have been seen");
}

/// Beside millimetres a tiny turn vanishes in P, so it is looked at by itself.
#[test]
fn a_turn_of_a_billionth_is_kept_by_the_rotation_vector() {
    let vector = DVec3::new(1e-9, -2e-9, 3e-9);
    let camera = Draw(2).camera(Some(DQuat::from_xyzw(0.5 * vector.x, 0.5 * vector.y, 0.5 * vector.z, 1.0)));
    let text = write(Format::OpenCv, &camera, PatientAxes::Lps).expect("can be written");
    let found = read(Format::OpenCv, &text, PatientAxes::Lps, &Known::default()).expect("can be read");
    let back = 2.0 * found.camera_from_lps.rotation.xyz();
    assert!(back.distance(vector) <= 1e-9 * vector.length(), "{back}");
}

#[test]
fn the_wrong_axes_are_another_camera() {
    let truth = Draw(3).camera(None);
    for format in Format::ALL {
        let text = write(format, &truth, PatientAxes::Lps).expect("can be written");
        let found = read(format, &text, PatientAxes::Ras, &known(&truth)).expect("can be read");
        assert!(difference(&truth, &found) > 1e-3, "{format}");
    }
}

/// xReg's own formula, pixel ~ K p (or K (x, y, f − z)), from its published header, taken literally.
fn xreg_pixel(text: &str, frame: XregFrame, p_in_lps: DVec3) -> DVec2 {
    let file: Value = serde_json::from_str(text).expect("JSON");
    let k: [[f64; 3]; 3] = get(&file, "intrinsic");
    let e: [[f64; 4]; 4] = get(&file, "extrinsic");
    let mut p: [f64; 3] = std::array::from_fn(|i| e[i][0] * p_in_lps.x + e[i][1] * p_in_lps.y + e[i][2] * p_in_lps.z + e[i][3]);
    let focal_mm = k[0][0].abs() * get::<f64>(&file, "col-spacing");
    match frame {
        XregFrame::DetectorPositiveZ => assert!(p[2] > 0.0),
        XregFrame::DetectorNegativeZ => assert!(p[2] < 0.0 && k[0][0] < 0.0 && k[1][1] < 0.0),
        XregFrame::OriginOnDetector => {
            assert!(p[2] > 0.0 && p[2] < focal_mm, "between detector and source");
            p[2] = focal_mm - p[2];
        }
    }
    let h: [f64; 3] = k.map(|row| row[0] * p[0] + row[1] * p[1] + row[2] * p[2]);
    DVec2::new(h[0] / h[2], h[1] / h[2])
}

#[test]
fn the_three_frames_of_xreg_see_the_phantom_by_its_own_formula() {
    let phantom = phantom(&data("opencv.json"));
    let mut draw = Draw(5);
    for _ in 0..20 {
        let mut camera = draw.camera(None);
        if let Some(k) = &mut camera.intrinsics {
            k.skew = 3.0;
        }
        let size_px = camera.size_px.expect("size");
        for frame in [XregFrame::DetectorPositiveZ, XregFrame::DetectorNegativeZ, XregFrame::OriginOnDetector] {
            let text = write(Format::Xreg(frame), &camera, PatientAxes::Lps).expect("can be written");
            for point in &phantom {
                let (ours, _) = camera.projection().expect("K").project(*point);
                let expected = if frame == XregFrame::DetectorPositiveZ { ours } else { columns_reversed(ours, size_px) };
                let off = xreg_pixel(&text, frame, *point).distance(expected);
                assert!(off <= 1e-8, "{frame:?}: {off} px");
            }
            let found = read(Format::Xreg(frame), &text, PatientAxes::Lps, &Known::default()).expect("can be read");
            assert!(difference(&camera, &found) <= 1e-9);
            assert_eq!(found.notes.is_empty(), frame == XregFrame::DetectorPositiveZ, "a mirrored picture is said");
        }
    }
}

/// The nominal camera of a Cios Fusion as xReg's source states it (xregCIOSFusionDICOM.cpp): 1020 mm, 0.194 mm, 1536 pixels, isocentre at the origin.
#[test]
fn the_published_cios_camera_of_xreg_is_read() {
    let text = r#"{"num-rows": 1536, "num-cols": 1536, "row-spacing": 0.194, "col-spacing": 0.194,
        "cam-coord-frame-type": "origin-at-focal-pt-det-neg-z",
        "intrinsic": [[-5257.731958762887, 0, 767.5], [0, -5257.731958762887, 767.5], [0, 0, 1]],
        "extrinsic": [[0.0014173902529073, 0.0000057733016248, 0.9999990957527923, -157.5822163123799555],
                      [-0.9999907608500266, -0.0040758357952800, 0.0014174006256202, -2.6757496083693013],
                      [0.0040758413782892, -0.9999918324063819, 0.0, -631.7764689585426368], [0, 0, 0, 1]]}"#;
    assert_eq!(recognise(text, ""), Some(Format::Xreg(XregFrame::DetectorPositiveZ)));
    let found = read(Format::Xreg(XregFrame::DetectorPositiveZ), text, PatientAxes::Lps, &Known::default()).expect("a camera");
    let projection = found.projection().expect("K");
    let (centre, depth) = projection.project(DVec3::ZERO);
    // By hand: −5257.73 · (−157.58)/(−631.78) + 767.5 = −543.9, and columns reversed 1535 + 543.9.
    let u = -5257.731958762887 * -157.582_216_312_379_96 / -631.776_468_958_542_6 + 767.5;
    let v = -5257.731958762887 * -2.675_749_608_369_301_3 / -631.776_468_958_542_6 + 767.5;
    assert!((depth - 631.776_468_958_542_6).abs() < 1e-6);
    // The published matrix is rounded to sixteen decimals, its rotation is made orthonormal on reading.
    assert!(centre.distance(DVec2::new(1535.0 - u, v)) < 1e-4, "{centre} {u} {v}");
    assert!(found.notes[0].contains("reverse order"));
}

#[test]
fn both_focal_lengths_negative_are_a_half_turn_and_no_mirror() {
    let upright = "1000 0 300\n0 1000 200\n0 0 1\n1 0 0 5\n0 1 0 7\n0 0 1 600\n";
    let turned = "-1000 0 300\n0 -1000 200\n0 0 1\n-1 0 0 -5\n0 -1 0 -7\n0 0 1 600\n";
    let read = |text| read(Format::Kr, text, PatientAxes::Lps, &Known::default()).expect("a camera");
    assert!(difference(&read(upright), &read(turned)) <= 1e-12);
}

#[test]
fn a_projection_of_any_positive_scale_is_read_and_a_negative_one_is_not_guessed() {
    let camera = Draw(8).camera(None);
    let rows = camera.projection().expect("K").0;
    let text = |scale: f64| rows.map(|row| row.map(|x| (scale * x).to_string()).join(", ")).join("\n");
    let found = read(Format::Matrix, &text(0.01), PatientAxes::Lps, &Known::default()).expect("a camera");
    assert!(difference(&camera, &found) <= 1e-9);
    let json = serde_json::to_string(&rows).expect("JSON");
    let found = read(Format::Matrix, &json, PatientAxes::Lps, &Known::default()).expect("a camera");
    assert!(difference(&camera, &found) <= 1e-9);
    let error = read(Format::Matrix, &text(-0.01), PatientAxes::Lps, &Known::default()).expect_err("negative depth");
    assert!(error.to_string().contains("multiply all of it by -1"));
}
