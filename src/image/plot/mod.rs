//! Plots of lines, steps, dots, bars and bands as self-contained SVG: the same data give the same bytes.
//!
//! Colours are set in the drawing itself and follow the reader's light or dark scheme; nothing is loaded from elsewhere, so that a plot may
//! stand alone or inside a page.

mod layout;
mod legend;
mod parts;
mod strokes;

use std::fmt::Write as _;

use layout::{Label, Layout};
use parts::escape;
pub use parts::{Axis, BAD, CAUTION, GOOD, Mark, Place, Plot, PlotError, Series, Stroke};

pub use super::ticks::{Scale, Tick};

const STYLE: &str = "<style>.sc-plot{color:#1a1d21;background:#fff;font:12px system-ui,sans-serif}.sc-plot .grid{stroke:#d9dde2}.sc-plot .paper{fill:#fff}\
.sc-plot .quiet{fill:#59616b}@media(prefers-color-scheme:dark){.sc-plot{color:#e8eaed;background:#15181c}.sc-plot .grid{stroke:#363c44}\
.sc-plot .paper{fill:#15181c}.sc-plot .quiet{fill:#a3abb5}}</style>";

impl Plot {
    /// The drawing, in user units, which scales to the width it is given.
    ///
    /// # Errors
    /// When no point can be drawn, or a given range is not ascending.
    pub fn svg(&self) -> Result<String, PlotError> {
        let layout = Layout::of(self)?;
        let Layout { width, height, left, right, top, bottom, .. } = layout;
        let (title, is_alone) = (escape(&self.title), self.place == Place::Alone);
        // What is part of a page needs no namespace, and has its title there.
        let namespace = if is_alone { " xmlns=\"http://www.w3.org/2000/svg\"" } else { "" };
        let mut svg = format!(
            "<svg{namespace} class=\"sc-plot\" viewBox=\"0 0 {width} {height}\" role=\"img\" aria-label=\"{title}\" \
             fill=\"currentColor\">{STYLE}\n<rect class=\"paper\" width=\"{width}\" height=\"{height}\"/>\n"
        );
        if is_alone {
            let _ = writeln!(svg, "<text x=\"{left}\" y=\"24\" font-size=\"15\" font-weight=\"600\">{title}</text>");
        }
        self.draw_axes(&layout, &mut svg);
        self.draw_marks(&layout, &mut svg);
        // Curves may leave a range that was given: the clip keeps them inside the axes. The hash keeps two plots of one page apart.
        let clip = format!("sc-clip-{:08x}", fingerprint(&self.title));
        let (wide, high) = (right - left, bottom - top);
        let _ = write!(
            svg,
            "<clipPath id=\"{clip}\"><rect x=\"{left}\" y=\"{top}\" width=\"{wide}\" height=\"{high}\"/></clipPath>\n<g clip-path=\"url(#{clip})\">\n"
        );
        for (index, series) in self.series.iter().enumerate() {
            strokes::draw(series, index, &layout, &mut svg);
        }
        svg.push_str("</g>\n");
        if is_alone {
            let points = self.series.iter().flat_map(|series| &series.points);
            let places: Vec<[f64; 2]> = points.filter_map(|point| layout.place(*point)).collect();
            legend::draw_in_corner(&self.series, [left, right, top], &places, &mut svg);
        } else {
            legend::draw_in_rows(&self.series, left, wide, &mut svg);
        }
        svg.push_str("</svg>\n");
        Ok(svg)
    }

