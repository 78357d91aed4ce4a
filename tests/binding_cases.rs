//! Single situations in which a frame once was, or could be, given the exposure beside its own.

use sidecarm::timeline::FrameEvidence;

use crate::binding_draw::{Draw, Exposed, Sent, Session, Truth, samples};
use crate::binding_play::{Score, play};
use crate::timeline_joints::T0_US;

/// Seconds by which the console's clock is ahead of the host's.
const AHEAD_S: f64 = 240.07;

fn us(seconds: f64) -> i64 {
    T0_US + (seconds * 1e6).round() as i64
}

/// A frame: what it is, arrival (s), the console's counter; its stamp in whole seconds follows from its exposure, a stray has none.
type Came = (Truth, f64, Option<u32>);

/// A session by hand; the C-arm counts from 1 if `counted`, frames have stamps if `stamped`.
fn played(exposures_s: &[(f64, f64)], holes: &[(f64, f64)], counted: bool, stamped: bool, came: &[Came]) -> Score {
    let mut draw = Draw::new(1, 0);
    let counter = |index: usize| index as u32 + 1;
    let end_s = exposures_s.iter().fold(0.0f64, |end, exposure| end.max(exposure.1)) + 30.0;
    let samples = samples(&mut draw, exposures_s, end_s, 25.0, counted.then_some(&counter), 0, holes);
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
                Truth::Of(index) | Truth::SecondOf(index) => stamped.then(|| us((exposures_s[*index].0 + AHEAD_S).floor())),
                Truth::Copy | Truth::Foreign => None,
            },
            console_resolution_us: 1_000_000,
            arrival_us: Some(us(*arrival_s)),
            frame_time_us: None,
        },
        truth: *truth,
        late: false,
        twin: false,
    });
    play(&Session { described: "by hand".to_owned(), exposures: exposures.collect(), samples, frames: frames.collect() })
}

/// Exposures far apart, whose prompt frames teach the console's offset.
fn calm(count: usize) -> Vec<(f64, f64)> {
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
