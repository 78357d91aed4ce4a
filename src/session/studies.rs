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
    /// That of each frame which names one.
    of_frames: BTreeMap<u32, String>,
}

impl Studies {
    /// Takes the study of a frame; what to say when a further one begins.
    pub(super) fn meet(&mut self, number: u32, study: Option<&str>) -> Option<String> {
        let study = study?;
        self.of_frames.insert(number, study.to_owned());
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

    /// Those of the `untied` frames whose study is that of none of the `tied` ones, which have exposures; none where no study of these is known.
    pub(super) fn strangers(&self, tied: impl Iterator<Item = u32>, untied: impl Iterator<Item = u32>) -> BTreeSet<u32> {
        let own: BTreeSet<&String> = tied.filter_map(|number| self.of_frames.get(&number)).collect();
        let is_stranger = |number: &u32| self.of_frames.get(number).is_some_and(|study| !own.contains(study));
        untied.filter(|number| !own.is_empty() && is_stranger(number)).collect()
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

    #[test]
    fn strangers_are_of_a_study_that_has_no_exposure_beside_one_that_has() {
        let mut studies = Studies::default();
        for (number, study) in [(1, Some("a")), (2, Some("b")), (3, None), (4, Some("b")), (5, Some("c")), (6, Some("a"))] {
            studies.meet(number, study);
        }
        let strangers =
            |tied: &[u32], untied: &[u32]| studies.strangers(tied.iter().copied(), untied.iter().copied()).into_iter().collect();
        let none: Vec<u32> = Vec::new();
        let found: Vec<u32> = strangers(&[1], &[2, 3, 4, 5, 6]);
        assert_eq!(found, [2, 4, 5]);
        let found: Vec<u32> = strangers(&[1, 4], &[2, 3, 5, 6]);
        assert_eq!(found, [5], "a study of which one frame has an exposure is the session's");
        assert_eq!(strangers(&[3], &[1, 2]), none, "nothing to differ from");
        assert_eq!(strangers(&[], &[1, 2]), none);
    }
}
