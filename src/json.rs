//! Our own JSON files, read: what is wrong in one is said with the place where it stands.

use serde::de::DeserializeOwned;

/// What is wrong in a file, and where; the reader of the file says which it is.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("at {place}: {detail}")]
pub struct JsonFault {
    /// Path of keys.
    pub place: String,
    /// What is wrong there.
    pub detail: String,
}

/// The value that is all of `bytes`. Keys that a type with `deny_unknown_fields` does not know are faults.
///
/// # Errors
/// Where it is no JSON, has another form, or goes on behind the value.
pub fn parse_json<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, JsonFault> {
    // Editors write it to mark UTF-8; it is no part of the text.
    let bytes = bytes.strip_prefix("\u{feff}".as_bytes()).unwrap_or(bytes);
    if !matches!(bytes.trim_ascii_start().first(), None | Some(b'{' | b'[' | b'"' | b'-' | b'0'..=b'9' | b't' | b'f' | b'n')) {
        let detail = "this is no JSON text; `sidecarm info FILE` says what the file is".to_owned();
        return Err(JsonFault { place: "the beginning".to_owned(), detail });
    }
    let mut deserializer = serde_json::Deserializer::from_slice(bytes);
    let value = serde_path_to_error::deserialize(&mut deserializer).map_err(|error| {
        // No key leads to the outermost value, nor to what stands where a key should.
        let path = error.path().to_string();
        let known = path.strip_suffix('?').map_or(&*path, |known| known.strip_suffix('.').unwrap_or(known));
        let place = Some(known.to_owned()).filter(|path| !path.is_empty() && path != ".");
        JsonFault { place: place.unwrap_or_else(|| "the top level".to_owned()), detail: error.into_inner().to_string() }
    })?;
    deserializer.end().map_err(|error| JsonFault { place: "the end".to_owned(), detail: error.to_string() })?;
    Ok(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, serde::Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Arm {
        joints: Vec<Joint>,
    }

    #[derive(Debug, serde::Deserialize)]
    #[serde(deny_unknown_fields)]
    struct Joint {
        orbital_deg: f64,
    }

    #[test]
    fn a_fault_is_named_with_its_place() {
        let fault = |text: &str| parse_json::<Arm>(text.as_bytes()).expect_err("refused").to_string();
        let right = r#"{"joints": [{"orbital_deg": 1.0}, {"orbital_deg": 2.0}]}"#;
        assert_eq!(parse_json::<Arm>(right.as_bytes()).expect("the control").joints[1].orbital_deg, 2.0);
        let marked = format!("\u{feff}{right}");
        assert_eq!(parse_json::<Arm>(marked.as_bytes()).expect("a byte order mark is no fault").joints.len(), 2);
        for (text, place, words) in [
            (right.replace("2.0", "2.0, \"tilt\": 3"), "at joints[1]", "unknown field `tilt`"),
            (right.replace("2.0", "\"two\""), "at joints[1].orbital_deg: ", "invalid type"),
            ("\u{1f}\u{8b}\u{8}".to_owned(), "at the beginning: ", "no JSON text"),
            ("{}".to_owned(), "at the top level: ", "missing field `joints`"),
            ("{\"joints\": [],}".to_owned(), "at the top level: ", "trailing comma"),
            (right.replace("2.0", "2.0,"), "at joints[1]: ", "trailing comma"),
            (format!("{right} x"), "at the end: ", "trailing characters"),
        ] {
            let said = fault(&text);
            assert!(said.starts_with(place) && said.contains(words), "{said}");
        }
    }
}
