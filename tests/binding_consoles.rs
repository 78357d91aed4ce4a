//! Two consoles that write into one folder.

use sidecarm::telemetry::{CarmSample, DeviceKind, Sample, SequenceTracker};
use sidecarm::timeline::{Binder, FrameEvidence, Timeline};

const SHOTS: u32 = 4;
/// Between two samples of the arm.
const STEP_US: i64 = 20_000;

/// When the exposure begins, 0.3 s before it ends.
fn begin_us(shot: u32) -> i64 {
    8_000_000 + 1_600_000 * i64::from(shot)
}

/// The arm's sample at a time.
fn sample(n: u32) -> CarmSample {
    let at_us = STEP_US * i64::from(n);
    let begun = (0..SHOTS).filter(|shot| begin_us(*shot) <= at_us).count() as u32;
    let xray_on = begun.checked_sub(1).is_some_and(|shot| at_us < begin_us(shot) + 300_000);
    CarmSample { device_us: at_us as u64, sequence: n, xray_on, exposure_counter: Some(begun), ..CarmSample::UNTOLD }
}

/// The exposures, by the arm's counter, that the frames of each console were bound to. Both count alike, and after each exposure the frame of the
/// second comes 0.36 s after that of the first.
fn bound_of(studies: [Option<&str>; 2]) -> [Vec<Option<u32>>; 2] {
    let (mut timeline, mut sequence, mut binder) = (Timeline::new(), SequenceTracker::default(), Binder::new());
    let came_us = |shot: u32, console: u32| begin_us(shot) + 600_000 + 360_000 * i64::from(console);
    for n in 0..800 {
        let (at_us, sample) = (STEP_US * i64::from(n), sample(n));
        let sequenced = sequence.take(n, sample.device_us);
        timeline.push_sample(DeviceKind::Carm, at_us, 0, sequenced, Sample::Carm(sample));
        for shot in 0..SHOTS {
            for (console, study) in (0..).zip(studies) {
                // The first frame is read when it comes, the others together with those of the other console.
                let read_us = if shot == 0 { came_us(shot, console) } else { came_us(shot, 1) };
                if at_us != read_us {
                    continue;
                }
                let stamp_us = if console == 0 { begin_us(shot) + 7_000 } else { came_us(shot, 1) - 400_000 };
                let frame = 1 + 2 * shot + console;
                binder.note_study(frame, study);
                binder.push(FrameEvidence {
                    frame,
                    content: format!("{frame}"),
                    image_of_file: [0, 1],
                    counter: Some(shot + 1),
                    console_us: Some(stamp_us),
                    console_resolution_us: 1000,
                    arrival_us: Some(came_us(shot, console)),
                    ..FrameEvidence::default()
                });
            }
        }
        binder.update(&timeline, at_us);
    }
    timeline.finish();
    binder.finish(&timeline);
    let bound = |frame: u32| binder.binding(frame)?.exposure.as_ref()?.counter;
    [0, 1].map(|console| (0..SHOTS).map(|shot| bound(1 + 2 * shot + console)).collect())
}

/// A second console that wrote into the folder cost the first one the exposures of its frames.
#[test]
fn another_console_is_left_out_by_its_study() {
    let [own, others] = bound_of([Some("own"), Some("other")]);
    assert_eq!(own, [Some(1), Some(2), Some(3), Some(4)]);
    assert_eq!(others, [None; 4]);
    // The control: nothing tells them apart.
    let [own, _] = bound_of([None, None]);
    assert!(own.contains(&None), "{own:?}");
}

/// A console that begins a new study, and counts from one again, is the same console.
#[test]
fn a_console_that_begins_a_new_study_is_not_left_out() {
    let (mut timeline, mut sequence, mut binder) = (Timeline::new(), SequenceTracker::default(), Binder::new());
    for n in 0..800 {
        let (at_us, sample) = (STEP_US * i64::from(n), sample(n));
        let sequenced = sequence.take(n, sample.device_us);
        timeline.push_sample(DeviceKind::Carm, at_us, 0, sequenced, Sample::Carm(sample));
        for shot in (0..SHOTS).filter(|shot| begin_us(*shot) + 600_000 == at_us) {
            let (frame, is_new) = (1 + shot, shot >= 2);
            binder.note_study(frame, Some(if is_new { "new" } else { "old" }));
            binder.push(FrameEvidence {
                frame,
                content: format!("{frame}"),
                image_of_file: [0, 1],
                counter: Some(if is_new { shot - 1 } else { shot + 1 }),
                console_us: Some(begin_us(shot) + 7_000),
                console_resolution_us: 1000,
                arrival_us: Some(at_us),
                ..FrameEvidence::default()
            });
        }
        binder.update(&timeline, at_us);
    }
    timeline.finish();
    binder.finish(&timeline);
    for frame in 1..=SHOTS {
        let words = binder.binding(frame).map(|binding| binding.evidence.join(" ")).unwrap_or_default();
        assert!(!words.contains("it takes no part"), "frame {frame}: {words}");
    }
}
