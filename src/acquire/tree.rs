//! A watched folder with those below it: consoles write a folder for each study, or for each day.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use super::Domain;
use super::listing::is_wanted;
use super::source::{FrameSource, Sighting, Trouble};
use super::watch::{FolderSource, Place};
use crate::foreign::ForeignReader;

/// So many levels below the watched folder are looked into.
const DEPTH: usize = 6;
/// So many folders are watched at once; each has a thread of its own where the system tells of what is written.
const MOST_FOLDERS: usize = 200;
/// Of those that are there at the start so many, which leaves room for those that come.
const MOST_OLD: usize = 100;
/// New folders are sought so often.
const SEEK_US: i64 = 200_000;

/// See the module. What lies in a folder that appears later is new; links to folders are not followed, which is said.
#[derive(Debug)]
pub struct FolderTree {
    root: PathBuf,
    domain: Option<Domain>,
    reader: ForeignReader,
    /// Those that are gone stay while there is room: a share that is away for a moment brings nothing new with it.
    folders: BTreeMap<PathBuf, FolderSource>,
    /// Those that were there at the start and are not watched, and when they were changed last.
    left_out: BTreeMap<PathBuf, Option<SystemTime>>,
    next_us: i64,
    crowded: bool,
}

impl FolderTree {
    /// Watches `root` and all below it; the arguments are those of [`FolderSource::new`].
    #[must_use]
    pub fn new(root: &Path, domain: Option<Domain>, include_existing: bool, reader: ForeignReader) -> Self {
        let mut old = below(root).unwrap_or_default();
        let left_out = old.split_off(old.len().min(MOST_OLD));
        let mut tree = Self {
            root: root.to_owned(),
            domain,
            reader,
            folders: BTreeMap::new(),
            left_out: left_out.into_iter().map(|found| (found.path, found.modified)).collect(),
            next_us: i64::MIN,
            crowded: false,
        };
        tree.watch(Found { path: root.to_owned(), depth: 0, modified: None }, include_existing);
        old.into_iter().for_each(|found| tree.watch(found, include_existing));
        tree
    }

    fn watch(&mut self, found: Found, include_existing: bool) {
        let Found { path, depth, .. } = found;
        let place = Place { reads_below: depth < DEPTH, may_go: depth > 0 };
        let source = FolderSource::new(&path, self.domain, include_existing, self.reader.clone());
        self.folders.insert(path, source.in_tree(place));
    }

    /// Folders that have come are watched.
    fn seek(&mut self, found: &mut Vec<Sighting>) {
        // Where the root cannot be listed, its own source says so.
        let Ok(there) = below(&self.root) else { return };
        let is_new = |found: &&Found| !self.folders.contains_key(&found.path) && !self.left_out.contains_key(&found.path);
        let new: Vec<Found> = there.iter().filter(is_new).cloned().collect();
        let is_unread = |found: &Found| self.left_out.get(&found.path).is_some_and(|modified| *modified != found.modified);
        let unread = there.iter().any(is_unread);
        if self.folders.len() + new.len() > MOST_FOLDERS {
            let there: BTreeSet<&PathBuf> = there.iter().map(|found| &found.path).collect();
            let Self { root, folders, .. } = self;
            folders.retain(|folder, source| folder == root || there.contains(folder) || source.is_expecting());
        }
        let room = MOST_FOLDERS.saturating_sub(self.folders.len());
        if (new.len() > room || unread) && !std::mem::replace(&mut self.crowded, true) {
            found.push(Sighting::Trouble(Trouble::TooManyFolders { most: MOST_FOLDERS }));
        }
        new.into_iter().take(room).for_each(|found| self.watch(found, true));
    }
}

impl FrameSource for FolderTree {
    fn look(&mut self, now_us: i64) -> Vec<Sighting> {
        let mut found = Vec::new();
        let all = now_us >= self.next_us;
        if all {
            self.next_us = now_us.saturating_add(SEEK_US);
            self.seek(&mut found);
        }
        // In between, the root and those in which something is on its way.
        for (folder, source) in &mut self.folders {
            if all || *folder == self.root || source.is_expecting() {
                found.extend(source.look(now_us));
            }
        }
        found
    }

    fn close(&mut self) {
        self.next_us = i64::MIN;
        self.folders.values_mut().for_each(FolderSource::close);
    }

    fn is_expecting(&self) -> bool {
        self.folders.values().any(FolderSource::is_expecting)
    }

    fn give_up(&mut self) -> Vec<Sighting> {
        self.folders.values_mut().flat_map(FolderSource::give_up).collect()
    }
}

/// A folder below the root.
#[derive(Clone, Debug)]
struct Found {
    path: PathBuf,
    /// Levels below the root.
    depth: usize,
    modified: Option<SystemTime>,
}

/// Folders below `root`, those first that were changed last; of those that cannot be listed, nothing.
fn below(root: &Path) -> std::io::Result<Vec<Found>> {
    let (mut found, mut level) = (Vec::new(), folders_in(root, 1)?);
    while !level.is_empty() && found.len() < 5 * MOST_FOLDERS {
        let deeper = level.iter().filter(|folder| folder.depth < DEPTH);
        let next = deeper.flat_map(|folder| folders_in(&folder.path, folder.depth + 1).unwrap_or_default()).collect();
        found.append(&mut level);
        level = next;
    }
    found.sort_by(|a, b| b.modified.cmp(&a.modified).then_with(|| a.path.cmp(&b.path)));
    Ok(found)
}

fn folders_in(folder: &Path, depth: usize) -> std::io::Result<Vec<Found>> {
    let found = |entry: std::fs::DirEntry| {
        // The kind of the entry itself: a link is none.
        let is_folder = is_wanted(&entry.file_name()) && entry.file_type().is_ok_and(|kind| kind.is_dir());
        let modified = || entry.metadata().and_then(|metadata| metadata.modified()).ok();
        is_folder.then(|| Found { path: entry.path(), depth, modified: modified() })
    };
    Ok(std::fs::read_dir(folder)?.flatten().filter_map(found).collect())
}
