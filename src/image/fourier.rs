//! A discrete Fourier transform of 2ⁿ values, in place.

/// Real and imaginary parts.
pub type Complex = [f64; 2];

/// Σ x_k exp(−2πi jk/n); the length must be a power of two.
pub fn transform(values: &mut [Complex]) {
    let n = values.len();
    debug_assert!(n.is_power_of_two());
    let mut mirrored = 0usize;
    for at in 1..n {
        let mut bit = n >> 1;
        while mirrored & bit != 0 {
            mirrored ^= bit;
            bit >>= 1;
        }
        mirrored |= bit;
        if at < mirrored {
            values.swap(at, mirrored);
        }
    }
    let mut half = 1;
    while half < n {
        let step = -std::f64::consts::PI / half as f64;
        for start in (0..n).step_by(2 * half) {
            for k in 0..half {
                let (sin, cos) = (step * k as f64).sin_cos();
                let [re, im] = values[start + k + half];
                let turned = [re * cos - im * sin, re * sin + im * cos];
                let even = values[start + k];
                values[start + k] = [even[0] + turned[0], even[1] + turned[1]];
                values[start + k + half] = [even[0] - turned[0], even[1] - turned[1]];
            }
        }
        half *= 2;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_the_sum_that_defines_it() {
        let input: Vec<Complex> = (0..16).map(|k| [(k as f64 * 1.3).sin() + 0.2 * k as f64, (k as f64).cos()]).collect();
        let mut fast = input.clone();
        transform(&mut fast);
        for (j, found) in fast.iter().enumerate() {
            let mut sum = [0.0, 0.0];
            for (k, [re, im]) in input.iter().enumerate() {
                let (sin, cos) = (-std::f64::consts::TAU * (j * k) as f64 / 16.0).sin_cos();
                sum[0] += re * cos - im * sin;
                sum[1] += re * sin + im * cos;
            }
            assert!((sum[0] - found[0]).hypot(sum[1] - found[1]) < 1e-11, "{j}: {sum:?} {found:?}");
        }
    }
}
