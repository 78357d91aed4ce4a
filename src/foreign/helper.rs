//! Starting a helper, listening to it, and telling how it ended.

use std::io::Read;
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, ExitStatus, Stdio};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use super::feed::{self, Input};
use super::process::spawn;
use super::reserve::Reserve;
use super::{Kind, Receiver, Request, WireError};

/// Why a helper gave no answer. Nothing in here comes from the file.
#[derive(Clone, Debug, PartialEq, thiserror::Error, serde::Serialize, serde::Deserialize)]
pub enum ForeignFault {
    /// The helper did not start; no fault of the file.
    #[error("the helper process that opens foreign files cannot be started ({detail})")]
    Start {
        /// What the system said.
        detail: String,
    },
    /// More memory than any file of the kind takes.
    #[error("reading it takes more than {limit_mib} MiB of memory: damaged, or made to exhaust the machine")]
    Memory {
        /// The limit.
        limit_mib: u64,
    },
    /// More time than any file of the kind takes.
    #[error("reading it takes more than {limit_s} s: damaged, or made to keep the machine busy")]
    Time {
        /// The limit.
        limit_s: f64,
    },
    /// The stack ran out.
    #[error("its parts are nested too deeply: damaged, or made to crash the reader")]
    TooDeep,
    /// A panic or a crash in the decoder.
    #[error("the decoder broke down on it, so the file is damaged; copy it again")]
    Crashed,
    /// One of the files that it was to be given.
    #[error("one of its files cannot be read ({detail})")]
    Fed {
        /// What the system said.
        detail: String,
    },
    /// The helper's answer was not understood.
    #[error("the helper process gave no proper answer ({detail})")]
    Answer {
        /// What was wrong.
        detail: String,
    },
}

/// Bytes of a helper's standard error that are looked at, for the kind of its end; nothing of it is ever shown.
const ERROR_BYTES: u64 = 4096;

/// A helper at work, and the thread that gives it what it reads, where it does not read its file itself.
type Begun = (Child, Option<JoinHandle<std::io::Result<()>>>);

/// What decodes foreign files.
#[derive(Clone, Copy, Debug)]
pub struct Helpers<'a> {
    pub(super) program: &'a Path,
    pub(super) reserve: Option<&'a Reserve>,
}

