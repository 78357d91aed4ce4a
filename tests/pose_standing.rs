//! What came of many registrations, by how their poses are shown: plain, with a caution, in doubt; so that what is wrong of each can be held
//! against one in 50 000.

use sidecarm::pose::Pose;

/// As a person sees an accepted pose. Strips and pairs show a caution in the colour of none; a doubt has another.
const SHOWN: [&str; 3] = ["plain", "with a caution", "in doubt"];
/// Of so many registrations one may be wrong and accepted.
const TARGET: usize = 50_000;

/// Accepted poses that are shown alike.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Shown {
    right: usize,
    wrong: usize,
    /// Wrong, and nothing that is given tells it.
    untold: usize,
}

/// They add up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Accepted {
    cases: usize,
    refused: usize,
    shown: [Shown; 3],
}

impl Accepted {
    /// One registration; `is_wrong` and `nothing_tells` are heard of accepted ones.
    pub fn add(&mut self, pose: &Pose, is_wrong: bool, nothing_tells: bool) {
        self.cases += 1;
        let shown = match (pose.is_accepted(), &pose.doubt, pose.cautions.is_empty()) {
            (false, ..) => {
                self.refused += 1;
                return;
            }
            (true, Some(_), _) => &mut self.shown[2],
            (true, None, false) => &mut self.shown[1],
            (true, None, true) => &mut self.shown[0],
        };
        match (is_wrong, nothing_tells) {
            (false, _) => shown.right += 1,
            (true, false) => shown.wrong += 1,
            (true, true) => shown.untold += 1,
        }
    }

    /// A line for each way of being shown.
    pub fn lines(&self) -> Vec<String> {
        let mut lines = vec![format!(
            "{:16} {:>8} {:>8} {:>8} {:>14}  wrong of all {} registrations, {} of them refused; target one in {TARGET}",
            "accepted", "all", "right", "wrong", "nothing tells", self.cases, self.refused
        )];
        lines.extend(SHOWN.iter().zip(&self.shown).map(|(words, Shown { right, wrong, untold })| {
            let all = right + wrong + untold;
            format!("{words:16} {all:8} {right:8} {wrong:8} {untold:14}  {}", rate(*wrong, self.cases))
        }));
        lines
    }

    /// For the line of sums.
    pub fn sums(&self) -> String {
        let keys = ["plain", "cautioned", "doubted"];
        let of = |(key, Shown { right, wrong, untold }): (&&str, &Shown)| {
            format!(" {key}_right {right} {key}_wrong {wrong} {key}_nothing_tells {untold}")
        };
        keys.iter().zip(&self.shown).map(of).collect()
    }
}

/// One in how many. Where there is none, the rate that has none once in twenty runs: three are then expected.
fn rate(wrong: usize, cases: usize) -> String {
    match wrong {
        0 => format!("none: fewer than one in {}, to 95 %", cases / 3),
        _ => format!("one in {}", cases / wrong),
    }
}

#[test]
fn poses_are_counted_as_they_are_shown() {
    use sidecarm::geometry::{Intrinsics, Projection, Rigid};
    let k = Intrinsics { fx: 1.0, fy: 1.0, skew: 0.0, cx: 0.0, cy: 0.0 };
    let plain = Pose { projection: Some(Projection::compose(&k, &Rigid::IDENTITY)), ..Pose::default() };
    let cautioned = Pose { cautions: vec!["look".to_owned()], ..plain.clone() };
    let mut doubted = plain.clone();
    doubted.doubt("another one".to_owned());
    let refused = plain.clone().refused_for(sidecarm::pose::Refusal::Unsolved);
    let mut all = Accepted::default();
    for (pose, is_wrong, nothing_tells) in [
        (&plain, false, false),
        (&plain, true, false),
        (&cautioned, true, true),
        (&doubted, true, false),
        (&doubted, false, true),
        (&refused, true, false),
    ] {
        all.add(pose, is_wrong, nothing_tells);
    }
    let shown = |right, wrong, untold| Shown { right, wrong, untold };
    assert_eq!(all, Accepted { cases: 6, refused: 1, shown: [shown(1, 1, 0), shown(0, 0, 1), shown(1, 1, 0)] });
    assert!(all.sums().contains(" cautioned_wrong 0 cautioned_nothing_tells 1 "), "{}", all.sums());
    let lines = all.lines();
    assert!(lines[1].ends_with("one in 6") && lines[2].ends_with("fewer than one in 2, to 95 %"), "{lines:?}");
}
