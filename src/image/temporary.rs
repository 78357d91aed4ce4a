//! Files and folders that are there for the time being: each is removed when it is dropped, and all of them when a signal ends the program.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{ErrorKind, Result, Write};
use std::ops::{Deref, DerefMut};
use std::path::{Path, PathBuf};
use std::sync::mpsc::channel;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use tempfile::{Builder, NamedTempFile, TempPath};

use crate::time::Stopwatch;

/// What was being made while the rest was removed is there by then.
const AGAIN: Duration = Duration::from_millis(5);

/// What is there for the time being.
struct Known {
    paths: BTreeSet<PathBuf>,
    /// The program ends.
    is_ending: bool,
}

static KNOWN: Mutex<Known> = Mutex::new(Known { paths: BTreeSet::new(), is_ending: false });

fn lock() -> MutexGuard<'static, Known> {
    KNOWN.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What is known. Whoever asks when the program ends waits for that: a file that was taken from under its writer is no failure that is told.
fn known() -> MutexGuard<'static, Known> {
    loop {
        let known = lock();
        if !known.is_ending {
            return known;
        }
        drop(known);
        std::thread::park();
    }
}

/// A path that is known as long as this is there.
#[derive(Debug)]
struct KnownPath(PathBuf);

impl KnownPath {
    fn of(path: &Path) -> Self {
        known().paths.insert(path.to_owned());
        Self(path.to_owned())
    }
}

impl Drop for KnownPath {
    fn drop(&mut self) {
        known().paths.remove(&self.0);
    }
}

/// A file or a folder that is removed when this is dropped, and by [`remove_temporaries`].
#[derive(Debug)]
pub struct Temporary<T> {
    made: T,
    // Dropped after what it names: nothing is there that is not known.
    path: KnownPath,
}

impl<T> Temporary<T> {
    /// Gives it to `end`, which gives it a lasting name or drops it.
    pub fn end_with<U>(self, end: impl FnOnce(T) -> U) -> U {
        let Self { made, path } = self;
        let ended = end(made);
        drop(path);
        ended
    }
}

impl Temporary<NamedTempFile> {
    /// The open file, and what removes it.
    #[must_use]
    pub fn into_parts(self) -> (File, Temporary<TempPath>) {
        let Self { made, path } = self;
        let (file, made) = made.into_parts();
        (file, Temporary { made, path })
    }
}

impl<T> Deref for Temporary<T> {
    type Target = T;

    fn deref(&self) -> &T {
        &self.made
    }
}

impl<T> DerefMut for Temporary<T> {
    fn deref_mut(&mut self) -> &mut T {
        &mut self.made
    }
}

impl<T: Write> Write for Temporary<T> {
    fn write(&mut self, bytes: &[u8]) -> Result<usize> {
        self.made.write(bytes)
    }

    fn flush(&mut self) -> Result<()> {
        self.made.flush()
    }
}

/// A new file in `folder`, open for writing and for its owner alone, whose name has `before` and `after` around its random part.
///
/// # Errors
/// When the folder is missing or not writable.
pub fn temporary_file(folder: &Path, before: &str, after: &str) -> Result<Temporary<NamedTempFile>> {
    let make = |path: &Path| -> Result<(File, KnownPath)> {
        // Known before it is there.
        let known = KnownPath::of(path);
        Ok((new_file(path)?, known))
    };
    let ((file, path), made) = Builder::new().prefix(before).suffix(after).make_in(folder, make)?.into_parts();
    Ok(Temporary { made: NamedTempFile::from_parts(file, made), path })
}

fn new_file(path: &Path) -> Result<File> {
    let mut options = File::options();
    options.read(true).write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    options.open(path)
}

/// A new folder in `within`, which is removed with all that is in it.
///
/// # Errors
/// When `within` is missing or not writable.
pub fn temporary_folder(within: &Path) -> Result<Temporary<TemporaryFolder>> {
    let make = |path: &Path| -> Result<KnownPath> {
        let known = KnownPath::of(path);
        new_folder(path)?;
        Ok(known)
    };
    let (path, made) = Builder::new().make_in(within, make)?.into_parts();
    Ok(Temporary { made: TemporaryFolder(made.keep().map_err(|error| error.error)?), path })
}

