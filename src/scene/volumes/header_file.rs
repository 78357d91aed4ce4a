//! Volumes that begin with a header of text lines, their voxels after it or in another file: NRRD and MetaImage. A helper reads the header
//! into a plan; the voxels are then read by the plan, from whichever file has them.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Seek, SeekFrom};

use super::head::{VolumeHead, VoxelSummary};
use super::voxels::{Encoding, VoxelLayout, cut_short, read_voxels, surplus};
use crate::foreign::Limits;

/// What a header says: enough to read the voxels.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct HeaderPlan {
    pub head: VolumeHead,
    pub layout: VoxelLayout,
    pub data: DataPlace,
}

/// Where voxels begin.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub(super) struct DataPlace {
    /// The file that has them, as the header names it; `None`: the header's own.
    pub file: Option<String>,
    /// They are the last bytes of the file, whatever comes before.
    pub at_end: bool,
    /// Bytes before them; the header's own where they are in its file.
    pub skip_bytes: u64,
    /// Lines after those bytes.
    pub skip_lines: u64,
    /// Bytes after those lines, of what comes out where they are compressed.
    pub skip_decoded_bytes: u64,
}

/// More than a header of text takes.
const MOST_HEADER_BYTES: u64 = 1 << 20;
/// A text of a header that may be repeated in a sentence has at most so many characters.
const MOST_SHOWN: usize = 24;
/// Bytes after a compressed stream that are counted, at most.
const MOST_BEHIND: u64 = 1 << 20;

/// What the header of `file` says, as `plan_of` reads it.
///
/// # Errors
/// One sentence, when it cannot be read, the header is none, or the file is too short for what it promises.
pub(super) fn plan_of_file(
    mut file: File,
    limits: &Limits,
    plan_of: fn(&[u8], &Limits) -> Result<HeaderPlan, String>,
) -> Result<HeaderPlan, String> {
    let unreadable = |error: std::io::Error| format!("cannot be read ({error})");
    let file_bytes = file.metadata().map_err(unreadable)?.len();
    let mut bytes = Vec::new();
    (&mut file).take(MOST_HEADER_BYTES).read_to_end(&mut bytes).map_err(unreadable)?;
    let plan = plan_of(&bytes, limits)?;
    if plan.data.file.is_none() {
        check_fits(&plan, file_bytes)?;
    }
    Ok(plan)
}

/// A line of a header at `at`, without its end; `at` moves past it. `None` at the end of what was read. The last line of a file needs no end.
pub(super) fn next_line(bytes: &[u8], at: &mut usize) -> Option<String> {
    let rest = bytes.get(*at..).filter(|rest| !rest.is_empty())?;
    let is_whole_file = (bytes.len() as u64) < MOST_HEADER_BYTES;
    let length = rest.iter().position(|byte| *byte == b'\n').or(is_whole_file.then_some(rest.len()))?;
    *at = bytes.len().min(*at + length + 1);
    Some(String::from_utf8_lossy(&rest[..length]).trim_end_matches('\r').to_owned())
}

/// What a header says, as far as it may be repeated: headers hold names of persons, but hardly in short plain words.
pub(super) fn shown(text: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || " -_.,()".contains(c);
    if text.len() <= MOST_SHOWN && text.chars().all(plain) { format!("'{text}'") } else { "something else".to_owned() }
}

/// Numbers with white space between them.
///
/// # Errors
/// When one is none, or there are more or fewer than `count`.
pub(super) fn numbers<T: std::str::FromStr>(key: &str, text: &str, count: usize) -> Result<Vec<T>, String> {
    let words: Vec<&str> = text.split_whitespace().collect();
    let found: Option<Vec<T>> = words.iter().map(|word| word.parse().ok()).collect();
    found.filter(|found| found.len() == count).ok_or_else(|| {
        let what = if count == 1 { "a number".to_owned() } else { format!("{count} numbers") };
        format!("'{key}' of its header is {}, expected {what}", shown(text))
    })
}

