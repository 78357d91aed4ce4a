//! When a video stands still, and whether what stands there is new.
//!
//! Changes are means over blocks, of which the largest counts: a tip that moves a little is few pixels, and noise is alike everywhere. What
//! noise a still picture has is learnt: the least that most blocks had over any stretch of `still_s` (0 of a digital line, some grey values of
//! an analogue one), so that fluoroscopy of something that does not move is no still picture, and a clock is no noise. A picture stands that
//! changes neither from one to the next nor from its first to its last: what fades or settles goes on until it has arrived. It is looked at
//! again every `still_s`: behind a noisy line only means show that another exposure has taken its place.

use std::collections::VecDeque;

use super::blocks::{Blocks, largest};
use super::run::Run;
use super::settings::VideoSettings;
use crate::image::Image;

/// The noise of a picture is what this share of its blocks do not exceed: many of the others may be black, where noise is cut off.
const MOST_BLOCKS: f64 = 0.75;
/// A still picture may change by so many times what the least noisy one did.
const OVER_NOISE: f64 = 1.6;
/// Pictures that make a still one, at least.
const LEAST_PICTURES: u32 = 4;
/// From its first half to its second a still picture differs by no more than this share of what would be another one: else what settles slowly
/// would be several.
const SETTLED: f64 = 0.25;
/// A picture is new that differs by so many grey values from the last one where the video had changed by so many in between, whatever its
/// compression: two exposures of one thing are hardly different.
const NEW_AFTER_CHANGE: f64 = 0.25;
const CLEAR_CHANGE: f64 = 6.0;
/// A picture of so few grey values is an empty screen.
const EMPTY: f32 = 8.0;
/// What began to stand later than this after the beginning was not there before: a device may give some pictures before those it has.
const FIRST_WITHIN_S: f64 = 1.0;
/// A video that has not stood still for so long is said to.
const RESTLESS_S: f64 = 20.0;
/// A new picture that differs in no more of its blocks than this is perhaps a clock …
const LOCAL: f64 = 0.05;
/// … and is one from the third on that follow each other so soon.
const TICKS: u32 = 3;
const TICK_S: f64 = 5.0;
const TOLD_TICKS: u32 = 20;

/// Changes that are none, whatever the line: what compression leaves in them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Leftover {
    /// From picture to picture, grey values.
    change: f64,
    /// Between two pictures that stand.
    between: f64,
}

impl Leftover {
    /// Each picture is compressed by itself, if at all.
    pub(super) const EACH: Self = Self { change: 0.4, between: 0.25 };
    /// Pictures are compressed as differences, and made anew every few seconds.
    pub(super) const DIFFERENCES: Self = Self { change: 1.5, between: 1.0 };
}

/// A picture that stands, of which nobody was told yet.
#[derive(Clone, Debug)]
pub(super) struct Still {
    /// Mean of the pictures, 0 to 255; in masks the last one.
    pub(super) picture: Image<f32>,
    /// Since when.
    pub(super) since_s: f64,
}

/// What a picture came to.
#[derive(Clone, Debug)]
pub(super) enum Noted {
    /// Nothing to tell.
    Nothing,
    /// A new picture stands still.
    Still(Still),
    /// One stands since `since_s` that was there at the beginning, and is not taken.
    First { since_s: f64 },
    /// None has for `for_s`: the block at `at_px` of the video changed most often, by up to `change`, where `limit` would be still.
    Restless { for_s: f64, at_px: [u32; 2], change: f64, limit: f64 },
    /// New pictures follow each other that differ in few blocks alone, most in that at `at_px`: a clock, a cursor.
    Ticking { at_px: [u32; 2], change: f64 },
}

