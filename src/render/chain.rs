//! What beam shape and panel add to a render: the checks, the words, and the steps between attenuation and noise.

use super::blur::{FWHM_PER_SIGMA, blur_signal, focal_blur};
use super::cpu::attenuate_spectrum::Signal;
use super::cpu::integrate_density::Density;
use super::flood::{Flood, Weights, attenuate, flood, shapes_spectrum};
use super::plan_parts::{Choice, Executor, Node};
use super::spectrum::Bins;
use super::{Quantity, RenderError};
use crate::geometry::View;
use crate::scene::model::{Formation, Noise, Scene};
use crate::scene::optics::Fault;

/// The first number of beam shape or panel that makes no sense.
pub(super) fn check(scene: &Scene) -> Result<(), RenderError> {
    let number = |Fault { key, value, expected }| RenderError::Number { what: key, value, expected };
    scene.beam.shape.check().and_then(|()| scene.detector.panel.check()).map_err(number)
}

/// What is wanted besides line integrals.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Wanted {
    /// N₀(u), which noise and counts need.
    pub photons: bool,
    /// What noise needs to know of the photons that arrive.
    pub moments: bool,
}

/// Puts heel, bow-tie and focal spot into `signal`, and says what arrives without an object. Where heel or bow-tie shape the spectrum,
/// `signal` may come empty.
///
/// # Errors
/// When an energy is outside the tables, or nothing arrives on the principal ray.
pub(super) fn shape(
    scene: &Scene,
    view: &View,
    (nodes, executor): (&[Node], Executor),
    density: &Density,
    bins: &Bins,
    signal: &mut Signal,
    wanted: Wanted,
) -> Result<Flood, RenderError> {
    let weights = Weights::new(scene, nodes, bins)?;
    let flood = flood(scene, view, &weights, wanted.photons)?;
    if shapes_spectrum(scene) {
        let shaped = attenuate(view, density, bins, &weights, wanted.moments);
        signal.arriving = shaped.arriving;
        // The yardstick has its own heel and bow-tie, in f64.
        if executor != Executor::Reference {
            signal.line_integral = shaped.line_integral;
        }
    }
    if let Some(focal) = focal_blur(scene, view) {
        blur_signal(signal, view, focal.sigma_px);
    }
    Ok(flood)
}

/// What stands where the field is closed.
pub(super) const BESIDE: &str = "intensity 0 where closed, line_integral at most -ln 1/(2 N0)";
pub(super) const BESIDE_WITH_SCATTER: &str = "scatter alone where closed";

/// Marks what the field or the heel closes as invalid, and says how much that is, and what stands `there`.
pub(super) fn close(flood: &Flood, valid: &mut [u8], notes: &mut Vec<String>, there: &str) {
    let closed = flood.open.iter().filter(|open| **open < 1.0).count();
    for (valid, open) in valid.iter_mut().zip(&flood.open) {
        if *open < 1.0 {
            *valid = 0;
        }
    }
    if closed > 0 {
        let share = 100.0 * closed as f64 / flood.open.len() as f64;
        notes.push(format!("{closed} pixels ({share:.1} %) lie outside the field or on its edge: {there}, marked invalid"));
    }
}

/// Says where the heel is guessed.
pub(super) fn note_extrapolated(flood: &Flood, notes: &mut Vec<String>) {
    if flood.extrapolated > 0 {
        let count = flood.extrapolated;
        notes.push(format!("{count} pixels see the anode at an angle outside the tables: extrapolated in 1/sin of the angle"));
    }
}

/// Share of saturated pixels that are no few bright ones: the gain is not that of the panel.
const SATURATED_SHARE: f64 = 0.01;
/// Where a gain that fits puts the unattenuated signal, of the highest count.
const AIR_SHARE: f64 = 0.9;

/// Line integrals beyond which a f32 holds no intensity to full precision: its smallest normal number is e^-87.3, the smallest of all e^-103.3.
const UNDERFLOW_NEPERS: f32 = 87.0;

/// Says how many intensities are 0 although light comes through, too little for a f32; the note again. Under noise such a pixel is 0 as it should be.
pub(super) fn note_underflowed(
    quantity: Quantity,
    page: &[f32],
    line_integral: &[f32],
    is_noisy: bool,
    notes: &mut Vec<String>,
) -> Option<String> {
    if quantity != Quantity::Intensity || is_noisy {
        return None;
    }
    // Behind closed blades the line integral is infinite.
    let is_lost = |(value, line): &(&f32, &f32)| **value == 0.0 && **line > UNDERFLOW_NEPERS && line.is_finite();
    let lost = page.iter().zip(line_integral).filter(is_lost).count();
    let words =
        format!("{lost} pixels are 0 because their intensity is below the smallest 32-bit float: line_integral holds them");
    (lost > 0).then(|| {
        notes.push(words.clone());
        words
    })
}

