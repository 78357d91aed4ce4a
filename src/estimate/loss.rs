//! What a residual costs.

/// ρ(χ²), χ² being a residual's square in standard deviations.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Loss {
    /// χ²: least squares.
    #[default]
    None,
    /// s² ln(1 + χ²/s²), s in standard deviations: gross errors lose nearly all weight.
    Cauchy(f64),
    /// χ² up to s², 2 s χ − s² beyond: gross errors pull with a bounded force.
    Huber(f64),
}

impl Loss {
    /// ρ.
    #[must_use]
    pub fn cost(self, chi2: f64) -> f64 {
        match self {
            Self::None => chi2,
            Self::Cauchy(s) => s * s * (chi2 / (s * s)).ln_1p(),
            Self::Huber(s) if chi2 <= s * s => chi2,
            Self::Huber(s) => 2.0 * s * chi2.sqrt() - s * s,
        }
    }

    /// ρ′: 1 where the residual counts fully.
    #[must_use]
    pub fn weight(self, chi2: f64) -> f64 {
        match self {
            Self::None => 1.0,
            Self::Cauchy(s) => 1.0 / (1.0 + chi2 / (s * s)),
            Self::Huber(s) if chi2 <= s * s => 1.0,
            Self::Huber(s) => s / chi2.sqrt(),
        }
    }
}

impl Loss {
    /// ρ″, never positive.
    pub(super) fn bend(self, chi2: f64) -> f64 {
        match self {
            Self::None => 0.0,
            Self::Cauchy(s) => -(s * (1.0 + chi2 / (s * s))).powi(-2),
            Self::Huber(s) if chi2 <= s * s => 0.0,
            Self::Huber(s) => -0.5 * s * chi2.powf(-1.5),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_the_slopes_of_the_costs() {
        let mut cases = 0;
        for loss in [Loss::None, Loss::Cauchy(3.0), Loss::Huber(1.5)] {
            for chi2 in [0.01, 1.0, 2.0, 30.0, 1e4] {
                let h = 1e-6 * chi2;
                let slope = (loss.cost(chi2 + h) - loss.cost(chi2 - h)) / (2.0 * h);
                assert!((slope - loss.weight(chi2)).abs() < 1e-6, "{loss:?} {chi2}");
                let bend = (loss.weight(chi2 + h) - loss.weight(chi2 - h)) / (2.0 * h);
                assert!((bend - loss.bend(chi2)).abs() < 1e-6, "{loss:?} {chi2}");
                cases += 1;
            }
        }
        assert_eq!(cases, 15);
    }
}
