//! Sums over histories. Histories come in batches of fixed size, and the spread between batches gives the standard error, whatever one
//! history adds to how many pixels.

use serde::{Deserialize, Serialize};

/// What a photon did before it was detected; the pages of a scatter image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Page {
    /// Nothing.
    Primary,
    /// One Compton scattering.
    Compton,
    /// One Rayleigh scattering.
    Rayleigh,
    /// More than one scattering.
    Multiple,
}

impl Page {
    /// All, in their order.
    pub const ALL: [Self; PAGES] = [Self::Primary, Self::Compton, Self::Rayleigh, Self::Multiple];
}

/// Pages of an image.
pub const PAGES: usize = 4;

/// Names of the pages, in their order.
pub const PAGE_NAMES: [&str; PAGES] = ["primary", "compton_once", "rayleigh_once", "multiple"];

/// Where the energy went, keV, besides what materials absorbed.
pub const FATES: usize = 3;
/// Started.
pub const STARTED: usize = 0;
/// Through the detector plane, on the image or beside it.
pub const DETECTED: usize = 1;
/// Out of the scene elsewhere.
pub const ESCAPED: usize = 2;

/// One batch: page by page the signal in each pixel, then energy absorbed by each scene material, then [`FATES`].
#[derive(Clone, Debug)]
pub struct Batch {
    /// Sums.
    pub sums: Vec<f64>,
    /// Energy by voxel of a dose map, keV, as it comes.
    deposits: Vec<(u32, f64)>,
    pixels: usize,
    materials: usize,
}

impl Batch {
    /// Nothing yet.
    #[must_use]
    pub fn new(pixels: usize, materials: usize) -> Self {
        Self { sums: vec![0.0; PAGES * pixels + materials + FATES], deposits: Vec::new(), pixels, materials }
    }

    /// A photon (or its expectation) on the detector.
    #[inline]
    pub fn detect(&mut self, page: Page, pixel: usize, signal: f64) {
        self.sums[page as usize * self.pixels + pixel] += signal;
    }

    /// Energy that stays in a scene material.
    #[inline]
    pub fn absorb(&mut self, material: u32, energy_kev: f64) {
        self.sums[PAGES * self.pixels + material as usize] += energy_kev;
    }

    /// Energy that stays in a voxel of a dose map.
    #[inline]
    pub fn deposit(&mut self, voxel: u32, energy_kev: f64) {
        self.deposits.push((voxel, energy_kev));
    }

    /// Adds up what came into one voxel: a batch counts by the square of all that it brought there.
    #[must_use]
    pub fn settled(mut self) -> Self {
        // Stable, so that sums are made in the order of the histories.
        self.deposits.sort_by_key(|(voxel, _)| *voxel);
        self.deposits.dedup_by(|later, first| {
            let is_one = later.0 == first.0;
            if is_one {
                first.1 += later.1;
            }
            is_one
        });
        self
    }

    /// Energy that meets a fate.
    #[inline]
    pub fn book(&mut self, fate: usize, energy_kev: f64) {
        self.sums[PAGES * self.pixels + self.materials + fate] += energy_kev;
    }
}

/// Sums of batches and of their squares.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Tally {
    /// Batches so far.
    pub batches: u64,
    /// Histories of each.
    pub histories_per_batch: u64,
    sums: Vec<f64>,
    squares: Vec<f64>,
    /// By pixel, squares of what all pages but the primary add up to.
    scatter_squares: Vec<f64>,
    /// Where a dose map is made.
    dose: Option<DoseSums>,
}

/// Energy by voxel of a dose map, and outside it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct DoseSums {
    sums: Vec<f64>,
    squares: Vec<f64>,
    /// Squares of what all voxels add up to in a batch: what one holds another does not.
    within_squares: f64,
}

/// Contributions of one size below which nobody knows a standard error: one that is missing may be heavier than all that came.
pub const FEWEST: f64 = 10.0;

/// A mean over histories with its standard error.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Estimate {
    /// Per history.
    pub mean: f64,
    /// Its standard error; NaN after a single batch.
    pub standard_error: f64,
}

impl Estimate {
    /// The same, its standard error NaN where less came than [`FEWEST`] contributions of one size, or nothing.
    // n contributions of one size leave a relative error of 1/√n, and where one of many outweighs the rest it is 1: (mean/error)² is how
    // many they are worth, whatever the number of batches. Behind dense matter all that comes may be 1e-30 ± 1e-30, and the truth 1e-7.
    // Over many pixels the squares of errors as they are add up without bias; those of the told ones do not.
    #[must_use]
    pub fn told(self) -> Self {
        let is_told = self.mean > 0.0 && self.mean >= FEWEST.sqrt() * self.standard_error;
        if is_told { self } else { Self { standard_error: f64::NAN, ..self } }
    }
}

