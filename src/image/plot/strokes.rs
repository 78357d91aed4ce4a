//! The series of a plot.

use std::fmt::Write as _;

use super::layout::Layout;
use super::parts::{Series, Stroke, escape};

/// Share of the way to the next bar that a bar takes, and the widest one, user units.
const BAR: (f64, f64) = (0.62, 46.0);
/// Height of a band, and the narrowest one, user units.
const BAND: (f64, f64) = (20.0, 2.0);

/// Draws the series at `index` of its plot.
pub(super) fn draw(series: &Series, index: usize, layout: &Layout, svg: &mut String) {
    let colour = series.colour(index);
    match series.stroke {
        Stroke::Line | Stroke::Dashed | Stroke::Steps => line(series, colour, layout, svg),
        Stroke::Points => dots(series, &format!("fill=\"{colour}\""), layout, svg),
        Stroke::Rings => dots(series, &format!("class=\"paper\" stroke=\"{colour}\" stroke-width=\"1.5\""), layout, svg),
        Stroke::Bars => bars(series, colour, layout, svg),
        Stroke::Bands => bands(series, colour, layout, svg),
    }
}

/// Adds an element: its name and attributes, and what is told where the pointer rests on it.
fn add(svg: &mut String, element: &str, words: Option<&String>) {
    let name = element.split(' ').next().unwrap_or_default();
    let _ = match words {
        Some(words) => write!(svg, "<{element}><title>{}</title></{name}>", escape(words)),
        None => write!(svg, "<{element}/>"),
    };
}

fn dots(series: &Series, paint: &str, layout: &Layout, svg: &mut String) {
    for (at, point) in series.points.iter().enumerate() {
        if let Some([u, v]) = layout.place(*point) {
            add(svg, &format!("circle cx=\"{u:.2}\" cy=\"{v:.2}\" r=\"3.5\" {paint}"), series.words.get(at));
        }
    }
    svg.push('\n');
}

fn bars(series: &Series, colour: &str, layout: &Layout, svg: &mut String) {
    let (share, most) = BAR;
    let places: Vec<Option<[f64; 2]>> = series.points.iter().map(|point| layout.place(*point)).collect();
    let known: Vec<f64> = places.iter().flatten().map(|[u, _]| *u).collect();
    let width = known.windows(2).map(|pair| share * (pair[1] - pair[0]).abs()).fold(most, f64::min);
    for (at, place) in places.into_iter().enumerate() {
        if let Some([u, v]) = place {
            let (left, high) = (u - 0.5 * width, (layout.bottom - v).max(0.0));
            let bar = format!("rect x=\"{left:.1}\" y=\"{v:.2}\" width=\"{width:.1}\" height=\"{high:.2}\" fill=\"{colour}\"");
            add(svg, &bar, series.words.get(at));
        }
    }
    svg.push('\n');
}

fn bands(series: &Series, colour: &str, layout: &Layout, svg: &mut String) {
    let (high, least) = BAND;
    for (at, ends) in series.points.chunks_exact(2).enumerate() {
        if let (Some([from, v]), Some([to, _])) = (layout.place(ends[0]), layout.place(ends[1])) {
            let (top, width) = (v - 0.5 * high, (to - from).max(least));
            let band =
                format!("rect x=\"{from:.1}\" y=\"{top:.1}\" width=\"{width:.1}\" height=\"{high}\" rx=\"3\" fill=\"{colour}\"");
            add(svg, &band, series.words.get(2 * at));
        }
    }
    svg.push('\n');
}

fn line(series: &Series, colour: &str, layout: &Layout, svg: &mut String) {
    let stepped = if series.stroke == Stroke::Steps { steps(&series.points) } else { Vec::new() };
    let points = if series.stroke == Stroke::Steps { &stepped } else { &series.points };
    let (mut path, mut pen_down, digits) = (String::new(), false, layout.decimals);
    for place in points.iter().map(|point| layout.place(*point)) {
        if let Some([u, v]) = place {
            let _ = write!(path, "{}{u:.digits$} {v:.digits$}", if pen_down { 'L' } else { 'M' });
        }
        pen_down = place.is_some();
    }
    if !path.is_empty() {
        let _ = writeln!(
            svg,
            "<path d=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"1.8\" stroke-linejoin=\"round\"{}/>",
            series.stroke.dashes()
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn histograms_have_two_corners_a_bin() {
        assert_eq!(steps(&[[1.0, 5.0], [2.0, 6.0]]), [[0.5, 5.0], [1.5, 5.0], [1.5, 6.0], [2.5, 6.0]]);
        assert_eq!(steps(&[[60.0, 1.0]]), [[59.5, 1.0], [60.5, 1.0]]);
    }
}
