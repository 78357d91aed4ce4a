//! Threads that compute yield to those that record.

/// How far computing threads stand back: the recording ones sleep nearly always, so nothing is lost by it.
#[cfg(target_os = "linux")]
const NICE: i32 = 10;

/// The calling thread, and those that it starts, stand back from now on.
#[cfg(target_os = "linux")]
pub(super) fn stand_back() {
    // On Linux a priority belongs to a thread. Where it is refused, all threads are equal.
    let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), NICE);
}

/// Elsewhere all threads are equal.
#[cfg(not(target_os = "linux"))]
pub(super) fn stand_back() {}

/// The threads that share loops stand back too. To be called before any loop is shared; later it changes nothing.
pub(super) fn loops_stand_back() {
    // An error says that the threads are there already.
    let _ = rayon::ThreadPoolBuilder::new().start_handler(|_| stand_back()).build_global();
}
