//! Frames to exposures: by counter first, by time second, and if neither is unambiguous, not at all.

use serde::{Deserialize, Serialize};

use super::evidence::{Binding, BindingHow};
use super::exposure::{ExposureInterval, ExposureTracker};

/// What a frame says about when it was taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrameStamp {
    /// The C-arm's exposure counter as written into the frame.
    pub exposure_counter: Option<u32>,
    /// Host time at which the frame was complete on this machine.
    pub host_arrival_us: i64,
    /// Acquisition time as the console wrote it (its clock, often whole seconds), as microseconds since the Unix epoch.
    pub acquired_us: Option<i64>,
}

/// What binding by time may assume.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct BindLimits {
    /// A frame may arrive this long after its exposure ended to be bound by its arrival.
    pub arrival_us: i64,
    /// Resolution of the console's stamp.
    pub acquired_resolution_us: i64,
    /// How far the console's clock may be off.
    pub acquired_tolerance_us: i64,
    /// Added to the console's stamp: host clock minus console clock, where known.
    pub console_offset_us: i64,
}

impl Default for BindLimits {
    /// 5 s, 1 s, 2 s, 0.
    fn default() -> Self {
        Self { arrival_us: 5_000_000, acquired_resolution_us: 1_000_000, acquired_tolerance_us: 2_000_000, console_offset_us: 0 }
    }
}

/// Collects what is found on the way to a verdict.
struct Inquiry<'a> {
    tracker: &'a ExposureTracker,
    stamp: &'a FrameStamp,
    limits: &'a BindLimits,
    evidence: Vec<String>,
    settled: bool,
}

/// Binds a frame to one of the tracker's exposures. `newest_us` is the mapped time of the newest C-arm sample.
pub(super) fn bind(tracker: &ExposureTracker, newest_us: Option<i64>, stamp: &FrameStamp, limits: &BindLimits) -> Binding {
    let settled = newest_us.is_some_and(|newest_us| newest_us >= stamp.host_arrival_us);
    let mut inquiry = Inquiry { tracker, stamp, limits, evidence: Vec::new(), settled };
    if tracker.closed().is_empty() && tracker.open().is_none() {
        return inquiry.none("telemetry recorded no exposure");
    }
    let counted = inquiry.exposures().any(|interval| interval.counter.is_some());
    match stamp.exposure_counter {
        Some(counter) if counted => inquiry.by_counter(counter),
        Some(counter) => {
            inquiry.note(format!("the frame carries counter {counter}, but the C-arm's telemetry has no exposure counter"));
            inquiry.by_time()
        }
        None => {
            inquiry.note("the frame carries no exposure counter".to_owned());
            inquiry.by_time()
        }
    }
}

impl<'a> Inquiry<'a> {
    /// Exposures that began before the frame arrived.
    fn exposures(&self) -> impl Iterator<Item = &'a ExposureInterval> + use<'a> {
        let arrival_us = self.stamp.host_arrival_us;
        let began = move |interval: &&ExposureInterval| {
            interval.start_us as f64 - 3.0 * interval.start_uncertainty_us <= arrival_us as f64
        };
        self.tracker.closed().iter().chain(self.tracker.open()).filter(began)
    }

    fn note(&mut self, sentence: String) {
        self.evidence.push(sentence);
    }

    fn none(mut self, reason: impl Into<String>) -> Binding {
        self.evidence.push(reason.into());
        Binding { evidence: self.evidence, settled: self.settled, ..Binding::default() }
    }

    /// The verdict for one exposure, unless it still goes on.
    fn one(mut self, interval: &ExposureInterval, how: BindingHow, reason: String) -> Binding {
        if interval.open {
            self.settled = false;
            return self.none(format!("{} still goes on as far as telemetry has come", interval.label()));
        }
        self.evidence.push(reason);
        let time_us = Some(interval.mid_us());
        Binding { exposure: Some(interval.clone()), how, evidence: self.evidence, settled: true, time_us, flags: Vec::new() }
    }

    fn by_counter(mut self, counter: u32) -> Binding {
        let matching: Vec<&ExposureInterval> = self.exposures().filter(|interval| interval.counter == Some(counter)).collect();
        match matching[..] {
            [] => {
                let seen: Vec<u32> = self.exposures().filter_map(|interval| interval.counter).collect();
                let range = match (seen.iter().min(), seen.iter().max()) {
                    (Some(low), Some(high)) => format!("telemetry saw {low} to {high}"),
                    _ => "telemetry saw none before the frame arrived".to_owned(),
                };
                self.none(format!("the frame carries exposure counter {counter}, which telemetry did not see ({range})"))
            }
            [interval] => {
                self.note_times(interval);
                let reason = format!("exposure counter {counter} is in the frame and in telemetry, once each");
                self.one(interval, BindingHow::Counter, reason)
            }
            _ => {
                let count = matching.len();
                self.note(format!("exposure counter {counter} occurs {count} times in telemetry (it was reset or wrapped)"));
                let by_stamp = matching.iter().filter(|interval| self.fits_stamp(interval)).copied().collect::<Vec<_>>();
                if let ([interval], true) = (&by_stamp[..], self.stamp.acquired_us.is_some()) {
                    return self.one(interval, BindingHow::Counter, "the console's stamp fits only one of them".to_owned());
                }
                let prompt = matching.iter().filter(|interval| self.is_prompt(interval)).copied().collect::<Vec<_>>();
                if let ([interval], None) = (&prompt[..], self.stamp.acquired_us) {
                    let late_s = seconds(self.stamp.host_arrival_us - interval.end_us);
                    let reason = format!("only one of them ended within reach of the arrival, {late_s} before it");
                    return self.one(interval, BindingHow::Counter, reason);
                }
                self.none("neither the console's stamp nor the arrival tells them apart")
            }
        }
    }

