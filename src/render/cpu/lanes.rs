//! Sixteen rays side by side: the few operations that crossing a volume needs, in portable code and in AVX-512.
//!
//! Everything is `inline(always)` and free of closures, so that all of it is compiled for the instruction set of its caller.

/// Rays that are crossed together.
pub const LANES: usize = 16;

/// Operations on sixteen `f32`.
pub trait Lanes: Copy {
    /// Sixteen numbers.
    type F: Copy;
    /// Sixteen truths.
    type M: Copy;
    /// Sixteen indices.
    type I: Copy;
    /// A table of 32 numbers.
    type Table: Copy;
    /// Whether looking up tables beats fetching from memory.
    const TABLES: bool;
    /// The same in all lanes.
    fn splat(self, value: f32) -> Self::F;
    /// From memory.
    fn load(self, values: &[f32; LANES]) -> Self::F;
    /// To memory.
    fn store(self, a: Self::F) -> [f32; LANES];
    /// a + b.
    fn add(self, a: Self::F, b: Self::F) -> Self::F;
    /// a − b.
    fn sub(self, a: Self::F, b: Self::F) -> Self::F;
    /// a / b.
    fn div(self, a: Self::F, b: Self::F) -> Self::F;
    /// a · b.
    fn mul(self, a: Self::F, b: Self::F) -> Self::F;
    /// a · b + c.
    fn fma(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F;
    /// The smaller.
    fn min(self, a: Self::F, b: Self::F) -> Self::F;
    /// The larger.
    fn max(self, a: Self::F, b: Self::F) -> Self::F;
    /// Towards −∞.
    fn floor(self, a: Self::F) -> Self::F;
    /// m and e of a = m 2ᵉ with 1 ≤ m < 2, a > 0.
    fn parts(self, a: Self::F) -> [Self::F; 2];
    /// a < b.
    fn less(self, a: Self::F, b: Self::F) -> Self::M;
    /// Whether any lane is true.
    fn any(self, m: Self::M) -> bool;
    /// `a` where true, else `b`.
    fn select(self, m: Self::M, a: Self::F, b: Self::F) -> Self::F;
    /// Whole numbers as indices.
    fn index(self, a: Self::F) -> Self::I;
    /// The same index in all lanes.
    fn same_index(self, i: i32) -> Self::I;
    /// i + j.
    fn add_index(self, i: Self::I, j: Self::I) -> Self::I;
    /// `i` where true, else `j`.
    fn select_index(self, m: Self::M, i: Self::I, j: Self::I) -> Self::I;
    /// Indices from memory.
    fn load_indices(self, i: &[i32; LANES]) -> Self::I;
    /// Indices to memory.
    fn indices(self, i: Self::I) -> [i32; LANES];
    /// A table of four rows of eight.
    fn rows_of_8(self, rows: [&[f32; 8]; 4]) -> Self::Table;
    /// A table of two rows of sixteen.
    fn rows_of_16(self, rows: [&[f32; 16]; 2]) -> Self::Table;
    /// From one table of 32.
    fn lookup(self, table: Self::Table, i: Self::I) -> Self::F;
    /// From two tables, the second holds entries 32–63.
    fn lookup_64(self, low: Self::Table, high: Self::Table, i: Self::I) -> Self::F;
    /// From three tables of 32.
    fn lookup_96(self, tables: [Self::Table; 3], i: Self::I) -> Self::F;
    /// The value where its low `bits` are `class`, else 0.
    fn of_class(self, a: Self::F, bits: u32, class: u32) -> Self::F;
}

/// Plain Rust, for any processor.
#[derive(Clone, Copy, Debug)]
pub struct Portable;

macro_rules! lanewise {
    ($l:ident => $value:expr) => {{
        let mut out = [Default::default(); LANES];
        let mut $l = 0;
        while $l < LANES {
            out[$l] = $value;
            $l += 1;
        }
        out
    }};
}

/// m of a = m 2ᵉ with 1 ≤ m < 2.
#[inline(always)]
#[must_use]
pub fn mantissa(a: f32) -> f32 {
    f32::from_bits(a.to_bits() & 0x7f_ffff | 127 << 23)
}

/// e of a = m 2ᵉ.
#[inline(always)]
#[must_use]
pub fn exponent(a: f32) -> f32 {
    ((a.to_bits() >> 23 & 255) as i32 - 127) as f32
}

impl Lanes for Portable {
    type F = [f32; LANES];
    type M = [bool; LANES];
    type I = [i32; LANES];
    type Table = [f32; 32];
    const TABLES: bool = false;
    #[inline(always)]
    fn splat(self, value: f32) -> Self::F {
        [value; LANES]
    }
    #[inline(always)]
    fn load(self, values: &[f32; LANES]) -> Self::F {
        *values
    }
    #[inline(always)]
    fn store(self, a: Self::F) -> [f32; LANES] {
        a
    }
    #[inline(always)]
    fn add(self, a: Self::F, b: Self::F) -> Self::F {
        lanewise!(l => a[l] + b[l])
    }
    #[inline(always)]
    fn sub(self, a: Self::F, b: Self::F) -> Self::F {
        lanewise!(l => a[l] - b[l])
    }
    #[inline(always)]
    fn div(self, a: Self::F, b: Self::F) -> Self::F {
        lanewise!(l => a[l] / b[l])
    }
    #[inline(always)]
    fn mul(self, a: Self::F, b: Self::F) -> Self::F {
        lanewise!(l => a[l] * b[l])
    }
    #[inline(always)]
    fn fma(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F {
        lanewise!(l => a[l] * b[l] + c[l])
    }
    #[inline(always)]
    fn min(self, a: Self::F, b: Self::F) -> Self::F {
        lanewise!(l => if a[l] < b[l] { a[l] } else { b[l] })
    }
    #[inline(always)]
    fn max(self, a: Self::F, b: Self::F) -> Self::F {
        lanewise!(l => if a[l] > b[l] { a[l] } else { b[l] })
    }
    #[inline(always)]
    fn floor(self, a: Self::F) -> Self::F {
        lanewise!(l => f32::floor(a[l]))
    }
    #[inline(always)]
    fn parts(self, a: Self::F) -> [Self::F; 2] {
        [lanewise!(l => mantissa(a[l])), lanewise!(l => exponent(a[l]))]
    }
    #[inline(always)]
    fn less(self, a: Self::F, b: Self::F) -> Self::M {
        lanewise!(l => a[l] < b[l])
    }
    #[inline(always)]
    fn any(self, m: Self::M) -> bool {
        let mut any = false;
        let mut l = 0;
        while l < LANES {
            any |= m[l];
            l += 1;
        }
        any
    }
    #[inline(always)]
    fn select(self, m: Self::M, a: Self::F, b: Self::F) -> Self::F {
        lanewise!(l => if m[l] { a[l] } else { b[l] })
    }
    #[inline(always)]
    fn index(self, a: Self::F) -> Self::I {
        lanewise!(l => a[l] as i32)
    }
    #[inline(always)]
    fn same_index(self, i: i32) -> Self::I {
        [i; LANES]
    }
    #[inline(always)]
    fn add_index(self, i: Self::I, j: Self::I) -> Self::I {
        lanewise!(l => i[l] + j[l])
    }
    #[inline(always)]
    fn select_index(self, m: Self::M, i: Self::I, j: Self::I) -> Self::I {
        lanewise!(l => if m[l] { i[l] } else { j[l] })
    }
    #[inline(always)]
    fn load_indices(self, i: &[i32; LANES]) -> Self::I {
        *i
    }
    #[inline(always)]
    fn indices(self, i: Self::I) -> [i32; LANES] {
        i
    }
    #[inline(always)]
    fn rows_of_8(self, rows: [&[f32; 8]; 4]) -> Self::Table {
        let mut table = [0.0; 32];
        let mut i = 0;
        while i < 32 {
            table[i] = rows[i / 8][i % 8];
            i += 1;
        }
        table
    }
    #[inline(always)]
    fn rows_of_16(self, rows: [&[f32; 16]; 2]) -> Self::Table {
        let mut table = [0.0; 32];
        let mut i = 0;
        while i < 32 {
            table[i] = rows[i / 16][i % 16];
            i += 1;
        }
        table
    }
    #[inline(always)]
    fn lookup(self, table: Self::Table, i: Self::I) -> Self::F {
        lanewise!(l => table[(i[l] & 31) as usize])
    }
    #[inline(always)]
    fn lookup_64(self, low: Self::Table, high: Self::Table, i: Self::I) -> Self::F {
        lanewise!(l => if i[l] & 32 == 0 { low[(i[l] & 31) as usize] } else { high[(i[l] & 31) as usize] })
    }
    #[inline(always)]
    fn lookup_96(self, tables: [Self::Table; 3], i: Self::I) -> Self::F {
        lanewise!(l => tables[((i[l] >> 5 & 3) as usize).min(2)][(i[l] & 31) as usize])
    }
    #[inline(always)]
    fn of_class(self, a: Self::F, bits: u32, class: u32) -> Self::F {
        lanewise!(l => if f32::to_bits(a[l]) & bits == class { a[l] } else { 0.0 })
    }
}

#[cfg(target_arch = "x86_64")]
mod avx512 {
    use core::arch::x86_64::{__m256, __m512, __m512i, __mmask16, _CMP_LT_OQ, _MM_MANT_NORM_1_2, _MM_MANT_SIGN_SRC};

