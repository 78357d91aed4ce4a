//! Single situations in which a frame once was, or could be, given the exposure beside its own.

use sidecarm::timeline::FrameEvidence;

use crate::binding_draw::{Draw, Exposed, Sent, Session, Truth, samples};
use crate::binding_play::{Score, play};
use crate::timeline_joints::T0_US;

/// Seconds by which the console's clock is ahead of the host's.
pub const AHEAD_S: f64 = 240.07;

pub fn us(seconds: f64) -> i64 {
    T0_US + (seconds * 1e6).round() as i64
}

/// A frame: what it is, arrival (s; infinite: exported afterwards), the console's counter; its stamp in whole seconds follows from its exposure, a stray has none.
pub type Came = (Truth, f64, Option<u32>);

/// A session by hand; the C-arm counts from 1 if `counted`, frames have stamps if `stamped`.
pub fn played(exposures_s: &[(f64, f64)], holes: &[(f64, f64)], counted: bool, stamped: bool, came: &[Came]) -> Score {
    played_with(exposures_s, holes, counted, came, 1_000_000, &|at_s| stamped.then(|| us((at_s + AHEAD_S).floor())))
}

/// The same; `stamp` is what the console writes at a time in s, to `resolution_us`.
pub fn played_with(
    exposures_s: &[(f64, f64)],
    holes: &[(f64, f64)],
    counted: bool,
    came: &[Came],
    resolution_us: i64,
    stamp: &dyn Fn(f64) -> Option<i64>,
) -> Score {
    played_at(exposures_s, holes, counted, came, (resolution_us, None, 25.0), stamp)
}

/// The same; pictures of something else have the second stamp, the C-arm sends at the third number, Hz.
pub fn played_at(
    exposures_s: &[(f64, f64)],
    holes: &[(f64, f64)],
    counted: bool,
    came: &[Came],
    (resolution_us, foreign, rate_hz): (i64, Option<i64>, f64),
    stamp: &dyn Fn(f64) -> Option<i64>,
) -> Score {
    let mut draw = Draw::new(1, 0);
    let counter = |index: usize| index as u32 + 1;
    let end_s = exposures_s.iter().fold(0.0f64, |end, exposure| end.max(exposure.1)) + 30.0;
    let samples = samples(&mut draw, exposures_s, end_s, rate_hz, counted.then_some(&counter), 0, holes);
    let exposures = exposures_s.iter().enumerate().map(|(index, (start, end))| Exposed {
        start_us: us(*start),
        end_us: us(*end),
        counter: counted.then(|| counter(index)),
    });
    let mut came: Vec<&Came> = came.iter().collect();
    came.sort_by(|a, b| a.1.total_cmp(&b.1));
    let frames = came.iter().enumerate().map(|(number, (truth, arrival_s, counter))| Sent {
        evidence: FrameEvidence {
            frame: number as u32,
            content: format!("{number:064x}"),
            image_of_file: [0, 1],
            counter: *counter,
            console_us: match truth {
                Truth::Of(index) | Truth::SecondOf(index) => stamp(exposures_s[*index].0),
                Truth::Copy | Truth::Foreign => foreign,
            },
            console_resolution_us: resolution_us,
            // What never came was exported afterwards.
            arrival_us: arrival_s.is_finite().then(|| us(*arrival_s)),
            frame_time_us: None,
            image_times_us: Vec::new(),
            stated_length_us: None,
            last_image: false,
            completes: None,
        },
        truth: *truth,
        late: false,
        twin: false,
    });
    play(&Session { described: "by hand".to_owned(), exposures: exposures.collect(), samples, frames: frames.collect() })
}

/// Exposures far apart, whose prompt frames teach the console's offset.
pub fn calm(count: usize) -> Vec<(f64, f64)> {
    (0..count)
        .map(|i| (i as f64, 17.0 * i as f64 + 0.13 * (i * i) as f64))
        .map(|(i, at)| (at + 10.0, at + 10.3 + 0.01 * i))
        .collect()
}

