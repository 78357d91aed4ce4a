//! What stands in the beam of a drawn radiograph: soft parts, bones, rods, wires, screws, a table.

use glam::DVec2;

use crate::mask_blades::reach;
use crate::mask_draw::Draw;

/// Something in the beam; nepers at a point.
pub enum Matter {
    Blob {
        centre: DVec2,
        spread_px: f64,
        nepers: f64,
    },
    /// An ellipse with an edge `soft_px` wide.
    Ellipse {
        centre: DVec2,
        axis: DVec2,
        half: DVec2,
        soft_px: f64,
        nepers: f64,
    },
    /// A straight rod, wire or screw.
    Rod {
        from: DVec2,
        to: DVec2,
        radius_px: f64,
        nepers: f64,
    },
    Table {
        normal: DVec2,
        limit: f64,
        nepers: f64,
    },
}

impl Matter {
    /// A rod that the beam goes along: the shadow of a sphere.
    pub fn is_round_metal(&self) -> bool {
        matches!(*self, Self::Rod { from, to, .. } if from.distance(to) < 1.0)
    }

    pub fn nepers(&self, x: DVec2) -> f64 {
        match *self {
            Self::Blob { centre, spread_px, nepers } => {
                let squared = (x - centre).length_squared() / (2.0 * spread_px * spread_px);
                if squared < 12.0 { nepers * (-squared).exp() } else { 0.0 }
            }
            Self::Ellipse { centre, axis, half, soft_px, nepers } => {
                let local = DVec2::new(axis.dot(x - centre), axis.perp_dot(x - centre)) / half;
                let inside = (1.0 - local.length()) * half.min_element();
                nepers * (inside / soft_px).clamp(0.0, 1.0)
            }
            Self::Rod { from, to, radius_px, nepers } => {
                let along = ((x - from).dot(to - from) / (to - from).length_squared()).clamp(0.0, 1.0);
                let off = (x - from - along * (to - from)).length() / radius_px;
                if off < 1.0 { nepers * (1.0 - off * off).sqrt() } else { 0.0 }
            }
            Self::Table { normal, limit, nepers } => nepers * (normal.dot(x) - limit).clamp(0.0, 1.0),
        }
    }
}

pub fn draw_anatomy(draw: &mut Draw, size: DVec2) -> Vec<Matter> {
    let shortest = size.min_element();
    let mut all = Vec::new();
    let thickest = draw.between(0.2, 5.0);
    let blobs = draw.count(2, 7);
    for _ in 0..blobs {
        let spread_px = shortest * draw.log(0.1, 0.7);
        all.push(Matter::Blob {
            centre: draw.place(size, 0.2),
            spread_px,
            nepers: thickest / (blobs as f64).sqrt() * draw.between(0.3, 1.0),
        });
    }
    if draw.chance(0.4) {
        // A hip or a thigh that comes in from the border.
        let normal = draw.direction();
        let centre = size / 2.0 + normal * size * draw.between(0.4, 0.7);
        let half = DVec2::new(draw.log(0.1, 0.5), draw.log(0.1, 0.5)) * shortest;
        all.push(Matter::Ellipse {
            centre,
            axis: draw.direction(),
            half,
            soft_px: shortest * draw.log(0.01, 0.3),
            nepers: draw.between(0.5, 4.0),
        });
    }
    for _ in 0..draw.count(0, 5) {
        let half = DVec2::new(draw.log(0.02, 0.2), draw.log(0.05, 0.6)) * shortest;
        all.push(Matter::Ellipse {
            centre: draw.place(size, 0.0),
            axis: draw.direction(),
            half,
            soft_px: draw.log(1.0, 20.0),
            nepers: draw.between(0.2, 1.5),
        });
    }
    if draw.chance(0.4) {
        for _ in 0..draw.count(1, 2) {
            let (middle, along) = (draw.place(size, 0.0), draw.direction() * 2.0 * size.length());
            all.push(Matter::Rod {
                from: middle - along,
                to: middle + along,
                radius_px: shortest * draw.log(0.005, 0.05),
                nepers: draw.between(1.0, 9.0),
            });
        }
    }
    for _ in 0..draw.count(0, 4) {
        let (from, along) = (draw.place(size, 0.1), draw.direction() * draw.between(0.1, 1.0) * shortest);
        all.push(Matter::Rod { from, to: from + along, radius_px: draw.log(0.7, 8.0), nepers: draw.between(0.5, 5.0) });
    }
    for _ in 0..draw.count(0, 12) {
        let centre = draw.place(size, 0.0);
        all.push(Matter::Rod {
            from: centre,
            to: centre + DVec2::X * 0.01,
            radius_px: draw.log(2.0, 9.0),
            nepers: draw.between(1.0, 5.0),
        });
    }
    if draw.chance(0.3) {
        let normal =
            if draw.chance(0.5) { draw.pick(&[DVec2::X, DVec2::Y, DVec2::NEG_X, DVec2::NEG_Y]) } else { draw.direction() };
        let (least, most) = reach(normal, size);
        all.push(Matter::Table { normal, limit: draw.between(least, most), nepers: draw.between(0.05, 0.7) });
    }
    all
}
