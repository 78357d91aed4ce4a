//! Planes that cut space along one axis: where they lie, and between which two a point is.

/// Largest width of a cell: photons of 60 keV fly 50 mm in tissue.
const CELL_MM: f64 = 8.0;

/// At most so many cells along an axis.
const MOST_CELLS: usize = 160;

/// Planes of things are not nearer to each other than this.
const NEAREST_PLANES_MM: f64 = 0.5;

/// Planes along one axis, and where to begin to look for one.
#[derive(Clone, Debug)]
pub struct Planes {
    /// Ascending, mm.
    pub at: Vec<f64>,
    /// By bucket of equal width, four a plane, the cell in which it begins.
    pub(super) buckets: Vec<u16>,
    per_mm: f64,
}

impl Planes {
    /// Of ascending places, at least two.
    #[must_use]
    pub fn new(at: Vec<f64>) -> Self {
        let (first, last) = (at[0], at[at.len() - 1]);
        let count = 4 * at.len();
        let per_mm = count as f64 / (last - first);
        let cell = |n: usize| at.partition_point(|plane| *plane <= first + n as f64 / per_mm).clamp(1, at.len() - 1) - 1;
        // A bucket's first cell is looked up a bucket early, so that rounding cannot begin past the right one.
        let buckets = (0..count).map(|n| cell(n.saturating_sub(1)) as u16).collect();
        Self { at, buckets, per_mm }
    }

    /// Number of cells.
    #[must_use]
    pub fn cells(&self) -> usize {
        self.at.len() - 1
    }

    /// The cell with coordinate `x`; the first or the last beyond the ends.
    #[inline]
    #[must_use]
    pub fn cell(&self, x: f64) -> usize {
        let bucket = (((x - self.at[0]) * self.per_mm).max(0.0) as usize).min(self.buckets.len() - 1);
        let mut cell = usize::from(self.buckets[bucket]);
        while cell + 1 < self.cells() && self.at[cell + 1] <= x {
            cell += 1;
        }
        cell
    }
}

/// Planes from `low` to `high` that meet `faces` and leave no gap wider than a cell may be.
#[must_use]
pub fn cut(low: f64, high: f64, mut faces: Vec<f64>) -> Vec<f64> {
    faces.extend([low, high]);
    faces.sort_unstable_by(f64::total_cmp);
    let nearest = NEAREST_PLANES_MM.max((high - low) / MOST_CELLS as f64 / 8.0);
    let mut kept: Vec<f64> = vec![low];
    for face in faces {
        if face - kept[kept.len() - 1] > nearest && high - face > nearest && kept.len() < MOST_CELLS / 2 {
            kept.push(face);
        }
    }
    kept.push(high);
    let width = CELL_MM.max((high - low) / MOST_CELLS as f64);
    let mut planes = vec![low];
    for pair in kept.windows(2) {
        let count = ((pair[1] - pair[0]) / width).ceil().max(1.0);
        planes.extend((1..count as usize).map(|n| pair[0] + (pair[1] - pair[0]) * n as f64 / count));
        planes.push(pair[1]);
    }
    planes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::transport::stream::Stream;

    #[test]
    fn planes_meet_faces_and_leave_no_wide_gap() {
        let found = cut(-100.0, 250.0, vec![-100.0, 3.0, 3.1, 77.7, 250.0]);
        assert!(found.windows(2).all(|pair| pair[1] > pair[0] && pair[1] - pair[0] <= CELL_MM));
        assert!(found.contains(&3.0) && found.contains(&77.7) && !found.contains(&3.1), "3.1 is too near to 3.0");
        assert!(cut(0.0, 1e6, (0..5000).map(f64::from).collect()).len() <= 2 * MOST_CELLS);
    }

    #[test]
    fn a_point_is_found_between_its_planes() {
        let planes = Planes::new(vec![-3.0, -2.5, 0.0, 0.1, 0.2, 60.0, 61.0]);
        let mut stream = Stream::new(1, 0);
        for _ in 0..10_000 {
            let x = -3.0 + 64.0 * stream.uniform();
            let cell = planes.cell(x);
            assert!(planes.at[cell] <= x && x < planes.at[cell + 1], "{x}: {cell}");
        }
        assert_eq!((planes.cell(-9.0), planes.cell(99.0), planes.cell(0.1)), (0, 5, 3));
    }
}
