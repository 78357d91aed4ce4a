//! Veiling glare from what shines behind an opaque disc.
//!
//! Behind lead nothing but glare arrives: there m = ρ (K ⊛ I), and elsewhere m = (1 − ρ) I + ρ (K ⊛ I), I being the light without glare.
//! For each scale k the share ρ follows by turns with I; the k whose glare has the shape of what is measured behind the lead is taken.

use glam::DVec2;

use super::error::IntensifierFault;
use crate::acquire::{Domain, Frame};
use crate::geometry::Glare;
use crate::image::{Image, quantile};
use crate::mask::{Disc, components};
use crate::render::veil::spread;

/// Scales that are tried, in radii of the intensifier's disc, and how many between them.
const SCALES: (f64, f64, i32) = (0.03, 1.5, 18);
/// The lead is this large at least, in radii of the intensifier's disc.
const LEAST_LEAD: f64 = 0.04;
/// Pixels left out beside the lead's rim, as a share of its radius.
const RIM: f64 = 0.2;
/// Glare between these is believed; beyond, the frame has an offset, or the lead is none.
const BELIEVED: (f64, f64) = (0.002, 0.6);
/// The share and the light have settled when a turn changes the share by no more; where they do not in so many turns, that scale explains
/// nothing.
const SETTLED: f64 = 1e-3;
const MOST_TURNS: u32 = 12;
/// What the model may leave of the signal behind the lead.
const MOST_MISFIT: f64 = 0.15;

/// Fraction and scale of the glare of a linear frame whose offset is taken out, with an opaque disc in the open beam.
///
/// # Errors
/// When the frame is not linear, shows no opaque disc, or what shines there is no glare.
pub fn measure_glare(frame: &Frame, disc: &Disc) -> Result<Glare, IntensifierFault> {
    let fault = |why: String| IntensifierFault::Glare { frame: frame.name.clone(), why };
    if frame.domain != Domain::Linear {
        return Err(fault("veiling glare shows in linear values only (--domain linear, with the offset taken out)".to_owned()));
    }
    let pixels = &frame.pixels;
    let size = [pixels.width, pixels.height];
    let open = seen(pixels, disc);
    let lead = lead(pixels, &open, disc).ok_or_else(|| fault("no opaque disc shows in the open beam".to_owned()))?;
    let inner: Vec<usize> = lead.inner;
    let measured: Vec<f64> = inner.iter().map(|at| f64::from(pixels.pixels[*at])).collect();
    let try_scale = |scale_px: f64| {
        // Alternately: the light that glares, and the share of it that does.
        let mut fraction = 0.0;
        let mut glare = vec![0.0; pixels.pixels.len()];
        let mut change = f64::INFINITY;
        for _ in 0..MOST_TURNS {
            let light: Vec<f64> = (0..glare.len())
                .map(|at| {
                    let shines = open.pixels[at] && !lead.mask.pixels[at];
                    if shines { (f64::from(pixels.pixels[at]) - fraction * glare[at]) / (1.0 - fraction) } else { 0.0 }
                })
                .collect();
            glare = spread(&light, size, scale_px);
            let (mut both, mut square) = (0.0, 0.0);
            for (at, measured) in inner.iter().zip(&measured) {
                both += glare[*at] * measured;
                square += glare[*at] * glare[*at];
            }
            let before = std::mem::replace(&mut fraction, (both / square).clamp(0.0, 0.9));
            change = (fraction - before).abs();
            if change <= SETTLED {
                break;
            }
        }
        if !(change <= SETTLED) {
            return (f64::INFINITY, Glare { fraction, scale_px });
        }
        let off: f64 = inner.iter().zip(&measured).map(|(at, m)| (m - fraction * glare[*at]).powi(2)).sum();
        (off, Glare { fraction, scale_px })
    };
    let (low, high, steps) = SCALES;
    let at_step = |n: f64| disc.radius_px * low * (high / low).powf(n / f64::from(steps));
    let best =
        |tried: &mut dyn Iterator<Item = f64>| tried.map(|n| (n, try_scale(at_step(n)))).min_by(|a, b| a.1.0.total_cmp(&b.1.0));
    let coarse = best(&mut (0..=steps).map(f64::from));
    let fine = coarse.and_then(|(n, _)| best(&mut (-4..=4).map(|part| n + 0.25 * f64::from(part))));
    let (off, glare) = fine.map(|(_, tried)| tried).ok_or_else(|| fault("no scale fits".to_owned()))?;
    let misfit = (off / measured.iter().map(|m| m * m).sum::<f64>()).sqrt();
    if !(glare.fraction >= BELIEVED.0 && glare.fraction <= BELIEVED.1 && misfit <= MOST_MISFIT) {
        return Err(fault(format!(
            "what shines behind the opaque disc is no glare (fraction {:.3}, {:.0} % of it unexplained)",
            glare.fraction,
            100.0 * misfit
        )));
    }
    Ok(glare)
}

fn place(at: usize, width: usize) -> DVec2 {
    DVec2::new((at % width) as f64, (at / width) as f64)
}

fn seen(pixels: &Image<f32>, disc: &Disc) -> Image<bool> {
    let mut open = pixels.map(|_| false);
    for (at, open) in open.pixels.iter_mut().enumerate() {
        *open = place(at, pixels.width).distance(disc.centre) <= disc.radius_px;
    }
    open
}

/// The opaque disc: its pixels, and those of them that lie well inside.
struct Lead {
    mask: Image<bool>,
    inner: Vec<usize>,
}

/// The largest dark patch that does not touch the rim of the intensifier's disc.
fn lead(pixels: &Image<f32>, open: &Image<bool>, disc: &Disc) -> Option<Lead> {
    let mut values: Vec<f32> =
        pixels.pixels.iter().zip(&open.pixels).filter(|(_, open)| **open).map(|(value, _)| *value).collect();
    let (bright, dark) = (quantile(&mut values, 0.7)?, quantile(&mut values, 0.002)?);
    let limit = 0.5 * (bright + dark);
    let mut below = pixels.map(|value| f64::from(*value) < limit);
    below.pixels.iter_mut().zip(&open.pixels).for_each(|(below, open)| *below &= open);
    let inside = |at: &usize| place(*at, pixels.width).distance(disc.centre) < disc.radius_px - 2.0;
    let patches = components(&below).into_iter().filter(|patch| patch.indices.iter().all(inside));
    let patch = patches.max_by_key(|patch| patch.indices.len())?;
    let radius_px = (patch.indices.len() as f64 / std::f64::consts::PI).sqrt();
    if !(radius_px >= (LEAST_LEAD * disc.radius_px).max(4.0)) {
        return None;
    }
    let mut mask = pixels.map(|_| false);
    patch.indices.iter().for_each(|at| mask.pixels[*at] = true);
    let rim_px = RIM * radius_px + 1.5;
    let deep = |at: &usize| {
        let from = place(*at, pixels.width);
        (0..16).all(|n| {
            let to = (from + rim_px * DVec2::from_angle(f64::from(n) * std::f64::consts::TAU / 16.0)).round();
            let on = to.min_element() >= 0.0 && (to.x as usize) < mask.width && (to.y as usize) < mask.height;
            on && *mask.at(to.x as usize, to.y as usize)
        })
    };
    let inner: Vec<usize> = patch.indices.iter().copied().filter(|at| deep(at)).collect();
    (inner.len() >= 20).then_some(Lead { mask, inner })
}
