//! A face of a grid that holds matter, and whether a straight line along it meets that matter.

use glam::DVec2;

/// A step from cell to cell goes so much further than the border between them, in cells.
const STEP: f64 = 1e-6;

/// A face with tissue: cells of its layer, how many of those in any rectangle hold matter, and how far it is to the nearest that does.
#[derive(Clone, Debug, PartialEq)]
pub struct CutFace {
    /// Axis of the normal.
    pub axis: usize,
    /// Whether the face is at the high end.
    pub high: bool,
    /// Cells along the other two axes.
    size: [usize; 2],
    /// Sums over [0, b) × [0, c), b fastest, (size + 1)² of them.
    sums: Vec<u32>,
    /// Steps of a chess king from each cell to the nearest with matter, b fastest.
    steps: Vec<u16>,
    /// First and one past the last cell that holds matter.
    bounds: [[usize; 2]; 2],
}

/// The other two axes.
#[must_use]
pub fn across(axis: usize) -> [usize; 2] {
    [usize::from(axis == 0), 2 - usize::from(axis == 2)]
}

impl CutFace {
    /// The faces of a grid of `cells` along each axis that hold matter.
    #[must_use]
    pub fn all_of(cells: [usize; 3], holds_matter: impl Fn([usize; 3]) -> bool) -> Vec<Self> {
        let sides = (0..3).flat_map(|axis| [(axis, false), (axis, true)]);
        sides.filter_map(|(axis, high)| Self::new(cells, &holds_matter, axis, high)).collect()
    }

    fn new(cells: [usize; 3], holds_matter: &impl Fn([usize; 3]) -> bool, axis: usize, high: bool) -> Option<Self> {
        let layer = if high { cells[axis] - 1 } else { 0 };
        let [b, c] = across(axis);
        let size = [cells[b], cells[c]];
        let width = size[0] + 1;
        let mut sums = vec![0u32; width * (size[1] + 1)];
        let mut bounds = [size, [0; 2]];
        for y in 0..size[1] {
            let mut row = 0;
            for x in 0..size[0] {
                let mut cell = [layer; 3];
                (cell[b], cell[c]) = (x, y);
                if holds_matter(cell) {
                    row += 1;
                    bounds[0] = [bounds[0][0].min(x), bounds[0][1].min(y)];
                    bounds[1] = [bounds[1][0].max(x + 1), bounds[1][1].max(y + 1)];
                }
                sums[(y + 1) * width + x + 1] = sums[y * width + x + 1] + row;
            }
        }
        let matter = |x: usize, y: usize| {
            let corner = |x: usize, y: usize| sums[y * width + x];
            corner(x + 1, y + 1) + corner(x, y) != corner(x + 1, y) + corner(x, y + 1)
        };
        let steps = if bounds[0][0] < bounds[1][0] { king_steps(size, matter) } else { return None };
        Some(Self { axis, high, size, sums, steps, bounds })
    }

    /// Depths within [`from`, `to`] at which a ray p + q·t is beyond the face at `plane`, at most `reach` from it.
    #[must_use]
    pub fn beyond(&self, [plane, reach]: [f64; 2], p: f64, q: f64, from: f64, to: f64) -> Option<(f64, f64)> {
        // Distance beyond the face: distance + t·rate.
        let sign = if self.high { 1.0 } else { -1.0 };
        let (distance, rate) = (sign * (p - plane), sign * q);
        if rate == 0.0 {
            return (distance > 0.0 && distance <= reach).then_some((from, to));
        }
        let (a, b) = (-distance / rate, (reach - distance) / rate);
        let (low, high) = (from.max(a.min(b)), to.min(a.max(b)));
        (low < high).then_some((low, high))
    }

    /// Cells with matter, and all cells, of the rectangle that holds all of `points`, as far as it lies on the face.
    #[must_use]
    pub fn count(&self, low: DVec2, high: DVec2) -> (u32, u32) {
        let [width, height] = self.size;
        let cell = |x: f64, n: usize| x.floor().clamp(0.0, n as f64) as usize;
        let (x0, y0) = (cell(low.x, width), cell(low.y, height));
        let (x1, y1) = (cell(high.x + 1.0, width), cell(high.y + 1.0, height));
        if x1 <= x0 || y1 <= y0 {
            return (0, 0);
        }
        let sum = |x: usize, y: usize| self.sums[y * (width + 1) + x];
        let found = sum(x1, y1) + sum(x0, y0) - sum(x0, y1) - sum(x1, y0);
        (found, ((x1 - x0) * (y1 - y0)) as u32)
    }