    fn by_time(mut self) -> Binding {
        let reach = seconds(self.limits.arrival_us);
        let prompt: Vec<&ExposureInterval> = self.exposures().filter(|interval| self.is_prompt(interval)).collect();
        let Some(acquired_us) = self.stamp.acquired_us else {
            let (from_us, to_us) = (self.stamp.host_arrival_us - self.limits.arrival_us, self.stamp.host_arrival_us);
            return match prompt[..] {
                [] => self.none(format!("no exposure ended within {reach} before the frame arrived")),
                [interval] => {
                    if let Some(blind) = self.blind(interval, from_us, to_us) {
                        return self.none(blind);
                    }
                    let late = seconds(self.stamp.host_arrival_us - interval.end_us);
                    let reason =
                        format!("{} ended {late} before the frame arrived, and no other within {reach}", interval.label());
                    self.one(interval, BindingHow::Time, reason)
                }
                _ => self.none(format!("{} exposures ended within {reach} before the frame arrived: ambiguous", prompt.len())),
            };
        };
        let reach = seconds(self.limits.acquired_tolerance_us);
        let (from_us, to_us) = self.stamp_window(acquired_us);
        let fitting: Vec<&ExposureInterval> = self.exposures().filter(|interval| self.fits_stamp(interval)).collect();
        match fitting[..] {
            [] => {
                let middle_us = from_us + (to_us - from_us) / 2;
                let nearest = self.exposures().map(|interval| (interval.mid_us() - middle_us).abs()).min();
                let nearest = nearest.map_or(String::new(), |us| format!(" (the nearest is {} away)", seconds(us)));
                self.none(format!("the console's stamp fits no exposure{nearest}; its clock may be off"))
            }
            [interval] => {
                if let [other] = prompt[..]
                    && other.index != interval.index
                {
                    let (by_stamp, by_arrival) = (interval.label(), other.label());
                    return self
                        .none(format!("the console's stamp points to {by_stamp}, the arrival to {by_arrival}: contradictory"));
                }
                if let Some(blind) = self.blind(interval, from_us, to_us.min(self.stamp.host_arrival_us)) {
                    return self.none(blind);
                }
                self.note_times(interval);
                let reason = format!("{} is the only exposure within {reach} of the console's stamp", interval.label());
                self.one(interval, BindingHow::Time, reason)
            }
            _ => self.none(format!("{} exposures lie within {reach} of the console's stamp: ambiguous", fitting.len())),
        }
    }

    /// The exposure ended shortly before the frame arrived (or goes on).
    fn is_prompt(&self, interval: &ExposureInterval) -> bool {
        interval.open || self.stamp.host_arrival_us - interval.end_us <= self.limits.arrival_us
    }

    /// Host times that the console's stamp can mean.
    fn stamp_window(&self, acquired_us: i64) -> (i64, i64) {
        let at_us = acquired_us.saturating_add(self.limits.console_offset_us);
        let tolerance_us = self.limits.acquired_tolerance_us;
        (
            at_us.saturating_sub(tolerance_us),
            at_us.saturating_add(self.limits.acquired_resolution_us).saturating_add(tolerance_us),
        )
    }

    fn fits_stamp(&self, interval: &ExposureInterval) -> bool {
        self.stamp.acquired_us.is_some_and(|acquired_us| {
            let (from_us, to_us) = self.stamp_window(acquired_us);
            interval.start_us <= to_us && interval.end_us >= from_us
        })
    }

    /// Whether another exposure may hide in the window because telemetry was silent there.
    fn blind(&self, interval: &ExposureInterval, from_us: i64, to_us: i64) -> Option<String> {
        // With a counter on either side the exposures themselves prove completeness, as silences with equal counters do.
        let spot = self.tracker.blind_spot(from_us, to_us)?;
        let silence_ms = (spot.to_us - spot.from_us) / 1000;
        Some(format!(
            "{} would fit, but telemetry was silent for {silence_ms} ms in the time in question: another exposure may have happened unseen",
            interval.label()
        ))
    }

    fn note_times(&mut self, interval: &ExposureInterval) {
        let late_us = self.stamp.host_arrival_us - interval.end_us;
        self.note(format!("{} ended {} before the frame arrived", interval.label(), seconds(late_us)));
        if let Some(acquired_us) = self.stamp.acquired_us {
            let off_us = acquired_us.saturating_add(self.limits.console_offset_us).saturating_sub(interval.mid_us());
            self.note(format!("the console's stamp is {} from the middle of it", seconds(off_us)));
        }
    }
}

fn seconds(us: i64) -> String {
    format!("{:.3} s", us as f64 * 1e-6)
}
