//! Reading logs record by record, tolerant to cuts and to damaged chunks: what can be read is read, what is lost is said.

use std::collections::HashMap;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use mcap::records::{Record, op};

use super::RecordError;
use super::announced::announced_at_the_end;
use super::channel::Kind;
use super::compression::begins_with_other;
use super::resync::{MAX_RECORD_BYTES, next_chunk};
use super::unpack::{Unpacked, has_checksum, is_head, is_other_head, unpack};
use crate::regular::{NotRegular, OpenFault, OpenFile, open_regular};

/// Opcode and length in front of every record.
const RECORD_HEADER_BYTES: u64 = 9;
/// So many losses are kept one by one; further ones are counted.
const MAX_LOSSES: usize = 1000;

/// A message of a log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LogEntry {
    /// Its topic.
    pub topic: Arc<str>,
    /// Name of its schema, such as `foxglove.RawImage`.
    pub schema: Arc<str>,
    /// How `data` is encoded: `json`, `protobuf`, `x-sidecarm-raw`.
    pub encoding: Arc<str>,
    /// Host time in microseconds since the Unix epoch.
    pub host_us: i64,
    /// Counts the messages of the topic, starting at 1.
    pub sequence: u32,
    /// The message.
    pub data: Vec<u8>,
}

/// Part of a log that could not be read.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
pub struct LogLoss {
    /// Where in the file it begins.
    pub at_byte: u64,
    /// What happened.
    pub reason: String,
}

impl std::fmt::Display for LogLoss {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "at byte {}: {}", self.at_byte, self.reason)
    }
}

/// A file kept in a log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Attachment {
    /// Its name.
    pub name: String,
    /// Its media type.
    pub media_type: String,
    /// Its content.
    pub data: Vec<u8>,
}

/// A whole log in memory.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct LogContents {
    /// Messages in the order in which they were recorded.
    pub entries: Vec<LogEntry>,
    /// Attached files.
    pub attachments: Vec<Attachment>,
    /// What could not be read; empty for a finished, sound log.
    pub losses: Vec<LogLoss>,
}

/// Reads all of `path`.
///
/// # Errors
/// When the file cannot be opened or is no MCAP log. Cuts and damage inside are [`LogContents::losses`].
pub fn read_log(path: &Path) -> Result<LogContents, RecordError> {
    let mut reader = LogReader::open(path)?;
    let entries = reader.by_ref().collect();
    Ok(LogContents { entries, attachments: std::mem::take(&mut reader.attachments), losses: reader.losses })
}

trait ReadSeek: Read + Seek + Send {}
impl<T: Read + Seek + Send> ReadSeek for T {}

struct Channel {
    topic: Arc<str>,
    schema_id: u16,
    encoding: Arc<str>,
}

struct Schema {
    name: Arc<str>,
    encoding: String,
    data: Vec<u8>,
}

/// Iterates over the messages of a log, one chunk in memory at a time.
pub struct LogReader {
    path: PathBuf,
    source: Box<dyn ReadSeek>,
    at_byte: u64,
    length: u64,
    /// Where the record begins that the ready messages are of.
    record_at: u64,
    schemas: HashMap<u16, Schema>,
    channels: HashMap<u16, Channel>,
    ready: std::collections::VecDeque<LogEntry>,
    attachments: Vec<Attachment>,
    losses: Vec<LogLoss>,
    /// Losses beyond those that are kept.
    more_losses: u64,
    messages: u64,
    finished: bool,
    ended: bool,
}

impl std::fmt::Debug for LogReader {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("LogReader").field("path", &self.path).field("at_byte", &self.at_byte).finish_non_exhaustive()
    }
}

impl LogReader {
    /// Opens `path` and checks its first bytes.
    ///
    /// # Errors
    /// When the file cannot be opened or does not begin as MCAP files do. A log cut within its first eight bytes is an empty log with a
    /// loss.
    pub fn open(path: &Path) -> Result<Self, RecordError> {
        let OpenFile { file, stamp } = open_regular(path, u64::MAX).map_err(|fault| match fault {
            OpenFault::NotRegular(NotRegular::Folder) => RecordError::Folder { path: path.to_owned() },
            other => RecordError::Io { path: path.to_owned(), source: other.into() },
        })?;
        Self::new(path, Box::new(BufReader::with_capacity(1 << 20, file)), stamp.bytes)
    }

