//! Plots over time as inline SVG; colours come from the style sheet, so that they follow light and dark.

use std::fmt::Write as _;

use maud::{Markup, html};

use super::colour::short;
use crate::image::round_values;

/// Drawn width in user units; the page scales it.
const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 210.0;
const LEFT: f64 = 58.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 14.0;
const BOTTOM: f64 = 34.0;

/// A dot of a plot over exposures.
pub(super) struct Dot {
    /// Seconds since the session's start.
    pub time_s: f64,
    pub value: f64,
    /// Class of its colour.
    pub class: &'static str,
    /// A second value, drawn hollow and joined to the first.
    pub against: Option<f64>,
    pub label: String,
}

/// Maps values to the drawing.
struct Axes {
    x: [f64; 2],
    y: [f64; 2],
    /// Of time; else the horizontal axis is left to the caller.
    timed: bool,
}

impl Axes {
    fn new(time_s: Option<[f64; 2]>, y: [f64; 2]) -> Self {
        let wide = |range: [f64; 2]| if range[1] > range[0] { range } else { [range[0] - 0.5, range[0] + 0.5] };
        Self { x: time_s.map_or([0.0, 1.0], wide), y: wide(y), timed: time_s.is_some() }
    }

    fn u(&self, x: f64) -> f64 {
        LEFT + (x - self.x[0]) / (self.x[1] - self.x[0]) * (WIDTH - LEFT - RIGHT)
    }

    fn v(&self, y: f64) -> f64 {
        HEIGHT - BOTTOM - (y - self.y[0]) / (self.y[1] - self.y[0]) * (HEIGHT - TOP - BOTTOM)
    }

    /// `inside` with grid and labels.
    fn around(&self, label: &str, inside: &Markup) -> Markup {
        html! {
            svg viewBox={ "0 0 " (WIDTH) " " (HEIGHT) } role="img" aria-label=(label) {
                @for value in round_values(self.y, 4) {
                    @let v = self.v(value);
                    line class="grid" x1=(LEFT) x2=(WIDTH - RIGHT) y1=(tenths(v)) y2=(tenths(v)) {}
                    (tick("end", LEFT - 8.0, v + 4.0, &short(value, self.y[1] - self.y[0])))
                }
                @if self.timed {
                    @for value in round_values(self.x, 8) {
                        (tick("middle", self.u(value), HEIGHT - 16.0, &short(value, self.x[1] - self.x[0])))
                    }
                }
                (tick("end", WIDTH - RIGHT, HEIGHT - 2.0, if self.timed { "s since start" } else { "exposure" }))
                (inside)
            }
        }
    }
}

/// A place in the drawing.
fn tenths(at: f64) -> String {
    format!("{at:.1}")
}

fn tick(anchor: &str, x: f64, y: f64, words: &str) -> Markup {
    html! { text class="tick" x=(tenths(x)) y=(tenths(y)) text-anchor=(anchor) { (words) } }
}

/// The span of `values`, widened by a tenth; from zero when `from_zero`.
fn span(values: impl Iterator<Item = f64>, from_zero: bool) -> Option<[f64; 2]> {
    let (low, high) = values.filter(|v| v.is_finite()).fold((f64::MAX, f64::MIN), |(low, high), v| (low.min(v), high.max(v)));
    if low > high {
        return None;
    }
    let low = if from_zero { low.min(0.0) } else { low };
    let margin = (0.1 * (high - low)).max(1e-3 * high.abs()).max(1e-9);
    Some([if from_zero && low == 0.0 { 0.0 } else { low - margin }, high + margin])
}

/// One dot per exposure over time; `None` when nothing is finite.
pub(super) fn dots(label: &str, dots: &[Dot], time_s: [f64; 2], from_zero: bool) -> Option<Markup> {
    let y = span(dots.iter().flat_map(|dot| [Some(dot.value), dot.against].into_iter().flatten()), from_zero)?;
    let axes = Axes::new(Some(time_s), y);
    let inside = html! {
        @for dot in dots.iter().filter(|dot| dot.value.is_finite()) {
            @let (u, v) = (tenths(axes.u(dot.time_s)), tenths(axes.v(dot.value)));
            @if let Some(against) = dot.against.filter(|against| against.is_finite()) {
                @let against = tenths(axes.v(against));
                line class="stem" x1=(u) x2=(u) y1=(v) y2=(against) {}
                circle class="hollow" cx=(u) cy=(against) r="4" {}
            }
            circle class={ "dot " (dot.class) } cx=(u) cy=(v) r="5" { title { (dot.label) } }
        }
    };
    Some(axes.around(label, &inside))
}

