//! A watched folder into which frames also come over DICOM.

use std::net::SocketAddr;
use std::path::Path;
use std::sync::mpsc::{self, channel};

use super::receiver::{Receiver, ReceiverError, ReceiverOptions};
use super::source::{FrameSource, Sighting};
use super::spool::Spool;

/// See the module: objects become files of the folder, and from there on are what all its files are.
pub struct ReceivedSource {
    folder: Box<dyn FrameSource>,
    receiver: Receiver,
    told: mpsc::Receiver<Sighting>,
}

impl ReceivedSource {
    /// Listens; `path` is the folder that `folder` watches.
    ///
    /// # Errors
    /// When the port is not to be had.
    pub fn open(folder: Box<dyn FrameSource>, path: &Path, options: ReceiverOptions) -> Result<Self, ReceiverError> {
        let (sender, told) = channel();
        let receiver = Receiver::open(options, Spool::lasting(path, "dicom"), sender)?;
        Ok(Self { folder, receiver, told })
    }

    /// Where it listens.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.receiver.address()
    }
}

impl FrameSource for ReceivedSource {
    fn look(&mut self, now_us: i64) -> Vec<Sighting> {
        let mut found: Vec<Sighting> = self.told.try_iter().collect();
        found.extend(self.folder.look(now_us));
        found
    }

    fn close(&mut self) {
        self.receiver.close();
        self.folder.close();
    }

    fn is_expecting(&self) -> bool {
        self.folder.is_expecting()
    }

    fn give_up(&mut self) -> Vec<Sighting> {
        self.folder.give_up()
    }
}
