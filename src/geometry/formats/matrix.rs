//! P as three rows of four numbers; K with \[R|t\] as rows or as JSON.

use serde_json::{Value, json};

use super::json::{list, object, pitch_mm, present, rows as json_rows, show_pitch, size_px};
use super::numbers::{camera, determinant_of, line, matrix, rigid, rigid_of, rotation_rows, rows};
use super::{ExchangedCamera, Format, FormatError};
use crate::geometry::Projection;

const THREE_BY_FOUR: &str = "3 rows of 4 numbers";
const THREE_BY_THREE: &str = "3 rows of 3 numbers";

pub(super) fn read_projection(text: &str) -> Result<ExchangedCamera, FormatError> {
    let found = if text.trim_start().starts_with('[') {
        let value: Value = serde_json::from_str(text)
            .map_err(|error| FormatError::Syntax { expected: "rows of numbers", detail: error.to_string() })?;
        json_rows(&value, "P")?
    } else {
        rows(text, "P")?
    };
    camera_of(&Projection(matrix(&found, "P", THREE_BY_FOUR)?))
}

/// K and pose of a P whose third coordinate is a positive multiple of the depth.
///
/// P and −P draw the same picture, and only the sign tells a mirrored picture of what lies in front from an upright one of what lies
/// behind. A negative sign is therefore refused rather than guessed away.
pub(super) fn camera_of(projection: &Projection) -> Result<ExchangedCamera, FormatError> {
    if !projection.0.iter().flatten().all(|value| value.is_finite()) {
        return Err(FormatError::NotFinite { what: "P".to_owned() });
    }
    let determinant = determinant_of(&projection.0.map(|row| [row[0], row[1], row[2]]));
    if determinant < 0.0 {
        let hint = "; if only its sign is reversed (third coordinate negative in front of the source), multiply all of it by -1";
        return Err(FormatError::Mirrored { what: "P", determinant, hint });
    }
    let (intrinsics, camera_from_lps) = projection.decompose()?;
    Ok(ExchangedCamera { intrinsics: Some(intrinsics), ..ExchangedCamera::placed(camera_from_lps) })
}

pub(super) fn write_projection(camera: &ExchangedCamera) -> Result<String, FormatError> {
    let projection = Projection::compose(&camera.intrinsics_for(Format::Matrix)?, &camera.camera_from_lps);
    let mut text = "# P: patient mm to pixels (column, row, 1) times depth in mm; centre of the first pixel (0, 0)\n".to_owned();
    for row in projection.0 {
        text += &format!("{}\n", line(&row));
    }
    Ok(text)
}

pub(super) fn read_kr(text: &str) -> Result<ExchangedCamera, FormatError> {
    let found = rows(text, "K with [R|t]")?;
    if !(found.len() == 6 || found.len() == 7) {
        let what = "K with [R|t]".to_owned();
        let found = format!("{} rows", found.len());
        return Err(FormatError::Shape { what, found, expected: "3 rows of 3 numbers (K), then 3 of 4 ([R|t])" });
    }
    let (k, rt) = found.split_at(3);
    let (intrinsics, camera_from_lps) = camera(&matrix(k, "K", THREE_BY_THREE)?, rigid(rt, "[R|t]")?, "K")?;
    Ok(ExchangedCamera { intrinsics: Some(intrinsics), ..ExchangedCamera::placed(camera_from_lps) })
}

pub(super) fn write_kr(camera: &ExchangedCamera) -> Result<String, FormatError> {
    let mut text = "# K, px; centre of the first pixel (0, 0)\n".to_owned();
    for row in camera.intrinsics_for(Format::Kr)?.to_rows() {
        text += &format!("{}\n", line(&row));
    }
    text += "# [R|t]: patient mm to camera mm (+z to the detector, +x along columns, +y along rows)\n";
    for row in &camera.camera_from_lps.to_rows()[..3] {
        text += &format!("{}\n", line(row));
    }
    Ok(text)
}

const KR_KEYS: [&str; 9] = ["intrinsics", "K", "camera_from_lps", "extrinsics", "Rt", "R", "t", "size_px", "pitch_mm"];

pub(super) fn read_kr_json(text: &str) -> Result<ExchangedCamera, FormatError> {
    let map = object(text, &KR_KEYS)?;
    let one = |keys: &[&'static str]| -> Result<Option<&Value>, FormatError> {
        let mut found = keys.iter().filter_map(|key| Some((*key, present(&map, key)?)));
        let first = found.next();
        match found.next() {
            Some((key, _)) => Err(FormatError::TwiceKey { key: key.to_owned() }),
            None => Ok(first.map(|(_, value)| value)),
        }
    };
    let k = one(&["intrinsics", "K"])?.ok_or(FormatError::MissingKey { key: "intrinsics" })?;
    let placed = match one(&["camera_from_lps", "extrinsics", "Rt", "R"])? {
        Some(value) if present(&map, "R").is_none() => {
            if present(&map, "t").is_some() {
                return Err(FormatError::TwiceKey { key: "t".to_owned() });
            }
            rigid(&json_rows(value, "[R|t]")?, "[R|t]")?
        }
        Some(r) => {
            let r: [[f64; 3]; 3] = matrix(&json_rows(r, "R")?, "R", THREE_BY_THREE)?;
            let t = list(present(&map, "t").ok_or(FormatError::MissingKey { key: "t" })?, "t")?;
            let [t]: [[f64; 3]; 1] = matrix(&[t], "t", "3 numbers")?;
            rigid_of(&std::array::from_fn(|i| [r[i][0], r[i][1], r[i][2], t[i]]), "R")?
        }
        None => return Err(FormatError::MissingKey { key: "camera_from_lps" }),
    };
    let (intrinsics, camera_from_lps) = camera(&matrix(&json_rows(k, "K")?, "K", THREE_BY_THREE)?, placed, "K")?;
    Ok(ExchangedCamera {
        intrinsics: Some(intrinsics),
        size_px: present(&map, "size_px").map(size_px).transpose()?,
        pitch_mm: present(&map, "pitch_mm").map(|value| pitch_mm(value, "pitch_mm")).transpose()?,
        ..ExchangedCamera::placed(camera_from_lps)
    })
}

pub(super) fn write_kr_json(camera: &ExchangedCamera) -> Result<String, FormatError> {
    let mut map = serde_json::Map::new();
    map.insert("intrinsics".to_owned(), json!(camera.intrinsics_for(Format::KrJson)?.to_rows()));
    map.insert("R".to_owned(), json!(rotation_rows(&camera.camera_from_lps)));
    map.insert("t".to_owned(), json!(camera.camera_from_lps.translation_mm.to_array()));
    if let Some(size_px) = camera.size_px {
        map.insert("size_px".to_owned(), json!(size_px));
    }
    if let Some(pitch_mm) = camera.pitch_mm {
        map.insert("pitch_mm".to_owned(), show_pitch(pitch_mm));
    }
    Ok(format!("{:#}\n", Value::Object(map)))
}
