//! Plots over time as inline SVG; colours come from the style sheet, so that they follow light and dark.

use std::fmt::Write as _;

use super::colour::{round_up, short};

/// Drawn width in user units; the page scales it.
const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 210.0;
const LEFT: f64 = 58.0;
const RIGHT: f64 = 14.0;
const TOP: f64 = 14.0;
const BOTTOM: f64 = 34.0;

/// Text as it may stand in HTML and SVG.
pub(super) fn escape(text: &str) -> String {
    let mut safe = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => safe.push_str("&amp;"),
            '<' => safe.push_str("&lt;"),
            '>' => safe.push_str("&gt;"),
            '"' => safe.push_str("&quot;"),
            '\'' => safe.push_str("&#39;"),
            _ => safe.push(c),
        }
    }
    safe
}

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

/// Axes, grid and labels; maps values to the drawing.
struct Axes {
    svg: String,
    x: [f64; 2],
    y: [f64; 2],
}

impl Axes {
    /// Without `x` the horizontal axis is left to the caller.
    fn new(label: &str, x: Option<[f64; 2]>, y: [f64; 2]) -> Self {
        let mut svg = format!("<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{}\">", escape(label));
        let timed = x.is_some();
        let x = x.map_or([0.0, 1.0], |x| if x[1] > x[0] { x } else { [x[0] - 0.5, x[0] + 0.5] });
        let y = if y[1] > y[0] { y } else { [y[0] - 0.5, y[0] + 0.5] };
        let axes = Self { svg: String::new(), x, y };
        for value in ticks(y, 4) {
            let v = axes.v(value);
            let text = short(value, y[1] - y[0]);
            let _ = write!(
                svg,
                "<line class=\"grid\" x1=\"{LEFT}\" x2=\"{}\" y1=\"{v:.1}\" y2=\"{v:.1}\"/><text class=\"tick\" x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">{text}</text>",
                WIDTH - RIGHT,
                LEFT - 8.0,
                v + 4.0
            );
        }
        for value in if timed { ticks(x, 8) } else { Vec::new() } {
            let u = axes.u(value);
            let _ = write!(
                svg,
                "<text class=\"tick\" x=\"{u:.1}\" y=\"{}\" text-anchor=\"middle\">{}</text>",
                HEIGHT - 16.0,
                short(value, x[1] - x[0])
            );
        }
        let what = if timed { "s since start" } else { "exposure" };
        let _ =
            write!(svg, "<text class=\"tick\" x=\"{}\" y=\"{}\" text-anchor=\"end\">{what}</text>", WIDTH - RIGHT, HEIGHT - 2.0);
        Self { svg, ..axes }
    }

    fn u(&self, x: f64) -> f64 {
        LEFT + (x - self.x[0]) / (self.x[1] - self.x[0]) * (WIDTH - LEFT - RIGHT)
    }

    fn v(&self, y: f64) -> f64 {
        HEIGHT - BOTTOM - (y - self.y[0]) / (self.y[1] - self.y[0]) * (HEIGHT - TOP - BOTTOM)
    }

    fn finish(mut self) -> String {
        self.svg.push_str("</svg>");
        self.svg
    }
}