impl Helpers<'_> {
    /// Runs a helper on `input` and gives its messages to `receive`, on a thread of its own.
    ///
    /// # Errors
    /// When the helper does not start, crashes, runs out of memory or time, or `receive` does not understand it.
    pub fn run<T: Send + 'static>(
        self,
        request: &Request,
        input: impl Into<Input>,
        receive: impl FnOnce(&mut Receiver<ChildStdout>) -> Result<T, WireError> + Send + 'static,
    ) -> Result<T, ForeignFault> {
        let start = |error: std::io::Error| ForeignFault::Start { detail: error.kind().to_string() };
        let (mut child, feeder) = self.begin(request, input.into()).map_err(start)?;
        let (Some(out), Some(err)) = (child.stdout.take(), child.stderr.take()) else {
            return Err(ForeignFault::Answer { detail: "no pipe".into() });
        };
        #[cfg(target_os = "linux")]
        let _ = rustix::pipe::fcntl_setpipe_size(&out, 1 << 20);
        let child = Arc::new(Mutex::new(child));
        let (sender, outcome) = channel();
        let limits = request.limits.clone();
        let (for_thread, wall) = (child.clone(), Duration::from_secs_f64(limits.wall_s));
        let listen = move || {
            let words = std::thread::spawn(move || last_words(err));
            let mut receiver = Receiver::new(out);
            let received = receive(&mut receiver);
            drop(receiver);
            let status = reap(&for_thread, !matches!(received, Err(WireError::Ended)));
            let words = words.join().unwrap_or_default();
            let _ = sender.send(match received {
                Ok(value) => Ok(value),
                Err(WireError::Ended) => Err(how_it_ended(status, &words, &limits)),
                Err(other) => Err(ForeignFault::Answer { detail: other.to_string() }),
            });
        };
        let listener = std::thread::Builder::new().name("foreign file".into()).spawn(listen);
        if let Err(error) = listener {
            kill(&child);
            return Err(start(error));
        }
        let outcome = outcome.recv_timeout(wall);
        // The next one starts when this one has left the processor.
        self.reserve.inspect(|reserve| reserve.refill());
        match outcome {
            // A file that could not be given explains whatever the helper makes of the others.
            Ok(result) => match feeder.map(std::thread::JoinHandle::join) {
                Some(Ok(Err(error))) => Err(ForeignFault::Fed { detail: error.to_string() }),
                _ => result,
            },
            Err(RecvTimeoutError::Timeout) => {
                kill(&child);
                Err(ForeignFault::Time { limit_s: request.limits.wall_s })
            }
            Err(RecvTimeoutError::Disconnected) => Err(ForeignFault::Answer { detail: "the listening thread ended".into() }),
        }
    }

    /// A fresh helper, or the one that stands ready, which gets its file through a pipe.
    fn begin(self, request: &Request, input: Input) -> std::io::Result<Begun> {
        let argument = serde_json::to_string(request)?;
        match input {
            Input::One(mut file) => {
                std::io::Seek::rewind(&mut file)?;
                let reserve = self.reserve.filter(|_| request.kind == Kind::Frames);
                let waiting = reserve.and_then(Reserve::take).and_then(|mut child| Some((child.stdin.take()?, child)));
                let Some((into, child)) = waiting else {
                    return Ok((spawn(self.program, Some(&argument), Stdio::from(file))?, None));
                };
                Ok((child, Some(feeding(into, move |into| feed::request_and_file(&argument, file, into)))))
            }
            Input::Many(files) => {
                let mut child = spawn(self.program, Some(&argument), Stdio::piped())?;
                let feeder = child.stdin.take().map(|into| feeding(into, move |into| feed::feed(files, into)));
                Ok((child, feeder))
            }
        }
    }
}

fn feeding(
    into: ChildStdin,
    feed: impl FnOnce(ChildStdin) -> std::io::Result<()> + Send + 'static,
) -> JoinHandle<std::io::Result<()>> {
    #[cfg(target_os = "linux")]
    let _ = rustix::pipe::fcntl_setpipe_size(&into, 1 << 20);
    std::thread::spawn(move || feed(into))
}

/// The start of what a helper wrote on standard error; the rest is read and dropped, so that it never waits for us.
fn last_words(mut err: impl Read) -> String {
    let mut words = Vec::new();
    let _ = err.by_ref().take(ERROR_BYTES).read_to_end(&mut words);
    let _ = std::io::copy(&mut err, &mut std::io::sink());
    String::from_utf8_lossy(&words).into_owned()
}

fn kill(child: &Mutex<Child>) {
    let mut child = child.lock().unwrap_or_else(PoisonError::into_inner);
    let _ = child.kill();
}

/// Waits for the end of a helper whose output has ended. One that is not listened to any more has nothing left to do.
fn reap(child: &Mutex<Child>, heard: bool) -> Option<ExitStatus> {
    let mut child = child.lock().unwrap_or_else(PoisonError::into_inner);
    if heard {
        let _ = child.kill();
    }
    child.wait().ok()
}

fn how_it_ended(status: Option<ExitStatus>, words: &str, limits: &super::Limits) -> ForeignFault {
    #[cfg(unix)]
    {
        use rustix::process::Signal;
        use std::os::unix::process::ExitStatusExt;
        let signal = status.and_then(|status| status.signal());
        if signal == Some(Signal::XCPU.as_raw()) || signal == Some(Signal::KILL.as_raw()) {
            return ForeignFault::Time { limit_s: limits.cpu_s as f64 };
        }
    }
    let _ = status;
    if words.contains("memory allocation of") || words.contains("capacity overflow") {
        ForeignFault::Memory { limit_mib: limits.memory_bytes >> 20 }
    } else if words.contains("overflowed its stack") {
        ForeignFault::TooDeep
    } else {
        ForeignFault::Crashed
    }
}
