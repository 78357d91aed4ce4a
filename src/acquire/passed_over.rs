//! What lies in the watched folder and is never read: pipes, devices, folders, of which a person must hear once something comes into them,
//! and files whose names say that they are hidden or on their way still, of which a person must hear where a picture stays so.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::{OsStr, OsString};
use std::io::Read;
use std::path::Path;

use super::FileKind;
use super::entry::PATIENCE_US;
use super::listing::{is_suspicious, is_wanted};
use super::offer::Reported;
use super::source::Trouble;
use crate::foreign::{FileStamp, NotRegular, open_regular};

/// So much of a file says what it is.
const HEAD_BYTES: u64 = 132;

/// A file that is passed over for its name.
#[derive(Debug)]
struct Hidden {
    stamp: FileStamp,
    since_us: i64,
    /// There from the start, looked into, or spoken of: once is enough for a name.
    is_settled: bool,
    is_told: bool,
}

/// See the module.
#[derive(Debug, Default)]
pub(super) struct PassedOver {
    known: BTreeMap<OsString, (NotRegular, Option<FileStamp>)>,
    /// Folders that were spoken of.
    told: BTreeSet<OsString>,
    /// Files passed over for their names; `None` where what was there at the beginning could not be seen.
    hidden: Option<BTreeMap<OsString, Hidden>>,
    /// Those that were spoken of, by device and inode.
    told_hidden: Vec<((u64, u64), Trouble)>,
    /// The first look is over: what comes into a folder from now on is of this session.
    begun: bool,
}

impl PassedOver {
    /// `hidden` was there before the watch began.
    pub(super) fn of_old(hidden: Option<BTreeMap<OsString, FileStamp>>) -> Self {
        let old =
            |(name, stamp): (OsString, FileStamp)| (name, Hidden { stamp, since_us: i64::MIN, is_settled: true, is_told: false });
        Self { hidden: hidden.map(|hidden| hidden.into_iter().map(old).collect()), ..Self::default() }
    }

    /// Pictures among `hidden` files in `folder` that have lain still for as long as a file that is waited for.
    pub(super) fn look_at_hidden(
        &mut self,
        folder: &Path,
        now_us: i64,
        hidden: BTreeMap<OsString, FileStamp>,
        label: &mut dyn FnMut(&OsStr) -> String,
    ) -> Vec<Trouble> {
        let Some(mut before) = self.hidden.take() else {
            self.hidden = Self::of_old(Some(hidden)).hidden;
            return Vec::new();
        };
        let mut found = Vec::new();
        let mut now = BTreeMap::new();
        for (name, stamp) in hidden {
            let mut file = match before.remove(&name) {
                Some(file) if file.stamp == stamp => file,
                other => {
                    let is_told = other.is_some_and(|file| file.is_told);
                    Hidden { stamp, since_us: now_us, is_settled: is_told, is_told }
                }
            };
            if !file.is_settled && now_us.saturating_sub(file.since_us) >= PATIENCE_US {
                file.is_settled = true;
                if is_picture(&folder.join(&name)) {
                    file.is_told = true;
                    let trouble = Trouble::Hidden { label: label(&name) };
                    self.told_hidden.push((stamp.inode, trouble.clone()));
                    found.push(trouble);
                }
            }
            now.insert(name, file);
        }
        self.hidden = Some(now);
        found
    }

    /// What was said of the file of which this is a version, now that it has a name that is read.
    pub(super) fn renamed(&mut self, stamp: FileStamp) -> Option<Reported> {
        let at = self.told_hidden.iter().position(|(inode, _)| *inode == stamp.inode && *inode != (0, 0))?;
        let (_, trouble) = self.told_hidden.swap_remove(at);
        Some(Reported { trouble, written: None })
    }

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

/// Whether the file begins as a picture does.
fn is_picture(path: &Path) -> bool {
    let Ok(open) = open_regular(path, u64::MAX) else { return false };
    let mut head = Vec::new();
    let is_read = open.file.take(HEAD_BYTES).read_to_end(&mut head).is_ok();
    is_read && matches!(FileKind::of(&head), FileKind::Dicom | FileKind::Png | FileKind::Tiff)
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
