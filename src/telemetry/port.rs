//! Byte sources, driven from tokio: bytes with their arrival time, unplugging, re-opening; serial lines, datagrams, growing files and
//! scripts alike.
//!
//! Read-only toward devices: nothing here can send a byte. [`PortTask`] owns the port and offers no access to it.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tokio::sync::mpsc::Sender;

use super::address::{PortAddress, PortConfig};
use super::byte_source::{ByteSource, Closing, Heard};
use super::device::DeviceKind;
use super::outlet::{Counters, Deaf, Outlet, PortEvent};
use super::serial::Serial;
use super::tail::Tail;
use super::udp::Listener;
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
    let PortConfig { device, path: port, adapter, .. } = config.clone();
    let listener = |address| Listener::new(port.clone(), address, adapter.is_some());
    match PortAddress::of(&port) {
        Ok(PortAddress::Serial(_)) => spawn_source(handle, device, port, Serial::new(config), sink),
        Ok(PortAddress::Udp(address)) => spawn_source(handle, device, port.clone(), listener(Ok(address)), sink),
        Ok(PortAddress::File(path)) => spawn_source(handle, device, port.clone(), Tail::new(port, path, adapter), sink),
        // Told as a port that does not open.
        Err(error) => spawn_source(handle, device, port.clone(), listener(Err(error)), sink),
    }
}

/// Reads any source of `device`'s bytes as [`spawn_port`] does a port; `name` is what it is called when it opens.
#[must_use = "the source closes when the task is dropped"]
pub fn spawn_source(
    handle: &tokio::runtime::Handle,
    device: DeviceKind,
    name: PathBuf,
    source: impl ByteSource + 'static,
    sink: Sender<(DeviceKind, PortEvent)>,
) -> PortTask {
    let counters = Arc::new(Counters::default());
    let (finish, finishing) = tokio::sync::watch::channel(false);
    let outlet = Outlet { device, sink, counters: Arc::clone(&counters) };
    PortTask { task: handle.spawn(run(name, source, Closing(finishing), outlet)), finish, counters }
}

async fn run<S: ByteSource>(name: PathBuf, mut source: S, mut closing: Closing, outlet: Outlet) {
    let mut epoch = 0;
    let mut attempt = 0;
    let mut backoff = FIRST_BACKOFF;
    loop {
        let mut at_once = false;
        let event = match source.open().await {
            Ok(resolved) => {
                let opened = PortEvent::Opened { epoch, host_us: host_now_us(), path: name.clone(), resolved };
                let Ok((reason, received)) = read(&mut source, opened, epoch, &mut closing, &outlet).await else { return };
                attempt = 0;
                // A port that opens and dies at once must not be hammered.
                if received {
                    backoff = FIRST_BACKOFF;
                    at_once = S::KEEPS_BYTES;
                }
                epoch += 1;
                PortEvent::Lost { epoch: epoch - 1, host_us: host_now_us(), reason }
            }
            Err(error) => {
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
            () = closing.asked() => return,
        }
        backoff = (backoff * 2).min(LONGEST_BACKOFF);
        if outlet.sink.is_closed() {
            return;
        }
    }
}

/// Reads a source that is open: why it ended, and whether anything had come; `Err` when nobody listens any more, or all is read.
async fn read(
    source: &mut impl ByteSource,
    opened: PortEvent,
    epoch: u32,
    closing: &mut Closing,
    outlet: &Outlet,
) -> Result<(String, bool), Deaf> {
    outlet.send(opened).await?;
    let mut received = false;
    loop {
        match source.next(closing).await {
            Heard::Bytes { host_us, bytes } => {
                received = true;
                outlet.send(PortEvent::Bytes { host_us, epoch, bytes }).await?;
            }
            Heard::Said { host_us, words } => outlet.send(PortEvent::Said { host_us, words }).await?,
            Heard::Lost { reason } => return Ok((reason, received)),
            Heard::Closed => return Err(Deaf),
        }
    }
}
