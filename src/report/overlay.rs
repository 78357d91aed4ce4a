//! What a registration saw: the frame with its masks, shadows, beads and residuals.

use super::canvas::{Canvas, Rgb};
use super::colour::{gray, window};
use super::drawn::draw;
use super::marks::PairMarks;
use crate::acquire::Frame;
use crate::image::Image;
use crate::mask::Masks;
use crate::pose::Pose;

const MASKED: Rgb = [150, 60, 200];

/// The frame in grey, of its own size. Masked pixels are tinted; thin white circles are shadows that are no bead's (grey where something
/// speaks against their centre), green ones those that P rests on, red ones those left out; yellow crosses stand where P puts the beads; magenta arrows are residuals, 20 times enlarged, as are
/// the orange ellipses about landmarks. Refused frames show what was found as well.
#[must_use]
pub fn overlay(frame: &Frame, pose: &Pose, masks: &Masks) -> Image<Rgb> {
    let [width, height] = frame.size_px;
    let usable = masks.usable(width, height, &[]);
    let seen = window(&[&frame.pixels], Some(&usable));
    let mut canvas = Canvas::over(frame.pixels.map(|value| gray(*value, seen)));
    for (at, usable) in usable.pixels.iter().enumerate() {
        if !usable {
            canvas.blend((at % width) as i64, (at / width) as i64, MASKED, 0.35);
        }
    }
    draw(&mut canvas, &PairMarks::of(pose, None, None, None).figures(), 1.0);
    canvas.image
}
