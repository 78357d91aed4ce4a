//! Threads that die when they are asked to, for the tests of sessions that go on without them. A release build has nothing of it.

/// Panics where the environment's `SIDECARM_BREAKS` is `PART:COUNT`. Called where nothing catches it, so that the thread itself dies.
#[cfg(debug_assertions)]
pub(super) fn breaks(part: &str, count: u32) {
    let is_asked = std::env::var("SIDECARM_BREAKS").is_ok_and(|asked| asked == format!("{part}:{count}"));
    assert!(!is_asked, "the {part} dies at {count}, as SIDECARM_BREAKS asks");
}

/// Does nothing.
#[cfg(not(debug_assertions))]
pub(super) fn breaks(_part: &str, _count: u32) {}
