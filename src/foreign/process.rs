//! The helper as a process.

use std::path::Path;
use std::process::{Child, Command, Stdio};

/// A process of `program` that serves the request `argument`, or the one that it will be given on its standard input.
pub(super) fn spawn(program: &Path, argument: Option<&str>, stdin: Stdio) -> std::io::Result<Child> {
    let mut command = Command::new(program);
    command
        .arg("read-foreign")
        .args(argument)
        .env("RUST_BACKTRACE", "0")
        .env("RAYON_NUM_THREADS", "2")
        // Address space that the allocator reserves before the limit is imposed would escape it.
        .env("MIMALLOC_ARENA_RESERVE", "32MiB")
        .stdin(stdin)
        .stdout(Stdio::piped())
        .stderr(Stdio::piped());
    // Ctrl-C in the terminal is meant for the session, which then finishes the file at hand.
    #[cfg(unix)]
    std::os::unix::process::CommandExt::process_group(&mut command, 0);
    command.spawn()
}

/// Ends a helper that was given nothing.
pub(super) fn kill_and_reap(child: &mut Child) {
    let _ = child.kill();
    let _ = child.wait();
}
