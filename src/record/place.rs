//! What became of a file that is being written: there, moved, deleted, or cut short.

use std::fs::File;
use std::path::Path;

/// A file that is watched while it is written.
#[derive(Debug)]
pub(super) struct Watched {
    file: File,
}

/// What became of a file that is being written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Place {
    There,
    Moved,
    Deleted,
    Cut,
}

/// Why recording stops when the file is [`Place::Deleted`], and when it is [`Place::Cut`].
pub(super) const DELETED: &str = "the log was deleted while it was being written";
pub(super) const CUT: &str = "the log was cut short while it was being written, by another program";

impl Watched {
    pub(super) fn new(file: &File) -> std::io::Result<Self> {
        Ok(Self { file: file.try_clone()? })
    }

    /// `written`: bytes that have been put into the file and must be there.
    #[cfg(unix)]
    pub(super) fn place(&self, path: &Path, written: u64) -> Place {
        use std::os::unix::fs::MetadataExt;
        let Ok(own) = self.file.metadata() else { return Place::There };
        if own.nlink() == 0 {
            return Place::Deleted;
        }
        if own.len() < written {
            return Place::Cut;
        }
        match std::fs::metadata(path) {
            Ok(found) if (found.dev(), found.ino()) == (own.dev(), own.ino()) => Place::There,
            Ok(_) => Place::Moved,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => Place::Moved,
            // A path that cannot be followed for the moment says nothing about the file.
            Err(_) => Place::There,
        }
    }

    #[cfg(not(unix))]
    pub(super) fn place(&self, path: &Path, _written: u64) -> Place {
        if path.exists() { Place::There } else { Place::Moved }
    }
}
