//! Plots of lines, steps and points as self-contained SVG: the same data give the same bytes.
//!
//! Colours are set in the drawing itself and follow the reader's light or dark scheme; nothing is loaded from elsewhere, so that a plot may
//! stand alone or inside a page.

use std::fmt::Write as _;

pub use super::ticks::Scale;
use super::ticks::{Tick, round_range, ticks};

/// What stands along one side.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Axis {
    /// Quantity with its unit: `energy / keV`.
    pub label: String,
    /// How values become positions.
    pub scale: Scale,
    /// First and last value; from the data when absent.
    pub range: Option<[f64; 2]>,
}

impl Axis {
    /// An axis whose range comes from the data.
    #[must_use]
    pub fn new(label: &str, scale: Scale) -> Self {
        Self { label: label.to_owned(), scale, range: None }
    }
}

/// How the points of a series are drawn.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Stroke {
    /// Straight lines between the points, in their order.
    #[default]
    Line,
    /// Dashed straight lines.
    Dashed,
    /// A histogram: each value from half-way before its point to half-way after.
    Steps,
    /// A dot each.
    Points,
}

/// One quantity.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Series {
    /// Name in the legend; a series without one has no entry there.
    pub label: String,
    /// (x, y); those that are not finite, or not positive on a logarithmic axis, leave a gap.
    pub points: Vec<[f64; 2]>,
    /// How they are drawn.
    pub stroke: Stroke,
    /// Colour, by its place in the palette; by the place of the series when absent.
    pub colour: Option<usize>,
}

/// A vertical line that names a position on the x axis.
#[derive(Clone, Debug, PartialEq)]
pub struct Mark {
    /// Where.
    pub x: f64,
    /// What it is, written beside it.
    pub label: String,
}

/// A plot, to be drawn by [`Plot::svg`].
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plot {
    /// Above the drawing.
    pub title: String,
    /// Horizontal axis.
    pub x: Axis,
    /// Vertical axis.
    pub y: Axis,
    /// What is drawn, later ones on top.
    pub series: Vec<Series>,
    /// Named positions on the x axis.
    pub marks: Vec<Mark>,
}

/// Why a plot could not be drawn.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PlotError {
    /// No point of any series has a place on the axes.
    #[error(
        "plot '{title}': none of its {found} points can be drawn, expected finite values (positive ones on a logarithmic axis)"
    )]
    NothingToDraw {
        /// The plot's title.
        title: String,
        /// Points given.
        found: usize,
    },
    /// A range that is not one.
    #[error("plot '{title}': axis '{axis}' goes from {from} to {to}, expected ascending values that the scale can show")]
    Range {
        /// The plot's title.
        title: String,
        /// The axis's label.
        axis: String,
        /// First.
        from: f64,
        /// Last.
        to: f64,
    },
}

const WIDTH: f64 = 760.0;
const HEIGHT: f64 = 460.0;
const LEFT: f64 = 78.0;
const RIGHT: f64 = 18.0;
const TOP: f64 = 44.0;
const BOTTOM: f64 = 56.0;
/// Height of a row of the legend.
const ROW: f64 = 18.0;
/// Mean width of a character of the legend's 12 px letters.
const LETTER: f64 = 6.6;

/// Okabe and Ito's colours, told apart by colour-blind readers, in an order that puts the strongest first. One list serves both schemes but for
/// its first entry, which is the text's own colour.
const PALETTE: [&str; 7] = ["currentColor", "#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00"];

const STYLE: &str = "<style>.sc-plot{color:#1a1d21;background:#fff;font:12px system-ui,sans-serif}.sc-plot .grid{stroke:#d9dde2}.sc-plot .paper{fill:#fff}\
.sc-plot .quiet{fill:#59616b}@media(prefers-color-scheme:dark){.sc-plot{color:#e8eaed;background:#15181c}.sc-plot .grid{stroke:#363c44}\
.sc-plot .paper{fill:#15181c}.sc-plot .quiet{fill:#a3abb5}}</style>";