impl Tally {
    /// Nothing yet.
    #[must_use]
    pub fn new(pixels: usize, materials: usize, histories_per_batch: u64) -> Self {
        let count = PAGES * pixels + materials + FATES;
        Self {
            batches: 0,
            histories_per_batch,
            sums: vec![0.0; count],
            squares: vec![0.0; count],
            scatter_squares: vec![0.0; pixels],
            dose: None,
        }
    }

    /// The same with the sums of a dose map of so many voxels.
    #[must_use]
    pub fn with_dose(self, voxels: usize) -> Self {
        let dose = DoseSums { sums: vec![0.0; voxels + 1], squares: vec![0.0; voxels + 1], within_squares: 0.0 };
        Self { dose: Some(dose), ..self }
    }

    /// Adds a batch, settled. The order of batches decides the last bits, so it is that of their numbers.
    pub fn add(&mut self, batch: &Batch) {
        self.batches += 1;
        for ((sum, square), value) in self.sums.iter_mut().zip(&mut self.squares).zip(&batch.sums) {
            *sum += value;
            *square += value * value;
        }
        let pixels = self.scatter_squares.len();
        for (pixel, square) in self.scatter_squares.iter_mut().enumerate() {
            *square += (1..PAGES).map(|page| batch.sums[page * pixels + pixel]).sum::<f64>().powi(2);
        }
        if let Some(dose) = &mut self.dose {
            let outside = dose.sums.len() - 1;
            let within = batch.deposits.iter().filter(|(voxel, _)| *voxel as usize != outside);
            dose.within_squares += within.map(|(_, energy_kev)| energy_kev).sum::<f64>().powi(2);
            for (voxel, energy_kev) in &batch.deposits {
                dose.sums[*voxel as usize] += energy_kev;
                dose.squares[*voxel as usize] += energy_kev * energy_kev;
            }
        }
    }

    /// Histories so far.
    #[must_use]
    pub fn histories(&self) -> u64 {
        self.batches * self.histories_per_batch
    }

    /// Whether this has as many sums of each kind as `other`.
    #[must_use]
    pub fn is_like(&self, other: &Self) -> bool {
        let lengths = |tally: &Self| {
            let dose = tally.dose.as_ref().map(|dose| [dose.sums.len(), dose.squares.len()]);
            (tally.sums.len(), tally.squares.len(), tally.scatter_squares.len(), dose)
        };
        lengths(self) == lengths(other)
    }

    /// Voxels of its dose map; `None` where it makes none.
    #[must_use]
    pub fn dose_voxels(&self) -> Option<usize> {
        self.dose.as_ref().map(|dose| dose.sums.len().saturating_sub(1))
    }

    fn pixels(&self) -> usize {
        self.scatter_squares.len()
    }

    /// Signal per history in a pixel of a page.
    #[must_use]
    pub fn signal(&self, page: Page, pixel: usize) -> Estimate {
        let index = page as usize * self.pixels() + pixel;
        self.estimate(self.sums[index], self.squares[index])
    }

    /// Signal per history in a pixel, of all pages but the primary.
    #[must_use]
    pub fn scatter(&self, pixel: usize) -> Estimate {
        let sum = (1..PAGES).map(|page| self.sums[page * self.pixels() + pixel]).sum();
        self.estimate(sum, self.scatter_squares[pixel])
    }

    /// Energy per history that a scene material absorbs, keV.
    #[must_use]
    pub fn absorbed(&self, material: usize) -> Estimate {
        let index = PAGES * self.pixels() + material;
        self.estimate(self.sums[index], self.squares[index])
    }

    /// Energy per history that met a fate, keV.
    #[must_use]
    pub fn fate(&self, fate: usize) -> Estimate {
        let index = self.sums.len() - FATES + fate;
        self.estimate(self.sums[index], self.squares[index])
    }

    /// Energy per history that stayed in a voxel of the dose map, or with the number of its voxels outside it, keV; nothing without a map.
    #[must_use]
    pub fn deposited(&self, voxel: usize) -> Estimate {
        let sums = self.dose.as_ref().and_then(|dose| Some((*dose.sums.get(voxel)?, *dose.squares.get(voxel)?)));
        let (sum, square) = sums.unwrap_or_default();
        self.estimate(sum, square)
    }

