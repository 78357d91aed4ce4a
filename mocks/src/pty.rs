//! A device's end of a line, which can be unplugged: a pseudo-terminal behind a stable symbolic link, datagrams to a port of this machine, or a
//! file that grows.

use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};

use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use crate::MockError;

/// A line that the mock writes and somebody else reads at [`Line::path`].
#[derive(Debug)]
pub struct Line {
    link: PathBuf,
    /// Where datagrams go; none of a serial line and of a file.
    address: Option<SocketAddr>,
    /// It is written to the end of the file at `link`.
    is_file: bool,
    /// From where they come, once and again: 0 until the system has chosen.
    own_port: u16,
    plugged: Option<Plugged>,
    /// Bytes that the system's buffer did not take, because nobody read.
    pub overrun_bytes: u64,
}

#[derive(Debug)]
enum Plugged {
    Terminal {
        master: OwnedFd,
        /// Held open so that the line does not hang up between readers.
        slave: OwnedFd,
    },
    Socket(UdpSocket),
    File(std::fs::File),
}

impl Line {
    /// Opens a pseudo-terminal and lets `link` point to it.
    ///
    /// # Errors
    /// When the system has no pseudo-terminal left or the link cannot be made.
    pub fn open(link: &Path) -> Result<Self, MockError> {
        let mut line =
            Self { link: link.to_owned(), address: None, is_file: false, own_port: 0, plugged: None, overrun_bytes: 0 };
        line.plug()?;
        Ok(line)
    }

    /// Writes to the end of a file, which is empty at first. It stays when the plug is pulled, and when the line is dropped.
    ///
    /// # Errors
    /// When the file cannot be made.
    pub fn to_file(path: &Path) -> Result<Self, MockError> {
        std::fs::File::create(path).map_err(MockError::io(path.display()))?;
        let mut line = Self { is_file: true, link: path.to_owned(), address: None, own_port: 0, plugged: None, overrun_bytes: 0 };
        line.plug()?;
        Ok(line)
    }

    /// Sends to `port` of this machine, a datagram for each packet. One that nobody hears is lost, and nobody knows.
    ///
    /// # Errors
    /// When the system has no socket.
    pub fn to_port(port: u16) -> Result<Self, MockError> {
        let address = SocketAddr::from((Ipv4Addr::LOCALHOST, port));
        let link = PathBuf::from(format!("udp://{address}"));
        let mut line = Self { link, address: Some(address), is_file: false, own_port: 0, plugged: None, overrun_bytes: 0 };
        line.plug()?;
        Ok(line)
    }

