//! The null: what each score would have been at poses that are known to be wrong.
//!
//! A score means something only if it is worse when the specimen is moved. Every score is computed again, at most 256 px wide, with the
//! specimen moved by ±1, 3 and 10 mm along the camera's axes and turned by ±1 and 3° about them, always about the beads' centroid; at
//! the poses that would be right if the layout were turned about, had its axes negated, or were mirrored; and with the picture mirrored. The
//! stated pose is rendered and scored in the same small way, so that nothing but the pose differs.
//!
//! What the specimen's symmetry hides is no wrong pose: where a hypothesis draws the picture of the stated pose once more, chance would decide
//! between the two. It is named, and not ranked.

use std::collections::BTreeMap;

use glam::{DQuat, DVec3};
use rayon::prelude::*;

use super::correlation::{for_each_scored, ranks, zncc};
use super::domain::CommonDomain;
use super::edges::{self, Maxima};
use super::filters::noise;
use super::ranking::{NullScore, Wrong, rank};
use super::scores::{NULL_SCORES, Scored, Scores, score};
use super::seen::{Ground, Seen};
use super::tone::{self, Tone, ToneFit};
use super::wrong_poses::{Hypotheses, Hypothesis, SHIFTS_MM, TURNS_DEG, hypotheses, is_of_another_layout};
use crate::geometry::{Rigid, View};
use crate::image::{Image, block_means, zip};

/// Renders the line integral at a given (small) view; pixels that cannot be known are NaN.
pub type Rerender<'r> = dyn FnMut(&View) -> Result<Image<f32>, String> + 'r;

/// Why there is no null.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum NullError {
    /// The pose of the simulated image was not given.
    #[error("null: the view of the simulated image is not known")]
    NoView,
    /// Nothing says about which point the specimen is moved.
    #[error("null: neither beads nor a centre of the specimen is known")]
    NoCentre,
    /// The centre to move about is not in front of the source.
    #[error("null: the centre to move about lies {depth_mm} mm in front of the source")]
    Behind {
        /// Depth, rounded.
        depth_mm: i64,
    },
    /// A render failed.
    #[error("null: rendering {shift} failed: {detail}")]
    Render {
        /// Which shift.
        shift: String,
        /// What the renderer said.
        detail: String,
    },
    /// The render has another size than asked.
    #[error("null: asked for {expected:?} px, rendered {found:?}")]
    Size {
        /// Columns and rows asked for.
        expected: [usize; 2],
        /// Columns and rows found.
        found: [usize; 2],
    },
    /// The scene at the stated pose is not what the simulated image shows.
    #[error(
        "null: the scene at the stated pose correlates with the simulated image by {correlation:.2}, expected at least {required:.2}: another \
         scene or pose than it was rendered from"
    )]
    AnotherPicture {
        /// Of the two, at null size.
        correlation: f64,
        /// [`OWN_PICTURE`].
        required: f64,
    },
    /// Somebody cancelled.
    #[error("null: cancelled after {done} of {total} renders")]
    Cancelled {
        /// Renders done.
        done: usize,
        /// Renders planned.
        total: usize,
    },
}

/// Widest render.
pub const NULL_WIDTH_PX: u32 = 256;
/// Pixels are binned up to this size at the depth of the centre: shifts of 1 mm still show.
const NULL_PIXEL_MM: f64 = 1.0;
/// For that, no image is made smaller than this.
const FEWEST_ROWS: u32 = 64;
/// Optima are looked for no further away than this: mm and degrees.
const FARTHEST: [f64; 2] = [12.0, 6.0];

/// The stated pose's render correlates with the simulated image at least this well, noise, blur and all.
const OWN_PICTURE: f64 = 0.7;
/// … if need be in the mean of so many pixels of the null, along each side.
const NOISE_BLOCK: usize = 8;
/// A shift or turn whose picture differs from the stated one by less than this share of its contrast is not seen in it …
const UNSEEN_STEP: f64 = 5e-4;
/// … and of two pictures of different layouts that differ by less than this, errors of the simulation pick one.
const UNSEEN_LAYOUT: f64 = 1e-2;

/// Renders that are scored side by side: whoever cancels waits for no more.
const SCORED_AT_ONCE: usize = 8;

/// Goes up whenever the same plan gives other scores.
const METHOD: u32 = 2;

fn first_method() -> u32 {
    1
}

