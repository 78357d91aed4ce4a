//! Is a wrong pose ever accepted, from pictures on? Drawn pictures ([`crate::pose_pictures_case`]) go through masks, beads and registration as
//! in `register` and `live`: `scripts/evaluate pictures`.

use std::collections::BTreeMap;

use rayon::prelude::*;
use sidecarm::geometry::Projection;
use sidecarm::pose::Refusal;

use crate::pose_mistakes::WRONG_PX;
use crate::pose_pictures_case::{Case, Expected, Layout, Mistake, Recipe, case, worst_px};
use crate::pose_pictures_draw::{Looks, Values};
use crate::pose_pictures_scenery::Shutters;
use crate::pose_standing::Accepted;

/// What is expected of pictures that a lab may ask for, by their prior.
const CLEAR: [(&str, &[Expected]); 2] =
    [("near", &[Expected::Right, Expected::RightStated]), ("10 degrees and 30 mm off", &[Expected::Off])];

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Verdict {
    GreenRight,
    GreenWrong,
    AmberRight,
    AmberWrong,
    NothingTells,
    Refused,
}

/// Strips and pairs show a pose with a caution in the colour of one without; a doubt has another.
fn verdict(case: &Case) -> Verdict {
    match (case.pose.is_accepted(), case.is_wrong(), case.pose.doubt.is_some()) {
        (false, _, _) => Verdict::Refused,
        (_, false, false) => Verdict::GreenRight,
        (_, false, true) => Verdict::AmberRight,
        (_, true, true) => Verdict::AmberWrong,
        (_, true, false) if case.nothing_tells => Verdict::NothingTells,
        (_, true, false) => Verdict::GreenWrong,
    }
}

/// What came of some pictures; they add up.
#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    pictures: usize,
    green_right: usize,
    green_wrong: usize,
    /// Of the green and wrong: with a caution.
    cautioned: usize,
    amber_right: usize,
    amber_wrong: usize,
    nothing_tells: usize,
    refused: usize,
}

impl Counts {
    fn add(&mut self, case: &Case) {
        self.pictures += 1;
        match verdict(case) {
            Verdict::GreenRight => self.green_right += 1,
            Verdict::GreenWrong => {
                self.green_wrong += 1;
                self.cautioned += usize::from(!case.pose.cautions.is_empty());
            }
            Verdict::AmberRight => self.amber_right += 1,
            Verdict::AmberWrong => self.amber_wrong += 1,
            Verdict::NothingTells => self.nothing_tells += 1,
            Verdict::Refused => self.refused += 1,
        }
    }
}

/// All that a picture is counted under.
fn classes(recipe: &Recipe) -> Vec<String> {
    let Recipe { layout, mistake, expected, k, has_false, looks, .. } = recipe;
    let quanta = match looks.quanta {
        quanta if quanta < 60.0 => "quanta 6 to 60",
        quanta if quanta < 600.0 => "quanta 60 to 600",
        quanta if quanta < 6000.0 => "quanta 600 to 6000",
        _ => "quanta 6000 to 20000",
    };
    let mut classes = vec![
        format!("layout {layout:?}"),
        format!("mistake {mistake:?}"),
        format!("prior {expected:?}"),
        format!("K {k:?}"),
        format!("values {:?}", looks.values),
        format!("shutters {:?}", looks.shutters),
        quanta.to_owned(),
        format!("noise {}", if looks.is_smoothed { "smoothed" } else { "white" }),
    ];
    let there = [
        (looks.has_pelvis, "with a pelvis"),
        (looks.has_edges, "with bone edges"),
        (looks.has_metal, "with wires, screw, rod"),
        (looks.has_text, "with text"),
        (looks.is_blank_behind && looks.shutters != Shutters::Open, "with blank shutters"),
        (*has_false, "with false shadows"),
    ];
    classes.extend(there.into_iter().filter(|(is_there, _)| *is_there).map(|(_, words)| words.to_owned()));
    classes
}

