//! `sidecarm devices`: which serial ports there are, and whether what a session needs is in place.

use std::path::{Path, PathBuf};

use serde::Serialize;

use crate::reporter::Reporter;

/// List serial ports, or check what a session needs.
#[derive(Clone, Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  sidecarm devices\n  sidecarm check session.json\n\nA session's port may also be udp://ADDRESS:PORT (datagrams) or file:PATH (what is written to a file's end)."
)]
pub struct DevicesArgs {
    /// The same as `sidecarm check SESSION.json`.
    #[arg(long, value_name = "SESSION.json")]
    pub check: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

/// A serial port of this machine.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct PortListing {
    /// Device file.
    pub path: PathBuf,
    /// Names that survive unplugging.
    pub by_id: Vec<PathBuf>,
    /// Vendor, product and serial number of a USB adapter, where the system tells.
    pub usb: Option<String>,
    /// Whether this user may open it; `None` if that cannot be told without opening it.
    pub permitted: Option<bool>,
}

/// The serial ports of this machine, by path. Nothing is opened.
#[must_use]
pub fn list_ports() -> Vec<PortListing> {
    let mut ports = std::collections::BTreeMap::<PathBuf, Option<String>>::new();
    for port in serialport::available_ports().unwrap_or_default() {
        let usb = match port.port_type {
            serialport::SerialPortType::UsbPort(usb) => {
                let mut words = vec![format!("{:04x}:{:04x}", usb.vid, usb.pid)];
                words.extend([usb.manufacturer, usb.product, usb.serial_number].into_iter().flatten());
                Some(words.join(" "))
            }
            _ => None,
        };
        ports.insert(PathBuf::from(port.port_name), usb);
    }
    // Without libudev the enumeration misses adapters; their names do not.
    for path in entries(Path::new("/dev")) {
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        if name.starts_with("ttyUSB") || name.starts_with("ttyACM") {
            ports.entry(path).or_insert(None);
        }
    }
    let links: Vec<(PathBuf, PathBuf)> = entries(Path::new("/dev/serial/by-id"))
        .into_iter()
        .filter_map(|link| std::fs::canonicalize(&link).ok().map(|target| (target, link)))
        .collect();
    for (target, _) in &links {
        ports.entry(target.clone()).or_insert(None);
    }
    let listing = |(path, usb): (PathBuf, Option<String>)| {
        let by_id = links.iter().filter(|(target, _)| *target == path).map(|(_, link)| link.clone()).collect();
        let permitted = permitted(&path);
        PortListing { path, by_id, usb, permitted }
    };
    ports.into_iter().map(listing).collect()
}

/// Prints the serial ports of this machine; exit code 0, also when there are none.
pub fn list(json: bool, reporter: &Reporter) -> u8 {
    let ports = list_ports();
    if json {
        println!("{}", serde_json::json!({ "ports": ports }));
        return 0;
    }
    if ports.is_empty() {
        reporter.note("no serial port found; plug the adapters in, or try `sidecarm demo`, which brings its own devices");
    }
    for port in ports {
        let stable = port.by_id.first().map(|link| format!("  use {}", link.display())).unwrap_or_default();
        let permission = match port.permitted {
            Some(false) => "  not permitted: `sudo usermod -aG dialout $USER`, then log in again",
            _ => "",
        };
        println!("{}  {}{stable}{permission}", port.path.display(), port.usb.as_deref().unwrap_or("serial port"));
    }
    0
}

/// Paths in a folder, sorted; empty if it cannot be read.
fn entries(folder: &Path) -> Vec<PathBuf> {
    let Ok(found) = std::fs::read_dir(folder) else { return Vec::new() };
    let mut paths: Vec<PathBuf> = found.filter_map(|entry| entry.ok().map(|entry| entry.path())).collect();
    paths.sort();
    paths
}

/// Whether this user may read and write `path`, from its mode and this process's groups; access lists are not looked at.
#[cfg(target_os = "linux")]
fn permitted(path: &Path) -> Option<bool> {
    use std::os::unix::fs::MetadataExt;
    let metadata = std::fs::metadata(path).ok()?;
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let numbers = |key: &str| -> Vec<u32> {
        let line = status.lines().find_map(|line| line.strip_prefix(key));
        line.map(|line| line.split_whitespace().filter_map(|word| word.parse().ok()).collect()).unwrap_or_default()
    };
    let user = *numbers("Uid:").get(1)?;
    let group = numbers("Gid:").get(1).copied();
    let shift = if user == metadata.uid() {
        6
    } else if group == Some(metadata.gid()) || numbers("Groups:").contains(&metadata.gid()) {
        3
    } else {
        0
    };
    Some(user == 0 || (metadata.mode() >> shift) & 0o6 == 0o6)
}

#[cfg(not(target_os = "linux"))]
fn permitted(_path: &Path) -> Option<bool> {
    None
}
