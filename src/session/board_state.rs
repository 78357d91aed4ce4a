//! What a window shows: everything that a session publishes, with as many whole pictures as there is room for.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use super::album::{Key, Leaving};
use super::link_view::Link;
use super::pair_pictures::PairPictures;
use super::pair_view::PairView;
use super::phase::Phase;

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
    /// Memory for whole pictures; of other pairs small ones are shown.
    pub picture_memory: PictureMemory,
    /// Frames whose whole pictures can be had again.
    pub away: BTreeSet<u32>,
    /// Numbers of the pairs, the one that was shown or looked at longest ago first.
    pub seen: Vec<u32>,
    /// The exposure that somebody looks at.
    pub looked_at: Option<u32>,
}

/// Bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PictureMemory(pub usize);

impl Default for PictureMemory {
    /// Eighty pairs of 620 × 480 pixels, ten of 1536 × 1536.
    fn default() -> Self {
        Self(256 << 20)
    }
}

impl BoardState {
    /// Shows a pair, or what is new about it; memory stays bounded. Gives the whole pictures for which there is no room any more.
    pub fn show(&mut self, mut pair: PairView) -> Vec<Leaving> {
        let number = pair.number();
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
        self.touch(number);
        self.make_room()
    }

    /// Somebody looks at an exposure; the key of its pictures where they have to be fetched.
    pub(super) fn look_at(&mut self, number: u32) -> Option<Key> {
        self.looked_at = Some(number);
        self.touch(number);
        let pair = self.pairs.iter().find(|pair| pair.number() == number)?;
        (pair.pictures.is_small() && self.away.contains(&number)).then_some((number, pair.development))
    }

    /// Takes whole pictures back, or that there are none.
    pub(super) fn take_back(&mut self, (number, development): Key, pictures: Option<PairPictures>) -> Vec<Leaving> {
        let mut pairs = self.pairs.iter_mut();
        let Some(pair) = pairs.find(|pair| (pair.number(), pair.development) == (number, development)) else {
            // It was posed again meanwhile: what is away is not this.
            return Vec::new();
        };
        // They are here now, or nowhere but in the log.
        self.away.remove(&number);
        let Some(pictures) = pictures.filter(|_| pair.pictures.is_small()) else { return Vec::new() };
        Arc::make_mut(pair).pictures = Arc::new(pictures);
        self.touch(number);
        self.make_room()
    }

    fn touch(&mut self, number: u32) {
        if self.seen.last() != Some(&number) {
            self.seen.retain(|other| *other != number);
            self.seen.push(number);
        }
    }

    /// Pictures that nobody has looked at for long leave; those of the newest pair and of the one looked at stay.
    fn make_room(&mut self) -> Vec<Leaving> {
        let mut leaving = Vec::new();
        let whole = self.pairs.iter().filter(|pair| !pair.pictures.is_small());
        let mut bytes: usize = whole.map(|pair| pair.pictures.bytes()).sum();
        let stays = [self.looked_at, self.pairs.last().map(|pair| pair.number())];
        while bytes > self.picture_memory.0 {
            let may_leave = |at: &usize| {
                let pair = &self.pairs[*at];
                !pair.pictures.is_small() && !stays.contains(&Some(pair.number()))
            };
            let seen = |at: &usize| self.seen.iter().position(|number| *number == self.pairs[*at].number());
            let Some(at) = (0..self.pairs.len()).filter(may_leave).min_by_key(seen) else { break };
            let pair = &mut self.pairs[at];
            let whole = Arc::clone(&pair.pictures);
            let Some(small) = whole.small().cloned() else { break };
            bytes -= whole.bytes();
            leaving.push(Leaving { key: (pair.number(), pair.development), whole, small: Arc::clone(&small) });
            Arc::make_mut(pair).pictures = small;
        }
        leaving
    }

