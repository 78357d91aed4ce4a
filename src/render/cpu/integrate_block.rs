//! A band of pixels through scenes whose one volume lies below everything else: shapes and meshes ray by ray, the volume in bundles
//! of sixteen rays.

use glam::DVec2;

use super::bundles::Pattern;
use super::claims::Claims;
use super::crossing::{Below, Crossing};
use super::lanes::{LANES, Lanes, Portable};
use crate::render::prepared::{Bounds, Step};
use crate::render::slabs::{CUT_BIT, MOST_MATERIALS};

/// Edge of the blocks of pixels that are laid out as bundles.
pub const BLOCK: usize = 8;

/// What a block of pixels is given, and gives back.
pub struct Block<'b> {
    /// First column and row, and one past the last.
    pub bounds: Bounds,
    /// Row with which `g_per_cm2` and `valid` begin.
    pub first_row: usize,
    /// Shapes and meshes that may be seen in it, the last object first.
    pub solids: &'b [Step],
    /// g/cm² of the band of rows that the block lies in: pixel by pixel, then by material.
    pub g_per_cm2: &'b mut [f32],
    /// Validity of the same rows.
    pub valid: &'b mut [u8],
    /// Columns of the image.
    pub width: usize,
}

impl Crossing<'_> {
    /// Fills a block; `walk` integrates one ray the slow way where bundles cannot. Returns the longest unscanned path in mm.
    pub fn fill(&self, block: Block, claims: &mut Claims, walk: &mut dyn FnMut(DVec2, &mut [f32]) -> Option<f64>) -> f32 {
        let fill = Fill { crossing: self, block, claims, walk };
        #[cfg(target_arch = "x86_64")]
        if let Some(avx512) = pulp::x86::V4::try_new() {
            return avx512.vectorize(On(fill, avx512));
        }
        #[cfg(target_arch = "x86_64")]
        if let Some(avx2) = pulp::x86::V3::try_new() {
            return avx2.vectorize(On(fill, avx2));
        }
        pulp::NullaryFnOnce::call(On(fill, Portable))
    }
}

struct Fill<'f, 'a, 'b> {
    crossing: &'f Crossing<'a>,
    block: Block<'b>,
    claims: &'f mut Claims,
    walk: &'f mut dyn FnMut(DVec2, &mut [f32]) -> Option<f64>,
}

/// A block on lanes of one kind, to be called where their instructions are allowed.
struct On<'f, 'a, 'b, S>(Fill<'f, 'a, 'b>, S);

impl<S: Lanes> pulp::NullaryFnOnce for On<'_, '_, '_, S> {
    type Output = f32;
    #[inline(always)]
    fn call(self) -> f32 {
        self.0.run(self.1)
    }
}

impl Fill<'_, '_, '_> {
    #[inline(always)]
    fn run<S: Lanes>(self, s: S) -> f32 {
        let Self { crossing, block, claims, walk } = self;
        let prepared = crossing.prepared;
        let bounds = block.bounds;
        let [u0, v0] = bounds.from.map(|n| n as usize);
        let columns = crossing.rays.columns(u0 as f64 + 3.5, v0 as f64 + 3.5, crossing.far_mm);
        let rows = LANES / columns;
        let mut unscanned = 0.0f32;
        let cells = &crossing.seen.cells;
        let first_row = block.first_row;
        let last = [bounds.to[0] as f64 - 1.0, bounds.to[1] as f64 - 1.0];
        let corners = [[u0 as f64, v0 as f64], [last[0], v0 as f64], [u0 as f64, last[1]], last];
        let mut below = Below::new(crossing, corners);
        for v in (v0..bounds.to[1] as usize).step_by(rows) {
            for u in (u0..bounds.to[0] as usize).step_by(columns) {
                let pattern = Pattern::grid([u, v], columns);
                let mut seen = [false; LANES];
                let mut l = 0;
                while l < LANES {
                    seen[l] = pattern.u[l] <= last[0] && pattern.v[l] <= last[1];
                    l += 1;
                }
                let mut aimed = crossing.aim(pattern, &seen);
                let missing = crossing.left_through_faces(&aimed);
                // Shapes and meshes claim their part of each ray; what is left comes in at most `rounds` pieces a ray.
                let mut rounds = usize::from(aimed.any);
                if !block.solids.is_empty() {
                    rounds = claims.claim(prepared, block.solids, &pattern, &seen, &aimed.t);
                }
                let mut sums = [[0.0f32; LANES]; MOST_MATERIALS];
                let mut met = 0;
                let mut lost = false;
                for round in 0..rounds {
                    if !block.solids.is_empty() {
                        claims.round(round, &mut aimed.t);
                    }
                    match below.cross(s, &aimed, &mut sums) {
                        Some(bits) => met |= bits,
                        None => lost = true,
                    }
                }
                let scale = aimed.g_per_cm2();
                if block.solids.is_empty() && !lost && met & CUT_BIT == 0 && !crossing.seen.volume.truncated_at_faces {
                    // Nothing but paths to write.
                    let materials = prepared.material_count;
                    for (m, material) in cells.materials.iter().enumerate() {
                        for l in 0..LANES {
                            if seen[l] {
                                let pixel = (v + l / columns - first_row) * block.width + u + l % columns;
                                block.g_per_cm2[pixel * materials + material] += sums[m][l] * scale[l];
                            }
                        }
                    }
                    continue;
                }
                for l in 0..LANES {
                    if !seen[l] {
                        continue;
                    }
                    let (x, y) = (u + l % columns, v + l / columns);
                    let pixel = (y - first_row) * block.width + x;
                    let materials = prepared.material_count;
                    let out = &mut block.g_per_cm2[pixel * materials..(pixel + 1) * materials];
                    if lost {
                        let missing = walk(DVec2::new(x as f64, y as f64), out);
                        if let Some(missing_mm) = missing {
                            block.valid[pixel] = 0;
                            unscanned = unscanned.max(missing_mm as f32);
                        }
                        continue;
                    }
                    let mm_per_depth = aimed.mm_per_depth[l];
                    if !block.solids.is_empty() {
                        claims.write(l, mm_per_depth, out);
                    }
                    for (m, sums) in sums.iter().enumerate().take(cells.materials.len()) {
                        out[cells.materials[m]] += sums[l] * scale[l];
                    }
                    if met & CUT_BIT != 0 {
                        let cut = if block.solids.is_empty() {
                            crossing.meets_cut(&below, &aimed, l, (aimed.t[0][l], aimed.t[1][l]))
                        } else {
                            claims.gaps[l].iter().any(|gap| crossing.meets_cut(&below, &aimed, l, *gap))
                        };
                        if cut {
                            block.valid[pixel] = 0;
                        }
                    }
                    if missing[l] != 0.0 {
                        block.valid[pixel] = 0;
                        unscanned = unscanned.max((missing[l] * mm_per_depth) as f32);
                    }
                }
            }
        }
        unscanned
    }
}
