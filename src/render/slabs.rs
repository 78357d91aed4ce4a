//! A volume laid out for crossing it slab by slab along one of its axes: a copy per axis, made when a view first needs it.

use std::sync::OnceLock;

use rayon::prelude::*;

pub use super::cells::AXES;
use super::cells::{BRICK, CUT, Cells, EMPTY, EMPTY_BRICK, MIXED, voxel_pair};
use super::words::{self, Line, WORD_OF_DENSEST, Words};
use crate::scene::model::Volume;

/// Bit of a brick in which matter borders on voxels of which nothing is known.
pub const CUT_BIT: u8 = 0x80;

/// Bits of a brick in which a material of the volume occurs: bit m for `Cells::materials[m]`.
pub const MATERIAL_BITS: u8 = (1 << MOST_MATERIALS) - 1;

/// Where the bits of a brick hold the number of the one value that it is filled with, in `SlabGrid::fillings`; 0 where it varies.
pub const FILLING_SHIFT: u32 = 8;

/// More materials than this in one volume are left to the cell walker.
pub const MOST_MATERIALS: usize = 4;

/// More voxels than this are left to the cell walker: a copy per axis would take too much memory.
pub const MOST_VOXELS: usize = 1 << 28;

/// More voxels times materials than this are not rounded, for the same reason.
pub const MOST_ROUNDED: usize = 1 << 27;

/// Copies of a volume, one per axis that was asked for.
#[derive(Debug)]
pub struct Slabs {
    voxels: [usize; 3],
    class_bits: u32,
    bricks: Vec<u16>,
    fillings: Vec<f32>,
    brick_count: [usize; 3],
    copies: [OnceLock<Vec<f32>>; 3],
    /// By material.
    rounded: [OnceLock<Vec<Vec<Line>>>; 3],
    /// Density of each material's densest voxel, g/cm³; NaN when any is.
    densest: [f32; MOST_MATERIALS],
}

/// One copy. Indices are those of cells (voxel + 1): the first and last voxels are repeated, so that the outer half voxels are cells
/// like all others.
#[derive(Clone, Copy, Debug)]
pub struct SlabGrid<'a> {
    /// Padded length along a, b, c.
    pub size: [i32; 3],
    /// Voxels along a, b, c.
    pub voxels: [i32; 3],
    /// Step from row to row.
    pub stride_b: usize,
    /// Step from slice to slice.
    pub stride_c: usize,
    /// Densities in g/cm³; the low `class_bits` hold the index of the material in `Cells::materials`, plus one.
    pub values: &'a [f32],
    /// Mask of those bits; 0 when there is one material.
    pub class_bits: u32,
    /// Per brick of 8³ cells: `MATERIAL_BITS` of what occurs, `CUT_BIT` where the unknown begins, `FILLING_SHIFT`.
    pub bricks: &'a [u16],
    /// Densities in g/cm³ that fill whole bricks, from number 1 on.
    pub fillings: &'a [f32],
    /// Step between bricks along a, b, c.
    pub brick_stride: [usize; 3],
    /// Densities in 16 bits, by material; only in a [`Slabs::rounded_grid`].
    pub words: [Words<'a>; MOST_MATERIALS],
    /// What a word of each stands for, g/cm³.
    pub word_g_per_cm3: [f32; MOST_MATERIALS],
}

/// Bits of the materials at a cell's corners.
fn materials_of(volume: &Volume, cells: &Cells, cell: [usize; 3]) -> u8 {
    let [(i, di), (j, dj), (k, dk)] = std::array::from_fn(|axis| voxel_pair(cell[axis], volume.size[axis]));
    (0..8).fold(0, |bits, corner: usize| {
        let voxel = volume.index(i + di * (corner & 1), j + dj * (corner >> 1 & 1), k + dk * (corner >> 2));
        match volume.class[voxel] {
            0 => bits,
            class => bits | 1 << cells.material_of_class[usize::from(class) - 1],
        }
    })
}

/// Numbers the densities of bricks that hold one material of one density throughout; returns the densities.
fn number_fillings(volume: &Volume, bricks: &mut [u16], [bi, bj, _]: [usize; 3]) -> Vec<f32> {
    let filling = |(index, bits): (usize, &u16)| {
        if *bits == 0 || bits & !u16::from(MATERIAL_BITS) != 0 || !bits.is_power_of_two() {
            return None;
        }
        let brick = [index % bi, index / bi % bj, index / (bi * bj)];
        // Cell n lies between voxels n − 1 and n.
        let [from, to] = [brick.map(|n| (n * BRICK).saturating_sub(1)), brick.map(|n| n * BRICK + BRICK)];
        let to: [usize; 3] = std::array::from_fn(|axis| to[axis].min(volume.size[axis]));
        let first = volume.index(from[0], from[1], from[2]);
        let (class, density) = (volume.class[first], volume.density_g_per_cm3[first]);
        for k in from[2]..to[2] {
            for j in from[1]..to[1] {
                let row = volume.index(from[0], j, k)..volume.index(to[0] - 1, j, k) + 1;
                let steady = volume.class[row.clone()].iter().all(|other| *other == class)
                    && volume.density_g_per_cm3[row].iter().all(|other| *other == density);
                if !steady {
                    return None;
                }
            }
        }
        Some(density)
    };
    let found: Vec<Option<f32>> = bricks.par_iter().enumerate().map(filling).collect();
    let mut fillings: Vec<f32> = Vec::new();
    for (bits, density) in bricks.iter_mut().zip(found) {
        let Some(density) = density else { continue };
        let number = fillings.iter().position(|known| *known == density).unwrap_or_else(|| {
            fillings.push(density);
            fillings.len() - 1
        });
        // What has no number is integrated like everything else.
        if number < usize::from(u8::MAX) {
            *bits |= (number as u16 + 1) << FILLING_SHIFT;
        } else {
            fillings.pop();
        }
    }
    fillings
}

