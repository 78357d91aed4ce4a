//! Finds its way back into a log behind damage: the next whole chunk.

use std::io::{Read, Seek, SeekFrom};

use super::unpack::{is_head, unpack};

/// No record of ours is longer.
pub(super) const MAX_RECORD_BYTES: u64 = 512 << 20;
/// Opcode and length of a record.
const RECORD_HEAD: usize = 9;
/// What of a chunk must be there to see that it may be one.
const CHUNK_HEAD: usize = RECORD_HEAD + 64;
/// Bytes that are looked at together.
const WINDOW: usize = 1 << 20;

/// Where in a file of `length` bytes the next chunk whose checksum is right begins, in `from..until`. Chance hardly makes one: the lengths in
/// its head must agree. Of what only looks like chunks no more is read than the file is long.
pub(super) fn next_chunk(source: &mut (impl Read + Seek), from: u64, until: u64, length: u64) -> Option<u64> {
    let (mut at, mut readable) = (from, length);
    while at < until && at + (CHUNK_HEAD as u64) < length {
        source.seek(SeekFrom::Start(at)).ok()?;
        let mut window = Vec::with_capacity(WINDOW);
        source.by_ref().take(WINDOW as u64).read_to_end(&mut window).ok()?;
        let last = window.len().checked_sub(CHUNK_HEAD)?;
        for offset in (0..=last).filter(|offset| window[*offset] == mcap::records::op::CHUNK) {
            let place = at + offset as u64;
            if place >= until || readable == 0 {
                return None;
            }
            if is_chunk(source, &window[offset..], place, length, &mut readable) {
                return Some(place);
            }
        }
        at += last as u64 + 1;
    }
    None
}

/// Whether a whole chunk begins at `place`, of which `start` holds the first bytes.
fn is_chunk(source: &mut (impl Read + Seek), start: &[u8], place: u64, length: u64, readable: &mut u64) -> bool {
    let Some((bytes, rest)) = start[1..].split_first_chunk::<8>() else { return false };
    let body_bytes = u64::from_le_bytes(*bytes);
    let fits =
        place.checked_add(RECORD_HEAD as u64).and_then(|body| body.checked_add(body_bytes)).is_some_and(|end| end <= length);
    if !fits || body_bytes > MAX_RECORD_BYTES || !is_head(rest, body_bytes) {
        return false;
    }
    *readable = readable.saturating_sub(body_bytes);
    let mut body = Vec::new();
    let read = source
        .seek(SeekFrom::Start(place + RECORD_HEAD as u64))
        .and_then(|_| source.by_ref().take(body_bytes).read_to_end(&mut body));
    read.is_ok_and(|read| read as u64 == body_bytes) && unpack(&body, true).damage.is_none()
}
