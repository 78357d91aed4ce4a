//! A depth that is off the prior's. A picture that a console has enlarged, with K as it was, fits all the same, its shadows' sizes among it: only the
//! depth is another, by as much. Six numbers together hide one that is off.

use super::case::Case;
use super::prior::Prior;
use super::settle::Settled;
use super::solve::about;

/// Depths are farther off by accident once in a hundred times, in standard deviations.
const UNLIKELY_DEPTH: f64 = 2.6;

/// How far the beads are from the source, by themselves and by the prior.
#[derive(Clone, Copy, Debug)]
struct OffDepth {
    own_mm: f64,
    prior_mm: f64,
    /// Of the difference.
    sigma_mm: f64,
}

impl OffDepth {
    /// `None` where accident explains it; what cannot be told is said as well.
    fn words(self) -> Option<String> {
        let Self { own_mm, prior_mm, sigma_mm } = self;
        let off_mm = own_mm - prior_mm;
        let sigmas = off_mm.abs() / sigma_mm;
        if sigmas.is_nan() {
            return Some(format!(
                "whether the beads are as far from the source as by the prior cannot be told: {own_mm:.0} mm, {prior_mm:.0} mm by the prior, standard \
                 deviation {sigma_mm:.0} mm; check the prior"
            ));
        }
        (!(sigmas <= UNLIKELY_DEPTH)).then(|| {
            format!(
                "the beads are {:.0} mm {} the source than by the prior, {sigmas:.1} standard deviations along the beam: a picture that is {:.1} % {} \
                 than K says looks just so; where the console has enlarged or cropped it declare that (--console, \"console\" in a session), else check \
                 SID, the layout's scale, and the prior",
                off_mm.abs(),
                if off_mm < 0.0 { "nearer" } else { "farther from" },
                100.0 * (prior_mm / own_mm - 1.0).abs(),
                if off_mm < 0.0 { "larger" } else { "smaller" }
            )
        })
    }
}

impl Case<'_> {
    /// That the beads' depth is not the prior's; `None` where it may be.
    pub(super) fn off_depth(&self, last: &Settled, prior: &Prior) -> Option<String> {
        let solution = &last.solution;
        let centroid_lps = solution.camera_from_lps.inverse().transform_point(solution.centroid_mm);
        let there_mm = prior.camera_from_lps.transform_point(centroid_lps);
        let to_beads = about(there_mm);
        let stated = to_beads * self.gate(prior).information.try_inverse()? * to_beads.transpose();
        // A pose that the prior is part of is no second word.
        let own_mm2 = if self.request.fuse { 0.0 } else { solution.covariance[(5, 5)] * last.chi2_per_dof.max(1.0) };
        let sigma_mm = (stated[(5, 5)] + own_mm2).sqrt();
        OffDepth { own_mm: solution.centroid_mm.z, prior_mm: there_mm.z, sigma_mm }.words()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_depth_says_by_how_much_the_picture_may_be_enlarged() {
        let words = |own_mm: f64, sigma_mm: f64| OffDepth { own_mm, prior_mm: 642.0, sigma_mm }.words();
        let nearer = words(600.0, 15.0).unwrap_or_default();
        for part in ["42 mm nearer the source", "2.8 standard deviations", "7.0 % larger than K says", "\"console\" in a session"]
        {
            assert!(nearer.contains(part), "{part} in {nearer}");
        }
        let farther = words(690.0, 15.0).unwrap_or_default();
        assert!(farther.contains("48 mm farther from the source") && farther.contains("7.0 % smaller"), "{farther}");
        assert_eq!([words(604.0, 15.0), words(600.0, 17.0)], [None, None]);
    }

    #[test]
    fn a_depth_that_is_no_number_is_not_taken_for_the_prior_s() {
        let mut cases = 0;
        for (own_mm, sigma_mm) in [(f64::NAN, 15.0), (600.0, f64::NAN), (642.0, 0.0)] {
            let words = OffDepth { own_mm, prior_mm: 642.0, sigma_mm }.words();
            assert!(words.is_some_and(|words| words.contains("cannot be told")), "{own_mm} and {sigma_mm}");
            cases += 1;
        }
        assert_eq!(cases, 3);
    }
}
