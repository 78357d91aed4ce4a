//! Distances in a grid of voxels.

use rayon::prelude::*;

/// Squared distance, mm², of every voxel's centre to that of the nearest for which `is_there`, i fastest; infinite where there is none.
/// Exact: a lower envelope of parabolas along each axis in turn (Felzenszwalb & Huttenlocher 2012).
pub(super) fn squared_mm2(size: [usize; 3], spacing_mm: [f64; 3], is_there: impl Fn(usize) -> bool + Sync) -> Vec<f32> {
    let [width, height, depth] = size;
    let slice = width * height;
    let mut values: Vec<f32> =
        (0..slice * depth).into_par_iter().map(|at| if is_there(at) { 0.0 } else { f32::INFINITY }).collect();
    let squared = spacing_mm.map(|mm| (mm * mm) as f32);
    values.par_chunks_mut(slice).for_each(|slice| {
        let mut envelope = Envelope::default();
        slice.chunks_mut(width).for_each(|row| envelope.along(row, squared[0]));
        let mut column = vec![0.0; height];
        for i in 0..width {
            (0..height).for_each(|j| column[j] = slice[i + width * j]);
            envelope.along(&mut column, squared[1]);
            (0..height).for_each(|j| slice[i + width * j] = column[j]);
        }
    });
    // Across the slices: lines of one row of all slices at a time, so that threads write what is theirs.
    let rows: Vec<Vec<f32>> = (0..height)
        .into_par_iter()
        .map(|j| {
            let mut envelope = Envelope::default();
            let mut lines = vec![0.0; width * depth];
            for i in 0..width {
                let line = &mut lines[i * depth..(i + 1) * depth];
                (0..depth).for_each(|k| line[k] = values[i + width * j + slice * k]);
                envelope.along(line, squared[2]);
            }
            lines
        })
        .collect();
    values.par_chunks_mut(slice).enumerate().for_each(|(k, slice)| {
        for (j, lines) in rows.iter().enumerate() {
            (0..width).for_each(|i| slice[i + width * j] = lines[i * depth + k]);
        }
    });
    values
}

/// The lower envelope of the parabolas of a line, kept between lines.
#[derive(Default)]
struct Envelope {
    /// Where the parabolas stand, and from where on each is the lowest.
    places: Vec<usize>,
    from: Vec<f32>,
    heights: Vec<f32>,
}

impl Envelope {
    /// min over q of `squared` · (p − q)² + line[q], for every p.
    fn along(&mut self, line: &mut [f32], squared: f32) {
        self.places.clear();
        self.from.clear();
        for (at, height) in line.iter().enumerate().filter(|(_, height)| height.is_finite()) {
            let mut from = f32::NEG_INFINITY;
            while let Some(last) = self.places.last() {
                // Where both are as high.
                let (p, q) = (at as f32, *last as f32);
                let cross = ((height - line[*last]) / squared + p * p - q * q) / (2.0 * (p - q));
                if cross > *self.from.last().expect("as many as places") {
                    from = cross;
                    break;
                }
                self.places.pop();
                self.from.pop();
            }
            self.places.push(at);
            self.from.push(from);
        }
        if self.places.is_empty() {
            return;
        }
        self.heights.clear();
        let mut lowest = 0;
        for at in 0..line.len() {
            while lowest + 1 < self.places.len() && self.from[lowest + 1] <= at as f32 {
                lowest += 1;
            }
            let apart = at as f32 - self.places[lowest] as f32;
            self.heights.push(squared * apart * apart + line[self.places[lowest]]);
        }
        line.copy_from_slice(&self.heights);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Stream};

    #[test]
    fn distances_are_those_of_a_search_of_all_voxels() {
        let (size, spacing) = ([7, 6, 5], [0.7, 1.3, 2.5]);
        let at = |index: usize| [index % 7, index / 7 % 6, index / 42];
        let mut stream = Stream::new(5, 0, 0, Purpose::Evaluation);
        for share in [0.02, 0.1, 0.5] {
            let there: Vec<bool> = (0..210).map(|_| stream.uniform() < share).collect();
            let found = squared_mm2(size, spacing, |index| there[index]);
            for (index, found) in found.iter().enumerate() {
                let apart = |other: usize| -> f64 {
                    let steps: [f64; 3] = std::array::from_fn(|axis| at(index)[axis] as f64 - at(other)[axis] as f64);
                    (0..3).map(|axis| (steps[axis] * spacing[axis]).powi(2)).sum()
                };
                let nearest = (0..210).filter(|other| there[*other]).map(apart).fold(f64::INFINITY, f64::min);
                assert!(f64::from(*found) == nearest || (f64::from(*found) - nearest).abs() < 1e-4, "{index}: {found} {nearest}");
            }
        }
        assert!(squared_mm2(size, spacing, |_| false).iter().all(|value| value.is_infinite()));
    }
}
