//! Whether a file is whole, seen from its own structure: decoders of images fill what is missing with grey or zeros and say nothing.

use super::Fault;

/// The eight bytes that start a PNG.
const PNG_MAGIC_BYTES: usize = 8;

fn damaged(kind: &str, detail: &str) -> Fault {
    Fault::Raster { kind: kind.into(), detail: detail.into() }
}

/// Columns and rows of a PNG by its first chunk.
pub(super) fn png_size(bytes: &[u8]) -> Result<[u64; 2], Fault> {
    let number =
        |at: usize| bytes.get(at..at + 4).map(|four| u64::from(u32::from_be_bytes([four[0], four[1], four[2], four[3]])));
    match (bytes.get(12..16), number(16), number(20)) {
        (Some(b"IHDR"), Some(width), Some(height)) => Ok([width, height]),
        _ => Err(damaged("PNG", "it ends in its header")),
    }
}

/// Walks the chunks of a PNG to its end mark.
pub(super) fn check_png_end(bytes: &[u8]) -> Result<(), Fault> {
    let mut at = PNG_MAGIC_BYTES;
    while let Some(head) = bytes.get(at..at + 8) {
        let length = u32::from_be_bytes([head[0], head[1], head[2], head[3]]) as usize;
        // Length, kind, content, checksum.
        at = at.saturating_add(12).saturating_add(length);
        if at > bytes.len() {
            break;
        }
        if &head[4..8] == b"IEND" {
            return Ok(());
        }
    }
    Err(damaged("PNG", "its end mark is missing"))
}

/// Strips or tiles of one TIFF page: all there, all within the file of `file_bytes`, none without content.
pub(super) fn check_strips(offsets: &[u64], counts: &[u64], file_bytes: u64) -> Result<(), Fault> {
    if offsets.is_empty() || offsets.len() != counts.len() {
        return Err(damaged("TIFF", "its table of strips is not complete"));
    }
    for (offset, count) in offsets.iter().zip(counts) {
        if *offset == 0 || *count == 0 {
            return Err(damaged("TIFF", "a strip has no content yet"));
        }
        if offset.checked_add(*count).is_none_or(|end| end > file_bytes) {
            return Err(damaged("TIFF", "a strip lies beyond the end of the file"));
        }
    }
    Ok(())
}

const RLE: &str = "1.2.840.10008.1.2.5";
/// Identifiers of all JPEG syntaxes start so; those of JPEG 2000 and later (90 and more) are not read.
const JPEG: &str = "1.2.840.10008.1.2.4.";

/// Compressed DICOM pixels: a JPEG stream must be complete and agree with the header in its size and its one component, RLE in its number of
/// byte planes. `size` is columns and rows.
pub(super) fn check_fragments(fragments: &[Vec<u8>], syntax: &str, size: [u64; 2], sample_bytes: usize) -> Result<(), Fault> {
    let missing = || Fault::Dicom { detail: "its compressed pixels are not complete".into() };
    if fragments.iter().all(Vec::is_empty) {
        return Err(missing());
    }
    if syntax == RLE {
        return fragments.iter().try_for_each(|fragment| check_rle(fragment, sample_bytes));
    }
    if !syntax.starts_with(JPEG) {
        return Ok(());
    }
    // One image may go over several fragments: each start is checked where it is, the end only at the last.
    let Some(last) = fragments.last() else { return Err(missing()) };
    let content = last.iter().rposition(|byte| *byte != 0).map_or(0, |at| at + 1);
    if !last[..content].ends_with(&[0xff, 0xd9]) {
        return Err(missing());
    }
    for fragment in fragments.iter().filter(|fragment| fragment.starts_with(&[0xff, 0xd8])) {
        let (found, components) = jpeg_size(fragment).ok_or_else(missing)?;
        if found != size {
            return Err(Fault::Disagreement {
                header: format!("{} x {} pixels", size[0], size[1]),
                stream: format!("{} x {} pixels", found[0], found[1]),
            });
        }
        if components != 1 {
            return Err(Fault::Disagreement {
                header: "one sample per pixel".into(),
                stream: format!("{components} samples per pixel"),
            });
        }
    }
    Ok(())
}

