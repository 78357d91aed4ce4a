//! Code strings that the standard defines; `standard_terms.json` is the table.

use std::collections::BTreeMap;
use std::sync::OnceLock;

/// The terms that the standard defines, by field of [`FrameTags`](super::FrameTags).
fn terms() -> &'static BTreeMap<String, serde_json::Value> {
    static TERMS: OnceLock<BTreeMap<String, serde_json::Value>> = OnceLock::new();
    TERMS.get_or_init(|| serde_json::from_str(include_str!("standard_terms.json")).unwrap_or_default())
}

/// Whether the standard defines `value` for the field.
pub(super) fn is_term(field: &str, value: &str) -> bool {
    let list = terms().get(field).and_then(serde_json::Value::as_array);
    list.is_some_and(|list| list.iter().any(|term| term.as_str() == Some(value)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn terms_are_those_of_the_standard() {
        for (field, term) in [("modality", "XA"), ("image_type", "SINGLE PLANE"), ("photometric", "MONOCHROME1")] {
            assert!(is_term(field, term), "{field} {term}");
        }
        for (field, other) in
            [("modality", "LI"), ("image_type", "MUELLER"), ("intensity_relationship", "ANNA"), ("origin", "DICOM")]
        {
            assert!(!is_term(field, other), "{field} {other}");
        }
    }
}
