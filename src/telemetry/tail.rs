//! A file that another program writes to its end: what is there before the session is not of it, what comes later is.

use std::fs::{File, Metadata};
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::outlet::{Deaf, Ended, Outlet, PortEvent};
use super::port_error::PortError;
use crate::time::host_now_us;

/// How often the file is looked at: what stands in it has no better time of arrival than this.
const POLL: Duration = Duration::from_millis(5);
/// Most bytes in one event.
const CHUNK_BYTES: u64 = 64 << 10;
/// Where the beginning of the last line is sought, bytes before the end.
const LAST_LINE_BYTES: u64 = 64 << 10;

/// Which file stands at a path.
type Identity = (u64, u64);

/// Follows the file at a path.
pub(super) struct Tail {
    path: PathBuf,
    /// The first line names the columns: it is read as well.
    has_header: bool,
    /// The file that was read last, and how far.
    known: Option<(Identity, u64)>,
    /// There was no file: whatever is in one that appears was written since.
    was_missing: bool,
}

/// The file, and what of its beginning is read first.
pub(super) struct Open {
    file: File,
    identity: Identity,
    at: u64,
    header: Vec<u8>,
}

impl Tail {
    pub(super) fn new(path: PathBuf, has_header: bool) -> Self {
        Self { path, has_header, known: None, was_missing: false }
    }

    /// Opens the file at the beginning of its last line where it was there before, at its beginning where it is new, and where reading
    /// ended where it is the same.
    pub(super) fn open(&mut self, configured: &Path) -> Result<Open, PortError> {
        let opened = self.opened();
        let path = configured.to_owned();
        let failed = |error: std::io::Error| match error.kind() {
            std::io::ErrorKind::NotFound => PortError::NotFound { path },
            std::io::ErrorKind::PermissionDenied => PortError::NotPermitted { path },
            std::io::ErrorKind::IsADirectory | std::io::ErrorKind::InvalidInput => {
                PortError::NotAPort { path, reason: error.to_string() }
            }
            _ => PortError::Io { path, reason: error.to_string() },
        };
        self.was_missing |= opened.as_ref().is_err_and(|error| error.kind() == std::io::ErrorKind::NotFound);
        opened.map_err(failed)
    }

    fn opened(&self) -> std::io::Result<Open> {
        // A pipe that nobody writes to would not open.
        let metadata = std::fs::metadata(&self.path)?;
        if !metadata.is_file() {
            return Err(std::io::Error::new(std::io::ErrorKind::InvalidInput, "no regular file"));
        }
        let mut file = File::open(&self.path)?;
        let metadata = file.metadata()?;
        let (identity, length) = (identity(&metadata), metadata.len());
        let (at, header) = match self.known {
            Some((known, at)) if known == identity && at <= length => (at, Vec::new()),
            Some(_) => (0, Vec::new()),
            None if self.was_missing => (0, Vec::new()),
            None => {
                let at = last_line(&mut file, length)?;
                (at, if self.has_header && at > 0 { first_line(&mut file)? } else { Vec::new() })
            }
        };
        Ok(Open { file, identity, at, header })
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

/// Reads what is written until the file is another, shorter or gone.
pub(super) async fn pump(tail: &mut Tail, open: Open, epoch: u32, outlet: &mut Outlet) -> Result<Ended, Deaf> {
    let Open { mut file, identity: own, mut at, header } = open;
    let mut received = !header.is_empty();
    if received {
        outlet.send(PortEvent::Bytes { host_us: host_now_us(), epoch, bytes: header }).await?;
    }
    loop {
        tail.known = Some((own, at));
        let is_last = *outlet.finishing.borrow();
        let Look { there, bytes } = match look(file, tail.path.clone(), at).await {
            Ok((same, found)) => {
                file = same;
                found
            }
            Err(error) => return Ok((error.to_string(), received)),
        };
        if !bytes.is_empty() {
            at += bytes.len() as u64;
            received = true;
            outlet.send(PortEvent::Bytes { host_us: host_now_us(), epoch, bytes }).await?;
            continue;
        }
        if is_last {
            return Err(Deaf);
        }
        let reason = match &there {
            None => Some("the file is gone"),
            Some(there) if identity(there) != own => Some("another file stands in its place"),
            Some(there) if there.len() < at => Some("the file was cut short"),
            Some(_) => None,
        };
        if let Some(reason) = reason {
            if there.is_none() {
                // What appears is new.
                (tail.known, tail.was_missing) = (None, true);
            }
            return Ok((reason.to_owned(), received));
        }
        tokio::select! {
            () = tokio::time::sleep(POLL) => {}
            () = outlet.asked_to_finish() => {}
        }
    }
}

/// Where the line begins that is not ended yet.
fn last_line(file: &mut File, length: u64) -> std::io::Result<u64> {
    let from = length.saturating_sub(LAST_LINE_BYTES);
    file.seek(SeekFrom::Start(from))?;
    let mut bytes = Vec::new();
    file.take(length - from).read_to_end(&mut bytes)?;
    let end = bytes.iter().rposition(|byte| *byte == b'\n');
    Ok(match end {
        Some(end) => from + end as u64 + 1,
        None if from == 0 => 0,
        None => length,
    })
}

/// The first line with its end.
fn first_line(file: &mut File) -> std::io::Result<Vec<u8>> {
    file.seek(SeekFrom::Start(0))?;
    let mut bytes = Vec::new();
    file.take(LAST_LINE_BYTES).read_to_end(&mut bytes)?;
    let end = bytes.iter().position(|byte| *byte == b'\n').map_or(0, |end| end + 1);
    bytes.truncate(end);
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
