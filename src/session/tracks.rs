//! What the report shows besides what is made of frames: joints and angles over time, how each line did, and what persons noted.

use std::collections::BTreeMap;

use super::edit::take_note;
use super::engine::Engine;
use crate::geometry::CarmJoints;
use crate::report::{Gap, LinkReport, Track};
use crate::telemetry::{DeviceKind, Metadata, Sample, status_words};

/// Tracks are drawn with at most one sample per this, at first.
const TRACK_STEP_US: i64 = 100_000;
/// Samples kept of a track; when there are more, every second one goes and the step doubles.
const MOST_SAMPLES: usize = 20_000;

/// What a sample says of the device that the one before did not, in words.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum News {
    /// Worth a warning.
    Told(String),
    /// Whatever rests on the device's calibration is lost from here on.
    Lost(String),
}

/// Values at a bounded number of times.
#[derive(Debug)]
struct Thinned<T> {
    step_us: i64,
    values: Vec<(i64, T)>,
}

impl<T> Thinned<T> {
    fn new() -> Self {
        Self { step_us: TRACK_STEP_US, values: Vec::new() }
    }

    fn push(&mut self, host_us: i64, value: T) {
        if self.values.last().is_some_and(|(last_us, _)| host_us.saturating_sub(*last_us) < self.step_us) {
            return;
        }
        self.values.push((host_us, value));
        if self.values.len() > MOST_SAMPLES {
            let mut index = 0;
            self.values.retain(|_| {
                index += 1;
                index % 2 == 1
            });
            self.step_us *= 2;
        }
    }
}

/// See the module.
#[derive(Debug)]
pub(super) struct Tracks {
    links: BTreeMap<DeviceKind, LinkReport>,
    joints: Thinned<CarmJoints>,
    angles: Thinned<[f64; 5]>,
    /// The latest status words.
    status: BTreeMap<DeviceKind, u32>,
    /// Serial number and calibration that each device named last.
    named: BTreeMap<DeviceKind, [String; 2]>,
    /// By the frame's number.
    notes: BTreeMap<u32, String>,
}

impl Tracks {
    pub(super) fn new() -> Self {
        Self {
            links: BTreeMap::new(),
            joints: Thinned::new(),
            angles: Thinned::new(),
            status: BTreeMap::new(),
            named: BTreeMap::new(),
            notes: BTreeMap::new(),
        }
    }

    /// What a person noted of a frame.
    pub(super) fn noted(&mut self, number: u32, words: &str) {
        take_note(&mut self.notes, number, words);
    }

    /// The note of a frame.
    pub(super) fn note(&self, number: u32) -> Option<&str> {
        self.notes.get(&number).map(String::as_str)
    }

    fn link(&mut self, device: DeviceKind) -> &mut LinkReport {
        self.links.entry(device).or_insert_with(|| LinkReport {
            device: device.key().to_owned(),
            first_us: None,
            last_us: None,
            counters: Vec::new(),
            gaps: Vec::new(),
        })
    }

    pub(super) fn line_lost(&mut self, device: DeviceKind, host_us: i64, reason: &str) {
        let gap = Gap { start_us: host_us, end_us: host_us, reason: reason.to_owned() };
        self.link(device).gaps.push(gap);
    }

    pub(super) fn line_opened(&mut self, device: DeviceKind, host_us: i64) {
        if let Some(gap) = self.link(device).gaps.last_mut()
            && gap.end_us == gap.start_us
        {
            gap.end_us = host_us;
        }
    }

    /// Takes a sample; what it says of the device that the one before did not.
    pub(super) fn sample(&mut self, host_us: i64, sample: &Sample) -> Option<News> {
        let (device, status) = match sample {
            Sample::Carm(carm) => {
                self.joints.push(host_us, carm.joints);
                (DeviceKind::Carm, carm.status)
            }
            Sample::Robot(robot) => {
                self.angles.push(host_us, robot.control_angles_deg().0);
                (DeviceKind::Robot, robot.status)
            }
            Sample::Metadata(metadata) => return self.another(metadata),
        };
        let link = self.link(device);
        link.first_us.get_or_insert(host_us);
        link.last_us = Some(host_us);
        self.news_of(device, status).map(News::Told)
    }

    /// Whether another device answers than before. Its numbers stand in the log alone.
    fn another(&mut self, metadata: &Metadata) -> Option<News> {
        let named = [metadata.serial_number.clone(), metadata.calibration_id.clone()];
        let device = metadata.device;
        let before = self.named.insert(device, named)?;
        let [serial, calibration] = &self.named[&device];
        match (before[0] != *serial, before[1] != *calibration) {
            (true, _) => Some(News::Lost(format!(
                "the {device} is another one than before: its serial number changed, and the session's calibration is of the first"
            ))),
            (false, true) => Some(News::Told(format!("the {device} names another calibration than before"))),
            (false, false) => None,
        }
    }