#[test]
fn a_frame_that_came_during_a_silence_does_not_push_its_neighbours_aside() {
    for counted in [true, false] {
        for phase in 0..10 {
            let mut exposures = calm(6);
            let at = exposures[5].0.floor() + 30.0 + 0.1 * f64::from(phase);
            // Three in a burst, of which the first has no frame yet; then telemetry falls silent and a fourth is not seen.
            exposures.extend([(0.709, 1.181), (1.579, 2.053), (2.303, 2.541), (3.192, 3.565)].map(|(a, b)| (at + a, at + b)));
            exposures.extend([(45.0, 45.3), (70.2, 70.6), (97.6, 98.0)].map(|(a, b)| (at + a, at + b)));
            let mut came: Vec<Came> =
                (0..13).filter(|i| *i != 6).map(|i| (Truth::Of(i), exposures[i].1 + 2.4, Some(1))).collect();
            came.push((Truth::Of(6), at + 120.0, Some(1)));
            let score = played(&exposures, &[(at + 2.896, at + 18.494)], counted, true, &came);
            assert!(score.wrong.is_empty(), "{:#?}", score.wrong);
            assert!(score.frames >= 12 && score.bound >= 9, "{} of {} bound", score.bound, score.frames);
        }
    }
}

#[test]
fn a_counter_seen_once_since_it_began_anew_does_not_choose_between_neighbours() {
    for phase in 0..10 {
        let mut exposures = calm(6);
        let at = exposures[5].0.floor() + 30.0 + 0.1 * f64::from(phase);
        // The counter begins anew at the first of the burst, and again at the second, whose frame is not stored.
        exposures.extend([(0.2, 0.8), (1.6, 1.9), (2.5, 2.95)].map(|(a, b)| (at + a, at + b)));
        let counters = [1, 2, 3, 4, 5, 6, 1, 1, 2];
        let came: Vec<Came> =
            (0..9).filter(|i| *i != 7).map(|i| (Truth::Of(i), exposures[i].1 + 1.5, Some(counters[i]))).collect();
        let score = played(&exposures, &[], true, true, &came);
        assert!(score.wrong.is_empty(), "{:#?}", score.wrong);
        assert!(score.bound >= 6, "{} of {} bound", score.bound, score.frames);
    }
}

#[test]
fn the_first_picture_without_stamp_and_counter_is_not_told_by_its_arrival() {
    let exposures = calm(8);
    // The first exposure's own frame comes late; before it, a picture of something else.
    let mut came: Vec<Came> = (1..8).map(|i| (Truth::Of(i), exposures[i].1 + 1.5, None)).collect();
    came.extend([(Truth::Foreign, exposures[0].1 + 1.8, None), (Truth::Of(0), 200.0, None)]);
    let score = played(&exposures, &[], false, true, &came);
    assert!(score.wrong.is_empty() && score.bound == 8, "{} bound, {:#?}", score.bound, score.wrong);
}

#[test]
fn frames_of_an_orderly_session_are_bound_when_they_come() {
    // As the demo's: the counter is the C-arm's, exposures follow each other within a second or two, each frame before the next exposure.
    let starts_s = [10.8, 11.8, 12.9, 13.9, 15.7, 16.6, 17.5, 18.8];
    let exposures = starts_s.map(|start_s| (start_s, start_s + 0.3));
    let came: Vec<Came> = (0..8).map(|i| (Truth::Of(i), exposures[i].1 + 0.35, Some(i as u32 + 1))).collect();
    let score = played(&exposures, &[], true, true, &came);
    assert!(score.wrong.is_empty(), "{:#?}", score.wrong);
    assert_eq!((score.frames, score.in_time), (8, 8), "all bound when developed");
}

#[test]
fn a_counter_of_stored_pictures_does_not_name_the_exposure_without_one() {
    // The console counts what it stores. Within a quick run one exposure has no picture; every later count is one less.
    let mut exposures = calm(6);
    let at = exposures[5].0 + 30.0;
    exposures.extend((0..8).map(|i| (at + 2.0 * f64::from(i), at + 2.0 * f64::from(i) + 0.4)));
    let stored: Vec<usize> = (0..14).filter(|i| *i != 8).collect();
    // Each comes after the next exposure.
    let came: Vec<Came> = stored.iter().zip(1..).map(|(i, count)| (Truth::Of(*i), exposures[*i].1 + 2.3, Some(count))).collect();
    for counted in [true, false] {
        let score = played(&exposures, &[], counted, false, &came);
        assert!(score.wrong.is_empty() && score.bound >= 6, "{} bound, {:#?}", score.bound, score.wrong);
    }
}

