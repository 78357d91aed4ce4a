//! The robot at an exposure, by its telemetry, and what a person should know before relying on how it is drawn.

use super::crosscheck::APART_DEG;
use crate::geometry::Rigid;
use crate::telemetry::AngleSource;
use crate::timeline::{Binding, BindingFlag, ExposureInterval, LONG_BEAM_US, Support, Timeline};

/// Robot or C-arm samples further apart than this around an exposure say nothing of it.
pub(super) const MAX_GAP_US: i64 = 500_000;
/// A control angle that changes by more than this while the beam is on moves the tip by more than its sensors' noise does.
const BENT_DEG: f64 = 0.5;

/// The robot's shape at the exposure.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotState {
    /// The five control angles, degrees.
    pub control_angles_deg: [f64; 5],
    /// Pose of the robot's base, when it is tracked and the tracker is tied to the specimen.
    pub lps_from_base: Option<Rigid>,
    /// `sensed` or `commanded`.
    pub source: String,
    /// Span of the samples that were interpolated.
    pub gap_us: i64,
    /// Why it may be otherwise than it is drawn.
    pub cautions: Vec<RobotCaution>,
}

/// Why a robot of which telemetry tells may be otherwise than it is drawn.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum RobotCaution {
    /// The base is tracked, and where the tracker stands is not known.
    TrackerUntied,
    /// The base is tracked, and where the specimen lies is not known yet.
    SpecimenUntied,
    /// The session counts on a tracked base, and it was not seen.
    BaseNotTracked,
    /// The tracked base is older than this at the exposure.
    BaseStale {
        /// Between the samples around the exposure, or since the last one.
        gap_us: i64,
    },
    /// The angles are those that were asked for.
    Commanded,
    /// Sensed and commanded angles contradict each other.
    Apart {
        /// Control point, from 0.
        point: usize,
        /// Sensed minus commanded.
        apart_deg: f64,
    },
    /// The robot moved while the beam was on.
    Bent {
        /// Control point that moved most, from 0.
        point: usize,
        /// By how much.
        moved_deg: f64,
    },
    /// It is drawn as it was in the middle of a long beam, and may have been otherwise in the picture.
    InMiddle {
        /// How long the beam was on.
        beam_us: i64,
    },
}

impl RobotCaution {
    /// Warnings are counted by this.
    #[must_use]
    pub fn kind(&self) -> &'static str {
        match self {
            Self::TrackerUntied | Self::SpecimenUntied => "robot base not tied",
            Self::BaseNotTracked | Self::BaseStale { .. } => "robot base not tracked",
            Self::Commanded => "robot angles commanded",
            Self::Apart { .. } => "robot angles contradict",
            Self::Bent { .. } | Self::InMiddle { .. } => "robot moved during the exposure",
        }
    }

    /// What a person can do about it.
    #[must_use]
    pub fn remedy(&self) -> &'static str {
        match self {
            Self::TrackerUntied => "give world_from_tracker in the session",
            Self::SpecimenUntied => "give world_from_lps in the session, or take frames whose beads are accepted",
            Self::BaseNotTracked | Self::BaseStale { .. } => "clear the tracker's view of the robot's marker and expose again",
            Self::Commanded => "check the robot's encoders and their cable",
            Self::Apart { .. } => "home the robot, check its tendons and encoders",
            Self::Bent { .. } | Self::InMiddle { .. } => "let the robot come to rest before the exposure",
        }
    }
}

impl std::fmt::Display for RobotCaution {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        const AT_SCENE: &str = "robot drawn at the scene's base";
        match self {
            Self::TrackerUntied => write!(f, "{AT_SCENE}: it is tracked, but the session has no world_from_tracker"),
            Self::SpecimenUntied => write!(f, "{AT_SCENE}: it is tracked, but the specimen is not tied to the room yet"),
            Self::BaseNotTracked => write!(f, "{AT_SCENE}: the tracker did not see it at the exposure"),
            Self::BaseStale { gap_us } => {
                write!(f, "{AT_SCENE}: the tracker told nothing of it for {:.1} s around the exposure", *gap_us as f64 * 1e-6)
            }
            Self::Commanded => f.write_str("robot drawn with commanded angles: they were not sensed at the exposure"),
            Self::Apart { point, apart_deg } => write!(
                f,
                "the robot sensed {apart_deg:+.1} degrees more than was commanded at control point {}: one of the two is wrong, the sensed \
                 angles are drawn",
                point + 1
            ),
            Self::Bent { point, moved_deg } => {
                write!(f, "the robot bent by {moved_deg:.1} degrees at control point {} during the exposure", point + 1)
            }
            Self::InMiddle { beam_us } => write!(
                f,
                "robot drawn as it was in the middle of a beam of {:.1} s: a last image held shows it as it was at the end",
                *beam_us as f64 * 1e-6
            ),
        }
    }
}

