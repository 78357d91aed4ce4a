//! Waits so that the inputs of a replay come at the recorded pace.

use std::time::Duration;

use crate::time::Stopwatch;

/// See the module.
pub(super) struct Pace {
    rate: Option<f64>,
    first_us: Option<i64>,
    watch: Stopwatch,
}

impl Pace {
    /// `None` waits for nothing.
    pub(super) fn new(rate: Option<f64>) -> Self {
        Self { rate, first_us: None, watch: Stopwatch::start() }
    }

    /// Waits until an input of this time is due.
    pub(super) fn wait_for(&mut self, host_us: i64) {
        let Some(rate) = self.rate else { return };
        let first_us = *self.first_us.get_or_insert(host_us);
        let due_ms = host_us.saturating_sub(first_us) as f64 * 1e-3 / rate;
        let early_ms = due_ms - self.watch.ms();
        if early_ms > 1.0 {
            std::thread::sleep(Duration::from_secs_f64(early_ms.min(60_000.0) * 1e-3));
        }
    }
}