#[test]
fn an_exposure_that_ends_in_a_silence_may_have_another_behind_it() {
    // The C-arm does not count. Two exposures in a hole, two after it, a third of which the end falls into a second hole with a fourth.
    for phase in 0..10 {
        let mut exposures = calm(10);
        let at = exposures[9].0.floor() + 60.0 + 0.1 * f64::from(phase);
        let burst = [(0.0, 0.4), (0.9, 1.2), (2.0, 2.6), (2.83, 3.38), (4.09, 4.6), (5.1, 5.6), (29.5, 29.7), (38.6, 38.8)];
        exposures.extend(burst.map(|(a, b)| (at + a, at + b)));
        let came: Vec<Came> = (0..18).map(|i| (Truth::Of(i), exposures[i].1 + 1.5, Some(i as u32 + 1))).collect();
        let score = played(&exposures, &[(at - 0.5, at + 1.7), (at + 4.2, at + 7.1)], false, true, &came);
        assert!(score.wrong.is_empty(), "{:#?}", score.wrong);
        assert!(score.bound >= 10, "{} of {} bound", score.bound, score.frames);
    }
}

#[test]
fn two_frames_with_one_count_after_one_exposure_leave_it_open() {
    // The counter begins anew at the seventh; the older frames with the same counts come late, in a batch, right after the eighth.
    let exposures = calm(16);
    let count = |i: usize| if i < 6 { i as u32 + 1 } else { i as u32 - 5 };
    let mut came: Vec<Came> =
        (6..16).map(|i| (Truth::Of(i), exposures[i].1 + if i == 8 { 2.9 } else { 2.5 }, Some(count(i)))).collect();
    came.extend((1..4).map(|i| (Truth::Of(i), exposures[8].1 + 2.6 + 0.05 * i as f64, Some(count(i)))));
    let score = played(&exposures, &[], true, false, &came);
    assert!(score.wrong.is_empty() && score.bound >= 8, "{} bound, {:#?}", score.bound, score.wrong);
}

#[test]
fn a_console_that_stamps_beginnings_tells_a_quick_run_apart() {
    // Nothing but stamps of whole seconds, and exposures of which two fit most of them, whatever instant they name.
    for phase in 0..10 {
        let mut exposures = calm(30);
        let at = exposures[29].0.floor() + 30.0 + 0.1 * f64::from(phase);
        exposures.extend((0..6).map(|i| at + 1.25 * f64::from(i)).map(|at| (at, at + 0.5)));
        let came: Vec<Came> = (0..36).filter(|i| *i != 33).map(|i| (Truth::Of(i), exposures[i].1 + 1.5, Some(1))).collect();
        let score = played(&exposures, &[], true, true, &came);
        assert!(score.wrong.is_empty(), "{:#?}", score.wrong);
        assert!(score.bound >= 34, "{} of {} bound", score.bound, score.frames);
    }
}

#[test]
fn a_counter_is_learnt_from_quick_runs_alone() {
    // No stamps, no exposure alone: each of a run's frames comes after the next exposures. The late ones come in a batch, some of them
    // right after an exposure.
    let exposures: Vec<(f64, f64)> = (0..48)
        .map(|i| (i / 4, i % 4))
        .map(|(run, nth)| {
            10.0 + 31.0 * f64::from(run) + 0.7 * f64::from(run * run % 5) + (1.1 + 0.05 * f64::from(run % 3)) * f64::from(nth)
        })
        .map(|at| (at, at + 0.4))
        .collect();
    for counted in [true, false] {
        let late = |i: usize| (12..20).contains(&i);
        let arrival = |i: usize| {
            if late(i) { exposures[30].1 + 0.5 + 0.05 * i as f64 } else { exposures[i].1 + 2.2 + 0.1 * (i % 4) as f64 }
        };
        let came: Vec<Came> = (0..48).map(|i| (Truth::Of(i), arrival(i), Some(i as u32 + 41))).collect();
        let score = played(&exposures, &[], counted, false, &came);
        assert!(score.wrong.is_empty(), "{:#?}", score.wrong);
        assert!(score.bound >= 40, "{} of {} bound", score.bound, score.frames);
    }
}

