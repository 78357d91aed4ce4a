//! JSON objects of foreign files: known keys only, numbers checked.

use serde_json::{Map, Value};

use super::FormatError;
use super::numbers::{finite, positive, size};

/// An object whose keys are all `known`.
pub(super) fn object(text: &str, known: &[&str]) -> Result<Map<String, Value>, FormatError> {
    let wrong = |detail: String| FormatError::Syntax { expected: "a JSON object", detail };
    // NaN and Infinity are no JSON, but Python's `json.dump` writes them; the reader's complaint would not say so.
    if text.split(|c: char| !c.is_ascii_alphabetic()).any(|word| matches!(word, "NaN" | "Infinity")) {
        return Err(FormatError::NotFinite { what: "the file".to_owned() });
    }
    let Value::Object(map) = serde_json::from_str(text).map_err(|error| wrong(error.to_string()))? else {
        return Err(wrong("it is another kind of value".to_owned()));
    };
    check_keys(&map, known)?;
    Ok(map)
}

/// Refuses keys that are not known.
pub(super) fn check_keys(map: &Map<String, Value>, known: &[&str]) -> Result<(), FormatError> {
    match map.keys().find(|key| !known.contains(&key.as_str())) {
        Some(key) => Err(FormatError::UnknownKey { key: key.clone(), expected: known.join(", ") }),
        None => Ok(()),
    }
}

/// A number.
pub(super) fn number(value: &Value, what: &str) -> Result<f64, FormatError> {
    let found = value.as_f64().ok_or_else(|| FormatError::NotNumber { what: what.to_owned(), found: value.to_string() })?;
    finite(found, what)
}

/// A list of numbers; a list of one-number lists is a column.
pub(super) fn list(value: &Value, what: &str) -> Result<Vec<f64>, FormatError> {
    let items = value.as_array().ok_or_else(|| FormatError::Shape {
        what: what.to_owned(),
        found: value.to_string().chars().take(40).collect(),
        expected: "a list of numbers",
    })?;
    items
        .iter()
        .map(|item| match item.as_array().map(Vec::as_slice) {
            Some([only]) => number(only, what),
            _ => number(item, what),
        })
        .collect()
}

/// A list of lists of numbers.
pub(super) fn rows(value: &Value, what: &str) -> Result<Vec<Vec<f64>>, FormatError> {
    let items = value.as_array().ok_or_else(|| FormatError::Shape {
        what: what.to_owned(),
        found: value.to_string().chars().take(40).collect(),
        expected: "a list of rows",
    })?;
    items.iter().map(|item| list(item, what)).collect()
}

/// `size_px`: columns and rows.
pub(super) fn size_px(value: &Value) -> Result<[u32; 2], FormatError> {
    match list(value, "size_px")?[..] {
        [columns, rows] => size(columns, rows),
        ref other => Err(FormatError::Shape {
            what: "size_px".to_owned(),
            found: format!("{} numbers", other.len()),
            expected: "two numbers",
        }),
    }
}

/// A pitch: one number for square pixels, or two.
pub(super) fn pitch_mm(value: &Value, key: &str) -> Result<[f64; 2], FormatError> {
    if value.is_number() {
        let pitch = positive(number(value, key)?, key)?;
        return Ok([pitch, pitch]);
    }
    match list(value, key)?[..] {
        [x, y] => Ok([positive(x, key)?, positive(y, key)?]),
        ref other => Err(FormatError::Shape {
            what: key.to_owned(),
            found: format!("{} numbers", other.len()),
            expected: "one number, or two (between columns, between rows)",
        }),
    }
}

/// A pitch as one number where pixels are square.
pub(super) fn show_pitch(pitch_mm: [f64; 2]) -> Value {
    if pitch_mm[0] == pitch_mm[1] { pitch_mm[0].into() } else { pitch_mm.to_vec().into() }
}

/// A key's value; `null` counts as absent.
pub(super) fn present<'a>(map: &'a Map<String, Value>, key: &str) -> Option<&'a Value> {
    map.get(key).filter(|value| !value.is_null())
}
