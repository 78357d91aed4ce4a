//! The frames that a distortion is measured in: of one size, each at its angle of the C-arm.

use super::error::IntensifierFault;
use crate::acquire::Frame;
use crate::geometry::{AnglesDeg, same_angle};

/// A frame of the grid, or of the phantom.
#[derive(Clone, Debug)]
pub struct GridFrame {
    /// As it was read.
    pub frame: Frame,
    /// Orbital and angulation angle, if known.
    pub angles_deg: Option<AnglesDeg>,
}

/// Whether all are of one size.
pub fn check_sizes(frames: &[GridFrame]) -> Result<(), IntensifierFault> {
    let of = |frame: &GridFrame| frame.frame.size_px;
    match frames.iter().find(|frame| of(frame) != of(&frames[0])) {
        Some(other) => {
            Err(IntensifierFault::Sizes { frame: other.frame.name.clone(), found: of(other), expected: of(&frames[0]) })
        }
        None => Ok(()),
    }
}

/// Whether all are of one size and, where there are several, each of its own known angle.
pub fn check(frames: &[GridFrame]) -> Result<(), IntensifierFault> {
    check_sizes(frames)?;
    let name = |frame: &GridFrame| frame.frame.name.clone();
    for (index, frame) in frames.iter().enumerate().filter(|_| frames.len() > 1) {
        let angles_deg = frame.angles_deg.ok_or_else(|| IntensifierFault::NoAngle { frame: name(frame) })?;
        let near = |other: &&GridFrame| other.angles_deg.is_some_and(|other| same_angle(other, angles_deg));
        if let Some(other) = frames[..index].iter().find(near) {
            return Err(IntensifierFault::SameAngle { frame: name(frame), other: name(other), angles_deg });
        }
    }
    Ok(())
}