#[test]
fn a_clock_set_within_a_run_does_not_move_its_frames_to_their_neighbours() {
    // The C-arm counts, the console counts three more. At the middle of a quick run its clock is set back by about one exposure.
    for back in [0.9, 1.0, 1.1, 1.2, 1.3] {
        let mut exposures = calm(6);
        let at = exposures[5].0 + 30.0;
        let starts = [0.0, 1.6, 2.9, 5.4, 7.1, 10.0, 11.2, 13.9, 15.1, 17.7, 18.8, 21.4, 23.6, 26.4];
        exposures.extend(starts.map(|start| (at + start, at + start + 0.5)));
        let set = |at_s: f64| if at_s > at + 9.0 { back } else { 0.0 };
        let stamp = |at_s: f64| Some(us(at_s + AHEAD_S - set(at_s)));
        let came: Vec<Came> = (0..20).map(|i| (Truth::Of(i), exposures[i].1 + 0.8, Some(i as u32 + 4))).collect();
        let score = played_with(&exposures, &[], true, &came, 1, &stamp);
        assert!(score.wrong.is_empty(), "{back}: {:#?}", score.wrong);
        assert!(score.bound >= 10, "{back}: {} of {} bound", score.bound, score.frames);
    }
}

#[test]
fn an_equal_number_proves_nothing_while_an_earlier_exposure_waits() {
    // The console counts one more than the C-arm, and the first picture comes late, right after the exposure that has its number.
    let exposures = calm(8);
    let mut came: Vec<Came> = (2..8).map(|i| (Truth::Of(i), exposures[i].1 + 1.5, Some(i as u32 + 2))).collect();
    came.push((Truth::Of(0), exposures[1].1 + 1.4, Some(2)));
    let score = played(&exposures, &[], true, false, &came);
    assert!(score.wrong.is_empty() && score.bound >= 5, "{} bound, {:#?}", score.bound, score.wrong);
}

#[test]
fn a_late_frame_is_not_bound_by_a_count_that_a_new_start_has_reached() {
    // The second exposure has no picture; the counter begins anew at the eighth, whose second picture comes late.
    let exposures = calm(20);
    let count = |i: usize| if i < 8 { i as u32 + 1 } else { i as u32 - 7 };
    let mut came: Vec<Came> =
        (0..20).filter(|i| ![1, 8, 9].contains(i)).map(|i| (Truth::Of(i), exposures[i].1 + 1.5, Some(count(i)))).collect();
    came.push((Truth::Of(9), exposures[9].1 + 8.0, Some(2)));
    let score = played(&exposures, &[], true, false, &came);
    assert!(score.wrong.is_empty() && score.bound >= 14, "{} bound, {:#?}", score.bound, score.wrong);
}

#[test]
fn a_missing_picture_does_not_move_all_later_frames_to_the_exposure_before() {
    // The console counts what it stores: nothing of the fourth, and exposures follow each other within two seconds.
    let exposures: Vec<(f64, f64)> =
        (0..24).map(|i| 20.0 + 1.9 * f64::from(i) + 0.3 * f64::from(i * i % 4)).map(|at| (at, at + 0.4)).collect();
    let stored = (0..24).filter(|i| *i != 3);
    let came: Vec<Came> = stored.zip(1..).map(|(i, count)| (Truth::Of(i), exposures[i].1 + 1.2, Some(count))).collect();
    let score = played(&exposures, &[], true, false, &came);
    assert!(score.wrong.is_empty(), "{:#?}", score.wrong);
}

#[test]
fn one_picture_too_few_and_one_too_many_do_not_name_the_exposure_between() {
    // The console counts what it stores: nothing of the twelfth, the fifteenth twice, and between them counts are one less. The fifteenth's
    // own picture has the count that the fourteenth's would have, which came late, as its second picture did.
    let mut exposures = calm(20);
    exposures[14] = (exposures[13].1 + 3.3, exposures[13].1 + 3.6);
    let mut came: Vec<Came> = Vec::new();
    let mut count = 0;
    for i in (0..20).filter(|i| *i != 11) {
        count += 1;
        let delay_s = if i == 12 { 12.0 } else { 0.4 };
        came.push((Truth::Of(i), exposures[i].1 + delay_s, Some(count)));
        if [3, 6, 14].contains(&i) {
            count += 1;
            came.push((Truth::SecondOf(i), exposures[i].1 + 3.8, Some(count)));
        }
    }
    let score = played(&exposures, &[], true, false, &came);
    assert!(score.wrong.is_empty() && score.bound >= 10, "{} bound, {:#?}", score.bound, score.wrong);
}

