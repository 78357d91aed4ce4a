//! Pictures compared in blocks of 16 x 16 pixels, without what is masked.

use super::settings::{Rectangle, VideoSettings};
use crate::image::Image;

/// Edge of a block.
const BLOCK_PX: usize = 16;
/// A block with fewer unmasked pixels tells nothing.
const LEAST_PIXELS: u32 = 32;

/// The blocks of a cropped picture.
#[derive(Default)]
pub(super) struct Blocks {
    width: usize,
    /// 255 where a pixel counts, 0 in masks.
    usable: Vec<u8>,
    /// How many count in each block.
    pixels: Vec<u32>,
    /// The picture's first pixel in the video.
    origin_px: [u32; 2],
}

impl Blocks {
    /// Of a picture of `size` (columns, rows) that was cropped as `settings` say.
    pub(super) fn of(settings: &VideoSettings, [width, height]: [usize; 2]) -> Self {
        let [left, top, ..] = settings.crop_px.unwrap_or_default();
        let is_usable = |index: usize| {
            let at = [left + (index % width) as u32, top + (index / width) as u32];
            if settings.masks_px.iter().any(|mask| holds(mask, at)) { 0 } else { u8::MAX }
        };
        let usable: Vec<u8> = (0..width * height).map(is_usable).collect();
        let mut pixels = vec![0; width.div_ceil(BLOCK_PX) * height.div_ceil(BLOCK_PX)];
        for index in (0..usable.len()).filter(|index| usable[*index] != 0) {
            pixels[block_of(index, width)] += 1;
        }
        Self { width, usable, pixels, origin_px: [left, top] }
    }

    /// How many there are.
    pub(super) fn count(&self) -> usize {
        self.pixels.len()
    }

    /// Whether a pixel counts.
    pub(super) fn counts(&self, index: usize) -> bool {
        self.usable[index] != 0
    }

    /// The values that count.
    pub(super) fn usable<T: Copy>(&self, values: &[T]) -> impl Iterator<Item = T> {
        values.iter().zip(&self.usable).filter(|(_, usable)| **usable != 0).map(|(value, _)| *value)
    }

    /// Mean difference of two pictures in each block.
    pub(super) fn changes(&self, picture: &Image<u8>, other: &Image<u8>) -> Vec<f64> {
        let mut sums = vec![0u32; self.count()];
        let (width, columns) = (self.width, self.width.div_ceil(BLOCK_PX));
        let rows = picture.pixels.chunks(width).zip(other.pixels.chunks(width)).zip(self.usable.chunks(width));
        for (row, ((a, b), usable)) in rows.enumerate() {
            let sums = &mut sums[row / BLOCK_PX * columns..][..columns];
            let parts = a.chunks(BLOCK_PX).zip(b.chunks(BLOCK_PX)).zip(usable.chunks(BLOCK_PX));
            for (sum, ((a, b), usable)) in sums.iter_mut().zip(parts) {
                let apart = a.iter().zip(b).zip(usable).map(|((a, b), usable)| u32::from(a.abs_diff(*b) & usable));
                *sum += apart.sum::<u32>();
            }
        }
        self.means(sums.into_iter().map(f64::from))
    }

    /// The same of two means.
    pub(super) fn differences(&self, a: &[f32], b: &[f32]) -> Vec<f64> {
        let mut sums = vec![0.0; self.count()];
        for index in (0..a.len()).filter(|index| self.counts(*index)) {
            sums[block_of(index, self.width)] += f64::from((a[index] - b[index]).abs());
        }
        self.means(sums.into_iter())
    }

    /// Of the sums of blocks; 0 where nothing is known.
    fn means(&self, sums: impl Iterator<Item = f64>) -> Vec<f64> {
        let mean = |(sum, pixels): (f64, &u32)| if *pixels >= LEAST_PIXELS { sum / f64::from(*pixels) } else { 0.0 };
        sums.zip(&self.pixels).map(mean).collect()
    }

    /// The first pixel of a block in the video.
    pub(super) fn place_of(&self, block: usize) -> [u32; 2] {
        let columns = self.width.div_ceil(BLOCK_PX);
        let [left, top] = self.origin_px;
        [left + (block % columns * BLOCK_PX) as u32, top + (block / columns * BLOCK_PX) as u32]
    }
}

/// The block that has the most, and what it has.
pub(super) fn largest(blocks: &[f64]) -> (usize, f64) {
    blocks.iter().copied().enumerate().fold((0, 0.0), |most, block| if block.1 > most.1 { block } else { most })
}

fn block_of(index: usize, width: usize) -> usize {
    index / width / BLOCK_PX * width.div_ceil(BLOCK_PX) + index % width / BLOCK_PX
}

fn holds([left, top, width, height]: &Rectangle, [column, row]: [u32; 2]) -> bool {
    (*left..left.saturating_add(*width)).contains(&column) && (*top..top.saturating_add(*height)).contains(&row)
}