impl Plot {
    /// The drawing, 760 × 460 user units, which scales to the width it is given.
    ///
    /// # Errors
    /// When no point can be drawn, or a given range is not ascending.
    pub fn svg(&self) -> Result<String, PlotError> {
        let frame = self.frame()?;
        let title = escape(&self.title);
        let mut svg = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" class=\"sc-plot\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" aria-label=\"{title}\" \
             fill=\"currentColor\">{STYLE}\n<rect class=\"paper\" width=\"{WIDTH}\" height=\"{HEIGHT}\"/>\n\
             <text x=\"{LEFT}\" y=\"24\" font-size=\"15\" font-weight=\"600\">{title}</text>\n"
        );
        self.draw_axes(&frame, &mut svg);
        self.draw_marks(&frame, &mut svg);
        // Curves may leave a range that was given: the clip keeps them inside the axes. The hash keeps two plots of one page apart.
        let clip = format!("sc-clip-{:08x}", fingerprint(&self.title));
        let (width, height) = (WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM);
        let _ = write!(
            svg,
            "<clipPath id=\"{clip}\"><rect x=\"{LEFT}\" y=\"{TOP}\" width=\"{width}\" height=\"{height}\"/></clipPath>\n<g clip-path=\"url(#{clip})\">\n"
        );
        for (index, series) in self.series.iter().enumerate() {
            draw_series(series, PALETTE[series.colour.unwrap_or(index) % PALETTE.len()], &frame, &mut svg);
        }
        svg.push_str("</g>\n");
        self.draw_legend(&frame, &mut svg);
        svg.push_str("</svg>\n");
        Ok(svg)
    }

    fn frame(&self) -> Result<Frame, PlotError> {
        let scales = [self.x.scale, self.y.scale];
        let all = || self.series.iter().flat_map(|series| series.points.iter());
        let drawn: Vec<&[f64; 2]> = all().filter(|point| (0..2).all(|i| scales[i].can_show(point[i]))).collect();
        if drawn.is_empty() {
            return Err(PlotError::NothingToDraw { title: self.title.clone(), found: all().count() });
        }
        let mut ranges = [[0.0; 2]; 2];
        for (i, axis) in [&self.x, &self.y].into_iter().enumerate() {
            ranges[i] = match axis.range {
                Some([from, to]) if axis.scale.can_show(from) && axis.scale.can_show(to) && from < to => [from, to],
                Some([from, to]) => {
                    return Err(PlotError::Range { title: self.title.clone(), axis: axis.label.clone(), from, to });
                }
                None => {
                    let low = drawn.iter().map(|point| point[i]).fold(f64::INFINITY, f64::min);
                    let high = drawn.iter().map(|point| point[i]).fold(f64::NEG_INFINITY, f64::max);
                    round_range(axis.scale, low, high)
                }
            };
        }
        Ok(Frame { scales, ranges })
    }

    fn draw_axes(&self, frame: &Frame, svg: &mut String) {
        let (right, bottom) = (WIDTH - RIGHT, HEIGHT - BOTTOM);
        for Tick { value, label } in ticks(self.x.scale, frame.ranges[0]) {
            let u = frame.u(value);
            let _ = write!(svg, "<path class=\"grid\" d=\"M{u:.1} {TOP}V{bottom}\"/>");
            let _ = writeln!(svg, "<text x=\"{u:.1}\" y=\"{:.1}\" text-anchor=\"middle\">{label}</text>", bottom + 18.0);
        }
        for Tick { value, label } in ticks(self.y.scale, frame.ranges[1]) {
            let v = frame.v(value);
            let _ = write!(svg, "<path class=\"grid\" d=\"M{LEFT} {v:.1}H{right}\"/>");
            let _ = writeln!(svg, "<text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\">{label}</text>", LEFT - 8.0, v + 4.0);
        }
        let (middle_u, middle_v) = (0.5 * (LEFT + right), 0.5 * (TOP + bottom));
        let _ = write!(
            svg,
            "<path d=\"M{LEFT} {TOP}V{bottom}H{right}\" fill=\"none\" stroke=\"currentColor\"/>\n\
             <text x=\"{middle_u}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>\n\
             <text transform=\"translate(20 {middle_v}) rotate(-90)\" text-anchor=\"middle\">{}</text>\n",
            HEIGHT - 14.0,
            escape(&self.x.label),
            escape(&self.y.label),
        );
    }

    fn draw_marks(&self, frame: &Frame, svg: &mut String) {
        let bottom = HEIGHT - BOTTOM;
        for mark in self.marks.iter().filter(|mark| frame.scales[0].can_show(mark.x)) {
            let u = frame.u(mark.x);
            if !(LEFT..=WIDTH - RIGHT).contains(&u) {
                continue;
            }
            let text_width = mark.label.chars().count() as f64 * LETTER;
            let (x, anchor) = if u + 6.0 + text_width > WIDTH - RIGHT { (u - 6.0, "end") } else { (u + 6.0, "start") };
            let _ = writeln!(
                svg,
                "<path d=\"M{u:.1} {TOP}V{bottom}\" stroke=\"currentColor\" stroke-dasharray=\"2 3\"/>\
                 <text class=\"quiet\" x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"{anchor}\">{}</text>",
                bottom - 8.0,
                escape(&mark.label),
            );
        }
    }

    /// In the upper corner that covers fewer points.
    fn draw_legend(&self, frame: &Frame, svg: &mut String) {
        let entries: Vec<(usize, &Series)> =
            self.series.iter().enumerate().filter(|(_, series)| !series.label.is_empty()).collect();
        let Some(longest) = entries.iter().map(|(_, series)| series.label.chars().count()).max() else { return };
        let (width, height) = (longest as f64 * LETTER + 46.0, entries.len() as f64 * ROW + 10.0);
        let corners = [WIDTH - RIGHT - width - 8.0, LEFT + 10.0];
        let covered = |left: f64| {
            let hidden = |point: &&[f64; 2]| {
                let (u, v) = (frame.u(point[0]), frame.v(point[1]));
                u >= left && u <= left + width && v <= TOP + 8.0 + height
            };
            self.series.iter().flat_map(|series| series.points.iter()).filter(hidden).count()
        };
        let left = if covered(corners[1]) < covered(corners[0]) { corners[1] } else { corners[0] };
        let _ = writeln!(
            svg,
            "<rect class=\"paper\" x=\"{left:.1}\" y=\"{:.1}\" width=\"{width:.1}\" height=\"{height:.1}\" fill-opacity=\"0.85\"/>",
            TOP + 8.0
        );
        for (row, (index, series)) in entries.into_iter().enumerate() {
            let colour = PALETTE[series.colour.unwrap_or(index) % PALETTE.len()];
            let v = TOP + 8.0 + ROW * (row as f64 + 0.5) + 5.0;
            let u = left + 8.0;
            let _ = match series.stroke {
                Stroke::Points => write!(svg, "<circle cx=\"{:.1}\" cy=\"{v:.1}\" r=\"3.5\" fill=\"{colour}\"/>", u + 12.0),
                stroke => {
                    write!(svg, "<path d=\"M{u:.1} {v:.1}h24\" stroke=\"{colour}\" stroke-width=\"2\"{}/>", dashes(stroke))
                }
            };
            let _ = writeln!(svg, "<text x=\"{:.1}\" y=\"{:.1}\">{}</text>", u + 31.0, v + 4.0, escape(&series.label));
        }
    }
}