/// The summary of a session whose console stores a processed picture beside each raw one asked whether they were of another day.
#[test]
fn a_second_picture_is_told_from_one_that_fits_nothing() {
    let exposures = calm(8);
    let mut came: Vec<Came> = (0..8).map(|i| (Truth::Of(i), exposures[i].1 + 1.5, Some(i as u32 + 1))).collect();
    came.extend((0..8).map(|i| (Truth::SecondOf(i), exposures[i].1 + 2.9, Some(i as u32 + 1))));
    came.push((Truth::Foreign, exposures[7].1 + 9.0, None));
    let score = played(&exposures, &[], true, true, &came);
    assert!(score.wrong.is_empty() && score.bound >= 7, "{} bound, {:#?}", score.bound, score.wrong);
    let unbound: Vec<&String> = score.told.iter().filter(|told| told.contains(": None ")).collect();
    let (second, other): (Vec<&String>, Vec<&String>) =
        unbound.iter().copied().partition(|told| told.contains("a second picture of the exposure that frame"));
    assert!(second.len() >= 6, "{unbound:#?}");
    assert!(
        other.iter().any(|told| told.contains("Foreign")) && !second.iter().any(|told| told.contains("Foreign")),
        "{unbound:#?}"
    );
}

#[test]
fn a_count_of_one_that_has_not_moved_is_no_exposures_number() {
    // The console writes 1 always; right after the first exposure a picture of half an hour ago comes, then the exposure's own.
    let exposures = calm(8);
    let mut came: Vec<Came> = (0..8).map(|i| (Truth::Of(i), exposures[i].1 + 1.5, Some(1))).collect();
    came.push((Truth::Foreign, exposures[0].1 + 0.3, Some(1)));
    let stamp = |at_s: f64| Some(us((at_s + AHEAD_S).floor()));
    let score = played_at(&exposures, &[], true, &came, (1_000_000, stamp(-1800.0), 25.0), &stamp);
    assert!(score.wrong.is_empty() && score.bound == 8, "{} bound, {:#?}", score.bound, score.wrong);
}

#[test]
fn a_picture_of_another_room_is_told_by_its_count() {
    // Both consoles keep the same time; the other room's picture has a stamp that fits the tenth exposure, whose own comes later.
    let exposures = calm(14);
    let mut came: Vec<Came> =
        (0..14).filter(|i| *i != 9).map(|i| (Truth::Of(i), exposures[i].1 + 1.5, Some(i as u32 + 6))).collect();
    came.push((Truth::Foreign, exposures[9].1 + 1.2, Some(71)));
    came.push((Truth::Of(9), exposures[9].1 + 1.9, Some(15)));
    let stamp = |at_s: f64| Some(us((at_s + AHEAD_S).floor()));
    let score = played_at(&exposures, &[], true, &came, (1_000_000, stamp(exposures[9].0), 25.0), &stamp);
    assert!(score.wrong.is_empty() && score.bound == 14, "{} bound, {:#?}", score.bound, score.wrong);
    let contradictory =
        "the console's stamp fits exposure 10, but its counter never began anew and is at another number: contradictory";
    for told in &score.told {
        assert_eq!(told.contains(contradictory), told.contains("Foreign"), "{told}");
    }
}

/// A picture that was exported again just then, with the export's time for a stamp, took an exposure whose own came later.
#[test]
fn a_picture_that_came_sooner_than_all_others_do_is_not_of_the_exposure_that_its_stamp_names() {
    let exposures = calm(14);
    let stamp = |at_s: f64| Some(us((at_s + AHEAD_S).floor()));
    for late_s in [-0.1, 0.3] {
        let mut came: Vec<Came> = (0..14).map(|i| (Truth::Of(i), exposures[i].1 + 1.5, None)).collect();
        came.push((Truth::Foreign, exposures[9].1 + late_s, None));
        let score = played_at(&exposures, &[], true, &came, (1_000_000, stamp(exposures[9].0), 25.0), &stamp);
        assert!(score.wrong.is_empty() && score.bound == 14, "{late_s} s: {} bound, {:#?}", score.bound, score.told);
        let sooner = score.told.iter().find(|told| told.contains("Foreign")).expect("it came");
        assert!(late_s < 0.0 || sooner.contains("others come after"), "{sooner}");
    }
}

