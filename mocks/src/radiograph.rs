//! Radiographs by the mock's own physics: closed-form paths, its own small tables, an energy-integrating detector, Poisson noise.

use std::sync::atomic::{AtomicUsize, Ordering};

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, Normal, Poisson};

use crate::MockError;
use crate::kinematics::CarmGeometry;
use crate::matrix::{Mat4, Vec3, inverse, point, sub};
use crate::phantom::{Body, area_densities};

/// Photon fraction and attenuation of the four materials in one energy bin.
#[derive(Clone, Copy, Debug)]
struct Bin {
    energy_kev: f64,
    fraction: f64,
    cm2_per_g: [f64; 4],
}

/// The mock's spectrum and attenuation.
#[derive(Clone, Debug)]
pub struct Physics {
    bins: Vec<Bin>,
}

impl Physics {
    /// The embedded tables.
    ///
    /// # Errors
    /// When they do not fit together.
    pub fn embedded() -> Result<Self, MockError> {
        let rows = |text: &str| -> Vec<Vec<f64>> {
            text.lines().filter_map(|line| line.split(',').map(|cell| cell.parse().ok()).collect()).collect()
        };
        let attenuation = rows(include_str!("../data/attenuation.csv"));
        let mut bins = Vec::new();
        for row in rows(include_str!("../data/spectrum.csv")) {
            let found = attenuation.iter().find(|other| (other[0] - row[0]).abs() < 1e-6);
            let Some(found) = found.filter(|found| found.len() == 5 && row.len() == 2) else {
                return Err(MockError::Data {
                    what: "spectrum.csv".to_owned(),
                    detail: format!("no attenuation at {} keV", row[0]),
                });
            };
            bins.push(Bin { energy_kev: row[0], fraction: row[1], cm2_per_g: std::array::from_fn(|i| found[i + 1]) });
        }
        Ok(Self { bins })
    }

    /// Detected energy relative to air, and its mean and mean square per photon relative to air: (signal, ⟨E⟩ N, ⟨E²⟩ N) sums.
    fn detect(&self, g_per_cm2: &[f64; 4]) -> [f64; 2] {
        let mut sums = [0.0; 2];
        for bin in &self.bins {
            let depth: f64 = bin.cm2_per_g.iter().zip(g_per_cm2).map(|(mu, area)| mu * area).sum();
            let photons = bin.fraction * (-depth).exp();
            sums[0] += photons * bin.energy_kev;
            sums[1] += photons * bin.energy_kev * bin.energy_kev;
        }
        sums
    }

    /// Intensity relative to air.
    #[must_use]
    pub fn intensity(&self, g_per_cm2: &[f64; 4]) -> f64 {
        self.detect(g_per_cm2)[0] / self.detect(&[0.0; 4])[0]
    }
}

/// How a frame is taken.
#[derive(Clone, Copy, Debug)]
pub struct Shot {
    /// Columns and rows.
    pub size_px: [usize; 2],
    /// The arm.
    pub geometry: CarmGeometry,
    /// Focal spot to detector.
    pub source_to_detector_mm: f64,
    /// Pixel size.
    pub pitch_mm: f64,
    /// The pose.
    pub camera_from_lps: Mat4,
    /// Left, top, right, bottom of the open field at the detector; None is open.
    pub field_mm: Option<[f64; 4]>,
    /// Photons per pixel in air.
    pub photons_per_pixel: f64,
    /// Standard deviation of the electronic noise relative to air; 0 for none.
    pub readout_sigma: f64,
    /// No random numbers at all when false.
    pub noise: bool,
    /// Seed of the noise.
    pub seed: u64,
}

/// Sub-samples of a pixel along each axis; the pixel integrates over its area.
const SUBSAMPLES: usize = 2;

/// Columns that share a list of bodies.
const BLOCK: usize = 16;

/// Area densities (soft tissue, bone, nitinol, steel) that differ by less within a pixel are averaged before they attenuate.
const SMOOTH_G_PER_CM2: [f64; 4] = [1e-2, 5e-3, 1e-4, 1e-4];

