//! Poses in other tools' formats: what is refused, and in which words.

use sidecarm::geometry::Intrinsics;
use sidecarm::geometry::formats::{ExchangedCamera, Format, FormatError, Known, PatientAxes, XregFrame, read, write};

use crate::pose_convert::{Draw, known};

fn refused(format: Format, text: &str) -> FormatError {
    let known = Known { size_px: Some([620, 480]), pitch_mm: Some([0.2, 0.2]), ..Known::default() };
    match read(format, text, PatientAxes::Lps, &known) {
        Err(error) => error,
        Ok(_) => panic!("{format} is read, but should be refused:\n{text}"),
    }
}

#[test]
fn mirrored_cameras_are_refused_in_every_format() {
    let camera = Draw(4).camera(None);
    let mut seen = 0;
    for format in [Format::Matrix, Format::Kr, Format::KrJson, Format::OpenCv, Format::DeepDrr, Format::Slicer] {
        let good = write(format, &camera, PatientAxes::Lps).expect("can be written");
        let k = camera.intrinsics.expect("K");
        let bad = match format {
            // The first row of P, of R, or the first focal length with its sign reversed.
            Format::Matrix => {
                let rows = camera.projection().expect("K").0;
                let line = |row: [f64; 4], sign: f64| row.map(|x| (sign * x).to_string()).join(" ") + "\n";
                line(rows[0], -1.0) + &line(rows[1], 1.0) + &line(rows[2], 1.0)
            }
            Format::Slicer => {
                let line = good.lines().find(|line| line.starts_with("Parameters")).expect("parameters");
                let words: Vec<&str> = line.split(' ').collect();
                let flipped = words.iter().enumerate().map(|(n, word)| {
                    if (1..4).contains(&n) { format!("{}", -word.parse::<f64>().expect("a number")) } else { (*word).to_owned() }
                });
                good.replace(line, &flipped.collect::<Vec<_>>().join(" "))
            }
            _ => good.replacen(&format!("{}", k.fx), &format!("{}", -k.fx), 1),
        };
        assert_ne!(good, bad, "{format}");
        assert!(read(format, &good, PatientAxes::Lps, &known(&camera)).is_ok(), "{format}");
        let error = refused(format, &bad);
        assert!(matches!(error, FormatError::Mirrored { .. }), "{format}: {error}");
        seen += 1;
    }
    assert_eq!(seen, 6);
}

