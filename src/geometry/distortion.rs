//! Geometric distortion of an image intensifier: pincushion of its curved input, S distortion of the earth's field.
//!
//! With c and R the centre and the radius of the disc and x = (p − c)/R, a place p of the frame as it is acquired lies at
//! `undistorted(p) = p + Σ sᵢⱼ xⁱ yʲ`, i + j ≤ order. Undistorted pixels are square, and a camera without distortion made the picture.
//! The fifth order leaves 0.2 px rms of 11 px (published for global polynomials).

use glam::{DMat2, DVec2};

use super::panel_window::PanelWindow;

/// Order of the polynomial where none is asked for.
pub const DEFAULT_ORDER: usize = 5;
/// Orders that are taken; the highest has as many terms as a usual grid can determine.
pub const ORDERS: std::ops::RangeInclusive<usize> = 1..=9;
/// The mapping is checked, and inverted, up to this many radii from the centre.
const REACH: f64 = 1.05;
/// The inverse is right to this.
const INVERSE_TOLERANCE_PX: f64 = 1e-9;
const MOST_STEPS: usize = 50;

/// Why there is no distortion, or no place under it.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum DistortionError {
    /// The disc is none.
    #[error("the disc has radius {radius_px} px about {centre_px}, expected finite numbers and a positive radius")]
    Disc {
        /// Its centre.
        centre_px: DVec2,
        /// Its radius.
        radius_px: f64,
    },
    /// The order is not taken.
    #[error("a distortion of order {found}, expected {} to {}", ORDERS.start(), ORDERS.end())]
    Order {
        /// Found.
        found: usize,
    },
    /// Coefficients are missing or too many.
    #[error("a distortion of order {order} has {found} coefficients per axis, expected {expected}, all finite")]
    Coefficients {
        /// Of the polynomial.
        order: usize,
        /// Found.
        found: usize,
        /// Terms of that order.
        expected: usize,
    },
    /// Two places of the frame would be one.
    #[error("the distortion folds the picture at ({:.1}, {:.1}) px, inside the disc: spots are named wrongly or too few", at_px.x, at_px.y)]
    Folded {
        /// Where.
        at_px: DVec2,
    },
    /// No place of the disc lies there.
    #[error("no place of the disc is seen undistorted at ({:.1}, {:.1}) px", undistorted_px.x, undistorted_px.y)]
    Outside {
        /// Asked for.
        undistorted_px: DVec2,
    },
}

/// Number of terms of a bivariate polynomial.
#[must_use]
pub fn term_count(order: usize) -> usize {
    (order + 1) * (order + 2) / 2
}

/// Terms of a bivariate polynomial by degree: 1, x, y, x², xy, y², x³, …
pub fn terms(order: usize, x: DVec2) -> impl Iterator<Item = f64> {
    (0..=order).flat_map(move |degree| (0..=degree).map(move |j| x.x.powi((degree - j) as i32) * x.y.powi(j as i32)))
}

/// Derivatives of [`terms`] by x and y.
fn term_slopes(order: usize, x: DVec2) -> impl Iterator<Item = DVec2> {
    let power = |base: f64, n: usize| if n == 0 { 0.0 } else { n as f64 * base.powi(n as i32 - 1) };
    (0..=order).flat_map(move |degree| {
        (0..=degree).map(move |j| {
            let i = degree - j;
            DVec2::new(power(x.x, i) * x.y.powi(j as i32), x.x.powi(i as i32) * power(x.y, j))
        })
    })
}

/// Derivative of the sum of [`terms`], each times its shift, px.
#[must_use]
pub fn shift_slopes(order: usize, x: DVec2, shift_px: &[DVec2]) -> DMat2 {
    let zero = (DVec2::ZERO, DVec2::ZERO);
    let (by_x, by_y) = term_slopes(order, x)
        .zip(shift_px)
        .fold(zero, |(by_x, by_y), (slope, shift)| (by_x + slope.x * *shift, by_y + slope.y * *shift));
    DMat2::from_cols(by_x, by_y)
}

