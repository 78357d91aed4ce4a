//! What a person should see right now: the latest state, published by the session, drawn by the window.

use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::album::{Album, Key, Leaving};
pub use super::at_exposure::AtExposure;
use super::bell::Bell;
pub use super::bell::LEAST_BETWEEN;
pub use super::board_state::{BoardState, PictureMemory};
pub use super::link_view::{Link, STALE_AFTER_US};
pub use super::pair_marks::{BeadMark, LandmarkMark, PairMarks, RobotMark};
pub use super::pair_pictures::PairPictures;
pub use super::pair_view::PairView;
pub use super::phase::Phase;
use crate::reporter::Reporter;

/// A shared slot with the latest state; cheap to clone.
#[derive(Clone, Default)]
pub struct Board {
    state: Arc<Mutex<BoardState>>,
    bell: Arc<Bell>,
    /// Where whole pictures go; absent where nobody said in which folder.
    album: Arc<Mutex<Option<Album>>>,
}

impl std::fmt::Debug for Board {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Board").field(&*self.lock()).finish()
    }
}

impl Board {
    /// Changes the state; whoever shows it hears of it.
    pub fn update(&self, change: impl FnOnce(&mut BoardState)) {
        change(&mut self.lock());
        self.bell.ring();
    }

    /// Changes what changes all the time, as readings do: whoever shows the state hears of it only where that is worth a look.
    pub fn tick(&self, change: impl FnOnce(&mut BoardState)) {
        let changed = {
            let mut state = self.lock();
            let before = state.telling();
            change(&mut state);
            state.telling() != before
        };
        if changed {
            self.bell.ring();
        }
    }

    /// Asks the state.
    pub fn read<T>(&self, ask: impl FnOnce(&BoardState) -> T) -> T {
        ask(&self.lock())
    }

    /// Shows a pair where somebody looks.
    pub fn show(&self, picture: impl FnOnce() -> PairView) {
        if self.read(|state| state.watched) {
            let picture = picture();
            let mut leaving = Vec::new();
            self.update(|state| leaving = state.show(picture));
            self.put_away(leaving);
        }
    }

    /// From now on whole pictures for which there is no room in memory go to the disk of `folder`, and come back when somebody looks at them.
    /// Where nobody looks at the board at all, nothing is done.
    pub fn keep_pictures_in(&self, folder: &Path, reporter: &Reporter) {
        if !self.read(|state| state.watched) {
            return;
        }
        // The album lives as long as somebody has the board, and its thread is nobody.
        let (state, bell, album) = (Arc::clone(&self.state), Arc::clone(&self.bell), Arc::downgrade(&self.album));
        let deliver = move |key: Key, pictures: Option<PairPictures>| {
            if let Some(album) = album.upgrade() {
                let board = Self { state: Arc::clone(&state), bell: Arc::clone(&bell), album };
                let mut leaving = Vec::new();
                board.update(|state| leaving = state.take_back(key, pictures));
                board.put_away(leaving);
            }
        };
        match Album::start(folder, reporter, deliver) {
            Ok(album) => *self.album() = Some(album),
            Err(error) => reporter.note(format!("the window shows older exposures small: the system gives no thread ({error})")),
        }
    }

    /// Somebody looks at this exposure: its whole pictures stay, or are fetched. To be said with each look.
    pub fn look_at(&self, number: u32) {
        let wanted = self.lock().look_at(number);
        let album = self.album();
        if let (Some(key), Some(album)) = (wanted, album.as_ref()) {
            album.fetch(key);
        }
    }

    /// What the album does not take is in the log alone.
    fn put_away(&self, leaving: Vec<Leaving>) {
        for leaving in leaving {
            let number = leaving.key.0;
            // It may be written before this is done.
            self.lock().away.insert(number);
            let is_taken = self.album().as_ref().is_some_and(|album| album.put(leaving));
            if !is_taken {
                self.update(|state| _ = state.away.remove(&number));
            }
        }
    }

