//! The outline that edges make together: which of them agree with each other, and what they leave open.

use glam::DVec2;

use super::cells::Cells;
use super::edge::{Judged, Terms, judge};
use super::fit::quantile;
use super::profile::Edge;
use super::shape::{FieldShape, HalfPlane};
use super::signal::Signal;
use crate::estimate::median;

/// One edge must be seen along this share of the frame's shorter side …
const LONG_SHARE: f64 = 0.25;
/// … or several, each along at least this share …
pub(super) const SHORT_SHARE: f64 = 0.05;
/// … along this share in all.
const TOGETHER_SHARE: f64 = 1.0;

/// The edges that were found together.
pub(super) struct Outline {
    pub shape: FieldShape,
    pub edges: Vec<Judged>,
}

/// Whether two edges are the same but for the precision of a candidate.
pub(super) fn alike(a: &Edge, b: &Edge, cells: &Cells) -> bool {
    let near = cells.size_px.max_element();
    let middle = cells.centre(cells.columns / 2, cells.rows / 2);
    match (a, b) {
        (Edge::Line(a), Edge::Line(b)) => {
            // Compared at the foot of the perpendicular from the middle of the frame.
            let foot = middle + a.normal * (a.limit_px - a.normal.dot(middle));
            a.normal.dot(b.normal) > 0.999 && (b.normal.dot(foot) - b.limit_px).abs() < 1.5 * near
        }
        (Edge::Circle(a), Edge::Circle(b)) => (a.centre - b.centre).length() < near && (a.radius_px - b.radius_px).abs() < near,
        _ => false,
    }
}

impl Outline {
    /// The open beam beside an object may be clipped to one value as well; then it has no corner, and its edge is hardly straight.
    pub fn is_no_saturated_air(&self) -> bool {
        let exact = self.edges.iter().all(|edge| edge.share >= 0.9);
        let planes = &self.shape.half_planes;
        let corner = planes.iter().any(|a| planes.iter().any(|b| a.normal.dot(b.normal) < 0.8));
        exact && (corner || self.shape.disc.is_some())
    }

    pub fn matched_px(&self) -> f64 {
        self.edges.iter().map(|edge| edge.matched_px).sum()
    }

    /// The median width, by length of edge: all blades of a collimator stand about as far from the focal spot.
    pub fn penumbra_px(&self) -> f64 {
        let mut widths: Vec<(f64, f64)> = self.edges.iter().map(|edge| (edge.penumbra_px, edge.matched_px)).collect();
        widths.sort_by(|a, b| a.0.total_cmp(&b.0));
        let half = self.matched_px() / 2.0;
        let mut length = 0.0;
        for (width, matched) in widths {
            length += matched;
            if length >= half {
                return width;
            }
        }
        0.0
    }

    /// Takes out edges beyond which it is brighter or noisier than beyond the others: what a blade shuts looks the same everywhere.
    pub fn prune(&mut self, signal: &Signal, cells: &Cells) -> Vec<Edge> {
        let mut dropped = Vec::new();
        while self.edges.len() > 1 {
            let worst =
                (0..self.edges.len()).map(|index| (index, self.excess(index, signal, cells))).max_by(|a, b| a.1.total_cmp(&b.1));
            let Some((index, excess)) = worst else { break };
            if excess <= 1.0 {
                break;
            }
            dropped.push(self.edges.remove(index).edge);
            self.shape = FieldShape::default();
            for judged in &self.edges {
                match judged.edge {
                    Edge::Line(plane) => self.shape.half_planes.push(plane),
                    Edge::Circle(disc) => self.shape.disc = Some(disc),
                }
            }
        }
        dropped
    }

    /// How much brighter or noisier it is where only edge `index` shuts, in units of what is allowed.
    fn excess(&self, index: usize, signal: &Signal, cells: &Cells) -> f64 {
        let judged = &self.edges[index];
        let (mut alone, mut others) = ((Vec::new(), Vec::new()), (Vec::new(), Vec::new()));
        for (centre, cell) in cells.iter() {
            let depth = |edge: &Judged| edge.edge.depth_px(centre);
            let margin = |edge: &Judged| edge.penumbra_px / 2.0 + cells.reach_px() + 1.0;
            let elsewhere = self.edges.iter().enumerate().filter(|(other, _)| *other != index);
            let shut_elsewhere = elsewhere.clone().any(|(_, edge)| depth(edge) < -margin(edge));
            if shut_elsewhere {
                others.0.push(f64::from(cell.level));
                others.1.push(f64::from(cell.noise));
            } else if depth(judged) < -margin(judged) && elsewhere.clone().all(|(_, edge)| depth(edge) > 0.0) {
                alone.0.push(f64::from(cell.level));
                alone.1.push(f64::from(cell.noise));
            }
        }
        let step = self.edges.iter().map(|edge| edge.step).fold(0.0, f64::max);
        let (Some(level), Some(noise)) = (median(others.0.iter().copied()), median(others.1)) else { return 0.0 };
        if others.0.len() < 12 {
            return 0.0;
        }
        let high = quantile(&mut others.0, 0.9).unwrap_or(level);
        let mut excess = (judged.level - high) / (0.06 * step + 2.0 * 0.25 * noise);
        if alone.0.len() >= 6 {
            let (middle, most) = (median(alone.0.iter().copied()).unwrap_or(level), quantile(&mut alone.0, 0.9).unwrap_or(level));
            excess = excess.max((middle - high) / (0.04 * step + 0.5 * noise)).max((most - high) / (0.1 * step + noise));
            if !signal.is_paint() {
                let noise_alone = median(alone.1).unwrap_or(noise);
                excess = excess.max((noise_alone - noise) / (noise + 0.001 * step + 1.1 * f64::from(signal.resolution)));
            }
        }
        excess
    }