/// Noise (uu, uv, vv) of a place that moves by `by` with one whose noise that is: J N Jᵀ.
#[must_use]
pub fn noise_through(by: DMat2, [uu, uv, vv]: [f64; 3]) -> [f64; 3] {
    let noise = by * DMat2::from_cols_array(&[uu, uv, uv, vv]) * by.transpose();
    [noise.x_axis.x, noise.y_axis.x, noise.y_axis.y]
}

/// From places in the frame as it is acquired to places without distortion, px.
#[derive(Clone, Debug, PartialEq)]
pub struct Distortion {
    centre_px: DVec2,
    radius_px: f64,
    order: usize,
    /// In the polynomial's own axes.
    shift_px: Vec<DVec2>,
    /// A turn from the frame's axes to the polynomial's, which are the panel's: a console may have turned the picture.
    axes_from_frame: DMat2,
}

impl Distortion {
    /// With the shift's coefficients in the order of [`terms`].
    ///
    /// # Errors
    /// When the disc or a number makes no sense, or the mapping cannot be inverted over the disc.
    pub fn new(centre_px: DVec2, radius_px: f64, order: usize, shift_px: Vec<DVec2>) -> Result<Self, DistortionError> {
        if !(centre_px.is_finite() && radius_px > 0.0 && radius_px.is_finite()) {
            return Err(DistortionError::Disc { centre_px, radius_px });
        }
        if !ORDERS.contains(&order) {
            return Err(DistortionError::Order { found: order });
        }
        let (found, expected) = (shift_px.len(), term_count(order));
        if found != expected || !shift_px.iter().all(|shift| shift.is_finite()) {
            return Err(DistortionError::Coefficients { order, found, expected });
        }
        let made = Self { centre_px, radius_px, order, shift_px, axes_from_frame: DMat2::IDENTITY };
        match made.fold() {
            Some(at_px) => Err(DistortionError::Folded { at_px }),
            None => Ok(made),
        }
    }

    /// A place about which the mapping cannot be inverted.
    // On a convex region a mapping whose Jacobian has a positive definite symmetric part takes no two points to one: for a ≠ b,
    // (b − a)·(f(b) − f(a)) = ∫ (b − a)·J (b − a) > 0. Its determinant is positive too: det J = det S + w², with S that part and w the
    // skew one.
    fn fold(&self) -> Option<DVec2> {
        const RINGS: i32 = 24;
        let ring = |ring: i32| {
            let around = (6 * ring).max(1);
            let radius = REACH * self.radius_px * f64::from(ring) / f64::from(RINGS);
            (0..around).map(move |n| radius * DVec2::from_angle(std::f64::consts::TAU * f64::from(n) / f64::from(around)))
        };
        (0..=RINGS).flat_map(ring).map(|offset| self.centre_px + offset).find(|at| {
            let j = self.jacobian(*at);
            let across = 0.5 * (j.x_axis.y + j.y_axis.x);
            !(j.x_axis.x > 0.0 && j.x_axis.x * j.y_axis.y - across * across > 0.0)
        })
    }

    /// Centre of the disc in the frame as it is acquired.
    #[must_use]
    pub fn centre_px(&self) -> DVec2 {
        self.centre_px
    }

    /// Radius of the disc in the frame as it is acquired.
    #[must_use]
    pub fn radius_px(&self) -> f64 {
        self.radius_px
    }

    /// Whether a place of the frame as it is acquired lies inside the disc: the mapping is known there and nothing is seen elsewhere.
    #[must_use]
    pub fn sees(&self, p_distorted: DVec2) -> bool {
        p_distorted.distance(self.centre_px) <= self.radius_px
    }

    /// The polynomial's x: radii from the disc's centre, along the polynomial's axes.
    fn polynomial_place(&self, p_distorted: DVec2) -> DVec2 {
        self.axes_from_frame * (p_distorted - self.centre_px) / self.radius_px
    }

    /// Where `p_distorted` would be without distortion.
    #[must_use]
    pub fn undistorted(&self, p_distorted: DVec2) -> DVec2 {
        let shift = terms(self.order, self.polynomial_place(p_distorted)).zip(&self.shift_px).map(|(term, shift)| term * *shift);
        p_distorted + self.axes_from_frame.transpose() * shift.sum::<DVec2>()
    }

