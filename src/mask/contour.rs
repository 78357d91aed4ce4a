//! Candidates for the edges of the field: straight lines and circles along the rim of the bright part, for one threshold of the cells'
//! levels. Generous: full resolution judges them later.

use glam::DVec2;

use super::cells::Cells;
use super::shape::{Disc, HalfPlane};

/// A part of the bright cells that is at least this large, compared with the largest, belongs to the field; smaller ones are letters.
const PART_SHARE: f64 = 0.05;
/// Rim points this many cells off a line are on it.
const NEAR_CELLS: f64 = 0.75;
/// Lines per threshold, at most.
const MOST_LINES: usize = 14;
/// Rim points looked at when lines are compared, at most: every second, third … of a long rim does.
const MOST_POINTS: usize = 160;
/// Share of the bright cells that may lie beyond an edge: letters over the blade.
const BEYOND_SHARE: f64 = 0.02;

/// A candidate, with the number of rim points on it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Found<T> {
    pub edge: T,
    pub support: usize,
}

/// The bright cells of one threshold.
pub(super) struct Bright {
    /// Row by row, how many bright cells come before each column.
    before: Vec<u32>,
    columns: usize,
    rows: usize,
    pub count: usize,
    /// Ordered by the angle about the middle.
    rim: Vec<DVec2>,
    middle: DVec2,
}

impl Bright {
    /// Cells above `threshold`, without small parts; `None` when there is no rim inside the frame.
    pub fn new(cells: &Cells, threshold: f32) -> Option<Self> {
        let kept = large_parts(cells, threshold);
        let (columns, rows) = (cells.columns, cells.rows);
        let mut before = Vec::with_capacity((columns + 1) * rows);
        let (mut count, mut sum) = (0usize, DVec2::ZERO);
        for row in 0..rows {
            let mut running = 0;
            before.push(0);
            for column in 0..columns {
                if kept[row * columns + column] {
                    running += 1;
                    count += 1;
                    sum += cells.centre(column, row);
                }
                before.push(running);
            }
        }
        if count < 9 {
            return None;
        }
        let middle = sum / count as f64;
        let rim = rim(cells, &kept);
        if rim.len() < 5 {
            return None;
        }
        let angle = |x: DVec2| (x.y - middle.y).atan2(x.x - middle.x);
        let mut by_angle: Vec<(f64, DVec2)> = rim.into_iter().map(|x| (angle(x), x)).collect();
        by_angle.sort_by(|a, b| a.0.total_cmp(&b.0));
        let rim = by_angle.into_iter().map(|(_, x)| x).collect();
        Some(Self { before, columns, rows, count, rim, middle })
    }

    /// How many bright cells have their centres beyond the line by `gap_px` or more.
    fn beyond(&self, cells: &Cells, plane: &HalfPlane, gap_px: f64) -> usize {
        let mut count = 0;
        let room = plane.limit_px + gap_px;
        for row in 0..self.rows {
            let first = cells.centre(0, row);
            let line = &self.before[row * (self.columns + 1)..(row + 1) * (self.columns + 1)];
            // normal · (first + c · size) > room
            let start = room - plane.normal.dot(first);
            let slope = plane.normal.x * cells.size_px.x;
            if slope.abs() < 1e-9 {
                if start < 0.0 {
                    count += line[self.columns];
                }
            } else {
                let at = (start / slope).clamp(-1.0, self.columns as f64);
                if slope > 0.0 {
                    count += line[self.columns] - line[((at.floor() + 1.0) as usize).min(self.columns)];
                } else {
                    count += line[(at.ceil().max(0.0) as usize).min(self.columns)];
                }
            }
        }
        count as usize
    }

    /// Lines along the rim, best first, each with its own points.
    pub fn lines(&self, cells: &Cells) -> Vec<Found<HalfPlane>> {
        let near = NEAR_CELLS * cells.size_px.max_element();
        let least = 4.max(cells.columns.min(cells.rows) / 16);
        let mut free = self.rim.clone();
        let mut lines = Vec::new();
        while free.len() >= least && lines.len() < MOST_LINES {
            let count = free.len();
            let thinning = count.div_ceil(MOST_POINTS);
            let points: Vec<DVec2> = free.iter().copied().step_by(thinning).collect();
            let mut best: Option<Found<HalfPlane>> = None;
            let mut gaps = [count / 3, count / 8, count / 20, 5];
            gaps.sort_unstable();
            for (index, &gap) in gaps.iter().enumerate() {
                if gap < 3 || index > 0 && gap == gaps[index - 1] {
                    continue;
                }
                for start in (0..count).step_by((count / 40).max(1)) {
                    let (from, to) = (free[start], free[(start + gap) % count]);
                    let Some(plane) = self.through(from, to, 3.0 * near) else { continue };
                    let support =
                        thinning * points.iter().filter(|x| (plane.normal.dot(**x) - plane.limit_px).abs() <= near).count();
                    if support < least || best.is_some_and(|best| support <= best.support) {
                        continue;
                    }
                    if self.beyond(cells, &plane, 1.5 * near) as f64 <= BEYOND_SHARE * self.count as f64 {
                        best = Some(Found { edge: plane, support });
                    }
                }
            }
            let Some(found) = best else { break };
            let plane = self.settled(found.edge, &free, near);
            free.retain(|x| (plane.normal.dot(*x) - plane.limit_px).abs() > near);
            lines.push(Found { edge: plane, support: found.support });
            if free.len() == count {
                break;
            }
        }
        lines
    }

