//! From a frame to the shadows of spheres in it.

use glam::DVec2;
use rayon::prelude::*;
use serde::Serialize;

use super::candidates::{self, Candidate, blur};
use super::fit::{Guess, finish, fit, refit, screen};
use super::flags::Flags;
use super::model::{Fit, Model};
use super::noise::Noise;
use super::profile::SHAPES;
use super::radius_sigma::among_forms;
use super::several::{DISTURBING, MOST_MISFIT, distinct, disturbed_px, once_per_place, overlap, same};
use super::window::Field;
use crate::acquire::{Domain, Frame};
use crate::estimate::median;
use crate::geometry::{Distortion, noise_through};
use crate::image::Image;
use crate::mask::fill;

/// What a pixel's value is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Signal {
    /// Proportional to transmitted intensity; metal is low.
    Transmission,
    /// −ln of transmission, up to an offset and at natural scale; metal is high.
    LineIntegral,
    /// Rising with attenuation, at an unknown scale; metal is high.
    Attenuation,
    /// Any monotone function of these, rising or falling.
    Unknown,
}

/// Which way metal goes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Polarity {
    /// Metal is dark.
    Dark,
    /// Metal is bright.
    Bright,
}

/// The shadow of a sphere.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Detection {
    /// Centre of the shadow; its small bias against the projected centre is corrected once P is known.
    pub image_px: DVec2,
    /// Standard deviation of the centre per axis, the mean of both.
    pub sigma_px: f64,
    /// Covariance of (u, v), for the noise's correlation and what structure there is; zero throughout: none but `sigma_px` is stated. Of what
    /// [`detect`] finds it is positive definite.
    pub covariance_px2: [[f64; 2]; 2],
    /// Radius of the shadow before blur.
    pub radius_px: f64,
    /// Standard deviation of that radius' logarithm, for noise and for what blur hides; 0: none is stated.
    pub radius_sigma_ln: f64,
    /// Depth of the shadow in its middle, as blur leaves it: nepers for transmission and line integrals, else the frame's unit.
    pub contrast: f64,
    /// Depth over its standard deviation, form and size taken as fitted.
    pub snr: f64,
    /// Structure that a sphere's shadow does not explain, as a share of the depth.
    pub misfit: f64,
    /// In (0, 1]: how much it looks like a bead and like the other beads; orders the search for a match.
    pub quality: f64,
    /// What speaks against its centre.
    pub flags: Flags,
}

impl Detection {
    /// The same with place, covariance and size in the undistorted picture.
    #[must_use]
    pub fn straightened(&self, distortion: &Distortion) -> Self {
        let jacobian = distortion.jacobian(self.image_px);
        let [uu, uv, vv] = noise_through(jacobian, self.noise_px2());
        Self {
            image_px: distortion.undistorted(self.image_px),
            sigma_px: (0.5 * (uu + vv)).sqrt(),
            covariance_px2: [[uu, uv], [uv, vv]],
            radius_px: self.radius_px * jacobian.determinant().sqrt(),
            ..*self
        }
    }

    /// By how much the logarithm of its radius may differ from that of another, where something else moves it by `else_ln`. What noise and
    /// blur hide has nothing to do with that: they add in squares. Of itself alone: by 0.
    #[must_use]
    pub fn radius_slack_ln(&self, else_ln: f64) -> f64 {
        else_ln.hypot(RADIUS_SIGMAS * self.radius_sigma_ln.max(0.0))
    }
}

/// All shadows found.
#[derive(Clone, Debug, PartialEq)]
pub struct Detections {
    /// Best first.
    pub found: Vec<Detection>,
    /// Which way metal goes.
    pub polarity: Polarity,
    /// What was found the other way round, best first; empty when the polarity is known.
    pub opposite: Vec<Detection>,
    /// How the polarity is known.
    pub evidence: String,
}

