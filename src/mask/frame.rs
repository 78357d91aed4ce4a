//! What a frame alone says of its pixels.

use std::borrow::Cow;

use super::dead::dead_pixels;
use super::field::find_told_field;
use super::layers::{Cause, Masks};
use super::shape::FieldShape;
use super::text::burned_in;
use super::told::told_by_header;
use crate::acquire::panel_maps::{AT_LOW_END, BURNED_IN, DEAD, HOT, SATURATED, UNSTABLE};
use crate::acquire::{Domain, Frame};
use crate::image::{Image, zip};

/// Masks that the acquired frame alone decides, at its full size.
#[must_use]
pub fn of_frame(frame: &Frame) -> Masks {
    of_told_frame(frame, &FieldShape::default())
}

/// [`of_frame`], where telemetry says that the edges of `told` are there, besides those of the frame's own header.
#[must_use]
pub fn of_told_frame(frame: &Frame, told: &FieldShape) -> Masks {
    let pixels = &frame.pixels;
    let by_header = told_by_header(frame);
    let mut told = told.clone();
    told.half_planes.extend(by_header.half_planes);
    told.disc = told.disc.or(by_header.disc);
    let mut masks = Masks::default();
    masks.add(Cause::NotMeasured, pixels.map(|v| !v.is_finite()));
    if let Some(field) = find_told_field(pixels, frame.larger_is_more_attenuation(), frame.domain.is_gray(), &told) {
        masks.field = Some(field.description);
        masks.disc = field.shape.disc;
        masks.add(Cause::Collimation, field.outside);
    }
    // Writing is found first: its strokes lie at the ends of the scale as well, but are no clipping.
    let flagged = |flags: &Image<u8>, any: u8| flags.map(|flag| flag & any != 0);
    let none = || Image::filled(pixels.width, pixels.height, false);
    let at_end = |end: Option<f32>| end.map_or_else(none, |end| pixels.map(|v| end == *v));
    let flags = frame.correction.as_ref().and_then(|correction| correction.flags.as_deref());
    let mut saturated = at_end(frame.clipping.saturated_at);
    let mut black = at_end(frame.clipping.black_at);
    if let Some(flags) = flags {
        saturated = zip(&saturated, flags, |here, flag| *here || flag & SATURATED != 0);
        black = zip(&black, flags, |here, flag| *here || flag & AT_LOW_END != 0);
    }
    let written = burned_in(&[&saturated, &black]);
    masks.add(Cause::Saturation, saturated);
    if frame.domain == Domain::Display {
        masks.add(Cause::NoSignal, black);
    }
    masks.add(Cause::BurnedIn, written);
    if let Some(flags) = flags {
        masks.add(Cause::BurnedIn, flagged(flags, BURNED_IN));
        masks.add(Cause::DeadPixels, flagged(flags, DEAD | HOT | UNSTABLE));
    }
    // A hot pixel is often at the end of the scale.
    let usable = masks.usable(pixels.width, pixels.height, &[Cause::Saturation]);
    let found = of_quanta(frame).and_then(|quanta| dead_pixels(&quanta, &usable, masks.layer(Cause::BurnedIn)));
    if let Some(dead) = found {
        masks.add(Cause::DeadPixels, dead);
    }
    masks
}

/// Values proportional to quanta, up to an offset; `None` where their scale is not known, and where a console or a codec has processed them:
/// it has mended what was dead, and has written and sharpened.
fn of_quanta(frame: &Frame) -> Option<Cow<'_, Image<f32>>> {
    if frame.is_lossy() {
        return None;
    }
    match frame.domain {
        Domain::Linear => Some(Cow::Borrowed(&frame.pixels)),
        Domain::Log if frame.unit.as_deref() == Some("neper") => {
            Some(Cow::Owned(frame.pixels.map(|nepers| (-nepers).clamp(-80.0, 80.0).exp())))
        }
        Domain::Log | Domain::Display | Domain::Unknown => None,
    }
}
