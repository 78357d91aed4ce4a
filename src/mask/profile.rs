//! Profiles of the signal across a candidate edge, at full resolution.

use glam::DVec2;

use super::shape::{Disc, FieldShape, HalfPlane};
use super::signal::Signal;

/// Profiles go this far to both sides of the edge, in pixels.
pub(super) const REACH_PX: isize = 36;
const LENGTH: usize = 2 * REACH_PX as usize + 1;
/// Along the edge, at most this many profiles.
const MOST_STATIONS: usize = 72;
/// Pixels averaged along the edge, at most.
const MOST_SAMPLES: usize = 6;

/// One edge of a field.
#[derive(Clone, Copy, Debug)]
pub(super) enum Edge {
    Line(HalfPlane),
    Circle(Disc),
}

/// A place on the edge and the unit vector into the field.
#[derive(Clone, Copy, Debug)]
pub(super) struct Station {
    pub at: DVec2,
    pub inward: DVec2,
}

/// Mean signals at offsets −`REACH_PX` (outside) to `REACH_PX` (inside) of each station.
pub(super) struct Profiles {
    pub stations: Vec<Station>,
    /// Distance between neighbouring stations.
    pub spacing_px: f64,
    /// Offsets of each station.
    length: usize,
    /// Running sums of signals and of how many lie in the frame, one more than `length` each station.
    sums: Vec<[f64; 2]>,
}

impl Edge {
    /// Moves the edge by what `fit` says: a shift into the field, and its change along the edge (line) or the inward normal (circle).
    pub fn moved(&self, fit: &[f64; 3]) -> Self {
        match *self {
            Self::Line(plane) => {
                let foot = plane.normal * plane.limit_px;
                let along = plane.normal.perp();
                // Two points of the moved line.
                let [p, q] = [-1.0, 1.0].map(|t| foot + along * t * 1000.0 - plane.normal * (fit[0] + fit[1] * t));
                let normal = -(q - p).perp().normalize();
                let normal = if normal.dot(plane.normal) < 0.0 { -normal } else { normal };
                Self::Line(HalfPlane { normal, limit_px: normal.dot(p) })
            }
            // Inwards by δ means a radius smaller by δ; along the inward normal n the circle moves by fit · n.
            Self::Circle(disc) => {
                Self::Circle(Disc { centre: disc.centre + DVec2::new(fit[1], fit[2]), radius_px: disc.radius_px - fit[0] })
            }
        }
    }

    /// What multiplies the numbers of `moved` at a station.
    pub fn basis(&self, station: &Station) -> [f64; 3] {
        match self {
            Self::Line(plane) => {
                let foot = plane.normal * plane.limit_px;
                [1.0, plane.normal.perp().dot(station.at - foot) / 1000.0, 0.0]
            }
            Self::Circle(_) => [1.0, station.inward.x, station.inward.y],
        }
    }

    /// A disc that is small or about a place far off is no intensifier's.
    pub fn is_sound(&self, width: usize, height: usize) -> bool {
        let size = DVec2::new(width as f64, height as f64);
        match self {
            Self::Line(_) => true,
            Self::Circle(disc) => {
                let off = (disc.centre - size / 2.0).abs() / size;
                disc.radius_px >= 0.2 * size.min_element() && off.max_element() <= 0.4
            }
        }
    }

    pub fn depth_px(&self, x: DVec2) -> f64 {
        match self {
            Self::Line(plane) => plane.limit_px - plane.normal.dot(x),
            Self::Circle(disc) => disc.radius_px - (x - disc.centre).length(),
        }
    }

    /// Places along the edge inside the frame and inside `shape`, and their spacing.
    fn stations(&self, width: usize, height: usize, shape: &FieldShape) -> (Vec<Station>, f64) {
        let size = DVec2::new(width as f64 - 1.0, height as f64 - 1.0);
        let in_frame = |x: DVec2| x.cmpge(DVec2::ZERO).all() && x.cmple(size).all();
        let seen = |x: &Station| in_frame(x.at) && shape.depth_px(x.at) > 4.0;
        match *self {
            Self::Line(plane) => {
                let along = plane.normal.perp();
                let nearest = plane.normal * plane.limit_px;
                let middle = nearest + along * along.dot(size / 2.0);
                let half = size.length() / 2.0;
                let (mut least, mut most) = (-half, half);
                for (start, slope, end) in [(middle.x, along.x, size.x), (middle.y, along.y, size.y)] {
                    if slope.abs() > 1e-9 {
                        let (a, b) = (-start / slope, (end - start) / slope);
                        (least, most) = (least.max(a.min(b)), most.min(a.max(b)));
                    } else if !(0.0..=end).contains(&start) {
                        most = f64::NEG_INFINITY;
                    }
                }
                if !(most > least) {
                    return (Vec::new(), 1.0);
                }
                let spacing = ((most - least) / MOST_STATIONS as f64).max(5.0);
                let count = ((most - least) / spacing) as usize;
                let station =
                    |k: usize| Station { at: middle + along * (least + (k as f64 + 0.5) * spacing), inward: -plane.normal };
                ((0..count).map(station).filter(seen).collect(), spacing)
            }
            Self::Circle(disc) => {
                let circumference = std::f64::consts::TAU * disc.radius_px;
                let spacing = (circumference / (2 * MOST_STATIONS) as f64).max(5.0);
                let count = (circumference / spacing) as usize;
                let station = |k: usize| {
                    let out = DVec2::from_angle(std::f64::consts::TAU * k as f64 / count as f64);
                    Station { at: disc.centre + out * disc.radius_px, inward: -out }
                };
                ((0..count).map(station).filter(seen).collect(), spacing)
            }
        }
    }
}

