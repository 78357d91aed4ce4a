//! When a video stands still, and whether what stands there is new.
//!
//! Changes are means over blocks, of which the largest counts: a tip that moves a little is few pixels, and noise is alike everywhere. What
//! noise a still picture has is learnt: the least that most blocks had over any stretch of `still_s` (0 of a digital line, some grey values of
//! an analogue one), so that fluoroscopy of something that does not move is no still picture, and a clock is no noise.

use std::collections::VecDeque;

use super::settings::{Rectangle, VideoSettings};
use crate::image::Image;

/// The noise of a picture is what this share of its blocks do not exceed: many of the others may be black, where noise is cut off.
const MOST_BLOCKS: f64 = 0.75;
/// Edge of a block.
const BLOCK_PX: usize = 16;
/// A block with fewer unmasked pixels tells nothing.
const LEAST_PIXELS: u32 = 32;
/// Changes up to this many grey values are none, whatever the line: compression leaves them in recordings.
const LEAST_CHANGE: f64 = 1.5;
/// A still picture may change by so many times what the least noisy one did.
const OVER_NOISE: f64 = 2.0;
/// Pictures that make a still one, at least.
const LEAST_PICTURES: u32 = 3;
/// A picture is new that differs by so many grey values from the last one …
const NEW: f64 = 1.0;
/// … or by so many where the video had changed clearly in between: two exposures of one thing are hardly different when they are compressed.
const NEW_AFTER_CHANGE: f64 = 0.25;
/// That clearly, in limits of a still picture.
const CLEARLY: f64 = 4.0;
/// What the mean of n pictures differs by for its noise alone is the change from picture to picture over √n; so many times that is new.
const OVER_MEAN_NOISE: f64 = 2.5;
/// A picture of so few grey values is an empty screen.
const EMPTY: f32 = 8.0;
/// A video that has not stood still for so long is said to.
const RESTLESS_S: f64 = 20.0;

/// A picture that stands, of which nobody was told yet.
#[derive(Clone, Debug)]
pub(super) struct Still {
    /// Mean of the pictures, 0 to 255; in masks the last one.
    pub(super) picture: Image<f32>,
    /// Since when.
    pub(super) since_s: f64,
}

/// A video in which nothing stands still.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Restless {
    /// For so long.
    pub(super) for_s: f64,
    /// The block that changes most in most pictures: its first pixel in the video.
    pub(super) at_px: [u32; 2],
    /// By how much it changes, grey values.
    pub(super) change: f64,
    /// Up to which it would stand still.
    pub(super) limit: f64,
}

/// What a picture came to.
#[derive(Clone, Debug)]
pub(super) enum Noted {
    /// Nothing to tell.
    Nothing,
    /// A new picture stands still.
    Still(Still),
    /// None has for long.
    Restless(Restless),
}

/// Pictures in succession that are alike.
struct Run {
    since_s: f64,
    sums: Vec<u32>,
    pictures: u32,
    /// The largest change among them.
    change: f64,
    is_judged: bool,
}

impl Run {
    fn of(picture: &Image<u8>, since_s: f64) -> Self {
        let sums = picture.pixels.iter().map(|value| u32::from(*value)).collect();
        Self { since_s, sums, pictures: 1, change: 0.0, is_judged: false }
    }

    fn add(&mut self, picture: &Image<u8>, change: f64) {
        // What was judged is not looked at again.
        if self.is_judged {
            return;
        }
        self.sums.iter_mut().zip(&picture.pixels).for_each(|(sum, value)| *sum += u32::from(*value));
        self.pictures += 1;
        self.change = self.change.max(change);
    }

    fn mean(&self) -> Vec<f32> {
        self.sums.iter().map(|sum| *sum as f32 / self.pictures as f32).collect()
    }
}

/// Takes the pictures of a video in order, cropped.
pub(super) struct Stillness {
    settings: VideoSettings,
    /// The first picture that stands is known already.
    knows_first: bool,
    usable: Vec<bool>,
    blocks: Vec<u32>,
    previous: Image<u8>,
    run: Run,
    /// Changes of the last `still_s`.
    recent: VecDeque<(f64, f64)>,
    started_s: f64,
    /// The least noise of any stretch.
    noise: f64,
    /// The last picture that was told, or known.
    known: Option<Vec<f32>>,
    /// The largest change since then, in limits.
    broken_by: f64,
    stood_at_s: f64,
    /// How often each block was the one that changed most, since the video stood still last, and the largest change of each.
    restless: Vec<(u32, f64)>,
}

