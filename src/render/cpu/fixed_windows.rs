//! Where the 16-bit values around a bundle of thirty-two rays come from, slab by slab.

use super::fixed_lanes::{FixedLanes, WORDS};
use crate::render::words::Words;

/// Words of one slice of voxels, near a bundle.
pub trait FixedWindow<S: FixedLanes>: Copy {
    /// Columns and rows that it holds.
    const SIZE: [i32; 2];
    /// Index step from row to row.
    const STRIDE: i32;
    /// Opens slices `c` and `c` + 1 from column `a` and row `b` on.
    fn open(s: S, words: Words, a: i32, b: i32, c: i32) -> [Self; 2];
    /// Words at indices made with [`FixedWindow::STRIDE`].
    fn fetch(self, s: S, words: Words, i: S::W) -> S::W;
}

/// Eight columns, four rows.
#[derive(Clone, Copy)]
pub struct Small<S: FixedLanes>(S::W);

impl<S: FixedLanes> FixedWindow<S> for Small<S> {
    const SIZE: [i32; 2] = [8, 4];
    const STRIDE: i32 = 8;
    #[inline(always)]
    fn open(s: S, words: Words, a: i32, b: i32, c: i32) -> [Self; 2] {
        let line = words.line(a, b, c);
        [Self(four_rows(s, words, line, a)), Self(four_rows(s, words, line + 1, a))]
    }
    #[inline(always)]
    fn fetch(self, s: S, _: Words, i: S::W) -> S::W {
        s.look_32(self.0, i)
    }
}

/// Sixteen columns, four rows.
#[derive(Clone, Copy)]
pub struct Wide<S: FixedLanes>([S::W; 2]);

impl<S: FixedLanes> FixedWindow<S> for Wide<S> {
    const SIZE: [i32; 2] = [16, 4];
    const STRIDE: i32 = 16;
    #[inline(always)]
    fn open(s: S, words: Words, a: i32, b: i32, c: i32) -> [Self; 2] {
        let (line, two) = (words.line(a, b, c), 2 * words.row_step);
        [
            Self([two_rows(s, words, line, a), two_rows(s, words, line + two, a)]),
            Self([two_rows(s, words, line + 1, a), two_rows(s, words, line + 1 + two, a)]),
        ]
    }
    #[inline(always)]
    fn fetch(self, s: S, _: Words, i: S::W) -> S::W {
        s.look_64(self.0, i)
    }
}

/// Eight columns, eight rows.
#[derive(Clone, Copy)]
pub struct Square<S: FixedLanes>([S::W; 2]);

impl<S: FixedLanes> FixedWindow<S> for Square<S> {
    const SIZE: [i32; 2] = [8, 8];
    const STRIDE: i32 = 8;
    #[inline(always)]
    fn open(s: S, words: Words, a: i32, b: i32, c: i32) -> [Self; 2] {
        let (line, four) = (words.line(a, b, c), 4 * words.row_step);
        [
            Self([four_rows(s, words, line, a), four_rows(s, words, line + four, a)]),
            Self([four_rows(s, words, line + 1, a), four_rows(s, words, line + 1 + four, a)]),
        ]
    }
    #[inline(always)]
    fn fetch(self, s: S, _: Words, i: S::W) -> S::W {
        s.look_64(self.0, i)
    }
}

/// Rows of [`Broad`].
pub const BROAD_ROWS: i32 = 8;

/// Sixteen columns, eight rows.
#[derive(Clone, Copy)]
pub struct Broad<S: FixedLanes>([S::W; 4]);

impl<S: FixedLanes> FixedWindow<S> for Broad<S> {
    const SIZE: [i32; 2] = [16, BROAD_ROWS];
    const STRIDE: i32 = 16;
    #[inline(always)]
    fn open(s: S, words: Words, a: i32, b: i32, c: i32) -> [Self; 2] {
        let (line, two) = (words.line(a, b, c), 2 * words.row_step);
        [Self(eight_rows(s, words, line, two, a)), Self(eight_rows(s, words, line + 1, two, a))]
    }
    #[inline(always)]
    fn fetch(self, s: S, _: Words, i: S::W) -> S::W {
        s.look_128(self.0, i)
    }
}

/// Up to 256 columns and rows, word by word.
#[derive(Clone, Copy)]
pub struct Memory([i32; 3]);

impl<S: FixedLanes> FixedWindow<S> for Memory {
    const SIZE: [i32; 2] = [0, 0];
    const STRIDE: i32 = 256;
    #[inline(always)]
    fn open(_: S, _: Words, a: i32, b: i32, c: i32) -> [Self; 2] {
        [Self([a, b, c]), Self([a, b, c + 1])]
    }
    #[inline(always)]
    fn fetch(self, s: S, words: Words, i: S::W) -> S::W {
        let [a, b, c] = self.0;
        let at = s.to_words(i);
        let mut out = [0u16; WORDS];
        let mut l = 0;
        while l < WORDS {
            let (a, b) = (a + i32::from(at[l] & 255), b + i32::from(at[l] >> 8));
            let [word] = words.row(words.line(a, b, c), a);
            out[l] = *word;
            l += 1;
        }
        s.words(&out)
    }
}

#[inline(always)]
fn four_rows<S: FixedLanes>(s: S, words: Words, line: usize, a: i32) -> S::W {
    let step = words.row_step;
    s.words_of_8([words.row(line, a), words.row(line + step, a), words.row(line + 2 * step, a), words.row(line + 3 * step, a)])
}

#[inline(always)]
fn two_rows<S: FixedLanes>(s: S, words: Words, line: usize, a: i32) -> S::W {
    s.words_of_16([words.row(line, a), words.row(line + words.row_step, a)])
}

#[inline(always)]
fn eight_rows<S: FixedLanes>(s: S, words: Words, line: usize, two: usize, a: i32) -> [S::W; 4] {
    [
        two_rows(s, words, line, a),
        two_rows(s, words, line + two, a),
        two_rows(s, words, line + 2 * two, a),
        two_rows(s, words, line + 3 * two, a),
    ]
}