/// Says how many counts are clipped, where `counts` are made. The note again where so many are saturated that a person should be warned.
pub(super) fn note_clipped(
    scene: &Scene,
    quantity: Quantity,
    page: &[f32],
    flood: &Flood,
    notes: &mut Vec<String>,
) -> Option<String> {
    let panel = &scene.detector.panel;
    if quantity != Quantity::Counts || (panel.saturation.is_none() && panel.bits.is_none()) {
        return None;
    }
    let air = flood.photons_per_pixel * flood.principal_response;
    let (lowest, highest) = super::detector::limits(scene, air);
    let saturated = page.iter().filter(|count| f64::from(**count) >= highest).count();
    let empty = page.iter().filter(|count| f64::from(**count) <= lowest).count();
    let is_warned = saturated as f64 > SATURATED_SHARE * page.len() as f64;
    if saturated > 0 {
        // Below that the panel's own saturation ends the scale, which is told in units of the unattenuated signal, whatever the gain.
        let is_of_bits = panel.bits.is_some_and(|bits| highest >= f64::from(bits).exp2() - 1.0);
        let fits = AIR_SHARE * (highest - scene.detector.offset) / air;
        let remedy = match panel.saturation {
            _ if !is_warned => String::new(),
            Some(most) if most < 1.0 || !is_of_bits => {
                format!(": detector.saturation is {most} of the unattenuated signal")
            }
            _ if fits > 0.0 => format!(": a detector.gain of {fits:.1e} fits, it is {}", scene.detector.gain),
            _ => format!(": no gain fits detector.offset {}", scene.detector.offset),
        };
        notes.push(format!("{saturated} pixels are saturated at {highest} counts{remedy}"));
    }
    let warned = if is_warned { notes.last().cloned() } else { None };
    if panel.bits.is_some() && empty > 0 {
        notes.push(format!("{empty} pixels are at 0 counts, the lowest that there is"));
    }
    warned
}

/// Each ingredient of beam and panel: modelled, not given, or left out with its bound.
pub(super) fn choices(scene: &Scene, quantity: Quantity) -> Vec<Choice> {
    let (shape, panel) = (&scene.beam.shape, &scene.detector.panel);
    let area = quantity == Quantity::AreaDensity;
    let naive = scene.model.formation == Formation::Naive;
    let mut list = Vec::new();
    let mut choose = |what: &str, given: bool, modelled: Option<String>, otherwise: &str| {
        let why = match (given, area, &modelled) {
            (false, ..) => "not given".to_owned(),
            (true, true, _) => "area density is that of the objects alone".to_owned(),
            (true, false, Some(how)) => how.clone(),
            (true, false, None) => otherwise.to_owned(),
        };
        list.push(Choice { what: what.to_owned(), modelled: given && !area && modelled.is_some(), why });
    };
    let spectral = if naive { "in N0(u) alone: naive formation does not harden" } else { "by energy, in N0(u) and in hardening" };
    choose("bow-tie", shape.bowtie.is_some(), Some(spectral.to_owned()), "");
    let heel = format!("{spectral}; tungsten output at each ray's take-off angle");
    choose("heel effect", shape.heel.is_some(), Some(heel), "");
    choose("collimation", shape.field.is_some(), Some("edge pixels by the share that is open, no penumbra".to_owned()), "");
    let focal = scene.view.as_ref().and_then(|view| focal_blur(scene, view)).map(|focal| {
        let [columns, rows] = focal.sigma_px.map(|sigma| sigma * FWHM_PER_SIGMA);
        let [near, far] = focal.range_px;
        format!(
            "FWHM {columns:.2} x {rows:.2} px, that of depth {:.0} mm, everywhere; the scene's own depths give {near:.2} to {far:.2} px",
            focal.depth_mm
        )
    });
    let absent = "there is no object between source and detector whose depth would say how wide it is drawn";
    choose("blur of the focal spot", shape.focal_spot_mm != [0.0; 2], focal, absent);
    let layer =
        "absorption 1 - exp(-mu t) at right angles; oblique rays absorb more, at most by the obliquity of their path".to_owned();
    choose("scintillator", panel.scintillator.is_some(), Some(layer), "");
    choose("antiscatter grid", panel.grid.is_some(), Some("transmission of primary photons, the same everywhere".to_owned()), "");
    let blurred =
        if scene.model.noise == Noise::Off { "of the signal" } else { "of signal and quantum noise, which it correlates" };
    choose("blur of the scintillator", panel.blur_fwhm_mm > 0.0, Some(blurred.to_owned()), "");
    let glare = panel.intensifier.as_ref().and_then(|intensifier| intensifier.glare);
    let glare = glare.map_or("no veiling glare, which was not measured".to_owned(), |glare| {
        format!("veiling glare of {:.1} % over {:.0} px, without noise of its own", 100.0 * glare.fraction, glare.scale_px)
    });
    let how = format!("bilinear in intensity, on top of the stated error; nothing outside the disc; {glare}");
    choose("image intensifier", panel.intensifier.is_some(), Some(how), "");
    let clip = |how: &str| (quantity == Quantity::Counts).then(|| how.to_owned());
    let counts_only = "acts on counts only";
    choose("saturation", panel.saturation.is_some(), clip("signals above it are cut"), counts_only);
    choose("digits", panel.bits.is_some(), clip("counts rounded to whole numbers and clipped"), counts_only);
    list
}