    /// Derivative of [`Distortion::undistorted`]; its determinant is the area on the undistorted picture that one pixel shows.
    #[must_use]
    pub fn jacobian(&self, p_distorted: DVec2) -> DMat2 {
        let slopes = shift_slopes(self.order, self.polynomial_place(p_distorted), &self.shift_px);
        let axes = self.axes_from_frame;
        DMat2::IDENTITY + axes.transpose() * slopes * axes * self.radius_px.recip()
    }

    /// Where the frame as it is acquired shows `p_undistorted`, by Newton steps to 1e-9 px.
    ///
    /// # Errors
    /// When no place of the disc, or just beside it, is seen there.
    pub fn distorted(&self, p_undistorted: DVec2) -> Result<DVec2, DistortionError> {
        let outside = DistortionError::Outside { undistorted_px: p_undistorted };
        let held = |p: DVec2| self.centre_px + (p - self.centre_px).clamp_length_max(REACH * self.radius_px);
        let off = |p: DVec2| p_undistorted - self.undistorted(p);
        let mut at = held(p_undistorted);
        let mut left = off(at);
        for _ in 0..MOST_STEPS {
            if left.length() <= INVERSE_TOLERANCE_PX {
                return Ok(at);
            }
            let step = self.jacobian(at).inverse() * left;
            // A full step may lead away where the mapping bends; half of it, or a quarter, does not.
            let shorter =
                (0..12).map(|halves| held(at + step * 0.5f64.powi(halves))).find(|next| off(*next).length() < left.length());
            let Some(next) = shorter else { break };
            (at, left) = (next, off(next));
        }
        // The last digits of large coordinates.
        if left.length() <= INVERSE_TOLERANCE_PX { Ok(at) } else { Err(outside) }
    }

    /// Where a frame as it is acquired shows `p_undistorted`: just there without distortion; `None` where it does not.
    #[must_use]
    pub fn shown(distortion: Option<&Self>, p_undistorted: DVec2) -> Option<DVec2> {
        distortion.map_or(Some(p_undistorted), |distortion| distortion.distorted(p_undistorted).ok())
    }

    /// The same distortion where each pixel has the side of `1 / scale` of these.
    #[must_use]
    pub fn scaled(&self, scale: f64) -> Self {
        let half = DVec2::splat(0.5);
        let shift_px = self.shift_px.iter().map(|shift| scale * *shift).collect();
        let centre_px = scale * (self.centre_px + half) - half;
        Self { centre_px, radius_px: scale * self.radius_px, shift_px, ..self.clone() }
    }

