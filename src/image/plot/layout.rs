//! Where the values of a plot lie in its drawing, in user units.

use super::legend;
use super::parts::{Axis, Place, Plot, PlotError};
use crate::image::ticks::{Scale, Tick, round_range, ticks};

/// Between the end of the axes and the words below them.
const BELOW: f64 = 18.0;
/// Between the axes and the words at their left.
const BESIDE: f64 = 8.0;

/// The drawing and its axes.
pub(super) struct Layout {
    pub width: f64,
    pub height: f64,
    /// Ends of the axes.
    pub left: f64,
    pub right: f64,
    pub top: f64,
    pub bottom: f64,
    pub scales: [Scale; 2],
    pub ranges: [[f64; 2]; 2],
    /// Decimals of places: a page holds many lines of many points.
    pub decimals: usize,
    /// Round numbers along x and y, about so many.
    counts: [usize; 2],
}

impl Layout {
    pub fn of(plot: &Plot) -> Result<Self, PlotError> {
        let counts = match plot.place {
            Place::Alone => [6, 6],
            Place::InPage { height } => [8, ((height / 40.0) as usize).max(2)],
        };
        let (scales, ranges) = ([plot.x.scale, plot.y.scale], ranges(plot, counts)?);
        let layout = match plot.place {
            Place::Alone => Self {
                width: 760.0,
                height: 460.0,
                left: 78.0,
                right: 742.0,
                top: 44.0,
                bottom: 404.0,
                scales,
                ranges,
                decimals: 2,
                counts,
            },
            Place::InPage { height } => {
                let names = plot.y.named.iter().map(|tick| legend::width_of(&tick.label) + 2.0 * BESIDE);
                let left = names.fold(62.0, f64::max);
                let (width, right) = (640.0, 626.0);
                let top = 10.0 + legend::height(&plot.series, right - left);
                let bottom = top + height;
                Self { width, height: bottom + 42.0, left, right, top, bottom, scales, ranges, decimals: 1, counts }
            }
        };
        Ok(layout)
    }

    pub fn u(&self, x: f64) -> f64 {
        self.left + self.scales[0].fraction(x, self.ranges[0]) * (self.right - self.left)
    }

    pub fn v(&self, y: f64) -> f64 {
        self.bottom - self.scales[1].fraction(y, self.ranges[1]) * (self.bottom - self.top)
    }

    /// Place of a point, or `None` where the axes have none for it. Far outside is as good as outside: numbers stay short.
    pub fn place(&self, point: [f64; 2]) -> Option<[f64; 2]> {
        let shown = self.scales[0].can_show(point[0]) && self.scales[1].can_show(point[1]);
        shown.then(|| [self.u(point[0]).clamp(-1e4, 1e4), self.v(point[1]).clamp(-1e4, 1e4)])
    }

    /// What stands along the axes: its place, and that of its words. Names have no lines across the axes.
    pub fn along(&self, side: usize, axis: &Axis) -> Vec<Label> {
        let is_named = !axis.named.is_empty();
        let ticks = if is_named { axis.named.clone() } else { ticks(axis.scale, self.ranges[side], self.counts[side]) };
        let label = |Tick { value, label }: Tick| {
            let at = if side == 0 { self.u(value) } else { self.v(value) };
            let words = if side == 0 { [at, self.bottom + BELOW] } else { [self.left - BESIDE, at + 4.0] };
            Label { at, has_line: !is_named, words, label }
        };
        ticks.into_iter().map(label).collect()
    }
}

/// See [`Layout::along`].
pub(super) struct Label {
    pub at: f64,
    pub has_line: bool,
    pub words: [f64; 2],
    pub label: String,
}

/// First and last value of both axes.
fn ranges(plot: &Plot, counts: [usize; 2]) -> Result<[[f64; 2]; 2], PlotError> {
    let axes = [&plot.x, &plot.y];
    let all = || plot.series.iter().flat_map(|series| series.points.iter());
    let drawn: Vec<&[f64; 2]> = all().filter(|point| (0..2).all(|i| axes[i].scale.can_show(point[i]))).collect();
    if drawn.is_empty() {
        return Err(PlotError::NothingToDraw { title: plot.title.clone(), found: all().count() });
    }
    let mut ranges = [[0.0; 2]; 2];
    for (i, axis) in axes.into_iter().enumerate() {
        ranges[i] = match axis.range {
            Some([from, to]) if axis.scale.can_show(from) && axis.scale.can_show(to) && from < to => [from, to],
            Some([from, to]) => {
                return Err(PlotError::Range { title: plot.title.clone(), axis: axis.label.clone(), from, to });
            }
            None => {
                let held = axis.holds.filter(|value| axis.scale.can_show(*value));
                let values = || drawn.iter().map(move |point| point[i]).chain(held);
                let (low, high) = (values().fold(f64::INFINITY, f64::min), values().fold(f64::NEG_INFINITY, f64::max));
                round_range(axis.scale, low, high, counts[i])
            }
        };
    }
    Ok(ranges)
}
