//! The writer's thread: takes what waits, writes it in chunks, and notices when the file is no longer there.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::RecordError;
use super::chunk::OpenChunk;
use super::file::LogFile;
use super::queue::{Command, Queue};
use crate::time::Stopwatch;

/// Messages gather for so long before they are written: what a killed program loses.
const GATHER: Duration = Duration::from_millis(60);
/// So often the writer looks whether its file is still where it was.
const LOOK: Duration = Duration::from_millis(400);
/// Chunks are closed when they hold this much.
const CHUNK_BYTES: usize = 4 << 20;

/// Where a log goes: a file, or something else that can be written (tests).
pub trait LogTarget: Write + Send {}
impl<T: Write + Send> LogTarget for T {}

/// What a finished log holds.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Serialize)]
pub struct Summary {
    /// The file.
    pub path: PathBuf,
    /// Messages in all.
    pub messages: u64,
    /// Messages per topic.
    pub topics: BTreeMap<String, u64>,
}

/// Where a file is on its disk.
#[derive(Debug)]
pub(super) struct Watched {
    file: File,
}

/// What became of a file that is being written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Place {
    There,
    Moved,
    Deleted,
}

impl Watched {
    pub(super) fn new(file: &File) -> std::io::Result<Self> {
        Ok(Self { file: file.try_clone()? })
    }

    #[cfg(unix)]
    fn place(&self, path: &Path) -> Place {
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
    fn place(&self, path: &Path) -> Place {
        if path.exists() { Place::There } else { Place::Moved }
    }
}

/// Ends the queue when the writer ends, however it ends.
struct Closer<'a>(&'a Queue);

impl Drop for Closer<'_> {
    fn drop(&mut self) {
        self.0.close(std::thread::panicking().then(|| "the writer panicked".to_owned()));
    }
}

/// Writes until the queue is finished or nothing can be written any more.
pub(super) fn write_until_finished(
    path: &Path,
    target: Box<dyn LogTarget>,
    watched: Option<&Watched>,
    queue: &Queue,
) -> Result<Summary, RecordError> {
    let _closer = Closer(queue);
    let written = write(path, target, watched, queue);
    written.map_err(|error| {
        let reason = error.to_string();
        let recorded = queue.health().flushed;
        queue.close(Some(reason.clone()));
        RecordError::Stopped { path: path.to_owned(), recorded, reason }
    })
}

fn write(path: &Path, target: Box<dyn LogTarget>, watched: Option<&Watched>, queue: &Queue) -> std::io::Result<Summary> {
    let mut pen = Pen { file: LogFile::start(target)?, chunk: OpenChunk::default(), topics: HashMap::new() };
    let mut looked = Stopwatch::start();
    let mut moved = false;
    loop {
        let batch = queue.take(GATHER, LOOK);
        for command in batch.commands {
            pen.take(command)?;
        }
        pen.close_chunk()?;
        pen.file.flush()?;
        if let Some(watched) = watched.filter(|_| batch.last || looked.ms() >= LOOK.as_secs_f64() * 1e3) {
            looked = Stopwatch::start();
            match watched.place(path) {
                Place::There => moved = false,
                Place::Moved => moved = true,
                Place::Deleted => return Err(std::io::Error::other("the log was deleted while it was being written")),
            }
        }
        if batch.last {
            pen.file.finish()?;
        }
        queue.wrote(moved);
        if batch.last {
            return Ok(pen.summary(path));
        }
    }
}

struct Pen {
    file: LogFile<Box<dyn LogTarget>>,
    chunk: OpenChunk,
    /// Topic and last sequence number of each channel.
    topics: HashMap<u16, (String, u32)>,
}

impl Pen {
    fn take(&mut self, command: Command) -> std::io::Result<()> {
        match command {
            Command::Channel { id, topic, kind } => {
                self.file.announce(&mut self.chunk, id, &topic, &kind);
                self.topics.insert(id, (topic, 0));
            }
            Command::Message { channel, log_time_ns, data } => {
                let sequence = self.topics.get_mut(&channel).map_or(0, |(_, count)| {
                    *count += 1;
                    *count
                });
                self.chunk.message(channel, sequence, log_time_ns, &data);
                if self.chunk.len() >= CHUNK_BYTES {
                    self.close_chunk()?;
                }
            }
            Command::Chunk(chunk) => {
                self.close_chunk()?;
                self.file.chunk(&chunk)?;
            }
            Command::Attach { name, media_type, time_ns, data } => {
                self.close_chunk()?;
                self.file.attachment(&name, &media_type, time_ns, &data)?;
            }
        }
        Ok(())
    }

    fn close_chunk(&mut self) -> std::io::Result<()> {
        if self.chunk.is_empty() {
            return Ok(());
        }
        self.file.chunk(&std::mem::take(&mut self.chunk).close())
    }

    fn summary(&self, path: &Path) -> Summary {
        let counted = self.topics.iter().map(|(id, (topic, _))| (topic.clone(), self.file.count(*id)));
        let topics: BTreeMap<String, u64> = counted.filter(|(_, count)| *count > 0).collect();
        Summary { path: path.to_owned(), messages: topics.values().sum(), topics }
    }
}
