//! The schemas and channels that a finished log repeats at its end: with them, messages stay readable even where the first chunk is damaged.

use std::io::{Read, Result, Seek, SeekFrom};

use mcap::records::op;

/// Opcode and length in front of every record.
const RECORD_HEAD: usize = 9;
/// Footer record (start of the summary and of its offsets, checksum), then the magic.
const TAIL_BYTES: u64 = (RECORD_HEAD + 20 + mcap::MAGIC.len()) as u64;
/// Head of the record that ends the data; its checksum of four bytes and the summary follow.
const DATA_END: [u8; RECORD_HEAD] = [op::DATA_END, 4, 0, 0, 0, 0, 0, 0, 0];
/// So much of the end of a file is looked through for it.
const LOOKED_THROUGH_BYTES: u64 = 8 << 20;

/// Records that announce schemas and channels, with their opcodes, from the end of a log of `length` bytes; none where it was not closed.
///
/// # Errors
/// When the file cannot be read.
pub(super) fn announced_at_the_end(source: &mut (impl Read + Seek), length: u64) -> Result<Vec<(u8, Vec<u8>)>> {
    let Some(footer_at) = length.checked_sub(TAIL_BYTES) else { return Ok(Vec::new()) };
    let footer = part(source, footer_at, TAIL_BYTES)?;
    let Some([op::FOOTER, rest @ ..]) = footer.strip_suffix(mcap::MAGIC) else { return Ok(Vec::new()) };
    let stated = rest.get(8..16).and_then(|bytes| bytes.first_chunk()).map_or(0, |bytes| u64::from_le_bytes(*bytes));
    if (1..footer_at).contains(&stated) {
        let found = announcements(&part(source, stated, footer_at - stated)?);
        if !found.is_empty() {
            return Ok(found);
        }
    }
    // Where bytes are missing before it, the summary is not where the footer says.
    let from = footer_at.saturating_sub(LOOKED_THROUGH_BYTES);
    let end = part(source, from, footer_at - from)?;
    let starts = end.windows(RECORD_HEAD).enumerate().filter(|(_, head)| **head == DATA_END);
    let found = starts.filter_map(|(at, _)| end.get(at + RECORD_HEAD + 4..)).map(announcements).find(|found| !found.is_empty());
    Ok(found.unwrap_or_default())
}

fn part(source: &mut (impl Read + Seek), from: u64, bytes: u64) -> Result<Vec<u8>> {
    source.seek(SeekFrom::Start(from))?;
    let mut part = Vec::new();
    source.by_ref().take(bytes).read_to_end(&mut part)?;
    Ok(part)
}

/// Those among the records that follow one another from the first byte on.
fn announcements(mut rest: &[u8]) -> Vec<(u8, Vec<u8>)> {
    let mut found = Vec::new();
    while let Some((&[opcode, ref length @ ..], later)) = rest.split_first_chunk::<RECORD_HEAD>() {
        let length: &[u8; 8] = length;
        let Some(body) = usize::try_from(u64::from_le_bytes(*length)).ok().and_then(|length| later.get(..length)) else { break };
        if matches!(opcode, op::SCHEMA | op::CHANNEL) && mcap::parse_record(opcode, body).is_ok() {
            found.push((opcode, body.to_vec()));
        }
        rest = &later[body.len()..];
    }
    found
}
