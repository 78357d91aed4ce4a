//! The round window a shadow is fitted in: its usable pixels as columns of numbers, with what does not change during the fit.

use rayon::prelude::*;

use super::correlation::REACH;
use super::model::{Fit, Model, Stopped};
use super::noise::Noise;
use super::profile::Profile;
use crate::image::Image;

/// What the fit works on.
pub struct Field<'a> {
    pub pixels: &'a Image<f32>,
    pub usable: &'a Image<bool>,
    pub noise: &'a Noise,
    /// How much deeper or shallower a shadow may be where the background has changed by the shadow's depth, as a share (standard
    /// deviation): 0 where values are physical, more behind a display curve that nobody knows.
    pub display_curve: f64,
    /// Values at and beyond which a pixel is clipped.
    clipped: (f32, f32),
}

/// Pixels that have the frame's lowest or highest value where that is the end of its grey values.
const CLIPPED_PIXELS: usize = 12;

impl<'a> Field<'a> {
    /// `pixels`, of which those that are `usable` count.
    pub fn new(pixels: &'a Image<f32>, usable: &'a Image<bool>, noise: &'a Noise, display_curve: f64) -> Self {
        let values = || pixels.pixels.iter().zip(&usable.pixels).filter(|(_, usable)| **usable).map(|(value, _)| *value);
        let each = || pixels.pixels.par_iter().zip(&usable.pixels).filter(|(_, usable)| **usable).map(|(value, _)| *value);
        let low = each().reduce(|| f32::INFINITY, f32::min);
        let high = each().reduce(|| f32::NEG_INFINITY, f32::max);
        let often = |end: f32| values().filter(|value| *value == end).take(CLIPPED_PIXELS).count() == CLIPPED_PIXELS;
        let clipped = (if often(low) { low } else { f32::NEG_INFINITY }, if often(high) { high } else { f32::INFINITY });
        Self { pixels, usable, noise, display_curve, clipped }
    }

    /// Whether `value` is at an end of the frame's grey values.
    pub fn is_clipped(&self, value: f64) -> bool {
        value <= f64::from(self.clipped.0) || value >= f64::from(self.clipped.1)
    }
}

/// Terms of the background.
pub const BACKGROUND: usize = 10;

/// Usable pixels of a round window; all columns are of one length.
pub struct Window {
    pub u_px: f64,
    pub v_px: f64,
    pub half_width: f64,
    /// Column and row in the frame, against the window's first.
    pub place: Vec<(u16, u16)>,
    /// Position against the window's centre.
    pub dx: Vec<f64>,
    pub dy: Vec<f64>,
    pub value: Vec<f64>,
    /// Pixels that cannot be used, masked or outside the frame, against the window's centre.
    pub missing: Vec<(f64, f64)>,
    /// What neighbouring beads contribute: a factor (transmission) or a term.
    pub others: Vec<f64>,
    /// Terms of the background at each pixel.
    pub basis: [Vec<f64>; BACKGROUND],
    /// Pixels there would be if all were usable.
    pub total: f64,
    /// Columns of a grid that holds the window with room for the noise's reach.
    pub side: usize,
    /// Whether all pixels of the window were taken.
    pub is_whole: bool,
}

/// Whole polynomials to the third degree in window units. Of odd terms only those that vary once around the centre are correlated with
/// it, and of even ones none; the others keep curved tissue out of the residual.
fn basis(x: f64, y: f64) -> [f64; BACKGROUND] {
    [1.0, x, y, x * x, x * y, y * y, x * x * x, x * x * y, x * y * y, y * y * y]
}

impl Window {
    /// The window about (`u_px`, `v_px`), thinned out to about `most_pixels`; `others` are shadows taken into account where they reach.
    pub fn new(
        field: &Field,
        model: Model,
        (u_px, v_px): (f64, f64),
        half_width: f64,
        others: &[Fit],
        most_pixels: usize,
    ) -> Self {
        let every = (std::f64::consts::PI * half_width * half_width / most_pixels as f64).round().max(1.0) as i64;
        let (w, h) = (field.pixels.width as i64, field.pixels.height as i64);
        let reach = half_width.ceil() as i64;
        let (column0, row0) = (u_px.round() as i64 - reach, v_px.round() as i64 - reach);
        let near: Vec<(&Fit, Profile, Stopped)> = others
            .iter()
            .filter(|other| {
                (other.u_px - u_px).hypot(other.v_px - v_px) < half_width + 1.3 * other.radius_px + 3.0 * other.blur_px
            })
            .map(|other| {
                let profile = Profile::new(other.model.shape(other.contrast), other.blur_px / other.radius_px);
                (other, profile, Stopped::of(other.contrast))
            })
            .collect();
        let room = (3.3 * half_width * half_width / every as f64) as usize + 16;
        let column = || Vec::with_capacity(room);
        let mut window = Self {
            u_px,
            v_px,
            half_width,
            place: Vec::with_capacity(room),
            dx: column(),
            dy: column(),
            value: column(),
            missing: Vec::new(),
            others: column(),
            basis: std::array::from_fn(|_| column()),
            total: 0.0,
            side: 2 * reach as usize + 1 + REACH,
            is_whole: every == 1,
        };
        for row in row0..=row0 + 2 * reach {
            for column in column0..=column0 + 2 * reach {
                let (dx, dy) = (column as f64 - u_px, row as f64 - v_px);
                if dx * dx + dy * dy > half_width * half_width || (column + 3 * row).rem_euclid(every) != 0 {
                    continue;
                }
                window.total += 1.0;
                let index = (row * w + column).max(0) as usize;
                if column < 0 || row < 0 || column >= w || row >= h || !field.usable.pixels[index] {
                    window.missing.push((dx, dy));
                    continue;
                }
                let value = |other: &Fit, profile: &Profile| {
                    let rho = (column as f64 - other.u_px).hypot(row as f64 - other.v_px) / other.radius_px;
                    profile.at(rho).value
                };
                window.others.push(match model {
                    Model::Transmission => {
                        near.iter().map(|(other, profile, stopped)| stopped.left(value(other, profile))).product()
                    }
                    Model::Additive { sign, .. } => {
                        sign * near.iter().map(|(other, profile, _)| other.contrast * value(other, profile)).sum::<f64>()
                    }
                });
                window.place.push(((column - column0) as u16, (row - row0) as u16));
                window.dx.push(dx);
                window.dy.push(dy);
                window.value.push(f64::from(field.pixels.pixels[index]));
                for (column, term) in window.basis.iter_mut().zip(basis(dx / half_width, dy / half_width)) {
                    column.push(term);
                }
            }
        }
        window
    }

    /// `values` of the pixels on a square grid of `side` columns, 0 elsewhere.
    pub fn on_grid(&self, values: &[f64]) -> Vec<f64> {
        let mut grid = vec![0.0; self.side * self.side];
        for ((column, row), value) in self.place.iter().zip(values) {
            grid[usize::from(*row) * self.side + usize::from(*column)] = *value;
        }
        grid
    }

    /// How many pixels can be used.
    pub fn len(&self) -> usize {
        self.value.len()
    }
}
