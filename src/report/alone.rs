//! A frame that has no matched DRR, as it would look beside one.

use super::colour;
use crate::acquire::{Domain, Frame};
use crate::image::Image;

/// A frame without a partner, as it would look beside one: larger (brighter) is more attenuation.
#[must_use]
pub fn alone(frame: &Frame) -> (Image<f32>, String) {
    let unit = frame.unit.as_deref().unwrap_or("");
    match frame.domain {
        Domain::Linear => {
            let air = if unit == "1" { 1.0 } else { colour::window(&[&frame.pixels], None)[1] };
            let words = if unit == "1" { "nepers" } else { "nepers below the brightest" };
            (frame.pixels.map(|&v| if v > 0.0 { -(f64::from(v) / air).ln() as f32 } else { f32::NAN }), words.into())
        }
        Domain::Log => (frame.pixels.clone(), if unit == "neper" { "nepers".into() } else { "log value".into() }),
        Domain::Display | Domain::Unknown => (frame.pixels.map(|v| -v), format!("{} value, sign turned", frame.domain)),
    }
}
