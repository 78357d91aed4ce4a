//! What speaks against taking a shadow's centre for as good as its noise.

use serde::{Deserialize, Serialize};

/// Warnings of one detection; its standard deviation holds with them. A file has those that are raised.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Flags {
    /// The core lies at the end of the frame's grey values, so that its depth is not known.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub clipped: bool,
    /// Another shadow reaches into it.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub overlapping: bool,
    /// Part of it lies behind a mask or outside the frame.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub at_mask: bool,
    /// Something that is no smooth background lies under or beside it (a bone's rim, a wire, a tool) and may move the centre by more
    /// than a few thousandths of the radius.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    pub over_structure: bool,
}

impl Flags {
    /// Whether any is raised.
    #[must_use]
    pub fn any(self) -> bool {
        self.clipped || self.overlapping || self.at_mask || self.over_structure
    }

    /// Those that are raised, in words.
    #[must_use]
    pub fn words(self) -> Vec<&'static str> {
        let all = [
            (self.clipped, "clipped"),
            (self.overlapping, "overlapping"),
            (self.at_mask, "at a mask"),
            (self.over_structure, "over structure"),
        ];
        all.into_iter().filter(|(is_raised, _)| *is_raised).map(|(_, words)| words).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_has_the_flags_that_are_raised_and_gives_them_back() {
        let all = |n: u32| Flags { clipped: n & 1 > 0, overlapping: n & 2 > 0, at_mask: n & 4 > 0, over_structure: n & 8 > 0 };
        for n in 0..16 {
            let flags = all(n);
            let text = serde_json::to_string(&flags).expect("JSON");
            assert_eq!(serde_json::from_str::<Flags>(&text).expect("reads what it writes"), flags);
            assert_eq!(text.matches("true").count(), flags.words().len(), "{text}");
            assert_eq!(flags.any(), n > 0);
        }
        assert!(serde_json::from_str::<Flags>(r#"{"clippd": true}"#).is_err(), "the control");
    }
}
