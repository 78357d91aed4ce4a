//! A band of pixels through scenes whose one volume lies below everything else: shapes and meshes ray by ray, the volume in bundles
//! of sixteen rays.

use glam::{DVec2, DVec3};

use super::bundles::{Pattern, Rays};
use super::cross_slabs::cross;
use super::edges::Layers;
use super::integrate_density::{Claims, claim_solids};
use super::lanes::{LANES, Lanes, Portable};
use super::walk_cells::CellRay;
use crate::render::cells::{CUT, EMPTY, EMPTY_BRICK};
use crate::render::prepared::{Bounds, Prepared, SeenVolume, Step};
use crate::render::slabs::{AXES, CUT_BIT, MOST_MATERIALS, SlabGrid};

/// Edge of the blocks of pixels that are laid out as bundles.
pub const BLOCK: usize = 8;

/// The volume of a scene that can be crossed in bundles.
pub struct Crossing<'a> {
    /// The scene.
    pub prepared: &'a Prepared<'a>,
    /// Its volume.
    pub seen: &'a SeenVolume<'a>,
    rays: Rays,
    grids: [Option<SlabGrid<'a>>; 3],
    /// Depth at which the volume ends, at most that of the detector.
    far_mm: f64,
}

/// What a block of pixels is given, and gives back.
pub struct Block<'b> {
    /// First column and row, and one past the last.
    pub bounds: Bounds,
    /// Shapes and meshes that may be seen in it, the last object first.
    pub solids: &'b [Step],
    /// g/cm² of the band of rows that the block lies in: pixel by pixel, then by material.
    pub g_per_cm2: &'b mut [f32],
    /// Validity of the same rows.
    pub valid: &'b mut [u8],
    /// Columns of the image.
    pub width: usize,
}

impl<'a> Crossing<'a> {
    /// `None` when the volume must be walked cell by cell: air is kept, or no slabs were made.
    #[must_use]
    pub fn new(prepared: &'a Prepared<'a>, index: usize) -> Option<Self> {
        let seen = &prepared.volumes[index];
        let slabs = seen.slabs.as_ref().filter(|_| seen.air_kind.is_none())?;
        let camera_from_cell = seen.cell_from_camera.inverse();
        let size = DVec3::from_array(seen.volume.size.map(|n| n as f64 + 1.0));
        let corner = |i: usize| size * DVec3::new((i & 1) as f64, (i >> 1 & 1) as f64, (i >> 2) as f64);
        let far_mm = (0..8).map(|i| camera_from_cell.transform_point3(corner(i)).z).fold(0.0, f64::max);
        let grids = [slabs.grid(0), slabs.grid(1), slabs.grid(2)];
        Some(Self { prepared, seen, rays: Rays::new(&prepared.view, seen), grids, far_mm: far_mm.min(prepared.detector_mm) })
    }

    /// Fills a block; `walk` integrates one ray the slow way where bundles cannot. Returns the longest unscanned path in mm.
    pub fn fill(&self, block: Block, claims: &mut Claims, walk: &mut dyn FnMut(DVec2, &mut [f32]) -> Option<f64>) -> f32 {
        let fill = Fill { crossing: self, block, claims, walk };
        #[cfg(target_arch = "x86_64")]
        if let Some(avx512) = pulp::x86::V4::try_new() {
            return avx512.vectorize(OnAvx512(fill, avx512));
        }
        fill.run(Portable)
    }

    /// Depths between which each ray crosses what holds matter; `whole` is the grid itself.
    #[inline(always)]
    fn depths(&self, low: [f64; 3], high: [f64; 3], q: &[[f64; 3]; LANES]) -> [[f64; LANES]; 2] {
        let mut t = [[0.0; LANES], [self.prepared.detector_mm; LANES]];
        let mut axis = 0;
        while axis < 3 {
            let (to_low, to_high) = (low[axis] - self.rays.p[axis], high[axis] - self.rays.p[axis]);
            let mut l = 0;
            while l < LANES {
                // A ray along the faces: far in or far out, never 0 · ∞.
                let along = if q[l][axis].abs() < 1e-12 { 1e-12 } else { q[l][axis] };
                let (x, y) = (to_low / along, to_high / along);
                let (x, y) = if x < y { (x, y) } else { (y, x) };
                t[0][l] = if x > t[0][l] { x } else { t[0][l] };
                t[1][l] = if y < t[1][l] { y } else { t[1][l] };
                l += 1;
            }
            axis += 1;
        }
        t
    }
}

