//! How a session is told to end: in order, or at once.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};

/// A shared flag; cheap to clone.
#[derive(Clone, Debug, Default)]
pub struct Stop {
    asked: Arc<AtomicU8>,
    interrupted: Arc<AtomicBool>,
}

impl Stop {
    /// Ends the session in order: what was acquired is finished.
    pub fn finish(&self) {
        self.asked.fetch_max(1, Ordering::Relaxed);
    }

    /// Asked once it ends in order, asked again at once, with nothing lost that was recorded. Returns how often it was asked.
    pub fn ask(&self) -> u8 {
        self.interrupted.store(true, Ordering::Relaxed);
        self.asked
            .fetch_update(Ordering::Relaxed, Ordering::Relaxed, |asked| Some(asked.saturating_add(1)))
            .map_or(1, |asked| asked.saturating_add(1))
    }

    /// Whether the session is to end.
    #[must_use]
    pub fn is_asked(&self) -> bool {
        self.asked.load(Ordering::Relaxed) >= 1
    }

    /// Whether nothing more is to be finished.
    #[must_use]
    pub fn leaves_at_once(&self) -> bool {
        self.asked.load(Ordering::Relaxed) >= 2
    }

    /// Whether somebody asked, by a signal, and it did not end by itself: then a window goes with it.
    #[must_use]
    pub fn is_interrupted(&self) -> bool {
        self.interrupted.load(Ordering::Relaxed)
    }
}
