//! Why a port cannot be opened or read, and what to do about it.

use std::path::{Path, PathBuf};

use super::address::PortAddress;

/// Why a port cannot be opened or read.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PortError {
    /// Nothing there.
    #[error("{}: does not exist", named(path))]
    NotFound {
        /// As configured.
        path: PathBuf,
    },
    /// Another program holds it.
    #[error("{}: is in use by another program", named(path))]
    Busy {
        /// As configured.
        path: PathBuf,
    },
    /// The user may not open it.
    #[error("{}: permission denied", named(path))]
    NotPermitted {
        /// As configured.
        path: PathBuf,
    },
    /// Exists, but is no serial port, or no file.
    #[error("{}: is not {} ({reason})", named(path), expected(path))]
    NotAPort {
        /// As configured.
        path: PathBuf,
        /// The system's words.
        reason: String,
    },
    /// The driver cannot do this speed.
    #[error("{}: runs at {found} baud, {wanted} was asked for", named(path))]
    Baud {
        /// As configured.
        path: PathBuf,
        /// Configured.
        wanted: u32,
        /// What the driver set instead.
        found: u32,
    },
    /// Anything else the system reports.
    #[error("{}: {reason}", named(path))]
    Io {
        /// As configured.
        path: PathBuf,
        /// The system's words.
        reason: String,
    },
}

impl PortError {
    /// Of what the system says of a port as configured.
    pub(super) fn of(path: &Path, error: &std::io::Error) -> Self {
        use std::io::ErrorKind;
        let path = path.to_owned();
        match error.kind() {
            ErrorKind::NotFound => Self::NotFound { path },
            ErrorKind::AddrInUse => Self::Busy { path },
            ErrorKind::PermissionDenied => Self::NotPermitted { path },
            ErrorKind::IsADirectory | ErrorKind::InvalidInput => Self::NotAPort { path, reason: error.to_string() },
            _ => Self::Io { path, reason: error.to_string() },
        }
    }

    fn path(&self) -> &Path {
        match self {
            Self::NotFound { path }
            | Self::Busy { path }
            | Self::NotPermitted { path }
            | Self::NotAPort { path, .. }
            | Self::Baud { path, .. }
            | Self::Io { path, .. } => path,
        }
    }
}

fn named(path: &Path) -> String {
    match PortAddress::of(path) {
        Ok(PortAddress::Serial(path)) => format!("serial port {}", path.display()),
        Ok(PortAddress::File(path)) => format!("telemetry file {}", path.display()),
        Ok(PortAddress::Udp(_)) | Err(_) => path.display().to_string(),
    }
}

fn expected(path: &Path) -> &'static str {
    if PortAddress::begins_whole(path) { "a file" } else { "a serial port" }
}

/// What a person at the C-arm can do about `error`.
#[must_use]
pub fn hint(error: &PortError) -> &'static str {
    let address = PortAddress::of(error.path());
    match (error, address) {
        (PortError::NotFound { .. }, Ok(PortAddress::File(_))) => {
            "it is read from its beginning as soon as it is there; check its path"
        }
        (PortError::NotPermitted { .. }, Ok(PortAddress::File(_))) => "give this user the right to read it",
        (PortError::NotAPort { .. }, Ok(PortAddress::File(_))) => "name the file that the device's program writes",
        (_, Ok(PortAddress::File(_))) => "check the disk and the path",
        (PortError::Busy { .. }, Ok(PortAddress::Udp(_)) | Err(_)) => {
            "end the program that listens there (`ss -ulnp` names it), or send to another port"
        }
        (PortError::NotPermitted { .. }, Ok(PortAddress::Udp(_)) | Err(_)) => "take a port from 1024 on",
        (_, Ok(PortAddress::Udp(_)) | Err(_)) => "give an address of this machine, as udp://127.0.0.1:5005",
        (PortError::NotFound { .. }, _) => "check the cable and the path; `sidecarm devices` lists the ports that exist",
        (PortError::Busy { .. }, _) => {
            "close the other program (a terminal, ModemManager, a second sidecarm); `fuser PORT` names it"
        }
        (PortError::NotPermitted { .. }, _) => {
            "add yourself to the group that owns the port (`sudo usermod -aG dialout $USER`), then log in again"
        }
        (PortError::NotAPort { .. }, _) => {
            "give a serial device such as /dev/ttyUSB0 or /dev/serial/by-id/…; `sidecarm devices` lists them"
        }
        (PortError::Baud { .. }, _) => "give a `baud` that the adapter supports and set the same on the device",
        (PortError::Io { .. }, _) => "unplug and replug the adapter; if it stays, look into `dmesg`",
    }
}