fn code(case: &Case) -> String {
    case.pose.refusal.as_ref().map(Refusal::code).unwrap_or_default()
}

/// Prints and counts `count` pictures from seed `first`.
fn evaluate(first: u64, count: u64) -> Counts {
    let cases: Vec<Case> = (first..first + count).into_par_iter().map(|seed| case(Recipe::drawn(seed))).collect();
    let mut table: BTreeMap<String, Counts> = BTreeMap::new();
    let mut refusals: BTreeMap<String, usize> = BTreeMap::new();
    let mut all = Counts::default();
    let mut accepted = Accepted::default();
    for case in &cases {
        all.add(case);
        accepted.add(&case.pose, case.is_wrong(), case.nothing_tells);
        classes(&case.recipe).into_iter().for_each(|class| table.entry(class).or_default().add(case));
        let Case { recipe, visible, clear, pose, worst_px, .. } = case;
        let used = pose.beads.iter().filter(|bead| bead.used).count();
        let verdict = verdict(case);
        if matches!(verdict, Verdict::GreenWrong | Verdict::AmberWrong) {
            println!(
                "seed {}: {verdict:?}, landmarks up to {worst_px:.1} px off, {visible} beads visible, {clear} of them clear, {used} used, rms {:.3} px, \
                 {:?}: {recipe:?}",
                recipe.seed,
                pose.rms_px.unwrap_or(f64::NAN),
                pose.cautions
            );
        }
        if verdict == Verdict::Refused {
            *refusals.entry(code(case)).or_default() += 1;
        }
    }
    println!(
        "wrong: landmarks off by over 2 px    green: right  wrong  with a caution  amber: right  wrong  nothing tells  refused  all"
    );
    for (class, counts) in &table {
        let Counts { pictures, green_right, green_wrong, cautioned, amber_right, amber_wrong, nothing_tells, refused } = counts;
        println!(
            "{class:30} {green_right:18} {green_wrong:6} {cautioned:15} {amber_right:13} {amber_wrong:6} {nothing_tells:14} {refused:8} {pictures:5}"
        );
    }
    println!("refusals: {refusals:?}");
    let mut ms: Vec<f64> = cases.iter().map(|case| case.ms).collect();
    ms.sort_by(f64::total_cmp);
    if let Some(worst) = ms.last() {
        println!("registered in {:.0} ms (median), {worst:.0} ms (worst), several at once", ms[ms.len() / 2]);
    }
    let mut of_clear = String::new();
    for (name, priors) in CLEAR {
        let clear: Vec<&Case> = cases.iter().filter(|case| case.is_clear() && priors.contains(&case.recipe.expected)).collect();
        let right = clear.iter().filter(|case| case.pose.is_accepted() && !case.is_wrong()).count();
        let mut refused: BTreeMap<String, usize> = BTreeMap::new();
        for case in clear.iter().filter(|case| !case.pose.is_accepted()) {
            println!("seed {}: refused, {} beads clear: {:?}", case.recipe.seed, case.clear, case.pose.reason);
            *refused.entry(code(case)).or_default() += 1;
        }
        println!(
            "six clear beads, no mistake, K, a prior {name}: {right} of {} accepted and right, refused {refused:?}",
            clear.len()
        );
        let key = if priors.len() == 1 { "clear_off" } else { "clear" };
        of_clear += &format!(" {key} {} {key}_right {right}", clear.len());
    }
    let Counts { pictures, green_right, green_wrong, cautioned, amber_right, amber_wrong, nothing_tells, refused } = all;
    println!("seeds {first} to {}", first + count - 1);
    accepted.lines().iter().for_each(|line| println!("{line}"));
    println!(
        "SUM cases {pictures} green_right {green_right} green_wrong {green_wrong} green_wrong_cautioned {cautioned} amber_right {amber_right} \
         amber_wrong {amber_wrong} nothing_tells {nothing_tells} refused {refused}{of_clear}{}",
        accepted.sums()
    );
    all
}

