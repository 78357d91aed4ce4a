//! When the image as a whole prefers another pose than the stated one.
//!
//! One score alone may: a pelvis with scatter that the simulation lacks correlates better 3° off than at the truth. Scores that look at
//! different things (gray values, gradients, local structure, edges) do not err towards the same wrong pose, so most of them must prefer
//! the same one, each by more than noise would give it.

use std::collections::BTreeMap;

use super::ranking::NullScore;
use super::wrong_poses::is_of_another_layout;

/// Scores that vote, each looking at something else: name, whether larger is better, and the least by which one must be better. A pose
/// that is half a millimetre and a fifth of a degree off, as beads leave it open, loses less than these in most scores.
const VOTERS: [(&str, bool, f64); 4] =
    [("zncc", true, 2e-3), ("gradient_ncc", true, 0.02), ("local_ncc", true, 0.01), ("edge_distance_px", false, 0.1)];
/// Voting in place of ZNCC where a tone is not declared.
const IN_PLACE_OF_ZNCC: &str = "rank_ncc";
/// Of what is missing to a perfect score, the better pose must make up this share.
const SHARE: f64 = 0.1;
/// The same where all scores, and at least three, prefer one pose of a layout turned about, negated or mirrored, or one mirrored picture. Scatter and noise that the simulation lacks
/// make what is missing large at every pose; they do not make all scores agree on the same half-turn.
const SHARE_OF_ANOTHER_LAYOUT: f64 = 0.05;
const FEWEST_UNANIMOUS: usize = 3;
/// Scores of local structure, in which neither the scene's beads nor its tools, which are where the pose puts them whatever CT surrounds
/// them, outweigh the bones; and the least by which one must be better. Both together tell a CT that is turned or mirrored against the beads.
const STRUCTURE: [(&str, f64); 2] = [("local_ncc", 0.03), ("ssim", 0.01)];
/// Of what is missing to a perfect score, that much: a CT that is the right one leaves no other layout so far ahead.
const SHARE_OF_STRUCTURE: f64 = 0.25;
/// Fewer voters than this decide nothing.
const FEWEST_VOTERS: usize = 2;

/// A pose that most scores prefer to the stated one.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Elsewhere {
    /// `depth -10 mm`, `turn about v +3 deg`, `half-turn about z (RAS and LPS swapped)` and the like.
    pub pose: String,
    /// Scores that prefer it: name, at the stated pose, there.
    pub preferring: Vec<(String, f64, f64)>,
    /// Scores that were asked.
    pub asked: usize,
}

impl std::fmt::Display for Elsewhere {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let scores: Vec<String> = self
            .preferring
            .iter()
            .map(|(name, here, there)| format!("{} {here:.3} to {there:.3}", name.replace('_', " ")))
            .collect();
        write!(
            f,
            "image disagrees: {} of {} scores prefer '{}' to the pose of the beads ({})",
            self.preferring.len(),
            self.asked,
            self.pose,
            scores.join(", ")
        )?;
        if is_of_another_layout(&self.pose) {
            f.write_str("; are CT and beads turned or mirrored against each other?")?;
        }
        Ok(())
    }
}

