//! A pelvis as it lies in a frame, in a few shapes: soft parts, two wings of bone with their rims, two heads, a sacrum.

use glam::DVec2;
use sidecarm::image::Image;

use crate::beads_drawn::counted;

/// An ellipse about `centre`, in shares of the frame, with an edge as wide as `soft` of it.
struct Bone {
    centre: DVec2,
    half: DVec2,
    turn: f64,
    soft: f64,
    nepers: f64,
}

const BONES: [Bone; 7] = [
    Bone { centre: DVec2::new(0.27, 0.35), half: DVec2::new(0.2, 0.3), turn: 0.5, soft: 0.08, nepers: 0.5 },
    Bone { centre: DVec2::new(0.73, 0.35), half: DVec2::new(0.2, 0.3), turn: -0.5, soft: 0.08, nepers: 0.5 },
    Bone { centre: DVec2::new(0.28, 0.36), half: DVec2::new(0.15, 0.24), turn: 0.5, soft: 0.1, nepers: -0.3 },
    Bone { centre: DVec2::new(0.72, 0.36), half: DVec2::new(0.15, 0.24), turn: -0.5, soft: 0.1, nepers: -0.3 },
    Bone { centre: DVec2::new(0.24, 0.76), half: DVec2::new(0.08, 0.1), turn: 0.0, soft: 0.2, nepers: 0.7 },
    Bone { centre: DVec2::new(0.76, 0.76), half: DVec2::new(0.08, 0.1), turn: 0.0, soft: 0.2, nepers: 0.7 },
    Bone { centre: DVec2::new(0.5, 0.3), half: DVec2::new(0.1, 0.22), turn: 0.0, soft: 0.5, nepers: 0.6 },
];

/// What stands in the beam at a place of a frame of this size.
pub fn nepers(x: DVec2, size: DVec2) -> f64 {
    let at = x / size;
    let soft = 1.3 * (-(at - DVec2::new(0.5, 0.45)).length_squared() / 0.25).exp() + 0.3 * (at.y - 0.5);
    let of = |bone: &Bone| {
        let inside = 1.0 - (DVec2::from_angle(-bone.turn).rotate(at - bone.centre) / bone.half).length();
        bone.nepers * (inside / bone.soft).clamp(0.0, 1.0)
    };
    soft + BONES.iter().map(of).sum::<f64>()
}

/// Quanta behind it, of which `passes` lets a share through at each place.
pub fn exposed(size_px: [usize; 2], quanta: f64, seed: u64, passes: impl Fn(DVec2) -> f64) -> Image<f32> {
    let [width, height] = size_px;
    let size = DVec2::new(width as f64 - 1.0, height as f64 - 1.0);
    let value = |at: usize| {
        let x = DVec2::new((at % width) as f64, (at / width) as f64);
        quanta * (-nepers(x, size)).exp() * passes(x)
    };
    counted(&Image { width, height, pixels: (0..width * height).map(value).collect() }, seed)
}
