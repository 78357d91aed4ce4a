//! How well an acquired frame and its simulation agree, honestly (DESIGN §9).
//!
//! Both images are brought into a common domain ([`CommonDomain`]), the declared [`Tone`] is fitted on alternate tiles and scored on the
//! others, one union of masks holds for all scores, and every score can be put against its null: the same score at poses known to be
//! wrong. What cannot be claimed is `None` and says why.

mod comparison;
mod convolution;
mod correlation;
mod disagreement;
mod displacement;
mod domain;
mod edges;
mod elsewhere;
mod filters;
mod input;
mod matched;
mod null;
mod pedestal;
mod ranking;
mod scores;
mod seen;
mod tone;
mod wrong_poses;

use std::collections::BTreeMap;
use std::sync::Arc;

use glam::DVec3;
use rayon::prelude::*;

pub use comparison::{Comparison, Pictures};
pub use disagreement::Disagreement;
pub use displacement::farthest_apart_px;
pub use domain::{AirContradiction, AirLevel, AirReport, CommonDomain};
pub use elsewhere::{Elsewhere, elsewhere};
pub use input::{CompareError, CompareInput};
pub use matched::{NullRenders, NullScatter, bead_marks, posed_scene, tool_mask};
pub use null::{NULL_WIDTH_PX, NullError, NullPlan, Rerender};
pub(crate) use pedestal::with_deviation;
pub use pedestal::{OffsetReport, OffsetRule};
pub use ranking::{NullScore, ShiftedScore};
pub use scores::{FEWEST_PIXELS, NULL_SCORES, SSIM_CONSTANTS, Scores};
pub use seen::{LOCAL_BAND_PX, LOCAL_WINDOW_PX, SCORE_SIGMA_PX};
pub use tone::{Tone, ToneFit};
pub use wrong_poses::NULL_RENDERS;

use crate::acquire::{Domain, Frame};
use crate::geometry::View;
use crate::image::{Image, block_means, quantile, zip};
use crate::mask::{self, Cause, Masks, REQUIRED_SHARE};
use correlation::{rank_ncc, ranks};
use filters::noise;
use scores::{Scored, score};
use seen::{Ground, REACH_PX, Seen};

/// A comparison, its pictures, and what a later null needs.
#[derive(Clone, Debug)]
pub struct Compared {
    /// The numbers.
    pub comparison: Comparison,
    /// The images.
    pub pictures: Arc<Pictures>,
    view: Option<View>,
    centre_lps_mm: Option<DVec3>,
}

/// Side of the tiles that are fitted and scored in turn.
const TILE_PX: usize = 32;

