//! The clock map against clocks whose truth is known.

use sidecarm::random::{Purpose, Stream};
use sidecarm::telemetry::Sequenced::{self, Next};
use sidecarm::timeline::{ClockMap, DeviceClock, MAX_DRIFT, Placed, SegmentStart, unit_of_clock};

const T0_US: i64 = 1_700_000_000_000_000;

/// (device, host, truth) stamps of a device whose clock runs `ppm` fast; the least delay is 300 µs, the rest exponential.
fn stamps(seed: u64, ppm: f64, seconds: f64, rate_hz: f64, mean_delay_us: f64) -> Vec<(i64, i64, i64)> {
    let mut stream = Stream::new(seed, 0, 0, Purpose::Evaluation);
    (0..(seconds * rate_hz) as i64)
        .map(|i| {
            let elapsed_us = i as f64 * 1e6 / rate_hz;
            let device_us = 5_000_000 + (elapsed_us * (1.0 + ppm * 1e-6)) as i64;
            let delay_us = 300.0 - mean_delay_us * stream.uniform().ln();
            let truth_us = T0_US + elapsed_us as i64;
            (device_us, truth_us + delay_us as i64, truth_us)
        })
        .collect()
}

fn mapped(stamps: &[(i64, i64, i64)]) -> ClockMap {
    let mut map = ClockMap::new(stamps[0].0, stamps[0].1, None);
    for (device_us, host_us, _) in &stamps[1..] {
        map.push(*device_us, *host_us);
    }
    map
}

#[test]
fn drift_of_200_ppm_is_found_and_mapped_away() {
    let mut cases = 0;
    for (seed, ppm) in [(1, 200.0), (2, -200.0), (3, 0.0), (4, 37.0)] {
        let stamps = stamps(seed, ppm, 120.0, 100.0, 2_000.0);
        let map = mapped(&stamps);
        let estimate = map.estimate();
        // The device runs fast by ppm, so the host runs slow against it.
        assert!((estimate.drift_ppm + ppm).abs() < 2.0, "{ppm}: {estimate:?}");
        let worst = stamps.iter().map(|(device, _, truth)| (map.host_from_device_us(*device) - truth - 300).abs()).max().unwrap();
        assert!(worst < 150, "{ppm}: off by {worst} us");
        assert!(estimate.uncertainty_us > 300.0, "the least delay cannot be seen and must be in the uncertainty: {estimate:?}");
        cases += 1;
    }
    assert_eq!(cases, 4);
}

#[test]
fn without_a_drift_estimate_the_error_would_show() {
    // Negative control of the test above: one offset for two minutes at 200 ppm is off by milliseconds.
    let stamps = stamps(1, 200.0, 120.0, 100.0, 2_000.0);
    let offset_us = stamps.iter().map(|(device, host, _)| host - device).min().unwrap();
    let worst = stamps.iter().map(|(device, _, truth)| (device + offset_us - truth - 300).abs()).max().unwrap();
    assert!(worst > 10_000, "{worst}");
}

#[test]
fn the_map_and_its_inverse_agree() {
    let stamps = stamps(9, 150.0, 30.0, 30.0, 1_000.0);
    let map = mapped(&stamps);
    for (device_us, _, _) in &stamps {
        let back = map.device_from_host_us(map.host_from_device_us(*device_us));
        assert!((back - device_us).abs() <= 1);
    }
    assert_eq!(stamps.len(), 900);
}

#[test]
fn an_initial_backlog_and_bursts_do_not_bias_the_map() {
    let mut stamps = stamps(5, 100.0, 60.0, 100.0, 500.0);
    // The first 0.4 s waited in the kernel and came at once; later every third second stalls for 250 ms.
    let release_us = stamps[40].1;
    for stamp in &mut stamps[..40] {
        stamp.1 = release_us;
    }
    for start in (300..5_700).step_by(300) {
        let release_us = stamps[start + 25].1;
        for stamp in &mut stamps[start..start + 25] {
            stamp.1 = release_us;
        }
    }
    let map = mapped(&stamps);
    let worst = stamps.iter().map(|(device, _, truth)| (map.host_from_device_us(*device) - truth - 300).abs()).max().unwrap();
    assert!(worst < 150, "off by {worst} us");
}

#[test]
fn the_drift_is_bounded() {
    let stamps = stamps(6, 5_000.0, 60.0, 100.0, 100.0);
    let (drift, _) = mapped(&stamps).drift();
    assert!(drift.abs() <= MAX_DRIFT);
}

