//! Two consoles that write into one folder, and one console that writes two studies.

use sidecarm::telemetry::{CarmSample, DeviceKind, Sample, SequenceTracker};
use sidecarm::timeline::{Binder, FrameEvidence, Timeline};

const SHOTS: u32 = 12;
/// Between two samples of the arm.
const STEP_US: i64 = 20_000;
/// How long the beam is on.
const BEAM_US: i64 = 300_000;

/// When an exposure begins: farther apart each time, so that no delay and no offset fits two readings.
fn begin_us(shot: u32) -> i64 {
    let shot = i64::from(shot);
    20_000_000 + 17_000_000 * shot + 140_000 * shot * shot
}

/// The arm's sample at a time; it counts its exposures from 1.
fn sample(n: u32) -> CarmSample {
    let at_us = STEP_US * i64::from(n);
    let begun = (0..SHOTS).filter(|shot| begin_us(*shot) <= at_us).count() as u32;
    let xray_on = begun.checked_sub(1).is_some_and(|shot| at_us < begin_us(shot) + BEAM_US);
    CarmSample { device_us: at_us as u64, sequence: n, xray_on, exposure_counter: Some(begun), ..CarmSample::UNTOLD }
}

/// A picture: its study, when it came (none: exported afterwards), count and stamp.
#[derive(Clone, Copy)]
struct Picture {
    study: Option<&'static str>,
    arrival_us: Option<i64>,
    counter: Option<u32>,
    console_us: Option<i64>,
}

/// The exposures, by the arm's counter, to which pictures are bound that come in this order.
fn bound(pictures: &[Picture]) -> Vec<Option<u32>> {
    let (mut timeline, mut sequence, mut binder) = (Timeline::new(), SequenceTracker::default(), Binder::new());
    let mut waiting = pictures.iter().zip(0_u32..).peekable();
    let said = |picture: &Picture, frame: u32| FrameEvidence {
        frame,
        content: format!("{frame:064x}"),
        image_of_file: [0, 1],
        counter: picture.counter,
        console_us: picture.console_us,
        console_resolution_us: 1000,
        arrival_us: picture.arrival_us,
        ..FrameEvidence::default()
    };
    let end_us = begin_us(SHOTS - 1) + 20_000_000;
    for n in 0..(end_us / STEP_US) as u32 {
        let (at_us, sample) = (STEP_US * i64::from(n), sample(n));
        let sequenced = sequence.take(n, sample.device_us);
        timeline.push_sample(DeviceKind::Carm, at_us, 0, sequenced, Sample::Carm(sample));
        while let Some((picture, frame)) = waiting.next_if(|(picture, _)| picture.arrival_us.is_some_and(|us| us <= at_us)) {
            binder.push_of(picture.study, said(picture, frame));
        }
        binder.update(&timeline, at_us);
    }
    for (picture, frame) in waiting {
        binder.push_of(picture.study, said(picture, frame));
    }
    timeline.finish();
    binder.finish(&timeline);
    (0..pictures.len() as u32).map(|frame| binder.binding(frame)?.exposure.as_ref()?.counter).collect()
}

/// The exposures of the session's own pictures, and of the others, where each has its study.
fn of_both(own: &[Picture], others: &[Picture], studies: [Option<&'static str>; 2]) -> [Vec<Option<u32>>; 2] {
    let of = |pictures: &[Picture], study: Option<&'static str>, is_own: bool| -> Vec<(bool, Picture)> {
        pictures.iter().map(|picture| (is_own, Picture { study, ..*picture })).collect()
    };
    let mut all = [of(own, studies[0], true), of(others, studies[1], false)].concat();
    all.sort_by_key(|(_, picture)| picture.arrival_us.unwrap_or(i64::MAX));
    let pictures: Vec<Picture> = all.iter().map(|(_, picture)| *picture).collect();
    let bound = bound(&pictures);
    [true, false].map(|is_own| all.iter().zip(&bound).filter(|((own, _), _)| *own == is_own).map(|(_, to)| *to).collect())
}

/// In order, each of its own.
fn each() -> Vec<Option<u32>> {
    (1..=SHOTS).map(Some).collect()
}

/// Of a console that counts and has no clock.
fn counted() -> Vec<Picture> {
    let picture = |shot: u32| Picture {
        study: None,
        arrival_us: Some(begin_us(shot) + BEAM_US + 900_000),
        counter: Some(shot + 1),
        console_us: None,
    };
    (0..SHOTS).map(picture).collect()
}

