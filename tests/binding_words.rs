//! What is told of a frame that is bound, or not: ambiguous, contradictory, dropped.

use crate::binding_cases::{AHEAD_S, Came, calm, played, played_with, us};
use crate::binding_draw::Truth;

/// Whether the frame of which this was told has no exposure.
fn is_unbound(told: &str) -> bool {
    told.contains(": None ")
}

/// Whole seconds fit both of two exposures within a second. Finer stamps, and exposures farther apart, leave one.
#[test]
fn a_stamp_that_fits_two_exposures_is_said_to_be_ambiguous_and_one_that_fits_one_is_not() {
    for (apart_s, resolution_us, ambiguous) in [(0.6, 1_000_000, true), (0.6, 1000, false), (3.0, 1_000_000, false)] {
        let mut exposures = calm(8);
        exposures.extend([(200.0, 200.2), (200.0 + apart_s, 200.2 + apart_s)]);
        // Of the first of the two there is no picture, and none has a count.
        let came: Vec<Came> = (0..10).filter(|i| *i != 8).map(|i| (Truth::Of(i), exposures[i].1 + 1.5, None)).collect();
        let unit_us = resolution_us as f64;
        let stamp = |at_s: f64| Some(us(((at_s + AHEAD_S) * 1e6 / unit_us).floor() * unit_us * 1e-6));
        let score = played_with(&exposures, &[], true, &came, resolution_us, &stamp);
        let last = &score.told[8];
        assert_eq!(last.contains("the console's stamp fits 2 exposures: ambiguous"), ambiguous, "{apart_s} s: {last}");
        assert_eq!(is_unbound(last), ambiguous, "{apart_s} s: {last}");
        assert!(score.wrong.is_empty() && score.bound >= 8, "{} bound, {:#?}", score.bound, score.wrong);
        let others = score.told[..8].iter().filter(|told| told.contains("ambiguous")).count();
        assert_eq!(others, 0, "{:#?}", score.told);
    }
}

/// Frames that say nothing of themselves, the last of them in doubt or not.
#[test]
fn an_arrival_that_leaves_a_doubt_is_said_to_be_ambiguous_and_one_as_usual_is_not() {
    // How long after the one before it the last exposure is, how long after that its frame comes, whether a second picture comes
    // later; of which frame is spoken, and what is told of it.
    let cases = [
        (17.0, 1.5, false, 13, "and no other was near", false),
        (3.0, 1.5, false, 13, "frames around it came 1.", false),
        (3.0, 2.2, false, 13, "2 exposures ended within 6.000 s before the frame arrived: ambiguous", true),
        (17.0, 1.5, true, 14, "several frames came after exposure 14: ambiguous", true),
        (17.0, 4.0, false, 13, "s after exposure 14, others come after ", true),
    ];
    for (apart_s, late_s, second, spoken_of, words, ambiguous) in cases {
        let mut exposures = calm(13);
        let at_s = exposures[12].1 + apart_s;
        exposures.push((at_s, at_s + 0.3));
        let mut came: Vec<Came> = (0..13).map(|i| (Truth::Of(i), exposures[i].1 + 1.5, None)).collect();
        came.push((Truth::Of(13), exposures[13].1 + late_s, None));
        if second {
            came.push((Truth::SecondOf(13), exposures[13].1 + late_s + 2.0, None));
        }
        let score = played(&exposures, &[], true, false, &came);
        let told = &score.told[spoken_of];
        assert!(told.contains(words) && is_unbound(told) == ambiguous, "'{words}': {told}");
        assert!(score.wrong.is_empty(), "{:#?}", score.wrong);
        let doubtful: Vec<&String> = score.told.iter().filter(|told| told.contains(": ambiguous")).collect();
        let expected: Vec<&String> = score.told[spoken_of..].iter().filter(|_| ambiguous).collect();
        assert_eq!(doubtful, expected, "nothing of the others");
    }
}