/// How the null was made.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct NullPlan {
    /// Columns and rows of the renders.
    pub size_px: [u32; 2],
    /// How many pixels of the simulated image make one here, each way.
    pub binning: u32,
    /// About which point the specimen was moved.
    pub centre_lps_mm: [f64; 3],
    /// Renders made.
    pub renders: usize,
    /// 2: volumes have no more slices along the rays than its pixels need.
    #[serde(default = "first_method")]
    pub method: u32,
    /// The tone, fitted anew at each pose.
    pub tone: Tone,
    /// Poses of other layouts that are the stated one here: they were not asked about.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub same_pose: Vec<String>,
    /// Hypotheses under which the specimen looks as at the stated pose, because it is symmetric: nothing was ranked against them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub same_picture: Vec<String>,
}

/// What the null needs of the comparison.
pub(super) struct NullInput<'a> {
    pub acquired: &'a Image<f32>,
    /// With the tone.
    pub simulated: &'a Image<f32>,
    pub usable: &'a Image<bool>,
    pub domain: CommonDomain,
    pub air_reason: Option<&'a str>,
    pub tone: &'a ToneFit,
    pub view: &'a View,
    pub centre_lps_mm: DVec3,
}

/// Pixels that make one, each way: at most [`NULL_WIDTH_PX`] wide, and no finer than the smallest shift asks for.
fn binning(view: &View, depth_mm: f64) -> u32 {
    let (_, by_width) = view.at_most_wide(NULL_WIDTH_PX);
    let by_size = (NULL_PIXEL_MM * view.intrinsics.fx / depth_mm).clamp(1.0, 64.0) as u32;
    let smallest = view.size_px[0].min(view.size_px[1]);
    by_width.max(by_size.min(smallest / FEWEST_ROWS))
}

pub(super) fn null(
    input: &NullInput,
    rerender: &mut Rerender,
    cancelled: &dyn Fn() -> bool,
) -> Result<(BTreeMap<String, NullScore>, NullPlan), NullError> {
    let centre_in_camera = input.view.camera_from_lps.transform_point(input.centre_lps_mm);
    if !(centre_in_camera.z > 1.0) {
        return Err(NullError::Behind { depth_mm: centre_in_camera.z.round() as i64 });
    }
    let binning = binning(input.view, centre_in_camera.z);
    let small = input.view.binned(binning);
    let (acquired, usable) = block_means(input.acquired, input.usable, binning as usize);
    let frame_columns = f64::from(input.view.size_px[0]) / f64::from(binning);
    let Hypotheses { asked, same_pose } = hypotheses(&small, frame_columns, input.centre_lps_mm);
    let (known_wrong, total) = (asked.len(), asked.len() + 3);
    let mut renders_made = 0;
    let mut render = |asked: Hypothesis| -> Result<(String, Image<f32>), NullError> {
        let Hypothesis { name, view, mirrored } = asked;
        if cancelled() {
            return Err(NullError::Cancelled { done: renders_made, total });
        }
        let mut render = match rerender(&view) {
            Ok(render) => render,
            Err(detail) => return Err(NullError::Render { shift: name, detail }),
        };
        if !render.same_size(&acquired) {
            let (expected, found) = ([acquired.width, acquired.height], [render.width, render.height]);
            return Err(NullError::Size { expected, found });
        }
        if mirrored {
            render.pixels.chunks_exact_mut(render.width.max(1)).for_each(<[f32]>::reverse);
        }
        renders_made += 1;
        Ok((name, render))
    };
    let at_pose =
        |name: String, camera_from_lps: Rigid| Hypothesis { name, view: View { camera_from_lps, ..small }, mirrored: false };
    let stated_picture = render(at_pose("the stated pose".to_owned(), small.camera_from_lps))?;
    is_of_simulated(input, &stated_picture.1, binning as usize)?;
    let mut renders = vec![stated_picture];
    for hypothesis in asked {
        renders.push(render(hypothesis)?);
    }
    let unseen = |(name, picture): &(String, Image<f32>)| {
        let least = if is_of_another_layout(name) { UNSEEN_LAYOUT } else { UNSEEN_STEP };
        change(&renders[0].1, picture, &usable).is_some_and(|change| change < least)
    };
    let same_picture: Vec<String> = renders[1..].iter().filter(|picture| unseen(picture)).map(|(name, _)| name.clone()).collect();
    // Renders use all cores one after the other; what they are scored with does not, so that happens side by side.
    let tile_px = (32 / binning as usize).max(8);
    let done = renders.len();
    let scored = score_small(input, &acquired, &usable, renders, tile_px, cancelled);
    let mut shifted = scored.ok_or(NullError::Cancelled { done, total })?;
    let (_, stated) = shifted.remove(0);
    // A pose that is wrong in several directions is only half mended by any one of them: the optimum of each, taken together.
    let best =
        optima(&stated, &shifted, centre_in_camera).map(|(name, motion)| render(at_pose(name, motion * small.camera_from_lps)));
    let best = best.into_iter().collect::<Result<Vec<_>, NullError>>()?;
    let of_best = score_small(input, &acquired, &usable, best, tile_px, cancelled);
    shifted.extend(of_best.ok_or(NullError::Cancelled { done: total, total })?);
    let wrong = Wrong { shifted: &shifted, known_wrong, same_picture: &same_picture };
    let scores = NULL_SCORES
        .iter()
        .filter(|(name, _)| stated.get(name).is_some())
        .map(|(name, larger_is_better)| ((*name).to_owned(), rank(name, *larger_is_better, &stated, &wrong)))
        .collect();
    let plan = NullPlan {
        size_px: small.size_px,
        binning,
        centre_lps_mm: input.centre_lps_mm.to_array(),
        renders: 1 + shifted.len(),
        method: METHOD,
        tone: input.tone.tone,
        same_pose,
        same_picture,
    };
    Ok((scores, plan))
}