/// The robot when its exposure was bound: all but its base in `lps`, which the tie to the room decides.
#[derive(Clone, Debug)]
pub(super) struct BoundRobot {
    state: RobotState,
    /// The tracked base and the span of its samples.
    tracked: Option<(Rigid, i64)>,
}

impl BoundRobot {
    /// What `timeline`, or the exposure itself where the samples are gone, says of the robot at `mid_us`, for a frame bound so; `None` where
    /// it was not heard around then. `mid_us` is when the frame was taken.
    pub(super) fn at(timeline: &Timeline, mid_us: i64, binding: &Binding) -> Option<Self> {
        let exposure = binding.exposure.as_ref();
        if !stood_still(timeline, mid_us, binding) {
            return None;
        }
        let live = live(timeline, mid_us);
        // What is kept with an exposure is of its middle.
        let of_middle = live.is_none() && binding.is_of_last_image();
        let mut state = live.or_else(|| stored(exposure?))?;
        // An image of a run is exposed for a part of it only, and nobody saw how long an exposure was of which only a counter tells.
        let is_run = binding.flags.iter().any(|flag| matches!(flag, BindingFlag::Run { .. }));
        let whole = exposure.filter(|exposure| exposure.samples > 0 && !is_run);
        if let Some(exposure) = whole {
            let beam_us = exposure.end_us.saturating_sub(exposure.start_us);
            let half_us = binding.half_image_us().filter(|_| binding.is_of_last_image());
            let span_us = half_us.map_or([exposure.start_us, exposure.end_us], |half_us| {
                [mid_us.saturating_sub(half_us), mid_us.saturating_add(half_us)]
            });
            let bent = bent(timeline, span_us);
            let doubtful = of_middle || bent.is_some() && half_us.is_none() && beam_us >= LONG_BEAM_US;
            state.cautions.extend(bent);
            state.cautions.extend(doubtful.then_some(RobotCaution::InMiddle { beam_us }));
        }
        if let Some(span_us) = binding.counted_span_us(timeline) {
            state.cautions.extend(bent(timeline, span_us));
        }
        let tracked = timeline.tracker_from_base_at(mid_us).or_else(|| exposure.and_then(|exposure| exposure.tracker_from_base));
        Some(Self { state, tracked: tracked.map(|answer| (answer.value, answer.gap_us)) })
    }

    /// The state with its base, where tracker and specimen are tied to the room.
    pub(super) fn in_lps(self, world_from_tracker: Option<Rigid>, world_from_lps: Option<Rigid>) -> RobotState {
        let Self { mut state, tracked } = self;
        let placed = match (tracked, world_from_tracker, world_from_lps) {
            (None, None, _) => return state,
            (None, Some(_), _) => Err(RobotCaution::BaseNotTracked),
            (Some((_, gap_us)), _, _) if gap_us > MAX_GAP_US => Err(RobotCaution::BaseStale { gap_us }),
            (Some(_), None, _) => Err(RobotCaution::TrackerUntied),
            (Some(_), Some(_), None) => Err(RobotCaution::SpecimenUntied),
            (Some((base, _)), Some(world_from_tracker), Some(world_from_lps)) => {
                Ok(world_from_lps.inverse() * world_from_tracker * base)
            }
        };
        match placed {
            Ok(lps_from_base) => state.lps_from_base = Some(lps_from_base),
            Err(caution) => state.cautions.insert(0, caution),
        }
        state
    }
}

