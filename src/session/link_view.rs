//! The state of the serial lines, as the window shows it.

use std::collections::BTreeMap;

use super::engine::Engine;
use crate::telemetry::{DeviceKind, Health, Sample};
use crate::timeline::ClockEstimate;

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
    /// Samples a second, lately.
    pub rate_hz: Option<f64>,
    /// The latest sample.
    pub latest: Option<Sample>,
    /// Device time to host time, as far as it is known.
    pub clock: Option<ClockEstimate>,
    /// Steps of the device's clock, and its restarts.
    pub clock_steps: u64,
}

/// Telemetry older than this is shown as stale.
pub const STALE_AFTER_US: i64 = 500_000;
/// Rates are means over at least this.
const RATE_OVER_US: i64 = 1_000_000;

impl Link {
    /// A line that is not open yet.
    #[must_use]
    pub fn new(device: DeviceKind) -> Self {
        Self {
            device,
            open: false,
            epoch: 0,
            health: Health::default(),
            last_byte_us: None,
            trouble: None,
            rate_hz: None,
            latest: None,
            clock: None,
            clock_steps: 0,
        }
    }

    /// Whether nothing came for [`STALE_AFTER_US`], or ever.
    #[must_use]
    pub fn is_stale(&self, now_us: i64) -> bool {
        self.last_byte_us.is_none_or(|last_us| now_us - last_us > STALE_AFTER_US)
    }
}

/// Brings what the engine knows of the lines to where it is shown.
#[derive(Debug, Default)]
pub(super) struct LinkReadings {
    /// Of each device when its samples were counted, how many there were, and the rate since the time before.
    counted: BTreeMap<DeviceKind, (i64, u64, Option<f64>)>,
}

impl LinkReadings {
    /// Brings `links` up to what `engine` knows at `now_us`.
    pub(super) fn update(&mut self, links: &mut [Link], engine: &Engine, now_us: i64) {
        let timeline = engine.timeline();
        for link in links {
            let Some(health) = engine.health(link.device) else { continue };
            link.rate_hz = self.rate_hz(link.device, health.frames, now_us);
            link.health = health;
            let clock = match link.device {
                DeviceKind::Carm => {
                    link.latest = timeline.carm().newest().map(|entry| Sample::Carm(entry.value.clone()));
                    timeline.carm().clock()
                }
                DeviceKind::Robot => {
                    link.latest = timeline.robot().newest().map(|entry| Sample::Robot(entry.value.clone()));
                    timeline.robot().clock()
                }
            };
            link.clock = clock.summaries().last().map(|segment| segment.clock);
            let (steps, resets) = clock.steps_and_resets();
            link.clock_steps = steps + resets;
        }
    }

    fn rate_hz(&mut self, device: DeviceKind, frames: u64, now_us: i64) -> Option<f64> {
        let (then_us, before, rate_hz) = *self.counted.entry(device).or_insert((now_us, frames, None));
        let since_us = now_us - then_us;
        if since_us < RATE_OVER_US {
            return rate_hz;
        }
        let rate_hz = Some(frames.saturating_sub(before) as f64 / (since_us as f64 * 1e-6));
        self.counted.insert(device, (now_us, frames, rate_hz));
        rate_hz
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_a_mean_over_a_second_or_more() {
        let mut readings = LinkReadings::default();
        let mut rate = |ms: i64, frames| readings.rate_hz(DeviceKind::Carm, frames, 1000 * ms);
        assert_eq!(rate(0, 50), None);
        assert_eq!(rate(900, 140), None);
        assert_eq!(rate(1000, 150), Some(100.0));
        assert_eq!(rate(1500, 150), Some(100.0));
        assert_eq!(rate(2000, 150), Some(0.0), "a silent line has none");
    }
}
