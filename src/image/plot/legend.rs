//! The legend of a plot: a key and a name for each series that has one.

use std::fmt::Write as _;

use super::parts::{Series, Stroke, escape};

/// Height of a row.
const ROW: f64 = 18.0;
/// Mean width of a character of 12 px letters.
const LETTER: f64 = 6.6;
/// Width of a key, and of the gap behind it.
const KEY: f64 = 31.0;
/// Between two entries of a row.
const GAP: f64 = 16.0;

/// About how wide `label` is.
pub(super) fn width_of(label: &str) -> f64 {
    label.chars().count() as f64 * LETTER
}

/// The series that have a name, and their places among all.
fn entries(series: &[Series]) -> Vec<(usize, &Series)> {
    series.iter().enumerate().filter(|(_, series)| !series.label.is_empty()).collect()
}

/// Left end and row of each entry in rows of `width`.
fn in_rows(entries: &[(usize, &Series)], width: f64) -> Vec<(f64, usize)> {
    let (mut left, mut row) = (0.0, 0);
    let place = |(_, series): &(usize, &Series)| {
        let wide = KEY + width_of(&series.label);
        if left > 0.0 && left + wide > width {
            (left, row) = (0.0, row + 1);
        }
        let at = (left, row);
        left += wide + GAP;
        at
    };
    entries.iter().map(place).collect()
}

/// How much room the rows of a legend above axes of `width` take.
pub(super) fn height(series: &[Series], width: f64) -> f64 {
    in_rows(&entries(series), width).last().map_or(0.0, |(_, row)| ROW * (row + 1) as f64 + 4.0)
}

/// In rows of `width` that begin at `left`.
pub(super) fn draw_in_rows(series: &[Series], left: f64, width: f64, svg: &mut String) {
    let entries = entries(series);
    for ((index, series), (from, row)) in entries.iter().zip(in_rows(&entries, width)) {
        draw_entry(series, *index, left + from, 6.0 + ROW * (row as f64 + 0.5), svg);
    }
}

/// Below each other, in the upper corner of the axes, from `left` to `right`, that covers fewer of the points at `places`.
pub(super) fn draw_in_corner(series: &[Series], [left, right, top]: [f64; 3], places: &[[f64; 2]], svg: &mut String) {
    let entries = entries(series);
    let Some(longest) = entries.iter().map(|(_, series)| width_of(&series.label)).reduce(f64::max) else { return };
    let (width, height) = (longest + 46.0, entries.len() as f64 * ROW + 10.0);
    let corners = [right - width - 8.0, left + 10.0];
    let covered = |left: f64| {
        let is_hidden = |[u, v]: &&[f64; 2]| *u >= left && *u <= left + width && *v <= top + 8.0 + height;
        places.iter().filter(is_hidden).count()
    };
    let left = if covered(corners[1]) < covered(corners[0]) { corners[1] } else { corners[0] };
    let _ = writeln!(
        svg,
        "<rect class=\"paper\" x=\"{left:.1}\" y=\"{:.1}\" width=\"{width:.1}\" height=\"{height:.1}\" fill-opacity=\"0.85\"/>",
        top + 8.0
    );
    for (row, (index, series)) in entries.into_iter().enumerate() {
        draw_entry(series, index, left + 8.0, top + 13.0 + ROW * (row as f64 + 0.5), svg);
    }
}

/// The key and the name of a series, the key's middle at height `v`.
fn draw_entry(series: &Series, index: usize, u: f64, v: f64, svg: &mut String) {
    let (colour, middle) = (series.colour(index), u + 12.0);
    let _ = match series.stroke {
        Stroke::Points => write!(svg, "<circle cx=\"{middle:.1}\" cy=\"{v:.1}\" r=\"3.5\" fill=\"{colour}\"/>"),
        Stroke::Rings => {
            write!(
                svg,
                "<circle cx=\"{middle:.1}\" cy=\"{v:.1}\" r=\"3.5\" class=\"paper\" stroke=\"{colour}\" stroke-width=\"1.5\"/>"
            )
        }
        Stroke::Bars | Stroke::Bands => {
            write!(svg, "<rect x=\"{:.1}\" y=\"{:.1}\" width=\"10\" height=\"10\" fill=\"{colour}\"/>", middle - 5.0, v - 5.0)
        }
        Stroke::Line | Stroke::Dashed | Stroke::Steps => {
            write!(svg, "<path d=\"M{u:.1} {v:.1}h24\" stroke=\"{colour}\" stroke-width=\"2\"{}/>", series.stroke.dashes())
        }
    };
    let _ = writeln!(svg, "<text x=\"{:.1}\" y=\"{:.1}\">{}</text>", u + KEY, v + 4.0, escape(&series.label));
}