    /// Reads a log held in memory; `path` serves messages only.
    ///
    /// # Errors
    /// As [`LogReader::open`].
    pub fn from_bytes(path: &Path, bytes: Vec<u8>) -> Result<Self, RecordError> {
        let length = bytes.len() as u64;
        Self::new(path, Box::new(std::io::Cursor::new(bytes)), length)
    }

    fn new(path: &Path, source: Box<dyn ReadSeek>, length: u64) -> Result<Self, RecordError> {
        let mut reader = Self {
            path: path.to_owned(),
            source,
            at_byte: 0,
            length,
            record_at: 0,
            schemas: HashMap::new(),
            channels: HashMap::new(),
            ready: std::collections::VecDeque::new(),
            attachments: Vec::new(),
            losses: Vec::new(),
            more_losses: 0,
            messages: 0,
            finished: false,
            ended: false,
        };
        let magic = reader.read_up_to(mcap::MAGIC.len() as u64);
        // A log that is being written may have grown since it was opened.
        reader.length = reader.length.max(reader.at_byte);
        if !mcap::MAGIC.starts_with(&magic) || magic.is_empty() {
            let found = magic.iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().join(" ");
            let found = if found.is_empty() { "an empty file".into() } else { found };
            return Err(RecordError::NotALog { path: path.to_owned(), found });
        }
        if magic.len() < mcap::MAGIC.len() {
            reader.end(0, "cut within the first eight bytes".into());
        } else {
            let io = |source| RecordError::Io { path: path.to_owned(), source };
            let announced = announced_at_the_end(&mut reader.source, reader.length).map_err(io)?;
            if begins_with_other(&mut reader.source, reader.at_byte, reader.length).map_err(io)? {
                return Err(RecordError::Compression { path: path.to_owned() });
            }
            reader.source.seek(SeekFrom::Start(reader.at_byte)).map_err(io)?;
            announced.into_iter().for_each(|(opcode, body)| reader.record(0, opcode, &body));
        }
        Ok(reader)
    }

    /// What could not be read so far; complete once the iterator has ended.
    #[must_use]
    pub fn losses(&self) -> &[LogLoss] {
        &self.losses
    }

    /// Where in the file the chunk begins that the latest message came in.
    #[must_use]
    pub fn place(&self) -> u64 {
        self.record_at
    }

    /// Whether the log was closed: its footer was met.
    #[must_use]
    pub fn is_closed(&self) -> bool {
        self.finished
    }

    /// Bytes of the file.
    #[must_use]
    pub fn length(&self) -> u64 {
        self.length
    }

    /// Schema and encoding of a message of this log.
    pub(super) fn kind_of(&self, entry: &LogEntry) -> Option<Kind> {
        let schema = self.schemas.values().find(|schema| schema.name == entry.schema)?;
        Some(Kind {
            schema_name: schema.name.to_string(),
            schema_encoding: schema.encoding.clone().into(),
            schema_data: schema.data.clone().into(),
            message_encoding: entry.encoding.to_string().into(),
        })
    }

    /// Attached files met so far.
    #[must_use]
    pub fn attachments(&self) -> &[Attachment] {
        &self.attachments
    }

