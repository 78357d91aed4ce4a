//! Serial ports: opened exclusively and raw, read until the device goes.

use std::path::{Path, PathBuf};
use std::time::Duration;

use tokio::io::AsyncReadExt;
use tokio_serial::SerialStream;

use super::address::PortConfig;
use super::byte_source::{ByteSource, Closing, Heard};
use super::port_error::PortError;
use crate::time::host_now_us;

/// Bytes take at most this long from the line to the reader.
const IN_THE_DRIVER: Duration = Duration::from_millis(25);
/// Most bytes in one event.
const CHUNK_BYTES: usize = 4096;

/// Reads a serial port.
pub(super) struct Serial {
    config: PortConfig,
    /// While it is open.
    port: Option<SerialStream>,
    buffer: Vec<u8>,
    was_open: bool,
    /// It is to be closed: what is left is read.
    is_draining: bool,
}

impl Serial {
    pub(super) fn new(config: PortConfig) -> Self {
        Self { config, port: None, buffer: vec![0; CHUNK_BYTES], was_open: false, is_draining: false }
    }

    async fn read(&mut self, closing: &mut Closing) -> Heard {
        let Self { port: Some(port), buffer, is_draining, .. } = self else { return Heard::Closed };
        while !*is_draining {
            // What has arrived comes first: when the port is to be closed, it is read to the end before.
            let outcome = tokio::select! {
                biased;
                outcome = port.read(buffer) => Some(outcome),
                () = closing.asked() => None,
            };
            match outcome {
                // After an unplug Linux returns nothing, at once and for ever.
                Some(Ok(0)) => return Heard::Lost { reason: "the device returns no bytes any more (unplugged?)".to_owned() },
                Some(Ok(count)) => return Heard::Bytes { host_us: host_now_us(), bytes: buffer[..count].to_vec() },
                Some(Err(error)) if error.kind() == std::io::ErrorKind::Interrupted => {}
                Some(Err(error)) => return Heard::Lost { reason: error.to_string() },
                None => {
                    // What the device sent a moment ago may not have come through the driver yet.
                    tokio::time::sleep(IN_THE_DRIVER).await;
                    *is_draining = true;
                }
            }
        }
        // What has come through, the runtime need not have noticed: this asks the system itself.
        match port.try_read(buffer) {
            Ok(count @ 1..) => Heard::Bytes { host_us: host_now_us(), bytes: buffer[..count].to_vec() },
            Ok(_) | Err(_) => Heard::Closed,
        }
    }
}

impl ByteSource for Serial {
    const KEEPS_BYTES: bool = false;

    async fn open(&mut self) -> Result<PathBuf, PortError> {
        let (port, resolved) = open(&self.config, !self.was_open)?;
        (self.port, self.was_open) = (Some(port), true);
        Ok(resolved)
    }

    async fn next(&mut self, closing: &mut Closing) -> Heard {
        let heard = self.read(closing).await;
        if !matches!(heard, Heard::Bytes { .. }) {
            // While it is held, it cannot be opened again.
            self.port = None;
        }
        heard
    }
}

/// Opens the port exclusively, raw, 8N1, without flow control. Returns it with the device file behind symbolic links.
///
/// # Errors
/// As [`PortError`] tells apart.
fn open(config: &PortConfig, is_first: bool) -> Result<(SerialStream, PathBuf), PortError> {
    let path = config.path.clone();
    let resolved = std::fs::canonicalize(&path).map_err(|error| PortError::of(&path, &error))?;
    let pty = is_pseudo_terminal(&resolved);
    // macOS refuses to set a speed on a pseudo-terminal; there 0 means to leave it.
    let baud = if pty && cfg!(target_os = "macos") { 0 } else { config.baud };
    let builder = tokio_serial::new(resolved.to_string_lossy(), baud);
    let port = SerialStream::open(&builder).map_err(|error| classify(&path, &resolved, &error))?;
    if !pty {
        use tokio_serial::SerialPort as _;
        // Drivers round to what they can do; beyond 3 % every byte is garbage.
        if let Ok(found) = port.baud_rate()
            && found.abs_diff(config.baud) > config.baud * 3 / 100
        {
            return Err(PortError::Baud { path, wanted: config.baud, found });
        }
    }
    if is_first {
        // What an earlier reader left in the system's buffer is of another session: its end would look like a loss. A driver that cannot
        // drop it keeps it.
        use tokio_serial::SerialPort as _;
        let _ = port.clear(tokio_serial::ClearBuffer::Input);
    }
    Ok((port, resolved))
}

/// Whether a device file is one end of a pseudo-terminal.
fn is_pseudo_terminal(resolved: &Path) -> bool {
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
