//! One file of several images, with one stamp: of one exposure, or each of its own.

use sidecarm::timeline::FrameEvidence;

use crate::binding_cases::us;
use crate::binding_draw::{Draw, Exposed, Sent, Session, Truth, samples};
use crate::binding_play::{Score, play};

/// Exposures by hand, seconds; the fifth to the seventh are the series, but where the fifth is a longer one.
fn exposures(last_gap_s: f64, fifth_s: f64) -> Vec<(f64, f64)> {
    let mut found: Vec<(f64, f64)> = (0..4).map(|i| 40.0 + 17.3 * f64::from(i)).map(|at| (at, at + 0.3)).collect();
    let at = 120.0;
    found.extend([(at, at + fifth_s), (at + 5.1, at + 5.4), (at + 5.1 + last_gap_s, at + 5.4 + last_gap_s)]);
    found
}

/// Single pictures of the first four, then `count` images in one file with the time of the fifth, whose truths these are.
fn played(exposures_s: &[(f64, f64)], truths: &[Truth], times_s: &[f64], frame_time_s: Option<f64>) -> Score {
    let counter = |index: usize| index as u32 + 1;
    let mut draw = Draw::new(1, 0);
    let end_s = exposures_s.iter().fold(0.0_f64, |end, exposure| end.max(exposure.1)) + 30.0;
    let exposures = exposures_s.iter().enumerate().map(|(index, (start, end))| Exposed {
        start_us: us(*start),
        end_us: us(*end),
        counter: Some(counter(index)),
    });
    let sent = |frame: usize, content: usize, image_of_file: [u32; 2], truth: Truth, at: usize, arrival_s: f64| Sent {
        evidence: FrameEvidence {
            frame: frame as u32,
            content: format!("{content:064x}"),
            image_of_file,
            counter: Some(counter(at)),
            console_us: Some(us(exposures_s[at].0 + 240.0)),
            console_resolution_us: 1000,
            arrival_us: Some(us(arrival_s)),
            frame_time_us: frame_time_s.map(|s| (s * 1e6) as i64),
            image_times_us: times_s.iter().map(|s| (s * 1e6) as i64).collect(),
            stated_length_us: None,
            last_image: false,
            completes: None,
        },
        truth,
        late: false,
        twin: false,
    };
    let single = (0..4).map(|i| sent(i, i, [0, 1], Truth::Of(i), i, exposures_s[i].1 + 1.0));
    let came_s = exposures_s.last().expect("exposures").1 + 1.5;
    let count = truths.len() as u32;
    let run = truths.iter().enumerate().map(|(image, truth)| sent(4 + image, 4, [image as u32, count], *truth, 4, came_s));
    let frames = single.chain(run).collect();
    let samples = samples(&mut draw, exposures_s, end_s, 25.0, Some(&counter), 0, &[]);
    play(&Session { described: "a file of images".to_owned(), exposures: exposures.collect(), samples, frames })
}

const SERIES: [Truth; 3] = [Truth::Of(4), Truth::Of(5), Truth::Of(6)];

/// All three were of the first exposure.
#[test]
fn three_images_of_three_exposures_are_not_all_of_the_first() {
    let exposures = exposures(3.4, 0.3);
    let score = played(&exposures, &SERIES, &[], None);
    assert!(score.wrong.is_empty() && score.bound == 4, "{:#?}", score.told);
    let untold = score.told.iter().filter(|told| told.contains("one file of 3 images") && told.contains("ambiguous"));
    assert_eq!(untold.count(), 3, "{:#?}", score.told);
}

#[test]
fn images_as_long_after_each_other_as_exposures_have_each_its_own() {
    let score = played(&exposures(3.4, 0.3), &SERIES, &[0.0, 5.1, 8.5], None);
    assert!(score.wrong.is_empty() && score.bound == 7, "{:#?} {:#?}", score.wrong, score.told);
    assert_eq!(score.taken_back, 0);
    let even = played(&exposures(5.1, 0.3), &SERIES, &[], Some(5.1));
    assert!(even.wrong.is_empty() && even.bound == 7, "{:#?} {:#?}", even.wrong, even.told);
}

#[test]
fn images_at_the_times_of_no_exposures_are_of_none() {
    let score = played(&exposures(3.4, 0.3), &SERIES, &[0.0, 4.0, 8.5], None);
    assert!(score.wrong.is_empty() && score.bound == 4, "{:#?}", score.told);
    assert!(score.told.iter().filter(|told| told.contains("0 series of exposures have these times")).count() == 3);
}

/// The control: what is of one exposure stays so, whatever waits for a picture.
#[test]
fn images_of_a_run_are_of_its_exposure() {
    let run = [Truth::Of(4); 3];
    let cases: [(f64, Vec<f64>, Option<f64>); 4] =
        [(1.6, Vec::new(), None), (0.3, Vec::new(), Some(0.1)), (0.3, vec![0.0, 0.1, 0.2], None), (1.6, Vec::new(), Some(0.5))];
    for (fifth_s, times_s, frame_time_s) in cases {
        let score = played(&exposures(3.4, fifth_s), &run, &times_s, frame_time_s);
        assert!(score.wrong.is_empty() && score.bound == 7, "{fifth_s} s: {:#?} {:#?}", score.wrong, score.told);
    }
}
