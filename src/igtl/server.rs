//! The sockets: clients come and go, and every one gets what is sent while it is there.
//!
//! One thread accepts, encodes once for all clients of a header version, and puts the bytes into their outboxes; it waits for none of them.

use std::collections::VecDeque;
use std::net::{IpAddr, SocketAddr, TcpListener, TcpStream};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::client::Client;
use super::decode::Received;
use super::header::HeaderVersion;
use super::message::{Content, Message, Status};
use super::outbox::Channel;
use crate::reporter::Reporter;
use crate::time::{Stopwatch, host_now_us};

/// Clients at one time.
pub const MOST_CLIENTS: usize = 16;
/// Messages that wait to be encoded; far more than come up while a large picture is.
const MOST_MESSAGES: usize = 1024;
/// Who comes waits at most this long.
const LOOK: Duration = Duration::from_millis(20);
/// The status is repeated so often, so that silence means that the connection is gone.
const ALIVE_MS: f64 = 1e3;
/// That a client is slow is said at once, and again at most so often.
const TELL_SLOW_MS: f64 = 10e3;
/// At the end what waits has so long to leave.
const DRAIN_MS: f64 = 300.0;

/// Why nothing can be sent.
#[derive(Debug, thiserror::Error)]
pub enum IgtlError {
    /// The port is not to be had.
    #[error(
        "OpenIGTLink cannot listen on {address}: {source}; choose another \"port\" under \"igtl\", or end the program that has it"
    )]
    Bind {
        /// Where.
        address: SocketAddr,
        /// What the system said.
        source: std::io::Error,
    },
    /// The system gives no thread.
    #[error("cannot start a thread: {source}; too many processes run, or memory is short")]
    Thread {
        /// What the system said.
        source: std::io::Error,
    },
}

struct Inbox {
    messages: VecDeque<Message>,
    /// Messages that went for newer ones before they were encoded.
    overrun: u64,
    ends: bool,
}

struct Shared {
    inbox: Mutex<Inbox>,
    changed: Condvar,
    clients: AtomicUsize,
    device: String,
    status: Mutex<Status>,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Inbox> {
        self.inbox.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn status_message(&self) -> Message {
        let status = self.status.lock().unwrap_or_else(PoisonError::into_inner).clone();
        Message { device: self.device.clone(), time_us: host_now_us(), content: Content::Status(status) }
    }

    fn answer(&self, received: &Received) -> Option<Message> {
        match received.type_name.as_str() {
            "GET_STATUS" => Some(self.status_message()),
            "GET_CAPABIL" => Some(Message { device: self.device.clone(), time_us: host_now_us(), content: Content::Capability }),
            // All else is sent as it comes up, or not at all.
            _ => None,
        }
    }
}

/// See the module. Dropped, it says that it leaves and closes.
pub struct Server {
    shared: Arc<Shared>,
    address: SocketAddr,
    hub: Option<std::thread::JoinHandle<()>>,
}

impl Server {
    /// Listens on `port` of `bind` (0: one that is free); `device` is the name under which the status is sent.
    ///
    /// # Errors
    /// When the port is not to be had.
    pub fn open(bind: IpAddr, port: u16, device: &str, status: Status, reporter: &Reporter) -> Result<Self, IgtlError> {
        let address = SocketAddr::new(bind, port);
        let refused = |source| IgtlError::Bind { address, source };
        let listener = TcpListener::bind(address).map_err(refused)?;
        listener.set_nonblocking(true).map_err(refused)?;
        let address = listener.local_addr().map_err(refused)?;
        let shared = Arc::new(Shared {
            inbox: Mutex::new(Inbox { messages: VecDeque::new(), overrun: 0, ends: false }),
            changed: Condvar::new(),
            clients: AtomicUsize::new(0),
            device: device.to_owned(),
            status: Mutex::new(status),
        });
        let hub = Hub {
            listener,
            shared: Arc::clone(&shared),
            reporter: reporter.clone(),
            clients: Vec::new(),
            numbered: 0,
            since_alive: Stopwatch::start(),
            told_overrun: 0,
        };
        let hub = std::thread::Builder::new().name("igtl".to_owned()).spawn(move || hub.run());
        let hub = hub.map_err(|source| IgtlError::Thread { source })?;
        Ok(Self { shared, address, hub: Some(hub) })
    }

    /// Where it listens.
    #[must_use]
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Clients that are there.
    #[must_use]
    pub fn clients(&self) -> usize {
        self.shared.clients.load(Ordering::Relaxed)
    }

    /// Sends to all who are there, and waits for nothing; what holds a number that is none is not sent.
    pub fn send(&self, message: Message) {
        if self.clients() == 0 || !message.is_finite() {
            return;
        }
        let mut inbox = self.shared.lock();
        if inbox.messages.len() >= MOST_MESSAGES {
            inbox.messages.pop_front();
            inbox.overrun += 1;
        }
        inbox.messages.push_back(message);
        self.shared.changed.notify_one();
    }