    pub fn long_enough(&self, shortest: f64) -> bool {
        self.edges.iter().any(|edge| edge.matched_px >= LONG_SHARE * shortest) || self.matched_px() >= TOGETHER_SHARE * shortest
    }

    /// Adds the edge if it holds inside what is open so far, and shuts something.
    pub fn add(&mut self, signal: &Signal, cells: &Cells, edge: Edge, search_px: f64, least_px: f64) {
        if matches!(edge, Edge::Circle(_)) && self.shape.disc.is_some()
            || self.edges.iter().any(|known| alike(&known.edge, &edge, cells))
        {
            return;
        }
        let shut_level = median(self.edges.iter().map(|edge| edge.level));
        let terms = Terms { shape: &self.shape, search_px, least_px, shut_level };
        let Ok(judged) = judge(signal, cells, edge, &terms) else { return };
        if self.edges.iter().any(|known| alike(&known.edge, &judged.edge, cells)) {
            return;
        }
        if !self.shuts_more(cells, &judged) {
            return;
        }
        match judged.edge {
            Edge::Line(plane) => self.shape.half_planes.push(plane),
            Edge::Circle(disc) => self.shape.disc = Some(disc),
        }
        self.edges.push(judged);
    }

    /// Adds a blade inside an outline that the console painted, as shutters inside an intensifier's disc are: what glows there has nothing
    /// to be compared with, so it must be long and seen well.
    pub fn add_blade(&mut self, signal: &Signal, cells: &Cells, judged: &Judged) {
        let shortest = signal.pixels.width.min(signal.pixels.height) as f64;
        if matches!(judged.edge, Edge::Line(_)) && judged.share >= 0.9 && judged.matched_px >= 0.4 * shortest {
            self.add(signal, cells, judged.edge, 0.0, LONG_SHARE * shortest);
        }
    }

    /// The radius of round corners, from the distance between the corner and the signal: the least of all, so that a dark corner is not
    /// taken for a rounder one.
    pub fn round_corners(&mut self, signal: &Signal) {
        let (width, height) = (signal.pixels.width as f64, signal.pixels.height as f64);
        let planes = &self.shape.half_planes;
        let right_angled = |a: &HalfPlane, b: &HalfPlane| !(0.05..0.95).contains(&a.normal.dot(b.normal).abs());
        if self.shape.disc.is_some() || !planes.iter().all(|a| planes.iter().all(|b| right_angled(a, b))) {
            return;
        }
        let mut radii = Vec::new();
        for (index, a) in self.edges.iter().enumerate() {
            for b in &self.edges[..index] {
                let (Edge::Line(first), Edge::Line(second)) = (a.edge, b.edge) else { continue };
                if first.normal.dot(second.normal).abs() > 0.05 {
                    continue;
                }
                let corner = (first.normal * first.limit_px + second.normal * second.limit_px)
                    - (first.normal + second.normal) * first.normal.dot(second.normal) * 0.5;
                // Where the corner is beyond the border, its arc may be too.
                if !(corner.min_element() >= 2.0 && corner.x < width - 3.0 && corner.y < height - 3.0) {
                    continue;
                }
                let inward = -(first.normal + second.normal).normalize();
                let (level, step) = (a.level.max(b.level), a.step.min(b.step));
                let half = self.penumbra_px() / 2.0;
                let reach = 0.35 * width.min(height);
                // Half of the step where the arc is: in the middle of the penumbra.
                let seen = (0..reach as usize).find(|&offset| {
                    let x = corner + inward * offset as f64 + 0.5;
                    let inside = x.x >= 1.0 && x.y >= 1.0 && x.x < width - 1.0 && x.y < height - 1.0;
                    let index = |du: usize, dv: usize| (x.y as usize + dv - 1) * signal.pixels.width + x.x as usize + du - 1;
                    inside && (0..9).map(|k| f64::from(signal.at(index(k % 3, k / 3)))).sum::<f64>() / 9.0 > level + 0.4 * step
                });
                let Some(seen) = seen else { continue };
                // A sharp corner shows at once, but for the penumbras of its two edges.
                radii.push(((seen as f64 - 1.0 - half) / (std::f64::consts::SQRT_2 - 1.0)).max(0.0));
            }
        }
        let least = radii.iter().copied().fold(f64::INFINITY, f64::min);
        if radii.len() >= 2 && least >= 8.0 && least.is_finite() {
            self.shape.corner_radius_px = least;
        }
    }

    /// Whether the edge lies inside the outline by more than its own uncertainty somewhere.
    fn shuts_more(&self, cells: &Cells, judged: &Judged) -> bool {
        if self.edges.is_empty() {
            return true;
        }
        let quarters = [DVec2::new(-0.25, -0.25), DVec2::new(0.25, -0.25), DVec2::new(-0.25, 0.25), DVec2::new(0.25, 0.25)];
        let gained = cells
            .iter()
            .flat_map(|(centre, _)| quarters.map(|quarter| centre + quarter * cells.size_px))
            .filter(|x| judged.edge.depth_px(*x) < -1.5 && self.shape.depth_px(*x) > 1.5)
            .count();
        gained >= 2
    }
}