impl Stillness {
    /// `skip_first`: what stands on the screen at the beginning was there before.
    pub(super) fn new(settings: &VideoSettings, skip_first: bool) -> Self {
        let empty = Image::filled(0, 0, 0);
        Self {
            settings: settings.clone(),
            knows_first: skip_first,
            usable: Vec::new(),
            blocks: Vec::new(),
            run: Run::of(&empty, 0.0),
            previous: empty,
            recent: VecDeque::new(),
            started_s: 0.0,
            noise: f64::INFINITY,
            known: None,
            broken_by: 0.0,
            stood_at_s: 0.0,
            restless: Vec::new(),
        }
    }

    /// Up to which change a picture stands still.
    fn limit(&self) -> f64 {
        let learnt = if self.noise.is_finite() { OVER_NOISE * self.noise } else { 0.0 };
        self.settings.change.unwrap_or(learnt.max(LEAST_CHANGE))
    }

    /// A picture at `at_s`, which counts up.
    pub(super) fn take(&mut self, picture: Image<u8>, at_s: f64) -> Noted {
        if !self.previous.same_size(&picture) {
            self.begin(picture, at_s);
            return Noted::Nothing;
        }
        let changes = self.changes(&picture);
        let (block, change) = largest(&changes);
        self.learn(at_s, changes);
        let limit = self.limit();
        if change <= limit {
            self.run.add(&picture, change);
        } else {
            self.broken_by = self.broken_by.max(change / limit);
            self.run = Run::of(&picture, at_s);
            let (times, largest) = &mut self.restless[block];
            (*times, *largest) = (*times + 1, largest.max(change));
        }
        self.previous = picture;
        self.judge(at_s)
    }

    /// Another video, or another mode of it.
    fn begin(&mut self, picture: Image<u8>, at_s: f64) {
        let [left, top, ..] = self.settings.crop_px.unwrap_or_default();
        let is_usable = |index: usize| {
            let at = [left + (index % picture.width) as u32, top + (index / picture.width) as u32];
            !self.settings.masks_px.iter().any(|mask| holds(mask, at))
        };
        self.usable = (0..picture.pixels.len()).map(is_usable).collect();
        self.blocks = vec![0; picture.width.div_ceil(BLOCK_PX) * picture.height.div_ceil(BLOCK_PX)];
        self.restless = vec![(0, 0.0); self.blocks.len()];
        for index in (0..picture.pixels.len()).filter(|index| self.usable[*index]) {
            self.blocks[block_of(index, picture.width)] += 1;
        }
        self.recent.clear();
        (self.started_s, self.stood_at_s, self.noise) = (at_s, at_s, f64::INFINITY);
        // What another mode shows first is a picture like any other.
        self.knows_first &= self.previous.pixels.is_empty();
        (self.known, self.broken_by) = (None, f64::INFINITY);
        self.run = Run::of(&picture, at_s);
        self.previous = picture;
    }

    /// By how much each block changed.
    fn changes(&self, picture: &Image<u8>) -> Vec<f64> {
        let apart = |index: usize| u32::from(picture.pixels[index].abs_diff(self.previous.pixels[index]));
        let mut sums = vec![0u32; self.blocks.len()];
        let columns = picture.width.div_ceil(BLOCK_PX);
        for (row, start) in (0..picture.pixels.len()).step_by(picture.width).enumerate() {
            for column in 0..picture.width {
                if self.usable[start + column] {
                    sums[row / BLOCK_PX * columns + column / BLOCK_PX] += apart(start + column);
                }
            }
        }
        self.means(sums.into_iter().map(f64::from))
    }

    /// Of the sums of blocks; 0 where nothing is known.
    fn means(&self, sums: impl Iterator<Item = f64>) -> Vec<f64> {
        sums.zip(&self.blocks).map(|(sum, pixels)| if *pixels >= LEAST_PIXELS { sum / f64::from(*pixels) } else { 0.0 }).collect()
    }

    fn learn(&mut self, at_s: f64, mut changes: Vec<f64>) {
        let most = (((changes.len() - 1) as f64) * MOST_BLOCKS) as usize;
        self.recent.push_back((at_s, *changes.select_nth_unstable_by(most, f64::total_cmp).1));
        while self.recent.front().is_some_and(|(then_s, _)| at_s - then_s > self.settings.still_s) {
            self.recent.pop_front();
        }
        if at_s - self.started_s >= self.settings.still_s && self.recent.len() >= LEAST_PICTURES as usize {
            let most = self.recent.iter().map(|(_, change)| *change).fold(0.0, f64::max);
            self.noise = self.noise.min(most);
        }
    }

