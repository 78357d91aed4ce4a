//! ITK's text transforms (`.tfm`), as 3D Slicer reads and writes them.
//!
//! ITK stores transforms in lps millimetres and in the resampling sense: from the parent to the child. Ours is the node "camera": its
//! parent is the patient, so the file's matrix maps patient points to the camera. In 3D Slicer the node, applied to a model drawn in
//! camera axes, carries the model into the patient.

use super::numbers::{determinant_of, line, numbers, rigid_of, rotation_rows};
use super::{ExchangedCamera, FormatError};
use glam::{DMat3, DVec3};

const HEAD: &str = "#Insight Transform File V1.0";
const LINEAR: [&str; 4] = [
    "AffineTransform_double_3_3",
    "AffineTransform_float_3_3",
    "MatrixOffsetTransformBase_double_3_3",
    "MatrixOffsetTransformBase_float_3_3",
];

pub(super) fn read(text: &str) -> Result<ExchangedCamera, FormatError> {
    let wrong = |detail: String| FormatError::Syntax { expected: "an ITK transform in text", detail };
    if !text.trim_start().starts_with(HEAD) {
        return Err(wrong(format!("the first line is not `{HEAD}`")));
    }
    let (mut kinds, mut parameters, mut fixed) = (Vec::new(), None, None);
    for line in text.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#')) {
        let (key, value) = line.split_once(':').ok_or_else(|| wrong(format!("`{line}` has no colon")))?;
        match key.trim() {
            "Transform" => kinds.push(value.trim().to_owned()),
            "Parameters" => parameters = Some(numbers(value, "Parameters")?),
            "FixedParameters" => fixed = Some(numbers(value, "FixedParameters")?),
            other => {
                let expected = "Transform, Parameters, FixedParameters".to_owned();
                return Err(FormatError::UnknownKey { key: other.to_owned(), expected });
            }
        }
    }
    let kind = match &kinds[..] {
        [kind] => kind,
        [] => return Err(FormatError::MissingKey { key: "Transform" }),
        more => return Err(FormatError::Several { found: more.len() }),
    };
    if !LINEAR.contains(&kind.as_str()) {
        let expected = "AffineTransform_double_3_3 (save it from 3D Slicer as a linear transform)";
        return Err(FormatError::Unsupported { key: "Transform".to_owned(), found: kind.clone(), expected });
    }
    let parameters = parameters.ok_or(FormatError::MissingKey { key: "Parameters" })?;
    let shape = |what: &str, found: usize, expected| FormatError::Shape {
        what: what.to_owned(),
        found: format!("{found} numbers"),
        expected,
    };
    let values: [f64; 12] = parameters[..].try_into().map_err(|_| shape("Parameters", parameters.len(), "12 numbers"))?;
    let fixed = fixed.unwrap_or_else(|| vec![0.0; 3]);
    let centre: [f64; 3] = fixed[..].try_into().map_err(|_| shape("FixedParameters", fixed.len(), "3 numbers"))?;
    let rows: [[f64; 3]; 3] = std::array::from_fn(|i| [values[3 * i], values[3 * i + 1], values[3 * i + 2]]);
    // A(x − c) + c + t, so the offset is t + c − A c.
    let centre = DVec3::from_array(centre);
    let offset = DVec3::new(values[9], values[10], values[11]) + centre - DMat3::from_cols_array_2d(&rows).transpose() * centre;
    if !(determinant_of(&rows).abs() > 1e-6) {
        return Err(FormatError::Shape { what: "transform".to_owned(), found: "flat".to_owned(), expected: "a rigid motion" });
    }
    let placed = rigid_of(&std::array::from_fn(|i| [rows[i][0], rows[i][1], rows[i][2], offset[i]]), "transform")?;
    Ok(ExchangedCamera::placed(placed))
}

pub(super) fn write(camera: &ExchangedCamera) -> String {
    let rows = rotation_rows(&camera.camera_from_lps);
    let values: Vec<f64> = rows.into_iter().flatten().chain(camera.camera_from_lps.translation_mm.to_array()).collect();
    format!("{HEAD}\n#Transform 0\nTransform: {}\nParameters: {}\nFixedParameters: 0 0 0\n", LINEAR[0], line(&values))
}
