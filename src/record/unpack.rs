//! From a chunk as it lies in the file to its records, without trusting what it says of itself.

use std::io::Read;

/// No chunk of ours unpacks to more: a full one and the largest image.
const MAX_UNPACKED_BYTES: u64 = 256 << 20;

/// What is in a chunk.
#[derive(Debug)]
pub(super) struct Unpacked {
    /// Records, as far as they could be unpacked.
    pub(super) records: Vec<u8>,
    /// Why that is not all.
    pub(super) damage: Option<String>,
}

/// Head of a chunk: span, unpacked length, checksum, compression, packed length.
struct Head<'a> {
    unpacked_bytes: u64,
    crc: u32,
    compression: &'a [u8],
    packed_bytes: u64,
    packed: &'a [u8],
}

/// Whether `start`, the first bytes of something that is `body_bytes` long, is the head of a chunk: its lengths agree.
pub(super) fn is_head(start: &[u8], body_bytes: u64) -> bool {
    head(start, false).is_some_and(|head| {
        let agree = match head.compression {
            b"" => head.packed_bytes == head.unpacked_bytes,
            compression => compression == b"zstd",
        };
        let head_bytes = 16 + 8 + 4 + 4 + head.compression.len() as u64 + 8;
        agree && head_bytes.checked_add(head.packed_bytes) == Some(body_bytes)
    })
}

/// The same of a chunk that is whole and compressed in the other way that MCAP knows, which is not read here.
pub(super) fn is_other_head(start: &[u8], body_bytes: u64) -> bool {
    head(start, false).is_some_and(|head| {
        let head_bytes = 16 + 8 + 4 + 4 + head.compression.len() as u64 + 8;
        head.compression == b"lz4" && head_bytes.checked_add(head.packed_bytes) == Some(body_bytes)
    })
}

fn head(body: &[u8], whole: bool) -> Option<Head<'_>> {
    let (_span, rest) = body.split_at_checked(16)?;
    let (unpacked_bytes, rest) = rest.split_first_chunk::<8>()?;
    let (crc, rest) = rest.split_first_chunk::<4>()?;
    let (length, rest) = rest.split_first_chunk::<4>()?;
    let (compression, rest) = rest.split_at_checked(u32::from_le_bytes(*length) as usize)?;
    let (length, packed) = rest.split_first_chunk::<8>()?;
    let packed_bytes = u64::from_le_bytes(*length);
    let fits = !whole || packed_bytes == packed.len() as u64;
    let (unpacked_bytes, crc) = (u64::from_le_bytes(*unpacked_bytes), u32::from_le_bytes(*crc));
    fits.then_some(Head { unpacked_bytes, crc, compression, packed_bytes, packed })
}

/// Unpacks the body of a chunk record; of one that is cut (not `whole`) as much as there is, unchecked.
pub(super) fn unpack(body: &[u8], whole: bool) -> Unpacked {
    let damaged = |damage: String| Unpacked { records: Vec::new(), damage: Some(damage) };
    let Some(head) = head(body, whole) else { return damaged("its head makes no sense".into()) };
    let limit = head.unpacked_bytes;
    if limit > MAX_UNPACKED_BYTES {
        return damaged(format!("it says that it unpacks to {limit} bytes, more than any chunk"));
    }
    let mut records = Vec::new();
    let outcome = match head.compression {
        b"" => head.packed.take(limit + 1).read_to_end(&mut records),
        b"zstd" => zstd::stream::read::Decoder::new(head.packed)
            .and_then(|unpacking| unpacking.take(limit + 1).read_to_end(&mut records)),
        other => return damaged(format!("compression {} is not read here", String::from_utf8_lossy(other).escape_debug())),
    };
    let damage = match outcome {
        Err(error) => Some(error.to_string()),
        Ok(_) if records.len() as u64 != limit => Some(format!("it unpacks to {} bytes, {limit} were promised", records.len())),
        Ok(_) => {
            let computed = crc32fast::hash(&records);
            // 0 means that there is no checksum.
            let wrong = head.crc != 0 && head.crc != computed;
            wrong.then(|| format!("its checksum is {:#010x}, computed {computed:#010x}", head.crc))
        }
    };
    records.truncate(limit as usize);
    Unpacked { records, damage }
}

/// Whether four bytes are left behind the head of an attachment (two times, name, media type, length): mcap 0.26 counts on them.
pub(super) fn has_checksum(body: &[u8]) -> bool {
    let mut at = 16usize;
    for _ in 0..2 {
        let length = body.get(at..).and_then(|rest| rest.first_chunk::<4>()).map(|bytes| u32::from_le_bytes(*bytes) as usize);
        let Some(after) = length.and_then(|length| at.checked_add(4)?.checked_add(length)) else { return false };
        at = after;
    }
    at.checked_add(8 + 4).is_some_and(|end| end <= body.len())
}
