//! Which frame a running session registers next, and when nulls wait for it.

use super::super::busy::{HANGS_AFTER, Task};
use super::super::input::Input;
use super::Session;

/// So many frames may be posed and wait for their DRR; the others wait to be posed.
const MOST_OPEN: usize = 8;
/// Frames that are newer than all of those are posed meanwhile, until so many wait.
const MOST_POSED: usize = 24;

impl Session {
    /// The newest frame that is bound is registered next; the log keeps the order.
    pub(super) fn register_next(&mut self) {
        let Some(newest) = self.engine.bound().next_back() else { return };
        // Posed frames wait with all that is known of them; those before are lighter.
        let most = if newest > self.newest_posed { MOST_POSED } else { MOST_OPEN };
        let crowded = self.workshop.open_jobs() >= most && !self.workshop.has_ended();
        // An edit is of the pose that a frame has, not of one to come.
        if self.registrar_ended || self.registering.is_some() || self.is_editing() || crowded || !self.engine.is_ready(newest) {
            return;
        }
        self.newest_posed = self.newest_posed.max(newest);
        self.registering = Some((newest, self.busy.begin(Task::Registering(newest))));
        self.log.input(Input::Develop { number: newest });
    }

    /// Whether frames are on their way to the workshop. Those that a registration holds up which hangs, or whose thread died, do not come soon: a
    /// null that waited for them might never be made. Those that wait for telemetry may wait for all of its silence.
    pub(super) fn frames_come(&self) -> bool {
        // One whose picture is on a disk that stands still may never come; it is asked for while another is registered.
        let can_be_taken = self.engine.bound().next_back().is_some_and(|newest| self.engine.is_ready(newest));
        let are_behind = self.registering.is_some() || self.is_editing() || can_be_taken;
        let hangs = || {
            let long = self.busy.longer_than(HANGS_AFTER);
            self.registrar_ended || long.iter().any(|(task, _)| matches!(task, Task::Registering(_)))
        };
        are_behind && !hangs()
    }

    fn is_editing(&self) -> bool {
        self.editor.as_ref().is_some_and(|editor| !editor.is_idle())
    }
}
