//! What a window shows of a replay besides its pairs: the lines as they were, at the time of the log. Where nobody looks nothing is done.

use super::board::{Board, Link};
use super::engine::Engine;
use super::file::Setup;
use super::link_view::LinkReadings;
use super::phase;
use crate::time::Stopwatch;

/// Wall time between two looks at the engine.
const LOOK_MS: f64 = 50.0;

/// See the module.
pub(super) struct ReplayBoard<'a> {
    board: &'a Board,
    watched: bool,
    readings: LinkReadings,
    looked: Option<Stopwatch>,
}

impl<'a> ReplayBoard<'a> {
    /// With a line for each device of the session.
    pub(super) fn open(board: &'a Board, setup: &Setup) -> Self {
        let watched = board.read(|state| state.watched);
        if watched {
            let links = setup.devices().map(|device| Link { open: true, ..Link::new(device) });
            board.update(|state| {
                state.links = links.collect();
                state.replayed = true;
            });
        }
        Self { board, watched, readings: LinkReadings::default(), looked: None }
    }

    /// Brings the board to `now_us` of the log: `seen` frames so far, `waiting` of them in the workshop.
    pub(super) fn tick(&mut self, engine: &Engine, now_us: i64, seen: usize, waiting: usize) {
        if !self.watched || self.looked.is_some_and(|looked| looked.ms() < LOOK_MS) {
            return;
        }
        self.looked = Some(Stopwatch::start());
        let Self { board, readings, .. } = self;
        board.tick(|state| {
            state.now_us = now_us;
            state.frames_seen = seen;
            state.frames_waiting = waiting + engine.waiting() + engine.bound().count();
            state.phases = phase::of_engine(engine);
            readings.update(&mut state.links, engine, now_us);
        });
    }

    /// The log has come to its end.
    pub(super) fn finish(&mut self, engine: &Engine, now_us: i64, seen: usize) {
        self.looked = None;
        self.tick(engine, now_us, seen, 0);
        self.board.update(|state| state.finished = true);
    }

    /// Where pairs are shown.
    pub(super) fn board(&self) -> &Board {
        self.board
    }
}
