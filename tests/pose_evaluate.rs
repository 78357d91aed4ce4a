//! Is a wrong pose ever accepted? Drawn registrations ([`crate::pose_mistakes`]), by what came of them: `scripts/evaluate pose`.

use std::collections::BTreeMap;

use rayon::prelude::*;
use sidecarm::pose::Refusal;

use crate::pose_mistakes::{Beads, Case, Expected, K, Mistake, WRONG_PX, case, drawn};
use crate::pose_standing::Accepted;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Verdict {
    Right,
    Refused,
    GreenWrong,
    AmberWrong,
    NothingTells,
}

impl Case {
    /// Strips and pairs show a pose with a caution in the colour of one without; a doubt has another.
    fn verdict(&self) -> Verdict {
        if !self.pose.is_accepted() {
            Verdict::Refused
        } else if self.worst_px <= WRONG_PX {
            Verdict::Right
        } else if self.pose.doubt.is_some() {
            Verdict::AmberWrong
        } else if self.nothing_tells {
            Verdict::NothingTells
        } else {
            Verdict::GreenWrong
        }
    }

    /// What a lab may ask for: no mistake, six beads that are not flat, K, and a prior near the pose.
    fn is_clear(&self) -> bool {
        let solid = matches!(self.beads, Beads::Scattered) && self.visible >= 6 && self.k == K::Known;
        let near = matches!(self.expected, Expected::Near | Expected::NearWithCovariance);
        self.mistake == Mistake::None && solid && near
    }

    /// Of the fixed cases: by the mean error, beyond noise.
    fn is_off(&self) -> bool {
        self.pose.is_accepted() && !(self.error_px <= self.wrong_px) && !self.untold
    }
}

/// What came of some cases; they add up.
#[derive(Clone, Copy, Debug, Default)]
struct Counts {
    cases: usize,
    right: usize,
    refused: usize,
    green_wrong: usize,
    /// Of the green and wrong: with a caution, and off by no more than six times the noise.
    cautioned: usize,
    within_noise: usize,
    amber_wrong: usize,
    nothing_tells: usize,
}

impl Counts {
    fn add(&mut self, case: &Case) {
        self.cases += 1;
        match case.verdict() {
            Verdict::Right => self.right += 1,
            Verdict::Refused => self.refused += 1,
            Verdict::AmberWrong => self.amber_wrong += 1,
            Verdict::NothingTells => self.nothing_tells += 1,
            Verdict::GreenWrong => {
                self.green_wrong += 1;
                self.cautioned += usize::from(!case.pose.cautions.is_empty());
                self.within_noise += usize::from(case.worst_px <= case.wrong_px);
            }
        }
    }
}

/// `count` cases from `first`; gives all their counts, and of those that a lab may ask for the right ones and all.
fn evaluate(first: u64, count: u64) -> (Counts, usize, usize) {
    let cases: Vec<(u64, Case)> =
        (first..first + count).into_par_iter().filter_map(|seed| Some((seed, drawn(seed, true)?))).collect();
    let mut table: BTreeMap<String, Counts> = BTreeMap::new();
    let mut refusals: BTreeMap<String, usize> = BTreeMap::new();
    let mut all = Counts::default();
    let mut accepted = Accepted::default();
    let (mut right, mut clear) = (0, 0);
    for (seed, case) in &cases {
        let Case { beads, mistake, expected, k, visible, pose, worst_px, wrong_px, .. } = case;
        all.add(case);
        accepted.add(pose, !(*worst_px <= WRONG_PX), case.nothing_tells);
        let classes = [format!("{mistake:?}"), format!("K {k:?}"), format!("beads {beads:?}"), format!("prior {expected:?}")];
        classes.into_iter().for_each(|class| table.entry(class).or_default().add(case));
        let verdict = case.verdict();
        if matches!(verdict, Verdict::GreenWrong | Verdict::AmberWrong) {
            println!(
                "seed {seed}: {verdict:?}, landmarks up to {worst_px:.1} px off (six sigma of noise, or 2 px: {wrong_px:.1}): {beads:?}, {mistake:?}, \
                 prior {expected:?}, K {k:?}, {visible} of {} visible, {} used, rms {:.3} px, {:?}",
                pose.beads.len(),
                pose.beads.iter().filter(|bead| bead.used).count(),
                pose.rms_px.unwrap_or(f64::NAN),
                pose.cautions
            );
        }
        if case.is_clear() {
            clear += 1;
            right += usize::from(pose.is_accepted() && worst_px <= wrong_px);
            if !pose.is_accepted() {
                *refusals.entry(pose.refusal.as_ref().map(Refusal::code).unwrap_or_default()).or_default() += 1;
            }
        }
    }
    for k in [K::Known, K::Stated, K::Free] {
        let mut ms: Vec<(f64, u64)> = cases.iter().filter(|(_, case)| case.k == k).map(|(seed, case)| (case.ms, *seed)).collect();
        ms.sort_by(|a, b| a.0.total_cmp(&b.0));
        let Some((worst, slowest)) = ms.last() else { continue };
        let [median, most] = [ms[ms.len() / 2].0, ms[ms.len() * 99 / 100].0];
        println!("K {k:?}: median {median:.1} ms, 99 % {most:.0} ms, worst {worst:.0} ms (seed {slowest})");
    }
    println!(
        "wrong: off by over 2 px     cases  right  refused  green wrong: all  with a caution  within 6 sigma  amber wrong  nothing tells"
    );
    for (class, counts) in &table {
        let Counts { cases, right, refused, green_wrong, cautioned, within_noise, amber_wrong, nothing_tells } = counts;
        println!(
            "{class:26} {cases:6} {right:6} {refused:8} {green_wrong:17} {cautioned:15} {within_noise:15} {amber_wrong:12} {nothing_tells:14}"
        );
    }
    println!("seeds {first} to {}; no mistake, K and a good prior, but refused: {refusals:?}", first + count - 1);
    accepted.lines().iter().for_each(|line| println!("{line}"));
    let Counts { cases, right: all_right, refused, green_wrong, cautioned, within_noise, amber_wrong, nothing_tells } = all;
    println!(
        "SUM cases {cases} green_wrong {green_wrong} amber_wrong {amber_wrong} refused {refused} right {all_right} nothing_tells {nothing_tells} \
         green_wrong_cautioned {cautioned} green_wrong_within_6_sigma {within_noise} clear {clear} clear_right {right}{}",
        accepted.sums()
    );
    (all, right, clear)
}