/// Where values lie in the drawing.
struct Frame {
    scales: [Scale; 2],
    ranges: [[f64; 2]; 2],
}

impl Frame {
    fn u(&self, x: f64) -> f64 {
        LEFT + self.scales[0].fraction(x, self.ranges[0]) * (WIDTH - LEFT - RIGHT)
    }

    fn v(&self, y: f64) -> f64 {
        HEIGHT - BOTTOM - self.scales[1].fraction(y, self.ranges[1]) * (HEIGHT - TOP - BOTTOM)
    }

    /// Place of a point, or `None` where the axes have none for it. Far outside is as good as outside: numbers stay short.
    fn place(&self, point: [f64; 2]) -> Option<(f64, f64)> {
        let shown = self.scales[0].can_show(point[0]) && self.scales[1].can_show(point[1]);
        shown.then(|| (self.u(point[0]).clamp(-1e4, 1e4), self.v(point[1]).clamp(-1e4, 1e4)))
    }
}

fn dashes(stroke: Stroke) -> &'static str {
    if stroke == Stroke::Dashed { " stroke-dasharray=\"6 4\"" } else { "" }
}

fn draw_series(series: &Series, colour: &str, frame: &Frame, svg: &mut String) {
    if series.stroke == Stroke::Points {
        for (u, v) in series.points.iter().filter_map(|point| frame.place(*point)) {
            let _ = write!(svg, "<circle cx=\"{u:.2}\" cy=\"{v:.2}\" r=\"3.5\" fill=\"{colour}\"/>");
        }
        svg.push('\n');
        return;
    }
    let mut path = String::new();
    let mut pen_down = false;
    let stepped = if series.stroke == Stroke::Steps { steps(&series.points) } else { Vec::new() };
    let points = if series.stroke == Stroke::Steps { &stepped } else { &series.points };
    for place in points.iter().map(|point| frame.place(*point)) {
        match place {
            Some((u, v)) => {
                let _ = write!(path, "{}{u:.2} {v:.2}", if pen_down { 'L' } else { 'M' });
                pen_down = true;
            }
            None => pen_down = false,
        }
    }
    if !path.is_empty() {
        let _ = writeln!(
            svg,
            "<path d=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.8\" stroke-linejoin=\"round\"{}/>",
            dashes(series.stroke)
        );
    }
}

