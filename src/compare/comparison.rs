//! What a comparison found.

use std::collections::BTreeMap;

use super::disagreement::Disagreement;
use super::domain::{AirReport, CommonDomain};
use super::null::NullPlan;
use super::ranking::NullScore;
use super::scores::Scores;
use super::tone::ToneFit;
use crate::acquire::Domain;
use crate::image::Image;
use crate::mask::MaskShares;

/// What was found, as it is written to files.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Comparison {
    /// Columns and rows that were compared.
    pub size_px: [usize; 2],
    /// Pixels of the acquired frame that make one here, each way.
    pub binning: usize,
    /// Of the acquired frame.
    pub domain: Domain,
    /// In which the images were compared.
    pub common_domain: CommonDomain,
    /// Where the air level came from.
    pub air: AirReport,
    /// Median noise of a pixel that quanta and electronics of the detector calibration give at the frame's own signal; nepers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub noise_expected_nepers: Option<f64>,
    /// The tone that was fitted.
    pub tone: ToneFit,
    /// With the tone.
    pub scores: Scores,
    /// Without any tone, on the same pixels.
    pub scores_without_tone: Scores,
    /// The robot or tool alone, with the tone; `None` without a tool mask.
    pub scores_tool: Option<Scores>,
    /// What plainly disagrees, whatever the pose; each is also a flag.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub disagreements: Vec<Disagreement>,
    /// Each score against its null; empty until the null is made.
    pub null: BTreeMap<String, NullScore>,
    /// How the null was made.
    pub null_plan: Option<NullPlan>,
    /// What was left out.
    pub masks: MaskShares,
    /// Millimetres at the depth of the centre per pixel.
    pub mm_per_px: Option<f64>,
    /// What to beware of.
    pub flags: Vec<String>,
}

/// The images behind the numbers, in the common domain: larger is more attenuation.
#[derive(Clone, Debug)]
pub struct Pictures {
    /// The frame; NaN where it has no value.
    pub acquired: Image<f32>,
    /// The simulation as the fitted tone shows it; NaN where it is not known.
    pub simulated: Image<f32>,
    /// True where scored or fitted.
    pub usable: Image<bool>,
    /// True behind the collimator: no picture is there, whatever `acquired` holds.
    pub shut_off: Image<bool>,
    /// Edges of the simulation.
    pub edges: Image<bool>,
    /// `nepers`, `nepers (offset unknown)`, or that they are gray values.
    pub unit: &'static str,
}
