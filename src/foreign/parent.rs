//! A helper ends when nobody hears it any more.

/// Ends this process once whoever started it has closed the pipe that is its standard output, as the system does when that one ends, however it
/// ends: a decoder that is long at work finds out only when it writes. To be called before limits are imposed, since it starts a thread.
///
/// # Errors
/// When the system gives no thread.
#[cfg(unix)]
pub fn end_unheard() -> std::io::Result<()> {
    // Address space is what a helper has little of.
    const STACK_BYTES: usize = 128 << 10;
    let (sender, is_watching) = std::sync::mpsc::channel();
    let watch = move || {
        use rustix::event::{PollFd, PollFlags, poll};
        let out = std::io::stdout();
        let _ = sender.send(());
        drop(sender);
        loop {
            // What is asked for is nothing: that a pipe has lost its reader is always told.
            match poll(&mut [PollFd::new(&out, PollFlags::empty())], None) {
                Ok(0) | Err(rustix::io::Errno::INTR) => {}
                Ok(_) => std::process::exit(1),
                Err(_) => return,
            }
        }
    };
    std::thread::Builder::new().name("unheard".into()).stack_size(STACK_BYTES).spawn(watch)?;
    // What a thread takes at its start must not be refused by the limits.
    let _ = is_watching.recv();
    Ok(())
}

/// Elsewhere it ends when it writes.
///
/// # Errors
/// Never.
#[cfg(not(unix))]
pub fn end_unheard() -> std::io::Result<()> {
    Ok(())
}
