//! Figures on a canvas that shows a frame.

use std::ops::Range;

use glam::DVec2;

use super::canvas::{Align, Canvas, Rgb};
use super::figures::{Figure, Form, arrow, ring_reach};

/// Height of letters, pixels of the canvas.
const LETTER: f32 = 13.0;
/// How far capitals rise above their baseline.
const CAPITAL: f64 = 9.0;
/// Width of crosses and arrows.
const THIN: f64 = 1.2;

/// Draws `figures` over a frame that is enlarged by `scale`, and whose first pixel's corner is the canvas's.
pub(super) fn draw(canvas: &mut Canvas, figures: &[Figure], scale: f64) {
    let place = |at: &[f64; 2]| (DVec2::from_array(*at) + 0.5) * scale - 0.5;
    for Figure { colour, form, .. } in figures {
        match form {
            Form::Ring { at_px, radius_px, width } => ring(canvas, place(at_px), ring_reach(*radius_px, scale), *width, *colour),
            Form::Spot { at_px, reach, width } => ring(canvas, place(at_px), *reach, *width, *colour),
            Form::Cross { at_px, reach } => {
                for arm in [*reach * DVec2::X, *reach * DVec2::Y] {
                    segment(canvas, place(at_px) - arm, place(at_px) + arm, THIN, *colour);
                }
            }
            Form::Arrow { from_px, to_px } => {
                for [from, to] in arrow(place(from_px).to_array(), place(to_px).to_array()) {
                    segment(canvas, DVec2::from_array(from), DVec2::from_array(to), THIN, *colour);
                }
            }
            Form::Line { along_px, width } => {
                for ends in along_px.windows(2) {
                    segment(canvas, place(&ends[0]), place(&ends[1]), *width, *colour);
                }
            }
            Form::Words { at_px, radius_px, below, text } => {
                words(canvas, place(at_px), ring_reach(*radius_px, scale) + 2.0, *below, text, *colour);
            }
        }
    }
}

/// A circle (pixel centres at integers), cut where the canvas ends.
fn ring(canvas: &mut Canvas, centre: DVec2, reach: f64, width: f64, colour: Rgb) {
    if !(centre.is_finite() && reach.is_finite()) {
        return;
    }
    let out = DVec2::splat(reach + width + 1.0);
    let [columns, rows] = within(canvas, centre - out, centre + out);
    for v in rows {
        for u in columns.clone() {
            let off = (DVec2::new(u as f64, v as f64).distance(centre) - reach).abs();
            canvas.blend(u as i64, v as i64, colour, (0.5 * width + 0.5 - off) as f32);
        }
    }
}

/// A line between two points, cut where the canvas ends.
fn segment(canvas: &mut Canvas, from: DVec2, to: DVec2, width: f64, colour: Rgb) {
    if !(from.is_finite() && to.is_finite()) {
        return;
    }
    let (along, out) = (to - from, DVec2::splat(0.5 * width + 1.0));
    let [columns, rows] = within(canvas, from.min(to) - out, from.max(to) + out);
    for v in rows {
        // Only what the line's width takes of the row; of a level line that is all of it.
        let (crossing, reach) = (
            from.x + (v as f64 - from.y) / along.y * along.x,
            out.x * along.length() / along.y.abs() + (along.x / along.y).abs(),
        );
        let taken =
            if (crossing + reach).is_finite() { cut(crossing - reach, crossing + reach, columns.end) } else { columns.clone() };
        for u in columns.start.max(taken.start)..columns.end.min(taken.end) {
            let at = DVec2::new(u as f64, v as f64);
            let share = ((at - from).dot(along) / along.length_squared().max(1e-12)).clamp(0.0, 1.0);
            let off = at.distance(from + share * along);
            canvas.blend(u as i64, v as i64, colour, (0.5 * width + 0.5 - off) as f32);
        }
    }
}

/// Columns and rows of the canvas between two corners.
fn within(canvas: &Canvas, low: DVec2, high: DVec2) -> [Range<usize>; 2] {
    [cut(low.x, high.x, canvas.image.width), cut(low.y, high.y, canvas.image.height)]
}

/// Pixels from `low` to `high`, cut at 0 and `end`.
fn cut(low: f64, high: f64, end: usize) -> Range<usize> {
    let limit = |value: f64| value.clamp(0.0, end as f64) as usize;
    limit(low.floor())..limit(high.ceil() + 1.0)
}

/// Words at the right of a place, at its left where there is no room; they can be read on any ground.
fn words(canvas: &mut Canvas, at: DVec2, aside: f64, below: bool, text: &str, colour: Rgb) {
    if !at.is_finite() {
        return;
    }
    let has_room = at.x + aside + f64::from(canvas.text_width(text, LETTER)) <= canvas.image.width as f64;
    let (u, align) = if has_room { (at.x + aside, Align::Left) } else { (at.x - aside, Align::Right) };
    let v = if below { at.y + aside + CAPITAL } else { at.y - aside };
    let (u, v) = (u as f32, v as f32);
    canvas.text(u + 1.0, v + 1.0, text, LETTER, [0; 3], align);
    canvas.text(u, v, text, LETTER, colour, align);
}
