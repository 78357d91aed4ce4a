//! A log compressed in a way that is not read here is told from one that is damaged.

use std::io::{Read, Result, Seek, SeekFrom};

use mcap::records::op;

use super::unpack::is_other_head;

/// Opcode and length of a record.
const RECORD_HEAD: usize = 9;
/// What of a chunk is looked at: its head.
const CHUNK_HEAD: usize = 64;
/// The first chunk is sought behind so many records: a head, schemas and channels, attachments.
const RECORDS: usize = 256;

/// Whether the first chunk behind byte `from` of a file of `length` bytes is compressed with lz4.
///
/// # Errors
/// When the file cannot be read.
pub(super) fn begins_with_other(source: &mut (impl Read + Seek), from: u64, length: u64) -> Result<bool> {
    let mut at = from;
    for _ in 0..RECORDS {
        source.seek(SeekFrom::Start(at))?;
        let mut start = Vec::new();
        source.by_ref().take((RECORD_HEAD + CHUNK_HEAD) as u64).read_to_end(&mut start)?;
        let Some((&[opcode, ref stated @ ..], body)) = start.split_first_chunk::<RECORD_HEAD>() else { return Ok(false) };
        let stated: &[u8; 8] = stated;
        let body_bytes = u64::from_le_bytes(*stated);
        match (opcode, at.checked_add(RECORD_HEAD as u64).and_then(|body_at| body_at.checked_add(body_bytes))) {
            (op::CHUNK, _) => return Ok(is_other_head(body, body_bytes)),
            (_, Some(next)) if next < length => at = next,
            _ => return Ok(false),
        }
    }
    Ok(false)
}
