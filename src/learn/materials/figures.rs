//! How good a materials network is on specimens, beside thresholding.

use std::collections::BTreeMap;

use super::distance::squared_mm2;
use crate::infer::materials::DENSE_HU;
use crate::learn::specimen::{LabelledSpecimen, METAL};
use crate::scene::{DensityCurve, ThresholdClass};

/// How near to bone errors cost most: partial volumes and what touches it.
const NEAR_MM: f32 = 5.0;
/// Where thresholding guesses.
const DOUBTFUL_HU: [f32; 2] = [100.0, 400.0];

/// Voxels by what they are and what is said of them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Counts {
    bone: u64,
    missed: u64,
    invented: u64,
    soft: u64,
}

impl Counts {
    fn add(&mut self, truth: bool, said: bool) {
        *match (truth, said) {
            (true, true) => &mut self.bone,
            (true, false) => &mut self.missed,
            (false, true) => &mut self.invented,
            (false, false) => &mut self.soft,
        } += 1;
    }

    fn and(self, other: Self) -> Self {
        Self {
            bone: self.bone + other.bone,
            missed: self.missed + other.missed,
            invented: self.invented + other.invented,
            soft: self.soft + other.soft,
        }
    }

    /// Share of the voxels that are wrong; 0 of none.
    fn error(self) -> f64 {
        let wrong = self.missed + self.invented;
        wrong as f64 / (wrong + self.bone + self.soft).max(1) as f64
    }

    /// 2 |A ∩ B| / (|A| + |B|) of the class of which `of` voxels are right; 1 where there are none and none is said.
    fn dice(self, of: u64) -> f64 {
        let wrong = self.missed + self.invented;
        if of + wrong == 0 { 1.0 } else { 2.0 * of as f64 / (2 * of + wrong) as f64 }
    }
}

/// Counts of one way to tell bone: of all tissue, of what lies near bone, and of what is doubtful by its Hounsfield number.
type Ways = [Counts; 3];

/// What a network and thresholding say of specimens.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MaterialsFigures {
    network: Ways,
    threshold: Ways,
}

impl MaterialsFigures {
    /// Of one specimen, whose voxels are bone where `said`. Bone is what has at least 100 HU in a structure that is bone, all else from −700 HU
    /// up soft tissue. Air and lung are told by the same rule whoever tells bone, and metal is neither: they do not count.
    #[must_use]
    pub fn of(specimen: &LabelledSpecimen, said: &[bool]) -> Self {
        let curve = DensityCurve::shipped();
        let truth: Vec<bool> =
            (0..specimen.hu.len()).map(|index| specimen.hu[index] >= DENSE_HU && specimen.is_in_bone(index)).collect();
        let near = squared_mm2(specimen.size, specimen.volume().spacing_mm(), |index| truth[index]);
        let mut found = Self::default();
        for (index, hu) in specimen.hu.iter().enumerate() {
            let class = curve.class(f64::from(*hu));
            if class == ThresholdClass::Thin || specimen.structure[index] == METAL {
                continue;
            }
            let is_of = [true, near[index] <= NEAR_MM * NEAR_MM, (DOUBTFUL_HU[0]..=DOUBTFUL_HU[1]).contains(hu)];
            for way in (0..3).filter(|way| is_of[*way]) {
                found.network[way].add(truth[index], said[index]);
                found.threshold[way].add(truth[index], class == ThresholdClass::Bone);
            }
        }
        found
    }

    /// Of the specimens of both together.
    #[must_use]
    pub fn and(self, other: Self) -> Self {
        let both = |a: Ways, b: Ways| std::array::from_fn(|way| a[way].and(b[way]));
        Self { network: both(self.network, other.network), threshold: both(self.threshold, other.threshold) }
    }

    /// By name, `of` whom.
    #[must_use]
    pub fn named(&self, of: &str) -> BTreeMap<String, f64> {
        let mut figures = BTreeMap::new();
        for (prefix, [all, near, doubtful]) in [("", self.network), ("threshold ", self.threshold)] {
            for (name, value) in [
                ("dice bone", all.dice(all.bone)),
                ("dice soft tissue", all.dice(all.soft)),
                ("error", all.error()),
                ("error within 5 mm of bone", near.error()),
                ("error from 100 to 400 HU", doubtful.error()),
            ] {
                figures.insert(format!("{prefix}{name}{of}"), value);
            }
        }
        figures
    }
}
