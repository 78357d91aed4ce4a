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
    /// The frame's number of arrival.
    pub number: u32,
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
    /// Frames that wait to be registered, rendered or compared.
    pub frames_waiting: usize,
    /// Age of the oldest message that is not in the log's file yet, ms.
    pub recorder_behind_ms: f64,
    /// Why nothing is recorded any more.
    pub recorder_failure: Option<String>,
    /// Host time of this state.
    pub now_us: i64,
    /// The session has ended.
    pub finished: bool,
    /// Somebody looks: pictures of pairs are made for the eye.
    pub watched: bool,
    /// Warnings by kind.
    pub warnings: Vec<(String, u64)>,
}

/// Telemetry older than this is shown as stale.
pub const STALE_AFTER_US: i64 = 500_000;

/// Pairs whose pictures are kept whole; of older ones a small picture is kept.
const WHOLE_PICTURES: usize = 16;
/// Widest small picture.
const THUMBNAIL_PX: usize = 155;

impl PairView {
    fn shrink(&mut self) {
        fn small<T: Clone>(image: &Image<T>) -> Image<T> {
            let step = image.width.div_ceil(THUMBNAIL_PX).max(1);
            let (width, height) = (image.width / step, image.height / step);
            let at = |index: usize| image.at(index % width * step, index / width * step).clone();
            Image { width, height, pixels: (0..width * height).map(at).collect() }
        }
        self.acquired = small(&self.acquired);
        self.drr = self.drr.as_ref().map(small);
        self.difference = self.difference.as_ref().map(small);
    }
}

impl BoardState {
    /// Shows a pair, or what is new about it; memory stays bounded.
    pub fn show(&mut self, pair: PairView) {
        let pair = Arc::new(pair);
        match self.pairs.iter_mut().find(|known| known.number == pair.number) {
            Some(slot) => *slot = pair,
            None => {
                let at = self.pairs.partition_point(|known| known.number < pair.number);
                self.pairs.insert(at, pair);
            }
        }
        let old = self.pairs.len().saturating_sub(WHOLE_PICTURES);
        // Any of the older ones may have come just now: the newest frame is developed first, and nulls come late.
        for pair in self.pairs[..old].iter_mut().filter(|pair| pair.acquired.width > THUMBNAIL_PX) {
            Arc::make_mut(pair).shrink();
        }
    }
}

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

    /// Asks the state.
    pub fn read<T>(&self, ask: impl FnOnce(&BoardState) -> T) -> T {
        ask(&self.0.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Shows a pair where somebody looks.
    pub fn show(&self, picture: impl FnOnce() -> PairView) {
        if self.read(|state| state.watched) {
            let picture = picture();
            self.update(|state| state.show(picture));
        }
    }

    /// A copy of the state; images are shared, not copied.
    #[must_use]
    pub fn snapshot(&self) -> BoardState {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_pictures_stay_whole_in_whatever_order_pairs_and_nulls_come() {
        let pair = |number: u32| PairView {
            number,
            name: String::new(),
            time_us: 0,
            status: String::new(),
            standing: Standing::Accepted,
            acquired: Image::filled(620, 4, 0),
            drr: None,
            difference: None,
            scores: Vec::new(),
        };
        let mut state = BoardState::default();
        // The newest first, then each once more with its null.
        (1..=60).rev().chain(1..=60).for_each(|number| state.show(pair(number)));
        let whole = state.pairs.iter().filter(|pair| pair.acquired.width > THUMBNAIL_PX).count();
        assert_eq!((state.pairs.len(), whole), (60, WHOLE_PICTURES));

        // Nobody looks: no picture is made.
        let board = Board::default();
        board.show(|| unreachable!("nobody looks"));
        board.update(|state| state.watched = true);
        board.show(|| pair(3));
        assert_eq!(board.read(|state| state.pairs.len()), 1);
    }
}
