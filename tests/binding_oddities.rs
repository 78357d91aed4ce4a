//! Consoles and people that do what `binding_sessions` and `binding_days` never drew: one oddity a session, drawn with the truth and without
//! regard to what can be bound.

use sidecarm::timeline::FrameEvidence;

use crate::binding_draw::{Draw, Exposed, Sent, Session, Truth, samples, us};
use crate::timeline_joints::T0_US;

/// What is odd.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Oddity {
    /// All pictures of a series carry the time at which the series began.
    SeriesStamp,
    /// The counter begins at 1 in every series.
    SeriesCount,
    /// The console's clock goes over to summer or winter time.
    SummerTime,
    /// Someone sets the console's clock, by up to ten minutes either way.
    ClockSet,
    /// Pairs of exposures half a second apart.
    HalfSecond,
    /// Each series is exported when it is over, the last picture first.
    ReverseSeries,
    /// Runs of several images in one file between single exposures.
    Runs,
    /// A third of the exposures has no picture: switched off at once, or discarded.
    NoPicture,
    /// Pictures of another room, whose console keeps the same time, come into the same folder.
    OtherRoom,
    /// Pictures are exported again: re-coded, under another name, some with the time of the export.
    ExportedAgain,
    /// Exposures follow each other like a clock's ticks, some without a picture, while telemetry may be slow and the console off by just
    /// one of them, in its clock, in its count, or in both.
    Rhythm,
}

const ODDITIES: [Oddity; 11] = [
    Oddity::SeriesStamp,
    Oddity::SeriesCount,
    Oddity::SummerTime,
    Oddity::ClockSet,
    Oddity::HalfSecond,
    Oddity::ReverseSeries,
    Oddity::Runs,
    Oddity::NoPicture,
    Oddity::OtherRoom,
    Oddity::ExportedAgain,
    Oddity::Rhythm,
];

pub fn oddity_of(seed: u64) -> Oddity {
    ODDITIES[(seed % ODDITIES.len() as u64) as usize]
}

/// An exposure, seconds from the session's begin, and its series.
#[derive(Clone, Copy)]
struct Shot {
    start_s: f64,
    end_s: f64,
    series: usize,
    /// Images of its file.
    images: u32,
}

fn shots(draw: &mut Draw, oddity: Oddity) -> Vec<Shot> {
    let mut at_s = draw.between(5.0, 30.0);
    if oddity == Oddity::Rhythm {
        let (count, period_s, length_s) = (4 + draw.below(20), draw.between(1.2, 4.5), draw.between(0.1, 0.5));
        let begins_s = (0..count).map(|i| at_s + period_s * i as f64);
        return begins_s.map(|start_s| Shot { start_s, end_s: start_s + length_s, series: 0, images: 1 }).collect();
    }
    let mut found: Vec<Shot> = Vec::new();
    for series in 0..8 + draw.below(8) {
        let count = if oddity == Oddity::HalfSecond { 2 } else { 1 + draw.below(5) };
        for _ in 0..count {
            let images = if oddity == Oddity::Runs && draw.chance(0.3) { 2 + draw.below(12) as u32 } else { 1 };
            let length_s = if images > 1 { draw.between(0.8, 6.0) } else { draw.between(0.1, 0.6) };
            found.push(Shot { start_s: at_s, end_s: at_s + length_s, series, images });
            at_s += length_s + if oddity == Oddity::HalfSecond { 0.5 } else { draw.log(0.8, 8.0) };
        }
        at_s += draw.log(5.0, 90.0);
    }
    found
}

/// A picture as it comes: arrival, stamp, counter, content, place in its file, what it is, whether it is late.
struct Picture {
    arrival_s: f64,
    console_us: Option<i64>,
    counter: Option<u32>,
    content: usize,
    image: [u32; 2],
    truth: Truth,
    late: bool,
}

/// Contents of pictures that are no exposure's first.
const OTHER: usize = 1000;

