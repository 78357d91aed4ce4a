//! Where a file that is being written is on its disk: there, moved, or deleted.

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
}

/// Why recording stops when the file is [`Place::Deleted`].
pub(super) const DELETED: &str = "the log was deleted while it was being written";

impl Watched {
    pub(super) fn new(file: &File) -> std::io::Result<Self> {
        Ok(Self { file: file.try_clone()? })
    }

    #[cfg(unix)]
    pub(super) fn place(&self, path: &Path) -> Place {
        use std::os::unix::fs::MetadataExt;
        let Ok(own) = self.file.metadata() else { return Place::There };
        if own.nlink() == 0 {
            return Place::Deleted;
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
    pub(super) fn place(&self, path: &Path) -> Place {
        if path.exists() { Place::There } else { Place::Moved }
    }
}
