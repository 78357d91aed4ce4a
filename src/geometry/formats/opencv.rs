//! OpenCV's `FileStorage` YAML: camera matrix, rotation vector, translation, image size.
//!
//! OpenCV's camera is ours: +z forward, x along columns, y along rows, the centre of the first pixel at (0, 0). `rvec` and `tvec` map
//! patient millimetres to it.

use glam::{DQuat, DVec3};

use super::numbers::{camera, matrix, positive, right_angled, rigid_of, show, size};
use super::yaml::{Node, parse, rows, scalar};
use super::{ExchangedCamera, Format, FormatError};
use crate::geometry::Rigid;

const CAMERA: [&str; 3] = ["camera_matrix", "cameraMatrix", "K"];
const DISTORTION: [&str; 4] = ["distortion_coefficients", "distCoeffs", "dist_coeffs", "D"];
const ROTATION: [&str; 2] = ["rvec", "R"];
const TRANSLATION: [&str; 2] = ["tvec", "T"];
const OWN: [&str; 4] = ["extrinsic_parameters", "image_width", "image_height", "pixel_pitch_mm"];
/// What OpenCV's own calibration programs write besides; no part of a pose.
const UNUSED: [&str; 18] = [
    "calibration_time",
    "nframes",
    "nr_of_frames",
    "board_width",
    "board_height",
    "square_size",
    "marker_size",
    "aspectRatio",
    "fix_aspect_ratio",
    "flags",
    "fisheye_model",
    "avg_reprojection_error",
    "per_view_reprojection_errors",
    "image_points",
    "grid_points",
    "rms",
    "projection_matrix",
    "rectification_matrix",
];

pub(super) fn read(text: &str) -> Result<ExchangedCamera, FormatError> {
    let found = parse(text)?;
    let known: Vec<&str> = [&CAMERA[..], &DISTORTION, &ROTATION, &TRANSLATION, &OWN].concat();
    if let Some((key, _)) = found.iter().find(|(key, _)| !known.contains(&key.as_str()) && !UNUSED.contains(&key.as_str())) {
        return Err(FormatError::UnknownKey { key: key.clone(), expected: known.join(", ") });
    }
    let one = |keys: &[&str]| -> Result<Option<(&str, &Node)>, FormatError> {
        let mut matching = found.iter().filter(|(key, _)| keys.contains(&key.as_str()));
        let first = matching.next();
        match matching.next() {
            Some((key, _)) => Err(FormatError::TwiceKey { key: key.clone() }),
            None => Ok(first.map(|(key, node)| (key.as_str(), node))),
        }
    };
    let (key, node) = one(&CAMERA)?.ok_or(FormatError::MissingKey { key: "camera_matrix" })?;
    let k: [[f64; 3]; 3] = matrix(rows(node, key)?, key, "3 rows of 3 numbers")?;
    if let Some((key, node)) = one(&DISTORTION)?
        && rows(node, key)?.iter().flatten().any(|value| *value != 0.0)
    {
        let expected = "zero: a projection matrix has no distortion, undistort the frame first";
        return Err(FormatError::Unsupported { key: key.to_owned(), found: "not zero".to_owned(), expected });
    }
    let placed = match (one(&["extrinsic_parameters"])?, one(&ROTATION)?, one(&TRANSLATION)?) {
        (Some((key, node)), None, None) => {
            let listed = rows(node, key)?;
            if listed.len() > 1 {
                return Err(FormatError::Several { found: listed.len() });
            }
            let [row]: [[f64; 6]; 1] = matrix(listed, key, "1 row of 6 numbers: rotation vector, translation")?;
            turned([row[0], row[1], row[2]], [row[3], row[4], row[5]])
        }
        (Some(_), Some((key, _)), _) | (Some(_), None, Some((key, _))) => {
            return Err(FormatError::TwiceKey { key: key.to_owned() });
        }
        (None, Some((rotation_key, rotation)), Some((key, translation))) => {
            let t = vector(rows(translation, key)?, key)?;
            let rotation = rows(rotation, rotation_key)?;
            if rotation.len() == 3 && rotation[0].len() == 3 {
                let r: [[f64; 3]; 3] = matrix(rotation, rotation_key, "3 rows of 3 numbers")?;
                rigid_of(&std::array::from_fn(|i| [r[i][0], r[i][1], r[i][2], t[i]]), "R")?
            } else {
                turned(vector(rotation, rotation_key)?, t)
            }
        }
        (None, None, _) => return Err(FormatError::MissingKey { key: "rvec" }),
        (None, Some(_), None) => return Err(FormatError::MissingKey { key: "tvec" }),
    };
    let (intrinsics, camera_from_lps) = camera(&k, placed, "camera_matrix")?;
    right_angled(&intrinsics, RIGHT_ANGLES)?;
    let value = |key: &str| one(&[key])?.map(|(key, node)| scalar(node, key)).transpose();
    let size_px = match (value("image_width")?, value("image_height")?) {
        (Some(columns), Some(rows)) => Some(size(columns, rows)?),
        (None, None) => None,
        (None, _) => return Err(FormatError::MissingKey { key: "image_width" }),
        (_, None) => return Err(FormatError::MissingKey { key: "image_height" }),
    };
    let pitch_mm = match one(&["pixel_pitch_mm"])? {
        Some((key, node)) => {
            let [[x, y]]: [[f64; 2]; 1] = matrix(rows(node, key)?, key, "1 row of 2 numbers")?;
            Some([positive(x, key)?, positive(y, key)?])
        }
        None => None,
    };
    Ok(ExchangedCamera { intrinsics: Some(intrinsics), size_px, pitch_mm, ..ExchangedCamera::placed(camera_from_lps) })
}

