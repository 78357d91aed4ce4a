//! A log made of the messages of others: the same bytes and times, in chunks of its own.

use std::collections::HashMap;
use std::fs::File;
use std::io::{BufWriter, ErrorKind, Write};
use std::path::Path;

use super::channel::Kind;
use super::chunk::OpenChunk;
use super::file::LogFile;
use super::writer::Summary;
use super::{Attachment, LogEntry, LogReader, RecordError};
use crate::image::NewFile;

/// Chunks are closed when they hold this much.
const CHUNK_BYTES: usize = 4 << 20;
/// Larger messages have chunks of their own, so that who looks for telemetry need not unpack pixels.
const LARGE_BYTES: usize = 64 << 10;

/// See the module. The file appears under its name when it is whole, and nothing is left behind otherwise.
pub struct LogCopy {
    new: NewFile,
    file: LogFile<BufWriter<File>>,
    chunk: OpenChunk,
    /// Topic, name of the schema and encoding, to the channel and its messages.
    channels: HashMap<(String, String, String), (u16, u32)>,
    largest_id: u16,
}

impl std::fmt::Debug for LogCopy {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("LogCopy").field("path", &self.new.path()).field("at", &self.file.at()).finish_non_exhaustive()
    }
}

impl LogCopy {
    /// For whoever reads long before it writes.
    ///
    /// # Errors
    /// When anything is there under this name, be it a link that leads nowhere.
    pub fn refuse_existing(path: &Path) -> Result<(), RecordError> {
        NewFile::refuse_existing(path).map_err(|source| failed(path, source))
    }

    /// Begins the log that will be `path`.
    ///
    /// # Errors
    /// When it exists, or its folder is missing or not writable.
    pub fn create(path: &Path) -> Result<Self, RecordError> {
        let (new, file) = NewFile::create(path).map_err(|source| failed(path, source))?;
        let file = LogFile::start(BufWriter::with_capacity(1 << 20, file)).map_err(|source| failed(path, source))?;
        let mut copy = Self { new, file, chunk: OpenChunk::default(), channels: HashMap::new(), largest_id: 0 };
        for (topic, kind) in Kind::announced() {
            copy.channel(topic, &kind);
        }
        Ok(copy)
    }

    /// The channel of a topic, announced where it is new.
    fn channel(&mut self, topic: &str, kind: &Kind) -> u16 {
        let key = (topic.to_owned(), kind.schema_name.clone(), kind.message_encoding.clone().into_owned());
        if let Some((id, _)) = self.channels.get(&key) {
            return *id;
        }
        self.largest_id += 1;
        self.file.announce(&mut self.chunk, self.largest_id, topic, kind);
        self.channels.insert(key, (self.largest_id, 0));
        self.largest_id
    }

    /// A message that `reader` gave, or one like it; messages of a topic are counted anew.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn message(&mut self, reader: &LogReader, entry: &LogEntry) -> Result<(), RecordError> {
        let kind = reader.kind_of(entry).unwrap_or_else(|| Kind::json(&entry.topic));
        self.put(&entry.topic, &kind, entry.host_us, &entry.data)
    }

    /// A value as JSON.
    ///
    /// # Errors
    /// When it has no JSON form, or the file cannot be written.
    pub fn json(&mut self, topic: &str, host_us: i64, value: &impl serde::Serialize) -> Result<(), RecordError> {
        let data = serde_json::to_vec(value).map_err(|source| RecordError::Json { topic: topic.to_owned(), source })?;
        self.put(topic, &Kind::json(topic), host_us, &data)
    }

    fn put(&mut self, topic: &str, kind: &Kind, host_us: i64, data: &[u8]) -> Result<(), RecordError> {
        let id = self.channel(topic, kind);
        let counted = self.channels.values_mut().find(|(channel, _)| *channel == id);
        let sequence = counted.map_or(0, |(_, count)| {
            *count += 1;
            *count
        });
        let is_large = data.len() > LARGE_BYTES;
        if is_large || self.chunk.len() > CHUNK_BYTES {
            self.close_chunk()?;
        }
        self.chunk.message(id, sequence, (host_us.max(0) as u64).saturating_mul(1000), data);
        if is_large { self.close_chunk() } else { Ok(()) }
    }

    /// An attached file.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn attach(&mut self, attachment: &Attachment, host_us: i64) -> Result<(), RecordError> {
        self.close_chunk()?;
        let Attachment { name, media_type, data } = attachment;
        let time_ns = (host_us.max(0) as u64).saturating_mul(1000);
        self.file.attachment(name, media_type, time_ns, data).map_err(|source| self.failed(source))
    }

    fn close_chunk(&mut self) -> Result<(), RecordError> {
        if self.chunk.is_empty() {
            return Ok(());
        }
        let chunk = std::mem::take(&mut self.chunk).close();
        self.file.chunk(&chunk).map_err(|source| self.failed(source))
    }

    fn failed(&self, source: std::io::Error) -> RecordError {
        failed(self.new.path(), source)
    }

    /// Closes the log and gives it its name.
    ///
    /// # Errors
    /// When the file cannot be written, or one of that name has appeared meanwhile.
    pub fn finish(mut self) -> Result<Summary, RecordError> {
        self.close_chunk()?;
        let written = self.file.finish().and_then(|()| self.file.target().flush());
        written.map_err(|source| self.failed(source))?;
        let counted = self.channels.iter().filter(|(_, (_, count))| *count > 0);
        let topics = counted.map(|((topic, ..), (_, count))| (topic.clone(), u64::from(*count))).collect();
        let Self { new, channels, .. } = self;
        let path = new.path().to_owned();
        new.appear().map_err(|source| failed(&path, source))?;
        Ok(Summary { path, messages: channels.values().map(|(_, count)| u64::from(*count)).sum(), topics })
    }
}

fn failed(path: &Path, source: std::io::Error) -> RecordError {
    match source.kind() {
        ErrorKind::AlreadyExists => RecordError::Exists { path: path.to_owned() },
        _ => RecordError::Io { path: path.to_owned(), source },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let entries = std::fs::read_dir(folder).expect("a folder").flatten();
        entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
    }

    #[test]
    fn a_file_that_is_there_is_not_written_over() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("there.mcap");
        std::fs::write(&path, "mine").expect("written");
        assert!(matches!(LogCopy::refuse_existing(&path), Err(RecordError::Exists { .. })));
        assert!(matches!(LogCopy::create(&path), Err(RecordError::Exists { .. })));
        assert_eq!(std::fs::read(&path).expect("there"), b"mine");
        assert_eq!(names(folder.path()), ["there.mcap"]);
    }

    #[test]
    fn a_file_that_appears_while_the_log_is_written_is_not_written_over() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("new.mcap");
        let mut copy = LogCopy::create(&path).expect("begun");
        copy.json("/events", 1, &"text").expect("taken");
        assert!(!path.exists(), "no half log under its name");
        std::fs::write(&path, "mine").expect("written");
        assert!(matches!(copy.finish(), Err(RecordError::Exists { .. })));
        assert_eq!(std::fs::read(&path).expect("there"), b"mine");
        assert_eq!(names(folder.path()), ["new.mcap"], "nothing is left behind");
    }
}
