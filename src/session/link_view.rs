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
    /// Counters.
    pub health: Health,
    /// Host time of the arrival of the latest sample: bytes that are none do not make a line live.
    pub last_sample_us: Option<i64>,
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
    /// Counts the samples that are so far from the one shown before that they are worth a look.
    pub moves: u64,
}

/// Telemetry older than this is shown as stale.
pub const STALE_AFTER_US: i64 = 500_000;
/// The age of what is stale is shown in steps of this.
const SILENCE_STEP_US: i64 = 1_000_000;
/// What changes by more than the last digit that is shown of it is worth a look, and no more than one in so long is.
const MOVE_DEG: f64 = 0.1;
const MOVE_MM: f64 = 0.1;
const MOVE_KV: f64 = 0.1;
const MOVE_RPM: f64 = 1.0;
const LOOK_US: i64 = 1_000_000;
/// Rates are means over at least this.
const RATE_OVER_US: i64 = 1_000_000;

impl Link {
    /// A line that is not open yet.
    #[must_use]
    pub fn new(device: DeviceKind) -> Self {
        Self {
            device,
            open: false,
            health: Health::default(),
            last_sample_us: None,
            trouble: None,
            rate_hz: None,
            latest: None,
            clock: None,
            clock_steps: 0,
            moves: 0,
        }
    }

    /// How long it has been silent, in steps in which that is worth a look; `None` where it is not stale, −1 where nothing ever came.
    pub(super) fn silent_steps(&self, now_us: i64) -> Option<i64> {
        let Some(last_us) = self.last_sample_us else { return Some(-1) };
        let silent_us = now_us - last_us;
        self.is_stale(now_us).then_some(silent_us / SILENCE_STEP_US)
    }

    /// Whether nothing came for [`STALE_AFTER_US`], or ever.
    #[must_use]
    pub fn is_stale(&self, now_us: i64) -> bool {
        self.last_sample_us.is_none_or(|last_us| now_us - last_us > STALE_AFTER_US)
    }
}

