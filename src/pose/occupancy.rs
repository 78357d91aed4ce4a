//! Where in a frame shadows are, in cells: most places that a wrong pose predicts are near none, and a look into a table tells so.

use glam::DVec2;

use crate::beads::Detection;

/// Side of a cell.
const CELL_PX: f64 = 8.0;
/// Cells along a side, at most; shadows beyond are as good as anywhere.
const MOST_CELLS: f64 = 1024.0;

/// See the module.
pub(super) struct Occupancy {
    corner_px: DVec2,
    columns: usize,
    rows: usize,
    /// Row by row; the last is what lies outside of all.
    is_near: Vec<bool>,
    /// Where the shadows that are near each cell begin in `shadows`, and where those of the last end.
    first: Vec<usize>,
    shadows: Vec<usize>,
}

impl Occupancy {
    /// Cells within `reach_px` of a shadow; every place may be near any where the table would be too large.
    pub fn new(detections: &[Detection], reach_px: f64) -> Self {
        let bounds = detections.iter().map(|d| (d.image_px, d.image_px)).reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)));
        let all = detections.len();
        let (is_near, first, shadows) = (vec![true], vec![0, all], (0..all).collect());
        let anywhere = Self { corner_px: DVec2::ZERO, columns: 0, rows: 0, is_near, first, shadows };
        let Some((low, high)) = bounds else { return anywhere };
        let corner_px = low - DVec2::splat(reach_px + CELL_PX);
        let size = ((high - low + DVec2::splat(2.0 * (reach_px + CELL_PX))) / CELL_PX).ceil() + DVec2::ONE;
        if !(size.max_element() <= MOST_CELLS) {
            return anywhere;
        }
        let [columns, rows] = [size.x as usize, size.y as usize];
        // Half a cell's diagonal is less than a cell.
        let reach = reach_px + CELL_PX;
        let mut near: Vec<(usize, usize)> = Vec::new();
        for (n, detection) in detections.iter().enumerate() {
            let at = detection.image_px - corner_px;
            let [low, high] = [-reach, reach].map(|by| ((at + DVec2::splat(by)) / CELL_PX).floor().max(DVec2::ZERO));
            for row in low.y as usize..=(high.y as usize).min(rows - 1) {
                for column in low.x as usize..=(high.x as usize).min(columns - 1) {
                    let middle = (DVec2::new(column as f64, row as f64) + 0.5) * CELL_PX;
                    if middle.distance(at) <= reach {
                        near.push((row * columns + column, n));
                    }
                }
            }
        }
        // Counted, then each to its place, in the order of shadows.
        let outside = columns * rows;
        let mut first = vec![0; outside + 2];
        near.iter().for_each(|(cell, _)| first[cell + 1] += 1);
        let is_near = first[1..].iter().map(|count| *count > 0).collect();
        (0..=outside).for_each(|cell| first[cell + 1] += first[cell]);
        let (mut next, mut shadows) = (first.clone(), vec![0; near.len()]);
        for (cell, n) in near {
            shadows[next[cell]] = n;
            next[cell] += 1;
        }
        Self { corner_px, columns, rows, is_near, first, shadows }
    }

    /// In cells from the corner, and whether any is there.
    #[inline(always)]
    fn in_cells(&self, at_px: DVec2) -> ([f64; 2], bool) {
        let [x, y] = [(at_px.x - self.corner_px.x) / CELL_PX, (at_px.y - self.corner_px.y) / CELL_PX];
        ([x, y], (x >= 0.0) & (y >= 0.0) & (x < self.columns as f64) & (y < self.rows as f64))
    }

    /// The number of the cell of a place. No branch, and no conversion that a vector cannot do: adding 2⁵² leaves a whole number in the last bits.
    #[inline(always)]
    pub fn cell(&self, at_px: DVec2) -> u32 {
        let ([x, y], is_inside) = self.in_cells(at_px);
        let columns = self.columns as f64;
        let cell = if is_inside { y.floor() * columns + x.floor() } else { columns * self.rows as f64 };
        (cell + 4_503_599_627_370_496.0).to_bits() as u32
    }

    /// Whether a shadow may be within reach of a place in a cell.
    #[inline(always)]
    pub fn is_near(&self, cell: u32) -> bool {
        self.is_near[cell as usize]
    }

    /// All that may be within reach of a place, in their order.
    pub fn near(&self, at_px: DVec2) -> &[usize] {
        let ([x, y], is_inside) = self.in_cells(at_px);
        let cell = if is_inside { y as usize * self.columns + x as usize } else { self.columns * self.rows };
        &self.shadows[self.first[cell]..self.first[cell + 1]]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Stream};

    #[test]
    fn no_place_within_reach_is_passed_over_and_most_others_are() {
        let mut random = Stream::new(7, 0, 0, Purpose::Evaluation);
        for reach_px in [1.0, 6.5, 40.0] {
            let mut place = || DVec2::new(random.uniform(), random.uniform()) * 1400.0 - 200.0;
            let shadows: Vec<Detection> = (0..12).map(|_| Detection { image_px: place(), ..Detection::default() }).collect();
            let table = Occupancy::new(&shadows, reach_px);
            let (mut near, mut told) = (0, 0);
            for at in (0..20_000).map(|_| place()) {
                let of_place = table.near(at);
                let is_missed = |n: &usize| shadows[*n].image_px.distance(at) <= reach_px && !of_place.contains(n);
                assert!(!(0..shadows.len()).any(|n| is_missed(&n)), "{at} of {reach_px}: {of_place:?}");
                assert!(of_place.is_sorted() && table.is_near(table.cell(at)) != of_place.is_empty());
                near += shadows.iter().filter(|shadow| shadow.image_px.distance(at) <= reach_px).count();
                told += of_place.len();
            }
            assert!(told <= 2 * near + 2000, "{told} told, {near} near");
            assert!(table.near(DVec2::NAN).is_empty());
        }
        assert!(Occupancy::new(&[Detection::default()], 3.0).near(DVec2::splat(60.0)).is_empty());
        // No table: any may be near.
        assert!(Occupancy::new(&[], 3.0).is_near(0));
        let apart = [0.0, 1e5].map(|u| Detection { image_px: DVec2::new(u, 0.0), ..Detection::default() });
        assert_eq!(Occupancy::new(&apart, 3.0).near(DVec2::NAN), [0, 1]);
    }
}