/// What is known beforehand.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Expectation {
    /// Smallest and largest radius of a shadow.
    pub radius_px: Option<(f64, f64)>,
    /// The frame shows a grid of spots: thousands of blobs are looked at, and noise is measured beside them, of which they would be most.
    pub grid: bool,
}

/// Radii searched when nothing is known.
const ANY_RADIUS_PX: (f64, f64) = (0.9, 24.0);
/// Blobs that are looked at: in a specimen, and in a grid of 60 × 60 with as many false ones.
const MOST_CANDIDATES: usize = 160;
const MOST_IN_GRID: usize = 7200;
/// Noise is measured so many radii from a grid's spots.
const BESIDE: f64 = 2.2;
/// Shadows that are tried as two.
const MOST_DOUBTFUL: usize = 16;
/// Contrast over noise below which a shadow is not trusted.
const LEAST_SNR: f64 = 6.0;
/// Structure as a share of the radius beyond which a faint shadow is a thread or a crossing of wires; a clear one may have more.
const MOST_STRUCTURE: f64 = 0.13;
const CLEAR_SNR: f64 = 25.0;
/// Standard deviations of its own by which a radius may be off where it is held against another.
const RADIUS_SIGMAS: f64 = 2.0;
/// Display curves change their slope by about half over the depth of a bead.
const DISPLAY_CURVE: f64 = 0.5;

/// Finds beads in `pixels`, whose values are a `signal`; `mask` is true where the frame may be used (everywhere if `None`). Pixels that
/// are not finite are left out.
#[must_use]
pub fn detect_image(pixels: &Image<f32>, signal: Signal, mask: Option<&Image<bool>>, expected: &Expectation) -> Detections {
    let usable = Image {
        width: pixels.width,
        height: pixels.height,
        pixels: pixels
            .pixels
            .par_iter()
            .enumerate()
            .map(|(n, value)| value.is_finite() && mask.is_none_or(|mask| mask.pixels.get(n).copied().unwrap_or(false)))
            .collect(),
    };
    let nothing = |evidence: &str| Detections {
        found: Vec::new(),
        polarity: Polarity::Dark,
        opposite: Vec::new(),
        evidence: evidence.to_owned(),
    };
    if pixels.width < 16 || pixels.height < 16 {
        return nothing("the frame is smaller than 16 pixels");
    }
    let filled = fill(pixels, &usable);
    let radius_px = expected.radius_px.unwrap_or(ANY_RADIUS_PX);
    let most = if expected.grid { MOST_IN_GRID } else { MOST_CANDIDATES };
    match signal {
        Signal::Transmission | Signal::LineIntegral => {
            let transmission =
                if signal == Signal::LineIntegral { filled.map(|p| (-p).clamp(-80.0, 80.0).exp()) } else { filled };
            let evidence = match signal {
                Signal::LineIntegral => "line integrals: metal is bright",
                _ => "linear intensities: metal is dark",
            };
            let bright = line_integral(&transmission);
            let plain = expected.grid.then(|| beside(&candidates::find(&bright, &usable, radius_px, most), &usable));
            let noise = Noise::measure(&transmission, plain.as_ref().unwrap_or(&usable), true);
            let field = Field::new(&transmission, &usable, &noise, 0.0);
            let found = find(&field, &bright, &[Model::Transmission], radius_px, most);
            let polarity = if signal == Signal::LineIntegral { Polarity::Bright } else { Polarity::Dark };
            Detections { found, polarity, opposite: Vec::new(), evidence: evidence.to_owned() }
        }
        Signal::Attenuation | Signal::Unknown => {
            let blobs = |sign: f32| candidates::find(&filled.map(|value| sign * value), &usable, radius_px, most);
            let plain = expected.grid.then(|| match signal {
                Signal::Unknown => beside(&blobs(-1.0), &beside(&blobs(1.0), &usable)),
                _ => beside(&blobs(1.0), &usable),
            });
            let noise = Noise::measure(&filled, plain.as_ref().unwrap_or(&usable), false);
            let field = Field::new(&filled, &usable, &noise, if signal == Signal::Unknown { DISPLAY_CURVE } else { 0.0 });
            let one = |sign: f64| {
                let models: Vec<Model> = (0..SHAPES.len()).map(|shape| Model::Additive { sign, shape }).collect();
                find(&field, &filled.map(|value| sign as f32 * value), &models, radius_px, most)
            };
            if signal == Signal::Attenuation {
                let evidence = "attenuation at an unknown scale: metal is bright".to_owned();
                return Detections { found: one(1.0), polarity: Polarity::Bright, opposite: Vec::new(), evidence };
            }
            let (dark, bright) = rayon::join(|| one(-1.0), || one(1.0));
            let weight = |found: &[Detection]| found.iter().take(12).map(|d| d.quality).sum::<f64>();
            let (dark_weight, bright_weight) = (weight(&dark), weight(&bright));
            let evidence = format!(
                "grey values of unknown sense: {} dark shadows (weight {dark_weight:.2}), {} bright ones (weight {bright_weight:.2})",
                dark.len(),
                bright.len()
            );
            if dark_weight >= bright_weight {
                Detections { found: dark, polarity: Polarity::Dark, opposite: bright, evidence }
            } else {
                Detections { found: bright, polarity: Polarity::Bright, opposite: dark, evidence }
            }
        }
    }
}