#[test]
fn wrong_shapes_words_keys_and_numbers_are_named() {
    let camera = Draw(6).camera(None);
    let yaml = write(Format::OpenCv, &camera, PatientAxes::Lps).expect("yaml");
    let xml = write(Format::Rtk, &camera, PatientAxes::Lps).expect("xml");
    let tfm = write(Format::Slicer, &camera, PatientAxes::Lps).expect("tfm");
    let dd = write(Format::DeepDrr, &camera, PatientAxes::Lps).expect("json");
    let xreg_format = Format::Xreg(XregFrame::DetectorPositiveZ);
    let xreg = write(xreg_format, &camera, PatientAxes::Lps).expect("json");
    let kr = write(Format::KrJson, &camera, PatientAxes::Lps).expect("json");
    let element = |key: &str, value: &str| {
        let start = xml.find(&format!("<{key}>")).expect("has the element") + key.len() + 2;
        let end = start + xml[start..].find('<').expect("ends");
        format!("{}{value}{}", &xml[..start], &xml[end..])
    };
    let cases: Vec<(Format, String, &str)> = vec![
        (Format::Matrix, "1 2 3\n4 5 6\n7 8 9\n".into(), "P is 3 rows of 3 numbers, expected 3 rows of 4 numbers"),
        (Format::Matrix, "1 0 0 0\n0 1 0 0\n0 0 nan 1\n".into(), "P holds a number that is not finite"),
        (Format::Matrix, "1 0 0 0\n0 1 0 0\n0 0 one 1\n".into(), "`one` is not a number"),
        (Format::Matrix, "1 0 0 0\n0 1 0 0\n1 1 0 1\n".into(), "singular"),
        (Format::Matrix, String::new(), "P is 0 rows of no numbers"),
        (Format::Kr, "1 0 0\n0 1 0\n0 0 1\n".into(), "K with [R|t] is 3 rows"),
        (Format::Kr, "9 0 0\n0 9 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1.1 9\n".into(), "not rigid"),
        (Format::Kr, "9 0 0\n1 9 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 9\n".into(), "not upper triangular"),
        (Format::Kr, "9 0 0\n0 9 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 9\n1 0 0 1\n".into(), "last row"),
        (Format::KrJson, kr.replacen("\"t\"", "\"tt\"", 1), "unknown key `tt`"),
        (Format::KrJson, kr.replacen("\"t\": [", "\"t\": [1.0,", 1), "4 numbers"),
        (Format::OpenCv, yaml.replacen("rvec:", "rvecs:", 1), "unknown key `rvecs`"),
        (Format::OpenCv, yaml.replacen("0., 0., 0., 0., 0.", "0.1, 0., 0., 0., 0.", 1), "undistort the frame first"),
        (
            Format::OpenCv,
            yaml.replacen("0., 0., 0., 0., 0.", "0., 0., 0., 0.", 1),
            "distortion_coefficients is 5x1 with 4 numbers",
        ),
        (Format::OpenCv, yaml.replacen("0., 0., 0., 0., 0.", ".Nan, 0., 0., 0., 0.", 1), "not finite"),
        (Format::OpenCv, yaml.replacen("image_width", "ignored", 1), "unknown key `ignored`"),
        (
            Format::OpenCv,
            yaml.lines().filter(|line| !line.starts_with("image_width")).collect::<Vec<_>>().join("\n"),
            "has no image_width",
        ),
        (Format::Rtk, xml.replace("SourceOffsetX", "SourceShiftX"), "unknown key `SourceShiftX`"),
        (Format::Rtk, element("SourceToDetectorDistance", "0"), "parallel beams"),
        (Format::Rtk, element("SourceToIsocenterDistance", "600.123"), "Matrix and parameters differ"),
        (Format::Rtk, element("InPlaneAngle", "nan"), "InPlaneAngle holds a number that is not finite"),
        (Format::Rtk, element("GantryAngle", "left"), "GantryAngle: `left` is not a number"),
        (Format::Rtk, xml.replace("version=\"3\"", "version=\"1\""), "version is 1, expected 2 or 3"),
        (Format::Rtk, xml.replace("<Projection>", "<Projection></Projection><Projection>"), "holds 2 projections"),
        (Format::Rtk, xml[..xml.len() / 2].to_owned(), "not an RTK geometry"),
        (Format::DeepDrr, dd.replacen("sensor_width", "sensor_breadth", 1), "unknown key `sensor_breadth`"),
        (Format::DeepDrr, dd.replacen("\"extrinsic\"", "\"extrinsics\"", 1), "unknown key `extrinsics`"),
        (Format::DeepDrr, r#"{"intrinsic": {"data": [[NaN]]}, "extrinsic": []}"#.into(), "not finite"),
        (Format::DeepDrr, "[]".into(), "not a JSON object"),
        (xreg_format, xreg.replacen("det-pos-z", "det-up", 1), "cam-coord-frame-type is `origin-at-focal-pt-det-up`"),
        (xreg_format, xreg.replacen("\"num-cols\"", "\"num-columns\"", 1), "unknown key `num-columns`"),
        (
            Format::Slicer,
            tfm.replace("AffineTransform_double_3_3", "BSplineTransform_double_3_3"),
            "Transform is BSplineTransform",
        ),
        (Format::Slicer, tfm.replace("FixedParameters: 0 0 0", "FixedParameters: 0 0"), "FixedParameters is 2 numbers"),
        (Format::Slicer, tfm.clone() + "Transform: AffineTransform_double_3_3\n", "holds 2 projections"),
        (Format::Slicer, "Transform: x\n".into(), "not an ITK transform"),
    ];
    let count = cases.len();
    for (n, (format, text, words)) in cases.into_iter().enumerate() {
        let found = refused(format, &text).to_string();
        assert!(found.contains(words), "{n}: {format}: `{found}` does not say `{words}`");
        assert!(!found.contains('\n'), "one sentence: {found}");
    }
    assert_eq!(count, 35);
}

#[test]
fn what_a_format_cannot_know_must_be_given() {
    let camera = Draw(7).camera(None);
    let xml = write(Format::Rtk, &camera, PatientAxes::Lps).expect("xml");
    let error = read(Format::Rtk, &xml, PatientAxes::Lps, &Known::default()).expect_err("no size");
    assert!(error.to_string().contains("--intrinsics K.json with size_px"), "{error}");
    let bare = ExchangedCamera::placed(camera.camera_from_lps);
    let mut refused = 0;
    for format in Format::ALL {
        match write(format, &bare, PatientAxes::Lps) {
            Ok(_) => assert_eq!(format, Format::Slicer),
            Err(error) => {
                assert!(error.to_string().contains("needs K; give --intrinsics K.json"), "{error}");
                refused += 1;
            }
        }
    }
    assert_eq!(refused, 9);
    let skewed = ExchangedCamera { intrinsics: camera.intrinsics.map(|k| Intrinsics { skew: 1.0, ..k }), ..camera.clone() };
    assert!(write(Format::Rtk, &skewed, PatientAxes::Lps).expect_err("skew").to_string().contains("skew is 1"));
    // OpenCV computes as if there were none.
    assert!(write(Format::OpenCv, &skewed, PatientAxes::Lps).expect_err("skew").to_string().contains("skew is 1"));
    let text = write(Format::OpenCv, &camera, PatientAxes::Lps).expect("written");
    let row = text.lines().find(|line| line.contains("data: [")).expect("K");
    let mut numbers: Vec<&str> = row.split(", ").collect();
    numbers[1] = "30.";
    let text = text.replace(row, &numbers.join(", "));
    let error = read(Format::OpenCv, &text, PatientAxes::Lps, &Known::default()).expect_err("skew");
    assert!(error.to_string().contains("skew is 30"), "{error}");
}
