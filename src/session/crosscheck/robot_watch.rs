//! The robot's line during a session: measurements that end.

use super::finding::Finding;
use crate::session::file::Setup;
use crate::telemetry::{AngleSource, RobotSample};

/// What is missing for less is an occlusion or a reading that failed; an exposure that falls into it says so by itself.
const LAPSED_US: u64 = 500_000;

/// Something that was measured and may end.
#[derive(Debug, Default)]
struct Lapse {
    was_there: bool,
    /// Device time since which it is missing.
    since_us: Option<u64>,
    told: bool,
}

impl Lapse {
    /// Whether it has just been missing for long; once, until it is there again.
    fn is_news(&mut self, there: bool, device_us: u64) -> bool {
        if there {
            *self = Self { was_there: true, ..Self::default() };
            return false;
        }
        // A clock that began anew has not been without it for long.
        let since_us = self.since_us.filter(|since_us| *since_us <= device_us).unwrap_or(device_us);
        self.since_us = Some(since_us);
        let is_news = self.was_there && !self.told && device_us - since_us >= LAPSED_US;
        self.told |= is_news;
        is_news
    }
}

/// See the module.
#[derive(Debug, Default)]
pub(super) struct RobotWatch {
    sensed: Lapse,
    tracked: Lapse,
}

impl RobotWatch {
    /// What has ended, each once per ending.
    pub(super) fn take(&mut self, setup: &Setup, sample: &RobotSample) -> Vec<Finding> {
        let mut found = Vec::new();
        let (_, source) = sample.control_angles_deg();
        if self.sensed.is_news(source == AngleSource::Sensed, sample.device_us) {
            found.push(Finding::warn(
                "robot angles",
                "the robot does not sense its angles any more: from now on it is drawn as commanded, whether it goes there or not",
                "check its encoders and their cable",
            ));
        }
        let lost = self.tracked.is_news(sample.tracker_from_base.is_some(), sample.device_us);
        if lost && setup.session.world_from_tracker.is_some() {
            found.push(Finding::warn(
                "robot base lost",
                "the robot's base is not tracked any more: from now on the robot is drawn at the scene's base",
                "clear the tracker's view of the robot's marker before the next exposure",
            ));
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_ends_is_news_once_until_it_is_back_and_a_blink_is_none() {
        let mut lapse = Lapse::default();
        let told = |lapse: &mut Lapse, there: bool, from_ms: u64, to_ms: u64| {
            (from_ms..to_ms).filter(|ms| lapse.is_news(there, ms * 1000)).collect::<Vec<_>>()
        };
        assert!(told(&mut lapse, false, 0, 2000).is_empty(), "it never was there");
        assert!(told(&mut lapse, true, 2000, 3000).is_empty());
        assert!(told(&mut lapse, false, 3000, 3400).is_empty(), "a blink");
        assert!(told(&mut lapse, true, 3400, 3500).is_empty());
        assert_eq!(told(&mut lapse, false, 3500, 6000), [4000]);
        assert!(told(&mut lapse, true, 6000, 6001).is_empty());
        assert_eq!(told(&mut lapse, false, 7000, 9000), [7500], "lost again");
        // The device's clock begins anew while it is missing.
        assert!(told(&mut lapse, true, 9000, 9001).is_empty());
        assert!(told(&mut lapse, false, 9001, 9100).is_empty());
        assert_eq!(told(&mut lapse, false, 0, 2000), [500]);
    }
}
