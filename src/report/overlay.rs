//! What a registration saw: the frame with its masks, shadows, beads and residuals.

use glam::DVec2;

use super::canvas::{Align, Canvas, Rgb};
use super::colour::{gray, window};
use crate::acquire::Frame;
use crate::image::Image;
use crate::mask::Masks;
use crate::pose::Pose;

const USED: Rgb = [40, 230, 80];
const LEFT_OUT: Rgb = [240, 50, 40];
const PREDICTED: Rgb = [250, 220, 30];
const SHADOW: Rgb = [235, 235, 245];
const RESIDUAL: Rgb = [255, 110, 230];
const MASKED: Rgb = [150, 60, 200];
/// Residuals are drawn so many times as long as they are.
const STRETCH: f64 = 20.0;
const LETTER_PX: f32 = 12.0;
/// Gap between a shadow's rim and its circle.
const GAP_PX: f64 = 4.0;

/// The frame in grey, of its own size. Masked pixels are tinted; thin white circles are all shadows found, green ones those that P rests
/// on, red ones those left out; yellow crosses stand where P puts the beads; magenta lines are residuals, 20 times enlarged. Refused
/// frames show what was found as well.
#[must_use]
pub fn overlay(frame: &Frame, pose: &Pose, masks: &Masks) -> Image<Rgb> {
    let [width, height] = frame.size_px;
    let usable = masks.usable(width, height, &[]);
    let seen = window(&[&frame.pixels], Some(&usable));
    let mut canvas = Canvas::new(width, height, [0; 3]);
    canvas.image = frame.pixels.map(|value| gray(*value, seen));
    for (at, usable) in usable.pixels.iter().enumerate() {
        if !usable {
            canvas.blend((at % width) as i64, (at / width) as i64, MASKED, 0.35);
        }
    }
    for shadow in &pose.shadows {
        ring(&mut canvas, DVec2::from_array(shadow.image_px), shadow.radius_px + GAP_PX, 1.0, SHADOW);
    }
    let radius_at = |at: DVec2| {
        let near = |shadow: &&crate::pose::Shadow| DVec2::from_array(shadow.image_px).distance(at) < 2.0;
        pose.shadows.iter().find(near).map_or(8.0, |shadow| shadow.radius_px)
    };
    for bead in &pose.beads {
        let observed = bead.image_px.map(DVec2::from_array);
        let predicted = bead.predicted_px.map(DVec2::from_array);
        if let Some(at) = observed {
            ring(&mut canvas, at, radius_at(at) + GAP_PX, 2.0, if bead.used { USED } else { LEFT_OUT });
        }
        if let Some(at) = predicted {
            line(&mut canvas, at - 4.0 * DVec2::X, at + 4.0 * DVec2::X, PREDICTED);
            line(&mut canvas, at - 4.0 * DVec2::Y, at + 4.0 * DVec2::Y, PREDICTED);
        }
        if let Some((from, off)) = predicted.zip(bead.residual_px.map(DVec2::from_array)) {
            line(&mut canvas, from, from + STRETCH * off, RESIDUAL);
        }
        if let Some(at) = observed.or(predicted) {
            let beside = at + DVec2::new(radius_at(at) + 2.0 * GAP_PX, -GAP_PX);
            canvas.text(beside.x as f32, beside.y as f32, &bead.name, LETTER_PX, PREDICTED, Align::Left);
        }
    }
    canvas.image
}

/// A circle about a point of the image (pixel centres at integers).
fn ring(canvas: &mut Canvas, centre: DVec2, radius_px: f64, thickness_px: f64, colour: Rgb) {
    if !(centre.is_finite() && radius_px.is_finite()) {
        return;
    }
    let reach = radius_px + thickness_px + 1.0;
    let limit = |value: f64, end: usize| value.clamp(0.0, end as f64) as usize;
    let (width, height) = (canvas.image.width, canvas.image.height);
    for v in limit(centre.y - reach, height)..limit(centre.y + reach + 1.0, height) {
        for u in limit(centre.x - reach, width)..limit(centre.x + reach + 1.0, width) {
            let off = (DVec2::new(u as f64, v as f64).distance(centre) - radius_px).abs();
            canvas.blend(u as i64, v as i64, colour, (0.5 * thickness_px + 0.5 - off) as f32);
        }
    }
}

/// A thin line between two points of the image, cut where it leaves it.
fn line(canvas: &mut Canvas, from: DVec2, to: DVec2, colour: Rgb) {
    let steps = (2.0 * from.distance(to)).ceil().clamp(1.0, 4000.0);
    if !(from.is_finite() && to.is_finite()) {
        return;
    }
    for step in 0..=steps as usize {
        let at = from.lerp(to, step as f64 / steps);
        canvas.blend(at.x.round() as i64, at.y.round() as i64, colour, 0.8);
    }
}
