//! A polynomial shift from places in the frame to places without distortion, in the gauge of the calibration.

use glam::{DMat2, DVec2};
use nalgebra::DMatrix;

use crate::geometry::{Distortion, DistortionError, noise_through, shift_slopes, term_count, terms};
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

    /// Derivative of [`ShiftField::straight`].
    pub fn jacobian(&self, p: DVec2) -> DMat2 {
        let slopes = shift_slopes(self.order, (p - self.disc.centre) / self.disc.radius_px, &self.shift_px);
        DMat2::IDENTITY + slopes * self.disc.radius_px.recip()
    }

    /// Covariance (uu, uv, vv), px², of the straight place of a shadow at `p` that is known in the frame to `noise_px2`.
    pub fn straight_noise_px2(&self, p: DVec2, noise_px2: [f64; 3]) -> [f64; 3] {
        noise_through(self.jacobian(p), noise_px2)
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
    use crate::random::{Purpose, Stream};

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

    /// Shadows that scatter about a place near the rim, drawn: their straight places scatter as is stated.
    #[test]
    fn noise_of_a_shadow_goes_through_the_field() {
        const DRAWS: usize = 20_000;
        let field = ShiftField::trial(Disc { centre: DVec2::new(250.0, 260.0), radius_px: 200.0 }, 0.12, 0.05);
        let (place, [long_px, short_px]) = (DVec2::new(250.0 + 130.0, 260.0 + 120.0), [0.3, 0.05]);
        let along = DVec2::from_angle(0.3);
        let wide = long_px * long_px - short_px * short_px;
        let least = short_px * short_px;
        let noise_px2 = [least + wide * along.x * along.x, wide * along.x * along.y, least + wide * along.y * along.y];
        let mut random = Stream::new(1, 64, 0, Purpose::Evaluation);
        let mut drawn = [0.0; 3];
        for _ in 0..DRAWS {
            let noise = along * (long_px * random.normal()) + along.perp() * (short_px * random.normal());
            let off = field.straight(place + noise) - field.straight(place);
            let squares = [off.x * off.x, off.x * off.y, off.y * off.y];
            drawn.iter_mut().zip(squares).for_each(|(sum, square)| *sum += square / DRAWS as f64);
        }
        // Variances of so many draws are known to 1 %.
        let scale = noise_px2[0] + noise_px2[2];
        let off_by = |stated: [f64; 3]| stated.iter().zip(drawn).map(|(a, b)| (a - b).abs() / scale).fold(0.0, f64::max);
        let stated = field.straight_noise_px2(place, noise_px2);
        assert!(off_by(stated) < 0.03, "{stated:?} {drawn:?}");
        assert!(off_by(noise_px2) > 0.15, "the control, noise as it is in the frame: {noise_px2:?} {drawn:?}");
        let distortion = field.distortion().expect("it can be inverted");
        assert!((0..4).all(|n| {
            let difference = field.jacobian(place) - distortion.jacobian(place);
            difference.to_cols_array()[n].abs() < 1e-12
        }));
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
