//! What scenes and phantoms are drawn with.

use glam::{DMat3, DQuat, DVec3};

use crate::random::Stream;

/// Numbers, directions and choices of a stream.
pub(super) struct Draw(pub Stream);

impl Draw {
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.0.uniform()
    }

    pub fn between3(&mut self, low: DVec3, high: DVec3) -> DVec3 {
        DVec3::new(self.between(low.x, high.x), self.between(low.y, high.y), self.between(low.z, high.z))
    }

    pub fn chance(&mut self, share: f64) -> bool {
        self.0.uniform() < share
    }

    /// From 0 up to but not including `below`, which is at least 1.
    pub fn count(&mut self, below: usize) -> usize {
        ((self.0.uniform() * below as f64) as usize).min(below - 1)
    }

    pub fn one_of<T: Copy>(&mut self, list: &[T]) -> T {
        list[self.count(list.len())]
    }

    pub fn rotation(&mut self) -> DQuat {
        DQuat::from_xyzw(self.0.normal(), self.0.normal(), self.0.normal(), self.0.normal()).normalize()
    }

    pub fn direction(&mut self) -> DVec3 {
        DVec3::new(self.0.normal(), self.0.normal(), self.0.normal()).normalize_or(DVec3::Z)
    }

    /// About any axis by up to half a turn.
    pub fn turn(&mut self) -> DMat3 {
        DMat3::from_axis_angle(self.direction(), self.between(0.0, std::f64::consts::PI))
    }
}
