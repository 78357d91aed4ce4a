//! Separable convolution with a Gaussian, as fast as the machine multiplies.

use rayon::prelude::*;

use crate::image::{Image, on_widest_vectors};

/// Gaussian weights out to 3 σ, normalised to a sum of 1.
pub(super) fn gaussian(sigma_px: f64) -> Vec<f32> {
    let radius = (3.0 * sigma_px).ceil().max(1.0) as i32;
    let weights: Vec<f64> = (-radius..=radius).map(|i| (-0.5 * (f64::from(i) / sigma_px).powi(2)).exp()).collect();
    let sum: f64 = weights.iter().sum();
    weights.iter().map(|w| (w / sum) as f32).collect()
}

/// Columns that are summed at a time, in registers.
const COLUMNS: usize = 64;
/// Rows of which a core makes the same columns one after the other: what they read stays near.
const ROWS: usize = 16;

/// Separable convolution, evaluated at every `stride`-th column and row; beyond the image there is zero. Each sum takes the kernel's weights in
/// their order, so that it is the same however it is divided among cores and registers.
pub(super) fn convolve(image: &Image<f32>, kernel: &[f32], stride: usize) -> Image<f32> {
    let (width, height) = (image.width.div_ceil(stride), image.height.div_ceil(stride));
    let radius = kernel.len() / 2;
    let blocks = width.div_ceil(COLUMNS);
    // An odd number of cache lines, so that the rows of one block do not displace each other.
    let long = blocks * COLUMNS + COLUMNS / 4;
    let lane_long = blocks * COLUMNS + kernel.len();
    // Where in the lanes of a row each weight finds what the first column takes of it.
    let starts: Vec<usize> = (0..kernel.len()).map(|tap| tap % stride * lane_long + tap / stride).collect();
    let mut across = vec![0.0f32; long * image.height];
    across.par_chunks_mut(long).zip(image.pixels.par_chunks(image.width.max(1))).for_each_init(
        || vec![0.0f32; stride * lane_long],
        |lanes, (out, row)| {
            // What lies beyond the row stays zero.
            for (phase, lane) in lanes.chunks_exact_mut(lane_long).enumerate() {
                // The first place of this phase that the row has.
                let skipped = (phase + stride - radius % stride) % stride;
                let (lane, row) = (&mut lane[(radius + skipped) / stride..], row.get(skipped..).unwrap_or_default());
                match stride {
                    1 => lane[..row.len()].copy_from_slice(row),
                    2 => {
                        let (pairs, last) = row.as_chunks::<2>();
                        lane.iter_mut().zip(pairs).for_each(|(to, [from, _])| *to = *from);
                        last.iter().for_each(|from| lane[pairs.len()] = *from);
                    }
                    _ => lane.iter_mut().zip(row.iter().step_by(stride)).for_each(|(to, from)| *to = *from),
                }
            }
            on_widest_vectors(Across { out: &mut out[..blocks * COLUMNS], lanes, starts: &starts, kernel });
        },
    );
    let mut down = vec![0.0f32; width * height];
    down.par_chunks_mut(width.max(1) * ROWS).enumerate().for_each(|(chunk, out)| {
        let first = (chunk * ROWS * stride) as isize - radius as isize;
        on_widest_vectors(Down { out, width, across: &across, long, kernel, first, stride });
    });
    Image { width, height, pixels: down }
}

/// A row of `out`, in whole blocks: column u takes of `lanes`, with each weight of the kernel, what lies u after its start.
struct Across<'a> {
    out: &'a mut [f32],
    lanes: &'a [f32],
    starts: &'a [usize],
    kernel: &'a [f32],
}

impl pulp::NullaryFnOnce for Across<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        for (block, out) in self.out.chunks_exact_mut(COLUMNS).enumerate() {
            let mut sums = [0.0f32; COLUMNS];
            for (start, weight) in self.starts.iter().zip(self.kernel) {
                // Slices rather than indices or steps: without a check in each step these are vectors.
                let lane = &self.lanes[start + block * COLUMNS..][..COLUMNS];
                sums.iter_mut().zip(lane).for_each(|(sum, value)| *sum += weight * value);
            }
            out.copy_from_slice(&sums);
        }
    }
}

/// Some rows of `out`, `width` long each, from the rows of `across`, `long` each: the first from row `first` on, each other `stride` rows below.
struct Down<'a> {
    out: &'a mut [f32],
    width: usize,
    across: &'a [f32],
    long: usize,
    kernel: &'a [f32],
    first: isize,
    stride: usize,
}

impl pulp::NullaryFnOnce for Down<'_> {
    type Output = ();

    #[inline(always)]
    fn call(self) {
        let rows = (self.across.len() / self.long) as isize;
        for from in (0..self.width).step_by(COLUMNS) {
            let columns = from..(from + COLUMNS).min(self.width);
            for (v, out) in self.out.chunks_exact_mut(self.width).enumerate() {
                let first = self.first + (v * self.stride) as isize;
                let skipped = (-first).max(0) as usize;
                let beyond = (rows - first).clamp(0, self.kernel.len() as isize) as usize;
                let mut sums = [0.0f32; COLUMNS];
                for (tap, weight) in self.kernel.iter().enumerate().take(beyond).skip(skipped) {
                    let row = &self.across[(first + tap as isize) as usize * self.long + from..][..COLUMNS];
                    sums.iter_mut().zip(row).for_each(|(sum, value)| *sum += weight * value);
                }
                out[columns.clone()].copy_from_slice(&sums[..columns.len()]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// As the definition has it, weight by weight in their order: sums are the same bit for bit, whatever the machine makes of them at once.
    #[test]
    fn sums_are_those_of_the_weights_in_their_order_bit_for_bit() {
        let mut cases = 0;
        for (width, height) in [(0, 0), (1, 1), (3, 40), (64, 17), (131, 35)] {
            let pixels = (0..width * height).map(|at| ((at * 7919 + 5) % 1013) as f32 * 0.37 - 180.0).collect();
            let image = Image::from_pixels(width, height, pixels).expect("size");
            for (sigma_px, stride) in [(0.3, 1), (1.5, 1), (4.0, 1), (1.5, 2), (6.0, 2), (2.0, 3)] {
                let kernel = gaussian(sigma_px);
                let radius = kernel.len() / 2;
                let sum = |at: usize, end: usize, value: &dyn Fn(usize) -> f32| {
                    let place = |tap: usize| (at * stride + tap).checked_sub(radius).filter(|place| *place < end);
                    let taken = kernel.iter().enumerate().filter_map(|(tap, weight)| Some(weight * value(place(tap)?)));
                    taken.fold(0.0f32, |sum, value| sum + value)
                };
                let across = |u: usize, row: usize| sum(u, width, &|column| *image.at(column, row));
                let found = convolve(&image, &kernel, stride);
                assert_eq!([found.width, found.height], [width.div_ceil(stride), height.div_ceil(stride)]);
                for (at, value) in found.pixels.iter().enumerate() {
                    let (u, v) = (at % found.width, at / found.width);
                    let expected = sum(v, height, &|row| across(u, row));
                    assert_eq!(value.to_bits(), expected.to_bits(), "{width}x{height}, {sigma_px}, {stride}: {u}, {v}");
                    cases += 1;
                }
            }
        }
        assert!(cases > 15_000, "{cases} sums");
    }
}