    fn judge(&mut self, at_s: f64) -> Noted {
        let stands = at_s - self.run.since_s >= self.settings.still_s && self.run.pictures >= LEAST_PICTURES;
        if !stands {
            let for_s = at_s - self.stood_at_s;
            return if for_s >= RESTLESS_S { self.complain(at_s, for_s) } else { Noted::Nothing };
        }
        self.stood_at_s = at_s;
        self.restless.fill((0, 0.0));
        if std::mem::replace(&mut self.run.is_judged, true) {
            return Noted::Nothing;
        }
        let mean = self.run.mean();
        let ends = mean.iter().zip(&self.usable).filter(|(_, usable)| **usable).map(|(value, _)| *value);
        let (low, high) = ends.fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
        if !(high - low > EMPTY) {
            self.knows_first = false;
            return Noted::Nothing;
        }
        if !self.is_new(&mean) {
            return Noted::Nothing;
        }
        self.broken_by = 0.0;
        self.known = Some(mean.clone());
        if std::mem::take(&mut self.knows_first) {
            return Noted::Nothing;
        }
        let value = |(index, mean): (usize, f32)| if self.usable[index] { mean } else { f32::from(self.previous.pixels[index]) };
        let pixels = mean.into_iter().enumerate().map(value).collect();
        let Image { width, height, .. } = self.previous;
        Noted::Still(Still { picture: Image { width, height, pixels }, since_s: self.run.since_s })
    }

    fn is_new(&self, mean: &[f32]) -> bool {
        let Some(known) = &self.known else { return true };
        let mut sums = vec![0.0; self.blocks.len()];
        for index in (0..mean.len()).filter(|index| self.usable[*index]) {
            sums[block_of(index, self.previous.width)] += f64::from((mean[index] - known[index]).abs());
        }
        let least = if self.broken_by > CLEARLY { NEW_AFTER_CHANGE } else { NEW };
        let noise = OVER_MEAN_NOISE * self.run.change / f64::from(self.run.pictures).sqrt();
        largest(&self.means(sums.into_iter())).1 > least.max(noise)
    }

    fn complain(&mut self, at_s: f64, for_s: f64) -> Noted {
        let columns = self.previous.width.div_ceil(BLOCK_PX);
        let most = self.restless.iter().enumerate().max_by_key(|(_, (times, _))| *times);
        let (block, (_, change)) = most.map_or((0, (0, 0.0)), |(block, found)| (block, *found));
        let [left, top, ..] = self.settings.crop_px.unwrap_or_default();
        let at_px = [left + (block % columns * BLOCK_PX) as u32, top + (block / columns * BLOCK_PX) as u32];
        self.stood_at_s = at_s;
        Noted::Restless(Restless { for_s, at_px, change, limit: self.limit() })
    }
}

/// The block that has the most, and what it has.
fn largest(blocks: &[f64]) -> (usize, f64) {
    blocks.iter().copied().enumerate().fold((0, 0.0), |most, block| if block.1 > most.1 { block } else { most })
}

fn block_of(index: usize, width: usize) -> usize {
    index / width / BLOCK_PX * width.div_ceil(BLOCK_PX) + index % width / BLOCK_PX
}

fn holds([left, top, width, height]: &Rectangle, [column, row]: [u32; 2]) -> bool {
    (*left..left.saturating_add(*width)).contains(&column) && (*top..top.saturating_add(*height)).contains(&row)
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
    fn told(stretches: &[(u32, f64, bool)], line: f64, settings: &VideoSettings) -> (Vec<f64>, Vec<Restless>) {
        let mut stillness = Stillness::new(settings, false);
        let (mut still, mut restless) = (Vec::new(), Vec::new());
        let (mut number, mut exposure) = (0, 0);
        for (pictures, quantum, moves) in stretches {
            exposure += 1;
            for _ in 0..*pictures {
                exposure += u32::from(*moves);
                match stillness.take(picture(exposure, *quantum, number, line), f64::from(number) * PERIOD_S) {
                    Noted::Nothing => {}
                    Noted::Still(found) => still.push(found.since_s),
                    Noted::Restless(found) => restless.push(found),
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
            for (found, expected) in still.iter().zip([0.0, 100.0, 190.0]) {
                assert!((found - expected * PERIOD_S).abs() < 2.5 * PERIOD_S, "line noise {line}: {still:?}");
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
                    Noted::Nothing => {}
                    Noted::Still(_) => still += 1,
                    Noted::Restless(found) => restless.push(found),
                }
            }
            (still, restless)
        };
        let (still, restless) = clocked(&VideoSettings::of("0"));
        assert!(still == 0 && restless.len() == 1, "{still} {restless:?}");
        assert!(restless[0].at_px == [80, 48] && restless[0].change > restless[0].limit, "{restless:?}");
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
}
