//! Thirty-two rays side by side in 16-bit fixed point: the few operations that crossing a volume needs.
//!
//! Whole numbers only, so every kind of lanes gives the same bits. Words are unsigned unless said otherwise.

use super::lanes::{LANES, Lanes, Portable};

/// Rays that are crossed together.
pub const WORDS: usize = 2 * LANES;

/// Whether this processor has lanes for which fixed point is faster than f32.
#[must_use]
pub fn is_fast() -> bool {
    #[cfg(target_arch = "x86_64")]
    let is_fast = pulp::x86::V4::try_new().is_some();
    #[cfg(not(target_arch = "x86_64"))]
    let is_fast = false;
    is_fast
}

/// Operations on thirty-two 16-bit words.
pub trait FixedLanes: Lanes {
    /// Thirty-two words.
    type W: Copy;
    /// Thirty-two truths.
    type K: Copy;
    /// The same in all lanes.
    fn word(self, value: u16) -> Self::W;
    /// From memory.
    fn words(self, values: &[u16; WORDS]) -> Self::W;
    /// To memory.
    fn to_words(self, a: Self::W) -> [u16; WORDS];
    /// Whether any is true.
    fn k_any(self, k: Self::K) -> bool;
    /// a + b, wrapping.
    fn w_add(self, a: Self::W, b: Self::W) -> Self::W;
    /// a − b, wrapping.
    fn w_sub(self, a: Self::W, b: Self::W) -> Self::W;
    /// a − b, at least 0.
    fn w_less(self, a: Self::W, b: Self::W) -> Self::W;
    /// The smaller.
    fn w_min(self, a: Self::W, b: Self::W) -> Self::W;
    /// The larger.
    fn w_max(self, a: Self::W, b: Self::W) -> Self::W;
    /// a / 2, rounded down.
    fn w_half(self, a: Self::W) -> Self::W;
    /// a · b / 32768 of signed words, halves up.
    fn w_scale(self, a: Self::W, b: Self::W) -> Self::W;
    /// a · 2ᵇ, wrapping; b < 16.
    fn w_shift(self, a: Self::W, b: Self::W) -> Self::W;
    /// a < b.
    fn w_below(self, a: Self::W, b: Self::W) -> Self::K;
    /// Both.
    fn k_and(self, a: Self::K, b: Self::K) -> Self::K;
    /// Either.
    fn k_or(self, a: Self::K, b: Self::K) -> Self::K;
    /// `a` where true, else `b`.
    fn w_choose(self, k: Self::K, a: Self::W, b: Self::W) -> Self::W;
    /// `a` where true, else 0.
    fn w_keep(self, k: Self::K, a: Self::W) -> Self::W;
    /// The low halves of two times sixteen whole numbers, by turns.
    fn interleave(self, even: Self::I, odd: Self::I) -> Self::W;
    /// Adds even words to the first, odd words to the second sixteen sums.
    fn gather_sums(self, sums: [Self::I; 2], a: Self::W) -> [Self::I; 2];
    /// Whole numbers as `f32`.
    fn number(self, i: Self::I) -> Self::F;
    /// Four rows of eight.
    fn words_of_8(self, rows: [&[u16; 8]; 4]) -> Self::W;
    /// Two rows of sixteen.
    fn words_of_16(self, rows: [&[u16; 16]; 2]) -> Self::W;
    /// From a table of 32; higher bits of `i` are ignored here and below.
    fn look_32(self, table: Self::W, i: Self::W) -> Self::W;
    /// From a table of 64.
    fn look_64(self, table: [Self::W; 2], i: Self::W) -> Self::W;
    /// From a table of 128.
    fn look_128(self, table: [Self::W; 4], i: Self::W) -> Self::W;
}

macro_rules! lanes32 {
    ($l:ident => $value:expr) => {{
        let mut out = [Default::default(); WORDS];
        let mut $l = 0;
        while $l < WORDS {
            out[$l] = $value;
            $l += 1;
        }
        out
    }};
}