/// Compares.
///
/// # Errors
/// When the sizes do not fit, the tone is not permitted or not determined, the frame contradicts the declared air level, or less than a quarter of the image is left.
pub fn compare(input: &CompareInput) -> Result<Compared, CompareError> {
    let frame = input.acquired;
    permit(input.tone, frame.domain)?;
    let simulated = input.simulated_line_integral;
    let (width, height) = (simulated.width, simulated.height);
    let binning = binning(frame, simulated)?;
    let mut masks = gather_masks(input, binning)?;
    let before_air = masks.usable(width, height, &[]);
    let binned;
    let pixels = if binning == 1 {
        &frame.pixels
    } else {
        binned = block_means(&frame.pixels, &frame.pixels.map(|v| v.is_finite()), binning).0;
        &binned
    };
    let evidence = domain::Evidence {
        usable: &before_air,
        shuttered: masks.layer(Cause::Collimation),
        clean: &masks.usable(width, height, &[Cause::Collimation]),
        air: input.air,
        offset: input.offset,
    };
    let mut common = domain::into_common(frame, pixels, simulated, &evidence)?;
    masks.add(Cause::NoSignal, common.no_signal);
    let usable = masks.usable(width, height, &[]);
    let shares = masks.shares(width, height);
    if !(shares.left >= REQUIRED_SHARE) {
        let causes: Vec<String> =
            shares.causes.iter().map(|(cause, share)| format!("{} {:.1} %", cause.words(), 100.0 * share)).collect();
        return Err(CompareError::TooLittleLeft {
            left: 100.0 * shares.left,
            required: 100.0 * REQUIRED_SHARE,
            causes: causes.join(", "),
        });
    }
    let mut flags = Vec::new();
    settle_polarity(frame.domain, &mut common.acquired, simulated, &usable, &mut flags);
    if common.air.rule == "maximum" {
        flags.push("air level: the paper's rule (highest value is N0) was asked for; without open air in the frame it errs a hundredfold".into());
    }
    if let Some(offset) = common.air.offset.as_ref().filter(|offset| offset.rule == "shutters") {
        flags.push(format!(
            "pedestal of {} subtracted ({})",
            with_deviation(offset.value, offset.sigma.unwrap_or(0.0)),
            offset.reason.as_deref().unwrap_or("from the shutters")
        ));
    }
    if let (CommonDomain::RelativeLineIntegral, Some(reason)) = (common.domain, &common.air.reason) {
        flags.push(format!("air level unknown: {reason}"));
    }
    let fit = tone::fit(input.tone, &common.acquired, simulated, &usable, TILE_PX)
        .ok_or(CompareError::ToneUndetermined { tone: input.tone })?;
    if let Some(note) = &fit.note {
        flags.push(format!("tone {}: {note}", input.tone.as_str()));
    }
    let toned = fit.apply_to(simulated);
    let scored = tone::scored_pixels(&usable, input.tone, TILE_PX);
    let mm_per_px = input.view.zip(input.centre_lps_mm).and_then(|(view, centre)| {
        let depth_mm = view.camera_from_lps.transform_point(centre).z;
        (depth_mm > 0.0).then(|| depth_mm / view.intrinsics.fx)
    });
    let ground = Ground::of(usable.clone());
    let (acquired_seen, toned_seen) = rayon::join(|| Seen::on(&ground, &common.acquired), || Seen::on(&ground, &toned));
    let (found_acquired, found_simulated) =
        rayon::join(|| edges::maxima(&acquired_seen, &usable), || edges::maxima(&toned_seen, &usable));
    let (edges, acquired_ranks) =
        rayon::join(|| edges::of_both(&found_acquired, &found_simulated), || ranks(&common.acquired, &scored));
    let noise_where = |image: &Image<f32>, scored: &Image<bool>| {
        (common.domain == CommonDomain::LineIntegral).then(|| noise(image, scored)).flatten()
    };
    let base = Scored {
        acquired: &acquired_seen,
        acquired_ranks: &acquired_ranks,
        // Without a tone all that is usable is scored, and its noise is known.
        acquired_noise: if input.tone == Tone::None { found_acquired.sigma } else { noise_where(&common.acquired, &scored) },
        simulated: &toned_seen,
        ground: &ground,
        scored: &scored,
        domain: common.domain,
        tone: input.tone,
        air_reason: common.air.reason.as_deref(),
        mm_per_px,
    };
    let alone = || {
        // One after the other: both ask the acquired image for the same windows.
        let scored = || {
            let scores = score(&base, (&edges.0, &edges.1));
            let without_tone = match input.tone {
                Tone::None => scores.clone(),
                _ => score(&Scored { simulated: &Seen::on(&ground, simulated), tone: Tone::None, ..base }, (&edges.0, &edges.1)),
            };
            (scores, without_tone)
        };
        let ((scores, without_tone), drawn) = rayon::join(scored, || found_simulated.to_draw());
        (scores, without_tone, drawn)
    };
    let of_tool = |tool: &Image<bool>| {
        let with_tool = masks.usable(width, height, &[Cause::Tool]);
        let on_tool = zip(&with_tool, tool, |usable, tool| *usable && *tool);
        // Nothing further away than windows reach tells of the tool.
        let near = around(tool, REACH_PX);
        let [acquired, toned] = [&common.acquired, &toned].map(|image| image.part(&near));
        let [with_tool, on_tool] = [&with_tool, &on_tool].map(|image| image.part(&near));
        let (acquired_ranks, acquired_noise) = (&ranks(&acquired, &on_tool), noise_where(&acquired, &on_tool));
        let ground = Ground::of(with_tool);
        let (acquired, simulated) = (&Seen::on(&ground, &acquired), &Seen::on(&ground, &toned));
        let edges = edges::of_both(&edges::maxima(acquired, &ground.usable), &edges::maxima(simulated, &ground.usable));
        let of_acquired = Scored { acquired, acquired_ranks, acquired_noise, ..base };
        let scored = Scored { simulated, ground: &ground, scored: &on_tool, ..of_acquired };
        score(&scored, (&edges.0, &edges.1))
    };
    let ((scores, scores_without_tone, edges), scores_tool) = rayon::join(alone, || masks.layer(Cause::Tool).map(of_tool));
    let noise_expected_nepers = expected_noise(frame, &common.acquired, common.air.level, &usable, binning);
    if let (Some(seen), Some(expected)) = (scores.noise_nepers, noise_expected_nepers)
        && !(seen <= NOISE_AGREES * expected && expected <= NOISE_AGREES * seen)
    {
        flags.push(format!(
            "noise is {seen:.4} nepers, the detector calibration expects {expected:.4}: processed by the console, or another gain mode?"
        ));
    }
    let mut disagreements = disagreement::disagreements(&scores_without_tone);
    if let (AirLevel::Value(declared), CommonDomain::LineIntegral) = (input.air, common.domain) {
        // What is at the end of the scale is at least as bright.
        let seen = masks.usable(width, height, &[Cause::Saturation]);
        disagreements.extend(disagreement::above_air(declared, &common.acquired, &seen));
    }
    flags.extend(disagreements.iter().map(ToString::to_string));
    let unit = match common.domain {
        CommonDomain::LineIntegral => "nepers",
        CommonDomain::RelativeLineIntegral => "nepers (offset unknown)",
        CommonDomain::GrayValues => "gray value, larger is more attenuation",
    };
    let comparison = Comparison {
        size_px: [width, height],
        binning,
        domain: frame.domain,
        common_domain: common.domain,
        air: common.air,
        noise_expected_nepers,
        tone: fit,
        scores,
        scores_without_tone,
        scores_tool,
        disagreements,
        null: BTreeMap::new(),
        null_plan: None,
        masks: shares,
        mm_per_px,
        flags,
    };
    let shut_off = masks.shut_off(width, height);
    let pictures = Pictures { acquired: common.acquired, simulated: toned, usable, shut_off, edges, unit };
    Ok(Compared { comparison, pictures: Arc::new(pictures), view: input.view.copied(), centre_lps_mm: input.centre_lps_mm })
}

