//! Figures on a canvas that shows a frame.

use glam::DVec2;
use tiny_skia::PathBuilder;

use super::canvas::{Align, Canvas, Rgb};
use super::figures::{Figure, Form, arrow, ring_reach};

/// Height of letters, pixels of the canvas.
const LETTER: f32 = 13.0;
/// How far capitals rise above their baseline.
const CAPITAL: f64 = 9.0;
/// Width of crosses and arrows.
const THIN: f64 = 1.2;
/// At this distance, pixels of the canvas, single precision no longer tells tenths of a pixel apart.
const FAR: f64 = 1e6;

/// Draws `figures` over a frame that is enlarged by `scale`, and whose first pixel's corner is the canvas's.
pub(super) fn draw(canvas: &mut Canvas, figures: &[Figure], scale: f64) {
    let place = |at: &[f64; 2]| (DVec2::from_array(*at) + 0.5) * scale - 0.5;
    for Figure { colour, form, .. } in figures {
        let mut path = PathBuilder::new();
        let width = match form {
            Form::Ring { at_px, radius_px, width } => {
                circle(&mut path, place(at_px), ring_reach(*radius_px, scale));
                *width
            }
            Form::Spot { at_px, reach, width } => {
                circle(&mut path, place(at_px), *reach);
                *width
            }
            Form::Cross { at_px, reach } => {
                for arm in [*reach * DVec2::X, *reach * DVec2::Y] {
                    line(&mut path, [place(at_px) - arm, place(at_px) + arm]);
                }
                THIN
            }
            Form::Arrow { from_px, to_px } => {
                for ends in arrow(place(from_px).to_array(), place(to_px).to_array()) {
                    line(&mut path, ends.map(DVec2::from_array));
                }
                THIN
            }
            Form::Line { along_px, width } => {
                line(&mut path, along_px.iter().map(place));
                *width
            }
            Form::Words { at_px, radius_px, below, text } => {
                words(canvas, place(at_px), ring_reach(*radius_px, scale) + 2.0, *below, text, *colour);
                continue;
            }
        };
        if let Some(path) = path.finish() {
            canvas.stroke(&path, width as f32, *colour);
        }
    }
}

fn circle(path: &mut PathBuilder, centre: DVec2, reach: f64) {
    if is_near(centre) && reach < FAR {
        path.push_circle(centre.x as f32, centre.y as f32, reach as f32);
    }
}

/// From point to point; one that is too far away leaves a gap.
fn line(path: &mut PathBuilder, along: impl IntoIterator<Item = DVec2>) {
    let mut pen_down = false;
    for at in along {
        let (u, v) = (at.x as f32, at.y as f32);
        match (is_near(at), pen_down) {
            (true, true) => path.line_to(u, v),
            (true, false) => path.move_to(u, v),
            (false, _) => {}
        }
        pen_down = is_near(at);
    }
}

fn is_near(at: DVec2) -> bool {
    at.x.abs() < FAR && at.y.abs() < FAR
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