/// The pose that most scores prefer to the stated one; `None` where they do not agree on any, or too few exist.
#[must_use]
pub fn elsewhere(null: &BTreeMap<String, NullScore>) -> Option<Elsewhere> {
    let voter = |(name, larger, least): (&'static str, bool, f64)| {
        let name = if name == "zncc" && !null.contains_key(name) { IN_PLACE_OF_ZNCC } else { name };
        let score = null.get(name)?;
        Some((name, larger, least, score.at_pose?, score))
    };
    let voters: Vec<_> = VOTERS.into_iter().filter_map(voter).collect();
    if voters.len() < FEWEST_VOTERS {
        return None;
    }
    let mut best: Option<(f64, Elsewhere)> = None;
    for (index, shift) in voters[0].4.shifts.iter().enumerate().filter(|(_, shift)| !shift.same_picture) {
        // The score, whether it is better there by more than noise, by how much, and what is missing here.
        let (mut told, mut gain) = (Vec::new(), 0.0);
        for (name, larger, least, here, score) in &voters {
            let Some(there) = score.shifts.get(index).filter(|s| s.shift == shift.shift).and_then(|s| s.value) else { continue };
            // What is missing to a perfect score: 1 for correlations, 0 for distances.
            let (missing_here, missing_there) = if *larger { (1.0 - here, 1.0 - there) } else { (*here, there) };
            let better = missing_here - missing_there;
            gain += better / missing_here.abs().max(1e-9);
            told.push((((*name).to_owned(), *here, there), better > *least, better, missing_here));
        }
        let by = |share: f64| -> Vec<(String, f64, f64)> {
            let beyond = told.iter().filter(|(_, beyond, better, missing)| *beyond && *better > share * missing);
            beyond.map(|(score, ..)| score.clone()).collect()
        };
        let all = by(SHARE_OF_ANOTHER_LAYOUT);
        let unanimous = all.len() == voters.len() && all.len() >= FEWEST_UNANIMOUS;
        let preferring = if unanimous && is_of_another_layout(&shift.shift) { all } else { by(SHARE) };
        let majority = 2 * preferring.len() > voters.len();
        if majority && best.as_ref().is_none_or(|(most, _)| gain > *most) {
            best = Some((gain, Elsewhere { pose: shift.shift.clone(), preferring, asked: voters.len() }));
        }
    }
    best.map(|(_, found)| found).or_else(|| by_structure(null))
}

