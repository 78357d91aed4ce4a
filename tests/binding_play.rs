//! A drawn session through timeline and binder, as the engine plays it, and what came of it.

use std::collections::{BTreeMap, BTreeSet};

use sidecarm::telemetry::{DeviceKind, Sample};
use sidecarm::timeline::{Binder, Binding};

use crate::binding_draw::{Exposed, Session, Truth};
use crate::timeline_joints::{Fed, T0_US};

/// How one session went.
#[derive(Clone, Debug, Default)]
pub struct Score {
    pub frames: usize,
    pub bound: usize,
    /// Those that something tells apart from every other exposure, and how many of them were bound.
    pub decidable: usize,
    pub decidable_bound: usize,
    pub prompt: usize,
    pub prompt_bound: usize,
    /// Prompt frames that something tells apart: all, bound when a live session develops them, and within 1.5 s of their arrival.
    pub clear: usize,
    pub in_time: usize,
    pub soon: usize,
    pub wrong: Vec<String>,
    /// Why frames were left unbound, digits taken out.
    pub reasons: BTreeMap<String, usize>,
    /// What became of each frame.
    pub told: Vec<String>,
    /// Changes of a binding that had been given.
    pub taken_back: usize,
}

impl Score {
    pub fn add(&mut self, other: &Score) {
        self.frames += other.frames;
        self.bound += other.bound;
        self.decidable += other.decidable;
        self.decidable_bound += other.decidable_bound;
        self.prompt += other.prompt;
        self.prompt_bound += other.prompt_bound;
        self.clear += other.clear;
        self.in_time += other.in_time;
        self.soon += other.soon;
        self.taken_back += other.taken_back;
        self.wrong.extend(other.wrong.iter().cloned());
        for (reason, count) in &other.reasons {
            *self.reasons.entry(reason.clone()).or_default() += count;
        }
    }
}

/// Whether `binding` names the exposure that it should.
fn is_of(binding: &Binding, truth: &Exposed) -> bool {
    let Some(interval) = &binding.exposure else { return false };
    if interval.samples == 0 {
        let around = interval.start_us < truth.start_us + 40_000 && interval.end_us > truth.end_us - 40_000;
        return interval.counter == truth.counter && around;
    }
    interval.start_us < truth.end_us + 40_000 && interval.end_us > truth.start_us - 40_000
}

