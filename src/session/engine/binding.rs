//! Frames that wait for their exposures, and frames whose exposures become clear late.

use std::sync::Arc;

use super::super::bound::Bound;
use super::super::input::Output;
use super::{Engine, Pending, Unbound};
use crate::acquire::Frame;
use crate::telemetry::DeviceKind;
use crate::timeline::Binding;

/// How long a frame waits for telemetry that would bind it.
const BIND_PATIENCE_US: i64 = 1_000_000;
/// Pixels of unbound frames that are kept, so that they can be developed again: the latest ones, up to this much.
const MOST_UNBOUND_BYTES: usize = 128 << 20;

impl Engine {
    /// Hands on the frames that telemetry has reached or that have waited long enough.
    pub(super) fn settle(&mut self, sink: &mut dyn FnMut(Output)) {
        let changed = match self.ended_us.is_some() {
            true => self.binder.finish(&self.timeline),
            false => self.binder.update(&self.timeline, self.now_us),
        };
        for number in changed {
            let Some(binding) = self.binder.binding(number).filter(|binding| binding.exposure.is_some()).cloned() else {
                continue;
            };
            if self.seen.contains(&number) {
                self.shown.extend(binding.exposure.as_ref().map(|exposure| exposure.index));
                self.tied.insert(number);
            }
            if let Some(unbound) = self.unbound.remove(&number) {
                self.bind_late(number, unbound, binding, sink);
            }
        }
        let waits_at_all = self.setup.carm.is_some() && self.ended_us.is_none();
        let ready = |(number, pending): (&u32, &Pending)| {
            let binding = self.binder.binding(*number).cloned().unwrap_or_default();
            let waited = self.now_us.saturating_sub(pending.host_us);
            let waits = waits_at_all && waited < BIND_PATIENCE_US && !(binding.settled && self.robot_has_reached(&binding));
            (!waits).then_some((*number, binding))
        };
        let ready: Vec<(u32, Binding)> = self.pending.iter().filter_map(ready).collect();
        let mut are_unbound = false;
        for (number, binding) in ready {
            let Some(Pending { frame, host_us }) = self.pending.remove(&number) else { continue };
            if binding.exposure.is_none() {
                self.keep_unbound(number, &frame, host_us);
                are_unbound = true;
            }
            let bound = Bound::new(frame, host_us, binding, &self.timeline);
            self.hearing.bound(number, host_us, &bound);
            self.shown.extend(bound.exposure_index());
            self.tied.extend(bound.exposure_index().map(|_| number));
            self.bound.insert(number, bound);
            sink(Output::Bound { number });
        }
        if are_unbound
            && !self.told_of_counts
            && let Some(words) = self.frames_that_count_on()
        {
            self.told_of_counts = true;
            self.reporter.warn("C-arm counter", words);
        }
    }

    /// The exposure of a frame that was handed on without one has become clear: its telemetry is stored with it.
    fn bind_late(&mut self, number: u32, unbound: Unbound, binding: Binding, sink: &mut dyn FnMut(Output)) {
        let label = binding.exposure.as_ref().map(|exposure| exposure.label()).unwrap_or_default();
        let Unbound { frame, host_us } = unbound;
        self.shown.extend(binding.exposure.as_ref().map(|exposure| exposure.index));
        self.tied.insert(number);
        let timeline = &self.timeline;
        // Not developed yet: nothing was made without the exposure.
        if let Some(bound) = self.bound.rebind(number, |frame| Bound::new(frame, host_us, binding.clone(), timeline)) {
            return self.hearing.bound(number, host_us, bound);
        }
        let bound = frame.map(|frame| Bound::new(frame, host_us, binding, timeline));
        if let Some(bound) = &bound {
            self.hearing.bound(number, host_us, bound);
        }
        let remedy = match bound {
            Some(_) => "it is posed again, with that exposure's telemetry",
            None => "its pair was made without that exposure's telemetry, and its pixels were let go since",
        };
        let words = format!("frame {number}: only now it is clear that it belongs to {label}; {remedy}");
        self.reporter.warn("bound late", &words);
        sink(Output::BoundLate { number, words });
        if let Some(bound) = bound {
            *self.developments.entry(number).or_default() += 1;
            self.bound.insert(number, bound);
            sink(Output::Bound { number });
        }
    }

    /// Why a frame is bound to no exposure, as far as is known by now; `None` where it is bound.
    pub(in crate::session) fn why_unbound(&self, number: u32) -> Option<&Binding> {
        self.binder.binding(number).filter(|binding| binding.exposure.is_none())
    }

    /// Keeps a frame for [`Engine::bind_late`]; the pixels of the oldest are let go where there are too many.
    fn keep_unbound(&mut self, number: u32, frame: &Arc<Frame>, host_us: i64) {
        self.unbound.insert(number, Unbound { frame: Some(Arc::clone(frame)), host_us });
        let mut kept_bytes = 0;
        for unbound in self.unbound.values_mut().rev() {
            kept_bytes += unbound.frame.as_ref().map_or(0, |frame| frame.pixels.pixels.len() * size_of::<f32>());
            if kept_bytes > MOST_UNBOUND_BYTES {
                unbound.frame = None;
            }
        }
    }

    /// Whether the robot's samples go beyond the time of the frame in its exposure, so that its shape is interpolated and not held.
    fn robot_has_reached(&self, binding: &Binding) -> bool {
        match (binding.asks_until_us(), self.links.contains_key(&DeviceKind::Robot)) {
            (Some(at_us), true) => self.timeline.told_until_us(DeviceKind::Robot).is_some_and(|newest_us| newest_us >= at_us),
            _ => true,
        }
    }
}