/// Refuses a null about another picture than the simulated image.
fn is_of_simulated(input: &NullInput, stated: &Image<f32>, binning: usize) -> Result<(), NullError> {
    let (simulated, known) = block_means(input.simulated, input.usable, binning);
    let known = zip(&known, stated, |known, l| *known && l.is_finite());
    let toned = input.tone.apply_to(stated);
    let close = |correlation: f64| correlation >= OWN_PICTURE;
    match zncc(&simulated, &toned, &known) {
        Some(correlation) if !close(correlation) => {
            // Noise of the simulated image, which null renders have less of or none, goes in the mean; another picture stays another.
            let (simulated, _) = block_means(&simulated, &known, NOISE_BLOCK);
            let (toned, known) = block_means(&toned, &known, NOISE_BLOCK);
            match zncc(&simulated, &toned, &known) {
                Some(coarse) if close(coarse) => Ok(()),
                _ => Err(NullError::AnotherPicture { correlation, required: OWN_PICTURE }),
            }
        }
        _ => Ok(()),
    }
}

/// Root mean square of what differs between two renders, as a share of the contrast of the first; `None` where they have nothing in common.
fn change(stated: &Image<f32>, other: &Image<f32>, usable: &Image<bool>) -> Option<f64> {
    let known = zip(&zip(stated, other, |a, b| a.is_finite() && b.is_finite()), usable, |known, usable| *known && *usable);
    let (mut n, mut sum, mut squares, mut apart) = (0.0, 0.0, 0.0, 0.0);
    for_each_scored(stated, other, &known, |a, b| {
        n += 1.0;
        sum += a;
        squares += a * a;
        apart += (a - b) * (a - b);
    });
    let variance = squares / n - (sum / n) * (sum / n);
    (variance > 0.0).then(|| (apart / n / variance).sqrt())
}

/// How much is missing to a perfect agreement, relative to the stated pose, over the scores that both have; 1 at the stated pose.
fn missing(stated: &Scores, scores: &Scores) -> Option<f64> {
    let relative = |(name, larger): &(&str, bool)| {
        let (here, there) = (stated.get(name)?, scores.get(name)?);
        let (here, there) = if *larger { (1.0 - here, 1.0 - there) } else { (here, there) };
        (here > 0.0).then(|| there / here)
    };
    let found: Vec<f64> = NULL_SCORES.iter().filter_map(relative).collect();
    (!found.is_empty()).then(|| found.iter().sum::<f64>() / found.len() as f64)
}

/// Where the shifts, and where the turns, point to: the minimum of a parabola through what is missing at 0, ±1 and ±3 along each axis.
fn optima(stated: &Scores, shifted: &[(String, Scores)], centre_in_camera: DVec3) -> [(String, Rigid); 2] {
    let steps = [0.0, 1.0, -1.0, 3.0, -3.0];
    let along = |first: usize, farthest: f64| {
        let values = (first..first + 4).map(|index| missing(stated, &shifted.get(index)?.1));
        let values: Option<Vec<f64>> = std::iter::once(Some(1.0)).chain(values).collect();
        values.map_or(0.0, |values| lowest(&steps, &values).clamp(-farthest, farthest))
    };
    let per_axis = 2 * SHIFTS_MM.len();
    let shift_mm = DVec3::from_array([0, 1, 2].map(|axis| along(axis * per_axis, FARTHEST[0])));
    let first_turn = 3 * per_axis;
    let turn_deg = DVec3::from_array([0, 1, 2].map(|axis| along(first_turn + axis * 2 * TURNS_DEG.len(), FARTHEST[1])));
    let turn = Rigid::rotation(DQuat::from_scaled_axis(turn_deg.map(f64::to_radians)));
    let about = Rigid::translation(centre_in_camera) * turn * Rigid::translation(-centre_in_camera);
    let words = |v: DVec3| format!("{:+.1}, {:+.1}, {:+.1}", v.x, v.y, v.z);
    [
        (format!("best shift ({}) mm", words(shift_mm)), Rigid::translation(shift_mm)),
        (format!("best turn ({}) deg", words(turn_deg)), about),
    ]
}

