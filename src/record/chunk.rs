//! Chunks of an MCAP file: messages gathered in memory, compressed into one record that is written whole.

use std::collections::BTreeMap;

use mcap::records::op;

/// Level of zstd: telemetry shrinks to a third, and pixels cost little time.
const LEVEL: i32 = 1;
/// Smaller gains than this are not worth decompressing for.
const WORTH: f64 = 0.97;

/// Appends a record: kind, length, body.
pub(super) fn put_record(out: &mut Vec<u8>, opcode: u8, body: &[&[u8]]) {
    out.push(opcode);
    out.extend((body.iter().map(|part| part.len()).sum::<usize>() as u64).to_le_bytes());
    body.iter().for_each(|part| out.extend_from_slice(part));
}

/// A string as MCAP writes it: length, then UTF-8.
pub(super) fn put_text(out: &mut Vec<u8>, text: &str) {
    out.extend((text.len() as u32).to_le_bytes());
    out.extend_from_slice(text.as_bytes());
}

/// A chunk that still grows.
#[derive(Debug, Default)]
pub(super) struct OpenChunk {
    records: Vec<u8>,
    span_ns: Option<(u64, u64)>,
    /// Time and offset of the messages of each channel.
    indexes: BTreeMap<u16, Vec<(u64, u64)>>,
}

impl OpenChunk {
    /// Bytes before compression.
    pub(super) fn len(&self) -> usize {
        self.records.len()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.records.is_empty()
    }

    /// A record that is no message: a schema or a channel.
    pub(super) fn announce(&mut self, record: &[u8]) {
        self.records.extend_from_slice(record);
    }

    pub(super) fn message(&mut self, channel: u16, sequence: u32, log_time_ns: u64, data: &[u8]) {
        self.indexes.entry(channel).or_default().push((log_time_ns, self.records.len() as u64));
        let time = log_time_ns.to_le_bytes();
        let head = [&channel.to_le_bytes()[..], &sequence.to_le_bytes(), &time, &time];
        put_record(&mut self.records, op::MESSAGE, &[head[0], head[1], head[2], head[3], data]);
        self.span_ns = Some(
            self.span_ns.map_or((log_time_ns, log_time_ns), |(first, last)| (first.min(log_time_ns), last.max(log_time_ns))),
        );
    }

    /// Compresses; slow for large messages, so whoever has one does it on a thread of its own.
    pub(super) fn close(self) -> ClosedChunk {
        let (start_ns, end_ns) = self.span_ns.unwrap_or((0, 0));
        // Compression into memory fails only where memory does; the bytes are then kept as they are.
        let compressed = zstd::bulk::compress(&self.records, LEVEL).ok();
        let compressed = compressed.filter(|compressed| compressed.len() as f64 <= WORTH * self.records.len() as f64);
        let compression = if compressed.is_some() { "zstd" } else { "" };
        let stored = compressed.as_deref().unwrap_or(&self.records);
        let mut head = Vec::with_capacity(64);
        head.extend(start_ns.to_le_bytes());
        head.extend(end_ns.to_le_bytes());
        head.extend((self.records.len() as u64).to_le_bytes());
        head.extend(crc32fast::hash(&self.records).to_le_bytes());
        put_text(&mut head, compression);
        head.extend((stored.len() as u64).to_le_bytes());
        let mut bytes = Vec::with_capacity(stored.len() + 128 + 64 * self.indexes.len());
        put_record(&mut bytes, op::CHUNK, &[&head, stored]);
        let place = ChunkPlace {
            start_ns,
            end_ns,
            length: bytes.len() as u64,
            compression,
            compressed: stored.len() as u64,
            uncompressed: self.records.len() as u64,
            indexes: Vec::with_capacity(self.indexes.len()),
        };
        let mut chunk = ClosedChunk { place, counts: Vec::with_capacity(self.indexes.len()), bytes };
        for (channel, entries) in &self.indexes {
            chunk.place.indexes.push((*channel, chunk.bytes.len() as u64));
            chunk.counts.push((*channel, entries.len() as u64));
            let pairs: Vec<u8> = entries.iter().flat_map(|(time, at)| [time.to_le_bytes(), at.to_le_bytes()].concat()).collect();
            put_record(
                &mut chunk.bytes,
                op::MESSAGE_INDEX,
                &[&channel.to_le_bytes(), &(pairs.len() as u32).to_le_bytes(), &pairs],
            );
        }
        chunk
    }
}

/// A chunk record with its message indexes, ready to be written in one piece.
#[derive(Debug)]
pub(super) struct ClosedChunk {
    /// The chunk record, then its index records.
    pub(super) bytes: Vec<u8>,
    /// Messages per channel.
    pub(super) counts: Vec<(u16, u64)>,
    /// What the summary says of it.
    pub(super) place: ChunkPlace,
}

/// Span and sizes of a chunk; offsets count from its own start.
#[derive(Debug)]
pub(super) struct ChunkPlace {
    start_ns: u64,
    end_ns: u64,
    length: u64,
    compression: &'static str,
    compressed: u64,
    uncompressed: u64,
    indexes: Vec<(u16, u64)>,
}

impl ChunkPlace {
    /// The chunk index record of the summary, for a chunk written at `at` that takes `total` bytes with its message indexes.
    pub(super) fn index_record(&self, at: u64, total: u64) -> Vec<u8> {
        let mut body = Vec::with_capacity(128);
        for number in [self.start_ns, self.end_ns, at, self.length] {
            body.extend(number.to_le_bytes());
        }
        body.extend((10 * self.indexes.len() as u32).to_le_bytes());
        for (channel, offset) in &self.indexes {
            body.extend(channel.to_le_bytes());
            body.extend((offset + at).to_le_bytes());
        }
        body.extend((total - self.length).to_le_bytes());
        put_text(&mut body, self.compression);
        body.extend(self.compressed.to_le_bytes());
        body.extend(self.uncompressed.to_le_bytes());
        let mut record = Vec::with_capacity(body.len() + 9);
        put_record(&mut record, op::CHUNK_INDEX, &[&body]);
        record
    }

    /// First and last log time; `None` without a message.
    pub(super) fn span_ns(&self) -> Option<(u64, u64)> {
        (!self.indexes.is_empty()).then_some((self.start_ns, self.end_ns))
    }
}
