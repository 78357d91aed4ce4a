//! Starting a helper, listening to it, and telling how it ended.

use std::fs::File;
use std::io::ErrorKind;
use std::path::Path;
use std::process::{ChildStdin, ChildStdout, ExitStatus, Stdio};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::thread::JoinHandle;
use std::time::Duration;

use super::feed::{self, Input};
use super::process::{KILLED, LOOK, Process};
use super::request::Request;
use super::reserve::Reserve;
use super::{Kind, Limits, Receiver, WireError};
use crate::time::Stopwatch;

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

/// What decodes foreign files.
#[derive(Clone, Copy, Debug)]
pub struct Helpers<'a> {
    pub(super) program: &'a Path,
    pub(super) reserve: Option<&'a Reserve>,
}

/// The thread that gives a helper what it reads; the helper's standard input comes back where more may follow.
type Feeder = JoinHandle<std::io::Result<Option<ChildStdin>>>;

impl Helpers<'_> {
    /// Runs a helper on `input` and gives its messages to `receive`, on a thread of its own.
    ///
    /// # Errors
    /// When the helper does not start, crashes, runs out of memory or time, or `receive` does not understand it.
    pub fn run<T: Send + 'static>(
        self,
        request: &Request,
        input: impl Into<Input>,
        receive: impl FnOnce(&mut Receiver<ChildStdout>) -> Result<T, WireError> + Clone + Send + 'static,
    ) -> Result<T, ForeignFault> {
        let start = |error: std::io::Error| ForeignFault::Start { detail: error.kind().to_string() };
        let argument = serde_json::to_string(request).map_err(|error| start(error.into()))?;
        match (input.into(), self.reserve) {
            (Input::One(file), Some(reserve)) if request.kind == Kind::Frames => {
                let same = file.try_clone().map_err(start)?;
                let watch = Stopwatch::start();
                let (outcome, was_used) = ask(reserve, &argument, file, &request.limits, receive.clone()).map_err(start)?;
                // Sooner than its time could be over, even on several processors.
                let is_early = watch.ms() < 250.0 * request.limits.cpu_s as f64;
                match outcome {
                    // What it read before may have broken it, or the system has ended it: this file is judged by one that begins with it.
                    Err(fault) if was_used && (is_early || !matches!(fault, ForeignFault::Time { .. })) => {
                        ask(reserve, &argument, same, &request.limits, receive).map_err(start)?.0
                    }
                    outcome => outcome,
                }
            }
            (Input::One(file), _) => {
                let stdin = Stdio::from(rewound(file).map_err(start)?);
                let mut process = Process::start(self.program, Some(&argument), stdin).map_err(start)?;
                serve(&mut process, None, &request.limits, receive).0
            }
            (Input::Many(files), _) => {
                let mut process = Process::start(self.program, Some(&argument), Stdio::piped()).map_err(start)?;
                let feed = move |mut into: ChildStdin| feed::feed(files, &mut into).map(|()| None);
                let feeder = process.into.take().map(|into| std::thread::spawn(move || feed(into)));
                serve(&mut process, feeder, &request.limits, receive).0
            }
        }
    }
}

/// What the helper of `reserve` makes of one file, and whether it had read others before.
fn ask<T: Send + 'static>(
    reserve: &Reserve,
    argument: &str,
    file: File,
    limits: &Limits,
    receive: impl FnOnce(&mut Receiver<ChildStdout>) -> Result<T, WireError> + Send + 'static,
) -> std::io::Result<(Result<T, ForeignFault>, bool)> {
    let (file, argument) = (rewound(file)?, argument.to_owned());
    let mut standing = reserve.take()?;
    let was_used = standing.served > 0;
    let feed = move |mut into: ChildStdin| match feed::request_and_file(&argument, file, &mut into) {
        Ok(()) => Ok(Some(into)),
        // Why it does not listen, it says itself.
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(None),
        Err(error) => Err(error),
    };
    let feeder = standing.process.into.take().map(|into| std::thread::spawn(move || feed(into)));
    let (outcome, into) = serve(&mut standing.process, feeder, limits, receive);
    match into {
        Some(into) if outcome.is_ok() => {
            standing.process.into = Some(into);
            reserve.give_back(standing);
        }
        _ => drop(standing),
    }
    // The next one starts when this one has left the processor.
    reserve.refill();
    Ok((outcome, was_used))
}

