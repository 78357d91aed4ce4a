//! Milliseconds of what a registration does: masks and beads of large frames, matching, thousands of false shadows:
//! `scripts/evaluate register-times`.

use glam::{DQuat, DVec3};
use rayon::prelude::*;
use sidecarm::acquire::{Domain, Frame};
use sidecarm::beads::{BeadLayout, Detection, Expectation, detect};
use sidecarm::geometry::View;
use sidecarm::mask::{self, Cause};
use sidecarm::pose::{Prior, Registration, register_shadows};
use sidecarm::random::{Purpose, Stream};
use sidecarm::time::Stopwatch;

use crate::pose_mistakes::{Draw, turned};
use crate::pose_registration::{clutter, matching, shadows};
use crate::pose_synthetic as synthetic;

const SIDE_PX: u32 = 1536;
const FRAMES: u64 = 6;
/// Each frame is masked and searched so often.
const REPEATS: usize = 5;
const BEADS: usize = 12;
const SHADOWS: usize = 40;
const MATCHES: usize = 100;
const STRAYS: usize = 10_000;
const CROWDED: usize = 10;

/// What the median may take on two cores that do nothing else; of masks no figure is stated.
const DETECTION_MS: f64 = 150.0;
const MATCHING_MS: f64 = 20.0;
/// What the worst may take among thousands of false shadows, of which forty are tried.
const CROWDED_MS: f64 = 2000.0;

#[derive(Clone, Copy)]
enum Bar {
    Unstated,
    Median(f64),
    Worst(f64),
}

/// How long one thing took, time after time.
struct Times {
    what: String,
    /// Sorted.
    ms: Vec<f64>,
    bar: Bar,
}

impl Times {
    fn new(what: impl Into<String>, mut ms: Vec<f64>, bar: Bar) -> Self {
        ms.sort_by(f64::total_cmp);
        Self { what: what.into(), ms, bar }
    }

    /// The time that so large a share of all does not exceed.
    fn of(&self, share: f64) -> f64 {
        let rank = (share * self.ms.len() as f64).ceil() as usize;
        self.ms.get(rank.clamp(1, self.ms.len().max(1)) - 1).copied().unwrap_or(f64::NAN)
    }

    fn is_slow(&self) -> bool {
        match self.bar {
            Bar::Unstated => self.ms.is_empty(),
            Bar::Median(most) => !(self.of(0.5) <= most),
            Bar::Worst(most) => !(self.of(1.0) <= most),
        }
    }

    fn line(&self) -> String {
        let bar = match self.bar {
            Bar::Unstated => String::new(),
            Bar::Median(most) => format!("  median at most {most:.0}"),
            Bar::Worst(most) => format!("  worst at most {most:.0}"),
        };
        let late = if self.is_slow() { ", exceeded" } else { "" };
        format!("{:44} {:5} {:9.1} {:9.1} {:9.1}{bar}{late}", self.what, self.ms.len(), self.of(0.5), self.of(0.99), self.of(1.0))
    }
}

fn timed<T>(work: impl FnOnce() -> T) -> (f64, T) {
    let watch = Stopwatch::start();
    let result = work();
    (watch.ms(), result)
}

/// Frames with bones, wires and a screw; every other one collimated.
fn frames(domain: Domain) -> Vec<Frame> {
    let one = |seed: u64| {
        let (view, layout) = (synthetic::view(SIDE_PX, SIDE_PX, seed), synthetic::layout(BEADS, 0.75, seed));
        let photons = 20_000.0;
        let mut drawing = synthetic::radiograph(view, &layout, photons, seed);
        drawing.collimated = seed % 2 == 1;
        let pixels = drawing.draw();
        let pixels = if domain == Domain::Display { synthetic::display(&pixels, photons, seed % 4 < 2) } else { pixels };
        Frame::from_pixels("drawn", pixels, domain).expect("finite")
    };
    (0..FRAMES).into_par_iter().map(one).collect()
}

/// Masks, and beads behind them as `register` looks for them.
fn of_pictures(domain: Domain) -> [Times; 2] {
    let (mut masked, mut detected) = (Vec::new(), Vec::new());
    for frame in frames(domain) {
        for _ in 0..REPEATS {
            let (ms, masks) = timed(|| mask::of_frame(&frame));
            masked.push(ms);
            let [width, height] = frame.size_px;
            let usable = masks.usable(width, height, &[Cause::Saturation, Cause::NoSignal, Cause::BurnedIn]);
            let (ms, found) = timed(|| detect(&frame, Some(&usable), &Expectation::default()));
            detected.push(ms);
            assert!(found.found.len() >= BEADS / 2, "{} shadows found", found.found.len());
        }
    }
    let size = format!("{SIDE_PX}x{SIDE_PX}, {domain}");
    [
        Times::new(format!("masks, {size}"), masked, Bar::Unstated),
        Times::new(format!("beads, {size}"), detected, Bar::Median(DETECTION_MS)),
    ]
}

