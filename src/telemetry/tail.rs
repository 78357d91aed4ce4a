//! A file that another program writes to its end: what is there before the session is not of it, what comes later is.

use std::fs::{File, Metadata};
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::byte_source::{ByteSource, Closing, Heard};
use super::lines::LineAdapter;
use super::port_error::PortError;
use crate::regular;
use crate::time::host_now_us;

/// How often the file is looked at: what stands in it has no better time of arrival than this.
const POLL: Duration = Duration::from_millis(5);
/// Most bytes in one event.
const CHUNK_BYTES: u64 = 64 << 10;
/// Ends of lines and headers are sought in so many bytes before the end, headers in as many at the beginning as well.
const NEAR_BYTES: u64 = 64 << 10;

/// Which file stands at a path.
type Identity = (u64, u64);

/// Follows the file at a path.
pub(super) struct Tail {
    /// As configured.
    port: PathBuf,
    path: PathBuf,
    /// How its lines are read: a header that names their columns is read as well. None where they are packets.
    adapter: Option<LineAdapter>,
    /// The file that was read last, and how far.
    known: Option<(Identity, u64)>,
    /// There was no file: whatever is in one that appears was written since.
    was_missing: bool,
    open: Option<Open>,
}

/// The file, and what of its beginning is read first.
struct Open {
    file: File,
    identity: Identity,
    at: u64,
    header: Vec<u8>,
}

impl Open {
    /// At the beginning of its last line where it was there before, at its beginning where it is new, and where reading ended where it is
    /// the same.
    fn of(
        path: &Path,
        adapter: Option<&LineAdapter>,
        known: Option<(Identity, u64)>,
        was_missing: bool,
    ) -> std::io::Result<Self> {
        let mut file = regular::open(path)?;
        let metadata = file.metadata()?;
        let (identity, length) = (identity(&metadata), metadata.len());
        let (at, header) = match known {
            Some((known, at)) if known == identity && at <= length => (at, Vec::new()),
            Some(_) => (0, Vec::new()),
            None if was_missing => (0, Vec::new()),
            None => {
                let at = last_unit(&mut file, length, adapter.is_some())?;
                let header = adapter.map(|adapter| last_header(&mut file, at, adapter));
                (at, header.transpose()?.unwrap_or_default())
            }
        };
        Ok(Self { file, identity, at, header })
    }
}

impl Tail {
    pub(super) fn new(port: PathBuf, path: PathBuf, adapter: Option<LineAdapter>) -> Self {
        Self { port, path, adapter, known: None, was_missing: false, open: None }
    }
}

/// What a look at the file has found.
struct Look {
    /// What stands at its path now; asked before the file was read: whoever renames has written its last line by then.
    there: Option<Metadata>,
    /// What was written since the last one.
    bytes: Vec<u8>,
}

/// Looks at the file on a thread for what may take long: a disk over a network must not hold up the other ports.
async fn look(mut file: File, path: PathBuf, at: u64) -> std::io::Result<(File, Look)> {
    let looking = tokio::task::spawn_blocking(move || {
        let there = std::fs::metadata(path).ok();
        file.seek(SeekFrom::Start(at))?;
        let mut bytes = Vec::new();
        file.by_ref().take(CHUNK_BYTES).read_to_end(&mut bytes)?;
        Ok((file, Look { there, bytes }))
    });
    looking.await.map_err(std::io::Error::other)?
}

impl ByteSource for Tail {
    const KEEPS_BYTES: bool = true;

    /// On a thread for what may take long, as [`look`] does.
    async fn open(&mut self) -> Result<PathBuf, PortError> {
        let (path, adapter, known, was_missing) = (self.path.clone(), self.adapter.clone(), self.known, self.was_missing);
        let opening = tokio::task::spawn_blocking(move || Open::of(&path, adapter.as_ref(), known, was_missing));
        let opened = opening.await.map_err(std::io::Error::other).flatten();
        self.was_missing |= opened.as_ref().is_err_and(|error| error.kind() == std::io::ErrorKind::NotFound);
        self.open = Some(opened.map_err(|error| PortError::of(&self.port, &error))?);
        Ok(self.port.clone())
    }

