//! Files that were given their whole size before their content: zeros stand where nothing has been written so far.

use std::fs::File;
use std::ops::Range;

use sha2::{Digest, Sha256};

/// Zeros from which on a file may be unfinished: this share of it, and at least so many bytes in a row.
const LEAST_SHARE: u64 = 64;
const LEAST_BYTES: u64 = 512;
const CHUNK: usize = 1 << 16;

/// Whether a file of `bytes` bytes ends in zeros that may be unwritten; false where it cannot be read.
#[must_use]
pub fn ends_in_zeros(file: &File, bytes: u64) -> bool {
    let mut chunk = vec![0; CHUNK];
    let mut end = bytes;
    while end > 0 {
        let start = end.saturating_sub(CHUNK as u64);
        let part = &mut chunk[..(end - start) as usize];
        if read_at(file, part, start).is_none() {
            return false;
        }
        if let Some(last) = part.iter().rposition(|byte| *byte != 0) {
            return is_much(bytes - (start + last as u64 + 1), bytes);
        }
        end = start;
    }
    is_much(bytes, bytes)
}

fn is_much(zeros: u64, bytes: u64) -> bool {
    zeros >= LEAST_BYTES && zeros >= bytes / LEAST_SHARE
}

/// What is around the zeros of a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Written {
    /// Where zeros stand, from first to last.
    zeros: Vec<Range<u64>>,
    bytes: u64,
    sha256: [u8; 32],
}

impl Written {
    /// Of a file of `bytes` bytes; `None` where it has few zeros, nothing else, or cannot be read.
    #[must_use]
    pub fn around_zeros(file: &File, bytes: u64) -> Option<Self> {
        let written = Self::so_far(file, bytes)?;
        let all = written.zeros.iter().map(|run| run.end - run.start).sum();
        (is_much(all, bytes) && all < bytes).then_some(written)
    }

    /// Of any file of `bytes` bytes; `None` where it cannot be read.
    #[must_use]
    pub fn so_far(file: &File, bytes: u64) -> Option<Self> {
        let (mut zeros, mut since): (Vec<Range<u64>>, Option<u64>) = (Vec::new(), None);
        let mut end = |since: &mut Option<u64>, at: u64| {
            zeros.extend(since.take().map(|since| since..at).filter(|run| run.end - run.start >= LEAST_BYTES));
        };
        each_chunk(file, 0..bytes, &mut |start, chunk| {
            let mut at = 0;
            while at < chunk.len() {
                if chunk[at] == 0 {
                    since.get_or_insert(start + at as u64);
                    at += chunk[at..].iter().position(|byte| *byte != 0).unwrap_or(chunk.len() - at);
                } else {
                    end(&mut since, start + at as u64);
                    at += chunk[at..].iter().position(|byte| *byte == 0).unwrap_or(chunk.len() - at);
                }
            }
        })?;
        end(&mut since, bytes);
        let sha256 = hash_around(file, &zeros, bytes)?;
        Some(Self { zeros, bytes, sha256 })
    }

    /// Whether `file` has the same content wherever this one has any.
    #[must_use]
    pub fn is_kept_in(&self, file: &File, bytes: u64) -> bool {
        // Reserved bytes at its end may have been too many.
        let last = self.zeros.last().filter(|run| run.end == self.bytes).map_or(self.bytes, |run| run.start);
        bytes >= last && hash_around(file, &self.zeros, self.bytes.min(bytes)).as_ref() == Some(&self.sha256)
    }

    /// Whether `file` has the same content wherever this one has any, and more where this one has zeros: it is the same file, written further.
    #[must_use]
    pub fn goes_on_in(&self, file: &File, bytes: u64) -> bool {
        if !self.is_kept_in(file, bytes) {
            return false;
        }
        let gains = |run: &Range<u64>| {
            let mut gains = false;
            let read =
                each_chunk(file, run.start..run.end.min(bytes), &mut |_, chunk| gains |= chunk.iter().any(|byte| *byte != 0));
            read.is_some() && gains
        };
        self.zeros.iter().any(gains)
    }
}