/// Whether the robot stood as it did at `mid_us` in all the time in which the frame may have been taken, where nobody knows when it was: an
/// exposure that telemetry missed, or whose begin or end it missed, or a clock that may have stood still.
fn stood_still(timeline: &Timeline, mid_us: i64, binding: &Binding) -> bool {
    // A beam that a count began was on then: the robot that moved meanwhile is drawn, and that it did is said.
    let is_counted = binding.counted_span_us(timeline).is_some();
    let unseen = binding.flags.iter().find_map(|flag| match flag {
        BindingFlag::Unseen { within_us } if !is_counted => Some(*within_us / 2),
        _ => None,
    });
    let (mut from_us, mut to_us) =
        unseen.map_or((mid_us, mid_us), |half_us| (mid_us.saturating_sub(half_us), mid_us.saturating_add(half_us)));
    // The time of an exposure that was not seen at all is narrowed by what the console says of it.
    if let Some(exposure) = binding.exposure.as_ref().filter(|_| unseen.is_none()) {
        let [begin_us, end_us] = [exposure.start_uncertainty_us, exposure.end_uncertainty_us].map(|sigma_us| sigma_us as i64);
        if begin_us.max(end_us) > MAX_GAP_US / 2 {
            from_us = from_us.min(exposure.start_us.saturating_sub(begin_us));
            to_us = to_us.max(exposure.end_us.saturating_add(end_us));
        }
    }
    let clock_us = timeline.robot_at(mid_us).map_or(0, |answer| answer.uncertainty_us as i64);
    if clock_us > MAX_GAP_US / 2 {
        from_us = from_us.saturating_sub(clock_us);
        to_us = to_us.saturating_add(clock_us);
    }
    if to_us.saturating_sub(from_us) <= MAX_GAP_US {
        return true;
    }
    let travel_deg = timeline.robot_travel_deg(from_us, to_us);
    travel_deg.is_some_and(|travel_deg| travel_deg.into_iter().all(|deg| deg <= BENT_DEG))
}

fn live(timeline: &Timeline, mid_us: i64) -> Option<RobotState> {
    let (answer, source) = timeline.robot_and_source_at(mid_us)?;
    // How the robot stood before it was last heard is not how it stood at the exposure.
    let fresh = answer.gap_us <= MAX_GAP_US && answer.support == Support::Between;
    if !(fresh && answer.value.iter().all(|angle| angle.is_finite())) {
        return None;
    }
    let (source, caution) = match source {
        AngleSource::Sensed => ("sensed", apart(timeline, mid_us)),
        AngleSource::Commanded => ("commanded", Some(RobotCaution::Commanded)),
    };
    Some(RobotState {
        control_angles_deg: answer.value,
        lps_from_base: None,
        source: source.to_owned(),
        gap_us: answer.gap_us,
        cautions: caution.into_iter().collect(),
    })
}

fn stored(exposure: &ExposureInterval) -> Option<RobotState> {
    let answer = exposure.control_angles_deg.filter(|answer| answer.gap_us <= MAX_GAP_US)?;
    if !answer.value.iter().all(|angle| angle.is_finite()) {
        return None;
    }
    Some(RobotState {
        control_angles_deg: answer.value,
        lps_from_base: None,
        source: "stored with the exposure".to_owned(),
        gap_us: answer.gap_us,
        cautions: Vec::new(),
    })
}

/// Of the sample nearest the middle of the exposure.
fn apart(timeline: &Timeline, mid_us: i64) -> Option<RobotCaution> {
    let bracket = timeline.robot().bracket(mid_us)?;
    let nearest = bracket.right.filter(|_| bracket.fraction > 0.5).unwrap_or(bracket.left);
    let (point, apart_deg) = nearest.value.sensed_from_commanded_deg()?;
    (apart_deg.abs() > APART_DEG).then_some(RobotCaution::Apart { point, apart_deg })
}

