//! Several files for one helper, one after the other on its standard input: a length, that many bytes. Names do not cross over.

use std::fs::File;
use std::io::{self, ErrorKind, Read, Write};

use super::wire::MAX_JSON_BYTES;

/// What a helper reads.
pub enum Input {
    /// One file, from its start: the helper's standard input itself.
    One(File),
    /// The starts of files, up to so many bytes of each; opened only when their turn comes, because a process may hold few files open.
    Many(Box<dyn Iterator<Item = io::Result<(File, u64)>> + Send>),
}

impl From<File> for Input {
    fn from(file: File) -> Self {
        Self::One(file)
    }
}

/// Writes all of `files` to `out`. A helper that does not listen to the end has its reasons, which it says itself.
///
/// # Errors
/// When a file cannot be read.
pub(super) fn feed(files: impl Iterator<Item = io::Result<(File, u64)>>, mut out: impl Write) -> io::Result<()> {
    for file in files {
        let (file, most) = file?;
        let bytes = file.metadata()?.len().min(most);
        let sent = out.write_all(&bytes.to_ne_bytes()).and_then(|()| io::copy(&mut file.take(bytes), &mut out));
        match sent {
            Ok(sent) if sent == bytes => {}
            Ok(_) => return Err(io::Error::new(ErrorKind::UnexpectedEof, "it became shorter while it was read")),
            Err(error) if error.kind() == ErrorKind::BrokenPipe => return Ok(()),
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

/// Writes `request` and `file` to `out`, each after its length, for a helper that serves one after the other.
///
/// # Errors
/// When the file cannot be read or becomes shorter, or the helper does not listen to the end.
pub(super) fn request_and_file(request: &str, file: File, mut out: impl Write) -> io::Result<()> {
    let bytes = file.metadata()?.len();
    out.write_all(&(request.len() as u64).to_ne_bytes())?;
    out.write_all(request.as_bytes())?;
    out.write_all(&bytes.to_ne_bytes())?;
    match io::copy(&mut file.take(bytes), &mut out)? == bytes {
        true => Ok(()),
        false => Err(io::Error::new(ErrorKind::UnexpectedEof, "it became shorter while it was read")),
    }
}

/// The helper's side of [`request_and_file`]: the request and how many bytes of its file follow. `None` when no more is asked.
///
/// # Errors
/// When what comes is no request.
pub fn next_request(from: &mut impl Read) -> io::Result<Option<(String, u64)>> {
    let Some(asked) = length(from)? else { return Ok(None) };
    if asked > MAX_JSON_BYTES as u64 {
        return Err(io::Error::other(format!("a request of {asked} bytes")));
    }
    let mut text = String::new();
    from.by_ref().take(asked).read_to_string(&mut text)?;
    match length(from)? {
        Some(bytes) => Ok(Some((text, bytes))),
        None => Err(ErrorKind::UnexpectedEof.into()),
    }
}

/// A length; `None` at the end of what comes.
fn length(from: &mut impl Read) -> io::Result<Option<u64>> {
    let mut head = [0u8; 8];
    if from.read(&mut head[..1])? == 0 {
        return Ok(None);
    }
    from.read_exact(&mut head[1..])?;
    Ok(Some(u64::from_ne_bytes(head)))
}

/// The helper's side: the files that come, one by one.
pub struct Fed<R: Read> {
    from: R,
    most_bytes: u64,
}

impl<R: Read> Fed<R> {
    /// From `from`; a file may have `most_bytes` bytes.
    pub fn new(from: R, most_bytes: u64) -> Self {
        Self { from, most_bytes }
    }

    /// The content of the next file; `None` after the last.
    ///
    /// # Errors
    /// When it is too large, or does not come whole.
    pub fn next_file(&mut self) -> io::Result<Option<Vec<u8>>> {
        let Some(bytes) = length(&mut self.from)? else { return Ok(None) };
        if bytes > self.most_bytes {
            return Err(io::Error::other(format!("{bytes} bytes, at most {} are read", self.most_bytes)));
        }
        let mut content = Vec::new();
        self.from.by_ref().take(bytes).read_to_end(&mut content)?;
        if (content.len() as u64) < bytes {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        Ok(Some(content))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(content: &[u8]) -> File {
        let mut file = tempfile::tempfile().expect("a file");
        file.write_all(content).and_then(|()| io::Seek::rewind(&mut file)).expect("written");
        file
    }

    #[test]
    fn files_come_one_by_one_as_they_are_and_what_is_cut_is_said() {
        let (long, mut out) = (vec![7u8; 100_000], Vec::new());
        let files = [(file(b"one"), 99), (file(&long), 99_999), (file(b""), 5)];
        feed(files.into_iter().map(Ok), &mut out).expect("read");
        let mut fed = Fed::new(out.as_slice(), 99_999);
        let contents: Vec<Vec<u8>> = std::iter::from_fn(|| fed.next_file().expect("whole")).collect();
        assert_eq!(contents, [b"one".to_vec(), long[..99_999].to_vec(), Vec::new()]);
        assert!(Fed::new(&out[..20], 99_999).next_file().is_ok(), "control");
        let mut cut = Fed::new(&out[..20], 99_999);
        assert!(cut.next_file().is_ok_and(|first| first.is_some()) && cut.next_file().is_err());
        assert!(Fed::new(out.as_slice(), 2).next_file().is_err(), "longer than allowed");
        let gone = [Err(ErrorKind::NotFound.into())];
        assert_eq!(feed(gone.into_iter(), &mut Vec::new()).expect_err("not there").kind(), ErrorKind::NotFound);
    }

    #[test]
    fn requests_and_their_files_follow_each_other() {
        let mut out = Vec::new();
        for (request, content) in [("{\"kind\":1}", &b"content"[..]), ("{}", b"")] {
            request_and_file(request, file(content), &mut out).expect("written");
        }
        let mut from = out.as_slice();
        assert_eq!(next_request(&mut from).expect("whole"), Some(("{\"kind\":1}".to_owned(), 7)));
        assert_eq!(from.split_off(..7), Some(&b"content"[..]));
        assert_eq!(next_request(&mut from).expect("whole"), Some(("{}".to_owned(), 0)));
        assert_eq!(next_request(&mut from).expect("nobody asks"), None);
        assert!(
            next_request(&mut &out[..12]).is_err() && next_request(&mut [0xffu8; 40].as_slice()).is_err(),
            "cut, and too long"
        );
    }
}
