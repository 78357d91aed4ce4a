//! A frame that has no matched DRR, as it would look beside one.

use super::colour;
use crate::acquire::{Domain, Frame};
use crate::image::Image;
use crate::mask::Masks;

/// A frame without a partner, as it would look beside one: larger (brighter) is more attenuation.
#[derive(Clone, Debug)]
pub struct Alone {
    /// NaN where a value has no logarithm.
    pub values: Image<f32>,
    /// Of the values.
    pub unit: String,
    /// True where they mean something.
    pub usable: Image<bool>,
    /// True behind the collimator.
    pub shut_off: Image<bool>,
    /// From black to white: of what means something.
    pub window: [f64; 2],
}

impl Alone {
    /// `frame`, of which `masks` say what its pixels mean.
    #[must_use]
    pub fn of(frame: &Frame, masks: &Masks) -> Self {
        let (values, unit) = values(frame);
        let (usable, shut_off) = (masks.usable(values.width, values.height, &[]), masks.shut_off(values.width, values.height));
        let window = colour::window(&[&values], Some(&usable));
        Self { values, unit, usable, shut_off, window }
    }
}

fn values(frame: &Frame) -> (Image<f32>, String) {
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