    /// The stable path, or the address, that a reader opens.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.link
    }

    /// Whether the line is there.
    #[must_use]
    pub fn is_plugged(&self) -> bool {
        self.plugged.is_some()
    }

    /// Puts a new pseudo-terminal behind the link, or sends datagrams or writes to the file again.
    ///
    /// # Errors
    /// As [`Line::open`], [`Line::to_port`] and [`Line::to_file`].
    pub fn plug(&mut self) -> Result<(), MockError> {
        if self.is_file {
            let opened = std::fs::OpenOptions::new().append(true).create(true).open(&self.link);
            self.plugged = Some(Plugged::File(opened.map_err(MockError::io(self.link.display()))?));
            return Ok(());
        }
        if self.address.is_some() {
            let failed = || MockError::io(self.link.display());
            let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, self.own_port)).map_err(failed())?;
            socket.set_nonblocking(true).map_err(failed())?;
            self.own_port = socket.local_addr().map_err(failed())?.port();
            self.plugged = Some(Plugged::Socket(socket));
            return Ok(());
        }
        let failed = |errno: rustix::io::Errno| MockError::Io { what: "pseudo-terminal".to_owned(), source: errno.into() };
        let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY | OpenptFlags::CLOEXEC).map_err(failed)?;
        grantpt(&master).map_err(failed)?;
        unlockpt(&master).map_err(failed)?;
        let name = ptsname(&master, Vec::new()).map_err(failed)?;
        let path = PathBuf::from(name.to_string_lossy().into_owned());
        let flags = rustix::fs::OFlags::RDWR | rustix::fs::OFlags::NOCTTY | rustix::fs::OFlags::CLOEXEC;
        let slave = rustix::fs::open(&path, flags, rustix::fs::Mode::empty()).map_err(failed)?;
        let mut settings = tcgetattr(&slave).map_err(failed)?;
        settings.make_raw();
        tcsetattr(&slave, OptionalActions::Now, &settings).map_err(failed)?;
        let status = rustix::fs::fcntl_getfl(&master).map_err(failed)?;
        rustix::fs::fcntl_setfl(&master, status | rustix::fs::OFlags::NONBLOCK).map_err(failed)?;
        let _ = std::fs::remove_file(&self.link);
        std::os::unix::fs::symlink(&path, &self.link).map_err(MockError::io(self.link.display()))?;
        self.plugged = Some(Plugged::Terminal { master, slave });
        Ok(())
    }

    /// Whether everything that was written has been read; of datagrams, whether somebody listens; of a file, whether somebody has it open.
    ///
    /// # Errors
    /// When the system does not say.
    pub fn is_read(&self) -> Result<bool, MockError> {
        let failed = |errno: rustix::io::Errno| MockError::Io { what: self.link.display().to_string(), source: errno.into() };
        match &self.plugged {
            None => Ok(false),
            Some(Plugged::Terminal { slave, .. }) => Ok(rustix::io::ioctl_fionread(slave).map_err(failed)? == 0),
            Some(Plugged::Socket(_)) => Ok(self.address.is_some_and(|address| is_heard(address.port()))),
            Some(Plugged::File(_)) => Ok(is_followed(&self.link)),
        }
    }

    /// Pulls the plug: the link goes, readers get an end of file or an error, and what they had not read is gone. Of datagrams no more come, and
    /// a file grows no more.
    pub fn unplug(&mut self) {
        if self.address.is_none() && !self.is_file {
            let _ = std::fs::remove_file(&self.link);
        }
        self.plugged = None;
    }

    /// Writes without waiting; what the system's buffer does not take is lost and counted.
    pub fn write(&mut self, bytes: &[u8]) {
        let mut rest = bytes;
        match &self.plugged {
            None => return,
            Some(Plugged::Socket(socket)) => {
                let sent = self.address.is_some_and(|address| socket.send_to(bytes, address).is_ok());
                rest = if sent { &[] } else { bytes };
            }
            Some(Plugged::File(file)) => {
                let mut file = file;
                rest = if std::io::Write::write_all(&mut file, bytes).is_ok() { &[] } else { bytes };
            }
            Some(Plugged::Terminal { master, .. }) => {
                while !rest.is_empty() {
                    match rustix::io::write(master, rest) {
                        Ok(count) if count > 0 => rest = &rest[count..],
                        Err(rustix::io::Errno::INTR) => {}
                        _ => break,
                    }
                }
            }
        }
        self.overrun_bytes += rest.len() as u64;
    }
}

/// Whether a program of this machine listens to datagrams on `port`, by the system's own list: to try the port would take it away from who is
/// about to listen.
fn is_heard(port: u16) -> bool {
    let of_line = |line: &str| u16::from_str_radix(line.split_whitespace().nth(1)?.rsplit_once(':')?.1, 16).ok();
    std::fs::read_to_string("/proc/net/udp").is_ok_and(|list| list.lines().filter_map(of_line).any(|known| known == port))
}

/// Whether another program of this machine has the file open, by the system's own list.
fn is_followed(path: &Path) -> bool {
    let (Ok(path), own) = (std::fs::canonicalize(path), std::process::id().to_string()) else { return false };
    let others = std::fs::read_dir("/proc").into_iter().flatten().flatten().filter(|process| process.file_name() != *own);
    let mut open = others.filter_map(|process| std::fs::read_dir(process.path().join("fd")).ok()).flatten().flatten();
    open.any(|file| std::fs::read_link(file.path()).is_ok_and(|to| to == path))
}

impl Drop for Line {
    fn drop(&mut self) {
        self.unplug();
    }
}