fn new_folder(path: &Path) -> Result<()> {
    #[cfg_attr(not(unix), expect(unused_mut))]
    let mut builder = std::fs::DirBuilder::new();
    #[cfg(unix)]
    std::os::unix::fs::DirBuilderExt::mode(&mut builder, 0o700);
    builder.create(path)
}

/// A folder that is removed, with all that is in it, when this is dropped.
#[derive(Debug)]
pub struct TemporaryFolder(PathBuf);

impl TemporaryFolder {
    /// Where it is.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for TemporaryFolder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Removes whatever is there for the time being, for whoever then ends the program: from now on no other temporary is made, and what a thread made of
/// one it does not tell. Gives what is still there after `limit`, as on a disk that stands still.
pub fn remove_temporaries(limit: Duration) -> Vec<PathBuf> {
    let mut left = {
        let mut known = lock();
        known.is_ending = true;
        std::mem::take(&mut known.paths)
    };
    let (sender, removed) = channel();
    for path in left.iter().cloned() {
        let sender = sender.clone();
        // One disk that stands still keeps nobody from what lies on another.
        let _ = std::thread::Builder::new().name("removal".into()).spawn(move || {
            if is_removed(&path) {
                let _ = sender.send(path);
            }
        });
    }
    drop(sender);
    let watch = Stopwatch::start();
    let rest = || limit.saturating_sub(Duration::from_secs_f64(1e-3 * watch.ms()));
    while let Ok(path) = removed.recv_timeout(rest()) {
        left.remove(&path);
    }
    left.into_iter().collect()
}

/// Whether it is gone, removed or with a lasting name.
fn is_removed(path: &Path) -> bool {
    let remove = || match path.symlink_metadata() {
        Ok(found) if found.is_dir() => std::fs::remove_dir_all(path).is_ok(),
        Ok(_) => std::fs::remove_file(path).is_ok(),
        Err(error) => error.kind() == ErrorKind::NotFound,
    };
    remove();
    std::thread::sleep(AGAIN);
    remove()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn is_known(path: &Path) -> bool {
        lock().paths.contains(path)
    }

    #[test]
    fn what_is_there_for_the_time_being_is_known_until_it_is_gone_or_has_its_name() {
        let folder = tempfile::tempdir().expect("a folder");
        let [dropped, named] = [(); 2].map(|()| temporary_file(folder.path(), ".a-", ".part").expect("a file"));
        let paths = [&dropped, &named].map(|file| file.path().to_owned());
        assert!(paths.iter().all(|path| path.exists() && is_known(path)), "{paths:?}");
        let name = paths[0].file_name().expect("a name").to_string_lossy().into_owned();
        assert!(name.starts_with(".a-") && name.ends_with(".part"), "{name}");
        let within = temporary_folder(folder.path()).expect("a folder");
        let path = within.path().to_owned();
        std::fs::write(path.join("file"), "in it").expect("written");
        assert!(is_known(&path));
        drop((dropped, within));
        let lasting = folder.path().join("lasting");
        named.end_with(|file| file.persist_noclobber(&lasting)).expect("named");
        assert!(!paths.iter().chain([&path]).any(|path| path.exists() || is_known(path)), "{paths:?} {path:?}");
        assert!(lasting.exists());
        let missing = temporary_file(&folder.path().join("missing"), "", "").expect_err("no such folder");
        assert_eq!(missing.kind(), ErrorKind::NotFound);
        assert!(!lock().paths.iter().any(|path| path.starts_with(folder.path())), "what could not be made is not known");
    }

    #[test]
    fn a_file_and_a_folder_with_files_are_removed_and_what_cannot_be_is_told() {
        let folder = tempfile::tempdir().expect("a folder");
        let (file, within) = (folder.path().join("file"), folder.path().join("folder"));
        std::fs::write(&file, "half").expect("written");
        std::fs::create_dir(&within).expect("a folder");
        std::fs::write(within.join("file"), "half").expect("written");
        for path in [&file, &within] {
            assert!(path.exists() && is_removed(path) && !path.exists(), "{path:?}");
        }
        assert!(is_removed(&file), "gone already");
        assert!(!is_removed(Path::new("/proc/self/status")) || cfg!(not(target_os = "linux")), "the control");
    }
}
