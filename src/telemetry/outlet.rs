//! What happens on a port, on its way to whoever listens.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tokio::sync::mpsc::Sender;
use tokio::sync::mpsc::error::TrySendError;

use super::device::DeviceKind;
use super::port_error::PortError;

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
        /// As they came; of a datagram of lines ended by a line feed.
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
    /// Something about the port that a person should know.
    Said {
        /// When.
        host_us: i64,
        /// In words, without names of files and addresses.
        words: String,
    },
}

/// Counters of a port, readable from any thread.
#[derive(Debug, Default)]
pub(super) struct Counters {
    pub(super) bytes: AtomicU64,
    pub(super) stalls: AtomicU64,
}

/// Where events go; `Err` when nobody listens any more.
pub(super) struct Outlet {
    pub(super) device: DeviceKind,
    pub(super) sink: Sender<(DeviceKind, PortEvent)>,
    pub(super) counters: Arc<Counters>,
}

/// The receiver is gone.
pub(super) struct Deaf;

impl Outlet {
    pub(super) async fn send(&self, event: PortEvent) -> Result<(), Deaf> {
        if let PortEvent::Bytes { bytes, .. } = &event {
            self.counters.bytes.fetch_add(bytes.len() as u64, Ordering::Relaxed);
        }
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
