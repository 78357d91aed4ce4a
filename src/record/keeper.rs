//! The keeper: a process of its own that writes the log's file. It outlives the program that records.
//!
//! The recording process copies bytes into memory that both hold (a memfd, in which position p is position p of the log) and then
//! announces how far they are whole. The keeper copies what was announced into the file and says how far it came. When the other process
//! is gone, it writes what is left and leaves. What was not announced is no whole batch and is never written.
//!
//! ```text
//! standard input   the shared memory
//! standard output  the log's file
//! standard error   a socket: in u64 "announced up to", out [`Told`]; nothing else is ever said there
//! ```

use std::fs::File;
use std::io::{Read, Write};
use std::os::fd::AsFd;
use std::os::unix::fs::FileExt;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::Duration;

use super::place::{Place, Watched};

/// So often the keeper looks whether its file is still where it was.
const LOOK: Duration = Duration::from_millis(400);
/// What it copies at once.
const PIECE_BYTES: u64 = 4 << 20;

/// What a keeper says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Told {
    /// So many bytes of the log are in the file.
    InFile(u64),
    Placed(Place),
    /// The file cannot be written; the system's error number, 0 where there is none.
    Failed(i32),
}

impl Told {
    pub(super) const BYTES: usize = 9;

    pub(super) fn bytes(self) -> [u8; Self::BYTES] {
        let (kind, number) = match self {
            Self::InFile(end) => (1, end),
            Self::Placed(Place::There) => (2, 0),
            Self::Placed(Place::Moved) => (2, 1),
            Self::Placed(Place::Deleted) => (2, 2),
            Self::Placed(Place::Cut) => (2, 3),
            Self::Failed(code) => (3, u64::from(code.unsigned_abs())),
        };
        let mut bytes = [kind; Self::BYTES];
        bytes[1..].copy_from_slice(&number.to_le_bytes());
        bytes
    }

    /// `None` for what no keeper says.
    pub(super) fn from_bytes(bytes: [u8; Self::BYTES]) -> Option<Self> {
        let mut number = [0; 8];
        number.copy_from_slice(&bytes[1..]);
        match (bytes[0], u64::from_le_bytes(number)) {
            (1, end) => Some(Self::InFile(end)),
            (2, 0) => Some(Self::Placed(Place::There)),
            (2, 1) => Some(Self::Placed(Place::Moved)),
            (2, 2) => Some(Self::Placed(Place::Deleted)),
            (2, 3) => Some(Self::Placed(Place::Cut)),
            (3, code) => i32::try_from(code).ok().map(Self::Failed),
            _ => None,
        }
    }
}

/// Keeps the log at `path`, of which `at` bytes are in the file, until the recording process is gone and all it announced is written.
///
/// # Errors
/// When standard input, output and error are not what a recording process gives, or the file cannot be written.
pub fn keep(path: &Path, at: u64) -> std::io::Result<()> {
    outlive_signals()?;
    let memory = crate::foreign::standard_input()?;
    let log = File::from(std::io::stdout().as_fd().try_clone_to_owned()?);
    let mut parent = UnixStream::from(std::io::stderr().as_fd().try_clone_to_owned()?);
    let announced = listen(parent.try_clone()?)?;
    parent.write_all(&Told::InFile(at).bytes())?;
    let written = write_announced(path, &memory, &log, at, &announced, &mut parent);
    if let Err(error) = &written {
        let _ = parent.write_all(&Told::Failed(error.raw_os_error().unwrap_or(0)).bytes());
    }
    written
}

/// What ends the recording process (Ctrl-C, a terminal that closes, the end of a service) is not meant for its log.
fn outlive_signals() -> std::io::Result<()> {
    use tokio::signal::unix::{SignalKind, signal};
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let _within = runtime.enter();
    for kind in [SignalKind::interrupt(), SignalKind::terminate(), SignalKind::hangup(), SignalKind::quit()] {
        // Listened to once is never again the end of the process.
        drop(signal(kind)?);
    }
    Ok(())
}

/// Takes announcements from the socket at once, whatever the disk does; the receiver ends when the recording process is gone.
fn listen(mut parent: UnixStream) -> std::io::Result<Receiver<u64>> {
    let (sender, announced) = channel();
    std::thread::Builder::new().name("announcements".into()).spawn(move || {
        let mut end = [0; 8];
        while parent.read_exact(&mut end).is_ok() && sender.send(u64::from_le_bytes(end)).is_ok() {}
    })?;
    Ok(announced)
}

fn write_announced(
    path: &Path,
    memory: &File,
    log: &File,
    mut at: u64,
    announced: &Receiver<u64>,
    parent: &mut UnixStream,
) -> std::io::Result<()> {
    let watched = Watched::new(log)?;
    let mut place = Place::There;
    loop {
        let end = match announced.recv_timeout(LOOK) {
            Ok(end) => announced.try_iter().last().unwrap_or(end),
            Err(RecvTimeoutError::Timeout) => at,
            Err(RecvTimeoutError::Disconnected) => return Ok(()),
        };
        // Looked at before more is written, which would fill up what was cut off. Whether anybody listens makes no difference to what is to be
        // written.
        let found = watched.place(path, at);
        if found != place {
            place = found;
            let _ = parent.write_all(&Told::Placed(place).bytes());
            if place == Place::Cut {
                return Ok(());
            }
        }
        let mut piece = vec![0; end.saturating_sub(at).min(PIECE_BYTES) as usize];
        while at < end {
            let part = &mut piece[..(end - at).min(PIECE_BYTES) as usize];
            memory.read_exact_at(part, at)?;
            log.write_all_at(part, at)?;
            at += part.len() as u64;
        }
        let _ = parent.write_all(&Told::InFile(at).bytes());
    }
}
