//! Samples, clocks and exposures in time: every question about "when" is answered here.
//!
//! A sample keeps its raw device time and its host arrival; its mapped host time comes from the clock map of its segment and improves
//! while data come in. Answers depend on what was pushed, in which order, and on nothing else, so a replay gives the same ones.

mod accident;
mod agreement;
mod alignment;
mod apart;
mod arrival;
mod binder;
mod claims;
mod clock;
mod console;
mod console_binder;
mod counted;
mod counting;
mod evidence;
mod exposure;
mod gap;
mod judgement;
mod kept;
mod known;
mod learning;
mod orderly;
mod rate;
mod segments;
mod sequence;
mod series;
mod shots;
mod stamped;
mod stated_length;
mod track;
mod travel;
mod zone;

pub use arrival::TOO_FEW_AGREE;
pub use binder::Binder;
pub use clock::{ClockEstimate, ClockMap, LEAST_DELAY_US, MAX_DRIFT};
pub use console::ConsoleClock;
pub use evidence::{Binding, BindingFlag, BindingHow, FrameEvidence, LONG_BEAM_US};
pub use exposure::{ExposureInterval, ExposureTracker, HIDING_SILENCE_US, Silence};
pub use gap::Gap;
pub use judgement::NO_EXPOSURE;
pub use rate::unit_of_clock;
pub use segments::{DeviceClock, Placed, Segment, SegmentStart, SegmentSummary};
pub use track::{Answer, Bracket, Entry, Retention, Stamps, Support, Track};
pub use zone::ConsoleZone;

use std::collections::VecDeque;

use travel::Travel;

use serde::{Deserialize, Serialize};

use crate::geometry::{CarmJoints, Rigid};
use crate::telemetry::{AngleSource, CarmSample, DeviceKind, Metadata, RobotSample, Sample, Sequenced};
use crate::units::{lerp_angle_rad, wrap_rad};

/// Whether a device's data can be relied on now.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case", tag = "state")]
pub enum Freshness {
    /// The newest message is young.
    Fresh {
        /// Since it arrived.
        age_us: i64,
    },
    /// The newest message is too old.
    Stale {
        /// Since it arrived.
        age_us: i64,
    },
    /// Nothing ever arrived.
    Absent,
}

/// When data are too old.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FreshLimits {
    /// Older is stale.
    pub stale_us: i64,
}

impl Default for FreshLimits {
    /// Half a second: 15 samples of the C-arm, 50 of the robot.
    fn default() -> Self {
        Self { stale_us: 500_000 }
    }
}

/// What a device's track holds and has lost, for people and logs.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct TrackSummary {
    /// Which device.
    pub device: DeviceKind,
    /// Samples in memory.
    pub samples: usize,
    /// Samples forgotten to bound memory.
    pub dropped: u64,
    /// Samples whose time is not known: late ones from before a step of the clock, and those whose device time is none.
    pub unusable: u64,
    /// Samples whose device time is none.
    pub no_time: u64,
    /// Samples that came after later ones.
    pub late: u64,
    /// Steps of the device's clock.
    pub clock_steps: u64,
    /// Restarts of the device within an epoch.
    pub resets: u64,
    /// Of a device without a clock: the standard deviation of the host's times that stand for it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub host_time_sigma_us: Option<f64>,
    /// Clock maps, oldest first.
    pub segments: Vec<SegmentSummary>,
}

/// All that was measured, by time.
#[derive(Clone, Debug)]
pub struct Timeline {
    carm: Track<CarmSample>,
    robot: Track<RobotSample>,
    metadata: [Option<Metadata>; 2],
    exposures: ExposureTracker,
    /// Samples of the C-arm that had waited in front of its port: exposures are sought in them once their times are known.
    waiting: VecDeque<(CarmSample, Stamps)>,
    ended: bool,
}

impl Default for Timeline {
    fn default() -> Self {
        Self::new()
    }
}

/// Samples of the C-arm that wait for their time, at most: two minutes of them.
const MOST_WAITING: usize = 4096;
/// Closed exposures younger than this many are asked again for what other devices measured.
const FILLED_BACK: usize = 32;
/// Samples further apart than this around an exposure tell nothing of its beam.
const BEAM_GAP_US: i64 = 500_000;
/// An exposure takes joints and angles only from samples nearer than this to its middle.
const EXPOSURE_REACH_US: i64 = 500_000;

impl Timeline {
    /// Empty, with the usual retention.
    #[must_use]
    pub fn new() -> Self {
        Self::with_retention(Retention::default())
    }

    /// Empty; samples are kept as `retention` says.
    #[must_use]
    pub fn with_retention(retention: Retention) -> Self {
        Self {
            carm: Track::new(retention),
            robot: Track::new(retention),
            metadata: [None, None],
            exposures: ExposureTracker::default(),
            waiting: VecDeque::new(),
            ended: false,
        }
    }

