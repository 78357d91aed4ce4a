//! Is the right pose found where the prior is off and every other shadow is false? `scripts/evaluate prior`.

use glam::DQuat;
use rayon::prelude::*;
use sidecarm::pose::{Prior, Registration, register_shadows};
use sidecarm::random::{Purpose, Stream};

use crate::pose_mistakes::{Draw, WRONG_PX, turned};
use crate::pose_registration::{clutter, matching, shadows, worst_landmark_px};
use crate::pose_synthetic as synthetic;

const OFF_DEG: f64 = 10.0;
const OFF_MM: f64 = 30.0;
/// So little, and stated of false shadows as well, that a pose which is wrong is another reading and no noise.
const NOISE_PX: f64 = 0.1;
const NOISE_MM: f64 = 0.02;
const STRATA: [&str; 3] = ["six beads and more", "four and five beads", "three beads and fewer"];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Outcome {
    Correct,
    Refused,
    Wrong,
}

struct Run {
    /// Of `STRATA`.
    stratum: usize,
    outcome: Outcome,
    doubted: bool,
    words: String,
}

/// `None` where no bead is in the frame.
fn run(seed: u64) -> Option<Run> {
    let mut draw = Draw(Stream::new(seed, 94, 0, Purpose::Evaluation));
    let [fewest, beyond] = draw.one_of(&[[6.0, 13.0], [6.0, 13.0], [4.0, 6.0], [1.0, 4.0]]);
    let wanted = draw.between(fewest, beyond) as usize;
    let beads = (wanted + draw.between(0.0, 5.0) as usize).max(5);
    let (view, layout) = (synthetic::view(1024, 1024, seed), synthetic::layout(beads, 0.75, seed));
    let mut found = shadows(&view, &layout, NOISE_PX, NOISE_MM, seed);
    while found.len() > wanted {
        let unseen = draw.between(0.0, found.len() as f64) as usize;
        found.remove(unseen);
    }
    let visible = found.len();
    let radius_px = found.first()?.radius_px;
    found.extend(clutter(&view, visible, radius_px, seed));
    found.iter_mut().for_each(|shadow| shadow.quality = draw.between(0.2, 1.0));
    found.sort_by(|a, b| b.quality.total_cmp(&a.quality));
    let turn = DQuat::from_axis_angle(draw.normal3(1.0).normalize(), OFF_DEG.to_radians());
    let prior = Prior { camera_from_lps: turned(&view, turn, draw.normal3(1.0).normalize() * OFF_MM), covariance: None };
    let pose = register_shadows(&Registration { prior: Some(&prior), ..matching(&view, &layout) }, &found);
    let (outcome, words) = if pose.is_accepted() {
        let worst_px = worst_landmark_px(&pose, &view, &layout);
        let outcome = if worst_px <= WRONG_PX { Outcome::Correct } else { Outcome::Wrong };
        (outcome, format!("landmarks up to {worst_px:.2} px off, {:?}", pose.cautions))
    } else {
        (Outcome::Refused, pose.reason.unwrap_or_default())
    };
    let stratum = match visible {
        0..=3 => 2,
        4 | 5 => 1,
        _ => 0,
    };
    let words = format!("seed {seed}: {visible} of {beads} beads seen: {words}");
    Some(Run { stratum, outcome, doubted: pose.doubt.is_some(), words })
}

/// Correct, refused and wrong of each of `STRATA`.
fn evaluate(first: u64, count: u64) -> [[usize; 3]; 3] {
    let runs: Vec<Run> = (first..first + count).into_par_iter().filter_map(run).collect();
    let mut table = [[0usize; 3]; 3];
    for (n, [correct, refused, wrong]) in table.iter_mut().enumerate() {
        let of = |outcome: Outcome| runs.iter().filter(move |run| run.stratum == n && run.outcome == outcome);
        let doubted = |outcome: Outcome| of(outcome).filter(|run| run.doubted).count();
        [*correct, *refused, *wrong] = [Outcome::Correct, Outcome::Refused, Outcome::Wrong].map(|outcome| of(outcome).count());
        of(Outcome::Wrong).for_each(|run| println!("wrong: {}", run.words));
        if n == 0 {
            of(Outcome::Refused).for_each(|run| println!("refused: {}", run.words));
        }
        println!(
            "SUM {}: correct {correct} (in doubt {}) refused {refused} wrong {wrong} (in doubt {})",
            STRATA[n],
            doubted(Outcome::Correct),
            doubted(Outcome::Wrong)
        );
    }
    assert!(table.iter().all(|stratum| stratum.iter().sum::<usize>() > 0), "each stratum has cases: {table:?}");
    table
}

#[test]
fn six_beads_are_found_from_a_prior_that_is_off_among_as_many_false_ones() {
    let [many, some, few] = evaluate(0, 32);
    assert!(many[0] >= 8 && many[1..] == [0, 0], "of six beads and more correct, refused, wrong: {many:?}");
    assert!(some.iter().sum::<usize>() >= 3 && some[2] == 0, "of four and five beads: {some:?}");
    assert!(few[1] >= 3 && few[0] + few[2] == 0, "of three beads and fewer: {few:?}");
}

#[test]
#[ignore = "minutes long: scripts/evaluate prior runs it"]
fn many_priors_that_are_off() {
    let number = |name: &str, default: u64| std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default);
    let [many, some, few] = evaluate(number("SIDECARM_FIRST_SEED", 0), number("SIDECARM_POSES", 5000));
    assert!(1000 * many[0] >= 999 * many.iter().sum::<usize>(), "of six beads and more correct, refused, wrong: {many:?}");
    assert_eq!(some[2], 0, "of four and five beads wrong");
    assert_eq!(few[0] + few[2], 0, "of three beads and fewer accepted");
}