impl Compared {
    /// Puts every score against its null: at most [`NULL_RENDERS`] renders, each at most [`NULL_WIDTH_PX`] wide. May run after the pair was shown.
    /// `cancelled` is asked before each render, and before each few of them are scored.
    ///
    /// # Errors
    /// When no view or centre was given, a render fails, has the wrong size or is of another picture, or it is cancelled; the comparison is
    /// unchanged then.
    pub fn add_null(&mut self, rerender: &mut Rerender, cancelled: &dyn Fn() -> bool) -> Result<(), NullError> {
        let view = self.view.as_ref().ok_or(NullError::NoView)?;
        let input = null::NullInput {
            acquired: &self.pictures.acquired,
            simulated: &self.pictures.simulated,
            usable: &self.pictures.usable,
            domain: self.comparison.common_domain,
            air_reason: self.comparison.air.reason.as_deref(),
            tone: &self.comparison.tone,
            view,
            centre_lps_mm: self.centre_lps_mm.ok_or(NullError::NoCentre)?,
        };
        let (scores, plan) = null::null(&input, rerender, cancelled)?;
        let blind: Vec<&str> = scores.iter().filter(|(_, null)| !null.discriminating).map(|(name, _)| name.as_str()).collect();
        if !blind.is_empty() {
            self.comparison
                .flags
                .push(format!("{}: not discriminating (a wrong pose scores at least as well)", blind.join(", ")));
        }
        let full = &self.comparison.scores;
        let unknown: Vec<&str> = NULL_SCORES
            .iter()
            .map(|(name, _)| *name)
            .filter(|name| full.get(name).is_some() && !scores.contains_key(*name))
            .collect();
        if !unknown.is_empty() {
            self.comparison
                .flags
                .push(format!("no null (the small render at the stated pose has no such score): {}", unknown.join(", ")));
        }
        if !plan.same_picture.is_empty() {
            self.comparison
                .flags
                .push(format!("the picture does not tell the stated pose from: {} (not ranked)", plan.same_picture.join(", ")));
        }
        self.comparison.null = scores;
        self.comparison.null_plan = Some(plan);
        Ok(())
    }
}

/// Noise beyond this factor of what the calibration expects is said; light shared by neighbours alone makes it smaller by half.
const NOISE_AGREES: f64 = 2.0;

/// Median over the usable pixels of √(gain · signal + σ²) / signal, less by the pixels that were averaged.
fn expected_noise(
    frame: &Frame,
    line_integral: &Image<f32>,
    air_level: Option<f64>,
    usable: &Image<bool>,
    binning: usize,
) -> Option<f64> {
    let correction = frame.correction.as_ref()?;
    let (gain, level) = (correction.gain_value_per_quantum?, air_level?);
    let readout = correction.readout_sigma_value.unwrap_or(0.0);
    let mut noise: Vec<f32> = line_integral
        .pixels
        .par_iter()
        .zip(&usable.pixels)
        .filter(|(line_integral, usable)| **usable && line_integral.is_finite())
        .map(|(line_integral, _)| {
            let signal = level * f64::from(-line_integral).exp();
            ((gain * signal + readout * readout).sqrt() / signal / binning as f64) as f32
        })
        .collect();
    quantile(&mut noise, 0.5).filter(|value| value.is_finite())
}