/// Columns, rows and components in the frame header of a JPEG stream.
fn jpeg_size(stream: &[u8]) -> Option<([u64; 2], u8)> {
    let word = |at: usize| stream.get(at..at + 2).map(|two| usize::from(u16::from_be_bytes([two[0], two[1]])));
    let mut at = 2;
    loop {
        let (mark, kind) = (*stream.get(at)?, *stream.get(at + 1)?);
        if mark != 0xff {
            return None;
        }
        match kind {
            0xff => at += 1,
            0x01 | 0xd0..=0xd7 => at += 2,
            // Frame headers; C4, C8 and CC in their row are tables.
            0xc0..=0xc3 | 0xc5..=0xc7 | 0xc9..=0xcb | 0xcd..=0xcf => {
                return Some(([word(at + 7)? as u64, word(at + 5)? as u64], *stream.get(at + 9)?));
            }
            _ => at += 2 + word(at + 2)?,
        }
    }
}

/// The header of an RLE fragment: the number of byte planes and where each starts.
fn check_rle(fragment: &[u8], planes: usize) -> Result<(), Fault> {
    let number = |index: usize| {
        let four = fragment.get(4 * index..4 * index + 4)?;
        Some(u32::from_le_bytes([four[0], four[1], four[2], four[3]]) as usize)
    };
    let damaged = || Fault::Dicom { detail: "the table of its run-length planes is damaged".into() };
    let found = number(0).ok_or_else(damaged)?;
    if found != planes {
        return Err(Fault::Disagreement {
            header: format!("{planes} bytes per pixel"),
            stream: format!("{found} run-length planes"),
        });
    }
    let mut before = 64;
    for plane in 1..=planes {
        let start = number(plane).filter(|start| *start >= before && *start < fragment.len()).ok_or_else(damaged)?;
        before = start + 1;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_jpeg_stream_must_end_and_agree() {
        let stream = |height: u8, components: u8| {
            let mut bytes =
                vec![0xff, 0xd8, 0xff, 0xe0, 0, 4, 1, 2, 0xff, 0xc0, 0, 11, 8, 0, height, 0, 4, components, 1, 0x11, 0];
            bytes.extend([0xff, 0xd9, 0]);
            bytes
        };
        let check = |bytes: Vec<u8>| check_fragments(&[bytes], "1.2.840.10008.1.2.4.50", [4, 2], 1);
        assert_eq!(check(stream(2, 1)), Ok(()));
        assert!(matches!(check(stream(3, 1)), Err(Fault::Disagreement { .. })));
        assert!(matches!(check(stream(2, 3)), Err(Fault::Disagreement { .. })));
        let mut cut = stream(2, 1);
        cut.truncate(cut.len() - 2);
        assert!(matches!(check(cut), Err(Fault::Dicom { .. })));
    }

    #[test]
    fn run_length_planes_are_counted() {
        let fragment = |planes: u8, starts: [u8; 2]| {
            let mut bytes = vec![0u8; 80];
            (bytes[0], bytes[4], bytes[8]) = (planes, starts[0], starts[1]);
            bytes
        };
        assert_eq!(check_rle(&fragment(2, [64, 70]), 2), Ok(()));
        for wrong in [fragment(3, [64, 70]), fragment(2, [64, 80]), fragment(2, [70, 66]), fragment(2, [3, 66]), vec![2]] {
            assert!(check_rle(&wrong, 2).is_err());
        }
    }

    #[test]
    fn strips_must_lie_in_the_file() {
        assert_eq!(check_strips(&[8, 20], &[12, 12], 32), Ok(()));
        for (offsets, counts) in [(vec![8, 21], vec![12, 12]), (vec![8, 0], vec![12, 12]), (vec![8], vec![0]), (vec![], vec![])] {
            assert!(check_strips(&offsets, &counts, 32).is_err(), "{offsets:?}");
        }
        assert!(check_strips(&[u64::MAX], &[2], 32).is_err());
    }
}
