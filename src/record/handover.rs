//! Handing a log over to its keeper (`keeper.rs`): a copy in memory, after which a kill of this process loses nothing.
//!
//! The writer's thread copies and announces; a thread of its own listens to the keeper, gives back memory that is in the file, and starts
//! another keeper where one was killed: what the file lacks still lies in the shared memory.

use std::fs::File;
use std::io::{Error, Read, Result, Write};
use std::net::Shutdown;
use std::os::fd::OwnedFd;
use std::os::unix::fs::FileExt;
use std::os::unix::net::UnixStream;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::fs::{FallocateFlags, MemfdFlags, fallocate, memfd_create};

use super::keeper::Told;
use super::place::{CUT, DELETED, Place};
use super::queue::Queue;
use super::sink::Sink;

/// A keeper that has not said a word by then is none.
const START: Duration = Duration::from_secs(30);
/// So many keepers in a row may die without having written anything.
const FRUITLESS: u32 = 3;
/// Memory is given back in multiples of this: no system has larger pages here.
const PAGE_BYTES: u64 = 64 << 10;

/// A log that a keeper writes.
pub(super) struct Handover {
    shared: Arc<Shared>,
    at: u64,
    listener: Option<JoinHandle<()>>,
}

struct Shared {
    program: PathBuf,
    path: PathBuf,
    log: File,
    memory: File,
    queue: Arc<Queue>,
    link: Mutex<Link>,
}

/// The way to the keeper.
#[derive(Default)]
struct Link {
    channel: Option<UnixStream>,
    announced: u64,
    /// Nothing more will be announced.
    ended: bool,
}

/// A running keeper.
struct Keeper {
    child: Child,
    channel: UnixStream,
}

impl Handover {
    /// Starts a keeper of `log`, which is empty and lies at `path`.
    pub(super) fn start(program: &Path, path: &Path, log: &File, queue: &Arc<Queue>) -> Result<Self> {
        let memory = File::from(memfd_create("sidecarm log", MemfdFlags::CLOEXEC)?);
        // Memory that cannot be given back would grow with the session.
        give_back(&memory, 0, PAGE_BYTES)?;
        let (program, path) = (program.to_owned(), path.to_owned());
        let link = Mutex::default();
        let shared = Arc::new(Shared { program, path, log: log.try_clone()?, memory, queue: Arc::clone(queue), link });
        let keeper = shared.start_keeper(0)?;
        shared.attach(&keeper)?;
        let listener = std::thread::Builder::new().name("log keeper".into()).spawn({
            let shared = Arc::clone(&shared);
            move || shared.attend(keeper)
        })?;
        Ok(Self { shared, at: 0, listener: Some(listener) })
    }
}

impl Write for Handover {
    fn write(&mut self, bytes: &[u8]) -> Result<usize> {
        self.shared.memory.write_all_at(bytes, self.at)?;
        self.at += bytes.len() as u64;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> Result<()> {
        Ok(())
    }
}

impl Sink for Handover {
    fn deliver(&mut self, end: u64) -> Result<()> {
        let mut link = self.shared.link();
        link.announced = end;
        if let Some(channel) = &mut link.channel {
            // A keeper that is gone is the listener's business; the next one is told.
            let _ = channel.write_all(&end.to_le_bytes());
        }
        Ok(())
    }
}

impl Drop for Handover {
    fn drop(&mut self) {
        {
            let mut link = self.shared.link();
            link.ended = true;
            if let Some(channel) = &link.channel {
                let _ = channel.shutdown(Shutdown::Write);
            }
        }
        if let Some(listener) = self.listener.take() {
            let _ = listener.join();
        }
    }
}

impl Shared {
    fn link(&self) -> MutexGuard<'_, Link> {
        self.link.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Starts a keeper of a file that holds `in_file` bytes, and waits until it says so.
    fn start_keeper(&self, in_file: u64) -> Result<Keeper> {
        let (channel, theirs) = UnixStream::pair()?;
        let mut command = Command::new(&self.program);
        command.arg("keep-log").arg(&self.path).arg(in_file.to_string());
        command.stdin(self.memory.try_clone()?).stdout(self.log.try_clone()?).stderr(OwnedFd::from(theirs));
        // What is sent to the group of this process, as Ctrl-C is, is not meant for the keeper.
        let child = command.process_group(0).spawn()?;
        // Holds the keeper's end of the socket.
        drop(command);
        let mut keeper = Keeper { child, channel };
        keeper.channel.set_read_timeout(Some(START))?;
        match keeper.hear() {
            Some(Told::InFile(found)) if found == in_file => {
                keeper.channel.set_read_timeout(None)?;
                Ok(keeper)
            }
            _ => Err(Error::other(format!("{} does not write logs", self.program.display()))),
        }
    }

