//! What a device said while its port was listened to before a session, against the session and the scene.

use super::exposure::plausible_beam;
use super::filter::filter_against_scene;
use super::finding::Finding;
use super::line::check_line;
use super::robot::check_robot_line;
use crate::scene::Scene;
use crate::session::file::Setup;
use crate::telemetry::{DeviceKind, Metadata, Sample, status_words};

/// Samples of one device.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Listened {
    /// The first sample.
    pub first: Option<Sample>,
    /// The latest sample.
    pub latest: Option<Sample>,
    /// What the device said of itself.
    pub metadata: Option<Metadata>,
    /// Every status bit that was set in any sample.
    status: u32,
}

impl Listened {
    /// Takes the next sample.
    pub fn take(&mut self, sample: &Sample) {
        self.status |= match sample {
            Sample::Metadata(metadata) => {
                self.metadata = Some(metadata.clone());
                return;
            }
            Sample::Carm(sample) => sample.status,
            Sample::Robot(sample) => sample.status,
        };
        self.first.get_or_insert_with(|| sample.clone());
        self.latest = Some(sample.clone());
    }
}

/// Disagreements of what was heard with the session's models and with the scene; nothing where all agrees.
#[must_use]
pub fn check_listened(setup: &Setup, scene: Option<&Scene>, listened: &Listened) -> Vec<Finding> {
    let carm = match &listened.latest {
        Some(Sample::Carm(sample)) => Some(sample),
        _ => None,
    };
    let mut found = check_line(setup, scene, listened.metadata.as_ref(), carm);
    if let Some(sample) = carm {
        found.extend(check_status(DeviceKind::Carm, listened.status));
        found.extend(plausible_beam(sample));
        found.extend(scene.and_then(|_| filter_against_scene(sample, &setup.scene_json)));
    }
    if let Some(Sample::Robot(latest)) = &listened.latest {
        found.extend(check_status(DeviceKind::Robot, listened.status));
        let first = match &listened.first {
            Some(Sample::Robot(first)) => Some(first),
            _ => None,
        };
        found.extend(check_robot_line(setup, scene, first, latest));
    }
    found
}

fn check_status(device: DeviceKind, status: u32) -> Option<Finding> {
    let words = status_words(device, status);
    if words.is_empty() {
        return None;
    }
    let remedy = match device {
        DeviceKind::Carm => "clear it at the arm: its joints may not be where they are reported, and it may not expose",
        DeviceKind::Robot => "clear it at the robot, or wait until it has homed: its angles may not be where they are reported",
    };
    let detail = format!("the {device} reports {}", words.join(", "));
    Some(Finding::warn(&format!("{device} status"), detail, remedy))
}