    /// Energy per history that stayed in all voxels of the dose map together, keV; nothing without a map.
    #[must_use]
    pub fn deposited_within(&self) -> Estimate {
        let dose = self.dose.as_ref();
        let sums = dose.and_then(|dose| Some((dose.sums.split_last()?.1.iter().sum::<f64>(), dose.within_squares)));
        let (sum, square) = sums.unwrap_or_default();
        self.estimate(sum, square)
    }

    // A batch of n histories sums to B; the mean of N batches estimates E[B] with the standard error √((⟨B²⟩ − ⟨B⟩²)/(N − 1)).
    fn estimate(&self, sum: f64, sum_of_squares: f64) -> Estimate {
        let (batches, per_batch) = (self.batches as f64, self.histories_per_batch as f64);
        let mean = sum / batches;
        let spread = (sum_of_squares / batches - mean * mean).max(0.0);
        let error = if self.batches > 1 { (spread / (batches - 1.0)).sqrt() } else { f64::NAN };
        Estimate { mean: mean / per_batch, standard_error: error / per_batch }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_spread_of_batches_gives_the_textbook_error() {
        let mut tally = Tally::new(1, 1, 10);
        for value in [2.0, 4.0, 9.0] {
            let mut batch = Batch::new(1, 1);
            batch.detect(Page::Rayleigh, 0, value);
            tally.add(&batch);
        }
        let found = tally.signal(Page::Rayleigh, 0);
        // Mean 5, sample variance 13, standard error √(13/3); per history a tenth.
        assert!((found.mean - 0.5).abs() < 1e-15 && (found.standard_error - (13.0_f64 / 3.0).sqrt() / 10.0).abs() < 1e-12);
        assert_eq!(tally.scatter(0), found);
        assert_eq!(tally.signal(Page::Primary, 0).mean, 0.0);
    }

    /// Told from ten contributions of one size on, however many batches saw none. A single spike had an error as large as itself, and cells
    /// that saw only what comes through everything one of 1e-30.
    #[test]
    fn an_error_is_told_once_enough_came() {
        let found = |values: &[f64], batches: usize| {
            let mut tally = Tally::new(1, 1, 10);
            for number in 0..batches {
                let mut batch = Batch::new(1, 1);
                batch.detect(Page::Compton, 0, values.get(number).copied().unwrap_or(0.0));
                tally.add(&batch);
            }
            tally.signal(Page::Compton, 0)
        };
        let mut outweighed = vec![1.0; 40];
        outweighed.push(100.0);
        for (values, batches, is_told) in [
            (Vec::new(), 1000, false),
            (vec![1e-3], 1000, false),
            (vec![1e-30; 9], 1000, false),
            (vec![1e-30; 11], 1000, true),
            (vec![1.0; 40], 40, true),
            (outweighed, 1000, false),
            (vec![1.0], 1, false),
        ] {
            let as_it_is = found(&values, batches);
            let told = as_it_is.told();
            assert_eq!(told.mean, as_it_is.mean);
            assert_eq!(told.standard_error.is_nan(), !is_told, "{values:?}: {as_it_is:?}");
            assert!(!is_told || told == as_it_is);
        }
    }

    /// A voxel's error is that of what batches bring to it, however many deposits that is.
    #[test]
    fn deposits_of_a_batch_count_together() {
        let mut tally = Tally::new(1, 1, 10).with_dose(2);
        for values in [[1.5, 0.5], [1.0, 3.0], [4.0, 5.0]] {
            let mut batch = Batch::new(1, 1);
            batch.deposit(1, values[0]);
            batch.deposit(2, 7.0);
            batch.deposit(1, values[1]);
            // In all ten.
            batch.deposit(0, 10.0 - values[0] - values[1]);
            tally.add(&batch.settled());
        }
        let found = tally.deposited(1);
        // The textbook's numbers again: 2, 4 and 9.
        assert!((found.mean - 0.5).abs() < 1e-15 && (found.standard_error - (13.0_f64 / 3.0).sqrt() / 10.0).abs() < 1e-12);
        assert_eq!((tally.deposited(2).mean, tally.dose_voxels()), (0.7, Some(2)));
        // Its neighbour has what a voxel lacks: they are uncertain, and their sum is not.
        let (neighbour, within) = (tally.deposited(0), tally.deposited_within());
        assert!((neighbour.standard_error - found.standard_error).abs() < 1e-12);
        assert!((within.mean - 1.0).abs() < 1e-15 && within.standard_error < 1e-12, "{within:?}");
        let other = Tally::new(1, 1, 10);
        assert!(tally.is_like(&Tally::new(1, 1, 5).with_dose(2)) && !tally.is_like(&other) && other.dose_voxels().is_none());
    }
}
