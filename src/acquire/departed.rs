//! Versions whose name is gone: they may come back under the same name or another one, and what is told of them may come late.

use std::collections::VecDeque;
use std::ffi::{OsStr, OsString};

use super::entry::Entry;
use super::offer::Reported;
use crate::foreign::FileStamp;

/// So many are remembered.
const REMEMBERED: usize = 4096;

/// See the module; the oldest first.
#[derive(Debug, Default)]
pub(super) struct Departed(VecDeque<(OsString, Entry)>);

impl Departed {
    pub(super) fn push(&mut self, name: OsString, entry: Entry) {
        self.0.push_back((name, entry));
        if self.0.len() > REMEMBERED {
            self.0.pop_front();
        }
    }

    /// The version `stamp`, which is away no longer.
    pub(super) fn take(&mut self, stamp: FileStamp) -> Option<Entry> {
        let place = self.0.iter().position(|(_, entry)| entry.stamp == stamp)?;
        self.0.remove(place).map(|(_, entry)| entry)
    }

    /// What was reported of the one that had this name last, as far as another copy of it may mend it.
    pub(super) fn reported_of(&mut self, name: &OsStr) -> Vec<Reported> {
        let reported = self.named_mut(name).map(|entry| std::mem::take(&mut entry.reported)).unwrap_or_default();
        reported.into_iter().filter(|reported| reported.written.is_some()).collect()
    }

    /// All of them.
    pub(super) fn entries_mut(&mut self) -> impl Iterator<Item = &mut Entry> {
        self.0.iter_mut().map(|(_, entry)| entry)
    }

    /// The one that had this name last.
    pub(super) fn named_mut(&mut self, name: &OsStr) -> Option<&mut Entry> {
        self.0.iter_mut().rev().find(|(known, _)| known == name).map(|(_, entry)| entry)
    }
}