/// Takes the pictures of a video in order, cropped.
pub(super) struct Stillness {
    settings: VideoSettings,
    leftover: Leftover,
    /// The first picture that stands is known already.
    knows_first: bool,
    begun_s: f64,
    blocks: Blocks,
    previous: Image<u8>,
    run: Run,
    /// Noise of the pictures of the last `still_s`.
    recent: VecDeque<(f64, f64)>,
    /// The least noise of any stretch.
    noise: f64,
    /// The last picture that was told, or known.
    known: Option<Vec<f32>>,
    /// The largest change since then, grey values.
    broken_by: f64,
    stood_at_s: f64,
    /// How often each block was the one that changed most, since the video stood still last, and the largest change of each.
    restless: Vec<(u32, f64)>,
    /// Pictures one soon after the other that are new in few blocks, and when the last one was.
    ticks: (u32, f64),
}

impl Stillness {
    /// `skip_first`: what stands on the screen at the beginning was there before.
    pub(super) fn new(settings: &VideoSettings, skip_first: bool) -> Self {
        let empty = Image::filled(0, 0, 0);
        Self {
            settings: settings.clone(),
            leftover: Leftover::EACH,
            knows_first: skip_first,
            begun_s: 0.0,
            blocks: Blocks::default(),
            run: Run::of(&empty, 0.0),
            previous: empty,
            recent: VecDeque::new(),
            noise: f64::INFINITY,
            known: None,
            broken_by: 0.0,
            stood_at_s: 0.0,
            restless: Vec::new(),
            ticks: (0, f64::NEG_INFINITY),
        }
    }

    /// What is known of the video's compression.
    pub(super) fn expect(&mut self, leftover: Leftover) {
        self.leftover = leftover;
    }

    /// Up to which change a picture stands still.
    fn limit(&self) -> f64 {
        let learnt = if self.noise.is_finite() { OVER_NOISE * self.noise } else { 0.0 };
        self.settings.change.unwrap_or(learnt.max(self.leftover.change))
    }

    /// A picture at `at_s`, which counts up.
    pub(super) fn take(&mut self, picture: Image<u8>, at_s: f64) -> Noted {
        if !self.previous.same_size(&picture) {
            self.begin(picture, at_s);
            return Noted::Nothing;
        }
        let changes = self.blocks.changes(&picture, &self.previous);
        let (block, change) = largest(&changes);
        self.learn(&picture, at_s, changes);
        let limit = self.limit();
        let drift = largest(&self.blocks.changes(&picture, &self.run.first)).1;
        if change.max(drift) <= limit {
            let half = usize::from(at_s - self.run.since_s > 0.5 * self.settings.still_s);
            self.run.add(&picture, change, half);
        } else {
            self.broken_by = self.broken_by.max(change.max(drift));
            self.run = Run::of(&picture, at_s);
            let (times, largest) = &mut self.restless[block];
            (*times, *largest) = (*times + 1, largest.max(change));
        }
        self.previous = picture;
        self.judge(at_s)
    }

    /// Another video, or another mode of it.
    fn begin(&mut self, picture: Image<u8>, at_s: f64) {
        self.blocks = Blocks::of(&self.settings, [picture.width, picture.height]);
        self.restless = vec![(0, 0.0); self.blocks.count()];
        self.recent.clear();
        (self.stood_at_s, self.begun_s, self.noise) = (at_s, at_s, f64::INFINITY);
        // What another mode shows first is a picture like any other.
        self.knows_first &= self.previous.pixels.is_empty();
        (self.known, self.broken_by) = (None, f64::INFINITY);
        self.run = Run::of(&picture, at_s);
        self.previous = picture;
    }

