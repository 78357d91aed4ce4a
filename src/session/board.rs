//! What a person should see right now: the latest state, published by the session, drawn by the window.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use super::bell::Bell;
pub use super::bell::LEAST_BETWEEN;
pub use super::link_view::{Link, STALE_AFTER_US};
pub use super::pair_marks::{BeadMark, LandmarkMark, PairMarks, RobotMark};
pub use super::pair_pictures::PairPictures;
pub use super::pair_view::PairView;
pub use super::phase::Phase;

/// Everything at once.
#[derive(Clone, Debug, Default)]
pub struct BoardState {
    /// Serial lines.
    pub links: Vec<Link>,
    /// Pairs in order of their frames' arrival.
    pub pairs: Vec<Arc<PairView>>,
    /// Frames seen so far.
    pub frames_seen: usize,
    /// Files that were seen and not read yet.
    pub frames_unread: usize,
    /// Frames that wait to be registered, rendered or compared.
    pub frames_waiting: usize,
    /// How far those have come of which it is known, and pairs whose null is made, by the frame's number.
    pub phases: BTreeMap<u32, Phase>,
    /// What persons noted, by the frame's number.
    pub notes: BTreeMap<u32, String>,
    /// What takes unusually long right now, in sentences.
    pub slow: Vec<String>,
    /// Age of the oldest message that is not in the log's file yet, ms.
    pub recorder_behind_ms: f64,
    /// Why nothing is recorded any more.
    pub recorder_failure: Option<String>,
    /// Host time of this state; in a replay the time of the log.
    pub now_us: i64,
    /// What is shown was recorded: ages are those of the log.
    pub replayed: bool,
    /// The session has ended.
    pub finished: bool,
    /// Somebody looks: pictures of pairs are made for the eye.
    pub watched: bool,
    /// The beads of the exposures shown may be edited: the session takes [`super::edit::EditRequest`]s.
    pub editable: bool,
    /// Warnings by kind.
    pub warnings: Vec<(String, u64)>,
}

/// Pairs whose pictures are kept whole; of older ones a small picture is kept.
const WHOLE_PICTURES: usize = 16;

impl BoardState {
    /// Shows a pair, or what is new about it; memory stays bounded.
    pub fn show(&mut self, mut pair: PairView) {
        // Whichever of the two comes first: the newest frame is developed first.
        if let Some(by) = self.pairs.iter().find(|other| other.replaces == Some(pair.number())) {
            Arc::make_mut(&mut pair.pair).replace_by(by.number());
        }
        if let Some(before) = self.pairs.iter_mut().find(|other| pair.replaces == Some(other.number())) {
            Arc::make_mut(&mut Arc::make_mut(before).pair).replace_by(pair.number());
        }
        match self.pairs.iter_mut().find(|known| known.number() == pair.number()) {
            // The null of the pose before came late: an edit was quicker.
            Some(slot) if slot.development > pair.development => {}
            Some(slot) => {
                // It was shown when it was shown first; another pose is another showing.
                if slot.development == pair.development {
                    pair.latency_ms = slot.latency_ms;
                }
                *slot = Arc::new(pair);
            }
            None => {
                let at = self.pairs.partition_point(|known| known.number() < pair.number());
                self.pairs.insert(at, Arc::new(pair));
            }
        }
        let old = self.pairs.len().saturating_sub(WHOLE_PICTURES);
        // Any of the older ones may have come just now: the newest frame is developed first, and nulls come late.
        for pair in self.pairs[..old].iter_mut().filter(|pair| !pair.pictures.is_small()) {
            Arc::make_mut(pair).shrink();
        }
    }

    /// What is drawn anew when it changes.
    fn telling(&self) -> Telling {
        Telling {
            frames: [self.frames_seen, self.frames_unread, self.frames_waiting, self.warnings.len()],
            said: [self.recorder_failure.is_some(), self.finished],
            slow: self.slow.clone(),
            phases: self.phases.clone(),
            lines: self.links.iter().map(|link| (link.silent_steps(self.now_us), link.moves)).collect(),
        }
    }
}

/// See [`BoardState::telling`].
#[derive(PartialEq)]
struct Telling {
    frames: [usize; 4],
    said: [bool; 2],
    slow: Vec<String>,
    phases: BTreeMap<u32, Phase>,
    lines: Vec<(Option<i64>, u64)>,
}

/// A shared slot with the latest state; cheap to clone.
#[derive(Clone, Default)]
pub struct Board {
    state: Arc<Mutex<BoardState>>,
    bell: Arc<Bell>,
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
            self.update(|state| state.show(picture));
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
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::acquire::{Domain, Frame};
    use crate::image::Image;
    use crate::mask::Masks;
    use crate::report::{Pair, PairStatus};

    fn pair(number: u32) -> PairView {
        let frame = Frame::from_pixels("a", Image::filled(620, 4, 1.0f32), Domain::Linear).expect("a frame");
        PairView {
            pair: Arc::new(Pair { number, ..Pair::unmatched("a", "") }),
            pose: Arc::default(),
            time_us: 0,
            development: 0,
            replaces: None,
            complete: true,
            mm_per_px: None,
            remedy: None,
            marks: Arc::default(),
            pictures: Arc::new(PairPictures::alone(&frame, &Masks::default())),
            latency_ms: Some(f64::from(number)),
        }
    }

    /// A torn picture stayed accepted in the window when the whole one had taken its exposure.
    #[test]
    fn a_picture_that_was_not_finished_is_taken_back_whichever_comes_first() {
        let torn = || PairView { pair: Arc::new(Pair { status: PairStatus::Accepted, ..(*pair(1).pair).clone() }), ..pair(1) };
        let whole = || PairView { replaces: Some(1), ..pair(2) };
        for order in [[torn(), whole()], [whole(), torn()]] {
            let mut state = BoardState::default();
            order.into_iter().for_each(|view| state.show(view));
            assert_eq!(
                state.pairs.iter().map(|view| view.pair.status).collect::<Vec<_>>(),
                [PairStatus::Refused, PairStatus::NoPose]
            );
        }
    }

    #[test]
    fn few_pictures_stay_whole_in_whatever_order_pairs_and_nulls_come() {
        let mut state = BoardState::default();
        // The newest first, then each once more with its null.
        (1..=60).rev().chain(1..=60).for_each(|number| state.show(pair(number)));
        let whole = state.pairs.iter().filter(|pair| !pair.pictures.is_small()).count();
        assert_eq!((state.pairs.len(), whole), (60, WHOLE_PICTURES));
        assert!(state.pairs.iter().all(|pair| pair.pictures.size_px == [620, 4]), "marks keep their places");

        // Nobody looks: no picture is made.
        let board = Board::default();
        board.show(|| unreachable!("nobody looks"));
        board.update(|state| state.watched = true);
        board.show(|| pair(3));
        assert_eq!(board.read(|state| state.pairs.len()), 1);
    }

    #[test]
    fn a_pair_was_shown_when_it_was_shown_first_unless_it_was_posed_again() {
        let mut state = BoardState::default();
        state.show(pair(3));
        state.show(PairView { latency_ms: Some(9e3), ..pair(3) });
        assert_eq!(state.pairs[0].latency_ms, Some(3.0));
        state.show(PairView { latency_ms: Some(9e3), development: 1, ..pair(3) });
        assert_eq!(state.pairs[0].latency_ms, Some(9e3));
        state.show(pair(3));
        assert_eq!(state.pairs[0].development, 1, "what was said before does not come back");
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
