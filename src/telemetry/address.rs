//! Where a device's bytes come from: a serial port, datagrams, a file that grows.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};

use super::device::{DEFAULT_BAUD, DeviceKind};
use super::lines::LineAdapter;

const UDP: &str = "udp:";
const FILE: &str = "file:";

/// Where bytes come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum PortAddress {
    /// Device file; a stable symbolic link (`/dev/serial/by-id/…`) survives unplugging, it is resolved anew at every opening.
    Serial(PathBuf),
    /// `udp://ADDRESS:PORT`: datagrams to this address of the host; `udp://:PORT` is the loopback's.
    Udp(SocketAddr),
    /// `file:PATH`: what is written to the end of a file from now on.
    File(PathBuf),
}

/// A port's name that is none.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{found:?} is no address to listen on, expected udp://ADDRESS:PORT such as udp://127.0.0.1:5005, or udp://:PORT")]
pub struct AddressError {
    /// As named.
    pub found: String,
}

impl PortAddress {
    /// Of a port as a session names it.
    ///
    /// # Errors
    /// When it begins as a UDP address and is none.
    pub fn of(port: &Path) -> Result<Self, AddressError> {
        let text = port.to_string_lossy();
        if let Some(rest) = text.strip_prefix(FILE) {
            return Ok(Self::File(PathBuf::from(rest.strip_prefix("//").filter(|rest| rest.starts_with('/')).unwrap_or(rest))));
        }
        let Some(rest) = text.strip_prefix(UDP) else { return Ok(Self::Serial(port.to_owned())) };
        let rest = rest.strip_prefix("//").unwrap_or(rest);
        let address = match rest.strip_prefix(':').or(rest.strip_prefix("localhost:")) {
            Some(number) => number.parse().ok().map(|number| SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), number)),
            None => rest.parse().ok(),
        };
        let usable = address.filter(|address: &SocketAddr| address.port() != 0);
        usable.map(Self::Udp).ok_or_else(|| AddressError { found: text.into_owned() })
    }

    /// Whether what comes first after an opening is never the rest of something that began before.
    #[must_use]
    pub fn begins_whole(port: &Path) -> bool {
        !matches!(Self::of(port), Ok(Self::Serial(_)))
    }

    /// The port with names of files taken as relative to `folder`.
    #[must_use]
    pub fn beside(port: &Path, folder: &Path) -> PathBuf {
        match Self::of(port) {
            Ok(Self::Serial(path)) => folder.join(path),
            Ok(Self::File(path)) => PathBuf::from(format!("{FILE}{}", folder.join(path).display())),
            Ok(Self::Udp(_)) | Err(_) => port.to_owned(),
        }
    }

    /// What kind of port it is, without a folder, and without a file's name or an address: those of a serial device are nobody's.
    #[must_use]
    pub fn told(port: &Path) -> PathBuf {
        match Self::of(port) {
            Ok(Self::Serial(path)) => path.file_name().map(PathBuf::from).unwrap_or_default(),
            Ok(Self::File(_)) => PathBuf::from(FILE),
            Ok(Self::Udp(_)) | Err(_) => PathBuf::from(UDP),
        }
    }
}

/// A port and the device expected behind it.
#[derive(Clone, Debug, PartialEq)]
pub struct PortConfig {
    /// What speaks there.
    pub device: DeviceKind,
    /// As a session names it: see [`PortAddress`].
    pub path: PathBuf,
    /// Bits per second; pseudo-terminals ignore it, and what is no serial port has none.
    pub baud: u32,
    /// How its lines are read, if it does not speak packets.
    pub adapter: Option<LineAdapter>,
}

impl PortConfig {
    /// Packets from `path` at [`DEFAULT_BAUD`].
    #[must_use]
    pub fn new(device: DeviceKind, path: impl Into<PathBuf>) -> Self {
        Self { device, path: path.into(), baud: DEFAULT_BAUD, adapter: None }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_serial_port_says_so_in_its_name() {
        let of = |text: &str| PortAddress::of(Path::new(text));
        assert_eq!(of("/dev/ttyUSB0"), Ok(PortAddress::Serial("/dev/ttyUSB0".into())));
        assert_eq!(of("udp://:5005"), Ok(PortAddress::Udp(([127, 0, 0, 1], 5005).into())));
        assert_eq!(of("udp://localhost:5005"), of("udp://127.0.0.1:5005"));
        assert_eq!(of("udp://0.0.0.0:5005"), Ok(PortAddress::Udp(([0, 0, 0, 0], 5005).into())));
        assert_eq!(of("file:///srv/robot.csv"), Ok(PortAddress::File("/srv/robot.csv".into())));
        assert_eq!(of("file:robot.csv"), Ok(PortAddress::File("robot.csv".into())));
        for wrong in ["udp://", "udp://robot:5005", "udp://127.0.0.1", "udp://:0", "udp://:66000"] {
            assert!(of(wrong).is_err_and(|error| error.to_string().contains("udp://127.0.0.1:5005")), "{wrong}");
        }
    }

    #[test]
    fn a_folder_is_put_before_files_and_never_told() {
        let folder = Path::new("/lab");
        let beside = |port: &str| PortAddress::beside(Path::new(port), folder).display().to_string();
        assert_eq!(beside("ttyROBOT"), "/lab/ttyROBOT");
        assert_eq!(beside("file:robot.csv"), "file:/lab/robot.csv");
        assert_eq!(beside("file:///srv/robot.csv"), "file:/srv/robot.csv");
        assert_eq!(beside("udp://:5005"), "udp://:5005");
        let told = |port: &str| PortAddress::told(Path::new(port));
        assert_eq!(
            [told("/dev/ttyUSB0"), told("file:/lab/robot.csv"), told("udp://10.0.0.7:5005")],
            ["ttyUSB0", "file:", "udp:"].map(PathBuf::from)
        );
        // A log keeps what is told: a replay reads from it how the bytes begin.
        for port in ["/dev/ttyUSB0", "file:/lab/robot.csv", "udp://:5005"] {
            let port = Path::new(port);
            assert_eq!(PortAddress::begins_whole(&PortAddress::told(port)), PortAddress::begins_whole(port));
        }
    }
}