#[test]
fn uncertainty_grows_when_the_device_is_silent() {
    let map = mapped(&stamps(7, 0.0, 10.0, 100.0, 500.0));
    let last_us = 15_000_000;
    assert!(map.uncertainty_us(last_us + 3_600_000_000) > 3.0 * map.uncertainty_us(last_us));
}

/// Runs stamps with sequence numbers through the device clock; returns it and the segment of each sample.
fn run(stamps: &[(i64, i64)]) -> (DeviceClock, Vec<Placed>) {
    let mut clock = DeviceClock::default();
    let placed = stamps.iter().enumerate().map(|(i, (device, host))| clock.observe(0, Next, i as u32, *device, *host)).collect();
    (clock, placed)
}

#[test]
fn steps_of_the_device_clock_begin_a_new_map() {
    let mut cases = 0;
    for step_us in [3_000_000i64, -3_000_000, 500_000, -40_000, 60_000] {
        let even = stamps(11, 50.0, 60.0, 100.0, 1_000.0);
        let stepped: Vec<(i64, i64)> = even
            .iter()
            .enumerate()
            .map(|(i, (device, host, _))| (device + if i >= 3_000 { step_us } else { 0 }, *host))
            .collect();
        let (clock, placed) = run(&stepped);
        assert_eq!(clock.steps_and_resets(), (1, 0), "step of {step_us} us");
        assert_eq!(placed[2_999], Placed::InOrder(0));
        assert_eq!(placed[3_000], Placed::InOrder(1));
        let segment = clock.latest().unwrap();
        assert_eq!(segment.start, SegmentStart::Step);
        assert!((segment.step_us - step_us).abs() < 12_000, "{} for {step_us}", segment.step_us);
        for (i, (_, _, truth)) in even.iter().enumerate() {
            let map = &clock.segment(if i < 3_000 { 0 } else { 1 }).unwrap().map;
            let error_us = map.host_from_device_us(stepped[i].0) - truth - 300;
            assert!(error_us.abs() < 400, "step {step_us}, sample {i}: {error_us} us");
        }
        cases += 1;
    }
    assert_eq!(cases, 5);
}

/// A device that was plugged in again sent what it had missed in a burst, all of it waited in front of the port together with eight samples at
/// the usual rate, and each of those was said to be a jump of its clock.
#[test]
fn what_waited_in_front_of_a_port_just_opened_is_no_step_at_whatever_rate_it_was_sent() {
    let read_us = T0_US + 400_000;
    let mut device_us = 5_000_000;
    let stamps: Vec<(i64, i64)> = (0..80i64)
        .map(|i| {
            device_us += if i < 18 { 3_000 } else { 33_000 };
            (device_us, read_us + (i - 26).max(0) * 33_000)
        })
        .collect();
    let (clock, placed) = run(&stamps);
    assert_eq!(clock.steps_and_resets(), (0, 0));
    assert!(placed.iter().all(|placed| *placed == Placed::InOrder(0)), "{placed:?}");
    // Once samples come as they are sent a step as small is one.
    let stepped: Vec<(i64, i64)> =
        stamps.iter().enumerate().map(|(i, (device, host))| (device + if i >= 60 { 60_000 } else { 0 }, *host)).collect();
    assert_eq!(run(&stepped).0.steps_and_resets(), (1, 0));
}

#[test]
fn pauses_delays_and_losses_are_not_steps() {
    let even = stamps(12, 50.0, 60.0, 100.0, 1_000.0);
    // The device pauses for 0.8 s: both clocks see it.
    let pause: Vec<(i64, i64)> =
        even.iter().enumerate().map(|(i, (d, h, _))| if i >= 1_000 { (d + 800_000, h + 800_000) } else { (*d, *h) }).collect();
    assert_eq!(run(&pause).0.steps_and_resets(), (0, 0));
    // The host is late by 0.4 s for a second.
    let late: Vec<(i64, i64)> = even
        .iter()
        .enumerate()
        .map(|(i, (d, h, _))| (*d, if (1_000..1_100).contains(&i) { even[1_100].1 } else { *h }))
        .collect();
    assert_eq!(run(&late).0.steps_and_resets(), (0, 0));
    // 300 frames are lost: the sequence explains the device time.
    let mut clock = DeviceClock::default();
    for (i, (device, host, _)) in even.iter().enumerate().filter(|(i, _)| !(2_000..2_300).contains(i)) {
        clock.observe(0, Next, i as u32, *device, *host);
    }
    assert_eq!(clock.steps_and_resets(), (0, 0));
}