/// Corners of a histogram whose bins meet half-way between the points; a single point is a bin of width 1.
fn steps(points: &[[f64; 2]]) -> Vec<[f64; 2]> {
    let mut corners = Vec::with_capacity(2 * points.len());
    for (i, [x, y]) in points.iter().copied().enumerate() {
        let before = i.checked_sub(1).map(|j| 0.5 * (x - points[j][0]));
        let after = points.get(i + 1).map(|next| 0.5 * (next[0] - x));
        let (before, after) = (before.or(after).unwrap_or(0.5), after.or(before).unwrap_or(0.5));
        corners.extend([[x - before, y], [x + after, y]]);
    }
    corners
}

/// Text as it may stand in SVG.
fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

/// FNV-1a: the same text, the same number, on every machine.
fn fingerprint(text: &str) -> u32 {
    text.bytes().fold(0x811c_9dc5, |hash, byte| (hash ^ u32::from(byte)).wrapping_mul(0x0100_0193))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plot(points: Vec<[f64; 2]>, scale: Scale) -> Plot {
        Plot {
            title: "a < b & c".to_owned(),
            x: Axis::new("energy / keV", Scale::Linear),
            y: Axis::new("attenuation / (cm²/g)", scale),
            series: vec![Series { label: "total".to_owned(), points, ..Series::default() }],
            marks: vec![Mark { x: 2.0, label: "mean".to_owned() }],
        }
    }

    #[test]
    fn points_lie_where_the_axes_say() {
        let svg = plot(vec![[0.0, 1.0], [5.0, 10.0], [10.0, 100.0]], Scale::Log).svg().expect("drawn");
        // Half-way on both axes: the middle of 78..742 and of 404..44.
        assert!(svg.contains("M78.00 404.00L410.00 224.00L742.00 44.00"), "{svg}");
        assert!(svg.contains("a &lt; b &amp; c") && svg.contains("energy / keV") && svg.contains("attenuation / (cm²/g)"));
        assert_eq!(svg, plot(vec![[0.0, 1.0], [5.0, 10.0], [10.0, 100.0]], Scale::Log).svg().expect("drawn"));
    }

    #[test]
    fn what_has_no_place_leaves_a_gap_and_no_nan() {
        let points = vec![[0.0, 1.0], [1.0, 10.0], [2.0, 0.0], [3.0, f64::NAN], [4.0, 10.0], [10.0, 100.0]];
        let svg = plot(points, Scale::Log).svg().expect("drawn");
        assert!(!svg.contains("NaN") && !svg.contains("inf"));
        let curve = svg.lines().find(|line| line.contains("stroke-linejoin")).expect("a curve");
        assert_eq!(curve.matches('M').count(), 2, "{curve}");
    }

    #[test]
    fn nothing_to_draw_is_an_error() {
        assert_eq!(
            plot(vec![[1.0, -1.0]], Scale::Log).svg(),
            Err(PlotError::NothingToDraw { title: "a < b & c".to_owned(), found: 1 })
        );
        let mut wrong = plot(vec![[1.0, 1.0]], Scale::Linear);
        wrong.x.range = Some([3.0, f64::NAN]);
        assert!(matches!(wrong.svg(), Err(PlotError::Range { .. })));
    }

    #[test]
    fn histograms_have_two_corners_a_bin() {
        assert_eq!(steps(&[[1.0, 5.0], [2.0, 6.0]]), [[0.5, 5.0], [1.5, 5.0], [1.5, 6.0], [2.5, 6.0]]);
        assert_eq!(steps(&[[60.0, 1.0]]), [[59.5, 1.0], [60.5, 1.0]]);
    }
}