/// Refuses voxels that cannot be in a file of `file_bytes` bytes; only of voxels that are not compressed is that known.
///
/// # Errors
/// One sentence.
fn check_fits(plan: &HeaderPlan, file_bytes: u64) -> Result<(), String> {
    if plan.layout.encoding != Encoding::Raw {
        return Ok(());
    }
    let data_bytes = plan.head.voxels().saturating_mul(plan.layout.number.bytes() as u64);
    let needed = data_bytes.saturating_add(plan.data.skip_bytes).saturating_add(plan.data.skip_decoded_bytes);
    if file_bytes < needed {
        return Err(format!("cut short: its header promises {needed} bytes, the file has {file_bytes}; copy it again"));
    }
    Ok(())
}

/// Reads the voxels of `plan` from the file that has them.
///
/// # Errors
/// One sentence, when the file is damaged or cut short, or `start` or `take` gives up.
pub(super) fn decode_planned(
    mut file: File,
    plan: &HeaderPlan,
    start: &mut dyn FnMut(&VolumeHead) -> Result<(), String>,
    take: &mut dyn FnMut(&[f32]) -> Result<(), String>,
) -> Result<VoxelSummary, String> {
    let unreadable = |error: std::io::Error| format!("cannot be read ({error})");
    let file_bytes = file.metadata().map_err(unreadable)?.len();
    check_fits(plan, file_bytes)?;
    start(&plan.head)?;
    let (voxels, data) = (plan.head.voxels(), &plan.data);
    let from = if data.at_end { file_bytes - voxels * plan.layout.number.bytes() as u64 } else { data.skip_bytes };
    file.seek(SeekFrom::Start(from)).map_err(unreadable)?;
    let mut stream = BufReader::with_capacity(1 << 18, file);
    let mut lines_bytes = 0;
    for _ in 0..data.skip_lines {
        // Line by line: there may be no end of one.
        let line_bytes = stream.skip_until(b'\n').map_err(unreadable)? as u64;
        if line_bytes == 0 {
            return Err(cut_short(&std::io::ErrorKind::UnexpectedEof.into(), 0, voxels));
        }
        lines_bytes += line_bytes;
    }
    // Headers that mean zlib are found before gzip, too; its first bytes tell them apart.
    let is_gzip = stream.fill_buf().map_err(unreadable)?.starts_with(&[0x1f, 0x8b]);
    let mut decoded: Box<dyn BufRead + '_> = match plan.layout.encoding {
        Encoding::Raw | Encoding::Text => Box::new(&mut stream),
        Encoding::Gzip | Encoding::Zlib if is_gzip => {
            Box::new(BufReader::with_capacity(1 << 18, flate2::bufread::MultiGzDecoder::new(&mut stream)))
        }
        Encoding::Gzip | Encoding::Zlib => {
            Box::new(BufReader::with_capacity(1 << 18, flate2::bufread::ZlibDecoder::new(&mut stream)))
        }
    };
    let skipped = std::io::copy(&mut (&mut decoded).take(data.skip_decoded_bytes), &mut std::io::sink());
    if skipped.map_err(|error| cut_short(&error, 0, voxels))? < data.skip_decoded_bytes {
        return Err(cut_short(&std::io::ErrorKind::UnexpectedEof.into(), 0, voxels));
    }
    let mut summary = read_voxels(&mut decoded, voxels, &plan.layout, take)?;
    drop(decoded);
    let number = plan.layout.number;
    match plan.layout.encoding {
        Encoding::Raw => {
            let end = from + lines_bytes + data.skip_decoded_bytes + voxels * number.bytes() as u64;
            summary.remarks.extend(surplus(file_bytes.saturating_sub(end), voxels, number));
        }
        // What follows a stream that has ended, and is none of it.
        Encoding::Zlib if !is_gzip => {
            let behind = std::io::copy(&mut stream.take(MOST_BEHIND), &mut std::io::sink()).map_err(unreadable)?;
            if behind > 0 && summary.remarks.is_empty() {
                let words = format!("{behind} bytes follow the compressed voxels: is it one file?");
                summary.remarks.push((Some("more bytes".to_owned()), words));
            }
        }
        Encoding::Text | Encoding::Gzip | Encoding::Zlib => {}
    }
    Ok(summary)
}