/// Finds beads in a frame. Linear frames and logarithms in nepers are taken at their word, logarithms of unknown scale at their sense;
/// in all others metal may be dark or bright and the frame itself decides.
#[must_use]
pub fn detect(frame: &Frame, mask: Option<&Image<bool>>, expected: &Expectation) -> Detections {
    let signal = match frame.domain {
        Domain::Linear => Signal::Transmission,
        Domain::Log if frame.unit.as_deref() == Some("neper") => Signal::LineIntegral,
        Domain::Log => Signal::Attenuation,
        Domain::Display | Domain::Unknown => Signal::Unknown,
    };
    detect_image(&frame.pixels, signal, mask, expected)
}

/// What is usable and lies beside all of `candidates`, but for those far larger than most, which are the gaps of a grid.
fn beside(candidates: &[Candidate], usable: &Image<bool>) -> Image<bool> {
    let mut plain = usable.clone();
    let usual = median(candidates.iter().map(|candidate| candidate.radius_px)).unwrap_or(0.0);
    for candidate in candidates.iter().filter(|candidate| candidate.radius_px <= 2.1 * usual) {
        let reach = BESIDE * candidate.radius_px;
        let range = |centre: f64, count: usize| (centre - reach).max(0.0) as usize..((centre + reach) as usize + 1).min(count);
        for row in range(candidate.v_px, usable.height) {
            for column in range(candidate.u_px, usable.width) {
                if (column as f64 - candidate.u_px).hypot(row as f64 - candidate.v_px) < reach {
                    *plain.at_mut(column, row) = false;
                }
            }
        }
    }
    plain
}

/// −ln of slightly smoothed transmission; values without quanta are held at a third of the lowest that occur.
fn line_integral(transmission: &Image<f32>) -> Image<f32> {
    let mut smooth = blur(transmission, 0.7);
    let is_positive = |value: &f32| *value > 0.0;
    let mut positive: Vec<f32> = if smooth.pixels.par_iter().all(is_positive) {
        smooth.pixels.iter().copied().step_by(7).collect()
    } else {
        smooth.pixels.iter().copied().filter(is_positive).step_by(7).collect()
    };
    if positive.is_empty() {
        return smooth.map(|_| 0.0);
    }
    let low = positive.len() / 500;
    let floor = (*positive.select_nth_unstable_by(low, f32::total_cmp).1 / 3.0).max(f32::MIN_POSITIVE);
    smooth.pixels.par_iter_mut().for_each(|value| *value = -value.max(floor).ln());
    smooth
}

