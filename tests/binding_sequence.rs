//! Pictures off a monitor: no number, no time, and exposures that follow each other within seconds. What tells them is that they follow each
//! other as their exposures do.

use crate::binding_cases::{Came, played_with};
use crate::binding_draw::Truth;
use crate::binding_play::Score;

/// What `came` after these exposures, without stamps and counts.
fn played(exposures: &[(f64, f64)], came: &[Came]) -> Score {
    played_with(exposures, &[], true, came, 1_000_000, &|_| None)
}

/// Exposures so many seconds after each other, of 0.3 s each.
fn exposures(gaps_s: &[f64]) -> Vec<(f64, f64)> {
    let mut at_s = 40.0;
    let mut found = vec![(at_s, at_s + 0.3)];
    for gap_s in gaps_s {
        at_s += gap_s;
        found.push((at_s, at_s + 0.3));
    }
    found
}

/// Times between exposures as a person has them.
const UNEVEN_S: [f64; 15] = [2.0, 3.1, 2.4, 1.7, 2.9, 2.2, 1.8, 2.6, 3.0, 2.1, 2.8, 1.9, 2.5, 1.7, 2.3];

/// Frames of these exposures that come so long after them, within 0.04 s.
fn after(exposures: &[(f64, f64)], of: impl Iterator<Item = usize>, delay_s: f64) -> Vec<Came> {
    of.map(|i| (Truth::Of(i), exposures[i].1 + delay_s + 0.02 * f64::from((i % 3) as u32), None)).collect()
}

/// Not one of them was bound: more than one exposure had ended within six seconds before each.
#[test]
fn pictures_that_follow_each_other_as_their_exposures_do_are_bound() {
    let exposures = exposures(&UNEVEN_S);
    for delay_s in [0.2, 0.9, 1.4, 4.0] {
        let score = played(&exposures, &after(&exposures, 0..16, delay_s));
        assert!(score.wrong.is_empty() && score.bound >= 14, "{delay_s} s: {} bound, {:#?}", score.bound, score.told);
        assert_eq!(score.taken_back, 0);
    }
}

/// The clock's ticks: each picture may as well be of the exposure before.
#[test]
fn pictures_of_exposures_as_even_as_a_clock_stay_ambiguous() {
    let exposures = exposures(&[2.2; 15]);
    for (missing, delay_s) in [(16, 0.9), (0, 0.9), (15, 3.1), (16, 3.1)] {
        let score = played(&exposures, &after(&exposures, (0..16).filter(|i| *i != missing), delay_s));
        assert!(score.bound == 0 && score.wrong.is_empty(), "{missing}, {delay_s} s: {:#?}", score.told);
        assert!(score.told.iter().all(|told| told.contains("ambiguous")), "{:#?}", score.told);
    }
}

/// From the ninth on the pictures come later by just the time between two exposures, which are even from there: each would take the next one's.
#[test]
fn a_delay_that_changes_where_exposures_are_even_gives_no_picture_the_next_exposure() {
    for at in 7..12 {
        let gaps_s: Vec<f64> = (0..24).map(|i| if i < at { UNEVEN_S[i] } else { 2.2 }).collect();
        let exposures = exposures(&gaps_s);
        for from in at..at + 2 {
            let mut came = after(&exposures, 0..from, 0.9);
            came.extend(after(&exposures, from..25, 0.9 + 2.2));
            let score = played(&exposures, &came);
            assert!(score.wrong.is_empty(), "{at}, {from}: {:#?}", score.wrong);
            assert!(score.bound >= 6, "those of before are bound: {:#?}", score.told);
        }
    }
}

/// A picture that is missing, and one of something else just then, a little sooner or later than pictures come, or much later.
#[test]
fn a_stray_in_the_place_of_a_missing_picture_is_not_of_its_exposure() {
    let exposures = exposures(&UNEVEN_S);
    let mut bound = 0;
    for (missing, late_s) in (3..13).flat_map(|missing| [0.78, 1.02, 1.5].map(|late_s| (missing, late_s))) {
        let mut came = after(&exposures, (0..16).filter(|i| *i != missing), 0.9);
        came.push((Truth::Foreign, exposures[missing].1 + late_s, None));
        let score = played(&exposures, &came);
        assert!(score.wrong.is_empty(), "{missing}, {late_s} s: {:#?}", score.wrong);
        bound += score.bound;
    }
    assert!(bound > 0, "others are");
}

/// Pictures that come when they like are not told by it.
#[test]
fn pictures_without_a_common_delay_are_not_bound() {
    let exposures = exposures(&UNEVEN_S);
    let came: Vec<Came> =
        (0..16).map(|i| (Truth::Of(i), exposures[i].1 + 0.3 + 0.37 * f64::from((7 * i as u32) % 11), None)).collect();
    let score = played(&exposures, &came);
    assert!(score.bound == 0 && score.wrong.is_empty(), "{:#?}", score.told);
}
