//! Densities in 16 bits, laid out for rays that are crossed in fixed point.

use rayon::prelude::*;

use super::cells::{AXES, Cells};
use crate::scene::model::Volume;

/// One material's densities as words, 0 where there is another: [`WORD_OF_DENSEST`] is its densest voxel.
///
/// In columns of 32 voxels along a that begin every sixteen: any sixteen neighbours lie in one cache line, and so do, slice by slice,
/// the next ones in its neighbours.
#[derive(Clone, Copy, Debug, Default)]
pub struct Words<'a> {
    /// By column, then by row, then by slice.
    lines: &'a [Line],
    /// Step from row to row.
    pub row_step: usize,
    column_step: usize,
}

/// Neighbours along a in one slice: a cache line.
#[derive(Clone, Copy, Debug)]
#[repr(align(64))]
pub struct Line([u16; COLUMN]);

/// Voxels of a column along a.
const COLUMN: usize = 32;

/// Voxels from column to column.
const COLUMN_STEP: usize = 16;

/// The word of a material's densest voxel: room is left for rounding below 2¹⁵.
pub const WORD_OF_DENSEST: u16 = 32_000;

impl<'a> Words<'a> {
    /// Lines that [`round`] made for a grid of such a size.
    #[must_use]
    pub fn new(lines: &'a [Line], size: [usize; 3]) -> Self {
        let row_step = row_step(size);
        Self { lines, row_step, column_step: size[1] * row_step }
    }
}

impl Words<'_> {
    /// Index of the line that sixteen neighbours from a on lie in.
    #[inline(always)]
    #[must_use]
    pub fn line(&self, a: i32, b: i32, c: i32) -> usize {
        let (a, b) = (a as u32 as usize / COLUMN_STEP, b as u32 as usize);
        a.wrapping_mul(self.column_step).wrapping_add(b.wrapping_mul(self.row_step)).wrapping_add(c as u32 as usize)
    }

    /// N neighbours, at most sixteen, from a on in a line; zeros outside.
    #[inline(always)]
    #[must_use]
    pub fn row<const N: usize>(&self, line: usize, a: i32) -> &[u16; N] {
        const NONE: &Line = &Line([0; COLUMN]);
        let line = match self.lines.get(line) {
            Some(line) => line,
            None => NONE,
        };
        let begin = a as u32 as usize % COLUMN_STEP;
        match line.0[begin..begin + N].try_into() {
            Ok(row) => row,
            Err(_) => &[0; N],
        }
    }
}

/// An odd number of slices, so that rows do not compete for the same part of a cache.
fn row_step(size: [usize; 3]) -> usize {
    size[2] | 1
}

/// The words of one material of `volume` whose densest voxel holds `densest` g/cm³, for slabs across `axis`, on all cores. Voxels are
/// repeated at the ends as in `SlabGrid`, whose padded size along a, b, c is `size`.
#[must_use]
pub fn round(volume: &Volume, cells: &Cells, material: usize, densest: f32, axis: usize, size: [usize; 3]) -> Vec<Line> {
    let [a, b, c] = AXES[axis];
    let stride = [1, volume.size[0], volume.size[0] * volume.size[1]];
    let voxel = |cell: usize, axis: usize| cell.saturating_sub(1).min(volume.size[axis] - 1);
    let scale = f32::from(WORD_OF_DENSEST) / densest.max(f32::MIN_POSITIVE);
    let word_at = |index: usize| match volume.class[index] {
        0 => 0,
        class if usize::from(cells.material_of_class[usize::from(class) - 1]) != material => 0,
        _ => (volume.density_g_per_cm3[index].max(0.0) * scale + 0.5) as i32 as u16,
    };
    let row = row_step(size);
    let mut lines = vec![Line([0; COLUMN]); size[0].div_ceil(COLUMN_STEP) * size[1] * row];
    lines.par_chunks_mut(size[1] * row).enumerate().for_each(|(column, lines)| {
        let across = COLUMN.min(size[0] - column * COLUMN_STEP);
        let along_a: Vec<usize> = (0..across).map(|i| voxel(column * COLUMN_STEP + i, a) * stride[a]).collect();
        for (j, lines) in lines.chunks_exact_mut(row).enumerate() {
            let base = voxel(j, b) * stride[b];
            // Voxels are read in the order in which they lie in memory.
            if stride[a] < stride[c] {
                for (k, line) in lines.iter_mut().enumerate().take(size[2]) {
                    let base = base + voxel(k, c) * stride[c];
                    line.0.iter_mut().zip(&along_a).for_each(|(word, at)| *word = word_at(base + at));
                }
            } else {
                for (i, at) in along_a.iter().enumerate() {
                    for (k, line) in lines.iter_mut().enumerate().take(size[2]) {
                        line.0[i] = word_at(base + at + voxel(k, c) * stride[c]);
                    }
                }
            }
        }
    });
    lines
}