#[test]
fn restarts_and_openings_begin_new_maps_and_carry_the_drift() {
    let even = stamps(13, 200.0, 120.0, 100.0, 1_000.0);
    let mut clock = DeviceClock::default();
    for (i, (device, host, _)) in even.iter().enumerate() {
        match i {
            0..6_000 => clock.observe(0, Next, i as u32, *device, *host),
            6_000..9_000 => clock.observe(
                0,
                if i == 6_000 { Sequenced::Reset } else { Next },
                (i - 6_000) as u32,
                device - even[6_000].0,
                *host,
            ),
            _ => clock.observe(1, Next, (i - 6_000) as u32, device - even[6_000].0, *host),
        };
    }
    let starts: Vec<SegmentStart> = clock.summaries().iter().map(|segment| segment.start).collect();
    assert_eq!(starts, [SegmentStart::First, SegmentStart::Reset, SegmentStart::Epoch]);
    assert_eq!(clock.steps_and_resets(), (0, 1));
    assert!((clock.latest().unwrap().map.estimate().drift_ppm + 200.0).abs() < 3.0);
}

#[test]
fn late_and_repeated_samples_keep_their_segment() {
    let even = stamps(14, 0.0, 1.0, 100.0, 100.0);
    let mut clock = DeviceClock::default();
    let mut placed = Vec::new();
    for i in [0usize, 1, 2, 3, 4, 5, 6, 9, 7, 8, 8, 10] {
        placed.push(clock.observe(
            0,
            if matches!(i, 7 | 8) { Sequenced::Reordered } else { Next },
            i as u32,
            even[i].0,
            even[9].1,
        ));
    }
    assert_eq!(placed[8..10], [Placed::Late(0), Placed::Late(0)]);
    assert_eq!(placed[11], Placed::InOrder(0));
}

/// A device that halts with its clock, its sequence going on: every time after it was too early by as much, and said to be good to a millisecond.
#[test]
fn a_clock_that_stood_still_is_uncertain_by_that_and_then_mapped_anew() {
    let even = stamps(14, 50.0, 60.0, 100.0, 1_000.0);
    for stood_us in [600_000i64, 2_500_000] {
        let halted: Vec<(i64, i64)> =
            even.iter().enumerate().map(|(i, (d, h, _))| (*d, h + if i >= 2_000 { stood_us } else { 0 })).collect();
        let (clock, placed) = run(&halted);
        assert_eq!(clock.steps_and_resets(), (1, 0), "{stood_us}");
        let segment = clock.latest().expect("segments");
        // The fastest arrivals of buckets are milliseconds apart.
        assert!((segment.step_us + stood_us).abs() < 20_000, "{} for {stood_us}", segment.step_us);
        let anew = placed.iter().position(|placed| *placed == Placed::InOrder(1)).expect("mapped anew");
        // Five seconds are 500 samples, and buckets are of a hundred.
        assert!((2_400..2_800).contains(&anew), "after {anew} samples");
        // It may have stopped right after the last that came in time, up to a bucket before it did.
        for (i, (_, _, truth)) in even.iter().enumerate().filter(|(i, _)| !(1_900..2_000).contains(i)) {
            let truth = truth + if i >= 2_000 { stood_us } else { 0 };
            let map = &clock.segment(if i < anew { 0 } else { 1 }).expect("kept").map;
            let (error_us, sigma_us) = (map.host_from_device_us(halted[i].0) - truth, map.uncertainty_us(halted[i].0));
            assert!(
                error_us.abs() as f64 <= 1.1 * sigma_us + 1_000.0,
                "{stood_us}, sample {i}: off by {error_us}, said {sigma_us}"
            );
            assert!((2_000..anew).contains(&i) || sigma_us < 5_000.0, "{stood_us}, sample {i}: said {sigma_us}");
        }
    }
    // What waits somewhere is worked off, however slowly: one tenth faster than it is sent, here.
    let waited: Vec<(i64, i64)> = even
        .iter()
        .enumerate()
        .map(|(i, (d, h, _))| (*d, h + if i >= 2_000 { (2_500_000 - 1_000 * (i as i64 - 2_000)).max(0) } else { 0 }))
        .collect();
    let (clock, _) = run(&waited);
    assert_eq!(clock.steps_and_resets(), (0, 0));
    let map = &clock.latest().expect("segments").map;
    for i in [2_100, 3_000, 5_900] {
        let error_us = map.host_from_device_us(even[i].0) - even[i].2;
        assert!(error_us.abs() < 1_000, "sample {i}: off by {error_us}");
    }
}

