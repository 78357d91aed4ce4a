//! How well the radius of a shadow is known.
//!
//! A shadow's width is that of sphere and blur together: s² + q r² with q from 1/5 (a chord) to 1/4 (a disc). Where the blur is little, its
//! rim tells the radius by itself. Where it is not, only the form does by which a blurred sphere differs from blur alone, and that goes as
//! r⁴: noise that leaves r⁴ uncertain by a share x leaves ln r uncertain by x/4, and from x = 1/n on, n standard deviations down there
//! is no sphere at all. With σ the standard deviation of ln r where the fit arrived, the radius n standard deviations down is
//! ln r + ¼ ln(1 − 4 n σ). Besides, no one knows the blur's form: what is taken for a Gaussian changes a width by a share of s², and the
//! radius by a share of (s/r)². In grey values no one knows the curve either: forms that fit as well and differ in radius tell how little
//! the radius is known.

use super::model::{Fit, Model};

/// Standard deviations down to which a radius must hold.
const DOWN: f64 = 3.0;
/// (s/r)² from which on the form alone tells the radius.
const BLURRED: f64 = 0.06;
/// Error of ln r over (s/r)² by a blur that is no Gaussian.
const OTHER_BLUR: f64 = 0.3;
/// No radius is known better, as a share of it: in quanta, where beams harden; in values of unknown scale, where a curve does as it likes.
const LEAST: f64 = 0.02;
const LEAST_OF_GREY: f64 = 0.1;
/// None is known worse: a candidate's scale tells as much.
const MOST: f64 = 0.5;

/// Standard deviation of ln r where the equations give `sigma_ln`.
pub fn radius_sigma_ln(model: Model, sigma_ln: f64, radius_px: f64, blur_px: f64) -> f64 {
    let blur2 = (blur_px / radius_px).powi(2);
    let least = match model {
        Model::Transmission => LEAST,
        Model::Additive { .. } => LEAST_OF_GREY,
    };
    let by_form = 4.0 * DOWN * (blur2 / BLURRED).min(1.0);
    let left = 1.0 - by_form * sigma_ln;
    let of_noise = if left > 1e-3 { -left.ln() / by_form } else { MOST };
    let sigma = (of_noise.powi(2) + (OTHER_BLUR * blur2).powi(2) + least * least).sqrt();
    if sigma < MOST { sigma } else { MOST }
}

/// χ² by which a form may fit worse than the best and be as good.
const AS_GOOD: f64 = 9.0;
/// Standard deviation over the largest distance of such forms in ln r.
const BY_FORM: f64 = 0.7;

/// The `best` of fits of several forms to one shadow, its radius as uncertain as they make it.
pub fn among_forms(best: Fit, tried: &[Fit]) -> Fit {
    let limit = AS_GOOD * best.chi2_per_dof.max(1.0);
    let is_as_good = |fit: &&Fit| (fit.chi2_per_dof - best.chi2_per_dof) * best.dof <= limit;
    let apart = |fit: &Fit| (fit.radius_px / best.radius_px).ln().abs();
    let widest = tried.iter().filter(is_as_good).map(apart).fold(0.0, f64::max);
    Fit { radius_sigma_ln: best.radius_sigma_ln.hypot(BY_FORM * widest).min(MOST), ..best }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blur_hides_a_radius_and_noise_does_the_more_of_a_blurred_one() {
        let of = |sigma_ln: f64, radius_px: f64, blur_px: f64| radius_sigma_ln(Model::Transmission, sigma_ln, radius_px, blur_px);
        // A bead of 1.5 mm in an ordinary frame: nothing but the least.
        assert!((0.02..0.025).contains(&of(0.004, 6.2, 0.8)), "{}", of(0.004, 6.2, 0.8));
        // Sharp: what noise makes of it.
        assert!((of(0.2, 6.0, 0.05) / 0.2 - 1.0).abs() < 0.03, "{}", of(0.2, 6.0, 0.05));
        assert!((0.05..0.08).contains(&of(0.02, 2.0, 0.8)) && of(0.06, 2.0, 0.8) > 0.1);
        // As wide a blur as the bead.
        assert!(of(0.05, 1.2, 1.2) > 0.3);
        for lost in [of(0.09, 2.0, 1.2), of(2.0, 2.0, 0.8), of(f64::NAN, 2.0, 0.8), of(0.01, 1.0, 2.0)] {
            assert_eq!(lost, MOST);
        }
        assert!(radius_sigma_ln(Model::Additive { sign: 1.0, shape: 0 }, 0.004, 6.2, 0.8) > 0.1);
    }
}
