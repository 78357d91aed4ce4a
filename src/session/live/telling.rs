//! What a running session tells while it runs: losses, what is behind, and how far it has come.

use std::time::Duration;

use super::super::busy::{HANGS_AFTER, Task};
use super::super::input::Input;
use super::super::phase::{self, Phase};
use super::{Session, Stage};
use crate::record::Level;
use crate::telemetry::DeviceKind;
use crate::time::host_now_us;

/// Ticks keep waiting frames and stale marks moving when nothing arrives.
const TICK_US: i64 = 100_000;
/// Losses on the lines are told at most this often.
const TELL_LOSSES_US: i64 = 1_000_000;
/// A log that is so far behind is said.
const BEHIND_MS: f64 = 1_000.0;

impl Session {
    pub(super) fn tick(&mut self, now_us: i64) {
        self.next_tick_us = now_us + TICK_US;
        self.faults_this_tick = 0;
        if matches!(self.stage, Stage::Open { .. }) {
            self.log.input(Input::Tick { host_us: now_us });
        }
        if now_us >= self.tell_losses_us {
            self.tell_losses_us = now_us + TELL_LOSSES_US;
            self.tell_losses();
        }
        self.tell_dead();
        self.tell_late();
        self.publish(now_us);
        if let Some((progress, complete)) = &mut self.finishing {
            let now_complete = self.scribe.complete();
            if now_complete > *complete {
                progress.advance((now_complete - *complete) as u64);
                *complete = now_complete;
                if !progress.is_shown() {
                    self.reporter.note(format!("finishing {now_complete} of {}", self.frames()));
                }
            }
        }
    }

    /// Frames that were given a number.
    pub(super) fn frames(&self) -> usize {
        self.board.read(|state| state.frames_seen)
    }

    /// Lost telemetry and a log that fails reach the person while there is something to be done.
    fn tell_losses(&mut self) {
        for device in DeviceKind::ALL {
            let Some(health) = self.engine.health(device).filter(|health| health.lost_in_all() > 0) else { continue };
            let told = self.told_losses.insert(device, health.lost_in_all());
            if let (true, Some(words)) = (told < Some(health.lost_in_all()), self.engine.losses_of(device)) {
                self.reporter.warn(&format!("{device} telemetry lost"), words);
            }
        }
        if matches!(self.stage, Stage::Open { .. }) {
            for (device, words) in self.engine.silent_lines() {
                self.reporter.warn(&format!("{device} line silent"), &words);
                self.log.event(Level::Warning, host_now_us(), &words);
            }
        }
        let recorder = self.log.health();
        if let Some(failure) = recorder.failure {
            self.log.fail(&failure);
        }
        if recorder.behind_ms > BEHIND_MS && !self.log.has_failed() {
            let safe =
                if recorder.kill_loses_ms > BEHIND_MS { "" } else { "; all of it is with the process that writes the log" };
            let words =
                format!("the log's file is {:.0} s behind: its disk is slow or stands still{safe}", recorder.behind_ms / 1e3);
            self.reporter.warn("recording behind", words);
        }
    }

    /// Threads and processes that died are said at the next tick, each once.
    fn tell_dead(&mut self) {
        let keepers_lost = self.log.health().keepers_lost;
        if keepers_lost > self.told_keepers_lost {
            self.told_keepers_lost = keepers_lost;
            let words = "the process that writes the log died; another one goes on, and nothing is lost";
            self.reporter.warn("log keeper lost", words);
            self.log.event(Level::Warning, host_now_us(), words);
        }
        if matches!(self.stage, Stage::Finishing) {
            return;
        }
        if self.scribe.has_died() {
            self.mourn(
                "files not written",
                "the thread that writes files died; recording goes on, replay the log for pairs and report",
                format!("the thread that writes files died; {}", self.log.again()),
            );
        } else if self.workshop.has_ended() {
            // Without pairs to write that of the other would have ended as well.
            self.mourn(
                "no rendering",
                "the rendering thread died; recording and registration go on, replay the log for the DRRs",
                "the rendering thread died: frames after that have no DRR; a replay of the log makes them".to_owned(),
            );
        }
    }

    fn mourn(&mut self, kind: &'static str, words: &str, lost: String) {
        if self.dead_said.insert(kind) {
            self.log.lose(lost);
            self.reporter.warn(kind, words);
            self.log.event(Level::Error, host_now_us(), words);
        }
    }

    /// A part that is late is said when it becomes so, and not again before it was on time; one that hangs is said once more, and that it went
    /// on.
    fn tell_late(&mut self) {
        let late = self.busy.late();
        for (task, taken) in &late {
            let hangs = *taken >= HANGS_AFTER;
            if !self.late_said.insert((*task, hangs)) || (!hangs && self.busy.was_late(task.kind())) {
                continue;
            }
            let words = task.words(*taken);
            self.reporter.warn(task.kind(), &words);
            self.log.event(Level::Warning, host_now_us(), &words);
        }
        let is_over = |(task, _): &(Task, bool)| !late.iter().any(|(other, _)| other == task);
        for (task, hung) in self.late_said.extract_if(.., is_over) {
            if hung {
                self.reporter.mend(task.kind(), task.over());
            }
        }
    }

    pub(super) fn publish(&mut self, now_us: i64) {
        let recorder = self.log.health();
        let waiting = self.engine.waiting()
            + self.engine.bound().count()
            + usize::from(self.registering.is_some())
            + self.workshop.open_jobs();
        let slow = self.busy.late().into_iter().map(|(task, taken)| task.words(taken)).collect();
        let mut phases = phase::of_engine(&self.engine);
        phases.extend(self.registering.iter().map(|(number, _)| (*number, Phase::Registering)));
        let at_work = self.busy.longer_than(Duration::ZERO);
        let Self { board, readings, engine, reporter, .. } = self;
        board.tick(|state| {
            state.now_us = now_us;
            state.frames_waiting = waiting;
            phases.extend(at_work.iter().filter_map(|(task, _)| match task {
                Task::Developing(number) => Some((*number, Phase::Rendering)),
                Task::Null(number) => Some((*number, Phase::Null)),
                Task::Folder | Task::Warming | Task::Reading(_) | Task::Registering(_) | Task::Writing(_) => None,
            }));
            state.phases = phases;
            state.recorder_behind_ms = recorder.behind_ms;
            state.recorder_failure = recorder.failure;
            state.slow = slow;
            readings.update(&mut state.links, engine, now_us);
            state.warnings = reporter.warnings().into_iter().map(|(kind, counted)| (kind, counted.count)).collect();
        });
    }
}