    /// What is drawn anew when it changes.
    pub(super) fn telling(&self) -> Telling {
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
pub(super) struct Telling {
    frames: [usize; 4],
    said: [bool; 2],
    slow: Vec<String>,
    phases: BTreeMap<u32, Phase>,
    lines: Vec<(Option<i64>, u64)>,
}

/// Boards of small pairs.
#[cfg(test)]
pub(super) mod example {
    use super::*;
    use crate::acquire::{Domain, Frame};
    use crate::image::Image;
    use crate::mask::Masks;
    use crate::report::Pair;

    /// A pair of a frame of 620 × 4 pixels, each of its own.
    pub(crate) fn pair(number: u32) -> PairView {
        let pixels = (0..620 * 4).map(|at| 1.0 + ((at * (number as usize + 1)) % 13) as f32).collect();
        let frame = Frame::from_pixels("a", Image { width: 620, height: 4, pixels }, Domain::Linear).expect("a frame");
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
            seen_robot: None,
            devices: Arc::default(),
            pictures: Arc::new(PairPictures::alone(&frame, &Masks::default())),
            latency_ms: Some(f64::from(number)),
        }
    }

    /// So many pairs of [`pair`] are whole.
    pub(crate) fn room_for(pairs: usize) -> BoardState {
        BoardState { picture_memory: PictureMemory(pairs * pair(1).pictures.bytes()), ..BoardState::default() }
    }

    /// Numbers of pairs whose pictures are whole.
    pub(crate) fn whole(state: &BoardState) -> Vec<u32> {
        state.pairs.iter().filter(|pair| !pair.pictures.is_small()).map(|pair| pair.number()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::example::{pair, room_for, whole};
    use super::*;
    use crate::report::{Pair, PairStatus};

    /// A torn picture stayed accepted in the window when the whole one had taken its exposure.
    #[test]
    fn a_picture_that_was_not_finished_is_taken_back_whichever_comes_first() {
        let torn = || PairView { pair: Arc::new(Pair { status: PairStatus::Accepted, ..(*pair(1).pair).clone() }), ..pair(1) };
        let whole = || PairView { replaces: Some(1), ..pair(2) };
        for order in [[torn(), whole()], [whole(), torn()]] {
            let mut state = BoardState::default();
            order.into_iter().for_each(|view| drop(state.show(view)));
            assert_eq!(
                state.pairs.iter().map(|view| view.pair.status).collect::<Vec<_>>(),
                [PairStatus::Refused, PairStatus::NoPose]
            );
        }
    }

    #[test]
    fn as_many_pictures_stay_whole_as_there_is_room_for_in_whatever_order_pairs_and_nulls_come() {
        let mut state = room_for(16);
        // The newest first, then each once more with its null.
        (1..=60).rev().chain(1..=60).for_each(|number| drop(state.show(pair(number))));
        assert_eq!((state.pairs.len(), whole(&state)), (60, (45..=60).collect::<Vec<_>>()));
        assert!(state.pairs.iter().all(|pair| pair.pictures.size_px == [620, 4]), "marks keep their places");
    }

    #[test]
    fn what_is_looked_at_stays_whole_and_what_was_looked_at_lately_leaves_last() {
        let mut state = room_for(3);
        let show = |state: &mut BoardState, number| {
            let left = state.show(pair(number));
            left.iter().map(|leaving| leaving.key).collect::<Vec<_>>()
        };
        (1..=3).for_each(|number| assert!(show(&mut state, number).is_empty()));
        state.look_at(1);
        assert_eq!((show(&mut state, 4), whole(&state)), (vec![(2, 0)], vec![1, 3, 4]));
        state.look_at(3);
        // It was looked at before 4 came.
        assert_eq!((show(&mut state, 5), whole(&state)), (vec![(1, 0)], vec![3, 4, 5]));
        assert_eq!(state.look_at(1), None, "nobody has its pictures");
        state.away.insert(1);
        assert_eq!(state.look_at(1), Some((1, 0)));
        // One that is back drives out another; one that is not is in the log.
        let left = state.take_back((1, 0), Some((*pair(1).pictures).clone()));
        assert_eq!((left.len(), left[0].key, whole(&state)), (1, (4, 0), vec![1, 3, 5]));
        state.away.insert(2);
        assert!(state.take_back((2, 0), None).is_empty() && state.away.is_empty() && whole(&state) == [1, 3, 5]);
        // It was posed again meanwhile.
        state.away.insert(4);
        assert!(state.take_back((4, 1), Some((*pair(4).pictures).clone())).is_empty() && whole(&state) == [1, 3, 5]);
        assert!(state.take_back((4, 1), None).is_empty() && state.away.contains(&4), "a stale answer takes nothing away");
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
}
