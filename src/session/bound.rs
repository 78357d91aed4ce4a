//! A bound frame: what telemetry says about it, fixed when it was bound.

use std::sync::Arc;

use super::robot_state::{BoundRobot, MAX_GAP_US};
use crate::acquire::Frame;
use crate::geometry::CarmJoints;
use crate::image::Image;
use crate::telemetry::{CarmSample, DeviceKind};
use crate::timeline::{Binding, BindingFlag, Gap, Support, Timeline};

/// A frame with what telemetry says about it, fixed when it was bound.
#[derive(Clone, Debug)]
pub struct Bound {
    pub(super) frame: Arc<Frame>,
    pub(super) time_us: i64,
    pub(super) binding: Binding,
    pub(super) joints: Option<CarmJoints>,
    pub(super) carm_gap_us: Option<i64>,
    pub(super) robot: Option<BoundRobot>,
    pub(super) beam: Option<Box<CarmSample>>,
}

/// The frame of which this one is a copy, by what it is bound to.
pub(super) fn copy_of(binding: &Binding) -> Option<u32> {
    binding.flags.iter().find_map(|flag| match flag {
        BindingFlag::Duplicate { of } => Some(*of),
        _ => None,
    })
}

impl Bound {
    /// What `timeline`, or the exposure itself where the samples are gone, says about a frame that arrived at `arrival_us`.
    #[must_use]
    pub fn new(frame: Arc<Frame>, arrival_us: i64, binding: Binding, timeline: &Timeline) -> Self {
        let binding = binding.with_beam_length(timeline, frame.tags.exposure_ms, arrival_us);
        let exposure = binding.exposure.as_ref();
        let mid_us = binding.time_us.or_else(|| exposure.map(|exposure| exposure.mid_us()));
        let joints_at =
            |us: i64| timeline.joints_at(us).filter(|answer| answer.gap_us <= MAX_GAP_US && answer.support == Support::Between);
        let joints = mid_us
            .and_then(joints_at)
            .or_else(|| exposure.and_then(|exposure| exposure.joints).filter(|answer| answer.gap_us <= MAX_GAP_US));
        let robot = mid_us.and_then(|mid_us| BoundRobot::at(timeline, mid_us, &binding));
        // Of an image of a run, and of the last one held: the joints at its beginning, in its middle, and at its end.
        let within: Option<Vec<CarmJoints>> = mid_us.zip(binding.half_image_us()).and_then(|(mid_us, half_us)| {
            let times_us = [mid_us.saturating_sub(half_us), mid_us, mid_us.saturating_add(half_us)];
            times_us.into_iter().map(|us| joints_at(us).map(|answer| answer.value)).collect()
        });
        Self {
            frame,
            time_us: mid_us.unwrap_or(arrival_us),
            joints: joints.as_ref().map(|answer| answer.value.with_plausible_distance()),
            carm_gap_us: joints.as_ref().map(|answer| answer.gap_us),
            beam: mid_us
                .and_then(|mid_us| timeline.beam_at(mid_us).map(Box::new))
                .or_else(|| exposure.and_then(|exposure| exposure.beam.clone())),
            binding: match within {
                Some(joints) => binding.moved_within(&joints),
                None => binding,
            }
            .across(joints.as_ref().and(mid_us).and_then(|mid_us| Gap::around(timeline, mid_us))),
            robot,
        }
    }

    /// The frame as it was read.
    #[must_use]
    pub fn frame(&self) -> &Arc<Frame> {
        &self.frame
    }

    /// The C-arm's sample nearest the middle of its exposure.
    #[must_use]
    pub fn beam(&self) -> Option<&CarmSample> {
        self.beam.as_deref()
    }

    /// Gives the frame other pixels and those that it had back; whoever else holds it keeps them too.
    pub(super) fn replace_pixels(&mut self, pixels: Image<f32>) -> Image<f32> {
        std::mem::replace(&mut Arc::make_mut(&mut self.frame).pixels, pixels)
    }

    /// Number of its exposure.
    #[must_use]
    pub fn exposure_index(&self) -> Option<u64> {
        self.binding.exposure.as_ref().map(|exposure| exposure.index)
    }

    /// Whether this device's telemetry says how it stood at the exposure.
    #[must_use]
    pub fn is_known_to(&self, device: DeviceKind) -> bool {
        match device {
            DeviceKind::Carm => self.joints.is_some(),
            DeviceKind::Robot => self.robot.is_some(),
        }
    }
}