    use pulp::x86::V4;

    use super::{LANES, Lanes};

    impl Lanes for V4 {
        type F = __m512;
        type M = __mmask16;
        type I = __m512i;
        type Table = (__m512, __m512);
        const TABLES: bool = true;
        #[inline(always)]
        fn splat(self, value: f32) -> __m512 {
            self.avx512f._mm512_set1_ps(value)
        }
        #[inline(always)]
        fn load(self, values: &[f32; LANES]) -> __m512 {
            pulp::cast(*values)
        }
        #[inline(always)]
        fn store(self, a: __m512) -> [f32; LANES] {
            pulp::cast(a)
        }
        #[inline(always)]
        fn add(self, a: __m512, b: __m512) -> __m512 {
            self.avx512f._mm512_add_ps(a, b)
        }
        #[inline(always)]
        fn sub(self, a: __m512, b: __m512) -> __m512 {
            self.avx512f._mm512_sub_ps(a, b)
        }
        #[inline(always)]
        fn div(self, a: __m512, b: __m512) -> __m512 {
            self.avx512f._mm512_div_ps(a, b)
        }
        #[inline(always)]
        fn mul(self, a: __m512, b: __m512) -> __m512 {
            self.avx512f._mm512_mul_ps(a, b)
        }
        #[inline(always)]
        fn fma(self, a: __m512, b: __m512, c: __m512) -> __m512 {
            self.avx512f._mm512_fmadd_ps(a, b, c)
        }
        #[inline(always)]
        fn min(self, a: __m512, b: __m512) -> __m512 {
            self.avx512f._mm512_min_ps(a, b)
        }
        #[inline(always)]
        fn max(self, a: __m512, b: __m512) -> __m512 {
            self.avx512f._mm512_max_ps(a, b)
        }
        #[inline(always)]
        fn floor(self, a: __m512) -> __m512 {
            // 9: towards −∞, no exception.
            self.avx512f._mm512_roundscale_ps::<9>(a)
        }
        #[inline(always)]
        fn parts(self, a: __m512) -> [__m512; 2] {
            let f = self.avx512f;
            [f._mm512_getmant_ps::<_MM_MANT_NORM_1_2, _MM_MANT_SIGN_SRC>(a), f._mm512_getexp_ps(a)]
        }
        #[inline(always)]
        fn less(self, a: __m512, b: __m512) -> __mmask16 {
            self.avx512f._mm512_cmp_ps_mask::<_CMP_LT_OQ>(a, b)
        }
        #[inline(always)]
        fn any(self, m: __mmask16) -> bool {
            m != 0
        }
        #[inline(always)]
        fn select(self, m: __mmask16, a: __m512, b: __m512) -> __m512 {
            self.avx512f._mm512_mask_blend_ps(m, b, a)
        }
        #[inline(always)]
        fn index(self, a: __m512) -> __m512i {
            self.avx512f._mm512_cvttps_epi32(a)
        }
        #[inline(always)]
        fn same_index(self, i: i32) -> __m512i {
            self.avx512f._mm512_set1_epi32(i)
        }
        #[inline(always)]
        fn add_index(self, i: __m512i, j: __m512i) -> __m512i {
            self.avx512f._mm512_add_epi32(i, j)
        }
        #[inline(always)]
        fn select_index(self, m: __mmask16, i: __m512i, j: __m512i) -> __m512i {
            self.avx512f._mm512_mask_blend_epi32(m, j, i)
        }
        #[inline(always)]
        fn load_indices(self, i: &[i32; LANES]) -> __m512i {
            pulp::cast(*i)
        }
        #[inline(always)]
        fn indices(self, i: __m512i) -> [i32; LANES] {
            pulp::cast(i)
        }
        #[inline(always)]
        fn rows_of_8(self, rows: [&[f32; 8]; 4]) -> (__m512, __m512) {
            let (a, b): (__m256, __m256) = (pulp::cast(*rows[0]), pulp::cast(*rows[1]));
            let (c, d): (__m256, __m256) = (pulp::cast(*rows[2]), pulp::cast(*rows[3]));
            let (f, dq) = (self.avx512f, self.avx512dq);
            (
                dq._mm512_insertf32x8::<1>(f._mm512_castps256_ps512(a), b),
                dq._mm512_insertf32x8::<1>(f._mm512_castps256_ps512(c), d),
            )
        }
        #[inline(always)]
        fn rows_of_16(self, rows: [&[f32; 16]; 2]) -> (__m512, __m512) {
            (pulp::cast(*rows[0]), pulp::cast(*rows[1]))
        }
        #[inline(always)]
        fn lookup(self, table: (__m512, __m512), i: __m512i) -> __m512 {
            self.avx512f._mm512_permutex2var_ps(table.0, i, table.1)
        }
        #[inline(always)]
        fn lookup_64(self, low: (__m512, __m512), high: (__m512, __m512), i: __m512i) -> __m512 {
            let f = self.avx512f;
            let is_high = f._mm512_test_epi32_mask(i, f._mm512_set1_epi32(32));
            let (low, high) = (f._mm512_permutex2var_ps(low.0, i, low.1), f._mm512_permutex2var_ps(high.0, i, high.1));
            f._mm512_mask_blend_ps(is_high, low, high)
        }
        #[inline(always)]
        fn lookup_96(self, tables: [(__m512, __m512); 3], i: __m512i) -> __m512 {
            let f = self.avx512f;
            let is_last = f._mm512_test_epi32_mask(i, f._mm512_set1_epi32(64));
            f._mm512_mask_blend_ps(is_last, self.lookup_64(tables[0], tables[1], i), self.lookup(tables[2], i))
        }
        #[inline(always)]
        fn of_class(self, a: __m512, bits: u32, class: u32) -> __m512 {
            let f = self.avx512f;
            let low = f._mm512_and_si512(pulp::cast(a), f._mm512_set1_epi32(bits as i32));
            f._mm512_maskz_mov_ps(f._mm512_cmpeq_epi32_mask(low, f._mm512_set1_epi32(class as i32)), a)
        }
    }
}