/// Density of each material's densest voxel, g/cm³; NaN when any is.
fn densest(volume: &Volume, cells: &Cells) -> [f32; MOST_MATERIALS] {
    // NaN stays.
    let larger = |most: f32, other: f32| if other > most || other.is_nan() { other } else { most };
    let voxels = volume.class.par_chunks(1 << 16).zip(volume.density_g_per_cm3.par_chunks(1 << 16));
    let of_part = |(classes, densities): (&[u8], &[f32])| {
        let mut densest = [0.0f32; MOST_MATERIALS];
        for (class, density) in classes.iter().zip(densities).filter(|(class, _)| **class > 0) {
            let most = &mut densest[usize::from(cells.material_of_class[usize::from(*class) - 1])];
            *most = larger(*most, *density);
        }
        densest
    };
    let both = |x: [f32; MOST_MATERIALS], y: [f32; MOST_MATERIALS]| std::array::from_fn(|m| larger(x[m], y[m]));
    voxels.map(of_part).reduce(Default::default, both)
}

impl Slabs {
    /// `None` when the volume is not for this method: too many materials, or voxels.
    #[must_use]
    pub fn new(volume: &Volume, cells: &Cells) -> Option<Self> {
        let materials = cells.materials.len();
        if materials > MOST_MATERIALS
            || volume.size.iter().product::<usize>() > MOST_VOXELS
            || volume.size.iter().any(|n| *n > 4000)
        {
            return None;
        }
        let brick_count = cells.size.map(|n| n.div_ceil(BRICK));
        let mut bricks = vec![0u16; brick_count.iter().product()];
        let [bi, bj, _] = brick_count;
        bricks.par_chunks_mut(bi * bj).enumerate().for_each(|(bk, layer)| {
            for k in bk * BRICK..((bk + 1) * BRICK).min(cells.size[2]) {
                for j in 0..cells.size[1] {
                    let row = &cells.kind[cells.index([0, j, k])..][..cells.size[0]];
                    for (i, (kinds, brick)) in row.chunks(BRICK).zip(&mut layer[j / BRICK * bi..]).enumerate() {
                        for (kind, i) in kinds.iter().zip(i * BRICK..) {
                            *brick |= u16::from(match *kind {
                                EMPTY | EMPTY_BRICK => 0,
                                CUT => CUT_BIT | materials_of(volume, cells, [i, j, k]),
                                MIXED => materials_of(volume, cells, [i, j, k]),
                                // `materials` ≤ `MOST_MATERIALS`.
                                single => 1 << (single - 1),
                            });
                        }
                    }
                }
            }
        });
        let class_bits = match materials {
            0 | 1 => 0,
            2 | 3 => 3,
            _ => 7,
        };
        let fillings = number_fillings(volume, &mut bricks, brick_count);
        let densest = densest(volume, cells);
        let (copies, rounded) = Default::default();
        Some(Self { voxels: volume.size, class_bits, bricks, fillings, brick_count, copies, rounded, densest })
    }

    /// Whether the brick around a cell is filled with one density.
    #[must_use]
    pub fn is_filled(&self, cell: [usize; 3]) -> bool {
        let [i, j, k] = cell.map(|n| n / BRICK);
        let [bi, bj, _] = self.brick_count;
        self.bricks.get(i + bi * (j + bj * k)).is_some_and(|bits| bits >> FILLING_SHIFT != 0)
    }

    /// Makes the copy for slabs across `axis`, on all cores, unless it is there.
    pub fn prepare(&self, axis: usize, volume: &Volume, cells: &Cells) {
        self.copies[axis].get_or_init(|| {
            let [a, b, c] = AXES[axis];
            let stride = [1, volume.size[0], volume.size[0] * volume.size[1]];
            let size = self.padded(axis);
            let mut values = vec![0.0f32; size.iter().product()];
            let voxel = |cell: usize, axis: usize| cell.saturating_sub(1).min(volume.size[axis] - 1);
            // The class takes the lowest bits; rounding the density to what is left keeps it unbiased.
            let pack = |index: usize| {
                let density = volume.density_g_per_cm3[index];
                let class = volume.class[index];
                if density.is_nan() {
                    return density;
                }
                if class == 0 || !(density > 0.0) {
                    return 0.0;
                }
                let bits = self.class_bits;
                let rounded = density.to_bits().wrapping_add(bits.div_ceil(2)) & !bits;
                f32::from_bits(rounded | (u32::from(cells.material_of_class[usize::from(class) - 1] + 1) & bits))
            };
            values.par_chunks_mut(size[0] * size[1]).enumerate().for_each(|(layer, slice)| {
                for (row, values) in slice.chunks_exact_mut(size[0]).enumerate() {
                    let base = voxel(row, b) * stride[b] + voxel(layer, c) * stride[c];
                    for (column, value) in values.iter_mut().enumerate() {
                        *value = pack(base + voxel(column, a) * stride[a]);
                    }
                }
            });
            values
        });
    }

