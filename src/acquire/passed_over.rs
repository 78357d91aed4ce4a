//! What lies in the watched folder and is never read: pipes, devices, and folders, of which a person must hear once something comes into
//! them.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::{OsStr, OsString};
use std::path::Path;

use super::listing::{is_suspicious, is_wanted};
use super::source::Trouble;
use crate::foreign::{FileStamp, NotRegular};

/// See the module.
#[derive(Debug, Default)]
pub(super) struct PassedOver {
    known: BTreeMap<OsString, (NotRegular, Option<FileStamp>)>,
    /// Folders that were spoken of.
    told: BTreeSet<OsString>,
    /// The first look is over: what comes into a folder from now on is of this session.
    begun: bool,
}

impl PassedOver {
    /// What is new among `others` in `folder`, where folders below are read or not; `label` names it without giving its name away.
    pub(super) fn look(
        &mut self,
        folder: &Path,
        reads_below: bool,
        others: BTreeMap<OsString, (NotRegular, Option<FileStamp>)>,
        label: &mut dyn FnMut(&OsStr) -> String,
    ) -> Vec<Trouble> {
        let mut found = Vec::new();
        for (name, now) in &others {
            let before = self.known.get(name);
            let kind = now.0;
            if before.map(|(kind, _)| *kind) != Some(kind) && is_suspicious(name, kind) {
                found.push(Trouble::NotAFile { label: label(name), kind });
            } else if self.begun
                && kind == NotRegular::Folder
                && before != Some(now)
                && !is_servers_own(name)
                // Those are looked at by themselves, but for links.
                && !(reads_below && is_folder_itself(&folder.join(name)))
                && holds_something(&folder.join(name))
                // Once is enough for all that comes into it.
                && self.told.insert(name.clone())
            {
                found.push(Trouble::SubFolder { label: label(name) });
            }
        }
        self.begun = true;
        self.known = others;
        found
    }
}

/// Whether a file server keeps thumbnails, snapshots or deleted files there.
fn is_servers_own(name: &OsStr) -> bool {
    name.to_string_lossy().starts_with(['@', '#', '$'])
}

/// A folder, and no link to one.
fn is_folder_itself(path: &Path) -> bool {
    std::fs::symlink_metadata(path).is_ok_and(|metadata| metadata.is_dir())
}

/// Whether there is a file or a folder that could hold frames.
fn holds_something(folder: &Path) -> bool {
    std::fs::read_dir(folder).is_ok_and(|entries| entries.flatten().any(|entry| is_wanted(&entry.file_name())))
}
