//! What a person should see right now: the latest state, published by the session, drawn by the window.

use std::sync::{Arc, Mutex, PoisonError};

use crate::image::Image;
use crate::report::Standing;
use crate::telemetry::{DeviceKind, Health};

/// The state of one serial line.
#[derive(Clone, Debug, PartialEq)]
pub struct Link {
    /// Which device.
    pub device: DeviceKind,
    /// Whether the port is open.
    pub open: bool,
    /// Times the port was opened.
    pub epoch: u32,
    /// Counters.
    pub health: Health,
    /// Host time of the latest byte.
    pub last_byte_us: Option<i64>,
    /// Latest trouble in words.
    pub trouble: Option<String>,
}

/// One frame with its matched DRR, as the window shows it.
#[derive(Clone, Debug)]
pub struct PairView {
    /// The frame's name.
    pub name: String,
    /// When it was exposed, host time.
    pub time_us: i64,
    /// One line: accepted, refused and why, pose from telemetry.
    pub status: String,
    /// Colour and word of the status line.
    pub standing: Standing,
    /// Acquired frame, gray 0..255.
    pub acquired: Image<u8>,
    /// Matched DRR; absent without a pose.
    pub drr: Option<Image<u8>>,
    /// Signed difference in colour; absent without a pose.
    pub difference: Option<Image<[u8; 3]>>,
    /// Name and value of each score.
    pub scores: Vec<(String, Option<f64>)>,
}

/// Everything at once.
#[derive(Clone, Debug, Default)]
pub struct BoardState {
    /// Serial lines.
    pub links: Vec<Link>,
    /// Pairs in order of exposure.
    pub pairs: Vec<Arc<PairView>>,
    /// Frames seen so far.
    pub frames_seen: usize,
    /// Host time of this state.
    pub now_us: i64,
    /// The session has ended.
    pub finished: bool,
    /// Warnings by kind.
    pub warnings: Vec<(String, u64)>,
}

/// Telemetry older than this is shown as stale.
pub const STALE_AFTER_US: i64 = 500_000;

impl Link {
    /// Whether nothing came for [`STALE_AFTER_US`], or ever.
    #[must_use]
    pub fn is_stale(&self, now_us: i64) -> bool {
        self.last_byte_us.is_none_or(|last_us| now_us - last_us > STALE_AFTER_US)
    }
}

/// A shared slot with the latest state; cheap to clone.
#[derive(Clone, Debug, Default)]
pub struct Board(Arc<Mutex<BoardState>>);

impl Board {
    /// Changes the state.
    pub fn update(&self, change: impl FnOnce(&mut BoardState)) {
        change(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner));
    }

    /// A copy of the state; images are shared, not copied.
    #[must_use]
    pub fn snapshot(&self) -> BoardState {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}
