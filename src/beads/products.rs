//! Sums of products of long columns, side by side: the same number of each, bit for bit, on every machine.

/// Sums are made in so many strands.
const STRANDS: usize = 8;

/// Sum of products, see [`dots`].
#[inline(always)]
pub fn dot<S: pulp::Simd>(simd: S, a: &[f64], b: &[f64]) -> f64 {
    dots(simd, [a], [b])[0][0]
}

/// Sums of products of each of `a` with each of `b`, all of one length: in eight strands, always in the same order, whatever the vectors of the
/// machine and whatever is summed beside.
#[inline(always)]
pub fn dots<S: pulp::Simd, const M: usize, const N: usize>(simd: S, a: [&[f64]; M], b: [&[f64]; N]) -> [[f64; N]; M] {
    match S::F64_LANES {
        8 => dots_in::<S, M, N, 1>(simd, a, b),
        4 => dots_in::<S, M, N, 2>(simd, a, b),
        2 => dots_in::<S, M, N, 4>(simd, a, b),
        _ => dots_in::<S, M, N, 8>(simd, a, b),
    }
}

/// [`dots`], where a sum's strands are so many vectors: a number that the compiler knows, so that they stay where they are added.
#[inline(always)]
fn dots_in<S: pulp::Simd, const M: usize, const N: usize, const VECTORS: usize>(
    simd: S,
    a: [&[f64]; M],
    b: [&[f64]; N],
) -> [[f64; N]; M] {
    let count = a.iter().chain(&b).map(|column| column.len()).min().unwrap_or(0);
    let whole = count / STRANDS * STRANDS;
    let x = a.map(|column| S::as_simd_f64s(&column[..whole]).0);
    let y = b.map(|column| S::as_simd_f64s(&column[..whole]).0);
    let mut strands = [[[simd.splat_f64s(0.0); VECTORS]; N]; M];
    for step in 0..whole / STRANDS {
        for n in 0..VECTORS {
            let y = y.map(|column| column[step * VECTORS + n]);
            for (strands, x) in strands.iter_mut().zip(x) {
                let x = x[step * VECTORS + n];
                for (strands, y) in strands.iter_mut().zip(y) {
                    strands[n] = simd.add_f64s(strands[n], simd.mul_f64s(x, y));
                }
            }
        }
    }
    std::array::from_fn(|i| {
        std::array::from_fn(|j| {
            let rest: f64 = a[i][whole..count].iter().zip(&b[j][whole..count]).map(|(x, y)| x * y).sum();
            // A copy, or all of them would lie in memory from the first.
            let strands = strands[i][j];
            pulp::bytemuck::cast_slice::<_, f64>(&strands).iter().sum::<f64>() + rest
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Stream};

    struct Several<'a>(&'a [Vec<f64>; 6]);

    impl pulp::WithSimd for Several<'_> {
        type Output = [[f64; 4]; 2];

        #[inline(always)]
        fn with_simd<S: pulp::Simd>(self, simd: S) -> Self::Output {
            let [a, b, c, d, e, f] = self.0.each_ref().map(Vec::as_slice);
            dots(simd, [a, b], [c, d, e, f])
        }
    }

    #[test]
    fn sums_side_by_side_are_plain_sums_in_eight_strands_whatever_the_vectors() {
        let mut random = Stream::new(3, 0, 0, Purpose::Evaluation);
        for count in [0, 1, 7, 8, 9, 40, 451] {
            let columns: [Vec<f64>; 6] = std::array::from_fn(|_| (0..count).map(|_| random.normal()).collect());
            let widest = pulp::Arch::new().dispatch(Several(&columns));
            let without = pulp::WithSimd::with_simd(Several(&columns), pulp::Scalar);
            for (i, a) in columns[..2].iter().enumerate() {
                for (j, b) in columns[2..].iter().enumerate() {
                    let products: Vec<f64> = a.iter().zip(b).map(|(a, b)| a * b).collect();
                    let steps = products.chunks_exact(STRANDS);
                    let rest: f64 = steps.remainder().iter().sum();
                    let mut strands = [0.0; STRANDS];
                    steps.for_each(|step| strands.iter_mut().zip(step).for_each(|(strand, product)| *strand += product));
                    let expected = strands.iter().sum::<f64>() + rest;
                    for sum in [widest[i][j], without[i][j], dot(pulp::Scalar, a, b)] {
                        assert_eq!(sum.to_bits(), expected.to_bits(), "{count} terms, {i} with {j}: {sum} for {expected}");
                    }
                    let plain: f64 = products.iter().sum();
                    assert!((expected - plain).abs() < 1e-11, "{count} terms: {expected} for {plain}");
                }
            }
        }
    }
}
