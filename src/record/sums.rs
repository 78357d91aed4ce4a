//! The checksums of a finished log that its chunks do not have: of all its data, and of its summary.

use std::io::{BufReader, Read};
use std::path::Path;

use mcap::records::op;

use super::{LogLoss, RecordError};
use crate::regular;

/// Opcode and length in front of every record.
const RECORD_HEAD: usize = 9;

/// What is wrong with these checksums; nothing where the log has none because it was not closed. A log that cannot be followed to its end
/// is not judged here: [`super::LogReader`] says where it breaks.
///
/// # Errors
/// When the file cannot be read.
pub fn wrong_sums(path: &Path) -> Result<Vec<LogLoss>, RecordError> {
    let io = |source| RecordError::Io { path: path.to_owned(), source };
    let file = regular::open(path).map_err(io)?;
    let length = file.metadata().map_err(io)?.len();
    Ok(of(&mut BufReader::with_capacity(1 << 20, file), length).map_err(io)?.unwrap_or_default())
}

/// `None` where the log breaks off.
fn of(source: &mut impl Read, length: u64) -> std::io::Result<Option<Vec<LogLoss>>> {
    let (mut wrong, mut sum, mut at) = (Vec::new(), crc32fast::Hasher::new(), 0u64);
    let Some(magic) = taken(source, mcap::MAGIC.len())? else { return Ok(None) };
    sum.update(&magic);
    at += magic.len() as u64;
    loop {
        let Some(head) = taken(source, RECORD_HEAD)? else { return Ok(None) };
        let Some((&opcode, size)) = head.split_first().and_then(|(opcode, rest)| Some((opcode, rest.first_chunk::<8>()?))) else {
            return Ok(None);
        };
        let bytes = u64::from_le_bytes(*size);
        if at.saturating_add(RECORD_HEAD as u64).saturating_add(bytes) > length {
            return Ok(None);
        }
        match opcode {
            op::DATA_END => {
                let Some(stored) = taken(source, bytes as usize)?.as_deref().and_then(last_four) else { return Ok(None) };
                let computed = std::mem::take(&mut sum).finalize();
                wrong.extend(difference(at, "the data", stored, computed));
            }
            op::FOOTER => {
                let Some(body) = taken(source, bytes as usize)? else { return Ok(None) };
                let Some(stored) = last_four(&body) else { return Ok(None) };
                sum.update(&head);
                sum.update(&body[..body.len() - 4]);
                wrong.extend(difference(at, "the summary", stored, sum.finalize()));
                return Ok(Some(wrong));
            }
            _ => {
                sum.update(&head);
                let mut left = bytes;
                while left > 0 {
                    let Some(part) = taken(source, left.min(1 << 20) as usize)? else { return Ok(None) };
                    sum.update(&part);
                    left -= part.len() as u64;
                }
            }
        }
        at += RECORD_HEAD as u64 + bytes;
    }
}

fn taken(source: &mut impl Read, bytes: usize) -> std::io::Result<Option<Vec<u8>>> {
    let mut part = Vec::new();
    source.by_ref().take(bytes as u64).read_to_end(&mut part)?;
    Ok(Some(part).filter(|part| part.len() == bytes))
}

fn last_four(body: &[u8]) -> Option<u32> {
    body.last_chunk::<4>().map(|bytes| u32::from_le_bytes(*bytes))
}

/// 0 means that there is no checksum.
fn difference(at_byte: u64, what: &str, stored: u32, computed: u32) -> Option<LogLoss> {
    let reason = format!("the checksum of {what} is {stored:#010x}, computed {computed:#010x}");
    (stored != 0 && stored != computed).then_some(LogLoss { at_byte, reason })
}
