//! What a log says for Foxglove alone: joints by name, and the tree of frames. Nothing here is read again.
//!
//! ```text
//! world ─ carm ─ camera ─ lps ─ base ─ piece_00 ─ … ─ piece_27 ─ tip
//! ```
//! Each exposure places arm, camera and specimen; between exposures the arm's samples do, with the camera where the last exposure left it in
//! the arm, so that the specimen rests in the room while the arm moves. A link that is not known is left out, and the tree falls into two.

use super::log::SessionLog;
use super::posed::Posed;
use super::whereabouts::Whereabouts;
use crate::geometry::Rigid;
use crate::record::{ArmInRoom, Placed, placed_in_room};
use crate::telemetry::{CarmSample, RobotSample, Sample};

/// Of each device, one sample in so long.
const STEP_US: i64 = 100_000;

/// See the module.
pub(super) struct Onlooker {
    whereabouts: Whereabouts,
    next_us: [i64; 2],
    /// Of the latest exposure of which it is known: when that was, `carm_from_camera`, and where the specimen lay in the room.
    link: Option<(i64, Rigid, Rigid)>,
}

impl Onlooker {
    pub(super) fn new(whereabouts: Whereabouts) -> Self {
        Self { whereabouts, next_us: [i64::MIN; 2], link: None }
    }

    /// Where a frame that was posed stands in the tree; `world_from_lps` is what is known of the specimen now. Once the camera hangs on the
    /// arm, the specimen is placed only together with that link: an old link under a new pose would put it where nobody has seen it.
    pub(super) fn posed(&mut self, posed: &Posed, world_from_lps: Option<Rigid>) -> Vec<Placed> {
        let world_from_carm = posed.joints.as_ref().and_then(|joints| self.whereabouts.world_from_camera(joints));
        let arm = world_from_carm.map(|world_from_carm| ArmInRoom { world_from_carm, world_from_lps });
        let camera_from_lps = posed.view.map(|view| view.camera_from_lps);
        let link = arm.zip(camera_from_lps).and_then(|(arm, camera_from_lps)| arm.carm_from_camera(camera_from_lps));
        let is_placed = link.is_some() || self.link.is_none();
        // Frames may be posed in another order than that of their exposures.
        let is_latest = self.link.is_none_or(|(before_us, ..)| before_us <= posed.time_us);
        if let Some((link, rests)) = link.zip(world_from_lps).filter(|_| is_latest) {
            self.link = Some((posed.time_us, link, rests));
        }
        placed_in_room(arm, camera_from_lps.filter(|_| is_placed))
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
            Sample::Carm(sample) => self.carm(log, host_us, sample, world_from_lps),
            Sample::Robot(sample) => self.robot(log, host_us, sample, world_from_lps),
            Sample::Metadata(_) => {}
        }
    }

    fn carm(&self, log: &SessionLog, host_us: i64, sample: &CarmSample, world_from_lps: Option<Rigid>) {
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
        let world_from_carm = self.whereabouts.world_from_camera(joints);
        // Where nobody knows it any more, it rests where it lay.
        let world_from_lps = world_from_lps.or(self.link.map(|(_, _, rests)| rests));
        let arm = world_from_carm.map(|world_from_carm| ArmInRoom { world_from_carm, world_from_lps });
        let linked = world_from_carm.zip(self.link).zip(world_from_lps);
        let camera_from_lps = linked.map(|((carm, (_, link, _)), world_from_lps)| (carm * link).inverse() * world_from_lps);
        log.onlooker("carm", host_us, &named, &placed_in_room(arm, camera_from_lps));
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
            let pieces = (0..).zip(&shape.base_from_pieces).map(|(n, (piece, _)): (usize, _)| (format!("piece_{n:02}"), *piece));
            let (mut parent, mut base_from_parent) = ("base".to_owned(), Rigid::IDENTITY);
            for (child, base_from_child) in pieces.chain([("tip".to_owned(), shape.base_from_tip)]) {
                placed.push(Placed::new(parent, child.clone(), base_from_parent.inverse() * base_from_child));
                (parent, base_from_parent) = (child, base_from_child);
            }
        }
        log.onlooker("robot", host_us, &named, &placed);
    }
}
