//! What stands in the beam of a drawn picture besides its spheres, and what is written over it: shutters, a pelvis, rims of bones, wires, a
//! screw, a rod, letters.

use std::f64::consts::TAU;

use glam::DVec2;
use sidecarm::image::Image;

use crate::mask_matter::Matter;
use crate::pose_mistakes::Draw;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shutters {
    Open,
    Round,
    Rectangle,
    Rotated,
}

/// What lets the beam pass.
pub struct Opening {
    /// Open where `normal · x <= limit_px`.
    planes: Vec<(DVec2, f64)>,
    disc: Option<(DVec2, f64)>,
    /// From fully shut to fully open.
    pub penumbra_px: f64,
}

impl Opening {
    pub fn drawn(shutters: Shutters, size: DVec2, draw: &mut Draw) -> Self {
        let mut opening = Self { planes: Vec::new(), disc: None, penumbra_px: draw.between(0.5, 8.0) };
        let (middle, short) = (size / 2.0, size.min_element());
        match shutters {
            Shutters::Open => {}
            Shutters::Round => {
                let stray = DVec2::from_angle(draw.between(0.0, TAU)) * draw.between(0.0, 0.06) * short;
                opening.disc = Some((middle + stray, short * draw.between(0.42, 0.56)));
            }
            Shutters::Rectangle | Shutters::Rotated => {
                let turned_rad = if shutters == Shutters::Rotated { draw.sign() * draw.between(0.1, 0.7) } else { 0.0 };
                for axis in [DVec2::X, DVec2::NEG_X, DVec2::Y, DVec2::NEG_Y] {
                    let normal = DVec2::from_angle(turned_rad).rotate(axis);
                    let half_px = 0.5 * axis.abs().dot(size) * draw.between(0.62, 0.97);
                    opening.planes.push((normal, normal.dot(middle) + half_px));
                }
            }
        }
        opening
    }

    /// From half of the beam inwards.
    pub fn depth_px(&self, x: DVec2) -> f64 {
        let planes = self.planes.iter().map(|(normal, limit_px)| limit_px - normal.dot(x));
        let disc = self.disc.iter().map(|(centre, radius_px)| radius_px - centre.distance(x));
        planes.chain(disc).fold(f64::INFINITY, f64::min)
    }

    /// Of the beam.
    pub fn share(&self, x: DVec2) -> f64 {
        let share = (self.depth_px(x) / self.penumbra_px + 0.5).clamp(0.0, 1.0);
        share * share * (3.0 - 2.0 * share)
    }
}

fn anywhere(size: DVec2, draw: &mut Draw) -> DVec2 {
    DVec2::new(draw.between(0.0, 1.0), draw.between(0.0, 1.0)) * size
}

fn direction(draw: &mut Draw) -> DVec2 {
    DVec2::from_angle(draw.between(0.0, TAU))
}

/// Soft tissue, two wings that are thin in their middle, two heads, two holes, a sacrum.
pub fn pelvis(size: DVec2, draw: &mut Draw) -> Vec<Matter> {
    let short = size.min_element();
    let mut all = Vec::new();
    for _ in 0..4 {
        let (centre, spread_px) = (anywhere(size, draw), short * draw.between(0.25, 0.7));
        all.push(Matter::Blob { centre, spread_px, nepers: draw.between(0.2, 0.7) });
    }
    let middle = size * DVec2::new(draw.between(0.4, 0.6), draw.between(0.35, 0.6));
    let (tilt_rad, nepers) = (draw.between(-0.4, 0.4), draw.between(0.4, 0.9));
    let across = DVec2::from_angle(tilt_rad);
    let at = |x: f64, y: f64| middle + short * (across * x + across.perp() * y);
    for side in [-1.0, 1.0] {
        let axis = DVec2::from_angle(tilt_rad + 0.5 * side);
        let mut part = |centre: DVec2, half: DVec2, soft_px: f64, nepers: f64| {
            all.push(Matter::Ellipse { centre, axis, half: short * half, soft_px, nepers });
        };
        part(at(0.33 * side, 0.0), DVec2::new(0.17, 0.27), 8.0, nepers);
        part(at(0.33 * side, 0.0), DVec2::new(0.13, 0.2), 20.0, -0.5 * nepers);
        part(at(0.36 * side, 0.3), DVec2::splat(0.1), 3.0, 0.8 * nepers);
        part(at(0.16 * side, 0.36), DVec2::new(0.06, 0.09), 4.0, -0.4 * nepers);
    }
    let (centre, half) = (at(0.0, -0.12), short * DVec2::new(0.13, 0.2));
    all.push(Matter::Ellipse { centre, axis: across, half, soft_px: 10.0, nepers: 0.7 * nepers });
    all
}