    /// Makes the copies in 16 bits for slabs across `axis`, on all cores, unless they are there or cannot be; see [`Slabs::rounds`].
    pub fn round(&self, axis: usize, volume: &Volume, cells: &Cells) {
        if self.rounds() {
            self.rounded[axis].get_or_init(|| {
                let round = |material| words::round(volume, cells, material, self.densest[material], axis, self.padded(axis));
                (0..cells.materials.len()).map(round).collect()
            });
        }
    }

    /// Whether the volume can be rounded: its densities are finite, and the copies do not take too much memory.
    #[must_use]
    pub fn rounds(&self) -> bool {
        let materials = self.densest.iter().filter(|densest| **densest > 0.0).count();
        self.densest.iter().all(|densest| densest.is_finite())
            && self.voxels.iter().product::<usize>() * materials <= MOST_ROUNDED
    }

    /// g/cm³ of each material by which a word differs from the next.
    #[must_use]
    pub fn word_g_per_cm3(&self) -> [f32; MOST_MATERIALS] {
        self.densest.map(|densest| densest / f32::from(WORD_OF_DENSEST))
    }

    /// Copies that were made, rounded or not.
    #[must_use]
    pub fn copies_made(&self) -> usize {
        let rounded = self.rounded.iter().filter(|copy| copy.get().is_some()).count();
        rounded + self.copies.iter().filter(|copy| copy.get().is_some()).count()
    }

    /// The copy for slabs across `axis`, once [`Slabs::prepare`] made it.
    #[must_use]
    pub fn grid(&self, axis: usize) -> Option<SlabGrid<'_>> {
        Some(self.laid_out(axis, self.copies[axis].get()?, [Words::default(); MOST_MATERIALS]))
    }

    /// The copies in 16 bits for slabs across `axis`, once [`Slabs::round`] made them; without [`SlabGrid::values`].
    #[must_use]
    pub fn rounded_grid(&self, axis: usize) -> Option<SlabGrid<'_>> {
        let copies = self.rounded[axis].get()?;
        let words = std::array::from_fn(|material| match copies.get(material) {
            Some(lines) => Words::new(lines, self.padded(axis)),
            None => Words::default(),
        });
        Some(self.laid_out(axis, &[], words))
    }

    fn laid_out<'a>(&'a self, axis: usize, values: &'a [f32], words: [Words<'a>; MOST_MATERIALS]) -> SlabGrid<'a> {
        let size = self.padded(axis);
        let brick_stride = [1, self.brick_count[0], self.brick_count[0] * self.brick_count[1]];
        SlabGrid {
            size: size.map(|n| n as i32),
            voxels: AXES[axis].map(|axis| self.voxels[axis] as i32),
            stride_b: size[0],
            stride_c: size[0] * size[1],
            values,
            class_bits: self.class_bits,
            bricks: &self.bricks,
            fillings: &self.fillings,
            brick_stride: AXES[axis].map(|axis| brick_stride[axis]),
            words,
            word_g_per_cm3: self.word_g_per_cm3(),
        }
    }

    /// Length along a, b, c: one voxel more at either end, and at least the largest window.
    fn padded(&self, axis: usize) -> [usize; 3] {
        let [a, b, c] = AXES[axis].map(|axis| self.voxels[axis] + 2);
        [a.max(16), b.max(8), c]
    }
}

impl SlabGrid<'_> {
    /// Index of a value.
    #[inline(always)]
    #[must_use]
    pub fn at(&self, a: i32, b: i32, c: i32) -> usize {
        (a as usize).wrapping_add((b as usize).wrapping_mul(self.stride_b)).wrapping_add((c as usize).wrapping_mul(self.stride_c))
    }

    /// Density in g/cm³ of filling number `number`; NaN where there is none.
    #[inline(always)]
    #[must_use]
    pub fn filling(&self, number: usize) -> f32 {
        match self.fillings.get(number.wrapping_sub(1)) {
            Some(density) => *density,
            None => f32::NAN,
        }
    }

    /// N neighbours along a; zeros outside.
    #[inline(always)]
    #[must_use]
    pub fn row<const N: usize>(&self, at: usize) -> &[f32; N] {
        match self.values.get(at..at.wrapping_add(N)) {
            Some(row) => match row.try_into() {
                Ok(row) => row,
                Err(_) => &[0.0; N],
            },
            None => &[0.0; N],
        }
    }
}
