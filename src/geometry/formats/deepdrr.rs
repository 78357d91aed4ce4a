//! DeepDRR's `CameraProjection`: the JSON of its `get_config` and `from_config`.
//!
//! `intrinsic.data` is K, `extrinsic` is `camera3d_from_world` in mm, and camera3d is our camera. Two things differ: the world of a volume
//! loaded from NIfTI is RAS, and pixel n is cast through n + ½, so that the first pixel's centre is (½, ½) and the middle of a panel of n
//! pixels is n/2. DeepDRR holds matrices in single precision; the file does not.

use serde_json::{Map, Value, json};

use super::json::{check_keys, number, object, pitch_mm, present, rows, show_pitch};
use super::numbers::{camera, matrix, rigid, size};
use super::{ExchangedCamera, Format, FormatError};

/// Place of the first pixel's centre, along columns and rows.
const FIRST_PIXEL: f64 = 0.5;

pub(super) fn read(text: &str) -> Result<ExchangedCamera, FormatError> {
    let map = object(text, &["intrinsic", "extrinsic", "pixel_size"])?;
    let intrinsic = match present(&map, "intrinsic") {
        Some(Value::Object(inner)) => inner,
        Some(_) => {
            let (what, found) = ("intrinsic".to_owned(), "no object".to_owned());
            return Err(FormatError::Shape { what, found, expected: "an object with data, sensor_height and sensor_width" });
        }
        None => return Err(FormatError::MissingKey { key: "intrinsic" }),
    };
    check_keys(intrinsic, &["data", "sensor_height", "sensor_width"])?;
    let data = present(intrinsic, "data").ok_or(FormatError::MissingKey { key: "intrinsic.data" })?;
    let mut k: [[f64; 3]; 3] = matrix(&rows(data, "intrinsic.data")?, "intrinsic.data", "3 rows of 3 numbers")?;
    k[0][2] -= FIRST_PIXEL;
    k[1][2] -= FIRST_PIXEL;
    let extrinsic = present(&map, "extrinsic").ok_or(FormatError::MissingKey { key: "extrinsic" })?;
    let placed = rigid(&rows(extrinsic, "extrinsic")?, "extrinsic")?;
    let (intrinsics, camera_from_lps) = camera(&k, placed, "intrinsic.data")?;
    let size_px = match (present(intrinsic, "sensor_width"), present(intrinsic, "sensor_height")) {
        (Some(columns), Some(rows)) => Some(size(number(columns, "sensor_width")?, number(rows, "sensor_height")?)?),
        (None, None) => None,
        (None, _) => return Err(FormatError::MissingKey { key: "sensor_width" }),
        (_, None) => return Err(FormatError::MissingKey { key: "sensor_height" }),
    };
    let pitch_mm = present(&map, "pixel_size").map(|value| pitch_mm(value, "pixel_size")).transpose()?;
    Ok(ExchangedCamera { intrinsics: Some(intrinsics), size_px, pitch_mm, ..ExchangedCamera::placed(camera_from_lps) })
}

pub(super) fn write(camera: &ExchangedCamera) -> Result<String, FormatError> {
    let mut k = camera.intrinsics_for(Format::DeepDrr)?.to_rows();
    k[0][2] += FIRST_PIXEL;
    k[1][2] += FIRST_PIXEL;
    // Without the size DeepDRR would take twice the principal point for it.
    let [columns, rows] = camera.size_for(Format::DeepDrr)?;
    let mut map = Map::new();
    map.insert("intrinsic".to_owned(), json!({"data": k, "sensor_height": rows, "sensor_width": columns}));
    map.insert("extrinsic".to_owned(), json!(camera.camera_from_lps.to_rows()));
    if let Some(pitch_mm) = camera.pitch_mm {
        map.insert("pixel_size".to_owned(), show_pitch(pitch_mm));
    }
    Ok(format!("{:#}\n", Value::Object(map)))
}
