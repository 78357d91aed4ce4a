//! A block of pixels that sees one volume, and shapes and meshes above and below it: these ray by ray, the volume in bundles of sixteen
//! rays, or of thirty-two.

use glam::DVec2;

use super::bundles::{Aimed, Pattern};
use super::claims::{Claims, Stack};
use super::crossing::{Below, Crossing};
use super::edges::BundleSums;
use super::fixed_lanes::FixedLanes;
use super::lanes::{LANES, Portable};
use crate::render::bounds::Bounds;
use crate::render::slabs::{CUT_BIT, MOST_MATERIALS};

/// Edge of the blocks of pixels that are laid out as bundles.
pub const BLOCK: usize = 8;

/// What a block of pixels is given, and gives back.
pub struct Block<'b> {
    /// First column and row, and one past the last.
    pub bounds: Bounds,
    /// Row with which `g_per_cm2` and `valid` begin.
    pub first_row: usize,
    /// What may be seen in it.
    pub stack: Stack<'b>,
    /// g/cm² of the band of rows that the block lies in: pixel by pixel, then by material.
    pub g_per_cm2: &'b mut [f32],
    /// Validity of the same rows.
    pub valid: &'b mut [u8],
    /// Columns of the image.
    pub width: usize,
}

impl Crossing<'_> {
    /// Fills a block; `walk` integrates one ray the slow way where bundles cannot, and says whether matter in it borders on the unknown.
    pub fn fill(&self, block: Block, claims: &mut [Claims; 2], walk: &mut dyn FnMut(DVec2, &mut [f32]) -> bool) {
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
    claims: &'f mut [Claims; 2],
    walk: &'f mut dyn FnMut(DVec2, &mut [f32]) -> bool,
}

/// A block on lanes of one kind, to be called where their instructions are allowed.
struct On<'f, 'a, 'b, S>(Fill<'f, 'a, 'b>, S);

impl<S: FixedLanes> pulp::NullaryFnOnce for On<'_, '_, '_, S> {
    type Output = ();
    #[inline(always)]
    fn call(self) {
        self.0.run(self.1);
    }
}

/// Sixteen rays, and what they crossed so far.
struct Shot {
    aimed: Aimed,
    seen: [bool; LANES],
    rounds: usize,
    sums: BundleSums,
}

impl Fill<'_, '_, '_> {
    #[inline(always)]
    fn run<S: FixedLanes>(mut self, s: S) {
        let crossing = self.crossing;
        let bounds = self.block.bounds;
        let [u0, v0] = bounds.from.map(|n| n as usize);
        let ([u, v], far_mm) = ([u0 as f64 + 3.5, v0 as f64 + 3.5], crossing.far_mm);
        let columns =
            if crossing.fixed { crossing.rays.fixed_fit([u, v], far_mm, 1.0).1 } else { crossing.rays.columns(u, v, far_mm) };
        let rows = LANES / columns;
        let last = [bounds.to[0] as f64 - 1.0, bounds.to[1] as f64 - 1.0];
        let corners = [[u0 as f64, v0 as f64], [last[0], v0 as f64], [u0 as f64, last[1]], last];
        let mut below = Below::new(crossing, corners);
        // Bundles two by two, the second below the first.
        for v in (v0..bounds.to[1] as usize).step_by(2 * rows) {
            for u in (u0..bounds.to[0] as usize).step_by(columns) {
                let patterns = [Pattern::grid([u, v], columns), Pattern::grid([u, v + rows], columns)];
                let mut shots = [self.aim(0, patterns[0], last), self.aim(1, patterns[1], last)];
                let rounds = shots[0].rounds.max(shots[1].rounds);
                let mut met = [0; 2];
                let mut lost = false;
                for round in 0..rounds {
                    if !self.block.stack.is_bare() {
                        self.claims[0].round(round, &mut shots[0].aimed.t);
                        self.claims[1].round(round, &mut shots[1].aimed.t);
                    }
                    let [first, second] = &mut shots;
                    if crossing.fixed {
                        match below.cross_fixed(s, [&first.aimed, &second.aimed], [&mut first.sums, &mut second.sums]) {
                            Some(bits) => met = [met[0] | bits, met[1] | bits],
                            None => lost = true,
                        }
                        continue;
                    }
                    for (half, bits) in [first, second].into_iter().zip(&mut met) {
                        if round < half.rounds {
                            match below.cross(s, &half.aimed, &mut half.sums) {
                                Some(found) => *bits |= found,
                                None => lost = true,
                            }
                        }
                    }
                }
                for half in 0..2 {
                    self.write(half, &shots[half], met[half], lost, &below);
                }
            }
        }
    }

    /// Aims at a bundle; shapes and meshes claim their part of each ray; what is left comes in at most `rounds` pieces a ray.
    #[inline(always)]
    fn aim(&mut self, half: usize, pattern: Pattern, last: [f64; 2]) -> Shot {
        let mut seen = [false; LANES];
        let mut l = 0;
        while l < LANES {
            seen[l] = pattern.u[l] <= last[0] && pattern.v[l] <= last[1];
            l += 1;
        }
        let aimed = self.crossing.aim(pattern, &seen);
        let mut rounds = usize::from(aimed.any);
        if !self.block.stack.is_bare() {
            rounds = self.claims[half].claim(self.crossing.prepared, self.block.stack, &pattern, &seen, &aimed.t);
        }
        Shot { aimed, seen, rounds, sums: [[0.0; LANES]; MOST_MATERIALS] }
    }

    /// Writes a bundle's paths.
    #[inline(always)]
    fn write(&mut self, half: usize, shot: &Shot, met: u8, lost: bool, below: &Below) {
        let Shot { aimed, seen, sums, .. } = shot;
        let (crossing, block, claims) = (self.crossing, &mut self.block, &self.claims[half]);
        let materials = crossing.prepared.material_count;
        let cells = &crossing.seen.cells;
        let pattern = &aimed.pattern;
        let pixel = |l: usize| {
            let [u, v] = pattern.pixel(l);
            (v - block.first_row) * block.width + u
        };
        let scale = aimed.g_per_cm2();
        if block.stack.is_bare() && !lost && met & CUT_BIT == 0 {
            // Nothing but paths to write.
            for (m, material) in cells.materials.iter().enumerate() {
                for l in 0..LANES {
                    if seen[l] {
                        block.g_per_cm2[pixel(l) * materials + material] += sums[m][l] * scale[l];
                    }
                }
            }
            return;
        }
        for l in 0..LANES {
            if !seen[l] {
                continue;
            }
            let pixel = pixel(l);
            let out = &mut block.g_per_cm2[pixel * materials..(pixel + 1) * materials];
            if lost {
                if (self.walk)(DVec2::new(pattern.u[l], pattern.v[l]), out) {
                    block.valid[pixel] = 0;
                }
                continue;
            }
            let mm_per_depth = aimed.mm_per_depth[l];
            if !block.stack.is_bare() {
                claims.write(l, mm_per_depth, out);
            }
            for (m, sums) in sums.iter().enumerate().take(cells.materials.len()) {
                out[cells.materials[m]] += sums[l] * scale[l];
            }
            if met & CUT_BIT != 0 {
                let cut = if block.stack.is_bare() {
                    crossing.meets_cut(below, aimed, l, (aimed.t[0][l], aimed.t[1][l]))
                } else {
                    claims.gaps[l].iter().any(|gap| crossing.meets_cut(below, aimed, l, *gap))
                };
                if cut {
                    block.valid[pixel] = 0;
                }
            }
        }
    }
}