    /// The same distortion in a frame whose pixels lie on this one's picture as `window` says.
    // With A = detector_from_oriented, A(p) = step · R p + t, a place p of the frame lies without distortion at A⁻¹(undistorted(A(p))),
    // since K of the frame is folded through A as well. With c' = A⁻¹(c) the polynomial's x is R (p − c') / (radius / step), and its shift
    // comes back as Rᵀ shift / step.
    #[must_use]
    pub fn through_window(&self, window: &PanelWindow) -> Self {
        let detector_from_oriented = window.detector_from_oriented();
        Self {
            centre_px: detector_from_oriented.inverse().transform_point2(self.centre_px),
            radius_px: self.radius_px / window.step,
            order: self.order,
            shift_px: self.shift_px.iter().map(|shift| *shift / window.step).collect(),
            axes_from_frame: self.axes_from_frame * detector_from_oriented.matrix2 * window.step.recip(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Pincushion of 20 px at the rim of a disc of 250 px, with some S.
    fn pincushion(share: f64) -> Result<Distortion, DistortionError> {
        let mut shift = vec![DVec2::ZERO; term_count(5)];
        // x³ + x y² and x² y + y³ are terms 6, 8, 7 and 9.
        for (n, radial, turned) in
            [(6, DVec2::X, DVec2::Y), (8, DVec2::X, DVec2::Y), (7, DVec2::Y, -DVec2::X), (9, DVec2::Y, -DVec2::X)]
        {
            shift[n] = share * (-20.0 * radial + 6.0 * turned);
        }
        Distortion::new(DVec2::new(255.0, 260.0), 250.0, 5, shift)
    }

    #[test]
    fn the_inverse_and_the_jacobian_fit_the_mapping() {
        let distortion = pincushion(1.0).expect("invertible");
        let mut furthest = 0.0f64;
        for n in 0..400 {
            let at = distortion.centre_px() + 250.0 * (f64::from(n) / 400.0).sqrt() * DVec2::from_angle(2.4 * f64::from(n));
            let straight = distortion.undistorted(at);
            furthest = furthest.max(straight.distance(at));
            let back = distortion.distorted(straight).expect("inside");
            assert!(back.distance(at) < 2e-9, "{at}: {back}");
            assert_eq!(Distortion::shown(Some(&distortion), straight), Some(back));
            let step = 1e-4;
            for (axis, slope) in [(DVec2::X, distortion.jacobian(at).x_axis), (DVec2::Y, distortion.jacobian(at).y_axis)] {
                let change = (distortion.undistorted(at + step * axis) - distortion.undistorted(at - step * axis)) / (2.0 * step);
                assert!((change - slope).length() < 1e-8, "{at}: {change} {slope}");
            }
        }
        assert!((furthest - 20.0f64.hypot(6.0)).abs() < 0.1, "{furthest}");
        let beside = DVec2::new(800.0, 260.0);
        assert!(distortion.distorted(beside).is_err());
        assert_eq!([Some(&distortion), None].map(|through| Distortion::shown(through, beside)), [None, Some(beside)]);
        assert!(distortion.distorted(DVec2::NAN).is_err());
    }

    #[test]
    fn a_mapping_that_folds_is_refused() {
        // The slope at the rim is 1 - 3 * 20 share / 250.
        assert!(pincushion(3.5).is_ok());
        assert!(matches!(pincushion(4.2), Err(DistortionError::Folded { .. })), "{:?}", pincushion(4.2));
        assert!(matches!(pincushion(f64::NAN), Err(DistortionError::Coefficients { .. })));
    }

    /// Of a picture that a console cropped, enlarged and turned each place is undistorted as it is on the panel.
    #[test]
    fn a_window_of_the_picture_has_the_same_places() {
        let whole = pincushion(1.0).expect("good");
        let mut cases = 0;
        for (first_px, step, turned_rad) in
            [([0.0; 2], 1.0, 0.0), ([37.0, 61.5], 1.0, 0.0), ([20.0, -9.0], 0.7, 0.4), ([0.0; 2], 2.0, -0.7)]
        {
            let window = PanelWindow { first_px, step, turned_rad };
            let (part, detector_from_oriented) = (whole.through_window(&window), window.detector_from_oriented());
            for n in 0..60 {
                let on_panel = whole.centre_px() + 245.0 * (f64::from(n) / 60.0).sqrt() * DVec2::from_angle(2.4 * f64::from(n));
                let at = detector_from_oriented.inverse().transform_point2(on_panel);
                let straight = detector_from_oriented.transform_point2(part.undistorted(at));
                assert!(straight.distance(whole.undistorted(on_panel)) < 1e-9, "{window:?}: {straight}");
                assert!(part.distorted(part.undistorted(at)).expect("inside").distance(at) < 2e-9, "{window:?}: {at}");
                let slope = (part.undistorted(at + 1e-4 * DVec2::X) - part.undistorted(at - 1e-4 * DVec2::X)) / 2e-4;
                assert!(slope.distance(part.jacobian(at).x_axis) < 1e-7, "{window:?}: {slope}");
                let beyond = on_panel + 20.0 * (on_panel - whole.centre_px()).normalize_or(DVec2::X);
                for p in [on_panel, beyond] {
                    assert_eq!(part.sees(detector_from_oriented.inverse().transform_point2(p)), whole.sees(p), "{window:?}: {p}");
                }
                cases += 1;
            }
        }
        assert_eq!(cases, 240);
        assert_eq!(whole.through_window(&PanelWindow::WHOLE), whole, "bit for bit");
    }

    #[test]
    fn a_binned_frame_has_the_same_places() {
        let (fine, coarse) = (pincushion(1.0).expect("good"), pincushion(1.0).expect("good").scaled(0.25));
        let at = DVec2::new(400.0, 137.0);
        let binned = |p: DVec2| 0.25 * (p + DVec2::splat(0.5)) - DVec2::splat(0.5);
        assert!(coarse.undistorted(binned(at)).distance(binned(fine.undistorted(at))) < 1e-9);
    }
}