/// Of a console that counts like the arm, and whose clock is off.
fn stamped(arrive: bool) -> Vec<Picture> {
    let picture = |shot: u32| Picture {
        study: None,
        arrival_us: arrive.then_some(begin_us(shot) + BEAM_US + 900_000),
        counter: arrive.then_some(shot + 1),
        console_us: Some(begin_us(shot) + 240_070_000),
    };
    (0..SHOTS).map(picture).collect()
}

/// Of a console in another room, whose counter stands still and which has no clock: before the first exposure, within a second of each of the session's
/// own, and between them.
fn standing_still() -> Vec<Picture> {
    let picture = |arrival_us: i64| Picture { study: None, arrival_us: Some(arrival_us), counter: Some(90), console_us: None };
    let before = [2_000_000, 5_000_000, 8_000_000].into_iter();
    let beside = counted().into_iter().zip(0..).filter_map(|(own, nth)| {
        let off_us = if nth % 2 == 0 { -500_000 } else { 700_000 };
        Some(own.arrival_us? + off_us)
    });
    let between = (0..SHOTS).map(|shot| begin_us(shot) + 9_000_000);
    before.chain(beside).chain(between).map(picture).collect()
}

/// A counter that stood still in another room made that of the session's own console useless, and its arrivals those of every frame ambiguous.
#[test]
fn another_console_does_not_spoil_what_the_own_one_says() {
    let alone = of_both(&counted(), &[], [Some("own"), None]);
    assert_eq!(alone, [each(), Vec::new()]);
    for studies in [[Some("b"), Some("a")], [Some("b"), Some("c")], [Some("b"), None], [None, Some("a")]] {
        let [own, others] = of_both(&counted(), &standing_still(), studies);
        assert_eq!(own, each(), "{studies:?}");
        assert!(others.len() == 27 && others.iter().all(Option::is_none), "{studies:?}: {others:?}");
    }
    // The control: nothing tells them apart.
    let [own, others] = of_both(&counted(), &standing_still(), [None, None]);
    assert!(own.contains(&None) && others.iter().all(Option::is_none), "{own:?} {others:?}");
}

/// Exported afterwards into one folder, with another clock and at times that are nobody's.
#[test]
fn stamps_of_another_console_do_not_spoil_those_of_the_own_one() {
    let taken_us = |nth: i64| 25_000_000 + 13_700_000 * nth + 1_900_000 * (nth * nth % 7);
    let other =
        |nth: i64| Picture { study: None, arrival_us: None, counter: None, console_us: Some(taken_us(nth) + 5_011_300_000) };
    let others: Vec<Picture> = (0..14).map(other).collect();
    for studies in [[Some("b"), Some("a")], [Some("b"), Some("c")]] {
        let [own, others] = of_both(&stamped(false), &others, studies);
        assert_eq!(own, each(), "{studies:?}");
        assert!(others.len() == 14 && others.iter().all(Option::is_none), "{studies:?}: {others:?}");
    }
}

/// A console that begins a new study in mid-session, with or without its count, is one console.
#[test]
fn both_halves_of_a_session_in_two_studies_are_bound_as_in_one() {
    let half = SHOTS / 2;
    for anew in [false, true] {
        let halves = |studies: [Option<&'static str>; 2]| -> Vec<Picture> {
            let of = |(picture, shot): (Picture, u32)| {
                let second = shot >= half;
                let counter = Some(if anew && second { shot + 1 - half } else { shot + 1 });
                Picture { study: studies[usize::from(second)], counter, ..picture }
            };
            stamped(true).into_iter().zip(0..).map(of).collect()
        };
        let as_one = bound(&halves([Some("a"), Some("a")]));
        assert_eq!(as_one, each(), "counts anew: {anew}");
        assert_eq!(bound(&halves([Some("a"), Some("b")])), as_one, "counts anew: {anew}");
        assert_eq!(bound(&halves([Some("b"), None])), as_one, "counts anew: {anew}");
    }
}

/// Two studies that claim the same exposures alike: neither goes before the other, whatever their names.
#[test]
fn what_two_studies_claim_alike_is_as_it_would_be_of_one() {
    let off = |picture: Picture| Picture { console_us: picture.console_us.map(|us| us + 40_000), ..picture };
    let others: Vec<Picture> = stamped(false).into_iter().map(off).collect();
    let as_one = of_both(&stamped(false), &others, [None, None]);
    for studies in [[Some("a"), Some("b")], [Some("b"), Some("a")]] {
        assert_eq!(of_both(&stamped(false), &others, studies), as_one, "{studies:?}");
    }
}