/// A flat-field corrected radiograph, 1 in air, rows from top to bottom.
#[must_use]
pub fn take(shot: &Shot, bodies: &[Body], physics: &Physics) -> Vec<f64> {
    let [columns, rows] = shot.size_px;
    let lps_from_camera = inverse(&shot.camera_from_lps);
    let source = point(&lps_from_camera, [0.0; 3]);
    let air = physics.detect(&[0.0; 4]);
    let next = AtomicUsize::new(0);
    let mut image = vec![0.0; columns * rows];
    let workers = std::thread::available_parallelism().map_or(1, usize::from);
    let parts: Vec<Vec<(usize, Vec<f64>)>> = std::thread::scope(|scope| {
        let work = || {
            let mut done = Vec::new();
            let mut scratch = Vec::new();
            loop {
                let row = next.fetch_add(1, Ordering::Relaxed);
                if row >= rows {
                    return done;
                }
                let ray = Ray { shot, bodies, physics, lps_from_camera: &lps_from_camera, source, air };
                done.push((row, ray.row(row, &mut scratch)));
            }
        };
        let handles: Vec<_> = (0..workers).map(|_| scope.spawn(work)).collect();
        handles.into_iter().filter_map(|handle| handle.join().ok()).collect()
    });
    for (row, pixels) in parts.into_iter().flatten() {
        image[row * columns..][..columns].copy_from_slice(&pixels);
    }
    image
}

struct Ray<'a> {
    shot: &'a Shot,
    bodies: &'a [Body],
    physics: &'a Physics,
    lps_from_camera: &'a Mat4,
    source: Vec3,
    air: [f64; 2],
}

