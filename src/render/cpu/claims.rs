//! What shapes and meshes claim of rays before the volume gets the rest.

use glam::{DVec2, DVec3};

use super::bundles::Pattern;
use super::intervals::Intervals;
use super::lanes::LANES;
use super::shapes::{cuboid, intersect};
use super::walk_cells::{CellRay, Field, Found, Pass};
use crate::render::prepared::{Prepared, SeenVolume, Step};

/// One volume, and the shapes and meshes that displace it or are displaced by it; the last object first.
#[derive(Clone, Copy, Debug)]
pub struct Stack<'s> {
    /// Shapes and meshes that displace the volume.
    pub above: &'s [Step],
    /// Index into `Prepared::volumes`.
    pub volume: usize,
    /// Shapes and meshes that the volume displaces.
    pub below: &'s [Step],
}

impl Stack<'_> {
    /// Whether there is nothing but the volume.
    #[inline(always)]
    #[must_use]
    pub fn is_bare(&self) -> bool {
        self.above.is_empty() && self.below.is_empty()
    }
}

/// What shapes and meshes claim of the rays of a bundle.
#[derive(Debug)]
pub struct Claims {
    covered: Intervals,
    own: Vec<(f64, f64)>,
    /// What lies below the volume, and what the volume covers there.
    lower: Intervals,
    found: Found,
    unused: Vec<f64>,
    /// Depths that the shapes leave of each ray.
    pub gaps: [Vec<(f64, f64)>; LANES],
    /// mm of depth times g/cm³, by material.
    sums: [Vec<f64>; LANES],
}

impl Claims {
    /// Of rays in a scene of so many materials.
    #[must_use]
    pub fn new(materials: usize) -> Self {
        Self {
            covered: Intervals::default(),
            own: Vec::new(),
            lower: Intervals::default(),
            found: Found::default(),
            unused: vec![0.0; materials],
            gaps: Default::default(),
            sums: std::array::from_fn(|_| vec![0.0; materials]),
        }
    }

    /// Integrates shapes and meshes along the rays of a bundle and keeps the gaps that those above the volume leave; returns the most gaps
    /// of a ray.
    pub fn claim(
        &mut self,
        prepared: &Prepared,
        Stack { above, volume, below }: Stack,
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
            claim_solids(prepared, above, direction, &mut self.covered, &mut self.own, &mut self.sums[l]);
            let gaps = &mut self.gaps[l];
            if t[1][l] > t[0][l] {
                self.covered.for_each_gap(t[0][l], t[1][l], |from, to| gaps.push((from, to)));
            }
            rounds = rounds.max(gaps.len());
            if !below.is_empty() {
                self.claim_below(l, prepared, volume, below, direction);
            }
        }
        rounds
    }

    /// Integrates what the volume displaces. Cells are walked for that, but only where something lies that they could displace.
    fn claim_below(&mut self, l: usize, prepared: &Prepared, volume: usize, below: &[Step], direction: DVec3) {
        let Self { covered, own, lower, found, unused, sums, .. } = self;
        lower.clear();
        for step in below {
            own.clear();
            spans_of(prepared, step, direction, own);
            own.iter().for_each(|(from, to)| lower.insert(from.max(0.0), to.min(prepared.detector_mm)));
        }
        if lower.is_empty() {
            return;
        }
        let seen = &prepared.volumes[volume];
        let field = Field { volume: seen.volume, cells: &seen.cells, air_kind: seen.air_kind };
        let ray = CellRay { p: seen.cell_from_camera.translation, q: seen.cell_from_camera.matrix3 * direction };
        found.spans.clear();
        (found.collect, found.cut) = (true, false);
        if let Some((enter, leave)) = occupied_depths(seen, &ray) {
            for (from, to) in lower.spans() {
                let (from, to) = (from.max(enter), to.min(leave));
                own.clear();
                covered.for_each_gap(from, to, |a, b| own.push((a, b)));
                own.iter().for_each(|(a, b)| field.integrate(&ray, *a, *b, Pass::Matter, unused, found));
            }
        }
        found.spans.iter().for_each(|(from, to)| covered.insert(*from, *to));
        claim_solids(prepared, below, direction, covered, own, &mut sums[l]);
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
    steps: &[Step],
    direction: DVec3,
    covered: &mut Intervals,
    own: &mut Vec<(f64, f64)>,
    sums: &mut [f64],
) {
    let far = prepared.detector_mm;
    for step in steps {
        own.clear();
        let Some((material, density)) = spans_of(prepared, step, direction, own) else { continue };
        for (from, to) in own.iter_mut() {
            (*from, *to) = (from.max(0.0), to.min(far));
            if *to > *from {
                sums[material] += covered.uncovered(*from, *to) * density;
            }
        }
        own.iter().for_each(|(from, to)| covered.insert(*from, *to));
    }
}

/// Adds the depths at which a ray is inside a shape or mesh; returns its material and density. `None` for a volume.
fn spans_of(prepared: &Prepared, step: &Step, direction: DVec3, own: &mut Vec<(f64, f64)>) -> Option<(usize, f64)> {
    match *step {
        Step::Solid(index) => {
            let seen = &prepared.solids[index];
            let spans = intersect(&seen.solid.shape, seen.source_in_local, seen.local_from_camera * direction);
            own.extend_from_slice(spans.as_slice());
            Some((seen.solid.material, seen.solid.density_g_per_cm3))
        }
        Step::Mesh(index) => {
            let seen = &prepared.meshes[index];
            seen.made.tree.inside(seen.source_in_lps, seen.lps_from_camera * direction, own);
            Some((seen.mesh.material, seen.mesh.density_g_per_cm3))
        }
        Step::Volume(_) | Step::VolumeAir(_) => None,
    }
}

/// Depths between which a ray is inside the box of cells that hold anything.
#[must_use]
pub fn occupied_depths(seen: &SeenVolume, ray: &CellRay) -> Option<(f64, f64)> {
    let whole = DVec3::from_array(seen.volume.size.map(|n| n as f64 + 0.5));
    let [first, end] = seen.cells.occupied.map(|cell| DVec3::from_array(cell.map(|n| n as f64)));
    cuboid(ray.p, ray.q, first.max(DVec3::splat(0.5)), end.min(whole))
}