/// Draws the session of this seed.
pub fn odd_session(seed: u64, oddity: Oddity) -> Session {
    let mut draw = Draw::new(seed, 200 + oddity as u32);
    let shots = shots(&mut draw, oddity);
    let end_s = shots.last().expect("there are exposures").end_s + draw.between(20.0, 60.0);
    let counts = draw.chance(0.6);
    let first = if draw.chance(0.4) { 0 } else { draw.below(80) as u32 };
    let arm_counter = |index: usize| first + index as u32 + 1;
    let times: Vec<(f64, f64)> = shots.iter().map(|shot| (shot.start_s, shot.end_s)).collect();
    let rhythm = oddity == Oddity::Rhythm;
    let rate_hz = if rhythm { draw.pick(&[2.0, 5.0, 10.0, 30.0]) } else { draw.between(18.0, 30.0) };
    let samples = samples(&mut draw, &times, end_s, rate_hz, counts.then_some(&arm_counter), first, &[]);

    // The console.
    let period_s = times[1].0 - times[0].0;
    let off_s = match oddity {
        Oddity::Rhythm => draw.pick(&[0.0, 0.0, 0.0, period_s, -period_s, 170.0]) + draw.between(-0.3, 0.3),
        _ => draw.between(-300.0, 300.0),
    };
    let ahead_s = draw.pick(&[0.0, 0.0, 3600.0, -18000.0]) + off_s;
    let drift = draw.between(-200e-6, 200e-6);
    let resolution_s = if oddity == Oddity::HalfSecond { 1.0 } else { draw.pick(&[1.0, 1.0, 1.0, 0.1, 0.001]) };
    let set_at_s = times[draw.below(times.len())].0 + draw.between(-3.0, 3.0);
    let set_by_s = match oddity {
        Oddity::SummerTime => draw.pick(&[3600.0, -3600.0]),
        Oddity::ClockSet => draw.pick(&[1.0, -1.0]) * draw.log(1.0, 600.0),
        _ => 0.0,
    };
    let stamp = |at_s: f64| {
        let set_s = if at_s >= set_at_s { set_by_s } else { 0.0 };
        let console_s = (T0_US as f64 * 1e-6).floor() + at_s * (1.0 + drift) + ahead_s + set_s;
        Some(us((console_s / resolution_s).floor() * resolution_s))
    };
    // What its counter counts: nothing, always 1, the exposures like the C-arm or from elsewhere, the stored pictures.
    let numbering = draw.below(5);
    let shift = if rhythm { first + draw.below(3) as u32 } else { draw.below(200) as u32 };
    let marks_end = draw.chance(0.25);
    let lacks = match oddity {
        Oddity::NoPicture => 0.33,
        Oddity::Rhythm => draw.pick(&[0.0, 0.1, 0.3]),
        _ => draw.pick(&[0.0, 0.02]),
    };
    let (delay_s, jitter_s) = (draw.between(0.3, 1.5), draw.pick(&[0.1, 0.5, 1.0]));
    let late_share = draw.pick(&[0.0, 0.0, 0.1]);
    let mut stored = 0;
    let mut in_series = (usize::MAX, 0);
    let mut came: Vec<Picture> = Vec::new();
    for (index, shot) in shots.iter().enumerate() {
        in_series = if in_series.0 == shot.series { (shot.series, in_series.1 + 1) } else { (shot.series, 1) };
        if draw.chance(lacks) {
            continue;
        }
        stored += 1;
        let counter = match numbering {
            _ if oddity == Oddity::SeriesCount => Some(in_series.1),
            0 => None,
            1 => Some(1),
            2 => Some(arm_counter(index)),
            3 => Some(index as u32 + 1 + shift),
            _ => Some(stored),
        };
        let series = || shots.iter().filter(|other| other.series == shot.series);
        let event_s = match oddity {
            Oddity::SeriesStamp => series().map(|other| other.start_s).fold(f64::INFINITY, f64::min),
            _ if marks_end => shot.end_s,
            _ => shot.start_s,
        };
        let console_us = stamp(event_s);
        let over_s = series().map(|other| other.end_s).fold(0.0, f64::max);
        let late = draw.chance(late_share);
        let arrival_s = match oddity {
            Oddity::ReverseSeries => over_s + delay_s + 0.2 * (series().count() as u32 - in_series.1) as f64,
            _ if late => shot.end_s + draw.log(7.0, 900.0),
            _ => shot.end_s + delay_s + draw.between(0.0, jitter_s),
        };
        for image in 0..shot.images {
            came.push(Picture {
                arrival_s: arrival_s + 1e-4 * f64::from(image),
                console_us,
                counter,
                content: index,
                image: [image, shot.images],
                truth: Truth::Of(index),
                late: late || oddity == Oddity::ReverseSeries,
            });
        }
        if oddity == Oddity::ExportedAgain && draw.chance(0.25) {
            let arrival_s = arrival_s + draw.log(0.5, 300.0);
            let console_us = if draw.chance(0.3) { stamp(arrival_s - 0.3) } else { console_us };
            let (image, truth) = ([0, 1], Truth::SecondOf(index));
            came.push(Picture { arrival_s, console_us, counter, content: OTHER + index, image, truth, late: true });
        }
    }
    if oddity == Oddity::OtherRoom {
        let (other_counter, other_s) = (draw.below(80) as u32, draw.between(-2.0, 2.0));
        for nth in 0..2 + draw.below(8) {
            let taken_s = draw.between(0.0, end_s - 10.0);
            let counter = (numbering > 0).then_some(if numbering == 1 { 1 } else { other_counter + nth as u32 });
            came.push(Picture {
                arrival_s: taken_s + delay_s + draw.between(0.0, jitter_s),
                console_us: stamp(taken_s + other_s),
                counter,
                content: 2 * OTHER + nth,
                image: [0, 1],
                truth: Truth::Foreign,
                late: false,
            });
        }
    }
    came.sort_by(|a, b| a.arrival_s.total_cmp(&b.arrival_s));
    let frames = came.into_iter().zip(0..).map(|(picture, frame)| Sent {
        evidence: FrameEvidence {
            frame,
            content: format!("{:064x}", picture.content),
            image_of_file: picture.image,
            counter: picture.counter,
            console_us: picture.console_us,
            console_resolution_us: us(resolution_s),
            arrival_us: Some(T0_US + us(picture.arrival_s)),
            frame_time_us: None,
            image_times_us: Vec::new(),
            stated_length_us: None,
            last_image: false,
            completes: None,
        },
        truth: picture.truth,
        late: picture.late,
        twin: false,
    });
    let exposures = times.iter().enumerate().map(|(index, (start_s, end_s))| Exposed {
        start_us: T0_US + us(*start_s),
        end_us: T0_US + us(*end_s),
        counter: counts.then(|| arm_counter(index)),
    });
    let described = format!("{oddity:?} seed {seed}: numbering {numbering} (telemetry {counts}), stamp every {resolution_s} s");
    Session { described, exposures: exposures.collect(), samples, frames: frames.collect() }
}