    /// `device` has no clock: the times of its samples are the host's at their arrival, with this standard deviation. Said before its first
    /// sample.
    pub fn keep_host_time(&mut self, device: DeviceKind, sigma_us: f64) {
        match device {
            DeviceKind::Carm => self.carm.keep_host_time(sigma_us),
            DeviceKind::Robot => self.robot.keep_host_time(sigma_us),
        }
    }

    /// Takes a decoded sample of `device` that arrived at `host_us` in opening `epoch` of its port, with the decoder's verdict on its
    /// sequence number.
    ///
    /// Returns its times, or `None` for metadata, duplicates, samples of the wrong device and samples whose time is no time.
    pub fn push_sample(
        &mut self,
        device: DeviceKind,
        host_us: i64,
        epoch: u32,
        sequenced: Sequenced,
        sample: Sample,
    ) -> Option<Stamps> {
        match (device, sample) {
            (DeviceKind::Carm, Sample::Carm(sample)) => {
                let number = (sample.sequence, sequenced);
                let (stamps, in_order) = self.carm.push(host_us, epoch, number, sample.device_us, sample.clone())?;
                if in_order {
                    self.waiting.push_back((sample, stamps));
                    let known = self.carm.clock().latest().is_none_or(|segment| segment.caught_up);
                    // Of a stretch that is over nothing more will be known.
                    let waits = (!known && self.waiting.len() <= MOST_WAITING).then_some(stamps.segment);
                    self.seek_exposures(waits);
                }
                self.fill_exposures();
                Some(stamps)
            }
            (DeviceKind::Robot, Sample::Robot(sample)) => {
                let number = (sample.sequence, sequenced);
                let stamps = self.robot.push(host_us, epoch, number, sample.device_us, sample)?.0;
                self.fill_exposures();
                Some(stamps)
            }
            (_, Sample::Metadata(metadata)) => {
                match device {
                    DeviceKind::Carm => self.carm.skip(host_us, epoch, sequenced),
                    DeviceKind::Robot => self.robot.skip(host_us, epoch, sequenced),
                }
                self.metadata[device as usize] = Some(metadata);
                None
            }
            (DeviceKind::Carm, Sample::Robot(_)) | (DeviceKind::Robot, Sample::Carm(_)) => None,
        }
    }

    /// No more samples will come: what waits for a better knowledge of its time is taken as it is.
    pub fn finish(&mut self) {
        self.ended = true;
        self.seek_exposures(None);
        self.exposures.finish();
        self.fill_exposures();
    }

    /// Samples of `device` come that had waited in front of a port just opened, and nobody knows yet for how long.
    #[must_use]
    pub fn is_catching_up(&self, device: DeviceKind) -> bool {
        !self.ended && self.clock(device).latest().is_some_and(|segment| !segment.caught_up)
    }

    /// The times of a sample of `device` as they are known by now; `None` where its stretch of the clock is forgotten.
    #[must_use]
    pub fn stamps_now(&self, device: DeviceKind, stamps: &Stamps) -> Option<Stamps> {
        let Stamps { segment, epoch, device_us, host_us, .. } = *stamps;
        match device {
            DeviceKind::Carm => self.carm.stamps_of(segment, epoch, device_us, host_us),
            DeviceKind::Robot => self.robot.stamps_of(segment, epoch, device_us, host_us),
        }
    }

    fn clock(&self, device: DeviceKind) -> &DeviceClock {
        match device {
            DeviceKind::Carm => self.carm.clock(),
            DeviceKind::Robot => self.robot.clock(),
        }
    }

    /// Until when the samples of `device` tell what was, with their times known.
    #[must_use]
    pub fn told_until_us(&self, device: DeviceKind) -> Option<i64> {
        match (device, self.ended) {
            (DeviceKind::Carm, true) => self.carm.newest_mapped_us(),
            (DeviceKind::Carm, false) => self.carm.told_until_us(),
            (DeviceKind::Robot, true) => self.robot.newest_mapped_us(),
            (DeviceKind::Robot, false) => self.robot.told_until_us(),
        }
    }

    /// Seeks exposures in the samples that waited, but for those of the stretch that waits on.
    fn seek_exposures(&mut self, waits: Option<u32>) {
        let goes_on = self.waiting.iter().position(|(_, stamps)| Some(stamps.segment) == waits);
        let known: Vec<_> = self.waiting.drain(..goes_on.unwrap_or(self.waiting.len())).collect();
        for (sample, stamps) in known {
            if let Some(stamps) = self.stamps_now(DeviceKind::Carm, &stamps) {
                self.exposures.push(&sample, &stamps);
            }
        }
    }