/// Plays the session through timeline and binder as the engine does, and scores what came out.
pub fn play(session: &Session) -> Score {
    let mut fed = Fed::default();
    let mut binder = Binder::default();
    let mut score = Score::default();
    let mut samples = session.samples.iter().peekable();
    // What was exported afterwards comes when telemetry is over.
    let end_us = session.samples.last().map_or(T0_US, |(host_us, _)| *host_us) + 1;
    let mut given: Vec<Option<u64>> = vec![None; session.frames.len()];
    let (mut in_time, mut soon) = (vec![None; session.frames.len()], vec![false; session.frames.len()]);
    let mut waiting: BTreeSet<u32> = BTreeSet::new();
    let mut note = |binder: &Binder, changed: Vec<u32>, new: Option<u32>, now_us: i64, score: &mut Score| {
        for frame in changed {
            let binding = binder.binding(frame).expect("a changed frame is known");
            let slot = &mut given[frame as usize];
            let index = binding.exposure.as_ref().map(|interval| interval.index);
            if slot.is_some() && *slot != index {
                score.taken_back += 1;
            }
            *slot = index;
            let arrival_us = session.frames[frame as usize].evidence.arrival_us.unwrap_or(end_us);
            soon[frame as usize] |= index.is_some() && now_us - arrival_us <= 1_500_000;
        }
        // The engine develops a frame once its binding is settled, or after a second as it stands.
        waiting.extend(new);
        waiting.retain(|frame| {
            let arrival_us = session.frames[*frame as usize].evidence.arrival_us.unwrap_or(end_us);
            let binding = binder.binding(*frame).expect("a waiting frame is known");
            let developed = binding.settled || now_us - arrival_us >= 1_000_000;
            if developed {
                in_time[*frame as usize] = Some(binding.exposure.is_some());
            }
            !developed
        });
    };
    let mut clock_us = T0_US;
    for sent in &session.frames {
        let arrival_us = sent.evidence.arrival_us.unwrap_or(end_us);
        // Ticks of 100 ms while telemetry flows, sparser ones when hours pass.
        while clock_us < arrival_us {
            let step_us = if samples.peek().is_some() { 100_000 } else { 1_000_000 };
            clock_us = (clock_us + step_us).min(arrival_us);
            while let Some((host_us, sample)) = samples.next_if(|(host_us, _)| *host_us <= clock_us) {
                fed.push_sample(DeviceKind::Carm, *host_us, 0, Sample::Carm(sample.clone()));
            }
            let changed = binder.update(&fed, clock_us);
            note(&binder, changed, None, clock_us, &mut score);
        }
        binder.push(sent.evidence.clone());
        // All that was exported afterwards is there before any of it is judged.
        let changed = sent.evidence.arrival_us.map(|arrival_us| binder.update(&fed, arrival_us)).unwrap_or_default();
        note(&binder, changed, Some(sent.evidence.frame), arrival_us, &mut score);
    }
    let last_us = clock_us + 2_000_000;
    while clock_us < last_us {
        clock_us += 100_000;
        while let Some((host_us, sample)) = samples.next_if(|(host_us, _)| *host_us <= clock_us) {
            fed.push_sample(DeviceKind::Carm, *host_us, 0, Sample::Carm(sample.clone()));
        }
        let changed = binder.update(&fed, clock_us);
        note(&binder, changed, None, clock_us, &mut score);
    }
    for (host_us, sample) in samples {
        fed.push_sample(DeviceKind::Carm, *host_us, 0, Sample::Carm(sample.clone()));
        clock_us = clock_us.max(*host_us);
    }
    let changed = binder.finish(&fed);
    note(&binder, changed, None, clock_us + 60_000_000, &mut score);
    // Exposures that telemetry could not know of: they lie in a hole and nothing counts them.
    let intervals = fed.exposures();
    let known = |truth: &Exposed| {
        intervals.iter().any(|interval| is_of(&Binding { exposure: Some(interval.clone()), ..Binding::default() }, truth))
    };
    let mut takers: BTreeMap<u64, (u32, &str)> = BTreeMap::new();
    for sent in &session.frames {
        let frame = sent.evidence.frame;
        let binding = binder.binding(frame).expect("every frame has its binding");
        assert!(binding.settled && !binding.evidence.is_empty(), "frame {frame} of {} is open at the end", session.described);
        score.told.push(format!(
            "frame {frame} {:?} counter {:?} stamp {:?} came {:.3} s: {:?} {}",
            sent.truth,
            sent.evidence.counter,
            sent.evidence.console_us.map(|us| (us - T0_US) as f64 * 1e-6),
            (sent.evidence.arrival_us.unwrap_or(i64::MAX) - T0_US) as f64 * 1e-6,
            binding.exposure.as_ref().map(|x| ((x.start_us - T0_US) as f64 * 1e-6, x.counter)),
            binding.evidence.iter().cloned().chain(binding.flags.iter().map(ToString::to_string)).collect::<Vec<_>>().join("; ")
        ));
        let right = match sent.truth {
            Truth::Of(index) | Truth::SecondOf(index) => is_of(binding, &session.exposures[index]),
            Truth::Copy | Truth::Foreign => false,
        };
        if let Some(interval) = &binding.exposure {
            // Images of one file are one run of one exposure.
            let content = sent.evidence.content.as_str();
            if let Some((other, _)) = takers.insert(interval.index, (frame, content)).filter(|(_, other)| *other != content) {
                score.wrong.push(format!("{}: frames {other} and {frame} on one exposure", session.described));
            }
            if !right {
                let evidence = binding.evidence.join("; ");
                let seconds = |us: i64| (us - T0_US) as f64 * 1e-6;
                let from_s = seconds(interval.start_us);
                let true_s = match sent.truth {
                    Truth::Of(index) | Truth::SecondOf(index) => seconds(session.exposures[index].start_us),
                    Truth::Copy | Truth::Foreign => f64::NAN,
                };
                score.wrong.push(format!(
                    "{}: frame {frame} ({:?}, come at {:.3} s) at {from_s:.3} s, truly {true_s:.3} s ({} samples): {evidence}",
                    session.described,
                    sent.truth,
                    seconds(sent.evidence.arrival_us.unwrap_or(i64::MAX)),
                    interval.samples
                ));
            }
        }
        if let Truth::Of(index) = sent.truth
            && known(&session.exposures[index])
        {
            score.frames += 1;
            score.bound += usize::from(binding.exposure.is_some());
            if !sent.twin {
                score.decidable += 1;
                score.decidable_bound += usize::from(binding.exposure.is_some());
            }
            if let (None, Some(reason)) = (&binding.exposure, binding.evidence.last()) {
                let words: String = reason.chars().filter(|c| !c.is_ascii_digit()).collect();
                *score.reasons.entry(words).or_default() += 1;
            }
            if !sent.late {
                score.prompt += 1;
                score.prompt_bound += usize::from(binding.exposure.is_some());
                if !sent.twin {
                    score.clear += 1;
                    score.in_time += usize::from(in_time[frame as usize] == Some(true));
                    score.soon += usize::from(soon[frame as usize]);
                }
            }
        }
    }
    // Where an exposure's second picture was taken instead of its first, the exposure has its frame all the same.
    for sent in &session.frames {
        if let Truth::SecondOf(index) = sent.truth
            && binder.binding(sent.evidence.frame).is_some_and(|binding| binding.exposure.is_some())
            && known(&session.exposures[index])
        {
            score.bound += 1;
        }
    }
    score
}