    fn news_of(&mut self, device: DeviceKind, status: u32) -> Option<String> {
        let raised = status & !self.status.insert(device, status).unwrap_or(0);
        let words = status_words(device, raised);
        (!words.is_empty()).then(|| format!("the {device} reports {}", words.join(", ")))
    }

    /// Host time of the latest sample.
    pub(super) fn last_us(&self) -> Option<i64> {
        self.links.values().filter_map(|link| link.last_us).max()
    }

    /// How each line did.
    pub(super) fn links(mut self, engine: &Engine) -> (Vec<LinkReport>, Vec<Track>) {
        for device in DeviceKind::ALL {
            let Some(health) = engine.health(device) else { continue };
            let counters = serde_json::to_value(health).unwrap_or_default();
            let counters = counters.as_object().cloned().unwrap_or_default();
            let steps = engine.timeline().summaries().into_iter().filter(|track| track.device == device);
            let counted = counters.into_iter().filter_map(|(name, count)| Some((name, count.as_u64()?)));
            self.link(device).counters =
                counted.chain(steps.map(|track| ("clock_steps".to_owned(), track.clock_steps))).collect();
        }
        let tracks = drawn(&self.joints.values, &self.angles.values);
        (self.links.into_values().collect(), tracks)
    }
}

fn drawn(joints: &[(i64, CarmJoints)], angles: &[(i64, [f64; 5])]) -> Vec<Track> {
    let mut tracks = Vec::new();
    if !joints.is_empty() {
        let degrees = |name: &str, value: fn(&CarmJoints) -> f64| {
            (name.to_owned(), joints.iter().map(|(t_us, j)| (*t_us, value(j).to_degrees())).collect())
        };
        let series = vec![
            degrees("orbital", |j| j.orbital_rad),
            degrees("angulation", |j| j.angulation_rad),
            degrees("wig-wag", |j| j.wig_wag_rad),
        ];
        tracks.push(Track { title: "C-arm joints".to_owned(), unit: "deg".to_owned(), series });
    }
    if !angles.is_empty() {
        let control =
            |index: usize| (format!("control point {}", index + 1), angles.iter().map(|(t_us, a)| (*t_us, a[index])).collect());
        let series = (0..5).map(control).collect();
        tracks.push(Track { title: "Robot bending".to_owned(), unit: "deg".to_owned(), series });
    }
    tracks
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_track_is_thinned_and_still_spans_the_session() {
        let mut track = Thinned::new();
        (0..500_000i64).for_each(|index| track.push(index * 100_000, index));
        assert!(track.values.len() <= MOST_SAMPLES && track.values.len() > MOST_SAMPLES / 4, "{}", track.values.len());
        assert_eq!(track.values[0].1, 0);
        assert!(track.values.last().is_some_and(|(_, index)| *index > 490_000));
    }

    #[test]
    fn a_status_bit_is_said_when_it_rises_and_again_when_it_has_fallen_between() {
        let mut tracks = Tracks::new();
        let mut said = |device, status| tracks.news_of(device, status);
        assert_eq!(said(DeviceKind::Carm, 0), None);
        assert_eq!(said(DeviceKind::Carm, 0b11).as_deref(), Some("the C-arm reports fault, emergency stop"));
        assert_eq!(said(DeviceKind::Carm, 0b11), None, "said already");
        assert_eq!(said(DeviceKind::Carm, 0b10), None);
        assert_eq!(said(DeviceKind::Carm, 0b11).as_deref(), Some("the C-arm reports fault"));
        assert_eq!(said(DeviceKind::Robot, 0b10_0100).as_deref(), Some("the robot reports homing, status bit 5"));
    }

    #[test]
    fn a_device_that_is_another_one_is_said_once_and_without_its_number() {
        let mut tracks = Tracks::new();
        let mut says = |serial_number: &str, calibration_id: &str| {
            let metadata = Metadata {
                device_us: 0,
                sequence: 0,
                device: DeviceKind::Robot,
                schema: 0,
                serial_number: serial_number.to_owned(),
                firmware: String::new(),
                calibration_id: calibration_id.to_owned(),
                units: String::new(),
                limits: Vec::new(),
            };
            tracks.sample(0, &Sample::Metadata(metadata))
        };
        assert_eq!([says("SNAKE-9", "a"), says("SNAKE-9", "a")], [None, None]);
        let Some(News::Lost(words)) = says("SNAKE-10", "a") else { panic!("another device is a loss") };
        assert!(words.contains("the robot is another one") && !words.contains("SNAKE"), "{words}");
        assert_eq!(says("SNAKE-10", "a"), None);
        assert!(matches!(says("SNAKE-10", "b"), Some(News::Told(words)) if words.contains("another calibration")));
    }
}
