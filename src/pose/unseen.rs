//! The error of a pose where it was not fitted: beads of role `check`, else each bead under the pose of all others.

use serde::{Deserialize, Serialize};

use super::residual::BeadResidual;

/// What an error was measured at.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum UnseenBy {
    /// Beads of role `check`.
    CheckBeads,
    /// Each used bead, by the pose of all others.
    LeftOut,
}

/// The error of a pose at beads that it has not seen.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Unseen {
    /// What it was measured at.
    pub by: UnseenBy,
    /// At how many.
    pub beads: usize,
    /// √mean(dx² + dy²).
    pub rms_px: f64,
    /// The same in mm, at the depth at which the pose tells its own.
    pub rms_mm: f64,
    /// The bead that is farthest off in standard deviations, outliers and beads beside whose place there is a shadow among them.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub worst: Option<WorstBead>,
}

/// The bead that agrees least with the others.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WorstBead {
    /// As in the layout.
    pub name: String,
    /// How far off it is.
    pub off_px: f64,
    /// The same in standard deviations of observation, place and prediction.
    pub off_sigmas: f64,
    /// Whether P rests on it.
    pub used: bool,
}

impl std::fmt::Display for Unseen {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { by, beads, rms_px, rms_mm, worst } = self;
        match by {
            UnseenBy::CheckBeads => {
                write!(f, "{beads} check beads are {rms_px:.3} px = {rms_mm:.3} mm (rms) from where P puts them")?
            }
            UnseenBy::LeftOut => write!(f, "each bead is {rms_px:.3} px = {rms_mm:.3} mm (rms) from where the others put it")?,
        }
        match worst {
            Some(WorstBead { name, off_px, off_sigmas, used }) => {
                // Check beads are what the rms is of; of all others it is of those that P rests on.
                let is_aside = !used && *by == UnseenBy::LeftOut;
                let which = if is_aside { "of the beads that are not used the farthest is" } else { "the worst is" };
                write!(f, "; {which} {name}, {off_px:.3} px, {off_sigmas:.1} σ")
            }
            None => Ok(()),
        }
    }
}

impl Unseen {
    /// Of the beads of an accepted pose; a pixel is `mm_per_px` where errors are told in mm. `None` where no bead was unseen by any pose.
    pub(super) fn of(beads: &[BeadResidual], mm_per_px: f64) -> Option<Self> {
        let length = |off: [f64; 2]| off[0].hypot(off[1]);
        let checks: Vec<f64> = beads.iter().filter(|bead| bead.check).filter_map(|bead| bead.residual_px.map(length)).collect();
        let (by, off_px) = match checks.is_empty() {
            false => (UnseenBy::CheckBeads, checks),
            true => (UnseenBy::LeftOut, beads.iter().filter_map(|bead| bead.left_out_px.map(length)).collect()),
        };
        let rms_px = (off_px.iter().map(|px| px * px).sum::<f64>() / off_px.len() as f64).sqrt();
        let worst = |bead: &BeadResidual| {
            let off_px = length(bead.left_out_px.filter(|_| bead.used).or(bead.residual_px).or(bead.beside_px)?);
            Some(WorstBead { name: bead.name.clone(), off_px, off_sigmas: bead.off_sigmas?, used: bead.used })
        };
        let worst = beads.iter().filter_map(worst).max_by(|a, b| a.off_sigmas.total_cmp(&b.off_sigmas));
        rms_px.is_finite().then_some(Self { by, beads: off_px.len(), rms_px, rms_mm: rms_px * mm_per_px, worst })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A bead 24 px off, which P does not rest on, was called the worst of those that are 0.2 px off.
    #[test]
    fn a_bead_that_is_not_used_is_no_worst_of_those_that_are() {
        let words = |by, used| {
            let worst = Some(WorstBead { name: "B06".to_owned(), off_px: 24.063, off_sigmas: 17.2, used });
            Unseen { by, beads: 8, rms_px: 0.206, rms_mm: 0.035, worst }.to_string()
        };
        let aside = words(UnseenBy::LeftOut, false);
        assert!(aside.ends_with("; of the beads that are not used the farthest is B06, 24.063 px, 17.2 σ"), "{aside}");
        for (by, used) in [(UnseenBy::LeftOut, true), (UnseenBy::CheckBeads, false)] {
            assert!(words(by, used).contains("; the worst is B06, "));
        }
    }
}
