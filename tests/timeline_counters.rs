//! C-arms that count in ways of their own: what has one beam and one count is one exposure.

use sidecarm::telemetry::DeviceKind;
use sidecarm::timeline::ExposureInterval;

use crate::timeline_joints::{Fed, T0_US, carm};

/// Beam on and off, ms.
const BEAMS: [[u64; 2]; 5] = [[1500, 1900], [2600, 3000], [4400, 4800], [5500, 5900], [8200, 8600]];
const PERIOD_MS: u64 = 33;

/// Exposures that a C-arm tells with a packet every 33 ms but in `silences`, where it says this at each time in ms.
fn told(says: &dyn Fn(u64) -> (bool, Option<u32>), silences: &[[u64; 2]]) -> Vec<ExposureInterval> {
    let mut fed = Fed::default();
    for number in 0..300u32 {
        let at_ms = u64::from(number) * PERIOD_MS;
        if silences.iter().any(|[from, to]| (*from..*to).contains(&at_ms)) {
            continue;
        }
        let (xray_on, counter) = says(at_ms);
        let host_us = T0_US + 1000 * at_ms as i64 + 2000;
        fed.push_sample(DeviceKind::Carm, host_us, 0, carm(number, 7_000_000 + 1000 * at_ms, 0.0, xray_on, counter));
    }
    fed.timeline.finish();
    fed.exposures()
}

fn beam(at_ms: u64) -> bool {
    BEAMS.iter().any(|[on, off]| (*on..*off).contains(&at_ms))
}

/// Beams that have gone on by then.
fn begun(at_ms: u64) -> u32 {
    BEAMS.iter().filter(|[on, _]| *on <= at_ms).count() as u32
}

fn ended(at_ms: u64) -> u32 {
    BEAMS.iter().filter(|[_, off]| *off <= at_ms).count() as u32
}

/// One exposure a beam, when the beam was on, with these counts.
fn assert_told(what: &str, told: &[ExposureInterval], counts: [u32; 5]) {
    let counters: Vec<Option<u32>> = told.iter().map(|exposure| exposure.counter).collect();
    assert_eq!(counters, counts.map(Some), "{what}");
    for (exposure, [on_ms, off_ms]) in told.iter().zip(BEAMS) {
        let away_ms = |us: i64, ms: u64| ((us - T0_US) as f64 * 1e-3 - ms as f64).abs();
        let away = [away_ms(exposure.start_us, on_ms), away_ms(exposure.end_us, off_ms)];
        assert!(away.iter().all(|ms| *ms < 40.0) && !exposure.open && exposure.end_seen, "{what}: {away:?}");
    }
}

#[test]
fn a_count_may_come_late_or_by_other_steps() {
    // As the protocol has it.
    assert_told("with the beam", &told(&|ms| (beam(ms), Some(7 + begun(ms))), &[]), [8, 9, 10, 11, 12]);
    // A packet ahead of the beam.
    assert_told("ahead", &told(&|ms| (beam(ms), Some(7 + begun(ms + 40))), &[]), [8, 9, 10, 11, 12]);
    for late_ms in [20, 50, 120, 300] {
        let says = |ms: u64| (beam(ms), Some(7 + begun(ms.saturating_sub(late_ms))));
        assert_told(&format!("{late_ms} ms late"), &told(&says, &[]), [8, 9, 10, 11, 12]);
    }
    // When the beam goes off, or the picture is stored: the exposures keep the count that they had.
    assert_told("at the end", &told(&|ms| (beam(ms), Some(7 + ended(ms))), &[]), [8, 9, 10, 11, 12]);
    assert_told("after the end", &told(&|ms| (beam(ms), Some(7 + ended(ms.saturating_sub(500)))), &[]), [7, 8, 9, 10, 11]);
    // By two, over the count that is none, and one that never moves.
    assert_told("by two", &told(&|ms| (beam(ms), Some(7 + 2 * begun(ms))), &[]), [9, 11, 13, 15, 17]);
    let wrapped = |ms: u64| {
        (
            beam(ms),
            Some(match begun(ms) {
                n @ 0..3 => u32::MAX - 3 + n,
                n => n - 3,
            }),
        )
    };
    assert_told("wrapped", &told(&wrapped, &[]), [u32::MAX - 2, u32::MAX - 1, 0, 1, 2]);
    assert_told("standing", &told(&|ms| (beam(ms), Some(1)), &[]), [1; 5]);
}

#[test]
fn a_flag_that_bounces_is_one_exposure_and_two_counts_are_two() {
    let bounces = |ms: u64| (beam(ms) && !(4560..4640).contains(&ms), Some(7 + begun(ms)));
    assert_told("bounced", &told(&bounces, &[]), [8, 9, 10, 11, 12]);
    // Off for longer, counted or not.
    for (counted, count) in [(true, 6), (false, 6)] {
        let again = |ms: u64| {
            let beam = beam(ms) && !(4500..4700).contains(&ms);
            (beam, Some(7 + begun(ms) + u32::from(counted && ms >= 4700)))
        };
        assert_eq!(told(&again, &[]).len(), count, "{counted}");
    }
    // A count that is raised under the beam where it was raised with the beam before: the flag was off between two packets.
    let twice = |ms: u64| (beam(ms), Some(7 + begun(ms) + u32::from(ms >= 4600)));
    assert_eq!(told(&twice, &[]).len(), 6);
    // The last one ends with the session.
    let mut last = told(&|ms| (beam(ms), Some(7 + begun(ms))), &[[8700, 99_999]]);
    assert!(last.pop().is_some_and(|exposure| !exposure.open && exposure.counter == Some(12)));
}

/// What only the counter tells of is still told, where telemetry was silent.
#[test]
fn exposures_in_a_silence_are_told_by_the_counter() {
    let says = |ms: u64| (beam(ms), Some(7 + begun(ms)));
    let seen = told(&says, &[[2300, 5100]]);
    assert_eq!(seen.iter().map(|exposure| exposure.counter).collect::<Vec<_>>(), [8, 9, 10, 11, 12].map(Some));
    assert_eq!(seen.iter().map(|exposure| exposure.samples > 0).collect::<Vec<_>>(), [true, false, false, true, true]);
    // A pulse between two packets.
    let short = |ms: u64| (beam(ms) && ms > 3500, Some(7 + begun(ms)));
    assert_eq!(told(&short, &[]).iter().filter(|exposure| exposure.samples == 0).count(), 2);
}
