//! Days at the C-arm, drawn with the truth: an orderly one, as the demo's, and days on which one thing goes wrong as it does in a theatre.
//!
//! Where `binding_sessions` mixes everything, these keep to one story each, and most of their frames come promptly.

use sidecarm::timeline::FrameEvidence;

use crate::binding_draw::{Draw, Exposed, Sent, Session, Truth, samples, us};
use crate::timeline_joints::T0_US;

/// What happens on the day.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Day {
    /// Every exposure's frame comes promptly, with counter and stamp.
    Orderly,
    /// As orderly, but frames have neither counter nor stamp.
    ArrivalOnly,
    /// The next patient: console, C-arm or both count from 1 again, and pictures of the patient before come in between.
    NextPatient,
    /// The console's clock is set in the middle, by -2 to +60 s.
    ClockSet,
    /// Exposures without a frame; some consoles count only what they store.
    Aborted,
    /// The C-arm's line is silent for half a minute, once or twice.
    LineLost,
    /// Long runs of fluoroscopy close to each other; the last image of each is stored.
    Fluoroscopy,
    /// The held image is stored as a picture of its own now and then.
    HeldImage,
    /// Frames are stored twice: the same file, or the same picture in another.
    StoredTwice,
    /// Nothing comes until the end or the middle, then everything in reverse order.
    ReverseExport,
}

pub const DAYS: [Day; 10] = [
    Day::Orderly,
    Day::ArrivalOnly,
    Day::NextPatient,
    Day::ClockSet,
    Day::Aborted,
    Day::LineLost,
    Day::Fluoroscopy,
    Day::HeldImage,
    Day::StoredTwice,
    Day::ReverseExport,
];

pub fn day_of(seed: u64) -> Day {
    DAYS[(seed % DAYS.len() as u64) as usize]
}

/// What the console's counter counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Numbering {
    Absent,
    Constant,
    /// It is the C-arm's own (without one: the exposures, from 1).
    Equal,
    /// The exposures, from somewhere else.
    Shifted(u32),
    /// The pictures that the console stored, from 1.
    Stored,
}

/// Contents of pictures that are no exposure's first begin here.
const OTHER: usize = 1000;

/// Starts and ends, seconds from the session's begin.
fn exposures(draw: &mut Draw, day: Day) -> Vec<(f64, f64)> {
    let rhythm = if matches!(day, Day::ArrivalOnly) { draw.pick(&[1, 1, 3]) } else { draw.below(4) };
    let (even_s, count) = (draw.pick(&[5.0, 10.0, 15.0, 30.0]), 8 + draw.below(33));
    let mut at = draw.between(3.0, 30.0);
    let mut found = Vec::new();
    for index in 0..count {
        let fluoroscopy = day == Day::Fluoroscopy && draw.chance(0.7);
        let length = if fluoroscopy { draw.log(0.5, 15.0) } else { draw.between(0.1, 0.7) };
        found.push((at, at + length));
        at += length
            + match rhythm {
                // As close as the demo's.
                0 => draw.between(0.5, 3.0),
                1 => draw.log(3.0, 90.0),
                2 if index % 3 < 2 => draw.between(0.4, 2.0),
                3 => (even_s - length).max(0.3),
                _ => draw.log(0.4, 60.0),
            };
    }
    found
}

/// The console of that day.
struct Console {
    numbering: Numbering,
    resolution_s: Option<f64>,
    ahead_s: f64,
    drift: f64,
    /// From this time on its clock is ahead by so much more.
    set: Option<(f64, f64)>,
    marks_end: bool,
    lag_s: f64,
}

impl Console {
    fn draw(draw: &mut Draw, day: Day, truth_s: &[(f64, f64)]) -> Self {
        let shift = draw.pick(&[1, 1, 2, 3]) + if draw.chance(0.6) { draw.below(300) as u32 } else { 0 };
        let moving = [Numbering::Equal, Numbering::Equal, Numbering::Equal, Numbering::Shifted(shift), Numbering::Stored];
        let any = [Numbering::Equal, Numbering::Shifted(shift), Numbering::Stored, Numbering::Absent, Numbering::Constant];
        let resolution_s = draw.pick(&[Some(1.0), Some(1.0), Some(1.0), Some(1.0), Some(0.001), Some(1e-6), None]);
        let (numbering, resolution_s) = match (day, resolution_s) {
            (Day::ArrivalOnly, _) => (draw.pick(&[Numbering::Absent, Numbering::Constant]), None),
            (Day::Orderly, resolution_s) => (draw.pick(&moving[..4]), resolution_s.or(Some(1.0))),
            (_, None) => (draw.pick(&moving), None),
            (_, resolution_s) => (draw.pick(&any), resolution_s),
        };
        let middle_s = truth_s[truth_s.len() / 2].0;
        Self {
            numbering,
            resolution_s,
            ahead_s: draw.pick(&[0.0, 3600.0, -7200.0]) + draw.between(-90.0, 90.0),
            drift: draw.between(-100e-6, 100e-6),
            set: (day == Day::ClockSet).then(|| (middle_s + draw.between(-5.0, 5.0), draw.between(-2.0, 60.0))),
            marks_end: day == Day::Fluoroscopy && draw.chance(0.5) || draw.chance(0.1),
            lag_s: draw.pick(&[0.0, 0.0, 0.1]),
        }
    }

