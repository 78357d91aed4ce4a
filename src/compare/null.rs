//! The null: what each score would have been at poses that are known to be wrong.
//!
//! A score means something only if it is worse when the specimen is moved. Every score is computed again, at most 256 px wide, with the
//! specimen moved by ±1, 3 and 10 mm along the camera's axes and turned by ±1 and 3° about them, always about the beads' centroid. The
//! stated pose is rendered and scored in the same small way, so that nothing but the pose differs.

use std::collections::BTreeMap;

use glam::{DQuat, DVec3};

use super::domain::CommonDomain;
use super::edges;
use super::filters::{block_means, zip};
use super::scores::{NULL_SCORES, Scored, Scores, score};
use super::tone::{self, Tone};
use crate::geometry::{Rigid, View};
use crate::image::Image;

/// Renders the line integral at a given (small) view; pixels that cannot be known are NaN.
pub type Rerender<'r> = dyn FnMut(&View) -> Result<Image<f32>, String> + 'r;

/// Why there is no null.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
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
const SHIFTS_MM: [f64; 3] = [1.0, 3.0, 10.0];
const TURNS_DEG: [f64; 2] = [1.0, 3.0];
/// Renders of a null: 18 shifts, 12 turns and the stated pose.
pub const NULL_RENDERS: usize = 31;

/// A score at one wrong pose.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ShiftedScore {
    /// `u +1 mm`, `turn about v −3 deg` and the like; camera axes.
    pub shift: String,
    /// `None` where the score does not exist there.
    pub value: Option<f64>,
}

/// One score against its null.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct NullScore {
    /// At the stated pose, at null size.
    pub at_pose: Option<f64>,
    /// The best at any wrong pose.
    pub best_shifted: Option<f64>,
    /// Where that is.
    pub best_shift: Option<String>,
    /// 1 when the stated pose is better than every wrong one.
    pub rank: usize,
    /// Poses compared, the stated one included.
    pub of: usize,
    /// Whether the best is at the stated pose. Where false, the score does not tell a right pose from a wrong one.
    pub discriminating: bool,
    /// All wrong poses.
    pub shifts: Vec<ShiftedScore>,
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
    /// The tone, fitted anew at each pose.
    pub tone: Tone,
}

/// What the null needs of the comparison.
pub(super) struct NullInput<'a> {
    pub acquired: &'a Image<f32>,
    pub usable: &'a Image<bool>,
    pub domain: CommonDomain,
    pub air_reason: Option<&'a str>,
    pub tone: Tone,
    pub view: &'a View,
    pub centre_lps_mm: DVec3,
}

/// Wrong poses: name and the motion of the specimen in `camera`, given the centre there.
fn motions(centre_in_camera: DVec3) -> Vec<(String, Rigid)> {
    let axes = [("u", DVec3::X), ("v", DVec3::Y), ("depth", DVec3::Z)];
    let mut found = Vec::with_capacity(NULL_RENDERS - 1);
    for (name, axis) in axes {
        for size in SHIFTS_MM.iter().flat_map(|size| [*size, -size]) {
            found.push((format!("{name} {size:+} mm"), Rigid::translation(axis * size)));
        }
    }
    for (name, axis) in axes {
        for degrees in TURNS_DEG.iter().flat_map(|size| [*size, -size]) {
            let turn = Rigid::rotation(DQuat::from_axis_angle(axis, degrees.to_radians()));
            let about = Rigid::translation(centre_in_camera) * turn * Rigid::translation(-centre_in_camera);
            found.push((format!("turn about {name} {degrees:+} deg"), about));
        }
    }
    found
}