fn bent(timeline: &Timeline, [from_us, to_us]: [i64; 2]) -> Option<RobotCaution> {
    let travel_deg = timeline.robot_travel_deg(from_us, to_us)?;
    // An angle that was not measured is NaN here; that it moved is not known.
    let (point, moved_deg) =
        travel_deg.into_iter().enumerate().filter(|(_, deg)| *deg > BENT_DEG).max_by(|(_, a), (_, b)| a.total_cmp(b))?;
    Some(RobotCaution::Bent { point, moved_deg })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::{CarmSample, DeviceKind, RobotSample, Sample, SequenceTracker, Tendon};

    /// The beam is on from 1000 to 1400 ms.
    const MID_US: i64 = 1_200_000;

    fn carm(ms: u64, off_ms: u64) -> Sample {
        Sample::Carm(CarmSample {
            device_us: 1000 * ms,
            sequence: (ms / 20) as u32,
            xray_on: (1000..off_ms).contains(&ms),
            exposure_counter: Some(u32::from(ms >= 1000)),
            ..CarmSample::UNTOLD
        })
    }

    /// A robot of 100 Hz that says the same but for what `change` does at a time in ms.
    fn bound(change: impl Fn(u64, &mut RobotSample)) -> BoundRobot {
        let (timeline, exposure) = told(0, change);
        BoundRobot::at(&timeline, MID_US, &Binding { exposure, ..Binding::default() }).expect("the robot was heard")
    }

    /// The same in a beam that is on for `longer_ms` more, and that beam.
    fn told(longer_ms: u64, change: impl Fn(u64, &mut RobotSample)) -> (Timeline, Option<ExposureInterval>) {
        let mut timeline = Timeline::new();
        let (mut of_carm, mut of_robot) = (SequenceTracker::default(), SequenceTracker::default());
        for ms in (0..2000 + longer_ms).step_by(10) {
            let host_us = 1000 * ms as i64;
            if ms % 20 == 0 {
                let sample = carm(ms, 1400 + longer_ms);
                let sequenced = of_carm.take(sample.sequence(), sample.device_us());
                timeline.push_sample(DeviceKind::Carm, host_us, 0, sequenced, sample);
            }
            let tendon = Tendon { position_mm: 0.0, velocity_mm_per_s: 0.0, tension_n: 1.0, current_a: 0.1 };
            // Encoder noise that is never the same twice in a row.
            let noise_deg = 0.03 * (ms as f64 * 0.7).sin();
            let mut sample = RobotSample {
                device_us: 1000 * ms,
                sequence: (ms / 10) as u32,
                commanded_deg: [1.0, 2.0, 0.5, -1.0, 0.0],
                sensed_deg: Some([1.1, 2.0 + noise_deg, 0.5, -1.0 - noise_deg, 0.1]),
                tendons: [tendon; 2],
                tracker_from_base: None,
                drill_rpm: 0.0,
                status: 0,
            };
            change(ms, &mut sample);
            let sequenced = of_robot.take(sample.sequence, sample.device_us);
            timeline.push_sample(DeviceKind::Robot, host_us, 0, sequenced, Sample::Robot(sample));
        }
        let exposure = timeline.exposures().into_iter().next();
        assert!(exposure.as_ref().is_some_and(|exposure| exposure.samples >= 15), "{exposure:?}");
        (timeline, exposure)
    }

    /// A last image held was drawn with the robot of the middle of its beam.
    #[test]
    fn the_last_image_of_a_long_beam_has_the_robot_of_its_end_and_of_any_other_picture_it_is_said() {
        // In its fourth second the robot bends by nine degrees, and then stands still; the beam is on until 5.4 s.
        let bends = |ms: u64, robot: &mut RobotSample| {
            let done = 9.0 * (ms.clamp(3000, 4000) - 3000) as f64 / 1000.0;
            robot.commanded_deg[3] += done;
            robot.sensed_deg.iter_mut().for_each(|angles| angles[3] += done);
        };
        let (timeline, exposure) = told(4000, bends);
        let beam_us = exposure.as_ref().map_or(0, |exposure| exposure.end_us - exposure.start_us);
        assert!((4_300_000..4_500_000).contains(&beam_us), "{beam_us}");
        let at = |time_us: i64, flags: Vec<BindingFlag>| {
            let binding = Binding { exposure: exposure.clone(), time_us: Some(time_us), flags, ..Binding::default() };
            BoundRobot::at(&timeline, time_us, &binding).expect("the robot was heard").state
        };
        let held = at(5_300_000, vec![BindingFlag::LastImage { beam_us }]);
        assert!((held.control_angles_deg[3] - 8.0).abs() < 0.1 && held.cautions.is_empty(), "{held:?}");
        // The control: nothing says that it is the last image.
        let plain = at(3_200_000, Vec::new());
        assert!((plain.control_angles_deg[3] - 0.8).abs() < 0.1, "{plain:?}");
        let is_said = |cautions: &[RobotCaution]| matches!(cautions, [RobotCaution::Bent { point: 3, .. }, RobotCaution::InMiddle { beam_us: of }] if *of == beam_us);
        assert!(is_said(&plain.cautions), "{plain:?}");
        assert!(plain.cautions[1].to_string().contains("in the middle of a beam of 4.4 s"), "{}", plain.cautions[1]);
        // While it still bends, the last image shows that it does.
        let bending = at(3_500_000, vec![BindingFlag::LastImage { beam_us }]);
        assert!(matches!(bending.cautions[..], [RobotCaution::Bent { point: 3, .. }]), "{bending:?}");
        let still = told(4000, |_, _| ());
        let binding = Binding { exposure: still.1, ..Binding::default() };
        let still = BoundRobot::at(&still.0, 3_200_000, &binding).expect("the robot was heard");
        assert_eq!(still.state.cautions, [], "a robot that stands still");
    }

    #[test]
    fn what_was_sensed_at_the_exposure_is_held_against_what_was_commanded() {
        assert_eq!(bound(|_, _| ()).state.cautions, []);
        let commanded = bound(|ms, robot| robot.sensed_deg = robot.sensed_deg.filter(|_| ms < 900)).state;
        assert_eq!((commanded.source.as_str(), &commanded.cautions[..]), ("commanded", &[RobotCaution::Commanded][..]));
        let apart = bound(|_, robot| robot.commanded_deg[2] += 3.0).state.cautions;
        assert!(
            matches!(apart[..], [RobotCaution::Apart { point: 2, apart_deg }] if (apart_deg + 3.0).abs() < 0.01),
            "{apart:?}"
        );
        assert!(apart[0].to_string().contains("-3.0 degrees more than was commanded at control point 3"), "{}", apart[0]);
        assert_eq!(bound(|_, robot| robot.commanded_deg[2] += 1.8).state.cautions, []);
    }

    #[test]
    fn a_robot_that_bends_while_the_beam_is_on_says_so_and_one_that_does_before_does_not() {
        let bends = |from_ms: u64, to_ms: u64, by_deg: f64| {
            let cautions = bound(|ms, robot| {
                let done = (ms.clamp(from_ms, to_ms) - from_ms) as f64 / (to_ms - from_ms) as f64;
                robot.commanded_deg[3] += by_deg * done;
                robot.sensed_deg.iter_mut().for_each(|angles| angles[3] += by_deg * done);
            });
            cautions.state.cautions
        };
        let during = bends(1000, 1400, 1.5);
        assert!(
            matches!(during[..], [RobotCaution::Bent { point: 3, moved_deg }] if (1.0..1.7).contains(&moved_deg)),
            "{during:?}"
        );
        assert_eq!(bends(200, 900, 6.0), []);
        assert_eq!(bends(1500, 1900, 6.0), []);
        assert_eq!(bends(1000, 1400, 0.3), []);
        // Angles that end in the middle are another reading, not a motion; those that were not measured say nothing.
        let switched = bound(|ms, robot| {
            robot.commanded_deg[0] += 1.5;
            robot.sensed_deg = robot.sensed_deg.filter(|_| ms < 1100);
        });
        assert_eq!(switched.state.cautions, [RobotCaution::Commanded]);
    }

    #[test]
    fn a_tracked_base_that_cannot_be_used_is_said_and_one_that_can_is_silent() {
        let base = Rigid::translation(glam::DVec3::new(1.0, 2.0, 3.0));
        let tracked = bound(|_, robot| robot.tracker_from_base = Some(base));
        let lost = bound(|ms, robot| robot.tracker_from_base = Some(base).filter(|_| ms < 1100));
        let never = bound(|_, _| ());
        let one = Some(Rigid::IDENTITY);
        let cautions = |robot: &BoundRobot, tracker: Option<Rigid>, lps: Option<Rigid>| {
            let state = robot.clone().in_lps(tracker, lps);
            assert_eq!(state.lps_from_base.is_some(), tracker.and(lps).is_some() && state.cautions.is_empty(), "{state:?}");
            state.cautions
        };
        assert_eq!(cautions(&tracked, one, one), []);
        assert_eq!(cautions(&tracked, None, one), [RobotCaution::TrackerUntied]);
        assert_eq!(cautions(&tracked, one, None), [RobotCaution::SpecimenUntied]);
        assert_eq!(cautions(&lost, one, one), [RobotCaution::BaseNotTracked]);
        assert_eq!(cautions(&never, one, one), [RobotCaution::BaseNotTracked]);
        assert_eq!(cautions(&never, None, one), [], "nobody counts on a tracker");
        let old = BoundRobot { tracked: Some((base, 700_000)), ..tracked };
        assert_eq!(cautions(&old, one, one), [RobotCaution::BaseStale { gap_us: 700_000 }]);
    }
}