    /// The running stretch of a device's clock: its number, and for one that began with a step by how much the clock jumped, µs.
    #[must_use]
    pub fn clock_stretch(&self, device: DeviceKind) -> Option<(u32, Option<i64>)> {
        self.clock(device).latest().map(|segment| (segment.id, (segment.start == SegmentStart::Step).then_some(segment.step_us)))
    }

    /// How many seconds the clock of `device` advances in one of the host's, where that is known and no crystal's drift.
    #[must_use]
    pub fn wrong_clock_rate(&self, device: DeviceKind) -> Option<f64> {
        self.clock(device).latest().and_then(Segment::wrong_rate)
    }

    /// Joints at a host time: linear, angles the short way round; NaN where a joint was not measured on either side.
    /// After the newest sample that one is held, before the oldest there is no answer.
    #[must_use]
    pub fn joints_at(&self, host_us: i64) -> Option<Answer<CarmJoints>> {
        let bracket = self.carm.bracket(host_us)?;
        let left = bracket.left.value.joints;
        let right = bracket.right.map_or(left, |right| right.value.joints);
        Some(bracket.answer(lerp_joints(&left, &right, bracket.fraction)))
    }

    /// Robot control angles in degrees at a host time: linear; sensed where both samples around it have them, else commanded.
    #[must_use]
    pub fn robot_at(&self, host_us: i64) -> Option<Answer<[f64; 5]>> {
        self.robot_and_source_at(host_us).map(|(answer, _)| answer)
    }

    /// As [`Timeline::robot_at`], with where the angles come from.
    #[must_use]
    pub fn robot_and_source_at(&self, host_us: i64) -> Option<(Answer<[f64; 5]>, AngleSource)> {
        let bracket = self.robot.bracket(host_us)?;
        let left = &bracket.left.value;
        let right = bracket.right.map_or(left, |right| &right.value);
        let (left_deg, right_deg, source) = match (left.control_angles_deg(), right.control_angles_deg()) {
            ((left_deg, AngleSource::Sensed), (right_deg, AngleSource::Sensed)) => (left_deg, right_deg, AngleSource::Sensed),
            _ => (left.commanded_deg, right.commanded_deg, AngleSource::Commanded),
        };
        let angles_deg = std::array::from_fn(|i| lerp(left_deg[i], right_deg[i], bracket.fraction));
        Some((bracket.answer(angles_deg), source))
    }

    /// How far each of the robot's control angles moved between two host times, beyond its sensors' noise, degrees; `None` without a
    /// sample between them.
    #[must_use]
    pub fn robot_travel_deg(&self, from_us: i64, to_us: i64) -> Option<[f64; 5]> {
        let during = self.robot.entries().rev().map(|entry| (self.robot.mapped(entry).0, &entry.value));
        let during = during.skip_while(|(at_us, _)| *at_us > to_us).take_while(|(at_us, _)| *at_us >= from_us);
        let mut travel = None;
        for (_, sample) in during {
            let (angles_deg, source) = sample.control_angles_deg();
            let readings = angles_deg.map(f64::to_radians);
            let (first_source, travel) = travel.get_or_insert_with(|| (source, Travel::of_angles(readings)));
            // From commanded to sensed is no motion.
            if *first_source == source {
                travel.push(readings);
            }
        }
        travel.map(|(_, travel)| travel.range().map(f64::to_degrees))
    }

    /// The C-arm's sample nearest a host time; `None` in silences.
    #[must_use]
    pub fn beam_at(&self, host_us: i64) -> Option<CarmSample> {
        let bracket = self.carm.bracket(host_us)?;
        let nearest = bracket.right.filter(|_| bracket.fraction > 0.5).unwrap_or(bracket.left);
        (bracket.answer(()).gap_us <= BEAM_GAP_US).then(|| nearest.value.clone())
    }

    /// Tracked robot base at a host time, along the geodesic; `None` unless both samples around it have it.
    #[must_use]
    pub fn tracker_from_base_at(&self, host_us: i64) -> Option<Answer<Rigid>> {
        let bracket = self.robot.bracket(host_us)?;
        let left = bracket.left.value.tracker_from_base?;
        let right = match bracket.right {
            Some(right) => right.value.tracker_from_base?,
            None => left,
        };
        Some(bracket.answer(left.interpolate(&right, bracket.fraction)))
    }

    /// Exposures so far, oldest first; the last one may still be open.
    #[must_use]
    pub fn exposures(&self) -> Vec<ExposureInterval> {
        self.exposures.closed().iter().chain(self.exposures.open()).cloned().collect()
    }

