//! What takes the bytes of a log: a file that this process writes itself, or a keeper (`handover.rs`).

use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::RecordError;
use super::place::{CUT, DELETED, Place, Watched};
use super::queue::Queue;

/// Where a log goes: a file, or something else that can be written (tests).
pub trait LogTarget: Write + Send {}
impl<T: Write + Send> LogTarget for T {}

/// Takes the bytes of a log in order. What was written and then delivered is safe from a kill of this process.
pub(super) trait Sink: Write + Send {
    /// The log's first `end` bytes are a whole; the queue is told when they are in the file, now or later.
    fn deliver(&mut self, end: u64) -> std::io::Result<()>;
}

/// A file that this process writes itself: a write that takes long holds up what comes behind it.
pub(super) struct OwnFile {
    pub(super) target: Box<dyn LogTarget>,
    pub(super) watched: Option<Watched>,
    pub(super) path: PathBuf,
    pub(super) queue: Arc<Queue>,
    /// Bytes that are in the file.
    pub(super) delivered: u64,
    /// Nothing was written since.
    pub(super) at_rest: bool,
}

impl OwnFile {
    /// `file`, which is empty and lies at `path`.
    ///
    /// # Errors
    /// When the system gives no second handle of it.
    pub(super) fn of(path: &Path, file: File, queue: &Arc<Queue>) -> Result<Self, RecordError> {
        let watched = Watched::new(&file).map_err(|source| RecordError::Io { path: path.to_owned(), source })?;
        let (target, queue) = (Box::new(file), Arc::clone(queue));
        Ok(Self { target, watched: Some(watched), path: path.to_owned(), queue, delivered: 0, at_rest: false })
    }
}

impl Write for OwnFile {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        // Before anything is written behind what was cut off.
        if std::mem::take(&mut self.at_rest)
            && self.watched.as_ref().is_some_and(|watched| watched.place(&self.path, self.delivered) == Place::Cut)
        {
            return Err(std::io::Error::other(CUT));
        }
        self.target.write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.target.flush()
    }
}

impl Sink for OwnFile {
    fn deliver(&mut self, end: u64) -> std::io::Result<()> {
        let place = self.watched.as_ref().map_or(Place::There, |watched| watched.place(&self.path, self.delivered));
        self.flush()?;
        (self.delivered, self.at_rest) = (end, true);
        match place {
            Place::Deleted => return Err(std::io::Error::other(DELETED)),
            Place::Cut => return Err(std::io::Error::other(CUT)),
            place => self.queue.placed(place == Place::Moved),
        }
        self.queue.in_file(end);
        Ok(())
    }
}