/// One stacked bar per exposure, and the legend. `None` when there is nothing to stack.
pub(super) fn stacks(label: &str, names: &[String], bars: &[(String, Vec<f64>)]) -> Option<Markup> {
    let total = |values: &[f64]| values.iter().filter(|v| v.is_finite()).sum::<f64>();
    let highest = bars.iter().map(|(_, values)| total(values)).fold(0.0, f64::max);
    if names.is_empty() || !(highest > 0.0) {
        return None;
    }
    let axes = Axes::new(None, [0.0, 1.08 * highest]);
    let slot = (WIDTH - LEFT - RIGHT) / bars.len() as f64;
    let width = (0.62 * slot).min(46.0);
    let inside = html! {
        @for (index, (name, values)) in bars.iter().enumerate() {
            @let centre = LEFT + (index as f64 + 0.5) * slot;
            @for (stage, value, below) in piled(values) {
                @let (top, bottom) = (axes.v(below + value), axes.v(below));
                rect class={ "s" (stage % 8) } x=(tenths(centre - 0.5 * width)) width=(tenths(width)) y=(format!("{top:.2}"))
                    height=(format!("{:.2}", bottom - top)) {
                    title { (names.get(stage).map_or("", String::as_str)) ": " (short(value, value)) " ms" }
                }
            }
            @if slot > 16.0 || index.is_multiple_of(5) { (tick("middle", centre, HEIGHT - 16.0, name)) }
        }
    };
    Some(html! { (axes.around(label, &inside)) (legend(names)) })
}

/// Of each value above zero: its place, itself, and the sum of those before it.
fn piled(values: &[f64]) -> Vec<(usize, f64, f64)> {
    let mut below = 0.0;
    let mut pile = |(stage, value): (usize, &f64)| {
        let before = below;
        below += value;
        (stage, *value, before)
    };
    values.iter().enumerate().filter(|(_, value)| **value > 0.0).map(&mut pile).collect()
}

/// Lines over time, and the legend. `None` when nothing is finite.
pub(super) fn lines(label: &str, series: &[(String, Vec<(f64, f64)>)], time_s: [f64; 2], marks_s: &[f64]) -> Option<Markup> {
    let y = span(series.iter().flat_map(|(_, points)| points.iter().map(|p| p.1)), false)?;
    let axes = Axes::new(Some(time_s), y);
    let inside = html! {
        @for u in marks_s.iter().map(|mark| tenths(axes.u(*mark))) {
            line class="mark" x1=(u) x2=(u) y1=(TOP) y2=(HEIGHT - BOTTOM) {}
        }
        @for (index, (_, points)) in series.iter().enumerate() {
            path class={ "line c" (index % 8) } d=(path(&axes, points)) {}
        }
    };
    let names: Vec<String> = series.iter().map(|(name, _)| name.clone()).collect();
    Some(html! { (axes.around(label, &inside)) (legend(&names)) })
}

/// The line through `points`, broken where one is not finite.
fn path(axes: &Axes, points: &[(f64, f64)]) -> String {
    // More points than the drawing has columns only make the file large.
    let step = points.len().div_ceil(900).max(1);
    let mut path = String::new();
    let mut command = 'M';
    for (time, value) in points.iter().step_by(step) {
        if value.is_finite() {
            let _ = write!(path, "{command}{:.1} {:.1}", axes.u(*time), axes.v(*value));
        }
        command = if value.is_finite() { 'L' } else { 'M' };
    }
    path
}

/// A link over time: when it was there, and when and why it was gone.
pub(super) struct Band {
    pub name: String,
    /// First and last sample.
    pub there_s: [f64; 2],
    pub gaps: Vec<([f64; 2], String)>,
}

/// A horizontal band per link: there, and gone.
pub(super) fn links(label: &str, bands: &[Band], time_s: [f64; 2]) -> Markup {
    let row = 34.0;
    let height = 10.0 + row * bands.len() as f64 + 30.0;
    let span = (time_s[1] - time_s[0]).max(1e-6);
    let u = |t: f64| 88.0 + ((t - time_s[0]) / span).clamp(0.0, 1.0) * (WIDTH - 88.0 - RIGHT);
    let block = |class: &str, v: f64, [from, to]: [f64; 2], least: f64, words: &Markup| {
        let (from, to) = (u(from), u(to));
        html! { rect class=(class) x=(tenths(from)) y=(tenths(v)) width=(tenths((to - from).max(least))) height="20" rx="3" { (words) } }
    };
    html! {
        svg viewBox={ "0 0 " (WIDTH) " " (height) } role="img" aria-label=(label) {
            @for (index, Band { name, there_s, gaps }) in bands.iter().enumerate() {
                @let v = 8.0 + row * index as f64;
                (tick("end", 78.0, v + 15.0, name))
                (block("there", v, *there_s, 1.0, &html! {}))
                @for (gap_s, reason) in gaps {
                    (block("gone", v, *gap_s, 2.0, &html! { title { (reason) (format!(" ({:.2} s)", gap_s[1] - gap_s[0])) } }))
                }
            }
            @for value in round_values(time_s, 8) { (tick("middle", u(value), height - 18.0, &short(value, span))) }
            (tick("end", WIDTH - RIGHT, height - 3.0, "s since start"))
        }
    }
}

fn legend(names: &[String]) -> Markup {
    html! {
        p class="legend" { @for (index, name) in names.iter().enumerate() { span class={ "key k" (index % 8) } { (name) } } }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_from_outside_cannot_break_the_page() {
        let drawn =
            lines("\"<joints>", &[("<script>&\"".into(), vec![(0.0, 1.0), (1.0, 2.0)])], [0.0, 1.0], &[]).expect("finite");
        let svg = drawn.into_string();
        assert!(!svg.contains("<script>") && svg.contains("&lt;script&gt;") && svg.contains("\"&quot;&lt;joints&gt;\""), "{svg}");
        assert!(lines("empty", &[("a".into(), vec![(0.0, f64::NAN)])], [0.0, 1.0], &[]).is_none());
    }
}