fn cases(recipes: &[Recipe]) -> Vec<Case> {
    recipes.par_iter().map(|recipe| case(*recipe)).collect()
}

#[test]
fn clear_pictures_give_the_right_pose() {
    let of = |seed: u64, looks: Looks| Recipe { looks, ..Recipe::plain(seed) };
    let plain = Looks::PLAIN;
    let shut = Looks { values: Values::Words, shutters: Shutters::Rectangle, has_metal: true, ..plain };
    let blank = Looks { values: Values::Nepers, shutters: Shutters::Round, is_blank_behind: true, ..plain };
    let shown = Looks { values: Values::Display, has_text: true, is_smoothed: true, ..plain };
    let cases = cases(&[
        Recipe { expected: Expected::RightStated, ..of(1, plain) },
        of(2, shut),
        Recipe { expected: Expected::Off, has_false: true, ..of(3, blank) },
        of(4, shown),
    ]);
    let clear: Vec<&Case> = cases.iter().filter(|case| case.is_clear()).collect();
    assert!(clear.len() >= 3, "beads that are clear: {:?}", cases.iter().map(|case| case.clear).collect::<Vec<_>>());
    for case in clear {
        let is_right = case.pose.is_accepted() && !case.is_wrong();
        assert!(is_right, "seed {}: {} px off, {:?}", case.recipe.seed, case.worst_px, case.pose.reason);
        // The control: a truth that is 3 px elsewhere.
        let (Projection(rows), right_px) = (case.truth, [3.0, 0.0, 0.0]);
        let beside = std::array::from_fn(|n| std::array::from_fn(|m| rows[n][m] + right_px[n] * rows[2][m]));
        assert!(worst_px(&case.pose, &Projection(beside), &case.landmarks) > WRONG_PX, "seed {}", case.recipe.seed);
    }
}

#[test]
fn mistaken_pictures_give_no_wrong_pose_without_a_doubt() {
    let of = |seed: u64, mistake: Mistake, expected: Expected| Recipe { mistake, expected, ..Recipe::plain(seed) };
    let cases = cases(&[
        of(11, Mistake::OtherLayout, Expected::Nowhere),
        Recipe { left: 6, ..of(12, Mistake::Copy, Expected::Nowhere) },
        Recipe { left: 5, ..of(13, Mistake::Ghost, Expected::Right) },
        Recipe { layout: Layout::Flat, ..of(14, Mistake::FrameMirrored, Expected::Right) },
        of(15, Mistake::FrameMirrored, Expected::Nowhere),
        of(16, Mistake::FocalLength, Expected::RightStated),
        of(17, Mistake::LayoutScaled, Expected::RightStated),
        Recipe { layout: Layout::HalfTurn, ..of(18, Mistake::None, Expected::Turned) },
    ]);
    let came: Vec<(u64, Verdict)> = cases.iter().map(|case| (case.recipe.seed, verdict(case))).collect();
    assert!(came.iter().all(|(_, verdict)| *verdict != Verdict::GreenWrong), "{came:?}");
    let unsure = |verdict: Verdict| matches!(verdict, Verdict::Refused | Verdict::AmberRight | Verdict::AmberWrong);
    assert!(came.iter().filter(|(_, verdict)| unsure(*verdict)).count() >= 5, "{came:?}");
}

#[test]
#[ignore = "tens of minutes long: scripts/evaluate pictures runs it"]
fn many_pictures() {
    let number = |name: &str, default: u64| std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default);
    let all = evaluate(number("SIDECARM_FIRST_SEED", 0), number("SIDECARM_PICTURES", 2000));
    assert!(all.pictures > 0 && all.green_wrong == 0, "{} of {} wrong, and nothing doubts them", all.green_wrong, all.pictures);
}
