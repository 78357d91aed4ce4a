//! What a log says of telemetry for Foxglove alone: joints by name and the frame tree, a few times a second. Nothing here is read again.

use super::log::SessionLog;
use super::whereabouts::Whereabouts;
use crate::geometry::Rigid;
use crate::record::Placed;
use crate::telemetry::{CarmSample, RobotSample, Sample};

/// Of each device, one sample in so long.
const STEP_US: i64 = 100_000;

/// See the module.
pub(super) struct Onlooker {
    whereabouts: Whereabouts,
    next_us: [i64; 2],
}

impl Onlooker {
    pub(super) fn new(whereabouts: Whereabouts) -> Self {
        Self { whereabouts, next_us: [i64::MIN; 2] }
    }

    /// A sample of either device; `world_from_lps` is what is known of the specimen now.
    pub(super) fn sample(&mut self, log: &SessionLog, host_us: i64, sample: &Sample, world_from_lps: Option<Rigid>) {
        let next_us = match sample {
            Sample::Carm(_) => &mut self.next_us[0],
            Sample::Robot(_) => &mut self.next_us[1],
            Sample::Metadata(_) => return,
        };
        if host_us < *next_us {
            return;
        }
        *next_us = host_us.saturating_add(STEP_US);
        match sample {
            Sample::Carm(sample) => self.carm(log, host_us, sample),
            Sample::Robot(sample) => self.robot(log, host_us, sample, world_from_lps),
            Sample::Metadata(_) => {}
        }
    }

    fn carm(&self, log: &SessionLog, host_us: i64, sample: &CarmSample) {
        let joints = &sample.joints;
        let metres = |mm: f64| mm / 1000.0;
        let named = [
            ("lift", metres(joints.lift_mm)),
            ("wig_wag", joints.wig_wag_rad),
            ("longitudinal", metres(joints.longitudinal_mm)),
            ("angulation", joints.angulation_rad),
            ("orbital", joints.orbital_rad),
            ("detector_rotation", joints.detector_rotation_rad),
            ("source_to_detector", metres(joints.source_to_detector_mm)),
        ];
        let camera = self.whereabouts.world_from_camera(sample);
        let placed = camera.map(|parent_from_child| Placed::new("world", "camera_by_telemetry", parent_from_child));
        log.onlooker("carm", host_us, &named, placed.as_slice());
    }

    fn robot(&self, log: &SessionLog, host_us: i64, sample: &RobotSample, world_from_lps: Option<Rigid>) {
        const CONTROLS: [&str; 5] = ["control_1", "control_2", "control_3", "control_4", "control_5"];
        let (angles_deg, _) = sample.control_angles_deg();
        let named: [(&str, f64); 5] = std::array::from_fn(|n| (CONTROLS[n], angles_deg[n].to_radians()));
        let Some(place) = self.whereabouts.robot(sample, world_from_lps) else {
            return log.onlooker("robot", host_us, &named, &[]);
        };
        let mut placed = vec![Placed::new("lps", "base", place.lps_from_base)];
        if let Some(shape) = &place.shape {
            let pieces = shape.base_from_pieces.iter().enumerate();
            placed.extend(pieces.map(|(n, (base_from_piece, _))| Placed::new("base", format!("piece_{n:02}"), *base_from_piece)));
            placed.push(Placed::new("base", "tip", shape.base_from_tip));
        }
        log.onlooker("robot", host_us, &named, &placed);
    }
}