    /// It ends when the file is another, shorter or gone.
    async fn next(&mut self, closing: &mut Closing) -> Heard {
        // Put back where reading goes on.
        let Some(mut open) = self.open.take() else { return Heard::Closed };
        let header = std::mem::take(&mut open.header);
        if !header.is_empty() {
            self.open = Some(open);
            return Heard::Bytes { host_us: host_now_us(), bytes: header };
        }
        loop {
            self.known = Some((open.identity, open.at));
            let is_last = closing.is_asked();
            let Look { there, bytes } = match look(open.file, self.path.clone(), open.at).await {
                Ok((same, found)) => {
                    open.file = same;
                    found
                }
                Err(error) => return Heard::Lost { reason: error.to_string() },
            };
            if !bytes.is_empty() {
                open.at += bytes.len() as u64;
                self.open = Some(open);
                return Heard::Bytes { host_us: host_now_us(), bytes };
            }
            if is_last {
                return Heard::Closed;
            }
            let reason = match &there {
                None => Some("the file is gone"),
                Some(there) if identity(there) != open.identity => Some("another file stands in its place"),
                Some(there) if there.len() < open.at => Some("the file was cut short"),
                Some(_) => None,
            };
            if let Some(reason) = reason {
                if there.is_none() {
                    // What appears is new.
                    (self.known, self.was_missing) = (None, true);
                }
                return Heard::Lost { reason: reason.to_owned() };
            }
            tokio::select! {
                () = tokio::time::sleep(POLL) => {}
                () = closing.asked() => {}
            }
        }
    }
}

/// Where the line, or the packet, begins that is not ended yet.
fn last_unit(file: &mut File, length: u64, of_lines: bool) -> std::io::Result<u64> {
    let from = length.saturating_sub(NEAR_BYTES);
    let bytes = part(file, from, length)?;
    let end = bytes.iter().rposition(|byte| if of_lines { is_end(*byte) } else { *byte == 0 });
    Ok(match end {
        Some(end) => from + end as u64 + 1,
        None if from == 0 => 0,
        None => length,
    })
}

/// The header that what is written from `at` on follows, with an end; nothing where there is none near the beginning or near `at`.
fn last_header(file: &mut File, at: u64, adapter: &LineAdapter) -> std::io::Result<Vec<u8>> {
    // The rest of a line at the beginning of what is near may look like one that has fewer columns; none of the lines after it fits it then.
    for [from, to] in [[at.saturating_sub(NEAR_BYTES), at], [0, at.min(NEAR_BYTES)]] {
        let bytes = part(file, from, to)?;
        if let Some(header) = bytes.rsplit(|byte| is_end(*byte)).find(|line| adapter.is_header(line)) {
            return Ok([header, b"\n"].concat());
        }
    }
    Ok(Vec::new())
}

fn is_end(byte: u8) -> bool {
    matches!(byte, b'\n' | b'\r')
}

fn part(file: &mut File, from: u64, to: u64) -> std::io::Result<Vec<u8>> {
    file.seek(SeekFrom::Start(from))?;
    let mut bytes = Vec::new();
    file.take(to - from).read_to_end(&mut bytes)?;
    Ok(bytes)
}

#[cfg(unix)]
fn identity(metadata: &Metadata) -> Identity {
    use std::os::unix::fs::MetadataExt;
    (metadata.dev(), metadata.ino())
}

/// When it was made tells files apart where nothing else does.
#[cfg(not(unix))]
fn identity(metadata: &Metadata) -> Identity {
    let made = metadata.created().ok().and_then(|made| made.duration_since(std::time::UNIX_EPOCH).ok());
    (0, made.map_or(0, |made| made.as_micros() as u64))
}
