//! What lies in the watched folder.

use std::collections::BTreeMap;
use std::ffi::{OsStr, OsString};
use std::path::{Path, PathBuf};

use super::label;
use super::spool::INCOMING;
use crate::foreign::{FileStamp, NotRegular};

/// Whether a file of this name could be a frame.
pub(super) fn is_wanted(name: &OsStr) -> bool {
    let name = name.to_string_lossy().to_lowercase();
    let passed_over = [".tmp", ".part", ".partial", ".json"].iter().any(|ending| name.ends_with(ending));
    !(name.starts_with('.') || name.starts_with('~') || passed_over)
}

/// Whether a picture may lie under this name that is passed over: hidden, or on its way.
fn may_be_hidden(name: &OsStr) -> bool {
    let name = name.to_string_lossy().to_lowercase();
    !name.ends_with(".json") && !name.starts_with(INCOMING)
}

/// Whether a person should hear of it: folders are ordinary, unless named like an image.
pub(super) fn is_suspicious(name: &OsStr, kind: NotRegular) -> bool {
    kind != NotRegular::Folder || label::looks_like_an_image(Path::new(name))
}

/// The files in `folder` and in those below it, by path, without what a watch passes over for its name; and why folders below could not be listed.
/// Links are not followed. The directory of a medium (`DICOMDIR`) is no picture.
///
/// # Errors
/// When `folder` itself cannot be listed.
pub fn files_below(folder: &Path) -> std::io::Result<(Vec<PathBuf>, Vec<std::io::Error>)> {
    let (mut files, mut unlisted) = (Vec::new(), Vec::new());
    let mut entries: Vec<_> = std::fs::read_dir(folder)?.collect();
    while let Some(entry) = entries.pop() {
        let entry = match entry.and_then(|entry| Ok((entry.file_type()?, entry))) {
            Ok((kind, entry)) if is_wanted(&entry.file_name()) => (kind, entry),
            Ok(_) => continue,
            Err(error) => {
                unlisted.push(error);
                continue;
            }
        };
        match entry {
            (kind, entry) if kind.is_dir() => match std::fs::read_dir(entry.path()) {
                Ok(below) => entries.extend(below),
                Err(error) => unlisted.push(error),
            },
            (kind, entry) if kind.is_file() && !entry.file_name().eq_ignore_ascii_case("DICOMDIR") => files.push(entry.path()),
            _ => {}
        }
    }
    files.sort();
    Ok((files, unlisted))
}

/// What lies in a folder, by name.
#[derive(Default)]
pub(super) struct Listing {
    pub(super) files: BTreeMap<OsString, FileStamp>,
    /// What is none, with its stamp unless it cannot be told.
    pub(super) others: BTreeMap<OsString, (NotRegular, Option<FileStamp>)>,
    /// Files that are passed over for their names.
    pub(super) hidden: BTreeMap<OsString, FileStamp>,
}

/// Lists `folder`: regular files (and links to such) with their stamps, and what is none.
pub(super) fn list(folder: &Path) -> std::io::Result<Listing> {
    let mut listing = Listing::default();
    for entry in std::fs::read_dir(folder)? {
        let Ok(entry) = entry else { continue };
        let name = entry.file_name();
        if !is_wanted(&name) {
            if may_be_hidden(&name)
                && let Ok(metadata) = std::fs::metadata(entry.path())
                && metadata.is_file()
            {
                listing.hidden.insert(name, FileStamp::of(&metadata));
            }
            continue;
        }
        match std::fs::metadata(entry.path()) {
            Ok(metadata) => match NotRegular::of(&metadata) {
                None => drop(listing.files.insert(name, FileStamp::of(&metadata))),
                Some(kind) => drop(listing.others.insert(name, (kind, Some(FileStamp::of(&metadata))))),
            },
            // Gone between listing and looking, unless it is a link that leads nowhere.
            Err(_) if std::fs::symlink_metadata(entry.path()).is_ok() => {
                listing.others.insert(name, (NotRegular::Other, None));
            }
            Err(_) => {}
        }
    }
    Ok(listing)
}
