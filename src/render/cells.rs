//! What each cell of a volume holds, prepared once: a cell lies between 2×2×2 neighbouring voxel centres, the outer half voxel is
//! a cell whose two sides are the same voxel.

use std::sync::OnceLock;

use glam::DVec3;
use rayon::prelude::*;

use super::face_sums::CutFace;
use super::steep::steep_bricks;
use crate::scene::model::Volume;

/// The cell holds nothing.
pub const EMPTY: u8 = 0;
/// Several materials meet.
pub const MIXED: u8 = 251;
/// Matter borders on voxels of which nothing is known.
pub const CUT: u8 = 252;
/// The whole brick of `BRICK`³ cells holds nothing.
pub const EMPTY_BRICK: u8 = 253;
/// Cells along the edge of a brick.
pub const BRICK: usize = 8;
/// Axes (a, b, c) for each axis c across the slabs; a is contiguous.
pub const AXES: [[usize; 3]; 3] = [[1, 2, 0], [0, 2, 1], [0, 1, 2]];

/// Kinds of the (n+1)³ cells. Cell (i, j, k) spans `cell` coordinates [i, i+1]; `cell` = `voxel` + 1; matter lies in [½, n + ½].
#[derive(Clone, Debug)]
pub struct Cells {
    /// Cells along each axis: voxels + 1.
    pub size: [usize; 3],
    /// `EMPTY`, 1 + index into `materials` where the cell holds one, `MIXED`, `CUT` or `EMPTY_BRICK`; i fastest.
    pub kind: Vec<u8>,
    /// Scene materials that occur.
    pub materials: Vec<usize>,
    /// Index into `materials` per class − 1.
    pub material_of_class: Vec<u8>,
    /// First and one past the last cell that holds anything; equal when all is empty.
    pub occupied: [[usize; 3]; 2],
    steep: OnceLock<Vec<DVec3>>,
    faces: OnceLock<Vec<CutFace>>,
}

impl Cells {
    /// Classifies every cell; `None` when more than 250 materials occur in one volume. `air`: which material is air that is kept; where
    /// only air borders on the unknown, nothing is cut off.
    #[must_use]
    pub fn new(volume: &Volume, air: Option<usize>) -> Option<Self> {
        let mut materials = Vec::new();
        let mut material_of_class = Vec::new();
        for &material in &volume.class_materials {
            let index = materials.iter().position(|known| *known == material).unwrap_or_else(|| {
                materials.push(material);
                materials.len() - 1
            });
            material_of_class.push(u8::try_from(index).ok().filter(|index| *index < 250)?);
        }
        let air_kind = materials.iter().position(|material| Some(*material) == air).map(|index| index as u8 + 1);
        let size = volume.size.map(|n| n + 1);
        let mut kind = vec![EMPTY; size[0] * size[1] * size[2]];
        kind.par_chunks_mut(size[0] * size[1]).enumerate().for_each(|(k, slice)| {
            for j in 0..size[1] {
                for i in 0..size[0] {
                    slice[i + size[0] * j] = classify(volume, &material_of_class, air_kind, [i, j, k]);
                }
            }
        });
        let occupied = mark_empty_bricks(&mut kind, size);
        Some(Self { size, kind, materials, material_of_class, occupied, steep: OnceLock::new(), faces: OnceLock::new() })
    }

    /// Index of cell (i, j, k).
    #[must_use]
    pub fn index(&self, cell: [usize; 3]) -> usize {
        cell[0] + self.size[0] * (cell[1] + self.size[1] * cell[2])
    }

    /// Middles of the bricks of `volume`, whose cells these are, in which density jumps as metal makes it; found when first asked for.
    #[must_use]
    pub fn steep_bricks(&self, volume: &Volume) -> &[DVec3] {
        self.steep.get_or_init(|| steep_bricks(volume, BRICK))
    }

    /// The faces of the grid that hold matter other than air of `air_kind`; found when first asked for.
    #[must_use]
    pub fn cut_faces(&self, air_kind: Option<u8>) -> &[CutFace] {
        let holds_matter = |cell: [usize; 3]| {
            let kind = self.kind[self.index(cell)];
            !matches!(kind, EMPTY | EMPTY_BRICK) && Some(kind) != air_kind
        };
        self.faces.get_or_init(|| CutFace::all_of(self.size, holds_matter))
    }

    /// Share of cells that hold nothing.
    #[must_use]
    pub fn empty_share(&self) -> f64 {
        let empty = self.kind.iter().filter(|kind| matches!(**kind, EMPTY | EMPTY_BRICK)).count();
        empty as f64 / self.kind.len().max(1) as f64
    }
}

/// Lower voxel of a cell along an axis of `n` voxels, and the step to the upper one (0 in the outer half voxels).
#[inline]
#[must_use]
pub fn voxel_pair(cell: usize, n: usize) -> (usize, usize) {
    let lower = cell.saturating_sub(1);
    (lower, cell.min(n - 1) - lower)
}

fn classify(volume: &Volume, material_of_class: &[u8], air_kind: Option<u8>, cell: [usize; 3]) -> u8 {
    let [(i, di), (j, dj), (k, dk)] = std::array::from_fn(|axis| voxel_pair(cell[axis], volume.size[axis]));
    let mut found = EMPTY;
    let mut unknown = false;
    for corner in 0..8usize {
        let voxel = volume.index(i + di * (corner & 1), j + dj * (corner >> 1 & 1), k + dk * (corner >> 2));
        unknown |= volume.unknown.get(voxel).copied().unwrap_or(false);
        let class = usize::from(volume.class[voxel]);
        if class == 0 || !(volume.density_g_per_cm3[voxel] > 0.0) {
            continue;
        }
        let kind = material_of_class[class - 1] + 1;
        found = if found == EMPTY || found == kind { kind } else { MIXED };
    }
    if unknown && found != EMPTY && Some(found) != air_kind { CUT } else { found }
}

fn mark_empty_bricks(kind: &mut [u8], size: [usize; 3]) -> [[usize; 3]; 2] {
    let mut occupied = [size, [0; 3]];
    let at = |i: usize, j: usize, k: usize| i + size[0] * (j + size[1] * k);
    for bk in (0..size[2]).step_by(BRICK) {
        for bj in (0..size[1]).step_by(BRICK) {
            for bi in (0..size[0]).step_by(BRICK) {
                let end = [bi, bj, bk].iter().zip(size).map(|(b, n)| (b + BRICK).min(n)).collect::<Vec<_>>();
                let mut empty = true;
                for k in bk..end[2] {
                    for j in bj..end[1] {
                        for i in bi..end[0] {
                            if kind[at(i, j, k)] != EMPTY {
                                empty = false;
                                for (axis, cell) in [i, j, k].into_iter().enumerate() {
                                    occupied[0][axis] = occupied[0][axis].min(cell);
                                    occupied[1][axis] = occupied[1][axis].max(cell + 1);
                                }
                            }
                        }
                    }
                }
                if empty {
                    for k in bk..end[2] {
                        for j in bj..end[1] {
                            kind[at(bi, j, k)..at(end[0] - 1, j, k) + 1].fill(EMPTY_BRICK);
                        }
                    }
                }
            }
        }
    }
    if occupied[0][0] >= occupied[1][0] { [[0; 3]; 2] } else { occupied }
}