/// Brings what the engine knows of the lines to where it is shown.
#[derive(Debug, Default)]
pub(super) struct LinkReadings {
    /// Of each device when its samples were counted, how many there were, and the rate since the time before.
    counted: BTreeMap<DeviceKind, (i64, u64, Option<f64>)>,
    /// Of each device the sample that was worth the latest look, and when that was.
    looked: BTreeMap<DeviceKind, (i64, Sample)>,
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
            link.last_sample_us = match link.device {
                DeviceKind::Carm => timeline.carm().last_arrival_us(),
                DeviceKind::Robot => timeline.robot().last_arrival_us(),
            };
            link.clock = clock.summaries().last().map(|segment| segment.clock);
            let (steps, resets) = clock.steps_and_resets();
            link.clock_steps = steps + resets;
            if let Some(sample) = &link.latest {
                link.moves += u64::from(self.is_worth_a_look(link.device, sample, now_us));
            }
        }
    }

    fn is_worth_a_look(&mut self, device: DeviceKind, sample: &Sample, now_us: i64) -> bool {
        let worth = match self.looked.get(&device) {
            // Whether the beam is on is seen at once.
            Some((then_us, before)) => {
                is_beam_on(before) != is_beam_on(sample) || now_us - then_us >= LOOK_US && has_moved(before, sample)
            }
            None => true,
        };
        if worth {
            self.looked.insert(device, (now_us, sample.clone()));
        }
        worth
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

fn is_beam_on(sample: &Sample) -> bool {
    matches!(sample, Sample::Carm(carm) if carm.xray_on)
}

/// Whether an eye would see the difference, or somebody must.
fn has_moved(before: &Sample, now: &Sample) -> bool {
    let apart = |a: f64, b: f64, limit: f64| (a - b).abs() > limit || a.is_nan() != b.is_nan();
    match (before, now) {
        (Sample::Carm(before), Sample::Carm(now)) => {
            let [a, b] = [before, now].map(|sample| &sample.joints);
            let angles = [
                (a.orbital_rad, b.orbital_rad),
                (a.angulation_rad, b.angulation_rad),
                (a.wig_wag_rad, b.wig_wag_rad),
                (a.detector_rotation_rad, b.detector_rotation_rad),
            ];
            let lengths = [
                (a.lift_mm, b.lift_mm),
                (a.longitudinal_mm, b.longitudinal_mm),
                (a.source_to_detector_mm, b.source_to_detector_mm),
            ];
            angles.iter().any(|(a, b)| apart(a.to_degrees(), b.to_degrees(), MOVE_DEG))
                || lengths.iter().any(|(a, b)| apart(*a, *b, MOVE_MM))
                || apart(before.tube_kvp, now.tube_kvp, MOVE_KV)
                || (before.xray_on, before.exposure_counter, before.status) != (now.xray_on, now.exposure_counter, now.status)
        }
        (Sample::Robot(before), Sample::Robot(now)) => {
            let [(a, sensed_before), (b, sensed_now)] = [before, now].map(|sample| sample.control_angles_deg());
            a.iter().zip(b).any(|(a, b)| apart(*a, b, MOVE_DEG))
                || apart(before.drill_rpm, now.drill_rpm, MOVE_RPM)
                || (sensed_before, before.status) != (sensed_now, now.status)
        }
        _ => true,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::CarmJoints;
    use crate::telemetry::{CarmSample, RobotSample, Tendon};

    #[test]
    fn an_arm_at_rest_is_worth_one_look_and_one_that_moves_one_a_second() {
        let mut readings = LinkReadings::default();
        let sample = |orbital_deg: f64| {
            let joints = CarmJoints { orbital_rad: orbital_deg.to_radians(), ..CarmJoints::ZERO };
            Sample::Carm(CarmSample { joints, ..CarmSample::UNTOLD })
        };
        let mut looks = |from_ms: i64, deg_per_s: f64| {
            let at = |ms: i64| (1000 * ms, sample(10.0 + 1e-3 * ms as f64 * deg_per_s + 0.05 * (ms as f64).sin()));
            let times = (from_ms..from_ms + 10_000).step_by(100).map(at);
            times.filter(|(now_us, sample)| readings.is_worth_a_look(DeviceKind::Carm, sample, *now_us)).count()
        };
        assert_eq!(looks(0, 0.0), 1);
        assert_eq!(looks(10_000, 5.0), 10);
    }

    /// An arm that crept by half a degree was shown where it had been, for as long as it liked.
    #[test]
    fn what_is_shown_to_a_tenth_is_not_off_by_more_for_longer_than_a_second() {
        type By = fn(f64) -> Sample;
        let creep: [(&str, By); 4] = [
            ("orbital", |by| {
                let joints = CarmJoints { orbital_rad: by.to_radians(), ..CarmJoints::ZERO };
                Sample::Carm(CarmSample { joints, ..CarmSample::UNTOLD })
            }),
            ("lift", |by| {
                Sample::Carm(CarmSample { joints: CarmJoints { lift_mm: by, ..CarmJoints::ZERO }, ..CarmSample::UNTOLD })
            }),
            ("tube", |by| Sample::Carm(CarmSample { tube_kvp: 90.0 + by, ..CarmSample::UNTOLD })),
            ("bend", |by| Sample::Robot(robot(by))),
        ];
        for (what, at) in creep {
            let mut readings = LinkReadings::default();
            // A twentieth a second; every tenth of one, somebody may look.
            let (mut shown, mut off_us) = (f64::NAN, 0);
            for now_us in (0..30_000_000).step_by(100_000) {
                let value = 0.05e-6 * now_us as f64;
                if readings.is_worth_a_look(DeviceKind::Carm, &at(value), now_us) {
                    shown = value;
                }
                off_us = if (value - shown).abs() > 0.1 + 1e-6 { off_us + 100_000 } else { 0 };
                assert!(off_us <= 1_000_000, "{what}: {shown} for {value}");
            }
            assert!((shown - 1.5).abs() < 0.2, "{what}: {shown} at the end");
        }
    }

    fn robot(bend_deg: f64) -> RobotSample {
        let tendon = || Tendon { position_mm: 0.0, velocity_mm_per_s: 0.0, tension_n: 1.0, current_a: 0.1 };
        RobotSample {
            device_us: 0,
            sequence: 0,
            commanded_deg: [0.0; 5],
            sensed_deg: Some([bend_deg, 0.0, 0.0, 0.0, 0.0]),
            tendons: [tendon(), tendon()],
            tracker_from_base: None,
            drill_rpm: 0.0,
            status: 0,
        }
    }

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