fn rewound(mut file: File) -> std::io::Result<File> {
    std::io::Seek::rewind(&mut file)?;
    Ok(file)
}

/// Hears one answer of `process`; with it the way to ask it more, where it was given all and stands.
fn serve<T: Send + 'static>(
    process: &mut Process,
    feeder: Option<Feeder>,
    limits: &Limits,
    receive: impl FnOnce(&mut Receiver<ChildStdout>) -> Result<T, WireError> + Send + 'static,
) -> (Result<T, ForeignFault>, Option<ChildStdin>) {
    let Some(out) = process.out.take() else { return (Err(ForeignFault::Answer { detail: "no pipe".into() }), None) };
    let (sender, answers) = channel();
    let listen = move || {
        let mut receiver = Receiver::new(out);
        let received = receive(&mut receiver);
        let _ = sender.send((received, receiver.into_inner()));
    };
    if let Err(error) = std::thread::Builder::new().name("foreign file".into()).spawn(listen) {
        return (Err(ForeignFault::Start { detail: error.kind().to_string() }), None);
    }
    let (watch, wall) = (Stopwatch::start(), Duration::from_secs_f64(limits.wall_s));
    let left = || wall.saturating_sub(Duration::from_secs_f64(watch.ms() * 1e-3));
    let late = ForeignFault::Time { limit_s: limits.wall_s };
    let outcome = match answers.recv_timeout(wall) {
        Ok((Ok(value), out)) => {
            process.out = Some(out);
            Ok(value)
        }
        Ok((Err(WireError::Ended), _)) => Err(match process.ended_within(left()) {
            Some((status, words)) => how_it_ended(status, &words, limits),
            None => late,
        }),
        Ok((Err(other), _)) => Err(ForeignFault::Answer { detail: other.to_string() }),
        Err(RecvTimeoutError::Timeout) => Err(late),
        Err(RecvTimeoutError::Disconnected) => Err(ForeignFault::Answer { detail: "the listening thread ended".into() }),
    };
    let Some(feeder) = feeder else { return (outcome, None) };
    let fed_within = |limit: Duration| {
        let waited = Stopwatch::start();
        while !feeder.is_finished() && waited.ms() < limit.as_secs_f64() * 1e3 {
            std::thread::sleep(LOOK);
        }
        feeder.is_finished()
    };
    // One that has answered still takes what it was given.
    if !fed_within(if outcome.is_ok() { left() } else { Duration::ZERO }) {
        process.kill();
    }
    // A feeder may hang on its file for ever.
    if !fed_within(KILLED) {
        return (outcome, None);
    }
    match feeder.join() {
        Ok(Ok(into)) => (outcome, into),
        // A file that could not be given explains whatever the helper makes of it.
        Ok(Err(error)) => (Err(ForeignFault::Fed { detail: error.to_string() }), None),
        Err(_) => (outcome, None),
    }
}

fn how_it_ended(status: ExitStatus, words: &str, limits: &Limits) -> ForeignFault {
    #[cfg(unix)]
    {
        use rustix::process::Signal;
        use std::os::unix::process::ExitStatusExt;
        let signal = status.signal();
        if signal == Some(Signal::XCPU.as_raw()) || signal == Some(Signal::KILL.as_raw()) {
            return ForeignFault::Time { limit_s: limits.cpu_s as f64 };
        }
    }
    #[cfg(not(unix))]
    let _ = status;
    if words.contains("memory allocation of") || words.contains("capacity overflow") {
        ForeignFault::Memory { limit_mib: limits.memory_bytes >> 20 }
    } else if words.contains("overflowed its stack") {
        ForeignFault::TooDeep
    } else {
        ForeignFault::Crashed
    }
}