    /// Learns the noise of the line.
    fn learn(&mut self, picture: &Image<u8>, at_s: f64, mut changes: Vec<f64>) {
        // An empty screen has no noise on any line: black is cut off.
        let values = || self.blocks.usable(&picture.pixels);
        let range = values().max().unwrap_or(0) - values().min().unwrap_or(0);
        if f32::from(range) <= 2.0 * EMPTY {
            self.recent.clear();
            return;
        }
        let most = (((changes.len() - 1) as f64) * MOST_BLOCKS) as usize;
        self.recent.push_back((at_s, *changes.select_nth_unstable_by(most, f64::total_cmp).1));
        while self.recent.front().is_some_and(|(then_s, _)| at_s - then_s > self.settings.still_s) {
            self.recent.pop_front();
        }
        let is_full = self.recent.front().is_some_and(|(then_s, _)| at_s - then_s > 0.8 * self.settings.still_s);
        if is_full && self.recent.len() >= LEAST_PICTURES as usize {
            let most = self.recent.iter().map(|(_, change)| *change).fold(0.0, f64::max);
            self.noise = self.noise.min(most);
        }
    }

    fn judge(&mut self, at_s: f64) -> Noted {
        let stands = at_s - self.run.since_s >= self.settings.still_s && self.run.count() >= LEAST_PICTURES;
        if !stands {
            let for_s = at_s - self.stood_at_s;
            return if for_s >= RESTLESS_S { self.complain(at_s, for_s) } else { Noted::Nothing };
        }
        let run = std::mem::replace(&mut self.run, Run::of(&self.previous, at_s));
        let settled = largest(&self.blocks.differences(&run.half(0), &run.half(1))).1;
        if settled > (SETTLED * self.leftover.between).max(run.noise_of(run.pictures[0].min(run.pictures[1]))) {
            return Noted::Nothing;
        }
        let mean = run.mean();
        let fold = |(low, high): (f32, f32), value: f32| (low.min(value), high.max(value));
        let (low, high) = self.blocks.usable(&mean).fold((f32::INFINITY, f32::NEG_INFINITY), fold);
        if !(high - low > EMPTY) {
            self.knows_first = false;
            return Noted::Nothing;
        }
        self.stood_at_s = at_s;
        self.restless.fill((0, 0.0));
        let new = self.new_blocks(&mean, &run);
        if new.is_empty() {
            return Noted::Nothing;
        }
        self.broken_by = 0.0;
        self.known = Some(mean.clone());
        // Before it there may have been a screen whose noise let nothing stand.
        let first_until_s = self.begun_s + FIRST_WITHIN_S.max(2.0 * self.settings.still_s);
        if std::mem::take(&mut self.knows_first) && run.since_s <= first_until_s {
            return Noted::First { since_s: run.since_s };
        }
        if let Some(clock) = self.ticks_at(&new, at_s) {
            return clock;
        }
        let value = |(index, mean): (usize, f32)| match self.blocks.counts(index) {
            true => mean,
            false => f32::from(self.previous.pixels[index]),
        };
        let pixels = mean.into_iter().enumerate().map(value).collect();
        let Image { width, height, .. } = self.previous;
        Noted::Still(Still { picture: Image { width, height, pixels }, since_s: run.since_s })
    }

    /// The blocks in which a picture differs from the last one that was told, and by how much.
    fn new_blocks(&self, mean: &[f32], run: &Run) -> Vec<(usize, f64)> {
        let Some(known) = &self.known else { return vec![(0, f64::INFINITY); self.blocks.count()] };
        let least = if self.broken_by > CLEAR_CHANGE { NEW_AFTER_CHANGE } else { self.leftover.between };
        let limit = least.max(run.noise_of(run.count()));
        self.blocks.differences(mean, known).into_iter().enumerate().filter(|(_, change)| *change > limit).collect()
    }

    /// Whether a picture is new in a few blocks only, again and again: then that is said, and every [`TOLD_TICKS`]th time again.
    fn ticks_at(&mut self, new: &[(usize, f64)], at_s: f64) -> Option<Noted> {
        let is_local = new.len() as f64 <= (LOCAL * self.blocks.count() as f64).max(1.0);
        let (ticks, last_s) = self.ticks;
        self.ticks = (if is_local && at_s - last_s < TICK_S { ticks + 1 } else { u32::from(is_local) }, at_s);
        if self.ticks.0 < TICKS {
            return None;
        }
        let (block, change) = new.iter().copied().fold((0, 0.0), |most, own| if own.1 > most.1 { own } else { most });
        let at_px = self.blocks.place_of(block);
        let is_said = (self.ticks.0 - TICKS).is_multiple_of(TOLD_TICKS);
        Some(if is_said { Noted::Ticking { at_px, change } } else { Noted::Nothing })
    }

