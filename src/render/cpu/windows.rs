//! Where the values around a bundle of rays come from, slab by slab: a few rows in registers, or memory.

use super::lanes::{LANES, Lanes};
use crate::render::slabs::SlabGrid;

/// Values of one slice of voxels, near a bundle.
pub trait Window<S: Lanes>: Copy {
    /// Columns and rows that it holds; 0 when it holds all.
    const SIZE: [i32; 2];
    /// Opens slice `c` from column `a` and row `b` on.
    fn open(s: S, grid: &SlabGrid, a: i32, b: i32, c: i32) -> Self;
    /// Values at indices made with [`Window::STRIDE`].
    fn fetch(self, s: S, grid: &SlabGrid, i: S::I) -> S::F;
    /// Index step from row to row.
    const STRIDE: i32;
}

/// Eight columns, four rows: one permutation a fetch.
#[derive(Clone, Copy)]
pub struct Small<S: Lanes>(S::Table);

impl<S: Lanes> Window<S> for Small<S> {
    const SIZE: [i32; 2] = [8, 4];
    const STRIDE: i32 = 8;
    #[inline(always)]
    fn open(s: S, grid: &SlabGrid, a: i32, b: i32, c: i32) -> Self {
        Self(four_rows(s, grid, a, b, c))
    }
    #[inline(always)]
    fn fetch(self, s: S, _: &SlabGrid, i: S::I) -> S::F {
        s.lookup(self.0, i)
    }
}

/// Eight columns, eight rows.
#[derive(Clone, Copy)]
pub struct Square<S: Lanes>(S::Table, S::Table);

impl<S: Lanes> Window<S> for Square<S> {
    const SIZE: [i32; 2] = [8, 8];
    const STRIDE: i32 = 8;
    #[inline(always)]
    fn open(s: S, grid: &SlabGrid, a: i32, b: i32, c: i32) -> Self {
        Self(four_rows(s, grid, a, b, c), four_rows(s, grid, a, b + 4, c))
    }
    #[inline(always)]
    fn fetch(self, s: S, _: &SlabGrid, i: S::I) -> S::F {
        s.lookup_64(self.0, self.1, i)
    }
}

/// Sixteen columns, four rows.
#[derive(Clone, Copy)]
pub struct Wide<S: Lanes>(S::Table, S::Table);

impl<S: Lanes> Window<S> for Wide<S> {
    const SIZE: [i32; 2] = [16, 4];
    const STRIDE: i32 = 16;
    #[inline(always)]
    fn open(s: S, grid: &SlabGrid, a: i32, b: i32, c: i32) -> Self {
        Self(two_rows(s, grid, a, b, c), two_rows(s, grid, a, b + 2, c))
    }
    #[inline(always)]
    fn fetch(self, s: S, _: &SlabGrid, i: S::I) -> S::F {
        s.lookup_64(self.0, self.1, i)
    }
}

/// Rows of [`Broad`].
pub const BROAD_ROWS: i32 = 6;

/// Sixteen columns, six rows.
#[derive(Clone, Copy)]
pub struct Broad<S: Lanes>(S::Table, S::Table, S::Table);

impl<S: Lanes> Window<S> for Broad<S> {
    const SIZE: [i32; 2] = [16, BROAD_ROWS];
    const STRIDE: i32 = 16;
    #[inline(always)]
    fn open(s: S, grid: &SlabGrid, a: i32, b: i32, c: i32) -> Self {
        Self(two_rows(s, grid, a, b, c), two_rows(s, grid, a, b + 2, c), two_rows(s, grid, a, b + 4, c))
    }
    #[inline(always)]
    fn fetch(self, s: S, _: &SlabGrid, i: S::I) -> S::F {
        s.lookup_96([self.0, self.1, self.2], i)
    }
}

/// The whole slice, value by value.
#[derive(Clone, Copy)]
pub struct Memory(usize);

impl<S: Lanes> Window<S> for Memory {
    const SIZE: [i32; 2] = [0, 0];
    // Column in the low, row in the high bits: whatever the grid's strides are.
    const STRIDE: i32 = 4096;
    #[inline(always)]
    fn open(_: S, grid: &SlabGrid, _: i32, _: i32, c: i32) -> Self {
        Self(grid.at(0, 0, c))
    }
    #[inline(always)]
    fn fetch(self, s: S, grid: &SlabGrid, i: S::I) -> S::F {
        let at = s.indices(i);
        let mut out = [0.0; LANES];
        let mut l = 0;
        while l < LANES {
            let (row, column) = ((at[l] as u32 >> 12) as usize, (at[l] & 4095) as usize);
            if let Some(value) = grid.values.get(self.0 + row * grid.stride_b + column) {
                out[l] = *value;
            }
            l += 1;
        }
        s.load(&out)
    }
}

#[inline(always)]
fn four_rows<S: Lanes>(s: S, grid: &SlabGrid, a: i32, b: i32, c: i32) -> S::Table {
    let at = grid.at(a, b, c);
    let (r0, r1) = (grid.row::<8>(at), grid.row::<8>(at + grid.stride_b));
    s.rows_of_8([r0, r1, grid.row::<8>(at + 2 * grid.stride_b), grid.row::<8>(at + 3 * grid.stride_b)])
}

#[inline(always)]
fn two_rows<S: Lanes>(s: S, grid: &SlabGrid, a: i32, b: i32, c: i32) -> S::Table {
    let at = grid.at(a, b, c);
    s.rows_of_16([grid.row::<16>(at), grid.row::<16>(at + grid.stride_b)])
}
