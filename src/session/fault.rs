//! Threads that die, hang or are slow when they are asked to, for the tests of sessions that go on without them. A release build has nothing of it.
//! The environment's `SIDECARM_BREAKS` is a list of `PART:NUMBER`, with commas between them.

#[cfg(debug_assertions)]
fn asked(part: &str) -> Option<u32> {
    let asked = std::env::var("SIDECARM_BREAKS").ok()?;
    asked.split(',').find_map(|one| one.strip_prefix(part)?.strip_prefix(':')?.parse().ok())
}

/// Panics where the number that is asked for is `count`. Called where nothing catches it, so that the thread itself dies.
#[cfg(debug_assertions)]
pub(super) fn breaks(part: &str, count: u32) {
    assert!(asked(part) != Some(count), "the {part} dies at {count}, as SIDECARM_BREAKS asks");
}

/// Hangs for as many milliseconds as are asked for, the first time that this part comes here.
#[cfg(debug_assertions)]
pub(super) fn hangs(part: &'static str) {
    use std::collections::BTreeSet;
    use std::sync::{Mutex, PoisonError};
    static HUNG: Mutex<BTreeSet<&str>> = Mutex::new(BTreeSet::new());
    let Some(ms) = asked(part) else { return };
    let is_first = HUNG.lock().unwrap_or_else(PoisonError::into_inner).insert(part);
    if is_first {
        std::thread::sleep(std::time::Duration::from_millis(ms.into()));
    }
}

/// Takes as many milliseconds longer as are asked for, every time.
#[cfg(debug_assertions)]
pub(super) fn lags(part: &str) {
    if let Some(ms) = asked(part) {
        std::thread::sleep(std::time::Duration::from_millis(ms.into()));
    }
}

/// Does nothing.
#[cfg(not(debug_assertions))]
pub(super) fn breaks(_part: &str, _count: u32) {}

/// Does nothing.
#[cfg(not(debug_assertions))]
pub(super) fn hangs(_part: &'static str) {}

/// Does nothing.
#[cfg(not(debug_assertions))]
pub(super) fn lags(_part: &str) {}