    fn complain(&mut self, at_s: f64, for_s: f64) -> Noted {
        let most = self.restless.iter().enumerate().max_by_key(|(_, (times, _))| *times);
        let (block, (_, change)) = most.map_or((0, (0, 0.0)), |(block, found)| (block, *found));
        let found = Noted::Restless { for_s, at_px: self.blocks.place_of(block), change, limit: self.limit() };
        self.stood_at_s = at_s;
        // Perhaps the line is noisier than a screen without a picture was.
        self.noise = f64::INFINITY;
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Stream};

    const SIZE: [usize; 2] = [96, 64];
    const PERIOD_S: f64 = 1.0 / 30.0;

    /// A picture with structure; `exposure` draws its quantum noise, `instant` that of the line.
    fn picture(exposure: u32, quantum: f64, instant: u32, line: f64) -> Image<u8> {
        let [mut of_exposure, mut of_instant] =
            [(1, exposure), (2, instant)].map(|(seed, frame)| Stream::new(seed, frame, 0, Purpose::QuantumNoise));
        let mut value = |index: usize| {
            let (column, row) = (index % SIZE[0], index / SIZE[0]);
            let clean = 60.0 + column as f64 + if (30..40).contains(&row) { 50.0 } else { 0.0 };
            (clean + quantum * of_exposure.normal() + line * of_instant.normal()).round().clamp(0.0, 255.0) as u8
        };
        let pixels = (0..SIZE[0] * SIZE[1]).map(&mut value).collect();
        Image { width: SIZE[0], height: SIZE[1], pixels }
    }

    /// What is told of a video of these stretches: (pictures, quantum noise of each new exposure, whether each picture is one).
    fn told(stretches: &[(u32, f64, bool)], line: f64, settings: &VideoSettings) -> (Vec<f64>, Vec<[u32; 2]>) {
        let mut stillness = Stillness::new(settings, false);
        let (mut still, mut restless) = (Vec::new(), Vec::new());
        let (mut number, mut exposure) = (0, 0);
        for (pictures, quantum, moves) in stretches {
            exposure += 1;
            for _ in 0..*pictures {
                exposure += u32::from(*moves);
                match stillness.take(picture(exposure, *quantum, number, line), f64::from(number) * PERIOD_S) {
                    Noted::Nothing | Noted::First { .. } => {}
                    Noted::Still(found) => still.push(found.since_s),
                    Noted::Restless { at_px, .. } | Noted::Ticking { at_px, .. } => restless.push(at_px),
                }
                number += 1;
            }
        }
        (still, restless)
    }

    #[test]
    fn each_last_image_held_is_told_once_and_fluoroscopy_is_not() {
        let settings = VideoSettings::of("0");
        // Held, fluoroscopy, held, and at once another exposure: with the quantum noise of each alone telling them apart.
        let stretches = [(40, 3.0, false), (60, 3.0, true), (90, 3.0, false), (45, 3.0, false)];
        for line in [0.0, 1.5] {
            let (still, restless) = told(&stretches, line, &settings);
            assert_eq!(still.len(), 3, "line noise {line}: {still:?}");
            for (found, expected) in still.iter().zip([0.0f64, 100.0, 190.0]) {
                // What noise the line has is not known before the first `still_s` are over.
                let late_s = if expected == 0.0 { settings.still_s } else { 2.5 * PERIOD_S };
                assert!((found - expected * PERIOD_S).abs() < late_s, "line noise {line}: {still:?}");
            }
            assert!(restless.is_empty());
        }
    }

