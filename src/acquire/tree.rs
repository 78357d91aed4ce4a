//! A watched folder with those below it: consoles write a folder for each study, or for each day.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use super::Domain;
use super::listing::is_wanted;
use super::source::{FrameSource, Sighting};
use super::watch::{FolderSource, Place};
use crate::foreign::ForeignReader;

/// So many levels below the watched folder are looked into.
const DEPTH: usize = 6;
/// So many folders are watched at once; each has a thread of its own where the system tells of what is written.
const MOST_FOLDERS: usize = 200;
/// New folders are sought so often.
const SEEK_US: i64 = 200_000;

/// See the module. What lies in a folder that appears later is new; links to folders are not followed.
#[derive(Debug)]
pub struct FolderTree {
    root: PathBuf,
    domain: Option<Domain>,
    reader: ForeignReader,
    folders: BTreeMap<PathBuf, FolderSource>,
    next_us: i64,
    crowded: bool,
}

impl FolderTree {
    /// Watches `root` and all below it; the arguments are those of [`FolderSource::new`].
    #[must_use]
    pub fn new(root: &Path, domain: Option<Domain>, include_existing: bool, reader: ForeignReader) -> Self {
        let mut tree =
            Self { root: root.to_owned(), domain, reader, folders: BTreeMap::new(), next_us: i64::MIN, crowded: false };
        tree.watch(root.to_owned(), include_existing);
        for folder in below(root).into_iter().take(MOST_FOLDERS - 1) {
            tree.watch(folder, include_existing);
        }
        tree
    }

    fn watch(&mut self, folder: PathBuf, include_existing: bool) {
        let place = if folder == self.root { Place::Above } else { Place::Below };
        let source = FolderSource::new(&folder, self.domain, include_existing, self.reader.clone()).in_tree(place);
        self.folders.insert(folder, source);
    }

    /// Folders that have come are watched, those that have gone are given up.
    fn seek(&mut self, found: &mut Vec<Sighting>) {
        let there = below(&self.root);
        // One that is gone stays until what was seen in it is read from the open files, or reported.
        self.folders.retain(|folder, source| *folder == self.root || there.contains(folder) || source.is_expecting());
        let new: Vec<PathBuf> = there.into_iter().filter(|folder| !self.folders.contains_key(folder)).collect();
        let room = MOST_FOLDERS.saturating_sub(self.folders.len());
        if new.len() > room && !std::mem::replace(&mut self.crowded, true) {
            let words = format!(
                "more than {MOST_FOLDERS} folders lie below the frame folder: what comes into the others is not read; move old ones away"
            );
            found.push(Sighting::Said { kind: "too many sub-folders", words });
        }
        new.into_iter().take(room).for_each(|folder| self.watch(folder, true));
    }
}

impl FrameSource for FolderTree {
    fn look(&mut self, now_us: i64) -> Vec<Sighting> {
        let mut found = Vec::new();
        if now_us >= self.next_us {
            self.next_us = now_us.saturating_add(SEEK_US);
            self.seek(&mut found);
        }
        for source in self.folders.values_mut() {
            found.extend(source.look(now_us));
        }
        found
    }

    fn close(&mut self) {
        self.folders.values_mut().for_each(FolderSource::close);
    }

    fn is_expecting(&self) -> bool {
        self.folders.values().any(FolderSource::is_expecting)
    }

    fn give_up(&mut self) -> Vec<Sighting> {
        self.folders.values_mut().flat_map(FolderSource::give_up).collect()
    }
}

/// Folders below `root`, nearest first; what cannot be listed has none.
fn below(root: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    let mut level = vec![root.to_owned()];
    for _ in 0..DEPTH {
        let mut next = Vec::new();
        for folder in level {
            let Ok(entries) = std::fs::read_dir(&folder) else { continue };
            // The kind of the entry itself: a link is none.
            let is_folder = |entry: &std::fs::DirEntry| entry.file_type().is_ok_and(|kind| kind.is_dir());
            let mut own: Vec<PathBuf> =
                entries.flatten().filter(|entry| is_wanted(&entry.file_name()) && is_folder(entry)).map(|e| e.path()).collect();
            own.sort();
            next.extend(own);
        }
        found.extend(next.iter().cloned());
        if found.len() > 5 * MOST_FOLDERS {
            break;
        }
        level = next;
    }
    found
}