/// In plain Rust, for lanes that have nothing better. Nothing is inlined: only logs from other machines and tests come here, and the
/// compiler would take minutes.
macro_rules! portable {
    ($lanes:ty) => {
        impl FixedLanes for $lanes {
            type W = [u16; WORDS];
            type K = [bool; WORDS];
            #[inline(never)]
            fn word(self, value: u16) -> Self::W {
                [value; WORDS]
            }
            #[inline(never)]
            fn words(self, values: &[u16; WORDS]) -> Self::W {
                *values
            }
            #[inline(never)]
            fn to_words(self, a: Self::W) -> [u16; WORDS] {
                a
            }
            #[inline(never)]
            fn k_any(self, k: Self::K) -> bool {
                let mut any = false;
                let mut l = 0;
                while l < WORDS {
                    any |= k[l];
                    l += 1;
                }
                any
            }
            #[inline(never)]
            fn w_add(self, a: Self::W, b: Self::W) -> Self::W {
                lanes32!(l => a[l].wrapping_add(b[l]))
            }
            #[inline(never)]
            fn w_sub(self, a: Self::W, b: Self::W) -> Self::W {
                lanes32!(l => a[l].wrapping_sub(b[l]))
            }
            #[inline(never)]
            fn w_less(self, a: Self::W, b: Self::W) -> Self::W {
                lanes32!(l => a[l].saturating_sub(b[l]))
            }
            #[inline(never)]
            fn w_min(self, a: Self::W, b: Self::W) -> Self::W {
                lanes32!(l => if a[l] < b[l] { a[l] } else { b[l] })
            }
            #[inline(never)]
            fn w_max(self, a: Self::W, b: Self::W) -> Self::W {
                lanes32!(l => if a[l] > b[l] { a[l] } else { b[l] })
            }
            #[inline(never)]
            fn w_half(self, a: Self::W) -> Self::W {
                lanes32!(l => a[l] >> 1)
            }
            #[inline(never)]
            fn w_scale(self, a: Self::W, b: Self::W) -> Self::W {
                lanes32!(l => (((i32::from(a[l] as i16) * i32::from(b[l] as i16) >> 14) + 1) >> 1) as u16)
            }
            #[inline(never)]
            fn w_shift(self, a: Self::W, b: Self::W) -> Self::W {
                lanes32!(l => a[l] << (b[l] & 15))
            }
            #[inline(never)]
            fn w_below(self, a: Self::W, b: Self::W) -> Self::K {
                lanes32!(l => a[l] < b[l])
            }
            #[inline(never)]
            fn k_and(self, a: Self::K, b: Self::K) -> Self::K {
                lanes32!(l => a[l] & b[l])
            }
            #[inline(never)]
            fn k_or(self, a: Self::K, b: Self::K) -> Self::K {
                lanes32!(l => a[l] | b[l])
            }
            #[inline(never)]
            fn w_choose(self, k: Self::K, a: Self::W, b: Self::W) -> Self::W {
                lanes32!(l => if k[l] { a[l] } else { b[l] })
            }
            #[inline(never)]
            fn w_keep(self, k: Self::K, a: Self::W) -> Self::W {
                lanes32!(l => if k[l] { a[l] } else { 0 })
            }
            #[inline(never)]
            fn interleave(self, even: Self::I, odd: Self::I) -> Self::W {
                let (even, odd) = (self.indices(even), self.indices(odd));
                lanes32!(l => if l & 1 == 0 { even[l / 2] as u16 } else { odd[l / 2] as u16 })
            }
            #[inline(never)]
            fn gather_sums(self, sums: [Self::I; 2], a: Self::W) -> [Self::I; 2] {
                let (mut even, mut odd) = ([0i32; LANES], [0i32; LANES]);
                let mut l = 0;
                while l < LANES {
                    (even[l], odd[l]) = (i32::from(a[2 * l]), i32::from(a[2 * l + 1]));
                    l += 1;
                }
                [self.add_index(sums[0], self.load_indices(&even)), self.add_index(sums[1], self.load_indices(&odd))]
            }
            #[inline(never)]
            fn number(self, i: Self::I) -> Self::F {
                let i = self.indices(i);
                let mut out = [0.0f32; LANES];
                let mut l = 0;
                while l < LANES {
                    out[l] = i[l] as f32;
                    l += 1;
                }
                self.load(&out)
            }
            #[inline(never)]
            fn words_of_8(self, rows: [&[u16; 8]; 4]) -> Self::W {
                lanes32!(l => rows[l / 8][l % 8])
            }
            #[inline(never)]
            fn words_of_16(self, rows: [&[u16; 16]; 2]) -> Self::W {
                lanes32!(l => rows[l / 16][l % 16])
            }
            #[inline(never)]
            fn look_32(self, table: Self::W, i: Self::W) -> Self::W {
                lanes32!(l => table[usize::from(i[l] & 31)])
            }
            #[inline(never)]
            fn look_64(self, table: [Self::W; 2], i: Self::W) -> Self::W {
                lanes32!(l => table[usize::from(i[l] >> 5 & 1)][usize::from(i[l] & 31)])
            }
            #[inline(never)]
            fn look_128(self, table: [Self::W; 4], i: Self::W) -> Self::W {
                lanes32!(l => table[usize::from(i[l] >> 5 & 3)][usize::from(i[l] & 31)])
            }
        }
    };
}

portable!(Portable);
#[cfg(target_arch = "x86_64")]
portable!(pulp::x86::V3);

#[cfg(target_arch = "x86_64")]
mod avx512 {
    use core::arch::x86_64::{__m128i, __m256i, __m512, __m512i, __mmask32};

    use pulp::x86::V4;

    use super::{FixedLanes, WORDS};