    #[test]
    fn a_menu_that_comes_and_goes_brings_no_picture_twice() {
        let mut stillness = Stillness::new(&VideoSettings::of("0"), false);
        let mut found = 0;
        for number in 0..150u32 {
            let mut shown = picture(7, 3.0, number, 0.0);
            if (50..53).contains(&number) {
                shown.pixels[..SIZE[0] * 20].fill(230);
            }
            found += u32::from(matches!(stillness.take(shown, f64::from(number) * PERIOD_S), Noted::Still(_)));
        }
        assert_eq!(found, 1);
    }

    #[test]
    fn what_never_stands_still_is_said_with_its_place_and_may_be_masked() {
        let clocked = |settings: &VideoSettings| {
            let mut stillness = Stillness::new(settings, false);
            let (mut still, mut restless) = (0, Vec::new());
            for number in 0..700u32 {
                let mut shown = picture(7, 3.0, number, 0.0);
                // A clock that shows every picture another number.
                for row in 50..58 {
                    shown.pixels[row * SIZE[0] + 80..][..12].fill((number * 37 % 200) as u8);
                }
                match stillness.take(shown, f64::from(number) * PERIOD_S) {
                    Noted::Nothing | Noted::First { .. } => {}
                    Noted::Still(_) => still += 1,
                    Noted::Restless { at_px, .. } | Noted::Ticking { at_px, .. } => restless.push(at_px),
                }
            }
            (still, restless)
        };
        let (still, restless) = clocked(&VideoSettings::of("0"));
        assert!(still == 0 && restless.len() == 1, "{still} {restless:?}");
        assert!(restless[0] == [80, 48], "{restless:?}");
        let masked = VideoSettings { masks_px: vec![[78, 48, 18, 12]], ..VideoSettings::of("0") };
        let (still, restless) = clocked(&masked);
        assert!(still == 1 && restless.is_empty(), "{still} {restless:?}");
    }

    #[test]
    fn an_empty_screen_and_what_stood_there_before_are_no_frames() {
        let mut stillness = Stillness::new(&VideoSettings::of("0"), true);
        let mut since = Vec::new();
        for number in 0..120u32 {
            let shown = match number {
                0..40 => picture(1, 3.0, number, 0.0),
                40..80 => Image::filled(SIZE[0], SIZE[1], 16),
                _ => picture(2, 3.0, number, 0.0),
            };
            if let Noted::Still(found) = stillness.take(shown, f64::from(number) * PERIOD_S) {
                since.push((found.since_s / PERIOD_S).round());
            }
        }
        assert_eq!(since, [80.0]);
    }

    /// What is told of a video of so many pictures, drawn by their number: since which number each stands.
    fn since(pictures: u32, skip_first: bool, draw: impl Fn(u32) -> Image<u8>) -> (Vec<f64>, usize) {
        let mut stillness = Stillness::new(&VideoSettings::of("0"), skip_first);
        let (mut since, mut restless) = (Vec::new(), 0);
        for number in 0..pictures {
            match stillness.take(draw(number), f64::from(number) * PERIOD_S) {
                Noted::Nothing | Noted::First { .. } => {}
                Noted::Still(found) => since.push((found.since_s / PERIOD_S).round()),
                Noted::Restless { .. } | Noted::Ticking { .. } => restless += 1,
            }
        }
        (since, restless)
    }

    /// Between two pictures, the share of the second.
    fn blend(a: &Image<u8>, b: &Image<u8>, share: f64) -> Image<u8> {
        crate::image::zip(a, b, |a, b| (f64::from(*a) * (1.0 - share) + f64::from(*b) * share).round() as u8)
    }

