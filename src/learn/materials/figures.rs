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
    /// up soft tissue. Air and lung are told by the same rule whoever tells bone, and metal (of a CT what has 2500 HU and more) is neither: they do
    /// not count.
    #[must_use]
    pub fn of(specimen: &LabelledSpecimen, said: &[bool]) -> Self {
        let curve = DensityCurve::shipped();
        let truth: Vec<bool> =
            (0..specimen.hu.len()).map(|index| specimen.hu[index] >= DENSE_HU && specimen.is_in_bone(index)).collect();
        let near = squared_mm2(specimen.grid.size, specimen.grid.spacing_mm(), |index| truth[index]);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::learn::specimen::upright;

    #[test]
    fn voxels_are_counted_where_they_count() {
        // In bone: marrow, spongy, dense; beside it: contrast medium, muscle; far away: muscle; air; metal.
        let mut hu = vec![50.0, 180.0, 900.0, 300.0, 60.0];
        hu.extend([40.0; 5]);
        hu.extend([-990.0, 3000.0]);
        let mut structure = vec![1, 1, 1, 2, 3];
        structure.extend([3; 5]);
        structure.extend([0, METAL]);
        let specimen = LabelledSpecimen {
            name: "a".into(),
            is_phantom: false,
            grid: upright([12, 1, 1], [2.0, 1.0, 1.0]),
            hu,
            structure,
            bones: vec![1],
            origin: String::new(),
        };
        let mut said = vec![false; 12];
        (said[1], said[2], said[4]) = (true, true, true);
        let figures = MaterialsFigures::of(&specimen, &said).named(" of a");
        let close = |name: &str, expected: f64| {
            let found = figures[&format!("{name} of a")];
            assert!((found - expected).abs() < 1e-12, "{name}: {found} {expected}");
        };
        // Ten voxels of tissue, of which the muscle beside is wrong; two are bone.
        close("error", 0.1);
        close("dice bone", 4.0 / 5.0);
        close("dice soft tissue", 14.0 / 15.0);
        // Six lie within 5 mm of the two: from the marrow to 4 mm behind the dense one.
        close("error within 5 mm of bone", 1.0 / 5.0);
        close("error from 100 to 400 HU", 0.0);
        // Thresholding misses the spongy one and invents the contrast medium.
        close("threshold error", 0.2);
        close("threshold error from 100 to 400 HU", 1.0);
        let twice = MaterialsFigures::of(&specimen, &said).and(MaterialsFigures::of(&specimen, &said));
        assert_eq!(twice.named(" of a"), figures);
    }
}
