//! Serial ports, driven from tokio: bytes with their arrival time, unplugging, re-opening.
//!
//! Read-only toward devices: nothing here can send a byte. [`PortTask`] owns the port and offers no access to it.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use tokio::io::AsyncReadExt;
use tokio::sync::mpsc::Sender;
use tokio::sync::mpsc::error::TrySendError;

use super::device::{DeviceKind, PortConfig};
use crate::time::host_now_us;

/// Wait before the first attempt to open again; doubled after each failure.
pub const FIRST_BACKOFF: Duration = Duration::from_millis(50);
/// Longest wait between attempts.
pub const LONGEST_BACKOFF: Duration = Duration::from_secs(1);
/// Bytes take at most this long from the line to the reader.
const IN_THE_DRIVER: Duration = Duration::from_millis(25);
/// Most bytes in one event.
const CHUNK_BYTES: usize = 4096;

/// Why a port cannot be opened or read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PortError {
    /// Nothing there.
    #[error("serial port {}: does not exist", path.display())]
    NotFound {
        /// As configured.
        path: PathBuf,
    },
    /// Another program holds it.
    #[error("serial port {}: is in use by another program", path.display())]
    Busy {
        /// As configured.
        path: PathBuf,
    },
    /// The user may not open it.
    #[error("serial port {}: permission denied", path.display())]
    NotPermitted {
        /// As configured.
        path: PathBuf,
    },
    /// Exists, but is no serial port.
    #[error("serial port {}: is not a serial port ({reason})", path.display())]
    NotAPort {
        /// As configured.
        path: PathBuf,
        /// The system's words.
        reason: String,
    },
    /// The driver cannot do this speed.
    #[error("serial port {}: runs at {found} baud, {wanted} was asked for", path.display())]
    Baud {
        /// As configured.
        path: PathBuf,
        /// Configured.
        wanted: u32,
        /// What the driver set instead.
        found: u32,
    },
    /// Anything else the system reports.
    #[error("serial port {}: {reason}", path.display())]
    Io {
        /// As configured.
        path: PathBuf,
        /// The system's words.
        reason: String,
    },
}

/// What a person at the C-arm can do about `error`.
#[must_use]
pub fn hint(error: &PortError) -> &'static str {
    match error {
        PortError::NotFound { .. } => "check the cable and the path; `sidecarm devices` lists the ports that exist",
        PortError::Busy { .. } => "close the other program (a terminal, ModemManager, a second sidecarm); `fuser PORT` names it",
        PortError::NotPermitted { .. } => {
            "add yourself to the group that owns the port (`sudo usermod -aG dialout $USER`), then log in again"
        }
        PortError::NotAPort { .. } => {
            "give a serial device such as /dev/ttyUSB0 or /dev/serial/by-id/…; `sidecarm devices` lists them"
        }
        PortError::Baud { .. } => "give a `baud` that the adapter supports and set the same on the device",
        PortError::Io { .. } => "unplug and replug the adapter; if it stays, look into `dmesg`",
    }
}

/// What happens on a port.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PortEvent {
    /// Open; bytes follow with the same epoch.
    Opened {
        /// Counts openings, from 0: across epochs nothing is known about what was missed.
        epoch: u32,
        /// When.
        host_us: i64,
        /// As configured.
        path: PathBuf,
        /// The device file behind symbolic links.
        resolved: PathBuf,
    },
    /// Bytes arrived.
    Bytes {
        /// Host time right after the read returned.
        host_us: i64,
        /// Epoch of the opening.
        epoch: u32,
        /// As they came.
        bytes: Vec<u8>,
    },
    /// The device went away.
    Lost {
        /// Epoch that ends here.
        epoch: u32,
        /// When.
        host_us: i64,
        /// What the system said.
        reason: String,
    },
    /// An attempt to open failed; the next follows after `wait_ms`.
    Retry {
        /// When.
        host_us: i64,
        /// Failures since the port was last open.
        attempt: u32,
        /// Until the next attempt.
        wait_ms: u64,
        /// Why.
        error: PortError,
    },
}

/// Counters of a port, readable from any thread.
#[derive(Debug, Default)]
struct Counters {
    bytes: AtomicU64,
    stalls: AtomicU64,
}

/// A running port; stops when dropped.
#[derive(Debug)]
pub struct PortTask {
    task: tokio::task::JoinHandle<()>,
    finish: tokio::sync::watch::Sender<bool>,
    counters: Arc<Counters>,
}

impl PortTask {
    /// Bytes read so far, all epochs.
    #[must_use]
    pub fn bytes(&self) -> u64 {
        self.counters.bytes.load(Ordering::Relaxed)
    }

