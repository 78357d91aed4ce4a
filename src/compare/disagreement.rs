//! When two images plainly do not show the same thing, whatever pose is right.

use super::scores::Scores;
use crate::image::{Image, block_means, quantile};

/// Rank correlations below this run the other way.
const INVERTED: f64 = -0.2;
/// Below this nothing of one image is seen in the other: frames of the right specimen at a pose that is degrees off still correlate better.
const UNRELATED: f64 = 0.2;
/// Nepers that scatter does not explain: four times the primary, as behind the thickest pelvis, is ln 5 = 1.6 there, and less on average.
const GROSS_RMSE_NEPERS: f64 = 1.5;
/// Open air reads more than a level that was measured without specimen by heel, gain and scatter, and hardly by more than this.
const ABOVE_AIR: f64 = 1.3;
/// Side of the blocks whose means are held against the level: noise of single pixels contradicts none.
const BLOCK_PX: usize = 8;
/// Less of the frame may be a reflection, or something that no mask has found.
const ABOVE_AIR_SHARE: f64 = 0.005;

/// A plain disagreement of the acquired frame with its simulation.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum Disagreement {
    /// What attenuates more shows as if it attenuated less.
    InvertedContrast {
        /// Of the two images, without tone.
        rank_ncc: f64,
    },
    /// Neither image is seen in the other.
    Unrelated {
        /// Of the two images, without tone.
        rank_ncc: f64,
    },
    /// Values in nepers that are far apart.
    FarApart {
        /// Without tone.
        rmse_nepers: f64,
        /// Mean of acquired − simulated, without tone.
        bias_nepers: f64,
    },
    /// Much of the frame is brighter than the air level that was declared.
    AboveAir {
        /// As declared, a stored value.
        declared: f64,
        /// Of the frame, where it is brighter.
        share: f64,
        /// How often the level such a place reads, in the middle of them.
        times: f64,
    },
}

impl std::fmt::Display for Disagreement {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::InvertedContrast { rank_ncc } => write!(
                f,
                "the acquired frame looks inverted: what attenuates more in the simulation attenuates less in the frame (rank correlation \
                 {rank_ncc:.2}); is bright dense? give --domain log or display, or check the pixel intensity relationship sign (0028,1041)"
            ),
            Self::Unrelated { rank_ncc } => write!(
                f,
                "the images hardly correlate (rank correlation {rank_ncc:.2}, expected above {UNRELATED}): another specimen, pose or frame?"
            ),
            Self::FarApart { rmse_nepers, bias_nepers } => write!(
                f,
                "the images are {rmse_nepers:.2} nepers apart (mean {bias_nepers:+.2}, expected below {GROSS_RMSE_NEPERS}): air level, offset, beam \
                 or materials are not those of the frame"
            ),
            Self::AboveAir { declared, share, times } => write!(
                f,
                "the air level {declared} is not this frame's: by it {:.1} % of the frame passes {times:.2} times what air does, where heel, gain and \
                 scatter make at most {ABOVE_AIR} times of that; measure it without specimen, or leave it out",
                100.0 * share
            ),
        }
    }
}

/// What is plainly wrong by the scores without tone: a fitted curve may fall where it should rise, and absorbs what values are apart.
pub(super) fn disagreements(without_tone: &Scores) -> Vec<Disagreement> {
    let by_rank = without_tone.rank_ncc.and_then(|rank_ncc| match rank_ncc {
        inverted if inverted < INVERTED => Some(Disagreement::InvertedContrast { rank_ncc }),
        unrelated if unrelated < UNRELATED => Some(Disagreement::Unrelated { rank_ncc }),
        _ => None,
    });
    let apart = without_tone.rmse_nepers.zip(without_tone.bias_nepers).filter(|(rmse, _)| !(*rmse <= GROSS_RMSE_NEPERS));
    let apart = apart.map(|(rmse_nepers, bias_nepers)| Disagreement::FarApart { rmse_nepers, bias_nepers });
    by_rank.into_iter().chain(apart).collect()
}

/// A declared air level, a stored value, that the frame contradicts by `nepers` far below 0 on more than a spot; `seen`: where the frame shows what
/// passed through, pixels at the end of the scale as well.
pub(super) fn above_air(declared: f64, nepers: &Image<f32>, seen: &Image<bool>) -> Option<Disagreement> {
    let (means, kept) = block_means(nepers, seen, BLOCK_PX);
    let within = means.pixels.iter().zip(&kept.pixels).filter(|(_, kept)| **kept).map(|(mean, _)| *mean);
    let blocks = within.clone().count();
    let mut above: Vec<f32> = within.filter(|mean| f64::from(*mean) < -ABOVE_AIR.ln()).collect();
    let share = above.len() as f64 / blocks as f64;
    let times = quantile(&mut above, 0.5).map(|middle| (-middle).exp())?;
    (share >= ABOVE_AIR_SHARE).then_some(Disagreement::AboveAir { declared, share, times })
}
