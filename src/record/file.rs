//! An MCAP file as it is written: chunks one after the other, at the end the summary.

use std::io::Write;

use mcap::records::op;

use super::channel::Kind;
use super::chunk::{ClosedChunk, OpenChunk, put_record, put_text};

/// Writes records in order and remembers what the summary needs.
pub(super) struct LogFile<W> {
    target: W,
    at: u64,
    /// Checksum of all bytes from the start.
    data_crc: crc32fast::Hasher,
    schemas: Vec<u8>,
    schema_names: Vec<String>,
    channels: Vec<u8>,
    channel_count: u32,
    chunk_indexes: Vec<u8>,
    chunk_count: u32,
    attachment_indexes: Vec<u8>,
    attachment_count: u32,
    /// Messages of channel 1, 2, ….
    counts: Vec<u64>,
    span_ns: Option<(u64, u64)>,
}

impl<W: Write> LogFile<W> {
    pub(super) fn start(target: W) -> std::io::Result<Self> {
        let mut file = Self {
            target,
            at: 0,
            data_crc: crc32fast::Hasher::new(),
            schemas: Vec::new(),
            schema_names: Vec::new(),
            channels: Vec::new(),
            channel_count: 0,
            chunk_indexes: Vec::new(),
            chunk_count: 0,
            attachment_indexes: Vec::new(),
            attachment_count: 0,
            counts: Vec::new(),
            span_ns: None,
        };
        let mut head = mcap::MAGIC.to_vec();
        let mut body = Vec::new();
        put_text(&mut body, "sidecarm");
        put_text(&mut body, concat!("sidecarm ", env!("CARGO_PKG_VERSION")));
        put_record(&mut head, op::HEADER, &[&body]);
        file.write(&head)?;
        Ok(file)
    }

    fn write(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        self.target.write_all(bytes)?;
        self.data_crc.update(bytes);
        self.at += bytes.len() as u64;
        Ok(())
    }

    /// Bytes of the log so far.
    pub(super) fn at(&self) -> u64 {
        self.at
    }

    pub(super) fn target(&mut self) -> &mut W {
        &mut self.target
    }

    /// Announces channel `id` (they count from 1) in `chunk`.
    pub(super) fn announce(&mut self, chunk: &mut OpenChunk, id: u16, topic: &str, kind: &Kind) {
        let schema_id = match self.schema_names.iter().position(|name| *name == kind.schema_name) {
            Some(index) => index as u16 + 1,
            None => {
                self.schema_names.push(kind.schema_name.clone());
                let schema_id = self.schema_names.len() as u16;
                let mut body = schema_id.to_le_bytes().to_vec();
                put_text(&mut body, &kind.schema_name);
                put_text(&mut body, &kind.schema_encoding);
                body.extend((kind.schema_data.len() as u32).to_le_bytes());
                body.extend_from_slice(&kind.schema_data);
                let mut record = Vec::new();
                put_record(&mut record, op::SCHEMA, &[&body]);
                chunk.announce(&record);
                self.schemas.extend(record);
                schema_id
            }
        };
        let mut body = id.to_le_bytes().to_vec();
        body.extend(schema_id.to_le_bytes());
        put_text(&mut body, topic);
        put_text(&mut body, &kind.message_encoding);
        body.extend(0u32.to_le_bytes());
        let mut record = Vec::new();
        put_record(&mut record, op::CHANNEL, &[&body]);
        chunk.announce(&record);
        self.channels.extend(record);
        self.channel_count += 1;
    }

    pub(super) fn chunk(&mut self, chunk: &ClosedChunk) -> std::io::Result<()> {
        let at = self.at;
        self.write(&chunk.bytes)?;
        self.chunk_indexes.extend(chunk.place.index_record(at, chunk.bytes.len() as u64));
        self.chunk_count += 1;
        for (channel, count) in &chunk.counts {
            let index = usize::from(*channel);
            if self.counts.len() <= index {
                self.counts.resize(index + 1, 0);
            }
            self.counts[index] += count;
        }
        if let Some((first, last)) = chunk.place.span_ns() {
            let known = self.span_ns.unwrap_or((first, last));
            self.span_ns = Some((known.0.min(first), known.1.max(last)));
        }
        Ok(())
    }