    /// Announcements go to `keeper` from now on; it hears of those it missed.
    fn attach(&self, keeper: &Keeper) -> Result<()> {
        let mut channel = keeper.channel.try_clone()?;
        let mut link = self.link();
        let _ = channel.write_all(&link.announced.to_le_bytes());
        if link.ended {
            let _ = channel.shutdown(Shutdown::Write);
        }
        link.channel = Some(channel);
        Ok(())
    }

    /// Listens until all is written or nothing can be.
    fn attend(&self, mut keeper: Keeper) {
        let (mut in_file, mut fruitless) = (0, 0);
        loop {
            let before = in_file;
            if let Some(failure) = self.listen(&mut keeper, &mut in_file) {
                return self.queue.close(Some(failure));
            }
            if self.link().ended {
                let _ = keeper.child.wait();
                return;
            }
            self.queue.keeper_left();
            // Two that write one file would be worse than none.
            drop(keeper);
            fruitless = if in_file > before { 0 } else { fruitless + 1 };
            let next = if fruitless < FRUITLESS {
                self.start_keeper(in_file).and_then(|keeper| self.attach(&keeper).map(|()| keeper))
            } else {
                Err(Error::other(format!("it died {fruitless} times without having written anything")))
            };
            keeper = match next {
                Ok(keeper) => keeper,
                Err(error) => {
                    let why = format!("the process that writes the log died, and another cannot take its place ({error})");
                    return self.queue.close(Some(why));
                }
            };
            self.queue.keeper_came();
        }
    }

    /// Listens until the keeper is gone; why nothing can be written any more, if that is so.
    fn listen(&self, keeper: &mut Keeper, in_file: &mut u64) -> Option<String> {
        loop {
            match keeper.hear()? {
                Told::InFile(end) => {
                    let (from, to) = (*in_file / PAGE_BYTES, end / PAGE_BYTES);
                    if to > from {
                        let _ = give_back(&self.memory, from * PAGE_BYTES, (to - from) * PAGE_BYTES);
                    }
                    *in_file = end;
                    self.queue.in_file(end);
                }
                Told::Placed(Place::Deleted) => return Some(DELETED.to_owned()),
                Told::Placed(Place::Cut) => return Some(CUT.to_owned()),
                Told::Placed(place) => self.queue.placed(place == Place::Moved),
                Told::Failed(0) => return Some("the process that writes the log cannot write it".to_owned()),
                Told::Failed(code) => return Some(Error::from_raw_os_error(code).to_string()),
            }
        }
    }
}

impl Keeper {
    /// What it says next; `None` when it is gone, or says what no keeper says.
    fn hear(&mut self) -> Option<Told> {
        let mut bytes = [0; Told::BYTES];
        self.channel.read_exact(&mut bytes).ok()?;
        Told::from_bytes(bytes)
    }
}

impl Drop for Keeper {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The bytes are in the file: their memory is free again.
fn give_back(memory: &File, from: u64, length: u64) -> Result<()> {
    Ok(fallocate(memory, FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE, from, length)?)
}