#[test]
fn stamps_that_name_a_series_are_not_used() {
    // Four exposures four seconds apart carry the time of the first; its own picture, in the third series, is missing.
    let exposures: Vec<(f64, f64)> =
        (0..24).map(|i| 10.0 + 4.1 * f64::from(i) + 20.0 * f64::from(i / 4)).map(|at| (at, at + 0.4)).collect();
    let stamp = |at_s: f64| {
        exposures.iter().rposition(|exposure| exposure.0 <= at_s).map(|i| us((exposures[i / 4 * 4].0 + AHEAD_S).floor()))
    };
    for counter in [None, Some(40)] {
        let came: Vec<Came> = (0..24)
            .filter(|i| *i != 8)
            .map(|i| (Truth::Of(i), exposures[i].1 + 0.9, counter.map(|from| from + i as u32)))
            .collect();
        let score = played_with(&exposures, &[], true, &came, 1_000_000, &stamp);
        assert!(score.wrong.is_empty(), "{counter:?}: {:#?}", score.wrong);
        assert!(counter.is_none() || score.bound >= 20, "{} of {} bound", score.bound, score.frames);
    }
}

#[test]
fn an_even_rhythm_does_not_keep_a_console_that_agrees_with_the_carm_from_being_believed() {
    // Exposures every two seconds: what each frame says fits the exposure before as well, with another offset and another count.
    let exposures: Vec<(f64, f64)> = (0..6).map(|i| 12.0 + 2.0 * f64::from(i)).map(|at| (at, at + 0.2)).collect();
    let frame = |i: usize| (Truth::Of(i), exposures[i].1 + 0.3, Some(i as u32 + 1));
    let host = |at_s: f64| Some(us(at_s));
    for missing in 0..3 {
        // One exposure has no frame; then one has a picture without stamp and count.
        let came: Vec<Came> = (0..6).filter(|i| *i != missing).map(frame).collect();
        let score = played_with(&exposures, &[], true, &came, 1000, &host);
        assert!(score.wrong.is_empty() && score.bound == 5, "{missing}: {} bound, {:#?}", score.bound, score.wrong);
        let mut with_foreign = came.clone();
        with_foreign.push((Truth::Foreign, exposures[missing].1 + 0.3, None));
        let score = played_with(&exposures, &[], true, &with_foreign, 1000, &host);
        assert!(score.wrong.is_empty() && score.bound == 5, "{missing}: {} bound, {:#?}", score.bound, score.wrong);
    }
    // A console that stores one picture less and whose clock is an exposure behind: its own count and time are those of the exposure before.
    let came: Vec<Came> = (1..6).map(|i| (Truth::Of(i), exposures[i].1 + 0.3, Some(i as u32))).collect();
    let score = played_with(&exposures, &[], true, &came, 1000, &|at_s| Some(us(at_s - 2.0)));
    assert!(score.wrong.is_empty(), "{:#?}", score.wrong);
}

#[test]
fn a_few_late_frames_of_a_console_that_keeps_the_time_find_their_exposures() {
    // Six exposures in an even rhythm, every frame after the next two or three; the last one shows that the console is not behind.
    let exposures: Vec<(f64, f64)> = (0..6).map(|i| 8.0 + 2.2 * f64::from(i)).map(|at| (at, at + 0.3)).collect();
    for late_s in [5.7, 6.5, 30.0, f64::INFINITY] {
        let came = |counted: bool| -> Vec<Came> {
            (0..6).map(|i| (Truth::Of(i), exposures[i].1 + late_s, counted.then_some(i as u32 + 1))).collect()
        };
        for (counted, zone_s, resolution_us) in
            [(true, 0.0, 1000), (true, 7200.0, 1_000_000), (false, 0.0, 1000), (false, -18000.0, 1_000_000)]
        {
            let stamp =
                |at_s: f64| Some(us(((at_s + zone_s) * 1e6 / resolution_us as f64).floor() * resolution_us as f64 * 1e-6));
            let score = played_with(&exposures, &[], true, &came(counted), resolution_us, &stamp);
            let all = score.wrong.is_empty() && score.bound == 6;
            assert!(all, "{late_s} s, {counted}, {zone_s}: {} bound, {:#?} {:#?}", score.bound, score.wrong, score.told);
            // The same pictures if the clock is an exposure ahead or behind and the first or the last exposure has none.
            for (behind, missing) in [(1, 0), (-1, 5)] {
                let came: Vec<Came> = (0..6usize)
                    .filter(|i| *i != missing)
                    .map(|i| (Truth::Of(i), exposures[i].1 + late_s, counted.then_some((i as i32 + 1 - behind) as u32)))
                    .collect();
                let off = |at_s: f64| stamp(at_s - 2.2 * f64::from(behind));
                let score = played_with(&exposures, &[], true, &came, resolution_us, &off);
                assert!(score.wrong.is_empty(), "{late_s} s, {counted}, {behind}: {:#?}", score.wrong);
            }
        }
    }
}

