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
    cells: Vec<bool>,
}

impl Occupancy {
    /// Cells within `reach_px` of a shadow; every place may be near one where the table would be too large.
    pub fn new(detections: &[Detection], reach_px: f64) -> Self {
        let bounds = detections.iter().map(|d| (d.image_px, d.image_px)).reduce(|a, b| (a.0.min(b.0), a.1.max(b.1)));
        let anywhere = Self { corner_px: DVec2::ZERO, columns: 0, cells: Vec::new() };
        let Some((low, high)) = bounds else { return anywhere };
        let corner_px = low - DVec2::splat(reach_px + CELL_PX);
        let size = ((high - low + DVec2::splat(2.0 * (reach_px + CELL_PX))) / CELL_PX).ceil() + DVec2::ONE;
        if !(size.max_element() <= MOST_CELLS) {
            return anywhere;
        }
        let [columns, rows] = [size.x as usize, size.y as usize];
        let mut cells = vec![false; columns * rows];
        // Half a cell's diagonal is less than a cell.
        let reach = reach_px + CELL_PX;
        for detection in detections {
            let at = detection.image_px - corner_px;
            let [first, last] = [-reach, reach].map(|by| ((at + DVec2::splat(by)) / CELL_PX).floor().max(DVec2::ZERO));
            for row in first.y as usize..=(last.y as usize).min(rows - 1) {
                for column in first.x as usize..=(last.x as usize).min(columns - 1) {
                    let middle = (DVec2::new(column as f64, row as f64) + 0.5) * CELL_PX;
                    cells[row * columns + column] |= middle.distance(at) <= reach;
                }
            }
        }
        Self { corner_px, columns, cells }
    }

    /// Whether a shadow may be within reach of a place.
    pub fn may_be_near(&self, at_px: DVec2) -> bool {
        if self.columns == 0 {
            return true;
        }
        let cell = (at_px - self.corner_px) / CELL_PX;
        if !(cell.x >= 0.0 && cell.y >= 0.0 && cell.x < self.columns as f64) {
            return false;
        }
        self.cells.get(cell.y as usize * self.columns + cell.x as usize).copied().unwrap_or(false)
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
                let is_near = shadows.iter().any(|shadow| shadow.image_px.distance(at) <= reach_px);
                assert!(!is_near || table.may_be_near(at), "{at} of {reach_px}");
                near += usize::from(is_near);
                told += usize::from(table.may_be_near(at));
            }
            assert!(told <= 2 * near + 2000, "{told} told, {near} near");
            assert!(!table.may_be_near(DVec2::NAN));
        }
        assert!(!Occupancy::new(&[Detection::default()], 3.0).may_be_near(DVec2::splat(60.0)));
        assert!(Occupancy::new(&[], 3.0).may_be_near(DVec2::ZERO));
    }
}