/// Of everything up to `bytes` but `zeros`.
fn hash_around(file: &File, zeros: &[Range<u64>], bytes: u64) -> Option<[u8; 32]> {
    let mut hash = Sha256::new();
    let mut from = 0;
    for run in zeros.iter().cloned().chain(std::iter::once(bytes..bytes)) {
        each_chunk(file, from..run.start.min(bytes), &mut |_, chunk| hash.update(chunk))?;
        from = run.end;
    }
    Some(hash.finalize().into())
}

/// Calls `take` with the place and the bytes of each part of a file; `None` where one cannot be read.
fn each_chunk(file: &File, within: Range<u64>, take: &mut dyn FnMut(u64, &[u8])) -> Option<()> {
    let mut chunk = vec![0; CHUNK];
    let mut start = within.start;
    while start < within.end {
        let part = &mut chunk[..(within.end - start).min(CHUNK as u64) as usize];
        read_at(file, part, start)?;
        take(start, part);
        start += part.len() as u64;
    }
    Some(())
}

/// Without moving the file's own position.
#[cfg(unix)]
fn read_at(file: &File, part: &mut [u8], start: u64) -> Option<()> {
    std::os::unix::fs::FileExt::read_exact_at(file, part, start).ok()
}

#[cfg(not(unix))]
fn read_at(_file: &File, _part: &mut [u8], _start: u64) -> Option<()> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file_of(content: &[u8]) -> (File, u64) {
        let file = tempfile::tempfile().unwrap();
        std::io::Write::write_all(&mut &file, content).unwrap();
        (file, content.len() as u64)
    }

    #[test]
    fn what_was_written_is_told_from_what_was_reserved() {
        let whole: Vec<u8> = (0..200_000u32).map(|n| (n % 251) as u8 + 1).collect();
        let (file, bytes_of_whole) = file_of(&whole);
        let has_zeros = Written::around_zeros(&file, bytes_of_whole).is_some() || ends_in_zeros(&file, bytes_of_whole);
        assert!(!has_zeros, "a whole file has no zeros");
        let mut another = whole.clone();
        another[0] = 0xff;
        let (another, _) = file_of(&another);
        // Its end, its middle, and two places at once are not written yet.
        let missing: [&[(usize, usize)]; 6] = [
            &[(1, 200_000)],
            &[(300, 200_000)],
            &[(190_000, 200_000)],
            &[(70_000, 140_001)],
            &[(4000, 9000), (150_000, 170_000)],
            &[(9, 8000)],
        ];
        for missing in missing {
            let mut torn = whole.clone();
            missing.iter().for_each(|(from, to)| torn[*from..*to].fill(0));
            let (torn, bytes) = file_of(&torn);
            let before = Written::around_zeros(&torn, bytes).unwrap();
            assert_eq!(before.zeros.len(), missing.len());
            assert_eq!(ends_in_zeros(&torn, bytes), missing.last().unwrap().1 == 200_000);
            assert!(before.goes_on_in(&file, bytes) && before.is_kept_in(&file, bytes), "{missing:?}");
            assert!(!before.goes_on_in(&torn, bytes), "nothing was added");
            assert!(!before.goes_on_in(&another, bytes), "another file");
        }
        let (few, bytes) = file_of(&[&whole[..199_600], &[0; 400]].concat());
        assert!(Written::around_zeros(&few, bytes).is_none() && !ends_in_zeros(&few, bytes), "a few zeros are content");
        let (none, bytes) = file_of(&[0; 4096]);
        assert!(Written::around_zeros(&none, bytes).is_none() && ends_in_zeros(&none, bytes));
        // One that was cut, without zeros: it is kept in the whole one and in no other.
        let cut = Written::so_far(&file, 70_000).unwrap();
        assert!(cut.is_kept_in(&file, bytes_of_whole) && cut.is_kept_in(&file, 70_000) && !cut.is_kept_in(&file, 69_999));
        assert!(!cut.is_kept_in(&another, bytes_of_whole) && !cut.goes_on_in(&file, bytes_of_whole));
        assert!(Written::so_far(&file, 0).unwrap().is_kept_in(&another, bytes_of_whole), "nothing is kept in whatever comes");
        // More was reserved than is needed.
        let (long, bytes) = file_of(&[&whole[..100_000], &[0; 150_000]].concat());
        assert!(Written::around_zeros(&long, bytes).unwrap().goes_on_in(&file, 200_000));
    }
}