/// What is told of the rate of a clock with these stamps, and after how many of them first.
fn told_rate(stamps: &[(i64, i64)]) -> Option<(usize, f64)> {
    let mut clock = DeviceClock::default();
    stamps.iter().enumerate().find_map(|(i, (device_us, host_us))| {
        clock.observe(0, Next, i as u32, *device_us, *host_us);
        Some((i, clock.latest()?.wrong_rate()?))
    })
}

/// A clock that counted milliseconds had all samples at the session's first moment, one that ran 6 % fast was never thought to have caught up:
/// all that was said was that frames could not be tied.
#[test]
fn a_clock_that_counts_another_unit_or_runs_fast_is_told_by_its_rate() {
    let mut cases = 0;
    for (rate, unit, within_s) in [
        (1e-3, Some("milliseconds"), 6),
        (1e3, Some("nanoseconds"), 6),
        (10.0, Some("units of 100 ns"), 6),
        (1.06, None, 65),
        (0.94, None, 13),
        (1.004, None, 110),
    ] {
        let of_rate: Vec<(i64, i64)> = stamps(21, 0.0, 120.0, 100.0, 2_000.0)
            .into_iter()
            .map(|(device, host, _)| (((device - 5_000_000) as f64 * rate) as i64, host))
            .collect();
        let (told, found) = told_rate(&of_rate).unwrap_or_else(|| panic!("nothing is told of a rate of {rate}"));
        assert!((found / rate - 1.0).abs() < 0.01 && told < 100 * within_s, "{rate}: {found} after {told} samples");
        assert_eq!(unit_of_clock(found), unit, "{rate}");
        // What had waited in front of its port changes nothing.
        let mut waited = of_rate.clone();
        let release_us = waited[60].1;
        waited[..60].iter_mut().for_each(|stamp| stamp.1 = release_us);
        assert!(told_rate(&waited).is_some_and(|(_, found)| (found / rate - 1.0).abs() < 0.01), "{rate}, behind a backlog");
        cases += 1;
    }
    assert_eq!(cases, 6);
}

/// The controls: what is late, what waits and what stands still is no rate.
#[test]
fn crystals_backlogs_pauses_and_halts_are_no_wrong_rate() {
    let even = stamps(22, 200.0, 300.0, 100.0, 2_000.0);
    let late = |late_us: &dyn Fn(i64) -> i64| -> Vec<(i64, i64)> {
        even.iter().enumerate().map(|(i, (device, host, _))| (*device, host + late_us(i as i64))).collect()
    };
    let cases: [(&str, Vec<(i64, i64)>); 8] = [
        ("200 ppm", late(&|_| 0)),
        // What had waited in front of the port comes at once; two and a half seconds are worked off later, a tenth faster than it is sent.
        ("waited", late(&|i| (900_000 - 10_000 * i).max(0))),
        ("waited and worked off", late(&|i| (2_500_000 - 1_000 * i).max(0))),
        ("worked off", late(&|i| if i < 2_000 { 0 } else { (2_500_000 - 1_000 * (i - 2_000)).max(0) })),
        ("halted", late(&|i| if i < 1_500 { 0 } else { 200_000 })),
        ("stalls", late(&|i| if i % 700 < 60 { 600_000 - 10_000 * (i % 700) } else { 0 })),
        ("frozen at once", even.iter().map(|(_, host, _)| (5_000_000, *host)).collect()),
        ("frozen later", even.iter().map(|(device, host, _)| ((*device).min(25_000_000), *host)).collect()),
    ];
    for (what, stamps) in &cases {
        assert_eq!(told_rate(stamps), None, "{what}");
    }
    // A device without a clock has the host's.
    let mut clock = DeviceClock::of_host(20_000.0);
    for (i, (_, host, _)) in even.iter().enumerate() {
        clock.observe(0, Next, i as u32, *host, *host);
    }
    assert_eq!(clock.latest().and_then(|segment| segment.wrong_rate()), None);
}