/// The other layout in which both scores of structure gain most, where they gain much.
fn by_structure(null: &BTreeMap<String, NullScore>) -> Option<Elsewhere> {
    let scores: Option<Vec<_>> = STRUCTURE.into_iter().map(|(name, least)| Some((name, least, null.get(name)?))).collect();
    let scores = scores?;
    let shifts = scores.first()?.2.shifts.iter().filter(|shift| !shift.same_picture && is_of_another_layout(&shift.shift));
    let mut best: Option<(f64, Elsewhere)> = None;
    for shift in shifts {
        let gained = |(name, least, score): &(&str, f64, &NullScore)| {
            let here = score.at_pose?;
            let there = score.shifts.iter().find(|other| other.shift == shift.shift)?.value?;
            let share = (there - here) / (1.0 - here);
            (there - here > *least && share > SHARE_OF_STRUCTURE).then(|| (((*name).to_owned(), here, there), share))
        };
        let Some(gains) = scores.iter().map(gained).collect::<Option<Vec<_>>>() else { continue };
        let gain: f64 = gains.iter().map(|(_, share)| share).sum();
        if best.as_ref().is_none_or(|(most, _)| gain > *most) {
            let preferring: Vec<_> = gains.into_iter().map(|(score, _)| score).collect();
            best = Some((gain, Elsewhere { pose: shift.shift.clone(), asked: preferring.len(), preferring }));
        }
    }
    best.map(|(_, found)| found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::compare::ShiftedScore;

    fn null(scores: &[(&str, f64, [f64; 3])]) -> BTreeMap<String, NullScore> {
        let shift = |(name, value): (&str, f64)| ShiftedScore { shift: name.to_owned(), value: Some(value), same_picture: false };
        let score = |(name, here, there): &(&str, f64, [f64; 3])| {
            let shifts = ["u +1 mm", "depth +3 mm", "turn about v +3 deg"].into_iter().zip(*there).map(shift).collect();
            let score = NullScore {
                at_pose: Some(*here),
                best_shifted: None,
                best_shift: None,
                rank: 1,
                of: 4,
                discriminating: true,
                shifts,
            };
            ((*name).to_owned(), score)
        };
        scores.iter().map(score).collect()
    }

    #[test]
    fn one_score_that_errs_does_not_decide_and_a_majority_does() {
        let scatter = ("zncc", 0.864, [0.85, 0.86, 0.885]);
        let rest = [("gradient_ncc", 0.6, [0.4, 0.58, 0.35]), ("local_ncc", 0.7, [0.5, 0.66, 0.4])];
        let distance = ("edge_distance_px", 0.6, [1.2, 0.8, 2.0]);
        assert_eq!(elsewhere(&null(&[scatter, rest[0], rest[1], distance])), None);
        let wrong = [("gradient_ncc", 0.35, [0.3, 0.36, 0.6]), ("local_ncc", 0.4, [0.3, 0.38, 0.7])];
        let found = elsewhere(&null(&[scatter, wrong[0], wrong[1], distance])).expect("three of four agree");
        assert_eq!((found.pose.as_str(), found.preferring.len(), found.asked), ("turn about v +3 deg", 3, 4));
        assert!(found.to_string().contains("3 of 4 scores prefer 'turn about v +3 deg'"));
        // The same votes for different poses are no agreement.
        let split = [("gradient_ncc", 0.35, [0.6, 0.36, 0.3]), ("local_ncc", 0.4, [0.3, 0.7, 0.3])];
        assert_eq!(elsewhere(&null(&[scatter, split[0], split[1], distance])), None);
    }

    #[test]
    fn all_scores_together_need_less_for_another_layout() {
        // Scatter that the simulation lacks: much is missing at every pose, and all scores lean the same way by 8 % of it.
        let leaning = |name: &str, voters: usize| {
            let scores =
                [("zncc", 0.5, 0.54), ("gradient_ncc", 0.4, 0.448), ("local_ncc", 0.3, 0.356), ("edge_distance_px", 4.0, 3.68)];
            let mut null = null(&scores.map(|(name, here, there)| (name, here, [here, there, here])));
            null.retain(|name, _| scores[..voters].iter().any(|(kept, ..)| kept == name));
            null.values_mut().for_each(|score| score.shifts[1].shift = name.to_owned());
            elsewhere(&null).map(|found| (found.pose, found.preferring.len()))
        };
        for name in ["half-turn about v", "y and z of lps negated", "x of lps mirrored", "picture mirrored left-right"] {
            assert_eq!(leaning(name, 4), Some((name.to_owned(), 4)));
            assert_eq!(leaning(name, 2), None, "two agree by chance");
        }
        assert_eq!(leaning("turn about v +3 deg", 4), None);
    }

    #[test]
    fn a_single_score_or_none_says_nothing() {
        assert_eq!(elsewhere(&null(&[("zncc", 0.2, [0.9, 0.9, 0.9])])), None);
        assert_eq!(elsewhere(&BTreeMap::new()), None);
        let not_numbers = null(&[("zncc", f64::NAN, [0.9; 3]), ("local_ncc", f64::NAN, [0.9; 3])]);
        assert_eq!(elsewhere(&not_numbers), None);
    }

    /// A CT mirrored against right beads was accepted without a word: beads and robot, which stand where the pose has them, decided.
    #[test]
    fn structure_tells_a_ct_that_is_mirrored_against_its_beads() {
        // Measured with a mirrored CT (stated, mirrored) and with the right one.
        let of = |zncc: [f64; 2], gradient: [f64; 2], local: [f64; 2], ssim: [f64; 2], distance: [f64; 2]| {
            let scores = [
                ("zncc", zncc),
                ("gradient_ncc", gradient),
                ("local_ncc", local),
                ("ssim", ssim),
                ("edge_distance_px", distance),
            ];
            let mut null = null(&scores.map(|(name, [here, there])| (name, here, [here, there, here])));
            null.values_mut().for_each(|score| score.shifts[1].shift = "z of lps mirrored".to_owned());
            elsewhere(&null)
        };
        let found = of([0.981, 0.970], [0.872, 0.719], [0.753, 0.878], [0.898, 0.941], [0.071, 0.068]).expect("it is seen");
        assert_eq!((found.pose.as_str(), found.preferring.len()), ("z of lps mirrored", 2));
        assert!(found.to_string().ends_with("are CT and beads turned or mirrored against each other?"), "{found}");
        assert_eq!(of([0.999, 0.970], [0.992, 0.72], [0.988, 0.794], [0.993, 0.916], [0.068, 0.069]), None);
        // One of them alone, or both by less, say nothing.
        assert_eq!(of([0.981, 0.970], [0.872, 0.719], [0.753, 0.878], [0.898, 0.900], [0.071, 0.068]), None);
        assert_eq!(of([0.981, 0.970], [0.872, 0.719], [0.753, 0.80], [0.898, 0.915], [0.071, 0.068]), None);
        assert_eq!(of([0.981, 0.970], [0.872, 0.719], [f64::NAN, 0.9], [0.8, 0.98], [0.071, 0.068]), None);
    }
}
