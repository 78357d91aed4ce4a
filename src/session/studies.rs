//! Whether all frames are of one study: a folder that other rooms or other days share brings pictures that take the exposures of one's own.

use std::collections::{BTreeMap, BTreeSet};

/// The studies of the frames so far.
#[derive(Clone, Debug, Default)]
pub(super) struct Studies {
    /// By study: the frame that brought it.
    first: BTreeMap<String, u32>,
    /// That of the session's first frame which names one.
    own: Option<String>,
    others: BTreeSet<u32>,
}

impl Studies {
    /// Takes the study of a frame; what to say when a further one begins.
    pub(super) fn meet(&mut self, number: u32, study: Option<&str>) -> Option<String> {
        let study = study?;
        let own = self.own.get_or_insert_with(|| study.to_owned());
        if own != study {
            self.others.insert(number);
        }
        let begins = !self.first.contains_key(study);
        let first = *self.first.entry(study.to_owned()).or_insert(number);
        (begins && self.first.len() > 1).then(|| self.words(first))
    }

    /// What the pair of a frame says of its study, if it is not that of the session's first.
    pub(super) fn of(&self, number: u32) -> Option<String> {
        self.others.contains(&number).then(|| self.words(number))
    }

    fn words(&self, number: u32) -> String {
        let before = self.own.as_ref().and_then(|own| self.first.get(own)).copied().unwrap_or_default();
        format!(
            "frame {number} is of another study than frame {before}: if it is of another specimen, room or day, its binding and its pose mean \
             nothing; keep other exports out of the folder"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_further_study_is_said_once_and_stands_with_each_of_its_frames() {
        let mut studies = Studies::default();
        assert_eq!(studies.meet(1, None), None);
        assert_eq!(studies.meet(2, Some("a")), None);
        assert_eq!(studies.meet(3, Some("a")), None);
        let words = studies.meet(4, Some("b")).expect("another study");
        assert!(words.contains("frame 4") && words.contains("frame 2"), "{words}");
        assert_eq!(studies.meet(5, Some("b")), None);
        assert_eq!(studies.meet(6, Some("a")), None);
        assert!(studies.of(5).is_some() && studies.of(6).is_none() && studies.of(1).is_none());
    }
}
