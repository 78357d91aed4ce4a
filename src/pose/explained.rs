//! What a registration looked at besides the pose that it gives: the prior and what was made of it, other readings of the frame and why they
//! do not stand, and what was told besides. For `register --explain`, and in a pose's file.

use std::fmt;

use serde::{Deserialize, Serialize};

/// See the module.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Explained {
    /// The prior; absent where there was none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub prior: Option<ExplainedPrior>,
    /// Other readings, in the order in which they were looked at.
    pub readings: Vec<RejectedReading>,
    /// What the frame's header and the picture say of numbers that a pose may rest on.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub told: Vec<Told>,
}

/// What a prior was used for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PriorUse {
    /// It bounded the search and started it.
    Gate,
    /// It bounded the search, and counts beside the beads.
    Measurement,
    /// Nothing that stands is near it: the pose was sought without it.
    LeftAside,
}

/// A prior, and what was made of it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExplainedPrior {
    /// Where it comes from, a path or words; absent where nobody says.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub source: Option<String>,
    /// Its standard deviations about the camera's axes, and along them, at the centroid of the layout.
    pub sigma_deg: [f64; 3],
    /// See `sigma_deg`.
    pub sigma_mm: [f64; 3],
    /// Whether it states them; else they are assumed.
    pub stated: bool,
    /// What it was used for.
    pub used: PriorUse,
    /// How far it is from the pose that the beads alone give, in standard deviations of both together (the root of χ² with six degrees of
    /// freedom); absent where there is no such pose.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub innovation_sigmas: Option<f64>,
    /// By how much it is turned against that pose.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub angle_deg: Option<f64>,
    /// By how much it puts the beads elsewhere.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub shift_mm: Option<f64>,
}

/// Another reading of the frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Reading {
    /// The match near the prior, where another is judged.
    NearPrior,
    /// The same shadows otherwise named, or others, where the prior lets the camera be.
    OtherMatch,
    /// All shadows, wherever the camera is.
    Elsewhere,
    /// The layout moved onto itself.
    MovedLayout,
    /// The beads' plane mirrored about the line of sight.
    TiltedPlane,
    /// The shadows that the match leaves.
    SecondSet,
    /// The same close to the pose.
    SecondSetClose,
    /// The frame's mirror image.
    MirrorImage,
    /// Another focal length and principal point.
    OtherIntrinsics,
    /// A distorted picture.
    Distortion,
    /// Pixels that are not square as K says.
    PixelShape,
    /// Metal bright for dark, or the reverse.
    OtherPolarity,
}

/// A reading that was found.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FoundReading {
    /// Beads that it explains.
    pub matched: usize,
    /// How well.
    pub rms_px: f64,
    /// By how much its camera is turned against the pose that was judged; of the match near a prior, against the prior.
    pub angle_deg: f64,
    /// By how much it puts the beads elsewhere.
    pub shift_mm: f64,
}

/// Why a reading does not stand.
#[derive(Clone, Debug, PartialEq, thiserror::Error, Serialize, Deserialize)]
#[serde(tag = "code", rename_all = "snake_case")]
pub enum Rejected {
    /// It was looked for.
    #[error("looked for, and nothing beyond accident is there")]
    NotFound,
    /// It was not looked for.
    #[error("not looked for: beads, shadows and residuals leave no need of it")]
    NotSought,
    /// It explains less.
    #[error("it explains fewer beads than the {against} of the pose")]
    FewerBeads {
        /// What the pose explains.
        against: usize,
    },
    /// It fits worse.
    #[error("it fits worse, by {chi2_more:.0} in χ², beads that it misses among it")]
    FitsWorse {
        /// By how much.
        chi2_more: f64,
    },
    /// The prior says that it cannot be.
    #[error("the prior excludes it: {sigmas:.1} standard deviations (limit {limit:.1})")]
    OutsidePrior {
        /// How far it is from the prior.
        sigmas: f64,
        /// How far it may be.
        limit: f64,
    },
    /// What it frees is not needed.
    #[error("what it frees explains the residuals {times:.1} times as well as accident does, {needed:.0} times are needed")]
    NotNeeded {
        /// The ratio of an F test.
        times: f64,
        /// Its quantile.
        needed: f64,
    },
    /// It would be refused by itself.
    #[error("refused: {reason}")]
    Refused {
        /// Why.
        reason: String,
    },
    /// It is not rejected: the pose is in doubt for it.
    #[error("it is not ruled out by the beads, and the pose is in doubt for it")]
    Doubted,
}