impl Ray<'_> {
    fn row(&self, row: usize, scratch: &mut Vec<(f64, f64, usize)>) -> Vec<f64> {
        let shot = self.shot;
        // One generator per row, so that the frame does not depend on which thread draws it.
        let mut random = ChaCha8Rng::seed_from_u64(shot.seed.wrapping_mul(1_000_003).wrapping_add(row as u64));
        let mut pixels = Vec::with_capacity(shot.size_px[0]);
        for first in (0..shot.size_px[0]).step_by(BLOCK) {
            let columns = first..(first + BLOCK).min(shot.size_px[0]);
            let near = self.near(&columns, row);
            pixels.extend(columns.map(|column| self.pixel(column, row, &near, &mut random, scratch)));
        }
        pixels
    }

    /// Place of a continuous pixel on the detector, in LPS.
    fn target(&self, u: f64, v: f64) -> Vec3 {
        let shot = self.shot;
        let x = (u - shot.geometry.principal_px[0]) * shot.pitch_mm;
        let y = (v - shot.geometry.principal_px[1]) * shot.pitch_mm;
        point(self.lps_from_camera, [x, y, shot.source_to_detector_mm])
    }

    /// Mean over the sub-samples of what passes: blades and matter.
    fn mean_detected(&self, samples: &[(f64, [f64; 4]); SUBSAMPLES * SUBSAMPLES]) -> [f64; 2] {
        let n = samples.len() as f64;
        let passed = samples.iter().map(|sample| sample.0).sum::<f64>() / n;
        let mean: [f64; 4] = std::array::from_fn(|i| samples.iter().map(|sample| sample.1[i]).sum::<f64>() / n);
        // Half the variance of the depth is what the mean of exp differs by from exp of the mean: below 1e-5 here.
        let smooth = samples.iter().all(|sample| {
            let differences = sample.1.iter().zip(&mean).map(|(a, b)| (a - b).abs());
            sample.0 == passed && differences.zip(SMOOTH_G_PER_CM2).all(|(difference, limit)| difference <= limit)
        });
        if smooth {
            return self.physics.detect(&mean).map(|sum| passed * sum);
        }
        let mut sums = [0.0; 2];
        for (passed, areas) in samples {
            for (sum, detected) in sums.iter_mut().zip(self.physics.detect(areas)) {
                *sum += passed * detected / n;
            }
        }
        sums
    }

    /// The bodies, in order, that a ray to one of these pixels can meet.
    fn near(&self, columns: &std::ops::Range<usize>, row: usize) -> Vec<Body> {
        let (u, v) = (0.5 * (columns.start + columns.end - 1) as f64, row as f64);
        let middle = sub(self.target(u, v), self.source);
        // Rays from one point are nowhere farther apart than at the detector.
        let margin_mm = self.shot.pitch_mm * (0.5 * columns.len() as f64).hypot(0.5);
        self.bodies.iter().filter(|body| body.is_near(self.source, middle, margin_mm)).copied().collect()
    }

    fn pixel(
        &self,
        column: usize,
        row: usize,
        bodies: &[Body],
        random: &mut ChaCha8Rng,
        scratch: &mut Vec<(f64, f64, usize)>,
    ) -> f64 {
        let shot = self.shot;
        let mut samples = [(0.0, [0.0; 4]); SUBSAMPLES * SUBSAMPLES];
        let n = SUBSAMPLES as f64;
        for (sub, sample) in samples.iter_mut().enumerate() {
            let offset = |k: usize| (k as f64 + 0.5) / n - 0.5;
            let u = column as f64 + offset(sub % SUBSAMPLES);
            let v = row as f64 + offset(sub / SUBSAMPLES);
            let x = (u - shot.geometry.principal_px[0]) * shot.pitch_mm;
            let y = (v - shot.geometry.principal_px[1]) * shot.pitch_mm;
            let open = shot.field_mm.is_none_or(|[left, top, right, bottom]| x >= left && x <= right && y >= top && y <= bottom);
            // Lead blades let a thousandth through.
            let passed = if open { 1.0 } else { 1e-3 };
            *sample = (passed, area_densities(bodies, self.source, self.target(u, v), scratch));
        }
        let sums = self.mean_detected(&samples);
        let intensity = sums[0] / self.air[0];
        if !shot.noise {
            return intensity;
        }
        // Fewer photons arrive off the axis: (SDD/d)³. The flat field divides them out again and leaves the noise.
        let sdd = shot.source_to_detector_mm;
        let x = (column as f64 - shot.geometry.principal_px[0]) * shot.pitch_mm;
        let y = (row as f64 - shot.geometry.principal_px[1]) * shot.pitch_mm;
        let obliquity = (sdd / (sdd * sdd + x * x + y * y).sqrt()).powi(3);
        // An energy-integrating signal Σ E_i of Poisson many photons has variance N⟨E²⟩: drawn as a Poisson count of photons of the
        // energy ⟨E²⟩/⟨E⟩, which has the right mean and variance.
        let unit_kev = sums[1] / sums[0].max(1e-300);
        let expected = shot.photons_per_pixel * obliquity * sums[0] / unit_kev;
        let drawn = if expected > 0.0 { Poisson::new(expected).map_or(0.0, |poisson| poisson.sample(random)) } else { 0.0 };
        let quantum = drawn * unit_kev / (shot.photons_per_pixel * obliquity * self.air[0]);
        let electronic = Normal::new(0.0, shot.readout_sigma).map_or(0.0, |normal| normal.sample(random));
        quantum + electronic
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::matrix::translation;
    use crate::phantom::{Form, Matter};

    fn shot(noise: bool) -> Shot {
        let geometry = CarmGeometry {
            column_to_isocentre_mm: [0.0; 3],
            source_to_isocentre_mm: 600.0,
            focal_px: 1000.0,
            principal_px: [19.5, 14.5],
        };
        Shot {
            size_px: [40, 30],
            geometry,
            source_to_detector_mm: 1000.0,
            pitch_mm: 1.0,
            camera_from_lps: translation(0.0, 0.0, 600.0),
            field_mm: None,
            photons_per_pixel: 1e4,
            readout_sigma: 0.0,
            noise,
            seed: 1,
        }
    }

    #[test]
    fn air_is_one_and_noise_has_the_right_size() {
        let physics = Physics::embedded().expect("embedded");
        assert!(take(&shot(false), &[], &physics).iter().all(|value| (value - 1.0).abs() < 1e-12));
        let noisy = take(&shot(true), &[], &physics);
        let mean = noisy.iter().sum::<f64>() / noisy.len() as f64;
        let deviation = (noisy.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / noisy.len() as f64).sqrt();
        assert!((mean - 1.0).abs() < 2e-3 && deviation > 0.0095 && deviation < 0.0125, "{mean} {deviation}");
        assert_eq!(noisy, take(&shot(true), &[], &physics), "the same seed gives the same frame");
    }

    #[test]
    fn a_slab_attenuates_by_the_tables() {
        let physics = Physics::embedded().expect("embedded");
        let block = Body::new(
            Form::Tube { length_mm: 50.0, outer_mm: 400.0, inner_mm: 0.0 },
            &translation(0.0, 0.0, 0.0),
            Matter::SoftTissue,
            1.06,
        );
        let image = take(&shot(false), &[block], &physics);
        let middle = image[15 * 40 + 20];
        let expected = physics.intensity(&[5.3, 0.0, 0.0, 0.0]);
        assert!((middle / expected - 1.0).abs() < 1e-4, "{middle} {expected}");
        assert!((middle / physics.intensity(&[5.4, 0.0, 0.0, 0.0]) - 1.0).abs() > 1e-3, "control");
    }
}