#[test]
fn pictures_of_another_day_do_not_keep_a_console_from_being_believed() {
    // Two of yesterday's among the late ones, with the same counts.
    let exposures: Vec<(f64, f64)> = (0..8).map(|i| 8.0 + 2.2 * f64::from(i)).map(|at| (at, at + 0.3)).collect();
    let mut came: Vec<Came> = (0..8).map(|i| (Truth::Of(i), exposures[i].1 + 6.5, Some(i as u32 + 1))).collect();
    came.extend([(Truth::Foreign, 20.0, Some(1)), (Truth::Foreign, 21.5, Some(2))]);
    let yesterday = Some(us(-86_400.0 + 11.0));
    let score = played_at(&exposures, &[], true, &came, (1000, yesterday, 25.0), &|at_s| Some(us(at_s)));
    assert!(score.wrong.is_empty() && score.bound == 8, "{} bound, {:#?} {:#?}", score.bound, score.wrong, score.told);
}

#[test]
fn slow_telemetry_that_counts_is_enough() {
    for rate_hz in [1.5, 2.0, 5.0] {
        let exposures: Vec<(f64, f64)> = (0..6).map(|i| 12.1 + 3.0 * f64::from(i)).map(|at| (at, at + 0.2)).collect();
        let came: Vec<Came> = (0..6).map(|i| (Truth::Of(i), exposures[i].1 + 0.6, Some(i as u32 + 1))).collect();
        let score = played_at(&exposures, &[], true, &came, (1000, None, rate_hz), &|at_s| Some(us(at_s)));
        assert!(score.wrong.is_empty() && score.bound == 6, "{rate_hz} Hz: {} bound, {:#?}", score.bound, score.wrong);
    }
}

/// Consoles export the first image, or the last pulses, before the beam's end. Such frames were never tied, whatever counter and stamp said.
#[test]
fn frames_that_come_while_the_beam_is_on_are_of_it_where_counter_or_stamp_say_so() {
    // All in beams that end soon after, or long after; two among others that come after their exposures.
    for (beam_s, early) in [(1.2, vec![0, 1, 2, 3, 4, 5]), (6.0, vec![0, 1, 2, 3, 4, 5]), (1.2, vec![2, 4])] {
        for stamped in [true, false] {
            let exposures: Vec<(f64, f64)> = calm(6).into_iter().map(|(start, _)| (start, start + beam_s)).collect();
            let came_s = |i: usize| if early.contains(&i) { exposures[i].0 + 0.8 } else { exposures[i].1 + 0.4 };
            let came: Vec<Came> = (0..6).map(|i| (Truth::Of(i), came_s(i), Some(i as u32 + 1))).collect();
            let score = played(&exposures, &[], true, stamped, &came);
            assert!(score.wrong.is_empty() && score.bound == 6, "{beam_s} s, {stamped}: {:#?}", score.told);
        }
    }
}

/// A frame that comes late while the next exposure is on is not of that one, and one that says nothing of itself is of none.
#[test]
fn a_late_frame_that_comes_while_another_beam_is_on_is_not_of_that_one() {
    let exposures: Vec<(f64, f64)> = calm(7).into_iter().map(|(start, _)| (start, start + 1.2)).collect();
    for counter in [Some(1), Some(2), None] {
        for stamped in [true, false] {
            let count = |i: usize| counter.map(|first| i as u32 + first);
            let came: Vec<Came> = (0..6).map(|i| (Truth::Of(i), exposures[i + 1].0 + 0.8, count(i))).collect();
            let score = played(&exposures, &[], true, stamped, &came);
            assert!(score.frames == 6 && score.wrong.is_empty(), "{counter:?} {stamped}: {:#?}", score.wrong);
        }
    }
}