    /// Whether the straight line from `a` to `b`, in cells, meets matter.
    // From a cell that is n steps of a king from matter, the line may leave the square of n − 1 cells around it before it is looked at again.
    #[must_use]
    pub fn meets(&self, a: DVec2, b: DVec2) -> bool {
        let [width, height] = self.size;
        let d = b - a;
        let nudge = STEP / d.length().max(STEP);
        // A line that begins on a border between cells is in the one that it enters.
        let mut along = nudge;
        // No line crosses more cells than this; one that is NaN is not known to miss anything.
        for _ in 0..2 * (width + height) + 2 {
            let at = a + d * along;
            let cell = [at.x, at.y].map(|x| x.floor().max(0.0) as usize);
            let (x, y) = (cell[0].min(width - 1), cell[1].min(height - 1));
            let steps = self.steps[y * width + x];
            if steps == 0 {
                return true;
            }
            let reach = f64::from(steps - 1);
            let leaves = |cell: usize, a: f64, d: f64| {
                let border = if d > 0.0 { cell as f64 + 1.0 + reach } else { cell as f64 - reach };
                if d == 0.0 { f64::INFINITY } else { (border - a) / d }
            };
            along = leaves(x, a.x, d.x).min(leaves(y, a.y, d.y)).max(along) + nudge;
            if along > 1.0 {
                return false;
            }
        }
        true
    }

    /// The part of [`from`, `to`] in which a + d·t lies over the tissue's bounding rectangle.
    #[must_use]
    pub fn over_bounds(&self, a: DVec2, d: DVec2, from: f64, to: f64) -> Option<(f64, f64)> {
        let (mut low, mut high) = (from, to);
        for n in 0..2 {
            // Matter ends half a cell before the layer does.
            let x0 = (self.bounds[0][n] as f64).max(0.5);
            let x1 = (self.bounds[1][n] as f64).min(self.size[n] as f64 - 0.5);
            if d[n] == 0.0 {
                if !(a[n] >= x0 && a[n] <= x1) {
                    return None;
                }
                continue;
            }
            let (t0, t1) = ((x0 - a[n]) / d[n], (x1 - a[n]) / d[n]);
            (low, high) = (low.max(t0.min(t1)), high.min(t0.max(t1)));
        }
        (low < high).then_some((low, high))
    }
}

/// By cell, how many steps a king of chess is from the nearest that holds `matter`: two passes, each over the neighbours already passed.
fn king_steps([width, height]: [usize; 2], matter: impl Fn(usize, usize) -> bool) -> Vec<u16> {
    let mut steps: Vec<u16> = (0..width * height).map(|at| if matter(at % width, at / width) { 0 } else { u16::MAX }).collect();
    let mut pass = |at: usize, dy: isize| {
        let (x, y) = ((at % width) as isize, (at / width) as isize);
        let inside = |x: isize, y: isize| (0..width as isize).contains(&x) && (0..height as isize).contains(&y);
        let passed = [(x - 1, y + dy), (x, y + dy), (x + 1, y + dy), (x + dy, y)];
        let nearest = passed.into_iter().filter(|(x, y)| inside(*x, *y)).map(|(x, y)| steps[y as usize * width + x as usize]);
        steps[at] = nearest.min().map_or(steps[at], |nearest| steps[at].min(nearest.saturating_add(1)));
    };
    (0..width * height).for_each(|at| pass(at, -1));
    (0..width * height).rev().for_each(|at| pass(at, 1));
    steps
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Stream};

    /// Whether the line passes a cell with matter: every cell is asked by clipping the line to it.
    fn crosses(matter: &[[bool; 9]; 7], a: DVec2, b: DVec2, grown: f64) -> bool {
        let d = b - a;
        (0..9 * 7).filter(|at| matter[at / 9][at % 9]).any(|at| {
            let low = DVec2::new((at % 9) as f64, (at / 9) as f64) - grown;
            let (mut from, mut to) = (0.0f64, 1.0f64);
            for n in 0..2 {
                let (s, t) = ((low[n] - a[n]) / d[n], (low[n] + 1.0 + 2.0 * grown - a[n]) / d[n]);
                (from, to) = (from.max(s.min(t)), to.min(s.max(t)));
            }
            from <= to
        })
    }

    #[test]
    fn a_line_meets_matter_where_it_crosses_one_of_its_cells() {
        let mut stream = Stream::new(5, 0, 0, Purpose::Evaluation);
        let mut unit = move || f64::from(stream.next_u32()) / f64::from(u32::MAX);
        let (mut met, mut missed) = (0, 0);
        for _ in 0..4000 {
            let share = unit().powi(2);
            let matter: [[bool; 9]; 7] = std::array::from_fn(|_| std::array::from_fn(|_| unit() < share));
            // Cells along x and y lie in the lowest layer along z.
            let Some(face) = CutFace::new([9, 7, 3], &|cell: [usize; 3]| matter[cell[1]][cell[0]], 2, false) else { continue };
            let (a, b) = (DVec2::new(9.0 * unit(), 7.0 * unit()), DVec2::new(9.0 * unit(), 7.0 * unit()));
            // At corners and borders either answer is right.
            let (least, most) = (crosses(&matter, a, b, -1e-5), crosses(&matter, a, b, 1e-5));
            let found = face.meets(a, b);
            assert!(!least || found, "{a} to {b} crosses {matter:?}");
            assert!(most || !found, "{a} to {b} misses {matter:?}");
            met += usize::from(found);
            missed += usize::from(!found);
        }
        assert!(met > 1000 && missed > 500, "{met} {missed}");
    }
}
