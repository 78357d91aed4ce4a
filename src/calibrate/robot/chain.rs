//! From unknowns to the robot's axis in a frame.

use glam::{DVec2, DVec3};

use super::shot::Shot;
use crate::geometry::{CONTROL_COUNT, Rigid, RobotModel, RobotShape};

/// What a shot has of its own, in degrees: by how much its control angles differ from readings with offsets, and its bend across the
/// plane at the first and the last notch. Load does this, friction and the encoders' noise.
pub(super) const OWN: usize = CONTROL_COUNT + 2;

/// What all shots share, and what each has of its own.
#[derive(Clone, Debug)]
pub(super) struct State {
    pub carrier_from_base: Rigid,
    pub offsets_deg: [f64; CONTROL_COUNT],
    /// Of each shot.
    pub own_deg: Vec<[f64; OWN]>,
}

/// The robot in a shot.
pub(super) struct Posed {
    pub shape: RobotShape,
    pub lps_from_base: Rigid,
}

/// The shape for readings, offsets and a shot's own bend; `None` for numbers that are none.
pub(super) fn shape(model: &RobotModel, shot: &Shot, offsets_deg: &[f64], own_deg: &[f64]) -> Option<RobotShape> {
    let angles_deg = std::array::from_fn(|k| shot.readings_deg[k] + offsets_deg[k] + own_deg[k]);
    model.loaded_shape(&angles_deg, [own_deg[CONTROL_COUNT], own_deg[CONTROL_COUNT + 1]]).ok()
}

impl State {
    /// The robot in the `n`th shot.
    pub fn posed(&self, model: &RobotModel, shot: &Shot, n: usize) -> Option<Posed> {
        let shape = shape(model, shot, &self.offsets_deg, &self.own_deg[n])?;
        Some(Posed { shape, lps_from_base: shot.lps_from_carrier * self.carrier_from_base })
    }
}

/// The point of the axis `s_mm` from the base along it, in `base`; beyond the body it lies on the drill's axis.
pub(super) fn on_axis(shape: &RobotShape, s_mm: f64) -> DVec3 {
    let mut left_mm = s_mm;
    for (base_from_piece, length_mm) in &shape.base_from_pieces {
        if left_mm <= *length_mm {
            return base_from_piece.transform_point(DVec3::new(0.0, 0.0, left_mm));
        }
        left_mm -= length_mm;
    }
    shape.base_from_body_end.transform_point(DVec3::new(0.0, 0.0, left_mm))
}

/// Body and drill, mm.
pub(super) fn length_mm(model: &RobotModel) -> f64 {
    model.length_mm + model.drill.length_mm.unwrap_or(0.0)
}

impl Shot {
    /// Where a point of `lps` is seen, and its depth; `None` behind the focal spot.
    pub(super) fn image(&self, lps_mm: DVec3) -> Option<(DVec2, f64)> {
        let p = self.view.camera_from_lps.transform_point(lps_mm);
        (p.z > 1.0).then(|| (self.view.intrinsics.project(p), p.z))
    }

    /// Towards the detector, through a point of `lps`, in `carrier`.
    pub(super) fn beam_in_carrier(&self, lps_mm: DVec3) -> DVec3 {
        let focal_spot = self.view.camera_from_lps.inverse().translation_mm;
        (self.lps_from_carrier.rotation.conjugate() * (lps_mm - focal_spot)).normalize()
    }
}
