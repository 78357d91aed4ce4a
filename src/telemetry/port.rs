//! Ports, driven from tokio: bytes with their arrival time, unplugging, re-opening; serial lines, datagrams and growing files alike.
//!
//! Read-only toward devices: nothing here can send a byte. [`PortTask`] owns the port and offers no access to it.

use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tokio::sync::mpsc::Sender;

use super::address::{PortAddress, PortConfig};
use super::device::DeviceKind;
use super::outlet::{Counters, Deaf, Ended, Outlet, PortEvent};
use super::port_error::PortError;
use super::tail::{self, Tail};
use super::{serial, udp};
use crate::time::host_now_us;

/// Wait before the first attempt to open again; doubled after each failure.
pub const FIRST_BACKOFF: Duration = Duration::from_millis(50);
/// Longest wait between attempts.
pub const LONGEST_BACKOFF: Duration = Duration::from_secs(1);

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

/// A port that is open, or opening.
enum Source {
    Serial,
    Udp(udp::Listener),
    File(Tail),
}

impl Source {
    fn of(config: &PortConfig) -> Result<Self, PortError> {
        let of_lines = config.adapter.is_some();
        match PortAddress::of(&config.path) {
            Ok(PortAddress::Serial(_)) => Ok(Self::Serial),
            Ok(PortAddress::Udp(address)) => Ok(Self::Udp(udp::Listener::new(address, of_lines))),
            Ok(PortAddress::File(path)) => Ok(Self::File(Tail::new(path, config.adapter.clone()))),
            Err(error) => Err(PortError::Io { path: config.path.clone(), reason: error.to_string() }),
        }
    }

    /// Opens it and reads until it ends; `Err` in the outer result when nobody listens any more.
    async fn read(&mut self, config: &PortConfig, epoch: u32, outlet: &mut Outlet) -> Result<Result<Ended, PortError>, Deaf> {
        let path = config.path.clone();
        let opened = |resolved| PortEvent::Opened { epoch, host_us: host_now_us(), path: path.clone(), resolved };
        match self {
            Self::Serial => match serial::open(config, epoch == 0) {
                Ok((port, resolved)) => {
                    outlet.send(opened(resolved)).await?;
                    serial::pump(port, epoch, outlet).await.map(Ok)
                }
                Err(error) => Ok(Err(error)),
            },
            Self::Udp(listener) => match listener.open(&path).await {
                Ok(socket) => {
                    outlet.send(opened(path.clone())).await?;
                    listener.pump(socket, epoch, outlet).await.map(Ok)
                }
                Err(error) => Ok(Err(error)),
            },
            Self::File(tail) => match tail.open(&path).await {
                Ok(open) => {
                    outlet.send(opened(path.clone())).await?;
                    tail::pump(tail, open, epoch, outlet).await.map(Ok)
                }
                Err(error) => Ok(Err(error)),
            },
        }
    }
}

async fn run(config: PortConfig, mut outlet: Outlet) {
    let mut epoch = 0;
    let mut attempt = 0;
    let mut backoff = FIRST_BACKOFF;
    let mut source = Source::of(&config);
    let is_whole = PortAddress::begins_whole(&config.path);
    loop {
        // What waits in a socket or stands in another file must not wait longer: its time would be that of the wait's end.
        let mut at_once = false;
        let read = match &mut source {
            Ok(source) => source.read(&config, epoch, &mut outlet).await,
            Err(error) => Ok(Err(error.clone())),
        };
        let event = match read {
            Err(Deaf) => return,
            Ok(Ok((reason, received))) => {
                attempt = 0;
                // A port that opens and dies at once must not be hammered.
                if received {
                    backoff = FIRST_BACKOFF;
                    at_once = is_whole;
                }
                epoch += 1;
                PortEvent::Lost { epoch: epoch - 1, host_us: host_now_us(), reason }
            }
            Ok(Err(error)) => {
                attempt += 1;
                PortEvent::Retry { host_us: host_now_us(), attempt, wait_ms: backoff.as_millis() as u64, error }
            }
        };
        if outlet.send(event).await.is_err() {
            return;
        }
        if at_once {
            continue;
        }
        tokio::select! {
            () = tokio::time::sleep(backoff) => {}
            () = outlet.asked_to_finish() => return,
        }
        backoff = (backoff * 2).min(LONGEST_BACKOFF);
        if outlet.sink.is_closed() {
            return;
        }
    }
}
