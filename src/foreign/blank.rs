//! Files that were given their whole size before their content: nothing but zeros follows what has been written so far.

use std::fs::File;

use crate::image::sha256_bytes;

/// Zeros at the end of a file from which on it may be unfinished: this share of it, and at least so many bytes.
const LEAST_SHARE: u64 = 64;
const LEAST_BYTES: u64 = 512;
const CHUNK: usize = 1 << 16;

/// What comes before the zeros at the end of a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Written {
    /// Its length.
    pub bytes: u64,
    sha256: String,
}

impl Written {
    /// Of a file of `bytes` bytes; `None` where it does not end in zeros, or cannot be read.
    #[must_use]
    pub fn before_zeros(file: &File, bytes: u64) -> Option<Self> {
        let mut chunk = vec![0; CHUNK];
        let mut end = bytes;
        let written = loop {
            let start = end.saturating_sub(CHUNK as u64);
            let part = &mut chunk[..(end - start) as usize];
            read_at(file, part, start)?;
            if let Some(last) = part.iter().rposition(|byte| *byte != 0) {
                break start + last as u64 + 1;
            }
            if start == 0 {
                break 0;
            }
            end = start;
        };
        let zeros = bytes - written;
        (zeros >= LEAST_BYTES && zeros >= bytes / LEAST_SHARE)
            .then(|| Some(Self { bytes: written, sha256: hash(file, written)? }))
            .flatten()
    }

    /// Whether `file` begins with the same content and goes on with something else: it is the same file, written further.
    #[must_use]
    pub fn goes_on_in(&self, file: &File, bytes: u64) -> bool {
        let further = Self::before_zeros(file, bytes).map_or(bytes, |written| written.bytes);
        self.bytes > 0 && further > self.bytes && hash(file, self.bytes).as_ref() == Some(&self.sha256)
    }
}

fn hash(file: &File, bytes: u64) -> Option<String> {
    let mut content = vec![0; usize::try_from(bytes).ok()?];
    read_at(file, &mut content, 0)?;
    Some(sha256_bytes(&content))
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
        let (file, bytes) = file_of(&whole);
        assert_eq!(Written::before_zeros(&file, bytes), None, "a whole file does not end in zeros");
        for written in [1usize, 300, 70_000, 190_000] {
            let torn: Vec<u8> = whole.iter().enumerate().map(|(at, byte)| if at < written { *byte } else { 0 }).collect();
            let (torn, bytes) = file_of(&torn);
            let before = Written::before_zeros(&torn, bytes).unwrap();
            assert_eq!(before.bytes, written as u64);
            assert!(before.goes_on_in(&file, bytes), "{written}");
            assert!(!before.goes_on_in(&torn, bytes), "nothing was added");
            let mut another = whole.clone();
            another[0] = 0xff;
            let (another, bytes) = file_of(&another);
            assert!(!before.goes_on_in(&another, bytes), "another file");
        }
        let (few, bytes) = file_of(&[&whole[..199_600], &[0; 400]].concat());
        assert_eq!(Written::before_zeros(&few, bytes), None, "a few zeros are content");
        let (none, bytes) = file_of(&[0; 4096]);
        assert_eq!(Written::before_zeros(&none, bytes).map(|written| written.bytes), Some(0));
    }
}