    /// Where exposures are found.
    #[must_use]
    pub fn exposure_tracker(&self) -> &ExposureTracker {
        &self.exposures
    }

    /// The closed exposure with this index, while it is kept.
    #[must_use]
    pub fn exposure(&self, index: u64) -> Option<&ExposureInterval> {
        let closed = self.exposures.closed();
        let at = closed.binary_search_by_key(&index, |interval| interval.index).ok()?;
        closed.get(at)
    }

    /// Whether `device` can be relied on at host time `now_us`.
    #[must_use]
    pub fn freshness(&self, device: DeviceKind, now_us: i64, limits: FreshLimits) -> Freshness {
        let last_us = match device {
            DeviceKind::Carm => self.carm.last_arrival_us(),
            DeviceKind::Robot => self.robot.last_arrival_us(),
        };
        match last_us {
            None => Freshness::Absent,
            Some(last_us) if now_us.saturating_sub(last_us) > limits.stale_us => {
                Freshness::Stale { age_us: now_us.saturating_sub(last_us) }
            }
            Some(last_us) => Freshness::Fresh { age_us: now_us.saturating_sub(last_us).max(0) },
        }
    }

    /// The latest metadata of `device`.
    #[must_use]
    pub fn metadata(&self, device: DeviceKind) -> Option<&Metadata> {
        self.metadata[device as usize].as_ref()
    }

    /// The C-arm's samples.
    #[must_use]
    pub fn carm(&self) -> &Track<CarmSample> {
        &self.carm
    }

    /// The robot's samples.
    #[must_use]
    pub fn robot(&self) -> &Track<RobotSample> {
        &self.robot
    }

    /// What each track holds.
    #[must_use]
    pub fn summaries(&self) -> [TrackSummary; 2] {
        [summary(DeviceKind::Carm, &self.carm), summary(DeviceKind::Robot, &self.robot)]
    }

    /// Completes closed exposures with what the samples around their middle say.
    fn fill_exposures(&mut self) {
        let mut exposures = std::mem::take(&mut self.exposures);
        let robot_newest_us = self.told_until_us(DeviceKind::Robot);
        for interval in exposures.closed_mut().iter_mut().rev().take(FILLED_BACK) {
            let mid_us = interval.mid_us();
            if interval.beam.is_none() {
                interval.beam = self.beam_at(mid_us).map(Box::new);
            }
            if interval.joints.is_none() {
                interval.joints = self.joints_at(mid_us).filter(|answer| answer.age_us <= EXPOSURE_REACH_US);
            }
            if interval.control_angles_deg.is_none() && robot_newest_us.is_some_and(|newest_us| newest_us >= mid_us) {
                interval.control_angles_deg = self.robot_at(mid_us).filter(|answer| answer.age_us <= EXPOSURE_REACH_US);
                interval.tracker_from_base =
                    self.tracker_from_base_at(mid_us).filter(|answer| answer.age_us <= EXPOSURE_REACH_US);
            }
        }
        self.exposures = exposures;
    }
}

fn summary<T>(device: DeviceKind, track: &Track<T>) -> TrackSummary {
    let (dropped, unusable, late) = track.dropped_unusable_late();
    let (clock_steps, resets) = track.clock().steps_and_resets();
    let segments = track.clock().summaries();
    let host_time_sigma_us = track.clock().host_sigma_us();
    let (samples, no_time) = (track.entries().len(), track.no_time());
    TrackSummary { device, samples, dropped, unusable, no_time, late, clock_steps, resets, host_time_sigma_us, segments }
}

/// Linear between two numbers; an end that is met exactly does not see the other one.
fn lerp(a: f64, b: f64, fraction: f64) -> f64 {
    if fraction == 0.0 { a } else { a + (b - a) * fraction }
}

/// Linear between two readings, angles the short way round and in (−π, π].
fn lerp_joints(a: &CarmJoints, b: &CarmJoints, fraction: f64) -> CarmJoints {
    if fraction == 0.0 {
        return *a;
    }
    let angle = |a: f64, b: f64| wrap_rad(lerp_angle_rad(a, b, fraction));
    CarmJoints {
        lift_mm: lerp(a.lift_mm, b.lift_mm, fraction),
        wig_wag_rad: angle(a.wig_wag_rad, b.wig_wag_rad),
        longitudinal_mm: lerp(a.longitudinal_mm, b.longitudinal_mm, fraction),
        angulation_rad: angle(a.angulation_rad, b.angulation_rad),
        orbital_rad: angle(a.orbital_rad, b.orbital_rad),
        detector_rotation_rad: angle(a.detector_rotation_rad, b.detector_rotation_rad),
        source_to_detector_mm: lerp(a.source_to_detector_mm, b.source_to_detector_mm, fraction),
    }
}