    /// How often the receiver was full and reading waited for it. Nothing is dropped here: meanwhile bytes wait in the kernel.
    #[must_use]
    pub fn stalls(&self) -> u64 {
        self.counters.stalls.load(Ordering::Relaxed)
    }

    /// Closes the port once the bytes that have arrived are read.
    pub fn finish(&self) {
        // Without a receiver the task has ended.
        let _ = self.finish.send(true);
    }

    /// Waits until the port is closed; after `limit` it is closed whatever it does.
    pub async fn ended_within(mut self, limit: Duration) {
        // A task that panicked has ended as well.
        let _ = tokio::time::timeout(limit, &mut self.task).await;
    }

    /// Closes the port and waits until it is closed.
    pub async fn closed(mut self) {
        self.task.abort();
        // The only error is the cancellation that was just asked for.
        let _ = (&mut self.task).await;
    }
}

impl Drop for PortTask {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// Reads `config`'s port on `handle`'s runtime (its I/O and time drivers enabled) until the task or the receiver is dropped.
///
/// The first failure to open is an event like later ones: a device may be plugged in after the start. When `sink` is full, reading waits.
#[must_use = "the port closes when the task is dropped"]
pub fn spawn_port(handle: &tokio::runtime::Handle, config: PortConfig, sink: Sender<(DeviceKind, PortEvent)>) -> PortTask {
    let counters = Arc::new(Counters::default());
    let (finish, finishing) = tokio::sync::watch::channel(false);
    let outlet = Outlet { device: config.device, sink, finishing, counters: Arc::clone(&counters) };
    PortTask { task: handle.spawn(run(config, outlet)), finish, counters }
}

/// Where events go; `Err` when nobody listens any more.
struct Outlet {
    device: DeviceKind,
    sink: Sender<(DeviceKind, PortEvent)>,
    /// True once the port is to be closed.
    finishing: tokio::sync::watch::Receiver<bool>,
    counters: Arc<Counters>,
}

/// The receiver is gone.
struct Deaf;

impl Outlet {
    async fn send(&self, event: PortEvent) -> Result<(), Deaf> {
        match self.sink.try_send((self.device, event)) {
            Ok(()) => Ok(()),
            Err(TrySendError::Closed(_)) => Err(Deaf),
            Err(TrySendError::Full(event)) => {
                self.counters.stalls.fetch_add(1, Ordering::Relaxed);
                self.sink.send(event).await.map_err(|_| Deaf)
            }
        }
    }
}

async fn run(config: PortConfig, mut outlet: Outlet) {
    let mut epoch = 0;
    let mut attempt = 0;
    let mut backoff = FIRST_BACKOFF;
    loop {
        let event = match open(&config) {
            Ok((port, resolved)) => {
                attempt = 0;
                let path = config.path.clone();
                if epoch == 0 {
                    // What an earlier reader left in the system's buffer is of another session: its end would look like a loss. A driver
                    // that cannot drop it keeps it.
                    use tokio_serial::SerialPort as _;
                    let _ = port.clear(tokio_serial::ClearBuffer::Input);
                }
                if outlet.send(PortEvent::Opened { epoch, host_us: host_now_us(), path, resolved }).await.is_err() {
                    return;
                }
                let Ok((reason, received)) = pump(port, epoch, &mut outlet).await else { return };
                // A port that opens and dies at once must not be hammered.
                if received {
                    backoff = FIRST_BACKOFF;
                }
                epoch += 1;
                PortEvent::Lost { epoch: epoch - 1, host_us: host_now_us(), reason }
            }
            Err(error) => {
                attempt += 1;
                PortEvent::Retry { host_us: host_now_us(), attempt, wait_ms: backoff.as_millis() as u64, error }
            }
        };
        if outlet.send(event).await.is_err() {
            return;
        }
        tokio::select! {
            () = tokio::time::sleep(backoff) => {}
            _ = outlet.finishing.wait_for(|finishing| *finishing) => return,
        }
        backoff = (backoff * 2).min(LONGEST_BACKOFF);
        if outlet.sink.is_closed() {
            return;
        }
    }
}

/// Reads until the device goes; returns why, and whether anything arrived at all.
async fn pump(mut port: tokio_serial::SerialStream, epoch: u32, outlet: &mut Outlet) -> Result<(String, bool), Deaf> {
    let mut buffer = vec![0; CHUNK_BYTES];
    let mut received = false;
    loop {
        // What has arrived comes first: when the port is to be closed, it is read to the end before.
        let outcome = tokio::select! {
            biased;
            outcome = port.read(&mut buffer) => Some(outcome),
            _ = outlet.finishing.wait_for(|finishing| *finishing) => None,
        };
        let Some(outcome) = outcome else {
            drain(&mut port, epoch, outlet, &mut buffer).await?;
            return Err(Deaf);
        };
        let host_us = host_now_us();
        match outcome {
            // After an unplug Linux returns nothing, at once and for ever.
            Ok(0) => return Ok(("the device returns no bytes any more (unplugged?)".to_owned(), received)),
            Ok(count) => {
                received = true;
                outlet.counters.bytes.fetch_add(count as u64, Ordering::Relaxed);
                outlet.send(PortEvent::Bytes { host_us, epoch, bytes: buffer[..count].to_vec() }).await?;
            }
            Err(error) if error.kind() == std::io::ErrorKind::Interrupted => {}
            Err(error) => return Ok((error.to_string(), received)),
        }
    }
}

/// Reads what is left. What the device sent a moment ago may not have come through the driver yet, and what has, the runtime need not have
/// noticed: the reads ask the system itself.
async fn drain(port: &mut tokio_serial::SerialStream, epoch: u32, outlet: &mut Outlet, buffer: &mut [u8]) -> Result<(), Deaf> {
    tokio::time::sleep(IN_THE_DRIVER).await;
    while let Ok(count @ 1..) = port.try_read(buffer) {
        outlet.counters.bytes.fetch_add(count as u64, Ordering::Relaxed);
        let bytes = buffer[..count].to_vec();
        outlet.send(PortEvent::Bytes { host_us: host_now_us(), epoch, bytes }).await?;
    }
    Ok(())
}

/// Opens the port exclusively, raw, 8N1, without flow control. Returns it with the device file behind symbolic links.
///
/// # Errors
/// As [`PortError`] tells apart.
fn open(config: &PortConfig) -> Result<(tokio_serial::SerialStream, PathBuf), PortError> {
    let path = config.path.clone();
    let resolved = std::fs::canonicalize(&path).map_err(|error| match error.kind() {
        std::io::ErrorKind::NotFound => PortError::NotFound { path: path.clone() },
        std::io::ErrorKind::PermissionDenied => PortError::NotPermitted { path: path.clone() },
        _ => PortError::Io { path: path.clone(), reason: error.to_string() },
    })?;
    let pty = is_pseudo_terminal(&resolved);
    // macOS refuses to set a speed on a pseudo-terminal; there 0 means to leave it.
    let baud = if pty && cfg!(target_os = "macos") { 0 } else { config.baud };
    let builder = tokio_serial::new(resolved.to_string_lossy(), baud);
    let port = tokio_serial::SerialStream::open(&builder).map_err(|error| classify(&path, &resolved, &error))?;
    if !pty {
        use tokio_serial::SerialPort as _;
        // Drivers round to what they can do; beyond 3 % every byte is garbage.
        if let Ok(found) = port.baud_rate()
            && found.abs_diff(config.baud) > config.baud * 3 / 100
        {
            return Err(PortError::Baud { path, wanted: config.baud, found });
        }
    }
    Ok((port, resolved))
}

/// Whether a device file is one end of a pseudo-terminal.
pub(super) fn is_pseudo_terminal(resolved: &Path) -> bool {
    resolved.starts_with("/dev/pts") || resolved.to_string_lossy().starts_with("/dev/ttys")
}

fn classify(path: &Path, resolved: &Path, error: &tokio_serial::Error) -> PortError {
    use std::io::ErrorKind as Io;
    use tokio_serial::ErrorKind;
    let path = path.to_owned();
    let reason = error.description.clone();
    match error.kind {
        // The serial library reports both kinds of foreign lock as "no device".
        ErrorKind::NoDevice => PortError::Busy { path },
        ErrorKind::Io(Io::NotFound) => PortError::NotFound { path },
        ErrorKind::Io(Io::PermissionDenied) => PortError::NotPermitted { path },
        _ if !is_character_device(resolved) => PortError::NotAPort { path, reason },
        ErrorKind::InvalidInput => PortError::NotAPort { path, reason },
        _ => PortError::Io { path, reason },
    }
}

#[cfg(unix)]
fn is_character_device(path: &Path) -> bool {
    use std::os::unix::fs::FileTypeExt;
    std::fs::metadata(path).is_ok_and(|metadata| metadata.file_type().is_char_device())
}

#[cfg(not(unix))]
fn is_character_device(_path: &Path) -> bool {
    true
}