/// Twelve beads that are all seen, and others beside them until there are `count` shadows, mixed among them in quality.
fn scene(seed: u64, count: usize) -> Option<(View, BeadLayout, Vec<Detection>)> {
    let (view, layout) = (synthetic::view(1024, 1024, seed), synthetic::layout(BEADS, 0.75, seed));
    let mut found = shadows(&view, &layout, 0.05, 0.05, seed);
    if found.len() < BEADS {
        return None;
    }
    found.extend(clutter(&view, count - BEADS, found[0].radius_px, seed));
    let mut draw = Draw(Stream::new(seed, 98, 0, Purpose::Evaluation));
    found.iter_mut().for_each(|shadow| shadow.quality = draw.between(0.2, 1.0));
    found.sort_by(|a, b| b.quality.total_cmp(&a.quality));
    Some((view, layout, found))
}

/// What is known of K and of the pose.
#[derive(Clone, Copy)]
struct Known {
    k: bool,
    prior: bool,
}

fn matched(scenes: &[(View, BeadLayout, Vec<Detection>)], known: Known) -> (Vec<f64>, usize) {
    let mut accepted = 0;
    let one = |(view, layout, found): &(View, BeadLayout, Vec<Detection>)| {
        let off = turned(view, DQuat::from_scaled_axis(DVec3::new(0.05, -0.05, 0.04)), DVec3::new(8.0, -8.0, 8.0));
        let prior = Prior { camera_from_lps: off, covariance: None };
        let base = matching(view, layout);
        let request =
            Registration { intrinsics: base.intrinsics.filter(|_| known.k), prior: Some(&prior).filter(|_| known.prior), ..base };
        let (ms, pose) = timed(|| register_shadows(&request, found));
        accepted += usize::from(pose.is_accepted());
        ms
    };
    (scenes.iter().map(one).collect(), accepted)
}

/// The times, and what gave few poses: what is refused at once takes no time.
fn of_matching() -> (Vec<Times>, Vec<&'static str>) {
    let scenes: Vec<_> = (0..).filter_map(|seed| scene(seed, SHADOWS)).take(MATCHES).collect();
    let crowded: Vec<_> = (0..).filter_map(|seed| scene(seed, BEADS + STRAYS)).take(CROWDED).collect();
    let (mut times, mut refused) = (Vec::new(), Vec::new());
    for (words, known) in [
        ("K known, a prior", Known { k: true, prior: true }),
        ("K known, no prior", Known { k: true, prior: false }),
        ("K free, no prior", Known { k: false, prior: false }),
    ] {
        let (ms, accepted) = matched(&scenes, known);
        println!("{BEADS} x {SHADOWS}, {words}: {accepted} of {MATCHES} accepted");
        refused.extend(Some(words).filter(|_| 2 * accepted <= MATCHES));
        times.push(Times::new(format!("matching {BEADS} x {SHADOWS}, {words}"), ms, Bar::Median(MATCHING_MS)));
        let (ms, _) = matched(&crowded, known);
        times.push(Times::new(format!("matching among {STRAYS} others, {words}"), ms, Bar::Worst(CROWDED_MS)));
    }
    (times, refused)
}

/// What the figures are of.
pub fn built() -> &'static str {
    if cfg!(debug_assertions) { "debug build with optimization" } else { "release build" }
}

#[test]
#[ignore = "minutes long: scripts/evaluate register-times runs it"]
fn figures() {
    let cores = std::thread::available_parallelism().map_or(0, std::num::NonZero::get);
    // The first of everything warms up.
    let warm = scene(0, SHADOWS).into_iter().collect::<Vec<_>>();
    matched(&warm, Known { k: true, prior: false });
    let mut times: Vec<Times> = [Domain::Linear, Domain::Display].into_iter().flat_map(of_pictures).collect();
    let (of_matching, refused) = of_matching();
    times.extend(of_matching);
    println!("{}, {cores} cores", built());
    println!("{:44} {:>5} {:>9} {:>9} {:>9}", "milliseconds", "runs", "median", "99 %", "worst");
    times.iter().for_each(|times| println!("{}", times.line()));
    let slow: Vec<&str> = times.iter().filter(|times| times.is_slow()).map(|times| times.what.as_str()).collect();
    assert!(times.len() == 10 && slow.is_empty(), "slower than stated: {slow:?}");
    assert!(refused.is_empty(), "most are refused: {refused:?}");
}

#[test]
fn times_are_held_against_their_bar() {
    let of = |bar: Bar| Times::new("this", (1..=200).rev().map(f64::from).collect(), bar);
    let plain = of(Bar::Unstated);
    assert_eq!([plain.of(0.5), plain.of(0.99), plain.of(1.0)], [100.0, 198.0, 200.0]);
    assert!(!plain.is_slow() && !of(Bar::Median(100.0)).is_slow() && !of(Bar::Worst(200.0)).is_slow());
    assert!(of(Bar::Median(99.0)).is_slow() && of(Bar::Worst(199.0)).is_slow());
    assert!(Times::new("none", Vec::new(), Bar::Unstated).is_slow(), "what was not measured");
}