    /// What it writes for an event at `at_s`.
    fn stamp(&self, at_s: f64) -> Option<i64> {
        let resolution_s = self.resolution_s?;
        let set_s = self.set.filter(|(from_s, _)| at_s >= *from_s).map_or(0.0, |(_, by_s)| by_s);
        let console_s = (T0_US as f64 * 1e-6).floor() + at_s * (1.0 + self.drift) + self.ahead_s + set_s;
        Some(us((console_s / resolution_s).floor() * resolution_s))
    }

    fn event_s(&self, (start_s, end_s): (f64, f64)) -> f64 {
        if self.marks_end { end_s } else { start_s + self.lag_s }
    }
}

/// A picture that comes: when, stamp, counter, content, of what, late.
type Came = (f64, Option<i64>, Option<u32>, usize, Truth, bool);

/// Draws the day of this seed.
pub fn day(seed: u64, day: Day) -> Session {
    let mut draw = Draw::new(seed, 100 + day as u32);
    let truth_s = exposures(&mut draw, day);
    let count = truth_s.len();
    let end_s = truth_s[count - 1].1 + draw.between(10.0, 60.0);
    let console = Console::draw(&mut draw, day, &truth_s);

    let counts = draw.chance(0.75);
    let first_counter = if draw.chance(0.5) { 0 } else { draw.below(60) as u32 };
    let anew = (day == Day::NextPatient).then(|| 1 + draw.below(count - 1));
    // Which of the two begins anew: the console's number alone, or the C-arm's with it.
    let arm_too = draw.chance(0.5);
    let arm_counter = |index: usize| match anew.filter(|at| arm_too && index >= *at) {
        Some(at) => (index - at) as u32 + 1,
        None => first_counter + index as u32 + 1,
    };
    let silences = if day == Day::LineLost { 1 + draw.below(2) } else { usize::from(draw.chance(0.1)) };
    let holes: Vec<(f64, f64)> = (0..silences)
        .map(|_| {
            let from_s = truth_s[draw.below(count)].0 + draw.between(-20.0, 5.0);
            let length_s = if day == Day::LineLost { draw.between(10.0, 40.0) } else { draw.between(0.1, 0.6) };
            (from_s, from_s + length_s)
        })
        .collect();
    let rate_hz = draw.between(20.0, 30.0);
    let samples = samples(&mut draw, &truth_s, end_s, rate_hz, counts.then_some(&arm_counter), first_counter, &holes);

    // The frames.
    let missing = match day {
        Day::Aborted => draw.between(0.05, 0.4),
        Day::Orderly => 0.0,
        _ => draw.pick(&[0.0, 0.0, 0.03]),
    };
    let straggling = if matches!(day, Day::Orderly | Day::ArrivalOnly) { 0.0 } else { draw.pick(&[0.0, 0.0, 0.02, 0.05]) };
    let (least_s, jitter_s) = (draw.between(0.3, 1.0), draw.pick(&[0.05, 0.3, 0.7]));
    let exported = if day == Day::ReverseExport { draw.pick(&[count, count, count / 2]) } else { 0 };
    let mut stored = 0;
    let mut came: Vec<Came> = Vec::new();
    let mut last_s = 0.0f64;
    for (index, exposure) in truth_s.iter().enumerate() {
        if anew == Some(index) {
            stored = 0;
        }
        if draw.chance(missing) {
            continue;
        }
        stored += 1;
        let since = anew.filter(|at| index >= *at).unwrap_or(0);
        let counter = match console.numbering {
            Numbering::Absent => None,
            Numbering::Constant => Some(1),
            Numbering::Equal if counts => Some(arm_counter(index)),
            Numbering::Equal => Some((index - since) as u32 + 1),
            Numbering::Shifted(shift) => Some((index - since) as u32 + 1 + shift),
            Numbering::Stored => Some(stored),
        };
        let stamp = console.stamp(console.event_s(*exposure));
        let late = index < exported || draw.chance(straggling);
        let arrival_s = if index < exported {
            // In reverse order, one after the other.
            truth_s[exported - 1].1 + 20.0 + 0.15 * (exported - index) as f64
        } else if late {
            exposure.1 + draw.log(7.0, 600.0)
        } else {
            last_s = (exposure.1 + least_s + draw.between(0.0, jitter_s)).max(last_s + 0.02);
            last_s
        };
        came.push((arrival_s, stamp, counter, index, Truth::Of(index), late));
        // The held image is gone once the next exposure has begun, and a hand on the key is no foot on the pedal.
        let saved_s = exposure.1 + draw.between(0.3, 6.0);
        let until_s = truth_s.get(index + 1).map_or(f64::INFINITY, |next| next.0 - 1.0);
        if day == Day::HeldImage && draw.chance(0.4) && saved_s < until_s {
            let own_number = console.numbering == Numbering::Stored || draw.chance(0.2);
            stored += u32::from(own_number);
            let counter = match console.numbering {
                Numbering::Stored => Some(stored),
                _ if own_number => counter.map(|counter| counter + 1),
                _ => counter,
            };
            let stamp = if draw.chance(0.5) { console.stamp(saved_s) } else { stamp };
            let comes_s = saved_s + least_s + draw.between(0.0, jitter_s);
            came.push((comes_s, stamp, counter, OTHER + index, Truth::SecondOf(index), late));
        }
        if day == Day::StoredTwice && draw.chance(0.25) {
            let (content, truth) = if draw.chance(0.5) { (index, Truth::Copy) } else { (OTHER + index, Truth::SecondOf(index)) };
            came.push((arrival_s + draw.log(0.02, 20.0), stamp, counter, content, truth, late));
        }
    }
    // Pictures of the patient before, exported while the next one is under the beam.
    if let Some(anew) = anew {
        let from_s = truth_s[anew].0 + draw.between(-20.0, 60.0);
        for nth in 0..draw.below(5) {
            let at_s = from_s + draw.between(0.0, 1.0) + 0.5 * nth as f64;
            let counter = match console.numbering {
                Numbering::Absent => None,
                Numbering::Constant => Some(1),
                _ => Some(1 + draw.below(60) as u32),
            };
            let stamp = console.stamp(-draw.log(600.0, 20_000.0));
            came.push((at_s, stamp, counter, 2 * OTHER + nth, Truth::Foreign, false));
        }
    }
    session(seed, day, &console, &truth_s, counts.then_some(&arm_counter), samples, came)
}

