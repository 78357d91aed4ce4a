//! A device's end of a serial line: a pseudo-terminal behind a stable symbolic link, which can be unplugged.

use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};

use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};

use crate::MockError;

/// A serial line that the mock writes and somebody else reads at [`Line::path`].
#[derive(Debug)]
pub struct Line {
    link: PathBuf,
    plugged: Option<Plugged>,
    /// Bytes that the system's buffer did not take, because nobody read.
    pub overrun_bytes: u64,
}

#[derive(Debug)]
struct Plugged {
    master: OwnedFd,
    /// Held open so that the line does not hang up between readers.
    slave: OwnedFd,
}

impl Line {
    /// Opens a pseudo-terminal and lets `link` point to it.
    ///
    /// # Errors
    /// When the system has no pseudo-terminal left or the link cannot be made.
    pub fn open(link: &Path) -> Result<Self, MockError> {
        let mut line = Self { link: link.to_owned(), plugged: None, overrun_bytes: 0 };
        line.plug()?;
        Ok(line)
    }

    /// The stable path that a reader opens.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.link
    }

    /// Whether the line is there.
    #[must_use]
    pub fn is_plugged(&self) -> bool {
        self.plugged.is_some()
    }

    /// Puts a new pseudo-terminal behind the link.
    ///
    /// # Errors
    /// As [`Line::open`].
    pub fn plug(&mut self) -> Result<(), MockError> {
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
        self.plugged = Some(Plugged { master, slave });
        Ok(())
    }

    /// Whether everything that was written has been read.
    ///
    /// # Errors
    /// When the system does not say.
    pub fn is_read(&self) -> Result<bool, MockError> {
        let Some(plugged) = &self.plugged else { return Ok(false) };
        let failed = |errno: rustix::io::Errno| MockError::Io { what: self.link.display().to_string(), source: errno.into() };
        Ok(rustix::io::ioctl_fionread(&plugged.slave).map_err(failed)? == 0)
    }

    /// Pulls the plug: the link goes, readers get an end of file or an error, and what they had not read is gone.
    pub fn unplug(&mut self) {
        let _ = std::fs::remove_file(&self.link);
        self.plugged = None;
    }

    /// Writes without waiting; what the system's buffer does not take is lost and counted.
    pub fn write(&mut self, bytes: &[u8]) {
        let Some(plugged) = &self.plugged else { return };
        let mut rest = bytes;
        while !rest.is_empty() {
            match rustix::io::write(&plugged.master, rest) {
                Ok(count) if count > 0 => rest = &rest[count..],
                Err(rustix::io::Errno::INTR) => {}
                _ => {
                    self.overrun_bytes += rest.len() as u64;
                    return;
                }
            }
        }
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        self.unplug();
    }
}
