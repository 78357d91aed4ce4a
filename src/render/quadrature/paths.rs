//! Which paths through matter the nodes are fitted to and judged by.

use super::mixture::{Mixture, SUMS};

/// Paths and the exact −ln of each sum along them.
#[derive(Clone, Debug, Default)]
pub(super) struct Paths {
    pub materials: usize,
    /// Path-major area densities.
    pub g_per_cm2: Vec<f64>,
    /// −ln of signal, photons and squares, from all bins.
    pub exact: Vec<[f64; SUMS]>,
}

impl Paths {
    pub fn len(&self) -> usize {
        self.exact.len()
    }

    pub fn path(&self, index: usize) -> &[f64] {
        &self.g_per_cm2[index * self.materials..(index + 1) * self.materials]
    }

    /// Copies one path of `other`.
    pub fn take(&mut self, other: &Self, index: usize) {
        self.g_per_cm2.extend_from_slice(other.path(index));
        self.exact.push(other.exact[index]);
    }
}

/// The box of paths, and how far into it an image can reach.
#[derive(Clone, Debug)]
pub(super) struct Reach {
    pub largest_g_per_cm2: Vec<f64>,
    /// The path over which each material's spectrum hardens, where spacing turns from linear to logarithmic.
    knee_g_per_cm2: Vec<f64>,
    pub largest_line_integral: Option<f64>,
}

/// Coordinates of the quasi-random points are stretched by this about the middle and clamped, so that many lie on faces.
const STRETCH: f64 = 1.3;

/// −ln of the strongest thinning.
const THINNEST: f64 = 6.0;

/// (√5 − 1) / 2: its multiples fill the unit interval evenly.
const GOLDEN: f64 = 0.618_033_988_749_894_9;

impl Reach {
    pub fn new(bins: &Mixture, largest_g_per_cm2: Vec<f64>, largest_line_integral: Option<f64>) -> Self {
        let knee = |(material, largest): (usize, &f64)| {
            let mean: f64 = (0..bins.terms()).map(|k| bins.weights[k][0] * bins.attenuation(k)[material]).sum();
            largest.min(0.5 / mean.max(1e-12))
        };
        let knee_g_per_cm2 = largest_g_per_cm2.iter().enumerate().map(knee).collect();
        Self { largest_g_per_cm2, knee_g_per_cm2, largest_line_integral }
    }

    /// Paths for fitting: corners, axes and `quasi_random` points.
    pub fn for_fitting(&self, bins: &Mixture, quasi_random: usize) -> Paths {
        let m = self.largest_g_per_cm2.len();
        let mut unit = Vec::new();
        grid(&mut unit, m, [33, 9, 4, 3, 2, 2, 2][m.min(7) - 1]);
        axes(&mut unit, m, 12);
        let regular = unit.len() / m;
        scattered(&mut unit, m, quasi_random, 0.5);
        self.evaluate(bins, &unit, regular)
    }

    /// Paths to choose from when a fit misses: denser than the fitted, other than the judged.
    pub fn candidates(&self, bins: &Mixture, quasi_random: usize) -> Paths {
        let m = self.largest_g_per_cm2.len();
        let mut unit = Vec::new();
        grid(&mut unit, m, [70, 14, 7, 4, 3, 2, 2][m.min(7) - 1]);
        axes(&mut unit, m, 27);
        if m > 2 {
            pairs(&mut unit, m, 5);
        }
        let regular = unit.len() / m;
        scattered(&mut unit, m, quasi_random, 0.137);
        self.evaluate(bins, &unit, regular)
    }

    /// Paths for judging: a grid with all corners, axes, planes of each pair, and `quasi_random` points.
    pub fn for_judging(&self, bins: &Mixture, quasi_random: usize) -> Paths {
        let m = self.largest_g_per_cm2.len();
        let mut unit = Vec::new();
        grid(&mut unit, m, [200, 24, 11, 6, 4, 3, 2][m.min(7) - 1]);
        axes(&mut unit, m, 40);
        if m > 2 {
            pairs(&mut unit, m, 7);
        }
        let regular = unit.len() / m;
        scattered(&mut unit, m, quasi_random, 0.811);
        self.evaluate(bins, &unit, regular)
    }

