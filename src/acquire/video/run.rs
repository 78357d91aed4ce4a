//! Pictures in succession that are alike, summed up.

use crate::image::Image;

/// What the mean of n pictures differs by for its noise alone is the change from picture to picture over √n; so many times that is new.
const OVER_MEAN_NOISE: f64 = 1.6;

/// Pictures in succession that are alike.
pub(super) struct Run {
    pub(super) since_s: f64,
    pub(super) first: Image<u8>,
    /// Of its first half, and of its second.
    sums: [Vec<u32>; 2],
    pub(super) pictures: [u32; 2],
    /// The largest change among them.
    change: f64,
}

impl Run {
    pub(super) fn of(picture: &Image<u8>, since_s: f64) -> Self {
        let sums = picture.pixels.iter().map(|value| u32::from(*value)).collect();
        let none = vec![0; picture.pixels.len()];
        Self { since_s, first: picture.clone(), sums: [sums, none], pictures: [1, 0], change: 0.0 }
    }

    pub(super) fn add(&mut self, picture: &Image<u8>, change: f64, half: usize) {
        self.sums[half].iter_mut().zip(&picture.pixels).for_each(|(sum, value)| *sum += u32::from(*value));
        self.pictures[half] += 1;
        self.change = self.change.max(change);
    }

    pub(super) fn count(&self) -> u32 {
        self.pictures[0] + self.pictures[1]
    }

    pub(super) fn mean(&self) -> Vec<f32> {
        let count = self.count() as f32;
        self.sums[0].iter().zip(&self.sums[1]).map(|(a, b)| (a + b) as f32 / count).collect()
    }

    pub(super) fn half(&self, half: usize) -> Vec<f32> {
        let count = self.pictures[half].max(1) as f32;
        self.sums[half].iter().map(|sum| *sum as f32 / count).collect()
    }

    /// By how much the mean of so many of its pictures may differ for noise alone.
    pub(super) fn noise_of(&self, pictures: u32) -> f64 {
        OVER_MEAN_NOISE * self.change / f64::from(pictures.max(1)).sqrt()
    }
}
