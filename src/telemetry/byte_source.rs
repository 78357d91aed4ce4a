//! The seam through which a device's bytes come: a serial port, datagrams, a file that grows, a script. A source opens, reads and says how
//! it ended; whoever drives it counts its openings, and opens it again.

use std::path::PathBuf;

use super::port_error::PortError;

/// Where a device's bytes come from.
pub trait ByteSource: Send {
    /// Whether what comes while it is not open waits in it. It is opened again at once then: what waits would take its time of arrival from
    /// the end of the wait.
    const KEEPS_BYTES: bool;

    /// Opens it; after [`Heard::Lost`], again. Gives what stands behind its name: the device file behind symbolic links.
    ///
    /// # Errors
    /// As [`PortError`] tells apart; it is tried again later.
    fn open(&mut self) -> impl Future<Output = Result<PathBuf, PortError>> + Send;

    /// What comes next of what is open, as soon as it comes. Once it is to be closed: what has arrived, then [`Heard::Closed`].
    fn next(&mut self, closing: &mut Closing) -> impl Future<Output = Heard> + Send;
}

/// What comes of a source that is open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Heard {
    /// Bytes arrived.
    Bytes {
        /// Host time right after the read returned.
        host_us: i64,
        /// As they came; of a datagram of lines ended by a line feed.
        bytes: Vec<u8>,
    },
    /// Something that a person should know.
    Said {
        /// When.
        host_us: i64,
        /// In words, without names of files and addresses.
        words: String,
    },
    /// The device went away.
    Lost {
        /// What the system said.
        reason: String,
    },
    /// All that had arrived is read, as was asked for; it is not opened again.
    Closed,
}

/// Whether a source is to be closed.
#[derive(Debug)]
pub struct Closing(pub(super) tokio::sync::watch::Receiver<bool>);

impl Closing {
    /// Whether it is asked for.
    #[must_use]
    pub fn is_asked(&self) -> bool {
        *self.0.borrow()
    }

    /// Comes back once it is asked for.
    pub async fn asked(&mut self) {
        // A task that is dropped is not asked.
        let _ = self.0.wait_for(|closing| *closing).await;
    }
}