    /// A copy of the state, for whoever shows it; images are shared, not copied.
    #[must_use]
    pub fn snapshot(&self) -> BoardState {
        self.bell.looked();
        self.lock().clone()
    }

    /// Whoever shows the state has heard that it changed, and looks where anything is to be seen: a hidden window is not drawn.
    pub fn heard(&self) {
        self.bell.looked();
    }

    /// `waker` is called when there is something new to show, with how long to wait before that: looks are [`LEAST_BETWEEN`] apart or more.
    pub fn on_change(&self, waker: impl Fn(Duration) + Send + 'static) {
        self.bell.tell(Box::new(waker));
    }

    /// Counts the changes that whoever shows the state hears of.
    #[must_use]
    pub fn generation(&self) -> u64 {
        self.bell.generation()
    }

    fn lock(&self) -> MutexGuard<'_, BoardState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn album(&self) -> MutexGuard<'_, Option<Album>> {
        self.album.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::super::board_state::example::{pair, room_for, whole};
    use super::*;

    #[test]
    fn no_picture_is_made_where_nobody_looks() {
        let board = Board::default();
        board.show(|| unreachable!("nobody looks"));
        board.update(|state| state.watched = true);
        board.show(|| pair(3));
        assert_eq!(board.read(|state| state.pairs.len()), 1);
    }

    /// Whoever scrubbed back saw 155 pixels across, for good.
    #[test]
    fn whole_pictures_that_left_the_memory_are_there_again_when_somebody_looks() {
        let folder = tempfile::tempdir().expect("a folder");
        let board = Board::default();
        board.keep_pictures_in(folder.path(), &Reporter::silent());
        assert!(board.album().is_none(), "nobody looks at all");
        board.update(|state| *state = BoardState { watched: true, ..room_for(3) });
        board.keep_pictures_in(folder.path(), &Reporter::silent());
        // A disk that is slower than this would leave the rest to the log.
        let kept = |number: u32| {
            board.show(|| pair(number));
            eventually(|| board.album().as_ref().is_some_and(|album| album.is_idle()))
        };
        assert!((1..=20).all(kept), "the disk does not come after");
        assert_eq!(board.read(whole), [18, 19, 20]);
        assert_eq!(board.read(|state| state.away.len()), 17);
        for number in [4, 9, 4] {
            board.look_at(number);
            let is_back = || board.read(|state| whole(state).contains(&number));
            assert!(eventually(is_back), "{number} does not come back: {:?}", board.read(whole));
            let (shown, expected) = (board.read(|state| Arc::clone(&state.pairs[number as usize - 1])), pair(number));
            assert_eq!(shown.pictures.acquired(), expected.pictures.acquired());
            assert_ne!(shown.pictures.acquired(), pair(number + 1).pictures.acquired(), "the control");
            assert_eq!(board.read(|state| whole(state).len()), 3, "memory does not grow");
        }
        assert!(board.read(|state| whole(state).contains(&9)), "it was looked at just now");
    }

    fn eventually(is_so: impl Fn() -> bool) -> bool {
        (0..1000).any(|_| {
            std::thread::sleep(Duration::from_millis(10));
            is_so()
        })
    }

    #[test]
    fn readings_do_not_ring_and_what_must_be_seen_does() {
        let board = Board::default();
        board.tick(|state| (state.now_us, state.recorder_behind_ms) = (5, 3.0));
        assert_eq!(board.generation(), 0);
        board.tick(|state| state.recorder_failure = Some("the disk is full".to_owned()));
        board.tick(|state| state.frames_waiting = 1);
        assert_eq!(board.generation(), 2);
        // A line is heard, goes on, and falls silent.
        board.update(|state| state.links.push(Link::new(crate::telemetry::DeviceKind::Carm)));
        for (now_us, last_us, generation) in [(1_000_000, 1_000_000, 4), (1_100_000, 1_050_000, 4), (2_000_000, 1_050_000, 5)] {
            board.tick(|state| {
                state.now_us = now_us;
                state.links[0].last_sample_us = Some(last_us);
            });
            assert_eq!(board.generation(), generation, "{now_us}");
        }
    }
}
