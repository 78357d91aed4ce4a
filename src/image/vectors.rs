//! Plain loops, compiled for the widest vectors that the machine has.

/// 1/12! … 1/0!: what is left out is below 2e-16 for |r| ≤ ½ ln 2.
const TAYLOR: [f64; 13] = {
    let mut terms = [1.0; 13];
    let mut n = 12;
    while n > 0 {
        terms[n - 1] = terms[n] / (13 - n) as f64;
        n -= 1;
    }
    terms
};

/// eˣ for |x| ≤ 700, to a few units in the last place; a loop over it becomes vector instructions.
#[inline(always)]
#[must_use]
pub fn exp(x: f64) -> f64 {
    // x = n ln 2 + r with |r| ≤ ½ ln 2; adding and subtracting 1.5 · 2⁵² rounds to whole numbers.
    const ROUND: f64 = 6_755_399_441_055_744.0;
    const LN_2: [f64; 2] = [0.693_147_180_369_123_8, 1.908_214_929_270_587_7e-10];
    let shifted = x * std::f64::consts::LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = x - n * LN_2[0] - n * LN_2[1];
    let sum = TAYLOR.iter().fold(0.0, |sum, term| sum * r + term);
    let power = f64::from_bits((shifted.to_bits() << 52).wrapping_add(1023 << 52));
    sum * power
}

/// Runs `op`, whose [`pulp::NullaryFnOnce::call`] and all that it calls are marked `#[inline(always)]`, with AVX-512, AVX2, or what every machine has.
/// The same operations in the same order: the result does not depend on the machine.
pub fn on_widest_vectors<Op: pulp::NullaryFnOnce>(op: Op) -> Op::Output {
    #[cfg(target_arch = "x86_64")]
    if let Some(avx512) = pulp::x86::V4::try_new() {
        return avx512.vectorize(op);
    }
    #[cfg(target_arch = "x86_64")]
    if let Some(avx2) = pulp::x86::V3::try_new() {
        return avx2.vectorize(op);
    }
    op.call()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_exponential_is_the_librarys() {
        for n in -70_000..=70_000 {
            let x = f64::from(n) * 0.01 + 0.003;
            let (ours, theirs) = (exp(x), x.exp());
            assert!((ours / theirs - 1.0).abs() < 1e-15, "{x}: {ours} against {theirs}");
        }
        assert_eq!(exp(0.0), 1.0);
    }
}
