//! The writer's thread: takes what waits, makes chunks of it and delivers them.

use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::RecordError;
use super::chunk::OpenChunk;
use super::file::LogFile;
use super::queue::{Command, Queue};
use super::sink::Sink;

/// Messages gather for so long before they are delivered: what a killed program loses.
const GATHER: Duration = Duration::from_millis(60);
/// An idle writer delivers nothing so often: whoever writes the file looks whether it is still there.
const LOOK: Duration = Duration::from_millis(400);
/// Chunks are closed when they hold this much.
const CHUNK_BYTES: usize = 4 << 20;

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

/// Ends the queue when the writer ends, however it ends.
struct Closer<'a>(&'a Queue);

impl Drop for Closer<'_> {
    fn drop(&mut self) {
        self.0.close(std::thread::panicking().then(|| "the writer panicked".to_owned()));
    }
}

/// Writes until the queue is finished or nothing can be written any more.
pub(super) fn write_until_finished(path: &Path, sink: Box<dyn Sink>, queue: &Queue) -> Result<Summary, RecordError> {
    let _closer = Closer(queue);
    let written = write(path, sink, queue);
    written.map_err(|error| {
        let reason = error.to_string();
        let recorded = queue.health().flushed;
        queue.close(Some(reason.clone()));
        RecordError::Stopped { path: path.to_owned(), recorded, reason }
    })
}

fn write(path: &Path, sink: Box<dyn Sink>, queue: &Queue) -> std::io::Result<Summary> {
    let mut pen = Pen { file: LogFile::start(sink)?, chunk: OpenChunk::default(), topics: HashMap::new() };
    loop {
        let batch = queue.take(GATHER, LOOK)?;
        for command in batch.commands {
            pen.take(command)?;
        }
        pen.close_chunk()?;
        if batch.last {
            pen.file.finish()?;
        }
        let end = pen.file.at();
        queue.handed_over(end);
        pen.file.target().deliver(end)?;
        if batch.last {
            queue.wait_until_in_file(end)?;
            return Ok(pen.summary(path));
        }
    }
}

struct Pen {
    file: LogFile<Box<dyn Sink>>,
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