/// Three numbers, as a row or as a column.
fn vector(rows: &[Vec<f64>], key: &str) -> Result<[f64; 3], FormatError> {
    let flat: Vec<f64> = rows.iter().flatten().copied().collect();
    if rows.len() > 1 && rows.iter().any(|row| row.len() != 1) {
        let [row]: [[f64; 3]; 1] = matrix(rows, key, "3 numbers, as a row or as a column")?;
        return Ok(row);
    }
    let [row] = matrix(&[flat], key, "3 numbers, as a row or as a column")?;
    Ok(row)
}

fn turned(rvec: [f64; 3], tvec_mm: [f64; 3]) -> Rigid {
    Rigid { rotation: DQuat::from_scaled_axis(DVec3::from_array(rvec)), translation_mm: DVec3::from_array(tvec_mm) }
}

/// The rotation vector of at most half a turn; small turns keep all digits.
fn rotation_vector(rotation: DQuat) -> DVec3 {
    let rotation = if rotation.w < 0.0 { -rotation } else { rotation };
    let sine = rotation.xyz().length();
    // angle / sin(angle / 2) tends to 2 at zero.
    let factor = if sine < 1e-8 { 2.0 } else { 2.0 * sine.atan2(rotation.w) / sine };
    rotation.xyz() * factor
}

/// OpenCV passes over what stands between the axes in K: P would be another one there.
const RIGHT_ANGLES: &str = "0: OpenCV takes the axes of a camera to be at right angles";

pub(super) fn write(camera: &ExchangedCamera) -> Result<String, FormatError> {
    let k = camera.intrinsics_for(Format::OpenCv)?;
    right_angled(&k, RIGHT_ANGLES)?;
    let k = k.to_rows();
    let mut text = "%YAML:1.0\n---\n# rvec, tvec: patient mm to the camera; first pixel's centre at (0, 0)\n".to_owned();
    let mut dense = |key: &str, rows: usize, columns: usize, values: &[f64]| {
        let data = values.iter().map(|value| decimal(*value)).collect::<Vec<_>>().join(", ");
        text += &format!("{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n");
    };
    dense("camera_matrix", 3, 3, k.as_flattened());
    dense("distortion_coefficients", 5, 1, &[0.0; 5]);
    dense("rvec", 3, 1, &rotation_vector(camera.camera_from_lps.rotation).to_array());
    dense("tvec", 3, 1, &camera.camera_from_lps.translation_mm.to_array());
    if let Some(pitch_mm) = camera.pitch_mm {
        dense("pixel_pitch_mm", 1, 2, &pitch_mm);
    }
    if let Some([columns, rows]) = camera.size_px {
        text += &format!("image_width: {columns}\nimage_height: {rows}\n");
    }
    Ok(text)
}

/// A number that OpenCV takes for a real one: with a point or an exponent.
fn decimal(value: f64) -> String {
    let text = show(value);
    if text.contains(['.', 'e']) { text } else { text + "." }
}
