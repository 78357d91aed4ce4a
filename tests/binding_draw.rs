//! What drawn sessions are made of: random numbers, frames with the truth, and the C-arm's samples.

use sidecarm::random::{Purpose, Stream};
use sidecarm::telemetry::CarmSample;
use sidecarm::timeline::FrameEvidence;

use crate::timeline_joints::{T0_US, carm_sample};

/// Uniform numbers of one seed.
pub struct Draw(Stream);

impl Draw {
    pub fn new(seed: u64, purpose: u32) -> Self {
        Self(Stream::new(seed, 10, purpose, Purpose::Evaluation))
    }

    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.0.uniform()
    }

    pub fn log(&mut self, low: f64, high: f64) -> f64 {
        self.between(low.ln(), high.ln()).exp()
    }

    pub fn chance(&mut self, probability: f64) -> bool {
        self.0.uniform() < probability
    }

    pub fn below(&mut self, count: usize) -> usize {
        ((self.0.uniform() * count as f64) as usize).min(count - 1)
    }

    pub fn pick<T: Copy>(&mut self, from: &[T]) -> T {
        from[self.below(from.len())]
    }

    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for i in (1..items.len()).rev() {
            items.swap(i, self.below(i + 1));
        }
    }
}

/// What a frame really is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Truth {
    /// Of this exposure, which telemetry could know of.
    Of(usize),
    /// A second picture of this exposure.
    SecondOf(usize),
    /// The same file again.
    Copy,
    /// Of no exposure of this session.
    Foreign,
}

/// A frame that arrives.
#[derive(Clone, Debug)]
pub struct Sent {
    pub evidence: FrameEvidence,
    pub truth: Truth,
    pub late: bool,
    /// Nothing in it tells its exposure from another that it may be of: the stamp, or its lack, and the counter are the same.
    pub twin: bool,
}

/// One exposure as it was.
#[derive(Clone, Copy, Debug)]
pub struct Exposed {
    pub start_us: i64,
    pub end_us: i64,
    /// The C-arm's counter during it.
    pub counter: Option<u32>,
}

/// A drawn session.
pub struct Session {
    pub described: String,
    pub exposures: Vec<Exposed>,
    pub samples: Vec<(i64, CarmSample)>,
    pub frames: Vec<Sent>,
}

pub fn us(seconds: f64) -> i64 {
    (seconds * 1e6).round() as i64
}

/// What the C-arm sends, with holes.
pub fn samples(
    draw: &mut Draw,
    truth_s: &[(f64, f64)],
    end_s: f64,
    rate_hz: f64,
    counter: Option<&dyn Fn(usize) -> u32>,
    first_counter: u32,
    holes: &[(f64, f64)],
) -> Vec<(i64, CarmSample)> {
    let ppm = draw.between(-200e-6, 200e-6);
    let mut index = 0;
    let mut found = Vec::new();
    for number in 0..(end_s * rate_hz) as u32 {
        let at_s = f64::from(number) / rate_hz;
        while index < truth_s.len() && at_s >= truth_s[index].1 {
            index += 1;
        }
        let on = index < truth_s.len() && at_s >= truth_s[index].0;
        if holes.iter().any(|(from, to)| at_s >= *from && at_s < *to) {
            continue;
        }
        let begun = if on { index + 1 } else { index };
        let exposure_counter = counter.map(|counter| if begun == 0 { first_counter } else { counter(begun - 1) });
        let sample = carm_sample(number, us(7.0 + at_s * (1.0 + ppm)) as u64, at_s * 1e-3, on, exposure_counter);
        found.push((T0_US + us(at_s + 0.0015 - 0.0005 * draw.0.uniform().ln()), sample));
    }
    found
}