    fn draw_axes(&self, layout: &Layout, svg: &mut String) {
        let Layout { height, left, right, top, bottom, .. } = *layout;
        for Label { at, has_line, words: [u, v], label } in layout.along(0, &self.x) {
            if has_line {
                let _ = write!(svg, "<path class=\"grid\" d=\"M{at:.1} {top}V{bottom}\"/>");
            }
            let _ = writeln!(svg, "<text x=\"{u:.1}\" y=\"{v:.1}\" text-anchor=\"middle\">{}</text>", escape(&label));
        }
        for Label { at, has_line, words: [u, v], label } in layout.along(1, &self.y) {
            if has_line {
                let _ = write!(svg, "<path class=\"grid\" d=\"M{left} {at:.1}H{right}\"/>");
            }
            let _ = writeln!(svg, "<text x=\"{u:.1}\" y=\"{v:.1}\" text-anchor=\"end\">{}</text>", escape(&label));
        }
        let (middle_u, middle_v) = (0.5 * (left + right), 0.5 * (top + bottom));
        let beside = if self.place == Place::Alone { 20.0 } else { 14.0 };
        let _ = write!(
            svg,
            "<path d=\"M{left} {top}V{bottom}H{right}\" fill=\"none\" stroke=\"currentColor\"/>\n\
             <text x=\"{middle_u}\" y=\"{:.1}\" text-anchor=\"middle\">{}</text>\n\
             <text transform=\"translate({beside} {middle_v}) rotate(-90)\" text-anchor=\"middle\">{}</text>\n",
            height - if self.place == Place::Alone { 14.0 } else { 6.0 },
            escape(&self.x.label),
            escape(&self.y.label),
        );
    }

    fn draw_marks(&self, layout: &Layout, svg: &mut String) {
        let Layout { left, right, top, bottom, .. } = *layout;
        for mark in self.marks.iter().filter(|mark| layout.scales[0].can_show(mark.x)) {
            let u = layout.u(mark.x);
            if !(left..=right).contains(&u) {
                continue;
            }
            let _ = writeln!(svg, "<path d=\"M{u:.1} {top}V{bottom}\" stroke=\"currentColor\" stroke-dasharray=\"2 3\"/>");
            if mark.label.is_empty() {
                continue;
            }
            let has_room = u + 6.0 + legend::width_of(&mark.label) <= right;
            let (x, anchor) = if has_room { (u + 6.0, "start") } else { (u - 6.0, "end") };
            let _ = writeln!(
                svg,
                "<text class=\"quiet\" x=\"{x:.1}\" y=\"{:.1}\" text-anchor=\"{anchor}\">{}</text>",
                bottom - 8.0,
                escape(&mark.label),
            );
        }
    }
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
            ..Plot::default()
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

    /// The numbers of an attribute of all elements of a name.
    fn numbers(svg: &str, element: &str, attribute: &str) -> Vec<f64> {
        let start = format!("<{element}");
        let elements = svg.split(&start).skip(1).filter_map(|rest| rest.split('>').next());
        let of = |text: &str| text.split_once(&format!(" {attribute}=\""))?.1.split('"').next()?.parse().ok();
        elements.filter_map(of).collect()
    }

    #[test]
    fn in_a_page_the_legend_stands_above_the_axes_and_words_from_outside_cannot_break_it() {
        let series = |n: usize| Series {
            label: format!("<script>&\" of a long name, {n}"),
            points: vec![[0.0, 1.0], [1.0, 2.0 + n as f64]],
            words: vec!["<b>".to_owned(), "\"".to_owned()],
            stroke: Stroke::Points,
            ..Series::default()
        };
        let of = |count: usize| Plot {
            title: "\"<joints>".to_owned(),
            place: Place::InPage { height: 160.0 },
            series: (0..count).map(series).collect(),
            ..Plot::default()
        };
        let svg = of(6).svg().expect("drawn");
        assert!(!svg.contains("<script>") && !svg.contains("<b>") && !svg.contains("http"), "{svg}");
        assert!(svg.contains("&lt;script&gt;") && svg.contains("aria-label=\"&quot;&lt;joints&gt;\""), "{svg}");
        assert!(!svg.contains("font-weight"), "its heading stands in the page");
        // Keys and dots: the lowest key stands higher than the highest dot can, which lies at the upper end of the axes.
        let (across, down) = (numbers(&svg, "circle", "cx"), numbers(&svg, "circle", "cy"));
        assert_eq!((across.len(), down.len()), (18, 18));
        let keys = svg.split("</g>").nth(1).map(|rest| numbers(rest, "circle", "cy")).expect("a legend");
        let dots = svg.split("<g ").nth(1).and_then(|rest| rest.split("</g>").next()).map(|dots| numbers(dots, "circle", "cy"));
        let (lowest, highest) =
            (keys.iter().fold(0.0f64, |a, b| a.max(*b)), dots.expect("dots").iter().fold(1e9f64, |a, b| a.min(*b)));
        assert!(keys.len() == 6 && lowest < highest, "{lowest} {highest}");
        assert!(across.iter().all(|u| (0.0..640.0).contains(u)), "{across:?}");
        // More entries than a row holds make the drawing higher, not the axes lower.
        let high =
            |svg: &str| svg.split_once("viewBox=\"0 0 640 ").and_then(|(_, rest)| rest.split('"').next()?.parse::<f64>().ok());
        assert!(high(&svg) > high(&of(1).svg().expect("drawn")), "{:?}", high(&svg));
    }