fn find(field: &Field, bright: &Image<f32>, models: &[Model], radius_px: (f64, f64), most: usize) -> Vec<Detection> {
    let candidates = candidates::find(bright, field.usable, radius_px, most);
    // Which of several profiles it is matters to size and misfit, hardly to the centre: asked only of what may be a bead.
    let best_model = |first: Fit, others: &[Fit]| -> Fit {
        if models.len() == 1 || !(first.snr > 0.7 * LEAST_SNR && first.misfit < 2.0 * MOST_MISFIT) {
            return first;
        }
        let tried: Vec<Fit> =
            models[1..].iter().filter_map(|model| refit(field, *model, &first, others)).chain([first]).collect();
        let best = tried.iter().fold(first, |best, next| if best.is_as_good_as(next) { best } else { *next });
        among_forms(best, &tried)
    };
    let screened: Vec<Option<Fit>> = candidates.par_iter().map(|c| screen(field, models[0], &guess(c), &[])).collect();
    let fits: Vec<Fit> = candidates
        .par_iter()
        .zip(once_per_place(screened))
        .filter_map(|(candidate, first)| finish(field, &first?, &guess(candidate), &[]).map(|fit| best_model(fit, &[])))
        .collect();
    let mut kept = distinct(fits.iter().copied().filter(|fit| is_bead(fit, radius_px)).collect());

    // Beads that touch: a shadow that one sphere does not explain is tried as one of two.
    let doubtful: Vec<Fit> = fits
        .iter()
        .copied()
        .filter(|fit| {
            fit.snr > 2.0 * LEAST_SNR && fit.misfit > MOST_MISFIT && fit.misfit < 0.6 && !kept.iter().any(|k| same(k, fit))
        })
        .take(MOST_DOUBTFUL)
        .collect();
    let pairs: Vec<[Fit; 2]> = candidates
        .par_iter()
        .filter_map(|candidate| {
            let partner = doubtful.iter().chain(&kept).find(|fit| {
                let distance = (fit.u_px - candidate.u_px).hypot(fit.v_px - candidate.v_px);
                let radius = candidate.radius_px.max(0.8 * fit.radius_px);
                distance > 0.5 * radius && distance < 2.6 * radius && (0.4..2.5).contains(&(fit.radius_px / candidate.radius_px))
            })?;
            (!kept.iter().any(|k| (k.u_px - candidate.u_px).hypot(k.v_px - candidate.v_px) < 0.6 * k.radius_px))
                .then(|| apart(field, models[0], candidate, partner))
                .flatten()
        })
        .collect();
    kept.extend(pairs.into_iter().flatten().filter(|fit| is_bead(fit, radius_px)));
    kept = distinct(kept);

    // Neighbours are taken out of each other's windows; two rounds are enough for shadows that overlap by less than half.
    for _ in 0..2 {
        let refined: Vec<Fit> = kept
            .par_iter()
            .map(|own| {
                let others: Vec<Fit> = kept
                    .iter()
                    .filter(|other| !same(other, own) && other.snr > DISTURBING * own.snr)
                    .filter(|other| {
                        (other.u_px - own.u_px).hypot(other.v_px - own.v_px) < 2.2 * own.radius_px + 1.4 * other.radius_px + 6.0
                    })
                    .copied()
                    .collect();
                if others.is_empty() {
                    return *own;
                }
                let again = fit(field, own.model, &place(own), &others).filter(|fit| is_bead(fit, radius_px));
                // What other forms make of the radius is not tried again.
                let known = |fit: Fit| Fit { radius_sigma_ln: fit.radius_sigma_ln.max(own.radius_sigma_ln), ..fit };
                again.map_or(*own, known)
            })
            .collect();
        kept = distinct(refined);
    }
    ranked(&kept)
}

