//! Sessions drawn at random, with the truth: what telemetry saw, which frames came when, and which exposure each frame is of.
//!
//! The generators know nothing of how frames are bound. They draw what consoles and people do: late exports, shuffled, with gaps; clocks
//! that are off by minutes, by a time zone, and drift; counters that are absent, constant, shifted, restarted; exposures in bursts and at
//! the minute; telemetry with holes; frames of something else; files that come twice; two pictures of one exposure.

use sidecarm::timeline::FrameEvidence;

use crate::binding_draw::{Draw, Exposed, Sent, Session, Truth, samples, us};
use crate::timeline_joints::T0_US;

/// Arrival in seconds, stamp, counter, content, what it is of, whether it is late.
type Arrived = (f64, Option<i64>, Option<u32>, usize, Truth, bool);

/// How a session is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Everything at random.
    Mixed,
    /// Exposures at the minute (or half minute), the console's clock off by whole minutes, no counter.
    AtTheMinute,
    /// Bursts of exposures 0.5 to 1.5 s apart.
    Bursts,
    /// Telemetry with many holes, some over exposures.
    Holes,
    /// No stamps: the counter is all there is besides arrival.
    CounterOnly,
    /// The counter is always 1 or absent: the stamp is all there is.
    StampOnly,
    /// Neither stamp nor counter: arrival is all there is, and a third of the frames comes late.
    Neither,
    /// Nothing odd: full telemetry, stamps to the second by a clock off by minutes that drifts, any counter but a restarting one, frames
    /// that are missing, 22 that come late and shuffled. Not among [`KINDS`]: a table of its own.
    Late,
}

/// Shares in a hundred sessions.
pub const KINDS: [(Kind, u64); 7] = [
    (Kind::Mixed, 55),
    (Kind::AtTheMinute, 10),
    (Kind::Bursts, 8),
    (Kind::Holes, 8),
    (Kind::CounterOnly, 7),
    (Kind::StampOnly, 10),
    (Kind::Neither, 2),
];