    #[test]
    fn bars_stand_on_the_axis_and_bands_reach_from_point_to_point() {
        let plot = |stroke: Stroke, points: Vec<[f64; 2]>| Plot {
            title: "a".to_owned(),
            y: Axis { range: Some([0.0, 10.0]), ..Axis::default() },
            x: Axis { range: Some([0.0, 100.0]), ..Axis::default() },
            series: vec![Series { points, stroke, words: vec!["w".to_owned()], ..Series::default() }],
            ..Plot::default()
        };
        let drawn = |stroke, points| {
            let svg = plot(stroke, points).svg().expect("drawn");
            let inside = svg.split("<g ").nth(1).and_then(|rest| rest.split("</g>").next()).expect("the series").to_owned();
            assert!(inside.contains("<title>w</title></rect>"), "{inside}");
            ["x", "y", "width", "height"].map(|name| numbers(&inside, "rect", name))
        };
        let [x, y, width, height] = drawn(Stroke::Bars, vec![[25.0, 5.0], [75.0, 10.0], [80.0, f64::NAN]]);
        // Axes from 78 to 742 and from 404 up to 44: half the height, and all of it.
        assert_eq!((x.len(), &y[..], &height[..]), (2, &[224.0, 44.0][..], &[180.0, 360.0][..]));
        assert!((x[0] + 0.5 * width[0] - 244.0).abs() < 0.11 && width[0] <= 46.0, "{x:?} {width:?}");
        // The second would be a tenth of a unit wide.
        let [x, y, width, height] = drawn(Stroke::Bands, vec![[0.0, 5.0], [50.0, 5.0], [60.0, 5.0], [60.01, 5.0], [70.0, 5.0]]);
        assert_eq!((x.len(), &height[..], &y[..]), (2, &[20.0, 20.0][..], &[214.0, 214.0][..]));
        assert!((width[0] - 332.0).abs() < 0.11 && width[1] >= 2.0, "{width:?}");
    }

    #[test]
    fn names_stand_in_place_of_numbers_and_a_range_holds_what_it_is_told() {
        let mut drawn = plot(vec![[1.0, 5.0], [3.0, 6.0]], Scale::Linear);
        drawn.x.named = [1.0, 3.0].map(|value| Tick { value, label: format!("no. {value}") }).to_vec();
        drawn.y.holds = Some(0.0);
        let svg = drawn.svg().expect("drawn");
        assert!(svg.contains(">no. 1</text>") && svg.contains(">no. 3</text>") && !svg.contains(">2.0</text>"), "{svg}");
        assert!(svg.contains(">0</text>"), "from zero: {svg}");
        drawn.y.holds = None;
        assert!(!drawn.svg().expect("drawn").contains(">0</text>"), "control");
    }
}