/// The fifth exposure's frame comes late: after the last exposure, which has no frame of its own or has one, or when none is near.
#[test]
fn a_count_and_an_arrival_that_name_two_exposures_are_said_to_be_ambiguous() {
    let exposures = calm(11);
    let prompt: Vec<Came> =
        (0..10).filter(|i| *i != 4).map(|i| (Truth::Of(i), exposures[i].1 + 1.5, Some(i as u32 + 1))).collect();
    for (late_s, own, ambiguous) in [(0.4, false, true), (0.4, true, false), (9.0, false, false)] {
        let mut came = prompt.clone();
        came.push((Truth::Of(4), exposures[10].1 + late_s, Some(5)));
        if own {
            came.push((Truth::Of(10), exposures[10].1 + 1.5, Some(11)));
        }
        let score = played(&exposures, &[], true, false, &came);
        let late = &score.told[9];
        let words = match ambiguous {
            true => "the counter names exposure 5, the arrival exposure 11: ambiguous",
            false => "counter 5 names exposure 5, between frames with the same count",
        };
        assert!(late.contains(words) && is_unbound(late) == ambiguous, "{late_s} s, own {own}: {late}");
        let all = score.told.iter().filter(|told| told.contains(": ambiguous")).count();
        assert_eq!(all, usize::from(ambiguous), "{:#?}", score.told);
        assert!(score.wrong.is_empty() && score.bound >= 9, "{} bound, {:#?}", score.bound, score.wrong);
    }
}

/// A counter that begins anew contradicts the stamp of the first frame after it, until that one has taught it. One that goes on
/// contradicts nothing.
#[test]
fn a_count_that_contradicts_the_stamp_is_said_to_be_dropped_where_it_does() {
    let exposures = calm(10);
    for anew in [true, false] {
        let count = |i: usize| if anew && i >= 6 { i as u32 - 5 } else { i as u32 + 1 };
        let came: Vec<Came> = (0..10).map(|i| (Truth::Of(i), exposures[i].1 + 1.5, Some(count(i)))).collect();
        let score = played(&exposures, &[], true, true, &came);
        let dropped = "the counter contradicts the stamp and is dropped for this frame";
        let said: Vec<usize> = (0..10).filter(|i| score.told[*i].contains(dropped)).collect();
        assert_eq!(said, if anew { vec![6] } else { Vec::new() }, "{:#?}", score.told);
        assert!(score.wrong.is_empty() && score.bound == 10, "{} bound, {:#?}", score.bound, score.wrong);
    }
}

/// A late frame with the stamp of the third exposure, whose count is that of the fifth, of the third as well, or none.
#[test]
fn a_count_that_surely_names_another_exposure_than_the_stamp_leaves_the_frame_unbound() {
    let exposures = calm(10);
    let others = (0..10).filter(|i| ![2, 4].contains(i));
    let prompt: Vec<Came> = others.map(|i| (Truth::Of(i), exposures[i].1 + 1.5, Some(i as u32 + 1))).collect();
    let cases = [
        (Some(5), "the console's stamp points to exposure 3, the counter to exposure 5: contradictory", true),
        (Some(3), "counter and stamp both name exposure 3", false),
        (None, "exposure 3 is the only exposure that the console's stamp fits", false),
    ];
    for (count, words, contradictory) in cases {
        let mut came = prompt.clone();
        came.push((Truth::Of(2), exposures[9].1 + 20.0, count));
        let score = played(&exposures, &[], true, true, &came);
        let late = &score.told[8];
        assert!(late.contains(words) && is_unbound(late) == contradictory, "{count:?}: {late}");
        let all = score.told.iter().filter(|told| told.contains("contradict")).count();
        assert_eq!(all, usize::from(contradictory), "{:#?}", score.told);
        assert!(score.wrong.is_empty() && score.bound >= 8, "{} bound, {:#?}", score.bound, score.wrong);
    }
}

/// An hour of the zone stood in what was said of a clock that is two seconds off.
#[test]
fn the_zone_is_said_apart_from_what_the_clock_is_off() {
    let exposures = calm(8);
    let came: Vec<Came> = (0..8).map(|i| (Truth::Of(i), exposures[i].1 + 1.5, None)).collect();
    for (ahead_s, words) in [
        (3602.0, " s ahead of the host's if its zone is UTC+01:00, which no file states, from "),
        (1500.0, " s ahead of the host's, zone and all, from "),
    ] {
        let score = played_with(&exposures, &[], true, &came, 1000, &|at_s| Some(us(at_s + ahead_s)));
        let told: Vec<&String> = score.told.iter().filter(|told| told.contains("(its clock is ")).collect();
        assert!(!told.is_empty() && told.iter().all(|told| told.contains(words)), "{words}: {:#?}", score.told);
        assert!(score.wrong.is_empty() && score.bound == 8, "{} bound, {:#?}", score.bound, score.wrong);
    }
}