/// What lies below a rectangle of pixels.
struct Below<'c, 'a> {
    crossing: &'c Crossing<'a>,
    /// Corners of the rectangle.
    corners: [[f64; 2]; 4],
    filled: [bool; 3],
    layers: [Layers; 3],
}

impl<'c, 'a> Below<'c, 'a> {
    fn new(crossing: &'c Crossing<'a>, corners: [[f64; 2]; 4]) -> Self {
        Self { crossing, corners, filled: [false; 3], layers: Default::default() }
    }

    /// Adds ∫ρ dc of the rays of `pattern`, whose directions are `q`, along each of the `axes` that are dominant for any. Returns the bits
    /// of the bricks below; `None` where an axis has no slabs.
    #[inline(always)]
    fn cross<S: Lanes>(
        &mut self,
        s: S,
        pattern: &Pattern,
        q: &[[f64; 3]; LANES],
        axes: &[bool; 3],
        t: &[[f64; LANES]; 2],
        sums: &mut [[f32; LANES]; MOST_MATERIALS],
    ) -> Option<u8> {
        let mut met = 0;
        let pixels = pattern.corners();
        let rays = &self.crossing.rays;
        let mut axis = 0;
        while axis < 3 {
            if axes[axis] {
                let Some(grid) = &self.crossing.grids[axis] else { return None };
                let reference = 0.5 * f64::from(grid.voxels[2]);
                if !self.filled[axis] {
                    self.layers[axis].fill(grid, &rays.corners(&self.corners, axis, reference), reference);
                    self.filled[axis] = true;
                }
                let bundle = rays.bundle(q, rays.corners(&pixels, axis, reference), axis, reference, t);
                met |= cross::<S>(s, grid, &bundle, &self.layers[axis], sums);
            }
            axis += 1;
        }
        Some(met)
    }
}

struct Fill<'f, 'a, 'b> {
    crossing: &'f Crossing<'a>,
    block: Block<'b>,
    claims: &'f mut Claims,
    walk: &'f mut dyn FnMut(DVec2, &mut [f32]) -> Option<f64>,
}

#[cfg(target_arch = "x86_64")]
struct OnAvx512<'f, 'a, 'b>(Fill<'f, 'a, 'b>, pulp::x86::V4);