    /// Maps points of the unit cube into the box, even ones linearly and odd ones by sinh, and shortens what is out of reach. After
    /// `regular` points every other pair is thinned as a whole: independent lengths are hardly ever all short.
    fn evaluate(&self, bins: &Mixture, unit: &[f64], regular: usize) -> Paths {
        let m = self.largest_g_per_cm2.len();
        let mut paths = Paths { materials: m, ..Paths::default() };
        let (mut path, mut depths) = (vec![0.0; m], Vec::new());
        for (index, point) in unit.chunks_exact(m).enumerate() {
            for (material, u) in point.iter().enumerate() {
                let (largest, knee) = (self.largest_g_per_cm2[material], self.knee_g_per_cm2[material]);
                path[material] = if knee > 0.0 && index % 2 == 1 {
                    (knee * (u * (largest / knee).asinh()).sinh()).min(largest)
                } else {
                    u * largest
                };
            }
            if index >= regular && index % 4 > 1 {
                let scale = (-THINNEST * (index as f64 * GOLDEN).fract()).exp();
                path.iter_mut().for_each(|length| *length *= scale);
            }
            self.shorten(bins, &mut path, &mut depths);
            paths.exact.push(bins.line_integrals(&path, &mut depths));
            paths.g_per_cm2.extend_from_slice(&path);
        }
        paths
    }

    /// Scales `path` down until its line integral is within reach.
    // −ln I is 0 at 0 and concave in the scale, so scaling by limit / (−ln I) approaches the limit from above and never crosses it.
    pub fn shorten(&self, bins: &Mixture, path: &mut [f64], depths: &mut Vec<f64>) {
        let Some(limit) = self.largest_line_integral else { return };
        for _ in 0..12 {
            let [line_integral, ..] = bins.line_integrals(path, depths);
            if !(line_integral > 1.01 * limit) {
                return;
            }
            path.iter_mut().for_each(|length| *length *= limit / line_integral);
        }
    }
}

/// A full grid of `count` points a side.
fn grid(unit: &mut Vec<f64>, m: usize, count: usize) {
    for mut index in 0..count.pow(m as u32) {
        for _ in 0..m {
            unit.push((index % count) as f64 / (count - 1) as f64);
            index /= count;
        }
    }
}

/// `count` points along each axis, twice, so that both spacings see each.
fn axes(unit: &mut Vec<f64>, m: usize, count: usize) {
    for material in 0..m {
        for index in 0..2 * count {
            let u = (index / 2 + 1) as f64 / count as f64;
            unit.extend((0..m).map(|other| if other == material { u } else { 0.0 }));
        }
    }
}

/// `count` by `count` points on the plane of each pair of materials.
fn pairs(unit: &mut Vec<f64>, m: usize, count: usize) {
    for first in 0..m {
        for second in first + 1..m {
            for index in 0..count * count {
                let (u, v) = ((index % count + 1) as f64 / count as f64, (index / count + 1) as f64 / count as f64);
                unit.extend((0..m).map(|other| {
                    if other == first {
                        u
                    } else if other == second {
                        v
                    } else {
                        0.0
                    }
                }));
            }
        }
    }
}

/// `count` points of the additive recurrence with the generalised golden ratio (Roberts 2018), stretched onto the faces.
fn scattered(unit: &mut Vec<f64>, m: usize, count: usize, start: f64) {
    // The root of x^(m+1) = x + 1, by its fixed-point iteration.
    let golden = (0..60).fold(2.0f64, |x, _| (1.0 + x).powf(1.0 / (m as f64 + 1.0)));
    for index in 0..count {
        for axis in 0..m {
            let u = (start + (index + 1) as f64 * golden.powi(-(axis as i32 + 1))).fract();
            unit.push(((u - 0.5) * STRETCH + 0.5).clamp(0.0, 1.0));
        }
    }
}