impl Profiles {
    /// Across `edge`, where it runs inside `shape`; nothing is known further in than `inwards_px`.
    pub fn new(signal: &Signal, edge: &Edge, shape: &FieldShape, inwards_px: isize) -> Self {
        let (width, height) = (signal.pixels.width, signal.pixels.height);
        let (stations, spacing_px) = edge.stations(width, height, shape);
        let samples = (spacing_px as usize).clamp(1, MOST_SAMPLES);
        let length = (REACH_PX + inwards_px.clamp(0, REACH_PX)) as usize + 1;
        let mut sums = Vec::with_capacity(stations.len() * (length + 1));
        for station in &stations {
            let along = station.inward.perp() * (spacing_px / samples as f64);
            let mut of_station = [[0.0, 0.0]; LENGTH];
            for sample in 0..samples {
                let shift = along * (sample as f64 - (samples as f64 - 1.0) / 2.0);
                add(&mut of_station[..length], signal, station, shift);
            }
            let mut running = [0.0, 0.0];
            sums.push(running);
            for [sum, count] in &of_station[..length] {
                // Half of the samples at the border still are a profile.
                if count * 2.0 >= samples as f64 && *count > 0.0 {
                    running[0] += sum / count;
                    running[1] += 1.0;
                }
                sums.push(running);
            }
        }
        Self { stations, spacing_px, length, sums }
    }

    /// Mean signal of station `k` over offsets `from..to` (clipped to what is known and to the frame), with the number of offsets.
    pub fn mean(&self, k: usize, from: isize, to: isize) -> Option<(f64, usize)> {
        let index = |offset: isize| ((offset.max(-REACH_PX) + REACH_PX) as usize).min(self.length);
        let line = &self.sums[k * (self.length + 1)..(k + 1) * (self.length + 1)];
        let (first, last) = (index(from), index(to));
        if last <= first {
            return None;
        }
        let count = line[last][1] - line[first][1];
        (count >= 1.0).then(|| ((line[last][0] - line[first][0]) / count, count as usize))
    }

    /// The outermost offset of station `k` that lies in the frame.
    pub fn outermost(&self, k: usize) -> isize {
        (-REACH_PX..=0).find(|&offset| self.mean(k, offset, offset + 1).is_some()).unwrap_or(0)
    }
}

/// Adds to `sums` at each offset of a station, from the outermost inwards, the signal at `shift` from there and 1, where that lies in the frame.
fn add(sums: &mut [[f64; 2]], signal: &Signal, station: &Station, shift: DVec2) {
    let (width, height) = (signal.pixels.width, signal.pixels.height);
    let place = |n: usize| station.at + station.inward * (n as f64 - REACH_PX as f64) + shift + 0.5;
    let is_inside = |x: DVec2| x.x >= 0.0 && x.y >= 0.0 && x.x < width as f64 && x.y < height as f64;
    if is_inside(place(0)) && is_inside(place(LENGTH - 1)) {
        // All that lies between lies in the frame too. Sides are below 2³¹.
        let (mut columns, mut rows) = ([0i32; LENGTH], [0i32; LENGTH]);
        for (n, (column, row)) in columns.iter_mut().zip(&mut rows).enumerate() {
            let x = place(n);
            (*column, *row) = (x.x as i32, x.y as i32);
        }
        for (sum, (column, row)) in sums.iter_mut().zip(columns.into_iter().zip(rows)) {
            sum[0] += f64::from(signal.at(row as usize * width + column as usize));
            sum[1] += 1.0;
        }
        return;
    }
    for (n, sum) in sums.iter_mut().enumerate() {
        let x = place(n);
        if is_inside(x) {
            sum[0] += f64::from(signal.at(x.y as usize * width + x.x as usize));
            sum[1] += 1.0;
        }
    }
}
