//! Where the panes lie, so that pictures fill the screen.

use eframe::egui::{Rect, pos2};

use super::state::Arrangement;

/// What a pane shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Pane {
    Acquired,
    Drr,
    Difference,
    Overlay,
}

/// Between panes.
const GAP: f32 = 4.0;
/// Shares of the side that the two large panes may have.
const SHARES: std::ops::RangeInclusive<u32> = 50..=75;

/// The panes of `arrangement` within `area`, for frames `aspect` times as wide as high.
pub(super) fn panes(area: Rect, aspect: f32, arrangement: Arrangement) -> Vec<(Pane, Rect)> {
    let large = [Pane::Acquired, Pane::Drr];
    match arrangement {
        Arrangement::Difference => vec![(Pane::Difference, area)],
        Arrangement::Overlay => vec![(Pane::Overlay, area)],
        Arrangement::Two => best(aspect, vec![beside(area, large), below(area, large)]),
        Arrangement::All => {
            let small = [Pane::Difference, Pane::Overlay];
            let split = |share: u32| {
                let share = share as f32 / 100.0;
                let (upper, lower) = rows(area, share);
                let (left, right) = columns(area, share);
                let in_rows = [beside(upper, large), beside(lower, small)].concat();
                let in_columns = [below(left, large), below(right, small)].concat();
                let column_right = columns(area, 2.0 * share / (1.0 + share));
                let large_and_column = [beside(column_right.0, large), below(column_right.1, small)].concat();
                [in_rows, in_columns, large_and_column]
            };
            best(aspect, SHARES.flat_map(split).collect())
        }
    }
}

/// The one whose pictures are largest.
fn best(aspect: f32, candidates: Vec<Vec<(Pane, Rect)>>) -> Vec<(Pane, Rect)> {
    let shown = |panes: &Vec<(Pane, Rect)>| panes.iter().map(|(_, pane)| picture_area(*pane, aspect)).sum::<f32>();
    candidates.into_iter().max_by(|a, b| shown(a).total_cmp(&shown(b))).unwrap_or_default()
}

/// Of a whole frame in `pane`.
fn picture_area(pane: Rect, aspect: f32) -> f32 {
    let width = pane.width().min(pane.height() * aspect);
    width * width / aspect
}

fn rows(area: Rect, share: f32) -> (Rect, Rect) {
    let at = area.top() + share * (area.height() - GAP);
    (Rect::from_min_max(area.min, pos2(area.right(), at)), Rect::from_min_max(pos2(area.left(), at + GAP), area.max))
}

fn columns(area: Rect, share: f32) -> (Rect, Rect) {
    let at = area.left() + share * (area.width() - GAP);
    (Rect::from_min_max(area.min, pos2(at, area.bottom())), Rect::from_min_max(pos2(at + GAP, area.top()), area.max))
}

fn beside(area: Rect, [left, right]: [Pane; 2]) -> Vec<(Pane, Rect)> {
    let (first, second) = columns(area, 0.5);
    vec![(left, first), (right, second)]
}

fn below(area: Rect, [upper, lower]: [Pane; 2]) -> Vec<(Pane, Rect)> {
    let (first, second) = rows(area, 0.5);
    vec![(upper, first), (lower, second)]
}

#[cfg(test)]
mod tests {
    use eframe::egui::vec2;

    use super::*;

    #[test]
    fn panes_do_not_overlap_and_acquired_and_drr_are_the_larger_ones() {
        for (size, aspect) in [((1090.0, 800.0), 1.29), ((1090.0, 800.0), 1.0), ((1600.0, 500.0), 1.29), ((700.0, 1000.0), 0.8)] {
            let area = Rect::from_min_size(pos2(310.0, 30.0), vec2(size.0, size.1));
            for arrangement in Arrangement::ALL {
                let panes = panes(area, aspect, arrangement);
                assert!(!panes.is_empty());
                for (n, (pane, rect)) in panes.iter().enumerate() {
                    assert!(area.expand(0.1).contains_rect(*rect), "{pane:?}");
                    assert!(panes[n + 1..].iter().all(|(_, other)| !rect.shrink(0.1).intersects(*other)), "{arrangement:?}");
                }
                let of = |wanted: Pane| panes.iter().find(|(pane, _)| *pane == wanted).map(|(_, r)| picture_area(*r, aspect));
                if let (Some(acquired), Some(difference)) = (of(Pane::Acquired), of(Pane::Difference)) {
                    // Halves of the same width are as large.
                    assert!(acquired >= (1.0 - 1e-5) * difference, "{arrangement:?} {size:?}");
                }
            }
        }
    }
}
