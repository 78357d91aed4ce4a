//! Pictures exported afterwards, two of which fit one exposure: which of them gets it follows from what they say, not from their names or order.

use sidecarm::timeline::FrameEvidence;

use crate::binding_cases::{AHEAD_S, calm, us};
use crate::binding_draw::{Draw, Exposed, Sent, Session, Truth, samples};
use crate::binding_play::{Score, play};

/// A picture: what it is, when it was taken by its stamp (host's time, s), the length that its header states, s, and its checksum.
type Exported = (Truth, f64, Option<f64>, usize);

/// The exposure that two pictures fit; it takes a second.
const LONG: usize = 4;

fn exposures() -> Vec<(f64, f64)> {
    let mut exposures = calm(9);
    exposures[LONG].1 = exposures[LONG].0 + 1.0;
    exposures
}

fn exported(pictures: &[Exported]) -> Score {
    exported_counted(pictures, &|_| None)
}

/// The same with a count of some, by their checksum.
fn exported_counted(pictures: &[Exported], count: &dyn Fn(usize) -> Option<u32>) -> Score {
    let (exposures_s, counter) = (exposures(), |index: usize| index as u32 + 1);
    let end_s = exposures_s.iter().fold(0.0f64, |end, exposure| end.max(exposure.1)) + 30.0;
    let samples = samples(&mut Draw::new(1, 0), &exposures_s, end_s, 25.0, Some(&counter), 0, &[]);
    let exposed = exposures_s.iter().enumerate().map(|(index, (start, end))| Exposed {
        start_us: us(*start),
        end_us: us(*end),
        counter: Some(counter(index)),
    });
    let frames = pictures.iter().enumerate().map(|(number, (truth, stamp_s, stated_s, content))| Sent {
        evidence: FrameEvidence {
            frame: number as u32,
            counter: count(*content),
            content: format!("{content:064x}"),
            image_of_file: [0, 1],
            console_us: Some(us(stamp_s + AHEAD_S)),
            console_resolution_us: 1000,
            stated_length_us: stated_s.map(|s| (s * 1e6) as i64),
            ..FrameEvidence::default()
        },
        truth: *truth,
        late: true,
        twin: false,
    });
    play(&Session { described: "exported".to_owned(), exposures: exposed.collect(), samples, frames: frames.collect() })
}

/// What becomes of the two pictures, before and behind those of all other exposures, in either order.
fn told_in_every_order(two: [Exported; 2]) -> Vec<[String; 2]> {
    let others = exposures().into_iter().enumerate().filter(|(index, _)| *index != LONG);
    let others: Vec<Exported> =
        others.map(|(index, (start_s, end_s))| (Truth::Of(index), start_s, Some(end_s - start_s), 100 + index)).collect();
    let mut told = Vec::new();
    for swapped in [false, true] {
        let own = if swapped { [two[1], two[0]] } else { two };
        for pictures in [[&own[..], &others[..]].concat(), [&others[..], &own[..]].concat()] {
            let score = exported(&pictures);
            let at = |content: usize| {
                let place = pictures.iter().position(|picture| picture.3 == content).expect("it is one of them");
                score.told[place].clone()
            };
            let unbound = score.told.iter().filter(|told| is_unbound(told)).count();
            assert!(score.wrong.is_empty() && (1..=2).contains(&unbound), "{unbound} unbound: {:#?}", score.told);
            told.push([at(two[0].3), at(two[1].3)]);
        }
    }
    assert_eq!(told.len(), 4);
    told
}

fn is_unbound(told: &str) -> bool {
    told.contains(": None ")
}

/// A picture of another room, with a stamp half a second off and a header of 0.3 s, took the exposure of 1 s: its name came first.
#[test]
fn of_two_pictures_that_fit_one_exposure_the_stated_length_tells_the_one_that_is_of_it() {
    let start_s = exposures()[LONG].0;
    let (own, foreign) = ((Truth::Of(LONG), start_s, Some(1.007), 2), (Truth::Foreign, start_s + 0.44, Some(0.3), 1));
    for [own, foreign] in told_in_every_order([own, foreign]) {
        assert!(!is_unbound(&own) && own.contains("fits exposure 5 as well, but its header states another length"), "{own}");
        let words = "its header states an exposure of 0.300 s, the beam was on for";
        assert!(is_unbound(&foreign) && foreign.contains(words) && !foreign.contains("a second picture"), "{foreign}");
    }
}

#[test]
fn of_two_pictures_that_fit_one_exposure_by_their_stamps_alone_neither_gets_it() {
    let start_s = exposures()[LONG].0;
    for lengths_s in [[None, None], [Some(1.0), Some(0.95)], [None, Some(0.3)]] {
        let (own, foreign) = ((Truth::Of(LONG), start_s, lengths_s[0], 2), (Truth::Foreign, start_s + 0.44, lengths_s[1], 1));
        for told in told_in_every_order([own, foreign]).into_iter().flatten() {
            assert!(is_unbound(&told) && told.contains("fits exposure 5 as well: ambiguous"), "{told}");
        }
    }
}

#[test]
fn of_a_raw_and_a_processed_picture_with_one_stamp_the_lower_checksum_is_bound() {
    let start_s = exposures()[LONG].0;
    let (raw, processed) = ((Truth::Of(LONG), start_s, Some(1.0), 7), (Truth::SecondOf(LONG), start_s, Some(1.0), 8));
    for [raw, processed] in told_in_every_order([raw, processed]) {
        assert!(!is_unbound(&raw), "{raw}");
        assert!(is_unbound(&processed) && processed.contains("a second picture of the exposure that frame"), "{processed}");
    }
}

/// Of two exposures, by their counts, one of which telemetry has not: the lower checksum was bound.
#[test]
fn of_two_pictures_with_one_stamp_that_are_counted_apart_neither_is_bound() {
    let exposures = exposures();
    let mut pictures: Vec<Exported> =
        (0..exposures.len()).map(|index| (Truth::Of(index), exposures[index].0, None, 100 + index)).collect();
    pictures.push((Truth::Foreign, exposures[LONG].0, None, 1));
    for (counts, unbound) in [([Some(31), Some(32)], 2), ([Some(31), Some(31)], 1), ([None, None], 1)] {
        let score = exported_counted(&pictures, &|content| match content {
            1 => counts[0],
            content if content == 100 + LONG => counts[1],
            _ => None,
        });
        assert_eq!(score.told.iter().filter(|told| is_unbound(told)).count(), unbound, "{counts:?}: {:#?}", score.told);
    }
}

#[test]
fn a_picture_whose_header_states_another_length_than_the_exposure_says_so() {
    let exposures = exposures();
    let mut told = Vec::new();
    for stated_s in [0.3, 0.9, 2.4] {
        let pictures: Vec<Exported> = exposures
            .iter()
            .enumerate()
            .map(|(i, (start_s, end_s))| (Truth::Of(i), *start_s, Some(if i == LONG { stated_s } else { end_s - start_s }), i))
            .collect();
        let score = exported(&pictures);
        assert!(score.wrong.is_empty() && score.bound == 9, "{:#?}", score.told);
        told.push(score.told.iter().map(|told| told.contains("the picture may be of another exposure")).collect::<Vec<bool>>());
    }
    let at_long: Vec<bool> = (0..9).map(|i| i == LONG).collect();
    assert_eq!(told, [at_long.clone(), vec![false; 9], at_long]);
}
