//! Which frames share a distortion: those taken at one angle of the C-arm.

use crate::calibrate::intensifier::error::IntensifierFault;
use crate::calibrate::intensifier::frames::GridFrame;
use crate::geometry::{AnglesDeg, same_angle};

/// Frames of one angle.
#[derive(Clone, Debug, PartialEq)]
pub struct AtOneAngle {
    /// That of the first of them.
    pub angles_deg: Option<AnglesDeg>,
    /// Among the frames given.
    pub frames: Vec<usize>,
}

/// Groups of frames, in the order of their first; frames of which none states an angle are all taken at one.
///
/// # Errors
/// When some frames state their angle and others do not.
pub fn by_angle(frames: &[GridFrame]) -> Result<Vec<AtOneAngle>, IntensifierFault> {
    let all = AtOneAngle { angles_deg: None, frames: (0..frames.len()).collect() };
    if frames.iter().all(|frame| frame.angles_deg.is_none()) {
        return Ok(vec![all]);
    }
    let mut groups: Vec<AtOneAngle> = Vec::new();
    for (n, frame) in frames.iter().enumerate() {
        let angles_deg = frame.angles_deg.ok_or_else(|| IntensifierFault::NoAngle { frame: frame.frame.name.clone() })?;
        let near = |group: &&mut AtOneAngle| group.angles_deg.is_some_and(|other| same_angle(other, angles_deg));
        match groups.iter_mut().find(near) {
            Some(group) => group.frames.push(n),
            None => groups.push(AtOneAngle { angles_deg: Some(angles_deg), frames: vec![n] }),
        }
    }
    Ok(groups)
}