    #[test]
    fn what_fades_or_settles_is_taken_when_it_has_arrived() {
        let moved = |number: u32| {
            let mut moved = picture(2, 3.0, number, 0.0);
            moved.pixels[SIZE[0] * 44..SIZE[0] * 54].fill(30);
            moved
        };
        // Over a second, two, and eight.
        for fade in [30, 60, 240] {
            let (found, _) = since(90 + fade, false, |number| {
                let share = f64::from(number.saturating_sub(40)) / f64::from(fade);
                blend(&picture(1, 3.0, number, 0.0), &moved(number), share.min(1.0))
            });
            assert_eq!(found.len(), 2, "a fade of {fade} pictures: {found:?}");
            assert!(found[1] > f64::from(40 + fade) - 8.0, "a fade of {fade} pictures: {found:?}");
        }
        // Each picture keeps most of the one before.
        let (found, _) = since(300, false, |number| {
            let share = if number < 60 { 0.0 } else { 1.0 - 0.92f64.powi(number as i32 - 60) };
            blend(&picture(1, 3.0, number, 0.0), &moved(number), share)
        });
        assert!(found.len() == 2 && found[1] > 90.0, "{found:?}");
    }

    #[test]
    fn the_same_view_again_is_another_picture_and_a_tip_that_moved_as_well() {
        // Bright enough for noise of half a grey value.
        let (found, _) = since(120, false, |number| picture(1 + number / 40, 0.6, number, 0.0));
        assert_eq!(found, [0.0, 40.0, 80.0]);
        let (found, _) = since(80, false, |number| {
            let mut shown = picture(1, 3.0, number, 0.0);
            for row in 20..24 {
                let value = if number < 40 { 140 } else { 120 };
                shown.pixels[row * SIZE[0] + 20..][..4].fill(value);
            }
            shown
        });
        assert_eq!(found, [0.0, 40.0]);
    }

    #[test]
    fn a_clock_of_seconds_is_said_and_not_taken_for_a_picture_a_second() {
        let (found, restless) = since(600, false, |number| {
            let mut shown = picture(7, 3.0, number, 0.0);
            for row in 50..58 {
                shown.pixels[row * SIZE[0] + 82..][..10].fill((number / 30 * 37 % 200) as u8);
            }
            shown
        });
        assert!(found.len() <= TICKS as usize && restless >= 1, "{found:?}, said {restless} times");
    }

    #[test]
    fn noise_of_a_line_is_not_that_of_a_screen_without_a_picture() {
        let (found, _) = since(160, false, |number| match number {
            0..60 => Image::filled(SIZE[0], SIZE[1], 0),
            _ => picture(1 + number / 110, 3.0, number, 2.0),
        });
        assert_eq!(found.len(), 2, "{found:?}");
    }

    /// The first radiograph behind a dark, noisy screen was taken for what had stood there, and nobody was told.
    #[test]
    fn what_came_after_the_beginning_is_a_picture_and_what_stood_there_is_said() {
        let dark = |number| {
            let mut line = Stream::new(3, number, 0, Purpose::QuantumNoise);
            let pixels = (0..SIZE[0] * SIZE[1]).map(|_| (20.0 + 0.7 * line.normal()).round() as u8).collect();
            Image { width: SIZE[0], height: SIZE[1], pixels }
        };
        let draw = |number: u32| if number < 150 { dark(number) } else { picture(number / 150, 3.0, number, 0.7) };
        let (found, _) = since(450, true, draw);
        assert!(found.len() == 2 && (150.0..165.0).contains(&found[0]), "{found:?}");
        let mut stillness = Stillness::new(&VideoSettings::of("0"), true);
        let first = |number: u32| stillness.take(picture(1, 3.0, number, 0.0), 7.0 + f64::from(number) * PERIOD_S);
        let said: Vec<Noted> = (0..60).map(first).filter(|noted| !matches!(noted, Noted::Nothing)).collect();
        assert!(matches!(said[..], [Noted::First { since_s }] if since_s < 7.5), "{said:?}");
    }
}