/// Abscissa of the minimum of the least-squares parabola; of the lowest value where the parabola has none.
fn lowest(x: &[f64; 5], y: &[f64]) -> f64 {
    let rows = nalgebra::Matrix5x3::from_fn(|row, column| x[row].powi(column as i32));
    let values = nalgebra::Vector5::from_fn(|row, _| y[row]);
    let normal = rows.transpose() * rows;
    let fitted = normal.try_inverse().map(|inverse| inverse * rows.transpose() * values);
    match fitted {
        Some(c) if c[2] > 0.0 && c[1].is_finite() => -0.5 * c[1] / c[2],
        _ => x.iter().zip(y).min_by(|a, b| a.1.total_cmp(b.1)).map_or(0.0, |(x, _)| *x),
    }
}

/// The acquired image as the scores see it, where the render of a pose is known: the same for most poses.
struct Standing<'a> {
    ground: Ground,
    scored: Image<bool>,
    acquired: Seen<'a>,
    maxima: Maxima,
    ranks: Image<f32>,
    noise: Option<f64>,
}

/// `None` when `cancelled`, which is asked before each few renders, says so.
fn score_small(
    input: &NullInput,
    acquired: &Image<f32>,
    usable: &Image<bool>,
    renders: Vec<(String, Image<f32>)>,
    tile_px: usize,
    cancelled: &dyn Fn() -> bool,
) -> Option<Vec<(String, Scores)>> {
    let mut known: Vec<Image<bool>> = Vec::new();
    let place = |(name, render): (String, Image<f32>)| {
        let usable = zip(usable, &render, |u, l| *u && l.is_finite());
        let at = known.iter().position(|other| *other == usable).unwrap_or_else(|| {
            known.push(usable);
            known.len() - 1
        });
        (name, render, at)
    };
    let renders: Vec<_> = renders.into_iter().map(place).collect();
    let standing = |usable: Image<bool>| {
        let scored = tone::scored_pixels(&usable, input.tone.tone, tile_px);
        let ground = Ground::of(usable);
        let seen = Seen::on(&ground, acquired);
        // Renders are scored side by side with it.
        seen.power(&ground);
        let (maxima, ranks) = (edges::maxima(&seen, &ground.usable), ranks(acquired, &scored));
        let noise = (input.domain == CommonDomain::LineIntegral).then(|| noise(acquired, &scored)).flatten();
        Standing { ground, scored, acquired: seen, maxima, ranks, noise }
    };
    let standings: Vec<Standing> = known.into_par_iter().map(standing).collect();
    let scores = |(name, render, at): (String, Image<f32>, usize)| (name, score_one(input, &standings[at], &render, tile_px));
    let (mut scored, mut left) = (Vec::with_capacity(renders.len()), renders.into_iter());
    loop {
        let some: Vec<_> = left.by_ref().take(SCORED_AT_ONCE).collect();
        if some.is_empty() {
            return Some(scored);
        }
        if cancelled() {
            return None;
        }
        scored.par_extend(some.into_par_iter().map(&scores));
    }
}

fn score_one(input: &NullInput, standing: &Standing, render: &Image<f32>, tile_px: usize) -> Scores {
    let Standing { ground, scored, acquired, maxima, ranks, noise } = standing;
    let Some(fit) = tone::fit(input.tone.tone, acquired.image, render, &ground.usable, tile_px) else {
        return Scores::absent("the tone is not determined");
    };
    let toned = fit.apply_to(render);
    let simulated = &Seen::on(ground, &toned);
    let (edges_a, edges_s) = edges::of_both(maxima, &edges::maxima(simulated, &ground.usable));
    score(
        &Scored {
            acquired,
            acquired_ranks: ranks,
            acquired_noise: *noise,
            simulated,
            ground,
            scored,
            domain: input.domain,
            tone: input.tone.tone,
            air_reason: input.air_reason,
            mm_per_px: None,
        },
        (&edges_a, &edges_s),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_parabola_s_minimum_is_found_and_a_slope_goes_downhill() {
        let x = [0.0, 1.0, -1.0, 3.0, -3.0];
        let parabola: Vec<f64> = x.iter().map(|x: &f64| 0.2 + 0.05 * (x - 1.7).powi(2)).collect();
        assert!((lowest(&x, &parabola) - 1.7).abs() < 1e-9);
        let dome: Vec<f64> = x.iter().map(|x: &f64| 1.0 - 0.05 * (x + 0.3).powi(2)).collect();
        assert_eq!(lowest(&x, &dome), 3.0);
    }
}
