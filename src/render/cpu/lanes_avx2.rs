//! Sixteen rays in pairs of AVX2 registers.

use core::arch::x86_64::{__m256, __m256i, _CMP_LT_OQ};

use pulp::x86::V3;

use super::lanes::{LANES, Lanes, exponent, mantissa};

/// Two registers, lane by lane alike.
macro_rules! both {
    ($a:ident => $value:expr) => {{
        let [low, high] = $a;
        [
            {
                let $a = low;
                $value
            },
            {
                let $a = high;
                $value
            },
        ]
    }};
    ($a:ident, $b:ident => $value:expr) => {{
        let ([a_low, a_high], [b_low, b_high]) = ($a, $b);
        [
            {
                let ($a, $b) = (a_low, b_low);
                $value
            },
            {
                let ($a, $b) = (a_high, b_high);
                $value
            },
        ]
    }};
    ($a:ident, $b:ident, $c:ident => $value:expr) => {{
        let ([a_low, a_high], [b_low, b_high], [c_low, c_high]) = ($a, $b, $c);
        [
            {
                let ($a, $b, $c) = (a_low, b_low, c_low);
                $value
            },
            {
                let ($a, $b, $c) = (a_high, b_high, c_high);
                $value
            },
        ]
    }};
}

/// One of 32 values per lane: a permutation in each register of eight, then by bits 3 and 4 of the index.
#[inline(always)]
fn of_32(s: V3, table: [__m256; 4], i: __m256i) -> __m256 {
    let (avx, avx2) = (s.avx, s.avx2);
    let by_3 = avx._mm256_castsi256_ps(avx2._mm256_slli_epi32::<28>(i));
    let by_4 = avx._mm256_castsi256_ps(avx2._mm256_slli_epi32::<27>(i));
    let pick = [
        avx2._mm256_permutevar8x32_ps(table[0], i),
        avx2._mm256_permutevar8x32_ps(table[1], i),
        avx2._mm256_permutevar8x32_ps(table[2], i),
        avx2._mm256_permutevar8x32_ps(table[3], i),
    ];
    let low = avx._mm256_blendv_ps(pick[0], pick[1], by_3);
    let high = avx._mm256_blendv_ps(pick[2], pick[3], by_3);
    avx._mm256_blendv_ps(low, high, by_4)
}