    impl FixedLanes for V4 {
        type W = __m512i;
        type K = __mmask32;
        #[inline(always)]
        fn word(self, value: u16) -> __m512i {
            self.avx512f._mm512_set1_epi16(value as i16)
        }
        #[inline(always)]
        fn words(self, values: &[u16; WORDS]) -> __m512i {
            pulp::cast(*values)
        }
        #[inline(always)]
        fn to_words(self, a: __m512i) -> [u16; WORDS] {
            pulp::cast(a)
        }
        #[inline(always)]
        fn k_any(self, k: __mmask32) -> bool {
            k != 0
        }
        #[inline(always)]
        fn w_add(self, a: __m512i, b: __m512i) -> __m512i {
            self.avx512bw._mm512_add_epi16(a, b)
        }
        #[inline(always)]
        fn w_sub(self, a: __m512i, b: __m512i) -> __m512i {
            self.avx512bw._mm512_sub_epi16(a, b)
        }
        #[inline(always)]
        fn w_less(self, a: __m512i, b: __m512i) -> __m512i {
            self.avx512bw._mm512_subs_epu16(a, b)
        }
        #[inline(always)]
        fn w_min(self, a: __m512i, b: __m512i) -> __m512i {
            self.avx512bw._mm512_min_epu16(a, b)
        }
        #[inline(always)]
        fn w_max(self, a: __m512i, b: __m512i) -> __m512i {
            self.avx512bw._mm512_max_epu16(a, b)
        }
        #[inline(always)]
        fn w_half(self, a: __m512i) -> __m512i {
            self.avx512bw._mm512_srli_epi16::<1>(a)
        }
        #[inline(always)]
        fn w_scale(self, a: __m512i, b: __m512i) -> __m512i {
            self.avx512bw._mm512_mulhrs_epi16(a, b)
        }
        #[inline(always)]
        fn w_shift(self, a: __m512i, b: __m512i) -> __m512i {
            self.avx512bw._mm512_sllv_epi16(a, b)
        }
        #[inline(always)]
        fn w_below(self, a: __m512i, b: __m512i) -> __mmask32 {
            self.avx512bw._mm512_cmplt_epu16_mask(a, b)
        }
        #[inline(always)]
        fn k_and(self, a: __mmask32, b: __mmask32) -> __mmask32 {
            a & b
        }
        #[inline(always)]
        fn k_or(self, a: __mmask32, b: __mmask32) -> __mmask32 {
            a | b
        }
        #[inline(always)]
        fn w_choose(self, k: __mmask32, a: __m512i, b: __m512i) -> __m512i {
            self.avx512bw._mm512_mask_blend_epi16(k, b, a)
        }
        #[inline(always)]
        fn w_keep(self, k: __mmask32, a: __m512i) -> __m512i {
            self.avx512bw._mm512_maskz_mov_epi16(k, a)
        }
        #[inline(always)]
        fn interleave(self, even: __m512i, odd: __m512i) -> __m512i {
            let f = self.avx512f;
            self.avx512bw._mm512_mask_blend_epi16(0xAAAA_AAAA, even, f._mm512_slli_epi32::<16>(odd))
        }
        #[inline(always)]
        fn gather_sums(self, sums: [__m512i; 2], a: __m512i) -> [__m512i; 2] {
            let f = self.avx512f;
            let even = self.avx512bw._mm512_maskz_mov_epi16(0x5555_5555, a);
            [f._mm512_add_epi32(sums[0], even), f._mm512_add_epi32(sums[1], f._mm512_srli_epi32::<16>(a))]
        }
        #[inline(always)]
        fn number(self, i: __m512i) -> __m512 {
            self.avx512f._mm512_cvtepi32_ps(i)
        }
        #[inline(always)]
        fn words_of_8(self, rows: [&[u16; 8]; 4]) -> __m512i {
            let (a, b): (__m128i, __m128i) = (pulp::cast(*rows[0]), pulp::cast(*rows[1]));
            let (c, d): (__m128i, __m128i) = (pulp::cast(*rows[2]), pulp::cast(*rows[3]));
            let f = self.avx512f;
            let table = f._mm512_inserti32x4::<1>(f._mm512_castsi128_si512(a), b);
            f._mm512_inserti32x4::<3>(f._mm512_inserti32x4::<2>(table, c), d)
        }
        #[inline(always)]
        fn words_of_16(self, rows: [&[u16; 16]; 2]) -> __m512i {
            let (a, b): (__m256i, __m256i) = (pulp::cast(*rows[0]), pulp::cast(*rows[1]));
            let f = self.avx512f;
            f._mm512_inserti64x4::<1>(f._mm512_castsi256_si512(a), b)
        }
        #[inline(always)]
        fn look_32(self, table: __m512i, i: __m512i) -> __m512i {
            self.avx512bw._mm512_permutexvar_epi16(i, table)
        }
        #[inline(always)]
        fn look_64(self, table: [__m512i; 2], i: __m512i) -> __m512i {
            self.avx512bw._mm512_permutex2var_epi16(table[0], i, table[1])
        }
        #[inline(always)]
        fn look_128(self, table: [__m512i; 4], i: __m512i) -> __m512i {
            let bw = self.avx512bw;
            let is_high = bw._mm512_test_epi16_mask(i, self.word(64));
            let low = bw._mm512_permutex2var_epi16(table[0], i, table[1]);
            bw._mm512_mask_blend_epi16(is_high, low, bw._mm512_permutex2var_epi16(table[2], i, table[3]))
        }
    }
}