pub(super) fn null(
    input: &NullInput,
    rerender: &mut Rerender,
    cancelled: &dyn Fn() -> bool,
) -> Result<(BTreeMap<String, NullScore>, NullPlan), NullError> {
    let (small, binning) = input.view.at_most_wide(NULL_WIDTH_PX);
    let centre_in_camera = small.camera_from_lps.transform_point(input.centre_lps_mm);
    if !(centre_in_camera.z > 1.0) {
        return Err(NullError::Behind { depth_mm: centre_in_camera.z.round() as i64 });
    }
    let (acquired, usable) = block_means(input.acquired, input.usable, binning as usize);
    let mut at = |shift: &str, view: &View| -> Result<Scores, NullError> {
        let render = rerender(view).map_err(|detail| NullError::Render { shift: shift.to_owned(), detail })?;
        if !render.same_size(&acquired) {
            let (expected, found) = ([acquired.width, acquired.height], [render.width, render.height]);
            return Err(NullError::Size { expected, found });
        }
        Ok(score_small(input, &acquired, &usable, &render, (32 / binning as usize).max(8)))
    };
    let stated = at("the stated pose", &small)?;
    let motions = motions(centre_in_camera);
    let mut shifted: Vec<(String, Scores)> = Vec::with_capacity(motions.len());
    for (name, motion) in motions {
        if cancelled() {
            return Err(NullError::Cancelled { done: 1 + shifted.len(), total: NULL_RENDERS });
        }
        let moved = View { camera_from_lps: motion * small.camera_from_lps, ..small };
        let scores = at(&name, &moved)?;
        shifted.push((name, scores));
    }
    let plan = NullPlan {
        size_px: small.size_px,
        binning,
        centre_lps_mm: input.centre_lps_mm.to_array(),
        renders: 1 + shifted.len(),
        tone: input.tone,
    };
    let scores = NULL_SCORES
        .iter()
        .filter(|(name, _)| stated.get(name).is_some())
        .map(|(name, larger_is_better)| ((*name).to_owned(), rank(name, *larger_is_better, &stated, &shifted)))
        .collect();
    Ok((scores, plan))
}

fn score_small(input: &NullInput, acquired: &Image<f32>, usable: &Image<bool>, render: &Image<f32>, tile_px: usize) -> Scores {
    let usable = zip(usable, render, |u, l| *u && l.is_finite());
    let Some(fit) = tone::fit(input.tone, acquired, render, &usable, tile_px) else {
        return Scores::absent("the tone is not determined");
    };
    let toned = fit.apply_to(render);
    let scored = super::scored_pixels(&usable, input.tone, tile_px);
    let (edges_a, edges_s) = edges::find_both(acquired, &toned, &usable);
    score(
        &Scored {
            acquired,
            simulated: &toned,
            usable: &usable,
            scored: &scored,
            domain: input.domain,
            tone: input.tone,
            air_reason: input.air_reason,
            mm_per_px: None,
        },
        (&edges_a, &edges_s),
    )
}

fn rank(name: &str, larger_is_better: bool, stated: &Scores, shifted: &[(String, Scores)]) -> NullScore {
    let at_pose = stated.get(name);
    let better = |a: f64, b: f64| if larger_is_better { a > b } else { a < b };
    let shifts: Vec<ShiftedScore> =
        shifted.iter().map(|(shift, scores)| ShiftedScore { shift: shift.clone(), value: scores.get(name) }).collect();
    let mut best: Option<(&str, f64)> = None;
    let mut rank = 1;
    for (shift, value) in shifts.iter().filter_map(|s| Some((s.shift.as_str(), s.value?))) {
        if best.is_none_or(|(_, top)| better(value, top)) {
            best = Some((shift, value));
        }
        // A tie does not count for the stated pose.
        if !at_pose.is_some_and(|at_pose| better(at_pose, value)) {
            rank += 1;
        }
    }
    NullScore {
        at_pose,
        best_shifted: best.map(|(_, value)| value),
        best_shift: best.map(|(shift, _)| shift.to_owned()),
        rank,
        of: 1 + shifts.iter().filter(|s| s.value.is_some()).count(),
        discriminating: rank == 1 && best.is_some(),
        shifts,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_are_thirty_wrong_poses_and_turns_keep_the_centre() {
        let centre = DVec3::new(10.0, -20.0, 600.0);
        let motions = motions(centre);
        assert_eq!(motions.len() + 1, NULL_RENDERS);
        let turns: Vec<_> = motions.iter().filter(|(name, _)| name.starts_with("turn")).collect();
        assert_eq!(turns.len(), 12);
        assert!(turns.iter().all(|(_, motion)| motion.transform_point(centre).distance(centre) < 1e-9));
        assert!(motions.iter().any(|(name, _)| name == "depth -10 mm"));
    }
}