impl Lanes for V3 {
    type F = [__m256; 2];
    type M = [__m256; 2];
    type I = [__m256i; 2];
    type Table = [__m256; 4];
    const TABLES: bool = true;
    #[inline(always)]
    fn splat(self, value: f32) -> Self::F {
        [self.avx._mm256_set1_ps(value); 2]
    }
    #[inline(always)]
    fn load(self, values: &[f32; LANES]) -> Self::F {
        pulp::cast(*values)
    }
    #[inline(always)]
    fn store(self, a: Self::F) -> [f32; LANES] {
        pulp::cast(a)
    }
    #[inline(always)]
    fn add(self, a: Self::F, b: Self::F) -> Self::F {
        both!(a, b => self.avx._mm256_add_ps(a, b))
    }
    #[inline(always)]
    fn sub(self, a: Self::F, b: Self::F) -> Self::F {
        both!(a, b => self.avx._mm256_sub_ps(a, b))
    }
    #[inline(always)]
    fn div(self, a: Self::F, b: Self::F) -> Self::F {
        both!(a, b => self.avx._mm256_div_ps(a, b))
    }
    #[inline(always)]
    fn mul(self, a: Self::F, b: Self::F) -> Self::F {
        both!(a, b => self.avx._mm256_mul_ps(a, b))
    }
    #[inline(always)]
    fn fma(self, a: Self::F, b: Self::F, c: Self::F) -> Self::F {
        both!(a, b, c => self.fma._mm256_fmadd_ps(a, b, c))
    }
    #[inline(always)]
    fn min(self, a: Self::F, b: Self::F) -> Self::F {
        both!(a, b => self.avx._mm256_min_ps(a, b))
    }
    #[inline(always)]
    fn max(self, a: Self::F, b: Self::F) -> Self::F {
        both!(a, b => self.avx._mm256_max_ps(a, b))
    }
    #[inline(always)]
    fn floor(self, a: Self::F) -> Self::F {
        // 9: towards −∞, no exception.
        both!(a => self.avx._mm256_round_ps::<9>(a))
    }
    #[inline(always)]
    fn parts(self, a: Self::F) -> [Self::F; 2] {
        let values = self.store(a);
        let (mut m, mut e) = ([0.0; LANES], [0.0; LANES]);
        let mut l = 0;
        while l < LANES {
            (m[l], e[l]) = (mantissa(values[l]), exponent(values[l]));
            l += 1;
        }
        [self.load(&m), self.load(&e)]
    }
    #[inline(always)]
    fn less(self, a: Self::F, b: Self::F) -> Self::M {
        both!(a, b => self.avx._mm256_cmp_ps::<_CMP_LT_OQ>(a, b))
    }
    #[inline(always)]
    fn any(self, m: Self::M) -> bool {
        self.avx._mm256_movemask_ps(self.avx._mm256_or_ps(m[0], m[1])) != 0
    }
    #[inline(always)]
    fn select(self, m: Self::M, a: Self::F, b: Self::F) -> Self::F {
        both!(m, a, b => self.avx._mm256_blendv_ps(b, a, m))
    }
    #[inline(always)]
    fn index(self, a: Self::F) -> Self::I {
        both!(a => self.avx._mm256_cvttps_epi32(a))
    }
    #[inline(always)]
    fn same_index(self, i: i32) -> Self::I {
        [self.avx._mm256_set1_epi32(i); 2]
    }
    #[inline(always)]
    fn add_index(self, i: Self::I, j: Self::I) -> Self::I {
        both!(i, j => self.avx2._mm256_add_epi32(i, j))
    }
    #[inline(always)]
    fn select_index(self, m: Self::M, i: Self::I, j: Self::I) -> Self::I {
        both!(m, i, j => self.avx2._mm256_blendv_epi8(j, i, self.avx._mm256_castps_si256(m)))
    }
    #[inline(always)]
    fn load_indices(self, i: &[i32; LANES]) -> Self::I {
        pulp::cast(*i)
    }
    #[inline(always)]
    fn indices(self, i: Self::I) -> [i32; LANES] {
        pulp::cast(i)
    }
    #[inline(always)]
    fn rows_of_8(self, rows: [&[f32; 8]; 4]) -> Self::Table {
        [pulp::cast(*rows[0]), pulp::cast(*rows[1]), pulp::cast(*rows[2]), pulp::cast(*rows[3])]
    }
    #[inline(always)]
    fn rows_of_16(self, rows: [&[f32; 16]; 2]) -> Self::Table {
        let ([a, b], [c, d]): ([__m256; 2], [__m256; 2]) = (pulp::cast(*rows[0]), pulp::cast(*rows[1]));
        [a, b, c, d]
    }
    #[inline(always)]
    fn lookup(self, table: Self::Table, i: Self::I) -> Self::F {
        both!(i => of_32(self, table, i))
    }
    #[inline(always)]
    fn lookup_64(self, low: Self::Table, high: Self::Table, i: Self::I) -> Self::F {
        let (avx, avx2) = (self.avx, self.avx2);
        both!(i => avx._mm256_blendv_ps(
            of_32(self, low, i),
            of_32(self, high, i),
            avx._mm256_castsi256_ps(avx2._mm256_slli_epi32::<26>(i))
        ))
    }
    #[inline(always)]
    fn lookup_96(self, tables: [Self::Table; 3], i: Self::I) -> Self::F {
        let (avx, avx2) = (self.avx, self.avx2);
        let first = self.lookup_64(tables[0], tables[1], i);
        let last = self.lookup(tables[2], i);
        both!(i, first, last => avx._mm256_blendv_ps(first, last, avx._mm256_castsi256_ps(avx2._mm256_slli_epi32::<25>(i))))
    }
    #[inline(always)]
    fn of_class(self, a: Self::F, bits: u32, class: u32) -> Self::F {
        let (avx, avx2) = (self.avx, self.avx2);
        let (bits, class) = (avx._mm256_set1_epi32(bits as i32), avx._mm256_set1_epi32(class as i32));
        both!(a => avx._mm256_and_ps(
            a,
            avx._mm256_castsi256_ps(avx2._mm256_cmpeq_epi32(avx2._mm256_and_si256(avx._mm256_castps_si256(a), bits), class))
        ))
    }
}