/// Cases of every kind of layout, mistake and prior, and few of free K, which takes longest.
fn some() -> &'static [Case] {
    static CASES: std::sync::OnceLock<Vec<Case>> = std::sync::OnceLock::new();
    CASES.get_or_init(|| (412..436u64).into_par_iter().chain([440, 456]).filter_map(case).collect())
}

#[test]
fn no_drawn_mistake_gives_a_wrong_pose() {
    let cases = some();
    assert_eq!(cases.iter().filter(|case| case.is_off() && case.pose.doubt.is_none()).count(), 0);
    let clear: Vec<&Case> = cases.iter().filter(|case| case.is_clear()).collect();
    let right = clear.iter().filter(|case| case.pose.is_accepted() && !case.is_off()).count();
    assert!(clear.len() >= 2 && right == clear.len(), "{right} of {}", clear.len());
}

/// A layout that half a turn puts onto itself, under a prior that is turned so: the wrong pose fits, and nothing but the prior speaks for it.
#[test]
fn that_only_a_prior_tells_a_layout_from_itself_is_said() {
    let case = case(7_000_713).expect("drawn");
    assert!(case.pose.is_accepted() && case.error_px > 100.0, "{} px off, {:?}", case.error_px, case.pose.reason);
    assert!(case.pose.cautions.iter().any(|caution| caution.contains("rests on the prior alone")), "{:?}", case.pose.cautions);
}

/// A bead that has moved hides that the others' layout is put onto itself by half a turn, with a turned prior and without one; a second specimen
/// stands behind more false shadows than were looked through; a mirrored grid near its prior.
#[test]
fn a_bead_that_moved_and_a_second_specimen_do_not_hide_what_else_fits() {
    for seed in [10_001_565, 10_003_185, 10_003_931, 10_002_511] {
        let case = case(seed).expect("drawn");
        let is_right = case.pose.is_accepted() && case.error_px <= case.wrong_px;
        assert!(!case.pose.is_accepted() || is_right || case.pose.doubt.is_some(), "seed {seed}: {} px off", case.error_px);
    }
}

/// Five or six beads, flat or close together: they fit, the pose is right as far as they go, and landmarks are pixels off.
#[test]
fn a_pose_that_few_beads_hold_loosely_says_so() {
    for seed in [10_002_355, 11_000_396, 11_000_532] {
        let case = case(seed).expect("drawn");
        assert!(
            case.pose.is_accepted() && case.error_px > case.wrong_px,
            "seed {seed}: {} px off, {:?}",
            case.error_px,
            case.pose.reason
        );
        assert!(case.pose.cautions.iter().any(|caution| caution.contains("loosely")), "seed {seed}: {:?}", case.pose.cautions);
    }
    // Others are not called so.
    let firm = some().iter().filter(|case| case.pose.is_accepted());
    let (loose, all) = firm.fold((0, 0), |(loose, all), case| {
        (loose + usize::from(case.pose.cautions.iter().any(|caution| caution.contains("loosely"))), all + 1)
    });
    assert!(all >= 6 && 2 * loose < all, "{loose} of {all}");
}

/// Mirrored frames of flat layouts whose mirror image is where the prior says, plates with a negated axis, grids and layouts with a half turn
/// under a prior that is turned, a mirrored grid: a wrong reading fitted, and the right one was not looked for.
#[test]
fn the_reading_that_a_prior_or_a_mirror_hides_is_found() {
    for seed in [500_040, 500_065, 500_144, 500_162, 500_292, 530_065, 530_169, 530_359, 530_914] {
        let case = case(seed).expect("drawn");
        let is_right = case.pose.is_accepted() && case.error_px <= case.wrong_px;
        assert!(!case.pose.is_accepted() || is_right, "seed {seed}: {} px off, {:?}", case.error_px, case.pose.cautions);
    }
}

#[test]
#[ignore = "minutes to hours long: scripts/evaluate pose runs it"]
fn many_registrations() {
    let number = |name: &str, default: u64| std::env::var(name).ok().and_then(|text| text.parse().ok()).unwrap_or(default);
    let (all, right, clear) = evaluate(number("SIDECARM_FIRST_SEED", 0), number("SIDECARM_POSES", 50_000));
    assert!(all.cases > 0 && all.green_wrong == 0, "{} of {} wrong, and nothing doubts them", all.green_wrong, all.cases);
    // A part of a run has few of them.
    assert!(clear - right <= (clear / 1000).max(1), "{right} of {clear}");
}
