//! xReg's camera model: the datasets of its HDF5 group `cam-model`, under the same names, as JSON.
//!
//! The extrinsic maps lps millimetres to one of three camera frames, the centre of the first pixel is (0, 0):
//!
//! - `origin-at-focal-pt-det-pos-z`: +z to the detector, pixel ~ K p. This is our camera.
//! - `origin-at-focal-pt-det-neg-z`: +z to the source side, pixel ~ K p with negative focal lengths.
//! - `origin-on-det`: origin on the detector, +z to the source at the focal length f, pixel ~ K (x, y, f − z).
//!
//! In the last two x runs along columns, y along rows and z to the source, right-handed: seen from the source the picture is mirrored.
//! They are the cameras of our frame with its columns in reverse order, u' = (columns − 1) − u.

use glam::{DMat3, DQuat, DVec3};
use serde_json::{Map, Value, json};

use super::json::{number, object, present, rows};
use super::matrix::camera_of;
use super::numbers::{determinant_of, matrix, positive, rigid, size};
use super::{ExchangedCamera, Format, FormatError, XregFrame};
use crate::geometry::{Projection, Rigid};

const KEYS: [&str; 8] =
    ["xreg-type", "num-rows", "num-cols", "row-spacing", "col-spacing", "cam-coord-frame-type", "intrinsic", "extrinsic"];

pub(super) fn read(text: &str) -> Result<ExchangedCamera, FormatError> {
    let map = object(text, &KEYS)?;
    let needed = |key: &'static str| present(&map, key).ok_or(FormatError::MissingKey { key });
    let word = needed("cam-coord-frame-type")?.as_str().unwrap_or_default();
    let frame = XregFrame::ALL.into_iter().find(|frame| frame.name() == word).ok_or_else(|| FormatError::Unsupported {
        key: "cam-coord-frame-type".to_owned(),
        found: format!("`{word}`"),
        expected: "origin-at-focal-pt-det-pos-z, origin-at-focal-pt-det-neg-z or origin-on-det",
    })?;
    let size_px = size(number(needed("num-cols")?, "num-cols")?, number(needed("num-rows")?, "num-rows")?)?;
    let spacing = |key| positive(number(needed(key)?, key)?, key);
    let pitch_mm = [spacing("col-spacing")?, spacing("row-spacing")?];
    let k: [[f64; 3]; 3] = matrix(&rows(needed("intrinsic")?, "intrinsic")?, "intrinsic", "3 rows of 3 numbers")?;
    if k[2] != [0.0, 0.0, 1.0] || k[1][0] != 0.0 {
        let (what, found) = ("intrinsic".to_owned(), "not upper triangular".to_owned());
        return Err(FormatError::Shape { what, found, expected: "a last row of 0, 0, 1" });
    }
    let extrinsic = rigid(&rows(needed("extrinsic")?, "extrinsic")?, "extrinsic")?;
    let mut camera = camera_in(frame, &k, &extrinsic, size_px, pitch_mm)?;
    camera.size_px = Some(size_px);
    camera.pitch_mm = Some(pitch_mm);
    Ok(camera)
}

/// Our camera of an xReg one.
fn camera_in(
    frame: XregFrame,
    k: &[[f64; 3]; 3],
    extrinsic: &Rigid,
    size_px: [u32; 2],
    pitch_mm: [f64; 2],
) -> Result<ExchangedCamera, FormatError> {
    // Depth in front of the focal spot, positive towards the detector, is the third row of each.
    let e = extrinsic.to_rows();
    let [x, y, z] = [e[0], e[1], e[2]];
    let (x, y, depth, sign) = match frame {
        XregFrame::DetectorPositiveZ => (x, y, z, 1.0),
        XregFrame::DetectorNegativeZ => (x, y, z, -1.0),
        XregFrame::OriginOnDetector => {
            let focal_mm = 0.5 * ((k[0][0] * pitch_mm[0]).abs() + (k[1][1] * pitch_mm[1]).abs());
            (x, y, [-z[0], -z[1], -z[2], focal_mm - z[3]], 1.0)
        }
    };
    let entry = |i: usize, j: usize| sign * (k[i][0] * x[j] + k[i][1] * y[j] + k[i][2] * depth[j]);
    let mut p: [[f64; 4]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| entry(i, j)));
    let mirrored = determinant_of(&p.map(|row| [row[0], row[1], row[2]])) < 0.0;
    if mirrored {
        let last = f64::from(size_px[0]) - 1.0;
        p[0] = std::array::from_fn(|j| last * p[2][j] - p[0][j]);
    }
    let mut camera = camera_of(&Projection(p))?;
    if mirrored {
        let name = frame.name();
        camera
            .notes
            .push(format!("{name} sees the picture mirrored: the pose is for the frame with its columns in reverse order"));
    }
    Ok(camera)
}

pub(super) fn write(camera: &ExchangedCamera, frame: XregFrame) -> Result<String, FormatError> {
    let format = Format::Xreg(frame);
    let ours = camera.intrinsics_for(format)?;
    let [columns, rows] = camera.size_for(format)?;
    let [pitch, _] = camera.pitch_for(format)?;
    // Both focal lengths are the same distance: the pitch between rows follows.
    let pitch_mm = [pitch, pitch * ours.fx / ours.fy];
    let k = ours.to_rows();
    let flipped = |sign: f64| {
        let last = f64::from(columns) - 1.0;
        [[sign * ours.fx, -sign * ours.skew, last - ours.cx], [0.0, sign * ours.fy, ours.cy], k[2]]
    };
    // A half turn about y takes (X, Y, Z) to (−X, Y, −Z): with columns reversed, x runs along them again.
    let half_turn = Rigid::rotation(DQuat::from_mat3(&DMat3::from_diagonal(DVec3::new(-1.0, 1.0, -1.0))));
    let (intrinsic, extrinsic) = match frame {
        XregFrame::DetectorPositiveZ => (k, camera.camera_from_lps),
        XregFrame::DetectorNegativeZ => (flipped(-1.0), half_turn * camera.camera_from_lps),
        XregFrame::OriginOnDetector => {
            let from_focal_spot = Rigid::translation(DVec3::new(0.0, 0.0, ours.fx * pitch));
            (flipped(1.0), from_focal_spot * half_turn * camera.camera_from_lps)
        }
    };
    let mut map = Map::new();
    map.insert("xreg-type".to_owned(), json!("cam-model"));
    map.insert("num-rows".to_owned(), json!(rows));
    map.insert("num-cols".to_owned(), json!(columns));
    map.insert("row-spacing".to_owned(), json!(pitch_mm[1]));
    map.insert("col-spacing".to_owned(), json!(pitch_mm[0]));
    map.insert("cam-coord-frame-type".to_owned(), json!(frame.name()));
    map.insert("intrinsic".to_owned(), json!(intrinsic));
    map.insert("extrinsic".to_owned(), json!(extrinsic.to_rows()));
    Ok(format!("{:#}\n", Value::Object(map)))
}