#[cfg(target_arch = "x86_64")]
impl pulp::NullaryFnOnce for OnAvx512<'_, '_, '_> {
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
        let [first, end] = cells.occupied;
        let (mut low, mut high) = ([0.5; 3], [0.5; 3]);
        let (mut grid_high, grid_low) = ([0.5; 3], [0.5; 3]);
        for axis in 0..3 {
            grid_high[axis] = crossing.seen.volume.size[axis] as f64 + 0.5;
            low[axis] = (first[axis] as f64).max(0.5);
            high[axis] = (end[axis] as f64).min(grid_high[axis]);
        }
        let first_row = v0 - v0 % BLOCK;
        let last = [bounds.to[0] as f64 - 1.0, bounds.to[1] as f64 - 1.0];
        let corners = [[u0 as f64, v0 as f64], [last[0], v0 as f64], [u0 as f64, last[1]], last];
        let mut below = Below::new(crossing, corners);
        for v in (v0..bounds.to[1] as usize).step_by(rows) {
            for u in (u0..bounds.to[0] as usize).step_by(columns) {
                let pattern = Pattern::grid([u as i32, v as i32], columns, 1);
                let mut q = [[0.0f64; 3]; LANES];
                let mut seen = [false; LANES];
                let mut l = 0;
                while l < LANES {
                    q[l] = crossing.rays.direction(pattern.u[l], pattern.v[l]);
                    seen[l] = pattern.u[l] <= last[0] && pattern.v[l] <= last[1];
                    l += 1;
                }
                let mut t = crossing.depths(low, high, &q);
                let mut axes = [false; 3];
                let mut any = false;
                for l in 0..LANES {
                    if !(seen[l] && t[1][l] > t[0][l]) {
                        t[1][l] = t[0][l];
                    } else {
                        axes[Rays::dominant(q[l])] = true;
                        any = true;
                    }
                }
                // Shapes and meshes claim their part of each ray; what is left comes in at most `rounds` pieces a ray.
                let mut rounds = usize::from(any);
                if !block.solids.is_empty() {
                    rounds = claims.claim(crossing, block.solids, [u, v], columns, &seen, &t);
                }
                let mut sums = [[0.0f32; LANES]; MOST_MATERIALS];
                let mut met = 0;
                let mut lost = false;
                for round in 0..rounds {
                    if !block.solids.is_empty() {
                        claims.gaps(round, &mut t);
                    }
                    match below.cross(s, &pattern, &q, &axes, &t, &mut sums) {
                        Some(bits) => met |= bits,
                        None => lost = true,
                    }
                }
                let missing = if crossing.seen.volume.truncated_at_faces {
                    crossing.left_through_faces(grid_low, grid_high, &q, &seen)
                } else {
                    [0.0; LANES]
                };
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
                    let mm_per_depth = prepared.view.intrinsics.unproject(DVec2::new(x as f64, y as f64)).length();
                    if !block.solids.is_empty() {
                        claims.write(l, mm_per_depth, out);
                    }
                    // ∫ρ dc: a ray is `mm_per_depth` / |q_c| mm long in c, and there are 10 mm in a cm.
                    let scale = 0.1 * mm_per_depth / q[l][Rays::dominant(q[l])].abs();
                    for (m, sums) in sums.iter().enumerate().take(cells.materials.len()) {
                        out[cells.materials[m]] += sums[l] * scale as f32;
                    }
                    if met & CUT_BIT != 0 {
                        let cut = if block.solids.is_empty() {
                            crossing.meets_cut(&q[l], (t[0][l], t[1][l]))
                        } else {
                            claims.gaps[l].iter().any(|gap| crossing.meets_cut(&q[l], *gap))
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

impl Crossing<'_> {
    /// Depth outside the grid of rays that enter or leave it through matter.
    #[inline(always)]
    fn left_through_faces(&self, low: [f64; 3], high: [f64; 3], q: &[[f64; 3]; LANES], seen: &[bool; LANES]) -> [f64; LANES] {
        let t = self.depths(low, high, q);
        let mut missing = [0.0; LANES];
        for l in 0..LANES {
            let (enter, leave) = (t[0][l], t[1][l]);
            if !(seen[l] && leave > enter) {
                continue;
            }
            if enter > 0.0 && enter < self.prepared.detector_mm && self.holds_matter(&q[l], enter) {
                missing[l] += enter;
            }
            if leave > 0.0 && leave < self.prepared.detector_mm && self.holds_matter(&q[l], leave) {
                missing[l] += self.prepared.detector_mm - leave;
            }
        }
        missing
    }

    /// Whether a ray between two depths crosses a cell in which matter borders on the unknown.
    fn meets_cut(&self, q: &[f64; 3], (from, to): (f64, f64)) -> bool {
        let axis = Rays::dominant(*q);
        let Some(grid) = &self.grids[axis] else { return true };
        let [a, b, c] = AXES[axis];
        let (p, cells) = (&self.rays.p, &self.seen.cells);
        let (low, high) = (p[c] + q[c] * from, p[c] + q[c] * to);
        let (low, high) = (low.min(high), low.max(high));
        let last = [a, b, c].map(|axis| cells.size[axis] as i64 - 1);
        let cell = |x: f64, place: usize| (x.floor() as i64).clamp(0, last[place]) as usize;
        let (first, end) = (cell(low, 2), cell(high, 2));
        let (slope_a, slope_b) = (q[a] / q[c], q[b] / q[c]);
        let across = |z: f64| (p[a] + slope_a * (z - p[c]), p[b] + slope_b * (z - p[c]));
        let is_cut = |ia: usize, ib: usize, ic: usize| {
            let mut at = [0usize; 3];
            (at[a], at[b], at[c]) = (ia, ib, ic);
            cells.kind[cells.index(at)] == CUT
        };
        let mut layer = first / BLOCK;
        while layer <= end / BLOCK {
            let (begin, stop) = ((layer * BLOCK).max(first), (layer * BLOCK + BLOCK - 1).min(end));
            let (near, far) = (across(low.max(begin as f64)), across(high.min(stop as f64 + 1.0)));
            let range = |x: f64, y: f64, place: usize| cell(x.min(y), place) / BLOCK..=cell(x.max(y), place) / BLOCK;
            let flagged = range(near.1, far.1, 1).any(|bb| {
                range(near.0, far.0, 0).any(|ba| {
                    let brick = ba * grid.brick_stride[0] + bb * grid.brick_stride[1] + layer * grid.brick_stride[2];
                    grid.bricks.get(brick).is_some_and(|bits| bits & CUT_BIT != 0)
                })
            });
            for ic in if flagged { begin..stop + 1 } else { 0..0 } {
                let ((a0, b0), (a1, b1)) = (across(low.max(ic as f64)), across(high.min(ic as f64 + 1.0)));
                let ([ia, ja], [ib, jb]) = ([cell(a0, 0), cell(a1, 0)], [cell(b0, 1), cell(b1, 1)]);
                // Between two slices a ray meets at most three cells; the middle one is behind the face that it reaches first.
                let share = |from: f64, to: f64| (from.max(to).floor() - from) / (to - from);
                let middle = || if share(a0, a1) < share(b0, b1) { (ja, ib) } else { (ia, jb) };
                let bends = ia != ja && ib != jb;
                if is_cut(ia, ib, ic) || is_cut(ja, jb, ic) || (bends && is_cut(middle().0, middle().1, ic)) {
                    return true;
                }
            }
            layer += 1;
        }
        false
    }

    #[inline(always)]
    fn holds_matter(&self, q: &[f64; 3], t: f64) -> bool {
        let cells = &self.seen.cells;
        let mut cell = [0usize; 3];
        for axis in 0..3 {
            cell[axis] = ((self.rays.p[axis] + q[axis] * t) as i64).clamp(0, cells.size[axis] as i64 - 1) as usize;
        }
        !matches!(cells.kind[cells.index(cell)], EMPTY | EMPTY_BRICK)
    }
}

impl Claims {
    /// Integrates shapes and meshes along the rays of a bundle and keeps the gaps that they leave; returns the most gaps of a ray.
    fn claim(
        &mut self,
        crossing: &Crossing,
        solids: &[Step],
        [u, v]: [usize; 2],
        columns: usize,
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
            let at = DVec2::new((u + l % columns) as f64, (v + l / columns) as f64);
            let direction = crossing.prepared.view.intrinsics.unproject(at);
            self.covered.clear();
            claim_solids(crossing.prepared, &self.trees, solids, direction, &mut self.covered, &mut self.own, &mut self.sums[l]);
            let gaps = &mut self.gaps[l];
            if t[1][l] > t[0][l] {
                self.covered.for_each_gap(t[0][l], t[1][l], |from, to| gaps.push((from, to)));
            }
            rounds = rounds.max(gaps.len());
        }
        rounds
    }

    /// The depths of each ray's gap number `round`; an empty one where there is none.
    fn gaps(&self, round: usize, t: &mut [[f64; LANES]; 2]) {
        for (l, gaps) in self.gaps.iter().enumerate() {
            (t[0][l], t[1][l]) = gaps.get(round).copied().unwrap_or((0.0, 0.0));
        }
    }

    /// g/cm² of the shapes and meshes along ray `l`.
    fn write(&self, l: usize, mm_per_depth: f64, out: &mut [f32]) {
        for (out, sum) in out.iter_mut().zip(&self.sums[l]) {
            *out = (0.1 * mm_per_depth * sum) as f32;
        }
    }
}

/// A ray in cell coordinates.
#[must_use]
pub fn cell_ray(seen: &SeenVolume, direction: DVec3) -> CellRay {
    CellRay { p: seen.cell_from_camera.translation, q: seen.cell_from_camera.matrix3 * direction }
}
