//! Files that appear whole, and never in place of another.

use std::fs::File;
use std::io::{Error, ErrorKind, Result};
use std::path::{Path, PathBuf};

use super::temporary::{Temporary, temporary_file};

/// What files are called that have no name yet, before the random part of that.
pub const UNNAMED: &str = ".sidecarm-";

/// A file that has its name only from [`NewFile::appear`] on; without that nothing is left behind.
#[derive(Debug)]
pub struct NewFile {
    path: PathBuf,
    /// Removes the file when dropped.
    temporary: Temporary<tempfile::TempPath>,
}

impl NewFile {
    /// For whoever reads long before it writes.
    ///
    /// # Errors
    /// [`ErrorKind::AlreadyExists`] when anything is there under this name, be it a link that leads nowhere.
    pub fn refuse_existing(path: &Path) -> Result<()> {
        match path.symlink_metadata() {
            Ok(_) => Err(Error::from(ErrorKind::AlreadyExists)),
            Err(_) => Ok(()),
        }
    }

    /// Begins the file that will be `path`; what is written goes to the second.
    ///
    /// # Errors
    /// When it exists, or its folder is missing or not writable.
    pub fn create(path: &Path) -> Result<(Self, File)> {
        Self::refuse_existing(path)?;
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let (file, temporary) = temporary_file(folder, UNNAMED, ".part")?.into_parts();
        #[cfg(unix)]
        {
            use std::os::unix::fs::PermissionsExt;
            file.set_permissions(std::fs::Permissions::from_mode(0o644))?;
        }
        Ok((Self { path: path.to_owned(), temporary }, file))
    }

    /// What it will be called.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Gives the file its name, once what was written is on the disk.
    ///
    /// # Errors
    /// [`ErrorKind::AlreadyExists`] when one of that name has appeared meanwhile; when the disk does not take it.
    pub fn appear(self) -> Result<PathBuf> {
        let Self { path, temporary } = self;
        File::options().write(true).open(&*temporary)?.sync_all()?;
        temporary.end_with(|temporary| temporary.persist_noclobber(&path).map_err(|error| error.error))?;
        sync_folder(&path);
        Ok(path)
    }
}

/// Waits until the name of the file at `path` is on the disk, as its bytes are. Where a file system does not do that for folders, as those of some
/// servers, a loss of power may bring back what was there before, whole.
pub fn sync_folder(path: &Path) {
    #[cfg(unix)]
    {
        let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let _ = File::open(folder).and_then(|folder| folder.sync_all());
    }
    // Elsewhere a folder is no file.
    #[cfg(not(unix))]
    let _ = path;
}
