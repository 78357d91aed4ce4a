//! A polynomial shift from places in the frame to places without distortion, in the gauge of the calibration.

use glam::DVec2;
use nalgebra::DMatrix;

use crate::geometry::{Distortion, DistortionError, term_count, terms};
use crate::mask::Disc;

/// Undistorted minus distorted over a disc, before anyone knows whether it can be inverted.
#[derive(Clone, Debug, PartialEq)]
pub struct ShiftField {
    pub disc: Disc,
    pub order: usize,
    /// Coefficients, px, in the order of [`terms`].
    pub shift_px: Vec<DVec2>,
}

impl ShiftField {
    /// A pincushion whose rim moves inwards by `pincushion` radii, turned there by `turn_rad`: both grow with r³.
    // With x = (p − c)/R the shift is R |x|² (turn · x⊥ − pincushion · x), x⊥ = (−y, x); x³, x²y, xy², y³ are terms 6 to 9.
    pub fn trial(disc: Disc, pincushion: f64, turn_rad: f64) -> Self {
        let mut shift_px = vec![DVec2::ZERO; term_count(3)];
        let by_x = DVec2::new(-pincushion, turn_rad) * disc.radius_px;
        for (term, shift) in [(6, by_x), (7, by_x.perp()), (8, by_x), (9, by_x.perp())] {
            shift_px[term] = shift;
        }
        Self { disc, order: 3, shift_px }
    }

    /// The same as a polynomial of `order`; what higher terms say is dropped.
    pub fn of_order(&self, order: usize) -> Self {
        let mut shift_px = self.shift_px.clone();
        shift_px.resize(term_count(order), DVec2::ZERO);
        Self { disc: self.disc, order, shift_px }
    }

    /// Terms at a place of the frame.
    pub fn terms_at(&self, p: DVec2) -> Vec<f64> {
        terms(self.order, (p - self.disc.centre) / self.disc.radius_px).collect()
    }

    /// Where `p` would be without distortion.
    pub fn straight(&self, p: DVec2) -> DVec2 {
        p + self.terms_at(p).iter().zip(&self.shift_px).map(|(term, shift)| *term * *shift).sum::<DVec2>()
    }

    /// The same as a distortion that can be inverted.
    ///
    /// # Errors
    /// When it folds the picture.
    pub fn distortion(&self) -> Result<Distortion, DistortionError> {
        Distortion::new(self.disc.centre, self.disc.radius_px, self.order, self.shift_px.clone())
    }

    /// All coefficients: those of columns, then those of rows.
    pub fn numbers(&self) -> Vec<f64> {
        self.shift_px.iter().map(|shift| shift.x).chain(self.shift_px.iter().map(|shift| shift.y)).collect()
    }

    /// The same field with other [`ShiftField::numbers`].
    pub fn with_numbers(&self, numbers: &[f64]) -> Self {
        let (u, v) = numbers.split_at(self.shift_px.len());
        let shift_px = u.iter().zip(v).map(|(u, v)| DVec2::new(*u, *v)).collect();
        Self { shift_px, ..self.clone() }
    }
}

/// Directions in which [`ShiftField::numbers`] are free, one a column: what no pose can make up for.
// Place, turn and scale of the picture are the pose's, so at the disc's centre the shift is zero and its derivative A = [u₁ u₂; v₁ v₂]
// is symmetric, which turns nothing, and without trace, which keeps areas: det(1 + A/R) = 1 to first order.
pub fn free_directions(order: usize) -> DMatrix<f64> {
    let count = term_count(order);
    let mut directions = DMatrix::zeros(2 * count, 2 + 2 * (count - 3));
    (directions[(1, 0)], directions[(count + 2, 0)]) = (1.0, -1.0);
    (directions[(2, 1)], directions[(count + 1, 1)]) = (1.0, 1.0);
    for term in 3..count {
        let column = 2 * (term - 2);
        (directions[(term, column)], directions[(count + term, column + 1)]) = (1.0, 1.0);
    }
    directions
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_trial_moves_the_rim_inwards_and_around_and_the_centre_not() {
        let disc = Disc { centre: DVec2::new(250.0, 260.0), radius_px: 200.0 };
        let field = ShiftField::trial(disc, 0.1, 0.05);
        let mut cases = 0;
        for n in 0..8 {
            let out = DVec2::from_angle(f64::from(n));
            let shift = field.straight(disc.centre + 200.0 * out) - (disc.centre + 200.0 * out);
            assert!((shift - (-20.0 * out + 10.0 * out.perp())).length() < 1e-9, "{n}: {shift}");
            cases += 1;
        }
        assert_eq!(cases, 8);
        assert!(field.straight(disc.centre) == disc.centre && field.distortion().is_ok());
        assert_eq!(field.of_order(5).straight(DVec2::new(300.0, 111.0)), field.straight(DVec2::new(300.0, 111.0)));
    }

    #[test]
    fn no_free_direction_moves_turns_or_enlarges_the_centre() {
        let disc = Disc { centre: DVec2::splat(100.0), radius_px: 90.0 };
        let none = ShiftField::trial(disc, 0.0, 0.0);
        let directions = free_directions(3);
        assert_eq!(directions.shape(), (20, 16));
        for direction in directions.column_iter() {
            let field = none.with_numbers(direction.as_slice());
            let jacobian = field.distortion().expect("small").jacobian(disc.centre);
            assert_eq!(field.straight(disc.centre), disc.centre);
            assert!((jacobian.determinant() - 1.0).abs() < 2e-4 && jacobian.x_axis.y == jacobian.y_axis.x, "{jacobian}");
        }
        // The control: enlarging is not free.
        let mut enlarged = vec![0.0; 20];
        (enlarged[1], enlarged[12]) = (1.0, 1.0);
        let enlarged = nalgebra::DVector::from_vec(enlarged);
        assert!(directions.column_iter().all(|direction| direction.dot(&enlarged) == 0.0));
    }
}
