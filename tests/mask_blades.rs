//! Shutters of every shape in front of a drawn radiograph.

use glam::DVec2;

use crate::mask_draw::Draw;

/// What lets the beam pass.
pub struct Blades {
    /// Open where `normal · x <= limit_px`; normals point out of the field.
    pub planes: Vec<(DVec2, f64)>,
    pub disc: Option<(DVec2, f64)>,
    /// A rectangle with round corners: centre, half size, its first axis, radius of the corners.
    pub rounded: Option<(DVec2, DVec2, DVec2, f64)>,
}

impl Blades {
    pub fn none() -> Self {
        Self { planes: Vec::new(), disc: None, rounded: None }
    }

    pub fn depth_px(&self, x: DVec2) -> f64 {
        let mut depth = f64::INFINITY;
        for (normal, limit) in &self.planes {
            depth = depth.min(limit - normal.dot(x));
        }
        if let Some((centre, radius)) = self.disc {
            depth = depth.min(radius - (x - centre).length());
        }
        if let Some((centre, half, axis, radius)) = self.rounded {
            let local = DVec2::new(axis.dot(x - centre), axis.perp_dot(x - centre)).abs() - half + radius;
            depth = depth.min(radius - local.max(DVec2::ZERO).length() - local.max_element().min(0.0));
        }
        depth
    }
}

pub fn polygon(centre: DVec2, sides: usize, inradius: f64, turn: f64) -> Vec<(DVec2, f64)> {
    (0..sides)
        .map(|side| {
            let normal = DVec2::from_angle(turn + std::f64::consts::TAU * side as f64 / sides as f64);
            (normal, normal.dot(centre) + inradius)
        })
        .collect()
}

/// How far the frame reaches along `normal`: the least and the most of `normal · x`.
pub fn reach(normal: DVec2, size: DVec2) -> (f64, f64) {
    let corners = [DVec2::ZERO, DVec2::new(size.x, 0.0), DVec2::new(0.0, size.y), size].map(|corner| normal.dot(corner));
    (corners.iter().copied().fold(f64::INFINITY, f64::min), corners.iter().copied().fold(f64::NEG_INFINITY, f64::max))
}

fn draw_blades(draw: &mut Draw, size: DVec2) -> (&'static str, Blades) {
    let shortest = size.min_element();
    let mut blades = Blades::none();
    let axes = [DVec2::NEG_X, DVec2::X, DVec2::NEG_Y, DVec2::Y];
    let blade = |draw: &mut Draw, normal: DVec2, deepest: f64| {
        let (least, most) = reach(normal, size);
        (normal, most - (most - least) * draw.log(0.01, deepest))
    };
    let kind = draw.pick(&[
        "rectangle",
        "turned rectangle",
        "octagon",
        "iris",
        "blades",
        "half",
        "disc",
        "wide disc",
        "disc and blades",
        "round corners",
    ]);
    match kind {
        "rectangle" => blades.planes = axes.iter().map(|&normal| blade(draw, normal, 0.4)).collect(),
        "turned rectangle" => {
            let turn = DVec2::from_angle(draw.between(-0.8, 0.8));
            blades.planes = axes.iter().map(|&normal| blade(draw, turn.rotate(normal), 0.4)).collect();
        }
        "octagon" => {
            blades.planes = axes.iter().map(|&normal| blade(draw, normal, 0.2)).collect();
            let turn = DVec2::from_angle(std::f64::consts::FRAC_PI_4);
            blades.planes.extend(axes.iter().map(|&normal| blade(draw, turn.rotate(normal), 0.35)).collect::<Vec<_>>());
        }
        "iris" => {
            let sides = draw.count(6, 16);
            let centre = size / 2.0 + draw.direction() * draw.between(0.0, 0.15) * shortest;
            blades.planes = polygon(centre, sides, draw.between(0.22, 0.55) * shortest, draw.between(0.0, 1.0));
        }
        "blades" => {
            for _ in 0..draw.count(1, 4) {
                let normal = if draw.chance(0.5) { draw.pick(&axes) } else { draw.direction() };
                blades.planes.push(blade(draw, normal, 0.6));
            }
        }
        "half" => {
            let normal = if draw.chance(0.6) { draw.pick(&axes) } else { draw.direction() };
            let (least, most) = reach(normal, size);
            blades.planes.push((normal, least + (most - least) * draw.between(0.4, 0.6)));
        }
        "round corners" => {
            let half = size * DVec2::new(draw.between(0.3, 0.5), draw.between(0.3, 0.5));
            let centre = size / 2.0 + (size / 2.0 - half) * DVec2::new(draw.between(-1.0, 1.0), draw.between(-1.0, 1.0));
            let radius = half.min_element() * draw.between(0.05, 0.5);
            blades.rounded = Some((centre, half, DVec2::X, radius));
        }
        _ => {
            let radius = shortest * if kind == "wide disc" { draw.between(0.5, 0.68) } else { draw.between(0.25, 0.5) };
            let stray = if kind == "wide disc" { 0.05 } else { 0.15 };
            blades.disc = Some((size / 2.0 + draw.direction() * draw.between(0.0, stray) * shortest, radius));
            if kind == "disc and blades" {
                let turn = DVec2::from_angle(draw.between(-0.8, 0.8));
                for &normal in &axes[..draw.count(1, 4)] {
                    let normal = turn.rotate(normal);
                    blades.planes.push((normal, normal.dot(size / 2.0) + radius * draw.between(0.4, 0.95)));
                }
            }
        }
    }
    (kind, blades)
}

/// Blades that leave at least 6 % of the frame open and shut at least 0.4 %.
pub fn seen_blades(draw: &mut Draw, size: DVec2) -> (&'static str, Blades) {
    loop {
        let (shape, blades) = draw_blades(draw, size);
        let mut open = 0;
        for row in 0..80 {
            for column in 0..80 {
                let x = DVec2::new(f64::from(column) + 0.5, f64::from(row) + 0.5) / 80.0 * size;
                open += usize::from(blades.depth_px(x) > 0.0);
            }
        }
        if (384..6375).contains(&open) {
            return (shape, blades);
        }
    }
}
