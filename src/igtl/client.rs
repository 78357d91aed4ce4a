//! One client: a thread that writes to it and one that hears it, so that neither waits for the other.

use std::io::{ErrorKind, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::decode::{Decoder, Received};
use super::header::HeaderVersion;
use super::message::Message;
use super::outbox::{Channel, Outbox};
use crate::reporter::Reporter;

/// A client that takes no byte for so long is not there any more.
const STALLED: Duration = Duration::from_secs(30);

#[derive(Default)]
struct Waiting {
    outbox: Outbox,
    /// A message is on its way into the socket.
    writing: bool,
    closed: bool,
}

/// See the module.
pub(super) struct Client {
    label: String,
    stream: TcpStream,
    /// Whether it writes headers of version 2.
    is_v2: AtomicBool,
    waiting: Mutex<Waiting>,
    changed: Condvar,
}

impl Client {
    /// Starts both threads; `answer` gives what a query is answered with.
    pub(super) fn start(
        stream: TcpStream,
        peer: SocketAddr,
        number: u64,
        reporter: &Reporter,
        answer: impl Fn(&Received) -> Option<Message> + Send + 'static,
    ) -> std::io::Result<Arc<Self>> {
        // Where the listener does not block, what it accepts may not either.
        stream.set_nonblocking(false)?;
        stream.set_nodelay(true)?;
        stream.set_write_timeout(Some(STALLED))?;
        let (input, output) = (stream.try_clone()?, stream.try_clone()?);
        let client = Arc::new(Self {
            label: format!("OpenIGTLink client {number} ({peer})"),
            stream,
            is_v2: AtomicBool::new(false),
            waiting: Mutex::default(),
            changed: Condvar::new(),
        });
        let (hears, writes, reporter) = (Arc::clone(&client), Arc::clone(&client), reporter.clone());
        let told = reporter.clone();
        std::thread::Builder::new().name("igtl write".to_owned()).spawn(move || writes.write_on(output, &told))?;
        let heard = std::thread::Builder::new().name("igtl read".to_owned()).spawn(move || {
            hears.hear(input, &reporter, &answer);
            hears.close();
        });
        heard.inspect_err(|_| client.close())?;
        Ok(client)
    }

    /// How people are told of it.
    pub(super) fn label(&self) -> &str {
        &self.label
    }

    /// The format that it understands, by what it sends.
    pub(super) fn version(&self) -> HeaderVersion {
        if self.is_v2.load(Ordering::Relaxed) { HeaderVersion::V2 } else { HeaderVersion::V1 }
    }

    /// Lets a message wait for its turn.
    pub(super) fn push(&self, channel: Channel, bytes: Arc<[u8]>) {
        let mut waiting = self.lock();
        if !waiting.closed {
            waiting.outbox.push(channel, bytes);
            self.changed.notify_all();
        }
    }

    /// Messages that went for newer ones.
    pub(super) fn dropped(&self) -> u64 {
        self.lock().outbox.dropped()
    }

    /// Whether all has been handed to the system.
    pub(super) fn is_idle(&self) -> bool {
        let waiting = self.lock();
        waiting.closed || waiting.outbox.is_empty() && !waiting.writing
    }

    pub(super) fn is_closed(&self) -> bool {
        self.lock().closed
    }

    /// Ends both threads, wherever they stand.
    pub(super) fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
        // It may have gone already.
        let _ = self.stream.shutdown(Shutdown::Both);
    }

    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The next message; `None` when there will be none.
    fn next(&self) -> Option<Arc<[u8]>> {
        let mut waiting = self.lock();
        waiting.writing = false;
        loop {
            if waiting.closed {
                return None;
            }
            if let Some(bytes) = waiting.outbox.pop() {
                waiting.writing = true;
                return Some(bytes);
            }
            waiting = self.changed.wait(waiting).unwrap_or_else(PoisonError::into_inner);
        }
    }

    fn write_on(&self, mut output: TcpStream, reporter: &Reporter) {
        while let Some(bytes) = self.next() {
            if let Err(error) = output.write_all(&bytes) {
                if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) && !self.is_closed() {
                    let words = format!("{} has taken nothing for {} s and is disconnected", self.label, STALLED.as_secs());
                    reporter.warn("OpenIGTLink client stalled", words);
                }
                return self.close();
            }
        }
    }

    /// Reads until the client goes or sends what is no message.
    fn hear(&self, mut input: TcpStream, reporter: &Reporter, answer: &dyn Fn(&Received) -> Option<Message>) {
        let mut decoder = Decoder::new();
        let mut buffer = [0; 4096];
        loop {
            let count = match input.read(&mut buffer) {
                Ok(0) => return,
                Ok(count) => count,
                Err(error) if error.kind() == ErrorKind::Interrupted => continue,
                Err(_) => return,
            };
            let taken = decoder.push(&buffer[..count], &mut |received| {
                self.is_v2.store(received.version == HeaderVersion::V2, Ordering::Relaxed);
                if let Some(message) = answer(&received) {
                    self.push(Channel::of(&message), message.encode(received.version).into());
                }
            });
            if let Err(fault) = taken {
                return reporter.warn(fault.kind(), format!("{}: {fault}; it is disconnected", self.label));
            }
        }
    }
}