/// Rims of bones: a shell's wall is thick where the rays touch it.
pub fn edges(size: DVec2, draw: &mut Draw) -> Vec<Matter> {
    let mut all = Vec::new();
    for _ in 0..draw.between(3.0, 7.0) as usize {
        let (centre, axis) = (anywhere(size, draw), direction(draw));
        let half = DVec2::new(draw.between(0.04, 0.15), draw.between(0.1, 0.4)) * size.min_element();
        let (soft_px, nepers) = (draw.between(0.8, 3.0), draw.between(0.2, 0.8));
        all.push(Matter::Ellipse { centre, axis, half, soft_px, nepers });
        all.push(Matter::Ellipse { centre, axis, half: 0.88 * half, soft_px: 3.0 * soft_px, nepers: -0.7 * nepers });
    }
    all
}

/// Two wires, a screw with its thread, a rod.
pub fn metal(size: DVec2, draw: &mut Draw) -> Vec<Matter> {
    let mut all = Vec::new();
    for _ in 0..2 {
        let (from, along) = (anywhere(size, draw), direction(draw) * draw.between(80.0, 500.0));
        all.push(Matter::Rod { from, to: from + along, radius_px: draw.between(0.8, 2.2), nepers: draw.between(0.4, 1.5) });
    }
    let (from, along) = (anywhere(size, draw), direction(draw) * draw.between(150.0, 500.0));
    all.push(Matter::Rod { from, to: from + along, radius_px: draw.between(8.0, 24.0), nepers: draw.between(2.5, 5.0) });
    let (from, along) = (anywhere(size, draw), direction(draw));
    let (length_px, radius_px) = (draw.between(60.0, 120.0), draw.between(4.0, 7.0));
    all.push(Matter::Rod { from, to: from + along * length_px, radius_px, nepers: draw.between(1.5, 3.0) });
    let ridge = DVec2::from_angle(0.3).rotate(along.perp()) * 1.35 * radius_px;
    for n in 0..(length_px / 6.0) as usize {
        let middle = from + along * (6.0 * n as f64 + 3.0);
        all.push(Matter::Rod { from: middle - ridge, to: middle + ridge, radius_px: 1.3, nepers: 0.8 });
    }
    all
}

/// Letters of 5 × 7 dots near the border; gives the first and the last of their pixels.
pub fn write(pixels: &mut Image<f32>, ink: f32, draw: &mut Draw) -> [DVec2; 2] {
    let (dot, letters) = (draw.one_of(&[1, 2]), draw.between(2.0, 12.0) as usize);
    let (width, height) = (6 * dot * letters, 7 * dot);
    let (free_x, free_y) = (pixels.width.saturating_sub(width + 8), pixels.height.saturating_sub(height + 8));
    let (left, top) = (4 + draw.one_of(&[0, free_x, free_x / 2]), 4 + draw.one_of(&[0, free_y, free_y / 8]));
    for cell in 0..35 * letters {
        if draw.chance(0.5) {
            continue;
        }
        let (letter, bit) = (cell / 35, cell % 35);
        for n in 0..dot * dot {
            let (column, row) = (left + (6 * letter + bit % 5) * dot + n % dot, top + bit / 5 * dot + n / dot);
            if column < pixels.width && row < pixels.height {
                *pixels.at_mut(column, row) = ink;
            }
        }
    }
    [DVec2::new(left as f64, top as f64), DVec2::new((left + width) as f64, (top + height) as f64)]
}