fn session(
    seed: u64,
    day: Day,
    console: &Console,
    truth_s: &[(f64, f64)],
    counter: Option<&dyn Fn(usize) -> u32>,
    samples: Vec<(i64, sidecarm::telemetry::CarmSample)>,
    mut came: Vec<Came>,
) -> Session {
    let described = format!(
        "{day:?} seed {seed}: counter {:?} (telemetry {}), stamp every {:?} s",
        console.numbering,
        counter.is_some(),
        console.resolution_s
    );
    came.sort_by(|a, b| a.0.total_cmp(&b.0));
    let numbered = matches!(console.numbering, Numbering::Equal | Numbering::Shifted(_)) && day != Day::NextPatient;
    let stamp = |index: usize| console.stamp(console.event_s(truth_s[index]));
    let twin = |index: usize| {
        let apart = |other: usize| truth_s[other].0 - truth_s[index].1 > 7.0 || truth_s[index].0 - truth_s[other].1 > 7.0;
        if day == Day::ArrivalOnly {
            return !(0..truth_s.len()).all(|other| other == index || apart(other));
        }
        !numbered && (0..truth_s.len()).any(|other| other != index && stamp(other) == stamp(index))
    };
    let sent = |(number, came): (usize, &Came)| {
        let (arrival_s, console_us, counter, content, truth, late) = *came;
        let evidence = FrameEvidence {
            frame: number as u32,
            content: format!("{content:064x}"),
            image_of_file: [0, 1],
            counter,
            console_us,
            console_resolution_us: console.resolution_s.map_or(1_000_000, us).max(1),
            arrival_us: Some(T0_US + us(arrival_s)),
            frame_time_us: None,
            image_times_us: Vec::new(),
            stated_length_us: None,
            last_image: false,
            completes: None,
        };
        Sent { evidence, truth, late, twin: matches!(truth, Truth::Of(index) if twin(index)) }
    };
    let frames = came.iter().enumerate().map(sent).collect();
    let exposures = truth_s.iter().enumerate().map(|(index, (start_s, end_s))| Exposed {
        start_us: T0_US + us(*start_s),
        end_us: T0_US + us(*end_s),
        counter: counter.map(|counter| counter(index)),
    });
    Session { described, exposures: exposures.collect(), samples, frames }
}