    /// The line through two points, with the middle on its open side; `None` when they are close together.
    fn through(&self, from: DVec2, to: DVec2, least_px: f64) -> Option<HalfPlane> {
        let along = to - from;
        if !(along.length() >= least_px) {
            return None;
        }
        let normal = along.perp().normalize();
        let normal = if normal.dot(self.middle - from) > 0.0 { -normal } else { normal };
        Some(HalfPlane { normal, limit_px: normal.dot((from + to) / 2.0) })
    }

    /// Total least squares on the points near the line, twice.
    fn settled(&self, mut plane: HalfPlane, points: &[DVec2], near: f64) -> HalfPlane {
        for _ in 0..2 {
            let on: Vec<DVec2> =
                points.iter().copied().filter(|x| (plane.normal.dot(*x) - plane.limit_px).abs() <= near).collect();
            if on.len() < 3 {
                break;
            }
            let mean = on.iter().copied().sum::<DVec2>() / on.len() as f64;
            let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
            for x in &on {
                let d = *x - mean;
                (xx, xy, yy) = (xx + d.x * d.x, xy + d.x * d.y, yy + d.y * d.y);
            }
            // The direction of the largest spread.
            let along = DVec2::from_angle(0.5 * (2.0 * xy).atan2(xx - yy));
            let normal = if along.perp().dot(plane.normal) < 0.0 { -along.perp() } else { along.perp() };
            plane = HalfPlane { normal, limit_px: normal.dot(mean) };
        }
        plane
    }

    /// The circle that most rim points lie on, of those that are not on the lines already known.
    pub fn disc(&self, cells: &Cells, known: &[HalfPlane]) -> Option<Found<Disc>> {
        let near = NEAR_CELLS * cells.size_px.max_element();
        let free = |x: &DVec2| known.iter().all(|plane| plane.limit_px - plane.normal.dot(*x) > 2.0 * near);
        let rim: Vec<DVec2> = self.rim.iter().copied().filter(free).collect();
        let count = rim.len();
        if count < 12 {
            return None;
        }
        let mut best: Option<Found<Disc>> = None;
        for spacing in [3, 5, 9] {
            for start in (0..count).step_by((count / 40).max(1)) {
                let points = [0, 1, 2].map(|i: usize| rim[(start + i * count / spacing) % count]);
                let Some(disc) = circle_through(points) else { continue };
                let support = rim.iter().filter(|x| ((**x - disc.centre).length() - disc.radius_px).abs() <= near).count();
                if best.is_none_or(|best| support > best.support) {
                    best = Some(Found { edge: disc, support });
                }
            }
        }
        best.filter(|found| found.support * 4 >= count)
    }
}

/// The circle through three points.
pub(super) fn circle_through([a, b, c]: [DVec2; 3]) -> Option<Disc> {
    let (ab, ac) = (b - a, c - a);
    let twice_area = 2.0 * ab.perp_dot(ac);
    if !(twice_area.abs() > 1e-9 * ab.length_squared().max(ac.length_squared())) {
        return None;
    }
    let (ab2, ac2) = (ab.length_squared(), ac.length_squared());
    let offset = DVec2::new(ac.y * ab2 - ab.y * ac2, ab.x * ac2 - ac.x * ab2) / twice_area;
    let radius_px = offset.length();
    radius_px.is_finite().then_some(Disc { centre: a + offset, radius_px })
}

/// Bright cells in connected parts that are not small.
fn large_parts(cells: &Cells, threshold: f32) -> Vec<bool> {
    let (columns, rows) = (cells.columns, cells.rows);
    let mut part = vec![0u32; columns * rows];
    let mut sizes = vec![0usize];
    let mut open = Vec::new();
    for start in 0..part.len() {
        if part[start] != 0 || !(cells.cells[start].level > threshold) {
            continue;
        }
        let label = sizes.len() as u32;
        sizes.push(0);
        part[start] = label;
        open.push(start);
        while let Some(index) = open.pop() {
            sizes[label as usize] += 1;
            let (column, row) = (index % columns, index / columns);
            let mut visit = |next: usize| {
                if part[next] == 0 && cells.cells[next].level > threshold {
                    part[next] = label;
                    open.push(next);
                }
            };
            if column > 0 {
                visit(index - 1);
            }
            if column + 1 < columns {
                visit(index + 1);
            }
            if row > 0 {
                visit(index - columns);
            }
            if row + 1 < rows {
                visit(index + columns);
            }
        }
    }
    let largest = sizes.iter().copied().max().unwrap_or(0);
    part.iter().map(|&label| label != 0 && sizes[label as usize] as f64 >= PART_SHARE * largest as f64).collect()
}

/// The outermost bright cells of each row and column, where they are not at the border of the frame: the points between them and the
/// next cell outwards.
fn rim(cells: &Cells, kept: &[bool]) -> Vec<DVec2> {
    let (columns, rows) = (cells.columns, cells.rows);
    let half = cells.size_px / 2.0;
    let mut rim = Vec::new();
    for row in 0..rows {
        let line = &kept[row * columns..(row + 1) * columns];
        if let Some(first) = line.iter().position(|&k| k).filter(|&first| first > 0) {
            rim.push(cells.centre(first, row) - DVec2::new(half.x, 0.0));
        }
        if let Some(last) = line.iter().rposition(|&k| k).filter(|&last| last + 1 < columns) {
            rim.push(cells.centre(last, row) + DVec2::new(half.x, 0.0));
        }
    }
    for column in 0..columns {
        if let Some(first) = (0..rows).find(|row| kept[row * columns + column]).filter(|&first| first > 0) {
            rim.push(cells.centre(column, first) - DVec2::new(0.0, half.y));
        }
        if let Some(last) = (0..rows).rev().find(|row| kept[row * columns + column]).filter(|&last| last + 1 < rows) {
            rim.push(cells.centre(column, last) + DVec2::new(0.0, half.y));
        }
    }
    rim
}
