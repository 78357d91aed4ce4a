//! Why there is no layout: what was expected, what was found.

use serde::{Deserialize, Serialize};

/// Why there is no layout.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, thiserror::Error)]
#[serde(rename_all = "snake_case")]
pub enum PhantomRefusal {
    /// Two shots fit almost anything.
    #[error("{found} shots, a layout needs at least {required}: take six or more, spread over the orbit")]
    TooFewShots {
        /// Given.
        found: usize,
        /// Needed.
        required: usize,
    },
    /// A shot shows next to nothing.
    #[error(
        "shot {shot} shows {found} round shadows, a shot needs at least {required}: open the collimator, raise the dose, or leave it out"
    )]
    TooFewShadows {
        /// Which.
        shot: String,
        /// Seen.
        found: usize,
        /// Needed.
        required: usize,
    },
    /// All from one side.
    #[error(
        "the shots are too alike: their beams differ by {angle_deg:.1} degrees at most, depth needs at least {required_deg:.0}; spread them over the orbit"
    )]
    TooAlike {
        /// Largest angle between two beams.
        angle_deg: f64,
        /// What would do.
        required_deg: f64,
    },
    /// Nothing fits.
    #[error(
        "the shots do not fit together: no {required} beads are seen alike in three shots where the cameras may be; are joints and shots paired rightly, do all show the same phantom, lying still, and is K that of these frames?"
    )]
    NoMatch {
        /// Beads needed.
        required: usize,
    },
    /// Left hand for right.
    #[error(
        "the shots fit together only when mirrored ({beads} beads in {shots} shots): the console mirrors the pictures, or the joints turn the other way than stated"
    )]
    MirroredPictures {
        /// Beads that would fit.
        beads: usize,
        /// Shots that would take part.
        shots: usize,
    },
    /// Accident explains it.
    #[error(
        "{beads} beads in {shots} shots to {rms_px:.2} px may be accident: shadows at random would fit so well {expected:.0e} times (limit {limit:.0e}); take more shots, or a phantom with more beads"
    )]
    Chance {
        /// Beads matched.
        beads: usize,
        /// Shots that take part.
        shots: usize,
        /// How well.
        rms_px: f64,
        /// Accidental matches expected.
        expected: f64,
        /// What is accepted.
        limit: f64,
    },
    /// Two ways to match.
    #[error(
        "the shots can be matched in two ways, with {matched} and with {rival} shadows: the phantom resembles itself; state the cameras closer, or take shots closer together"
    )]
    Ambiguous {
        /// Shadows of the best match.
        matched: usize,
        /// Shadows of its rival.
        rival: usize,
    },
    /// Depth may be the other way round.
    #[error(
        "the cloud mirrored in depth fits as well (squares {mirrored:.0} against {found:.0}), and is another: take shots from farther apart, or closer to the phantom"
    )]
    Mirrored {
        /// Σ of squares of the layout found.
        found: f64,
        /// Of its mirror image.
        mirrored: f64,
    },
    /// Too few beads are left.
    #[error("{found} beads are seen in three shots or more, a layout needs at least {required}")]
    TooFewBeads {
        /// Beads.
        found: usize,
        /// Needed.
        required: usize,
    },
    /// Shots contradict each other.
    #[error("{} of {shots} shots do not fit the others ({}): their joints are those of other moments, or the phantom was moved between the shots, or is another", named.len(), named.join(", "))]
    Contradictory {
        /// Names of the shots.
        named: Vec<String>,
        /// All shots.
        shots: usize,
    },
    /// Residuals are too large.
    #[error(
        "the shadows agree only to {times:.1} times what they state (limit {limit:.0}): did the phantom move or bend between the shots, is K right, or is the picture distorted?"
    )]
    Residual {
        /// Root of squares over degrees of freedom.
        times: f64,
        /// Most that is believed.
        limit: f64,
    },
    /// Cameras are not where they are stated.
    #[error(
        "the cameras are {times:.1} times as far from where they are stated as their standard deviations allow (limit {limit:.0}): are the joints those of the shots, and is the arm as well calibrated as stated?"
    )]
    Cameras {
        /// Root of squares over degrees of freedom.
        times: f64,
        /// Most that is believed.
        limit: f64,
    },
    /// Depth is not determined.
    #[error(
        "the shots do not fix the shape: beads are known to {sigma_mm:.2} mm besides the scale (limit {limit_mm:.1}); spread the shots, or take more"
    )]
    Shape {
        /// Root mean square standard deviation.
        sigma_mm: f64,
        /// Most that is written.
        limit_mm: f64,
    },
    /// Nothing tells the size.
    #[error("nothing fixes the scale: it is known to {:.1} % (limit {:.0} %), from {}; state the cameras closer, --bead-radius, or a distance between two beads (--distance A B MM)", 100.0 * sigma, 100.0 * limit, sources.join(", "))]
    Scale {
        /// Standard deviation as a share.
        sigma: f64,
        /// Most that is written.
        limit: f64,
        /// What was tried.
        sources: Vec<String>,
    },
    /// Evidence of the size contradicts.
    #[error("the {source_said} would have the layout {:+.2} % larger, {times:.1} standard deviations from what the cameras say (limit {limit:.0}): check it, the joints, SID and pitch", 100.0 * larger_by)]
    ScaleContradicted {
        /// Which evidence.
        source_said: String,
        /// By which share.
        larger_by: f64,
        /// In standard deviations.
        times: f64,
        /// Most that is believed.
        limit: f64,
    },
    /// A name that no bead has.
    #[error("--distance names {name}, the beads found are {}", known.join(", "))]
    NoSuchBead {
        /// As typed.
        name: String,
        /// Names there are.
        known: Vec<String>,
    },
    /// The least-squares problem has no solution.
    #[error("the beads cannot be solved: {detail}")]
    Unsolved {
        /// Why.
        detail: String,
    },
}