/// Round values within `range`, about `count` of them.
fn ticks(range: [f64; 2], count: usize) -> Vec<f64> {
    let step = round_up((range[1] - range[0]) / (1.6 * count as f64));
    let first = (range[0] / step - 1e-9).ceil() as i64;
    (0..=2 * count as i64).map(|i| (first + i) as f64 * step).take_while(|value| *value <= range[1] + 1e-9 * step).collect()
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
pub(super) fn dots(label: &str, dots: &[Dot], time_s: [f64; 2], from_zero: bool) -> Option<String> {
    let y = span(dots.iter().flat_map(|dot| [Some(dot.value), dot.against].into_iter().flatten()), from_zero)?;
    let mut axes = Axes::new(label, Some(time_s), y);
    for dot in dots.iter().filter(|dot| dot.value.is_finite()) {
        let (u, v) = (axes.u(dot.time_s), axes.v(dot.value));
        if let Some(against) = dot.against.filter(|a| a.is_finite()).map(|against| axes.v(against)) {
            let _ = write!(axes.svg, "<line class=\"stem\" x1=\"{u:.1}\" x2=\"{u:.1}\" y1=\"{v:.1}\" y2=\"{against:.1}\"/>");
            let _ = write!(axes.svg, "<circle class=\"hollow\" cx=\"{u:.1}\" cy=\"{against:.1}\" r=\"4\"/>");
        }
        let class = dot.class;
        let _ = write!(
            axes.svg,
            "<circle class=\"dot {class}\" cx=\"{u:.1}\" cy=\"{v:.1}\" r=\"5\"><title>{}</title></circle>",
            escape(&dot.label)
        );
    }
    Some(axes.finish())
}

/// One stacked bar per exposure; returns the drawing and its legend. `None` when there is nothing to stack.
pub(super) fn stacks(label: &str, names: &[String], bars: &[(String, Vec<f64>)]) -> Option<(String, String)> {
    let total = |values: &[f64]| values.iter().filter(|v| v.is_finite()).sum::<f64>();
    let highest = bars.iter().map(|(_, values)| total(values)).fold(0.0, f64::max);
    if names.is_empty() || !(highest > 0.0) {
        return None;
    }
    let mut axes = Axes::new(label, None, [0.0, 1.08 * highest]);
    let slot = (WIDTH - LEFT - RIGHT) / bars.len() as f64;
    let width = (0.62 * slot).min(46.0);
    for (index, (name, values)) in bars.iter().enumerate() {
        let centre = LEFT + (index as f64 + 0.5) * slot;
        let mut below = 0.0;
        for (stage, value) in values.iter().enumerate().filter(|(_, value)| **value > 0.0) {
            let (top, bottom) = (axes.v(below + value), axes.v(below));
            let _ = write!(
                axes.svg,
                "<rect class=\"s{}\" x=\"{:.1}\" y=\"{top:.2}\" width=\"{width:.1}\" height=\"{:.2}\"><title>{}: {} ms</title></rect>",
                stage % 8,
                centre - 0.5 * width,
                bottom - top,
                escape(names.get(stage).map_or("", String::as_str)),
                short(*value, *value)
            );
            below += value;
        }
        if slot > 16.0 || index % 5 == 0 {
            let _ = write!(
                axes.svg,
                "<text class=\"tick\" x=\"{centre:.1}\" y=\"{}\" text-anchor=\"middle\">{}</text>",
                HEIGHT - 16.0,
                escape(name)
            );
        }
    }
    Some((axes.finish(), legend(names)))
}

/// Lines over time; returns the drawing and its legend. `None` when nothing is finite.
pub(super) fn lines(
    label: &str,
    series: &[(String, Vec<(f64, f64)>)],
    time_s: [f64; 2],
    marks_s: &[f64],
) -> Option<(String, String)> {
    let y = span(series.iter().flat_map(|(_, points)| points.iter().map(|p| p.1)), false)?;
    let mut axes = Axes::new(label, Some(time_s), y);
    for mark in marks_s {
        let u = axes.u(*mark);
        let _ = write!(axes.svg, "<line class=\"mark\" x1=\"{u:.1}\" x2=\"{u:.1}\" y1=\"{TOP}\" y2=\"{}\"/>", HEIGHT - BOTTOM);
    }
    for (index, (_, points)) in series.iter().enumerate() {
        // More points than the drawing has columns only make the file large.
        let step = points.len().div_ceil(900).max(1);
        let mut path = String::new();
        let mut pen_down = false;
        for (time, value) in points.iter().step_by(step) {
            if !value.is_finite() {
                pen_down = false;
                continue;
            }
            let command = if pen_down { 'L' } else { 'M' };
            let _ = write!(path, "{command}{:.1} {:.1}", axes.u(*time), axes.v(*value));
            pen_down = true;
        }
        let _ = write!(axes.svg, "<path class=\"line c{}\" d=\"{path}\"/>", index % 8);
    }
    let names: Vec<String> = series.iter().map(|(name, _)| name.clone()).collect();
    Some((axes.finish(), legend(&names)))
}

/// A link over time: when it was there, and when and why it was gone.
pub(super) struct Band {
    pub name: String,
    /// First and last sample.
    pub there_s: [f64; 2],
    pub gaps: Vec<([f64; 2], String)>,
}

/// A horizontal band per link: there, and gone.
pub(super) fn links(label: &str, bands: &[Band], time_s: [f64; 2]) -> String {
    let row = 34.0;
    let height = 10.0 + row * bands.len() as f64 + 30.0;
    let span = (time_s[1] - time_s[0]).max(1e-6);
    let u = |t: f64| 88.0 + ((t - time_s[0]) / span).clamp(0.0, 1.0) * (WIDTH - 88.0 - RIGHT);
    let mut svg = format!("<svg viewBox=\"0 0 {WIDTH} {height}\" role=\"img\" aria-label=\"{}\">", escape(label));
    for (index, Band { name, there_s: there, gaps }) in bands.iter().enumerate() {
        let v = 8.0 + row * index as f64;
        let _ = write!(svg, "<text class=\"tick\" x=\"78\" y=\"{:.1}\" text-anchor=\"end\">{}</text>", v + 15.0, escape(name));
        let (from, to) = (u(there[0]), u(there[1]));
        let _ = write!(
            svg,
            "<rect class=\"there\" x=\"{from:.1}\" y=\"{v:.1}\" width=\"{:.1}\" height=\"20\" rx=\"3\"/>",
            (to - from).max(1.0)
        );
        for (gap, reason) in gaps {
            let (from, to) = (u(gap[0]), u(gap[1]));
            let _ = write!(
                svg,
                "<rect class=\"gone\" x=\"{from:.1}\" y=\"{v:.1}\" width=\"{:.1}\" height=\"20\"><title>{} ({:.2} s)</title></rect>",
                (to - from).max(2.0),
                escape(reason),
                gap[1] - gap[0]
            );
        }
    }
    for value in ticks(time_s, 8) {
        let at = u(value);
        let _ = write!(
            svg,
            "<text class=\"tick\" x=\"{at:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>",
            height - 18.0,
            short(value, span)
        );
    }
    let _ = write!(
        svg,
        "<text class=\"tick\" x=\"{}\" y=\"{:.1}\" text-anchor=\"end\">s since start</text></svg>",
        WIDTH - RIGHT,
        height - 3.0
    );
    svg
}

fn legend(names: &[String]) -> String {
    let items: Vec<String> = names
        .iter()
        .enumerate()
        .map(|(index, name)| format!("<span class=\"key k{}\">{}</span>", index % 8, escape(name)))
        .collect();
    format!("<p class=\"legend\">{}</p>", items.join(""))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_within() {
        let found = ticks([0.03, 0.98], 4);
        assert!(found.len() >= 3 && found.iter().all(|t| (0.03..=0.98).contains(t)), "{found:?}");
        assert!(ticks([0.0, 20.0], 8).contains(&10.0));
    }

    #[test]
    fn names_from_outside_cannot_break_the_page() {
        let (svg, legend) =
            lines("joints", &[("<script>&\"".into(), vec![(0.0, 1.0), (1.0, 2.0)])], [0.0, 1.0], &[]).expect("finite");
        assert!(!svg.contains("<script>") && !legend.contains("<script>") && legend.contains("&lt;script&gt;"));
        assert!(lines("empty", &[("a".into(), vec![(0.0, f64::NAN)])], [0.0, 1.0], &[]).is_none());
    }
}