impl Rejected {
    /// Numbers that a file cannot hold are as large as it can.
    pub(super) fn finite(self) -> Self {
        let held = |number: f64| if number.is_finite() { number } else { f64::MAX };
        match self {
            Self::FitsWorse { chi2_more } => Self::FitsWorse { chi2_more: held(chi2_more) },
            Self::OutsidePrior { sigmas, limit } => Self::OutsidePrior { sigmas: held(sigmas), limit },
            Self::NotNeeded { times, needed } if times.is_nan() => Self::NotNeeded { times: 0.0, needed },
            Self::NotNeeded { times, needed } => Self::NotNeeded { times: held(times), needed },
            other => other,
        }
    }
}

/// Another reading, and why it does not stand.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RejectedReading {
    /// Which.
    pub reading: Reading,
    /// What was found of it; absent where nothing was.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub found: Option<FoundReading>,
    /// Why it does not stand.
    pub why: Rejected,
}

/// What somebody says of a number that a pose may rest on, and whether it does.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Told {
    /// Which number, and who says it.
    pub what: String,
    /// What is said.
    pub value: String,
    /// Whether the pose rests on it.
    pub used: bool,
    /// Why, or why not.
    pub why: String,
}

impl fmt::Display for PriorUse {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Gate => "it bounded the search, and P does not rest on it",
            Self::Measurement => "it bounded the search, and is a measurement beside the beads (--fuse)",
            Self::LeftAside => "left aside: nothing that stands is near it",
        })
    }
}

impl fmt::Display for ExplainedPrior {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { source, sigma_deg: [a, b, c], sigma_mm: [x, y, z], stated, used, .. } = self;
        let source = source.as_deref().map_or(String::new(), |source| format!(" {source}"));
        let stated = if *stated { "as it states" } else { "assumed, it states none" };
        write!(
            f,
            "prior{source}: ± {a:.2}°, {b:.2}°, {c:.2}° about x, y, z and ± {x:.2}, {y:.2}, {z:.2} mm at the beads, {stated}"
        )?;
        write!(f, "; {used}")?;
        match (self.innovation_sigmas, self.angle_deg, self.shift_mm) {
            (Some(sigmas), Some(angle_deg), Some(shift_mm)) => {
                write!(f, "; it is {angle_deg:.2}° and {shift_mm:.2} mm from what the beads alone give, {sigmas:.1} σ of both")
            }
            _ => f.write_str("; there is no pose of the beads alone to compare it with"),
        }
    }
}

impl fmt::Display for Reading {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::NearPrior => "the match near the prior",
            Self::OtherMatch => "shadows otherwise named, or others",
            Self::Elsewhere => "all shadows, the prior left out",
            Self::MovedLayout => "the layout moved onto itself",
            Self::TiltedPlane => "the beads' plane tilted the other way",
            Self::SecondSet => "a second set of shadows",
            Self::SecondSetClose => "a second set of shadows close to the pose",
            Self::MirrorImage => "the frame's mirror image",
            Self::OtherIntrinsics => "another K (SID, pitch, principal point)",
            Self::Distortion => "a distorted picture",
            Self::PixelShape => "pixels of another shape",
            Self::OtherPolarity => "metal the other way round",
        })
    }
}

impl fmt::Display for RejectedReading {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.reading)?;
        if let Some(FoundReading { matched, rms_px, angle_deg, shift_mm }) = self.found {
            write!(f, ", {matched} beads to {rms_px:.2} px, {angle_deg:.1}° and {shift_mm:.1} mm away")?;
        }
        write!(f, ": {}", self.why)
    }
}

impl fmt::Display for Told {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { what, value, used, why } = self;
        write!(f, "{what}: {value}; {}{why}", if *used { "" } else { "not used: " })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file has no word for what is not a number, and did not come back.
    #[test]
    fn what_is_not_a_number_comes_back_from_a_file() {
        let of = |why: Rejected| RejectedReading { reading: Reading::OtherIntrinsics, found: None, why: why.finite() };
        let worst = [
            of(Rejected::NotNeeded { times: f64::NAN, needed: 40.0 }),
            of(Rejected::FitsWorse { chi2_more: f64::INFINITY }),
            of(Rejected::OutsidePrior { sigmas: f64::INFINITY, limit: 5.5 }),
        ];
        for own in worst {
            let text = serde_json::to_string(&own).expect("JSON");
            assert_eq!(serde_json::from_str::<RejectedReading>(&text).expect("reads what it writes"), own);
        }
    }
}