/// Alternately fits `candidate` and `partner`, each with the other taken out: on few pixels until they keep apart, then on all.
fn apart(field: &Field, model: Model, candidate: &Candidate, partner: &Fit) -> Option<[Fit; 2]> {
    let mut second = *partner;
    second.radius_px = second.radius_px.min(1.3 * candidate.radius_px);
    let mut first = screen(field, model, &guess(candidate), &[second])?;
    second = screen(field, model, &place(&second), &[first])?;
    first = screen(field, model, &place(&first), &[second])?;
    second = screen(field, model, &place(&second), &[first])?;
    first = finish(field, &first, &place(&first), &[second])?;
    second = finish(field, &second, &place(&second), &[first])?;
    ((first.u_px - second.u_px).hypot(first.v_px - second.v_px) > 0.4 * second.radius_px).then_some([first, second])
}

fn is_bead(fit: &Fit, radius_px: (f64, f64)) -> bool {
    let sigma = fit.covariance_px2[0][0].max(fit.covariance_px2[1][1]).sqrt();
    fit.contrast > 0.0
        && fit.snr >= LEAST_SNR
        && fit.misfit <= MOST_MISFIT
        && fit.coverage > 0.7
        && fit.radius_px >= 0.7 * radius_px.0
        && fit.radius_px <= 1.3 * radius_px.1
        && fit.blur_px <= 0.9 * fit.radius_px + 0.8
        && fit.structure_px <= MOST_STRUCTURE * fit.radius_px * (fit.snr / CLEAR_SNR).clamp(1.0, 3.0)
        && sigma <= 0.5 * fit.radius_px + 0.2
}

fn guess(candidate: &Candidate) -> Guess {
    Guess { u_px: candidate.u_px, v_px: candidate.v_px, radius_px: candidate.radius_px }
}

fn place(fit: &Fit) -> Guess {
    Guess { u_px: fit.u_px, v_px: fit.v_px, radius_px: fit.radius_px }
}

/// As detections, best first.
fn ranked(fits: &[Fit]) -> Vec<Detection> {
    // Beads of one specimen look alike: radii differ by magnification, contrasts by what lies behind them.
    let alike = |a: &Fit, b: &Fit| (a.radius_px / b.radius_px).ln().abs() < 0.2 && (a.depth / b.depth).ln().abs() < 0.5;
    let mut found: Vec<Detection> = fits
        .iter()
        .map(|fit| {
            let company = fits.iter().filter(|other| alike(fit, other)).count() - 1;
            let variance = disturbed_px(fit, fits).powi(2);
            let [[uu, uv], [vu, vv]] = fit.covariance_px2;
            let covariance_px2 = [[uu + variance, uv], [vu, vv + variance]];
            let own = (1.0 - fit.misfit / (1.2 * MOST_MISFIT)).max(0.05) * fit.snr / (fit.snr + 10.0);
            Detection {
                image_px: DVec2::new(fit.u_px, fit.v_px),
                sigma_px: (0.5 * (covariance_px2[0][0] + covariance_px2[1][1])).sqrt(),
                covariance_px2,
                radius_px: fit.radius_px,
                radius_sigma_ln: fit.radius_sigma_ln,
                contrast: fit.depth,
                snr: fit.snr,
                misfit: fit.misfit,
                quality: own * (0.4 + 0.6 * (company.min(4) as f64 / 4.0)),
                flags: Flags { overlapping: fits.iter().any(|other| overlap(fit, other)), ..fit.flags },
            }
        })
        .collect();
    found.sort_by(|a, b| b.quality.total_cmp(&a.quality));
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    /// At some places the two were added as they are, at others in squares.
    #[test]
    fn what_hides_a_radius_adds_in_squares_to_what_else_moves_it() {
        for (radius_sigma_ln, else_ln, expected) in [(0.0, 0.3, 0.3), (0.2, 0.3, 0.5), (0.2, 0.0, 0.4), (-1.0, 0.3, 0.3)] {
            let slack = Detection { radius_sigma_ln, ..Detection::default() }.radius_slack_ln(else_ln);
            assert!((slack - expected).abs() < 1e-12, "{radius_sigma_ln} {else_ln}: {slack}");
        }
    }
}