pub fn kind_of(seed: u64) -> Kind {
    let mut rest = seed % 100;
    for (kind, share) in KINDS {
        if rest < share {
            return kind;
        }
        rest -= share;
    }
    Kind::Mixed
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Counting {
    Absent,
    Constant,
    Right,
    Offset,
    Restarting,
}

const EXPOSURES: usize = 60;
const LATE: usize = 22;

/// Starts and ends, seconds from the session's begin.
fn exposures(draw: &mut Draw, kind: Kind) -> Vec<(f64, f64)> {
    let regime = match kind {
        Kind::AtTheMinute => 0,
        Kind::Bursts => 2,
        Kind::Late => draw.pick(&[1, 3]),
        Kind::Neither | Kind::StampOnly | Kind::CounterOnly | Kind::Holes | Kind::Mixed => draw.pick(&[0, 1, 1, 1, 2, 3]),
    };
    let period = if kind == Kind::AtTheMinute { draw.pick(&[20.0, 30.0, 60.0]) } else { draw.pick(&[5.0, 12.0, 20.0, 30.0]) };
    let jitter = draw.pick(&[0.0, 0.05, 0.3, 1.0]);
    let mut at = draw.between(5.0, 30.0);
    let mut left_in_burst = 0;
    let mut found: Vec<(f64, f64)> = Vec::new();
    for index in 0..EXPOSURES {
        let length = draw.between(0.1, 0.7);
        let start = if regime == 0 { at + draw.between(-jitter, jitter) } else { at };
        let earliest = found.last().map_or(1.0, |(_, end): &(f64, f64)| end + 0.25);
        let start = start.max(earliest);
        found.push((start, start + length));
        at = match regime {
            0 => 10.0 + period * (index + 1) as f64,
            1 => start + draw.log(2.0, 90.0),
            2 if left_in_burst > 0 => {
                left_in_burst -= 1;
                start + draw.between(0.5, 1.5)
            }
            2 => {
                left_in_burst = draw.below(5);
                start + draw.log(8.0, 90.0)
            }
            _ => start + draw.log(0.5, 120.0),
        };
    }
    found
}

/// Draws the session of this seed.
pub fn session(seed: u64, kind: Kind) -> Session {
    let mut draw = Draw::new(seed, kind as u32);
    let truth_s = exposures(&mut draw, kind);
    let end_s = truth_s.last().expect("there are exposures").1 + draw.between(20.0, 90.0);

    // The C-arm: rate, counter with a reset now and then, holes.
    let rate_hz = draw.between(15.0, 30.0);
    let counts = match kind {
        Kind::AtTheMinute => draw.chance(0.3),
        Kind::CounterOnly => draw.chance(0.7),
        _ => draw.chance(0.6),
    };
    let first_counter = draw.below(40) as u32;
    let reset_at = (counts && draw.chance(0.08)).then(|| draw.below(EXPOSURES));
    let telemetry_counter = |index: usize| match reset_at {
        Some(at) if index >= at => (index - at) as u32 + 1,
        _ => first_counter + index as u32 + 1,
    };
    let holes = match kind {
        Kind::Holes => 3 + draw.below(6),
        Kind::Late => 0,
        _ if draw.chance(0.35) => 1 + draw.below(3),
        _ => 0,
    };
    let holes: Vec<(f64, f64)> = (0..holes)
        .map(|_| {
            let near = truth_s[draw.below(EXPOSURES)].0;
            let from = if draw.chance(0.5) { near + draw.between(-3.0, 3.0) } else { draw.between(0.0, end_s) };
            (from, from + draw.log(0.3, 20.0))
        })
        .collect();
    let samples = samples(&mut draw, &truth_s, end_s, rate_hz, counts.then_some(&telemetry_counter), first_counter, &holes);

    // The console: its clock, what its stamp marks, its counter.
    let offset_s = if kind == Kind::AtTheMinute || draw.chance(0.25) {
        60.0 * draw.between(-10.0, 10.0).round()
    } else {
        draw.between(-600.0, 600.0)
    };
    let zone_s = if kind != Kind::Late && draw.chance(0.4) { 3600.0 * draw.between(-12.0, 12.0).round() } else { 0.0 };
    let drift = draw.between(-200e-6, 200e-6);
    let resolution_s = match kind {
        Kind::CounterOnly | Kind::Neither => None,
        Kind::Late => Some(1.0),
        Kind::StampOnly | Kind::AtTheMinute => Some(draw.pick(&[1.0, 1.0, 1.0, 0.1])),
        _ if draw.chance(0.06) => None,
        _ if draw.chance(0.03) => Some(60.0),
        _ => Some(draw.pick(&[1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.1, 0.001])),
    };
    let marks_end = draw.chance(0.3);
    let lag_s = draw.pick(&[0.0, 0.0, 0.05, 0.3]);
    let mut counting = match kind {
        Kind::Neither | Kind::StampOnly => draw.pick(&[Counting::Absent, Counting::Constant]),
        Kind::Late => draw.pick(&[Counting::Absent, Counting::Constant, Counting::Right, Counting::Offset]),
        Kind::AtTheMinute => draw.pick(&[Counting::Absent, Counting::Constant, Counting::Constant, Counting::Restarting]),
        Kind::CounterOnly => draw.pick(&[
            Counting::Right,
            Counting::Right,
            Counting::Right,
            Counting::Offset,
            Counting::Offset,
            Counting::Restarting,
        ]),
        _ => draw.pick(&[
            Counting::Absent,
            Counting::Constant,
            Counting::Constant,
            Counting::Right,
            Counting::Right,
            Counting::Right,
            Counting::Offset,
            Counting::Restarting,
        ]),
    };
    if resolution_s.is_none() && kind != Kind::Neither && matches!(counting, Counting::Absent | Counting::Constant) {
        counting = Counting::Right;
    }
    // Whole minutes tell exposures apart only together with a counter.
    let moves = !matches!(counting, Counting::Absent | Counting::Constant);
    let resolution_s = if resolution_s == Some(60.0) && !moves { Some(1.0) } else { resolution_s };
    let shift = 1 + draw.below(300) as u32;
    let restarts = [draw.below(EXPOSURES), draw.below(EXPOSURES)];
    let frame_counter = |index: usize| match counting {
        Counting::Absent => None,
        Counting::Constant => Some(1),
        Counting::Right if counts => Some(telemetry_counter(index)),
        Counting::Right => Some(index as u32 + 1),
        Counting::Offset if counts => Some(telemetry_counter(index) + shift),
        Counting::Offset => Some(index as u32 + shift),
        Counting::Restarting => {
            let from = restarts.iter().filter(|at| **at <= index).max().copied().unwrap_or(0);
            Some((index - from) as u32 + 1)
        }
    };
    let is_odd = kind != Kind::Late;
    let stamp_missing = if is_odd && draw.chance(0.15) { 0.05 } else { 0.0 };
    let stamp = |draw: &mut Draw, index: usize| {
        let resolution_s = resolution_s?;
        if draw.chance(stamp_missing) {
            return None;
        }
        let (start, end) = truth_s[index];
        let event = if marks_end { end } else { start } + lag_s + draw.between(-0.03, 0.03);
        let console = (T0_US as f64 * 1e-6).floor() + event - offset_s - zone_s - drift * event;
        Some(us((console / resolution_s).floor() * resolution_s))
    };

    // The frames: some are never stored, 22 come late in batches, the others promptly and in order.
    let missing_share = draw.pick(&[0.0, 0.02, 0.05, 0.1]);
    let mut is_late = [false; EXPOSURES];
    let batches = 1 + draw.below(5);
    let mut batch_of = [0usize; EXPOSURES];
    let mut left = LATE;
    for batch in 0..batches {
        let size = if batch + 1 == batches { left } else { left.min(1 + draw.below(2 * LATE / batches)) };
        let mut chosen = 0;
        let mut at = draw.below(EXPOSURES);
        let runs = draw.chance(0.6);
        while chosen < size {
            if !is_late[at] {
                is_late[at] = true;
                batch_of[at] = batch;
                chosen += 1;
            }
            at = if runs { (at + 1) % EXPOSURES } else { draw.below(EXPOSURES) };
        }
        left -= size;
    }
    let mut sent: Vec<Arrived> = Vec::new();
    let base_delay = draw.between(0.3, 3.0);
    let delay_jitter = draw.between(0.05, 2.0);
    let mut last_prompt = 0.0f64;
    let mut late: Vec<Vec<usize>> = vec![Vec::new(); batches];
    for index in 0..EXPOSURES {
        if draw.chance(missing_share) {
            continue;
        }
        if is_late[index] {
            late[batch_of[index]].push(index);
            continue;
        }
        let arrival = (truth_s[index].1 + base_delay + draw.between(0.0, delay_jitter)).max(last_prompt + 0.02);
        last_prompt = arrival;
        sent.push((arrival, stamp(&mut draw, index), frame_counter(index), index, Truth::Of(index), false));
    }
    for batch in &mut late {
        let Some(last) = batch.iter().copied().max() else { continue };
        let mut at = truth_s[last].1 + draw.log(60.0, 3600.0);
        if draw.chance(0.7) {
            draw.shuffle(batch);
        }
        let pause = draw.log(0.02, 0.8);
        for index in batch.iter().copied() {
            sent.push((at, stamp(&mut draw, index), frame_counter(index), index, Truth::Of(index), true));
            at += pause * draw.between(0.5, 1.5);
        }
    }
    // A second picture of an exposure, with the same stamp and counter, soon after the first.
    let originals = sent.len();
    if is_odd && draw.chance(0.3) {
        for _ in 0..=draw.below(2) {
            let (at, stamp, counter, index, _, late) = sent[draw.below(originals)];
            sent.push((at + draw.between(0.02, 2.0), stamp, counter, EXPOSURES + sent.len(), Truth::SecondOf(index), late));
        }
    }
    // The same file again.
    for _ in 0..if is_odd { draw.below(3) } else { 0 } {
        let (at, stamp, counter, content, _, late) = sent[draw.below(originals)];
        sent.push((at + draw.log(0.5, 1000.0), stamp, counter, content, Truth::Copy, late));
    }
    // Frames of something else: an earlier patient, a picture without any header, a report.
    for _ in 0..if is_odd { draw.below(4) } else { 0 } {
        let at = draw.between(0.0, end_s);
        let stamp = (resolution_s.is_some() && draw.chance(0.6))
            .then(|| us((T0_US as f64 * 1e-6).floor() - zone_s - offset_s - draw.log(7200.0, 300_000.0).floor()));
        let counter = match resolution_s {
            Some(_) if draw.chance(0.5) => Some(1 + draw.below(60) as u32),
            _ => draw.chance(0.3).then_some(900_000 + draw.below(1000) as u32),
        };
        sent.push((at, stamp, counter, 10 * EXPOSURES + sent.len(), Truth::Foreign, false));
    }
    sent.sort_by(|a, b| a.0.total_cmp(&b.0));
    let second = |index: usize, resolution_s: f64| {
        let event = if marks_end { truth_s[index].1 } else { truth_s[index].0 } + lag_s;
        (((T0_US as f64 * 1e-6).floor() + event - offset_s - zone_s - drift * event) / resolution_s).floor()
    };
    // Another exposure with the same stamp and count that the frame may be of; a count and a prompt arrival are two kinds of evidence.
    let has_twin = |index: usize, arrival_s: f64, stamped: bool, late: bool| {
        (0..EXPOSURES).filter(|other| *other != index).any(|other| {
            let since_s = arrival_s - truth_s[other].1;
            let reach_s = if late || !moves { f64::INFINITY } else { 7.0 };
            let same_stamp = |resolution_s: f64| !stamped || second(other, resolution_s) == second(index, resolution_s);
            (0.0..reach_s).contains(&since_s)
                && resolution_s.is_none_or(same_stamp)
                && frame_counter(other) == frame_counter(index)
        })
    };
    let resolution_us = resolution_s.map_or(1_000_000, us);
    let frames = sent
        .into_iter()
        .enumerate()
        .map(|(number, (at_s, console_us, counter, content, truth, late))| Sent {
            evidence: FrameEvidence {
                frame: number as u32,
                content: format!("{content:064x}"),
                image_of_file: [0, 1],
                counter,
                console_us,
                console_resolution_us: if resolution_us == 60_000_000 { 1_000_000 } else { resolution_us },
                arrival_us: Some(T0_US + us(at_s)),
                frame_time_us: None,
                image_times_us: Vec::new(),
                stated_length_us: None,
                last_image: false,
                completes: None,
            },
            truth,
            late,
            twin: matches!(truth, Truth::Of(index) if has_twin(index, at_s, console_us.is_some(), late)),
        })
        .collect();
    let exposures = truth_s.iter().enumerate().map(|(index, (start, end))| Exposed {
        start_us: T0_US + us(*start),
        end_us: T0_US + us(*end),
        counter: counts.then(|| telemetry_counter(index)),
    });
    let described = format!(
        "{kind:?} seed {seed}: counter {counting:?} (telemetry {counts}, reset {reset_at:?}), stamp every {resolution_s:?} s, {batches} batches, {} holes",
        holes.len()
    );
    Session { described, exposures: exposures.collect(), samples, frames }
}
