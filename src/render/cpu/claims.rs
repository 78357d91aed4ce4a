//! What shapes and meshes claim of rays before the volume gets the rest.

use std::sync::Arc;

use glam::{DVec2, DVec3};

use super::bundles::Pattern;
use super::intersect_mesh::MeshTree;
use super::intervals::Intervals;
use super::lanes::LANES;
use super::shapes::intersect;
use crate::render::prepared::{Prepared, Step};

/// What shapes and meshes claim of the rays of a bundle.
#[derive(Debug)]
pub struct Claims {
    trees: Arc<Vec<MeshTree>>,
    covered: Intervals,
    own: Vec<(f64, f64)>,
    /// Depths that the shapes leave of each ray.
    pub gaps: [Vec<(f64, f64)>; LANES],
    /// mm of depth times g/cm³, by material.
    sums: [Vec<f64>; LANES],
}

impl Claims {
    /// Of rays among `trees`, in a scene of so many materials.
    #[must_use]
    pub fn new(trees: Arc<Vec<MeshTree>>, materials: usize) -> Self {
        Self {
            trees,
            covered: Intervals::default(),
            own: Vec::new(),
            gaps: Default::default(),
            sums: std::array::from_fn(|_| vec![0.0; materials]),
        }
    }

    /// Integrates shapes and meshes along the rays of a bundle and keeps the gaps that they leave; returns the most gaps of a ray.
    pub fn claim(
        &mut self,
        prepared: &Prepared,
        solids: &[Step],
        pattern: &Pattern,
        seen: &[bool; LANES],
        t: &[[f64; LANES]; 2],
    ) -> usize {
        let mut rounds = 0;
        for l in 0..LANES {
            self.gaps[l].clear();
            self.sums[l].fill(0.0);
            if !seen[l] {
                continue;
            }
            let direction = prepared.view.intrinsics.unproject(DVec2::new(pattern.u[l], pattern.v[l]));
            self.covered.clear();
            claim_solids(prepared, &self.trees, solids, direction, &mut self.covered, &mut self.own, &mut self.sums[l]);
            let gaps = &mut self.gaps[l];
            if t[1][l] > t[0][l] {
                self.covered.for_each_gap(t[0][l], t[1][l], |from, to| gaps.push((from, to)));
            }
            rounds = rounds.max(gaps.len());
        }
        rounds
    }

    /// The depths of each ray's gap number `round`; an empty one where there is none.
    pub fn round(&self, round: usize, t: &mut [[f64; LANES]; 2]) {
        for (l, gaps) in self.gaps.iter().enumerate() {
            (t[0][l], t[1][l]) = gaps.get(round).copied().unwrap_or((0.0, 0.0));
        }
    }

    /// g/cm² of the shapes and meshes along ray `l`.
    pub fn write(&self, l: usize, mm_per_depth: f64, out: &mut [f32]) {
        for (out, sum) in out.iter_mut().zip(&self.sums[l]) {
            *out = (0.1 * mm_per_depth * sum) as f32;
        }
    }
}

/// Adds depth × density of the shapes and meshes among `steps`, the last object first, and marks what they cover.
pub fn claim_solids(
    prepared: &Prepared,
    trees: &[MeshTree],
    steps: &[Step],
    direction: DVec3,
    covered: &mut Intervals,
    own: &mut Vec<(f64, f64)>,
    sums: &mut [f64],
) {
    let far = prepared.detector_mm;
    for step in steps {
        own.clear();
        let (material, density) = match *step {
            Step::Solid(index) => {
                let seen = &prepared.solids[index];
                let spans = intersect(&seen.solid.shape, seen.source_in_local, seen.local_from_camera * direction);
                own.extend_from_slice(spans.as_slice());
                (seen.solid.material, seen.solid.density_g_per_cm3)
            }
            Step::Mesh(index) => {
                trees[index].inside(direction, own);
                (prepared.meshes[index].mesh.material, prepared.meshes[index].mesh.density_g_per_cm3)
            }
            Step::Volume(_) | Step::VolumeAir(_) => continue,
        };
        for (from, to) in own.iter_mut() {
            (*from, *to) = (from.max(0.0), to.min(far));
            if *to > *from {
                sums[material] += covered.uncovered(*from, *to) * density;
            }
        }
        own.iter().for_each(|(from, to)| covered.insert(*from, *to));
    }
}
