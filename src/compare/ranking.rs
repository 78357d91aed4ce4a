//! A score at the stated pose, ranked among the same score under hypotheses that are wrong.

use super::scores::Scores;

/// A score at one wrong pose.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ShiftedScore {
    /// `u +1 mm`, `turn about v −3 deg` and the like; camera axes.
    pub shift: String,
    /// `None` where the score does not exist there.
    pub value: Option<f64>,
    /// The picture there is that of the stated pose, so nothing can prefer it; it is not ranked.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub same_picture: bool,
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
    /// Poses and mirrored pictures compared, the stated pose included.
    pub of: usize,
    /// Whether the best is at the stated pose. Where false, the score does not tell a right pose from a wrong one.
    pub discriminating: bool,
    /// All wrong poses, then the optima of all shifts and of all turns, which are not ranked.
    pub shifts: Vec<ShiftedScore>,
}

/// What the stated pose is ranked against.
pub(super) struct Wrong<'a> {
    /// By hypothesis; the last two are optima.
    pub shifted: &'a [(String, Scores)],
    /// Without the optima, which may lie at the stated pose.
    pub known_wrong: usize,
    /// Not told from it by the picture.
    pub same_picture: &'a [String],
}

pub(super) fn rank(name: &str, larger_is_better: bool, stated: &Scores, wrong: &Wrong) -> NullScore {
    let at_pose = stated.get(name);
    let better = |a: f64, b: f64| if larger_is_better { a > b } else { a < b };
    let shift = |(shift, scores): &(String, Scores)| ShiftedScore {
        shift: shift.clone(),
        value: scores.get(name),
        same_picture: wrong.same_picture.contains(shift),
    };
    let shifts: Vec<ShiftedScore> = wrong.shifted.iter().map(shift).collect();
    let ranked =
        || shifts[..wrong.known_wrong].iter().filter(|s| !s.same_picture).filter_map(|s| Some((s.shift.as_str(), s.value?)));
    let mut best: Option<(&str, f64)> = None;
    let mut rank = 1;
    for (shift, value) in ranked() {
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
        of: 1 + ranked().count(),
        discriminating: rank == 1 && best.is_some(),
        shifts,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(zncc: f64) -> Scores {
        Scores { zncc: Some(zncc), ..Scores::default() }
    }

    /// A symmetric phantom looks the same mirrored; noise gave its mirror image the better score, and the pose counted as not told from others.
    #[test]
    fn what_draws_the_same_picture_is_listed_and_not_ranked() {
        let shifted = [("u +1 mm", 0.8), ("picture mirrored left-right", 0.91), ("half-turn about v", 0.4), ("best shift", 0.95)]
            .map(|(name, zncc)| (name.to_owned(), at(zncc)));
        let ranked =
            |same_picture: &[String]| rank("zncc", true, &at(0.9), &Wrong { shifted: &shifted, known_wrong: 3, same_picture });
        let told = ranked(&[]);
        assert_eq!((told.rank, told.of, told.discriminating), (2, 4, false));
        assert_eq!(told.best_shift.as_deref(), Some("picture mirrored left-right"));
        let hidden = ranked(&["picture mirrored left-right".to_owned()]);
        assert_eq!((hidden.rank, hidden.of, hidden.discriminating), (1, 3, true));
        assert_eq!(hidden.best_shift.as_deref(), Some("u +1 mm"));
        assert_eq!(hidden.shifts.iter().filter(|shift| shift.same_picture).count(), 1, "it stays in the list");
        let all: Vec<String> = shifted.iter().map(|(name, _)| name.clone()).collect();
        assert!(!ranked(&all).discriminating, "nothing to be told from");
    }
}