    /// The status from now on, sent at once.
    pub fn set_status(&self, status: Status) {
        *self.shared.status.lock().unwrap_or_else(PoisonError::into_inner) = status;
        self.send(self.shared.status_message());
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.shared.lock().ends = true;
        self.shared.changed.notify_one();
        if let Some(hub) = self.hub.take() {
            // A hub that died has closed everything.
            let _ = hub.join();
        }
    }
}

struct Served {
    client: Arc<Client>,
    told_dropped: u64,
    since_told: Option<Stopwatch>,
}

struct Hub {
    listener: TcpListener,
    shared: Arc<Shared>,
    reporter: Reporter,
    clients: Vec<Served>,
    numbered: u64,
    since_alive: Stopwatch,
    told_overrun: u64,
}

impl Hub {
    fn run(mut self) {
        loop {
            let (messages, overrun, ends) = self.wait();
            self.part();
            while let Ok((stream, peer)) = self.listener.accept() {
                self.welcome(stream, peer);
            }
            messages.iter().for_each(|message| self.distribute(message));
            if self.since_alive.ms() >= ALIVE_MS {
                self.since_alive = Stopwatch::start();
                self.distribute(&self.shared.status_message());
            }
            self.tell_slow();
            if overrun > self.told_overrun {
                self.told_overrun = overrun;
                self.reporter.warn("OpenIGTLink overrun", format!("{overrun} messages came faster than they could be encoded"));
            }
            if ends {
                return self.leave();
            }
        }
    }

    fn wait(&self) -> (VecDeque<Message>, u64, bool) {
        let inbox = self.shared.lock();
        let idle = |inbox: &mut Inbox| inbox.messages.is_empty() && !inbox.ends;
        let (mut inbox, _) = self.shared.changed.wait_timeout_while(inbox, LOOK, idle).unwrap_or_else(PoisonError::into_inner);
        (std::mem::take(&mut inbox.messages), inbox.overrun, inbox.ends)
    }

    fn welcome(&mut self, stream: TcpStream, peer: SocketAddr) {
        if self.clients.len() >= MOST_CLIENTS {
            let words = format!("OpenIGTLink client {peer} is turned away: {MOST_CLIENTS} are there already");
            return self.reporter.warn("OpenIGTLink clients", words);
        }
        self.numbered += 1;
        let shared = Arc::clone(&self.shared);
        let answer = move |received: &Received| shared.answer(received);
        match Client::start(stream, peer, self.numbered, &self.reporter, answer) {
            Ok(client) => {
                self.reporter.note(format!("{} is there", client.label()));
                self.clients.push(Served { client, told_dropped: 0, since_told: None });
                self.shared.clients.store(self.clients.len(), Ordering::Relaxed);
                if let Some(served) = self.clients.last() {
                    let message = self.shared.status_message();
                    served.client.push(Channel::of(&message), message.encode(HeaderVersion::V1).into());
                }
            }
            Err(error) => self.reporter.warn("OpenIGTLink clients", format!("OpenIGTLink client {peer} is turned away: {error}")),
        }
    }

    /// Forgets those who have gone.
    fn part(&mut self) {
        let reporter = &self.reporter;
        self.clients.retain(|Served { client, .. }| {
            let gone = client.is_closed();
            if gone {
                let dropped = match client.dropped() {
                    0 => String::new(),
                    dropped => format!("; {dropped} messages were dropped because it did not keep up"),
                };
                reporter.note(format!("{} has gone{dropped}", client.label()));
            }
            !gone
        });
        self.shared.clients.store(self.clients.len(), Ordering::Relaxed);
    }

    fn distribute(&self, message: &Message) {
        let channel = Channel::of(message);
        for version in [HeaderVersion::V1, HeaderVersion::V2] {
            let mut of_version = self.clients.iter().filter(|served| served.client.version() == version).peekable();
            if of_version.peek().is_none() {
                continue;
            }
            let bytes: Arc<[u8]> = message.encode(version).into();
            of_version.for_each(|served| served.client.push(channel.clone(), Arc::clone(&bytes)));
        }
    }

    fn tell_slow(&mut self) {
        for Served { client, told_dropped, since_told } in &mut self.clients {
            let dropped = client.dropped();
            if dropped > *told_dropped && since_told.is_none_or(|since| since.ms() >= TELL_SLOW_MS) {
                (*told_dropped, *since_told) = (dropped, Some(Stopwatch::start()));
                let words =
                    format!("{} does not keep up: {dropped} messages dropped so far, the newest are kept", client.label());
                self.reporter.warn("OpenIGTLink client slow", words);
            }
        }
    }

    fn leave(self) {
        let words = "the session ends".to_owned();
        let status = Status { code: Status::LEAVING, frame: 0, name: "leaving".to_owned(), words };
        *self.shared.status.lock().unwrap_or_else(PoisonError::into_inner) = status;
        self.distribute(&self.shared.status_message());
        let watch = Stopwatch::start();
        while watch.ms() < DRAIN_MS && !self.clients.iter().all(|served| served.client.is_idle()) {
            std::thread::sleep(Duration::from_millis(5));
        }
        self.clients.iter().for_each(|served| served.client.close());
    }
}
