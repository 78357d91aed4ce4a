//! What takes the bytes of a log: a file that this process writes itself, or a keeper (`handover.rs`).

use std::io::Write;
use std::path::PathBuf;
use std::sync::Arc;

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