    pub(super) fn attachment(&mut self, name: &str, media_type: &str, time_ns: u64, data: &[u8]) -> std::io::Result<()> {
        let mut head = Vec::new();
        head.extend(time_ns.to_le_bytes());
        head.extend(time_ns.to_le_bytes());
        put_text(&mut head, name);
        put_text(&mut head, media_type);
        head.extend((data.len() as u64).to_le_bytes());
        let mut crc = crc32fast::Hasher::new();
        crc.update(&head);
        crc.update(data);
        let mut record = Vec::new();
        put_record(&mut record, op::ATTACHMENT, &[&head, data, &crc.finalize().to_le_bytes()]);
        let mut body = Vec::new();
        for number in [self.at, record.len() as u64, time_ns, time_ns, data.len() as u64] {
            body.extend(number.to_le_bytes());
        }
        put_text(&mut body, name);
        put_text(&mut body, media_type);
        self.write(&record)?;
        put_record(&mut self.attachment_indexes, op::ATTACHMENT_INDEX, &[&body]);
        self.attachment_count += 1;
        Ok(())
    }

    /// Messages recorded on channel `id`.
    pub(super) fn count(&self, id: u16) -> u64 {
        self.counts.get(usize::from(id)).copied().unwrap_or(0)
    }

    /// Ends the data, writes summary and footer.
    pub(super) fn finish(&mut self) -> std::io::Result<()> {
        let mut end = Vec::new();
        put_record(&mut end, op::DATA_END, &[&self.data_crc.clone().finalize().to_le_bytes()]);
        self.write(&end)?;
        let summary_start = self.at;
        let mut summary = Vec::new();
        let mut offsets = Vec::new();
        let statistics = self.statistics();
        let groups = [
            (op::SCHEMA, &self.schemas),
            (op::CHANNEL, &self.channels),
            (op::STATISTICS, &statistics),
            (op::CHUNK_INDEX, &self.chunk_indexes),
            (op::ATTACHMENT_INDEX, &self.attachment_indexes),
        ];
        for (opcode, records) in groups.into_iter().filter(|(_, records)| !records.is_empty()) {
            let start = summary_start + summary.len() as u64;
            put_record(
                &mut offsets,
                op::SUMMARY_OFFSET,
                &[&[opcode], &start.to_le_bytes(), &(records.len() as u64).to_le_bytes()],
            );
            summary.extend_from_slice(records);
        }
        let offsets_start = summary_start + summary.len() as u64;
        summary.extend(offsets);
        // The checksum covers the summary and the footer up to itself.
        let footer_length = 20u64;
        summary.push(op::FOOTER);
        summary.extend(footer_length.to_le_bytes());
        summary.extend(summary_start.to_le_bytes());
        summary.extend(offsets_start.to_le_bytes());
        summary.extend(crc32fast::hash(&summary).to_le_bytes());
        summary.extend_from_slice(mcap::MAGIC);
        self.write(&summary)
    }

    fn statistics(&self) -> Vec<u8> {
        let used: Vec<(u16, u64)> =
            self.counts.iter().enumerate().filter(|(_, count)| **count > 0).map(|(id, count)| (id as u16, *count)).collect();
        let mut body = Vec::new();
        body.extend(self.counts.iter().sum::<u64>().to_le_bytes());
        body.extend((self.schema_names.len() as u16).to_le_bytes());
        for number in [self.channel_count, self.attachment_count, 0, self.chunk_count] {
            body.extend(number.to_le_bytes());
        }
        let (first, last) = self.span_ns.unwrap_or((0, 0));
        body.extend(first.to_le_bytes());
        body.extend(last.to_le_bytes());
        body.extend((10 * used.len() as u32).to_le_bytes());
        for (id, count) in used {
            body.extend(id.to_le_bytes());
            body.extend(count.to_le_bytes());
        }
        let mut record = Vec::new();
        put_record(&mut record, op::STATISTICS, &[&body]);
        record
    }
}
