//! The helper as a process, and its pipes.

use std::io::Read;
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, ExitStatus, Stdio};
use std::thread::JoinHandle;
use std::time::Duration;

use crate::time::Stopwatch;

/// Bytes of a helper's standard error that are looked at, for the kind of its end; nothing of it is ever shown.
const ERROR_BYTES: u64 = 4096;
/// One that was killed has ended by then, unless the system has it in a read that cannot be interrupted.
pub(super) const KILLED: Duration = Duration::from_secs(1);
/// How often whoever waits for a helper looks.
pub(super) const LOOK: Duration = Duration::from_millis(1);

/// A helper. Dropped, it ends.
#[derive(Debug)]
pub(super) struct Process {
    /// Until it is dropped.
    child: Option<Child>,
    /// What it is asked and reads; `None` where it reads a file itself, and after the last byte.
    pub(super) into: Option<ChildStdin>,
    /// Its answers.
    pub(super) out: Option<ChildStdout>,
    words: Option<JoinHandle<String>>,
}

impl Process {
    /// A process of `program` that serves the request `argument`, or those that it will be given on its standard input.
    pub(super) fn start(program: &Path, argument: Option<&str>, stdin: Stdio) -> std::io::Result<Self> {
        let mut command = Command::new(program);
        command
            .arg("read-foreign")
            .args(argument)
            .env("RUST_BACKTRACE", "0")
            .env("RAYON_NUM_THREADS", "2")
            // Address space that the allocator reserves before the limit is imposed would escape it.
            .env("MIMALLOC_ARENA_RESERVE", "32MiB")
            // What a second thread of the system's allocator reserves, 64 MiB and more, would be missing within it.
            .env("MALLOC_ARENA_MAX", "1")
            .stdin(stdin)
            .stdout(Stdio::piped())
            .stderr(Stdio::piped());
        // Ctrl-C in the terminal is meant for the session, which then finishes the file at hand.
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut child = command.spawn()?;
        let (into, out, err) = (child.stdin.take(), child.stdout.take(), child.stderr.take());
        let mut started = Self { child: Some(child), into, out, words: None };
        started.words = match err {
            Some(err) => Some(std::thread::Builder::new().name("foreign words".into()).spawn(move || last_words(err))?),
            None => None,
        };
        #[cfg(target_os = "linux")]
        {
            let more = 1 << 20;
            started.into.iter().for_each(|pipe| _ = rustix::pipe::fcntl_setpipe_size(pipe, more));
            started.out.iter().for_each(|pipe| _ = rustix::pipe::fcntl_setpipe_size(pipe, more));
        }
        Ok(started)
    }

    /// Its number.
    pub(super) fn id(&self) -> Option<u32> {
        self.child.as_ref().map(Child::id)
    }

    /// Whether it has not ended.
    pub(super) fn is_alive(&mut self) -> bool {
        self.child.as_mut().is_some_and(|child| matches!(child.try_wait(), Ok(None)))
    }

    /// Ends it.
    pub(super) fn kill(&mut self) {
        let _ = self.child.as_mut().map(Child::kill);
    }

    /// How it ended, and its last words; `None` when it goes on for longer.
    pub(super) fn ended_within(&mut self, limit: Duration) -> Option<(ExitStatus, String)> {
        let status = waited_for(self.child.as_mut()?, limit)?;
        let words = self.words.take().map(JoinHandle::join);
        Some((status, words.and_then(Result::ok).unwrap_or_default()))
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        self.kill();
        let Some(mut child) = self.child.take() else { return };
        if waited_for(&mut child, KILLED).is_none() {
            // In a read that nothing ends: nobody waits for that.
            let _ = std::thread::Builder::new().name("foreign end".into()).spawn(move || child.wait());
        }
    }
}

/// How a process ended; `None` when it goes on for longer.
fn waited_for(child: &mut Child, limit: Duration) -> Option<ExitStatus> {
    let watch = Stopwatch::start();
    loop {
        match child.try_wait() {
            Ok(Some(status)) => return Some(status),
            Ok(None) if watch.ms() < limit.as_secs_f64() * 1e3 => std::thread::sleep(LOOK),
            _ => return None,
        }
    }
}

/// The start of what a helper wrote on standard error; the rest is read and dropped, so that it never waits for us.
fn last_words(mut err: impl Read) -> String {
    let mut words = Vec::new();
    let _ = err.by_ref().take(ERROR_BYTES).read_to_end(&mut words);
    let _ = std::io::copy(&mut err, &mut std::io::sink());
    String::from_utf8_lossy(&words).into_owned()
}