fn permit(tone: Tone, domain: Domain) -> Result<(), CompareError> {
    if tone.is_permitted(domain) {
        return Ok(());
    }
    let permitted = if domain.is_gray() { "none or monotone" } else { "none, gain or log_affine" };
    Err(CompareError::ToneNotPermitted { tone, domain, permitted })
}

/// How many pixels of the frame make one of the simulated image, each way (whole blocks, as [`View::at_most_wide`] has it).
fn binning(frame: &Frame, simulated: &Image<f32>) -> Result<usize, CompareError> {
    let (acquired, wanted) = ([frame.pixels.width, frame.pixels.height], [simulated.width, simulated.height]);
    let factor = acquired[0].checked_div(wanted[0]).unwrap_or(0);
    if factor >= 1 && wanted[1] >= 1 && acquired[0] / factor == wanted[0] && acquired[1] / factor == wanted[1] {
        Ok(factor)
    } else {
        Err(CompareError::Size { name: frame.name.clone(), acquired, simulated: wanted })
    }
}

fn gather_masks(input: &CompareInput, binning: usize) -> Result<Masks, CompareError> {
    let simulated = input.simulated_line_integral;
    let (width, height) = (simulated.width, simulated.height);
    let mut masks = match input.masks {
        Some(masks) => masks.binned(binning),
        None => mask::of_frame(input.acquired).binned(binning),
    };
    // What is clipped at the dark end of a logarithm is anything but that value. Beads are found there all the same.
    if let Some(black) = input.acquired.clipping.black_at.filter(|_| input.acquired.domain == Domain::Log) {
        masks.add(Cause::NoSignal, mask::any_in_block(&input.acquired.pixels.map(|value| *value == black), binning));
    }
    let checked = |what: &'static str, found: [usize; 2]| {
        if found == [width, height] { Ok(()) } else { Err(CompareError::MaskSize { what, found, expected: [width, height] }) }
    };
    let mut invalid = simulated.map(|l| !l.is_finite());
    if let Some(valid) = input.valid {
        checked("validity", [valid.width, valid.height])?;
        invalid.pixels.iter_mut().zip(&valid.pixels).for_each(|(invalid, valid)| *invalid |= *valid == 0);
    }
    masks.add(Cause::Invalid, invalid);
    if let Some(guessed) = input.guessed {
        checked("guessed", [guessed.width, guessed.height])?;
        masks.add(Cause::Filled, guessed.map(|guessed| *guessed != 0));
    }
    if let Some(tool) = input.tool {
        checked("tool", [tool.width, tool.height])?;
        masks.add(Cause::Tool, tool.clone());
    }
    if let Some(extra) = input.extra_mask {
        let full = [input.acquired.pixels.width, input.acquired.pixels.height];
        let extra = if [extra.width, extra.height] == full { mask::any_in_block(extra, binning) } else { extra.clone() };
        checked("extra", [extra.width, extra.height])?;
        masks.add(Cause::Extra, extra);
    }
    if !input.beads.is_empty() {
        masks.add(Cause::Beads, mask::discs(width, height, input.beads));
    }
    Ok(masks)
}

/// Columns and rows that hold all of `marked`, and as many pixels around it as there are up to `margin`.
fn around(marked: &Image<bool>, margin: usize) -> [std::ops::Range<usize>; 2] {
    let (mut from, mut to) = ([marked.width, marked.height], [0; 2]);
    for at in (0..marked.pixels.len()).filter(|at| marked.pixels[*at]) {
        let place = [at % marked.width, at / marked.width];
        from = [0, 1].map(|axis| from[axis].min(place[axis]));
        to = [0, 1].map(|axis| to[axis].max(place[axis] + 1));
    }
    let size = [marked.width, marked.height];
    [0, 1].map(|axis| from[axis].saturating_sub(margin).min(to[axis])..(to[axis] + margin).min(size[axis]))
}

/// Values of frames of unknown domain may run either way; it is found by rank correlation, and said.
fn settle_polarity(
    domain: Domain,
    acquired: &mut Image<f32>,
    simulated: &Image<f32>,
    usable: &Image<bool>,
    flags: &mut Vec<String>,
) {
    if domain != Domain::Unknown {
        return;
    }
    let correlation = rank_ncc(&ranks(acquired, usable), &ranks(simulated, usable)).unwrap_or(0.0);
    if correlation < 0.0 {
        acquired.pixels.iter_mut().for_each(|v| *v = -*v);
        flags.push(format!("domain unknown: larger values are taken as more attenuation (rank correlation {:.2})", -correlation));
    } else {
        flags.push(format!("domain unknown: larger values are taken as more signal (rank correlation {correlation:.2})"));
    }
}