    /// Up to `count` bytes; fewer where the file ends or stops being readable.
    fn read_up_to(&mut self, count: u64) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(count.min(self.length.saturating_sub(self.at_byte)) as usize);
        if let Err(error) = self.source.by_ref().take(count).read_to_end(&mut bytes) {
            self.lose(self.at_byte + bytes.len() as u64, format!("reading failed: {error}"));
        }
        self.at_byte += bytes.len() as u64;
        bytes
    }

    fn lose(&mut self, at_byte: u64, reason: String) {
        if self.losses.len() < MAX_LOSSES {
            self.losses.push(LogLoss { at_byte, reason });
        } else {
            self.more_losses += 1;
        }
    }

    fn end(&mut self, at_byte: u64, reason: String) {
        self.lose(at_byte, reason);
        self.ended = true;
    }

    /// Goes on at the next whole chunk; without one the log ends here.
    fn skip_damage(&mut self, start: u64, reason: String) {
        let Some(next) = next_chunk(&mut self.source, start + 1, self.length, self.length) else {
            return self.end(start, reason);
        };
        if self.source.seek(SeekFrom::Start(next)).is_err() {
            return self.end(start, reason);
        }
        self.at_byte = next;
        self.lose(start, format!("{reason}; {} bytes were skipped up to the next whole chunk", next - start));
    }

    /// Where bytes are missing, a whole chunk may begin within what looks like the record before it.
    fn look_inside(&mut self, start: u64) {
        let next = next_chunk(&mut self.source, start + 1, self.at_byte, self.length).unwrap_or(self.at_byte);
        if let Err(error) = self.source.seek(SeekFrom::Start(next)) {
            return self.end(start, format!("reading failed: {error}"));
        }
        self.at_byte = next;
    }

    /// Says how many losses were counted only.
    fn close(&mut self) {
        if let more @ 1.. = std::mem::take(&mut self.more_losses) {
            self.losses.push(LogLoss { at_byte: self.at_byte, reason: format!("{more} more losses of the same kinds") });
        }
    }

    /// Reads one record of the file; may make messages ready.
    fn step(&mut self) {
        let start = self.at_byte;
        self.record_at = start;
        if self.finished {
            // Behind the footer only the closing magic is left, and nothing in it can be lost.
            if self.read_up_to(mcap::MAGIC.len() as u64) != mcap::MAGIC {
                self.lose(start, "the closing bytes are cut; all messages are there".into());
            }
            if self.at_byte < self.length {
                let behind = self.length - self.at_byte;
                let reason =
                    format!("{behind} bytes stand behind the end of the log and were not read: is it two logs in one file?");
                self.lose(self.at_byte, reason);
            }
            self.ended = true;
            return;
        }
        let header = self.read_up_to(RECORD_HEADER_BYTES);
        if header.is_empty() {
            return self.end(start, "the log was not closed: the program was stopped while recording".into());
        }
        let Some((&opcode, length)) = header.split_first().filter(|(_, length)| length.len() == 8) else {
            return self.end(start, "cut within the head of a record".into());
        };
        let length = length.iter().rev().fold(0u64, |value, &byte| value << 8 | u64::from(byte));
        let left = self.length.saturating_sub(self.at_byte);
        if length > MAX_RECORD_BYTES {
            return self.skip_damage(start, format!("record of {length} bytes is larger than any"));
        }
        let body = self.read_up_to(length);
        let whole = body.len() as u64 == length;
        match opcode {
            op::CHUNK if whole && is_other_head(&body, length) => {
                self.lose(start, format!("chunk of {length} bytes is compressed with lz4, which is not read here"));
            }
            // Where its own lengths disagree, that of the record may be wrong as well, and what follows is inside.
            op::CHUNK if whole && !is_head(&body, length) => {
                self.skip_damage(start, "the head of a chunk makes no sense".into());
            }
            op::CHUNK => {
                self.chunk(start, &body, whole);
                if !whole {
                    self.skip_damage(start, format!("cut within a chunk: {left} of {length} bytes are there"));
                }
            }
            _ if !whole => self.skip_damage(start, format!("cut within a record: {left} of {length} bytes are there")),
            // No record is of this kind, but a stretch of zeros looks like many.
            0 => self.skip_damage(start, "no record begins here".into()),
            _ => self.record(start, opcode, &body),
        }
    }

    /// A chunk: its messages become ready when its checksum is right, or as far as they can be read when it is cut.
    fn chunk(&mut self, start: u64, body: &[u8], whole: bool) {
        let Unpacked { records, damage } = unpack(body, whole);
        if let (Some(damage), true) = (&damage, whole) {
            self.lose(start, format!("chunk of {} bytes is damaged and was skipped: {damage}", body.len()));
            return self.look_inside(start);
        }
        let mut rest = records.as_slice();
        while let Some((&[opcode, a, b, c, d, e, f, g, h], later)) = rest.split_first_chunk::<9>() {
            let length = u64::from_le_bytes([a, b, c, d, e, f, g, h]);
            let Some(record) = usize::try_from(length).ok().and_then(|length| later.get(..length)) else { break };
            self.record(start, opcode, record);
            rest = &later[record.len()..];
        }
        if whole && !rest.is_empty() {
            self.lose(start, format!("the last {} bytes of a chunk are no whole record", rest.len()));
        }
    }

    fn record(&mut self, start: u64, opcode: u8, body: &[u8]) {
        if opcode == op::ATTACHMENT && !has_checksum(body) {
            return self.lose(start, "attachment is cut short and was skipped".into());
        }
        let record = match mcap::parse_record(opcode, body) {
            Ok(record) => record,
            Err(error) => return self.lose(start, format!("record of kind {opcode:#04x} is damaged and was skipped: {error}")),
        };
        match record {
            Record::Schema { header, data } => {
                let known = Schema { name: header.name.into(), encoding: header.encoding, data: data.into_owned() };
                self.schemas.insert(header.id, known);
            }
            Record::Channel(channel) => {
                let known = Channel {
                    topic: channel.topic.into(),
                    schema_id: channel.schema_id,
                    encoding: channel.message_encoding.into(),
                };
                self.channels.insert(channel.id, known);
            }
            Record::Message { header, data } => match self.channels.get(&header.channel_id) {
                Some(channel) => {
                    let entry = LogEntry {
                        topic: Arc::clone(&channel.topic),
                        schema: self.schemas.get(&channel.schema_id).map_or_else(|| "".into(), |schema| Arc::clone(&schema.name)),
                        encoding: Arc::clone(&channel.encoding),
                        host_us: (header.log_time / 1000) as i64,
                        sequence: header.sequence,
                        data: data.into_owned(),
                    };
                    self.messages += 1;
                    self.ready.push_back(entry);
                }
                None => self.lose(start, format!("message of unknown channel {}: its announcement was lost", header.channel_id)),
            },
            Record::Attachment { header, data, crc } => {
                // The checksum covers the record up to itself; 0 means that there is none.
                let computed = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&body[..body.len() - 4]);
                if crc != 0 && crc != computed {
                    return self.lose(start, format!("attachment {} is damaged and was skipped", header.name));
                }
                self.attachments.push(Attachment { name: header.name, media_type: header.media_type, data: data.into_owned() });
            }
            Record::Statistics(statistics) => self.check_counts(start, &statistics),
            Record::Footer(_) => self.finished = true,
            Record::Unknown { opcode, .. } => {
                self.lose(start, format!("record of unknown kind {opcode:#04x} was skipped"));
                self.look_inside(start);
            }
            _ => {}
        }
    }
}

impl LogReader {
    /// The writer's own counts catch whatever went missing without a trace.
    fn check_counts(&mut self, start: u64, statistics: &mcap::records::Statistics) {
        let read = [self.messages, self.attachments.len() as u64];
        let written = [statistics.message_count, u64::from(statistics.attachment_count)];
        for (what, read, written) in [("messages", read[0], written[0]), ("attachments", read[1], written[1])] {
            if read != written {
                self.lose(start, format!("{read} {what} were read, {written} had been recorded"));
            }
        }
    }
}

impl Iterator for LogReader {
    type Item = LogEntry;

    fn next(&mut self) -> Option<LogEntry> {
        loop {
            if let Some(entry) = self.ready.pop_front() {
                return Some(entry);
            }
            if self.ended {
                self.close();
                return None;
            }
            self.step();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_that_grew_while_it_was_opened_is_read() {
        for length in 0..mcap::MAGIC.len() as u64 {
            let source = Box::new(std::io::Cursor::new(mcap::MAGIC.to_vec()));
            let mut reader = LogReader::new(Path::new("growing.mcap"), source, length).expect("a log");
            assert!(reader.by_ref().next().is_none());
        }
    }
}
