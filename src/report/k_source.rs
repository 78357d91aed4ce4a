//! Where K of an exposure comes from.

/// Whose K it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum KSource {
    /// The calibration of the C-arm, with telemetry's distance where there is one.
    Carm,
    /// `intrinsics` of the session.
    Intrinsics,
    /// The frame's own header.
    Header,
    /// Solved with the pose.
    Beads,
}

/// Whose it is, where the word is one of these: any other tells nothing.
pub(super) fn known<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<Option<KSource>, D::Error> {
    let word = <serde_json::Value as serde::Deserialize>::deserialize(deserializer)?;
    Ok(serde_json::from_value(word).ok())
}

impl std::fmt::Display for KSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Carm => "K of the C-arm's calibration",
            Self::Intrinsics => "K of the session's intrinsics",
            Self::Header => "K of the frame's header",
            Self::Beads => "K solved from the beads",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Scripts compare the word, people read the sentence.
    #[test]
    fn each_source_is_a_word_in_files_and_a_sentence_for_people() {
        for (source, word, part) in [
            (KSource::Carm, "carm", "C-arm"),
            (KSource::Intrinsics, "intrinsics", "session"),
            (KSource::Header, "header", "header"),
            (KSource::Beads, "beads", "solved"),
        ] {
            assert_eq!(serde_json::to_value(source).expect("a word"), word);
            assert_eq!(serde_json::from_value::<KSource>(word.into()).expect("a source"), source);
            assert!(source.to_string().contains(part), "{source}");
        }
    }
}
