//! A face of a grid that holds matter, and whether a straight line along it meets that matter.

use glam::DVec2;

/// A stretch shorter than this, in cells, lies in one cell.
const SHORT: f64 = 1e-3;

/// A face with tissue: cells of its layer, and how many of those in any rectangle hold matter.
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
        (bounds[0][0] < bounds[1][0]).then_some(Self { axis, high, size, sums, bounds })
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
    #[must_use]
    pub fn meets(&self, a: DVec2, b: DVec2) -> bool {
        let (low, high) = (a.min(b), a.max(b));
        match self.count(low, high) {
            (0, _) => false,
            (found, all) if found == all => true,
            _ if !(a.distance(b) > SHORT) => true,
            _ => {
                let middle = 0.5 * (a + b);
                self.meets(a, middle) || self.meets(middle, b)
            }
        }
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
