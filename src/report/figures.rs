//! Marks as figures: rings, crosses, arrows, lines and words. The window, strips and overlays draw the same ones, each by its own means.

use std::f64::consts::TAU;

use glam::DVec2;

use super::canvas::Rgb;
use super::marks::{BeadMark, LandmarkMark, PairMarks, RobotMark, ShadowMark};

/// Residuals and uncertainties are drawn so many times as large as they are.
pub const STRETCH: f64 = 20.0;
/// Between a shadow's rim and its ring, pixels of the frame.
pub const GAP_PX: f64 = 4.0;
/// For shadows whose radius is not known, pixels of the frame.
pub const RADIUS_PX: f64 = 8.0;

const USED: Rgb = [40, 230, 80];
const LEFT_OUT: Rgb = [240, 50, 40];
const PREDICTED: Rgb = [250, 220, 30];
/// Put or named by a hand.
const BY_HAND: Rgb = [80, 220, 250];
const SHADOW: Rgb = [235, 235, 245];
/// A shadow against whose centre something speaks.
const FLAGGED: Rgb = [150, 150, 165];
const RESIDUAL: Rgb = [255, 110, 230];
const ROBOT: Rgb = [90, 190, 255];
const LANDMARK: Rgb = [255, 170, 90];

/// No ring is smaller, points of the screen.
const LEAST_RING: f64 = 4.0;
/// The head of an arrow, points of the screen; shorter arrows have none.
const HEAD: f64 = 5.0;
/// Corners of an ellipse.
const CORNERS: u32 = 48;
/// No ellipse is narrower, pixels of the frame from its centre.
const LEAST_AXIS_PX: f64 = 1.0;

/// What a figure tells of: whoever draws may leave some out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tells {
    /// Where shadows are seen, a bead's or nobody's.
    Seen,
    /// Where P puts beads.
    Predicted,
    /// By how much the two differ.
    Residual,
    /// What beads are called.
    Name,
    /// Landmarks and their uncertainty.
    Landmark,
    /// What landmarks are called.
    LandmarkName,
    /// The robot.
    Robot,
}

/// Places are pixels of the frame; widths and reaches are points of the screen, whatever the magnification.
#[derive(Clone, Debug, PartialEq)]
pub enum Form {
    /// About a shadow, with a gap between ([`ring_reach`]).
    Ring {
        /// Its centre.
        at_px: [f64; 2],
        /// Of the shadow.
        radius_px: f64,
        /// Of the line.
        width: f64,
    },
    /// A circle of one size.
    Spot {
        /// Its centre.
        at_px: [f64; 2],
        /// Its radius.
        reach: f64,
        /// Of the line.
        width: f64,
    },
    /// Upright.
    Cross {
        /// Its middle.
        at_px: [f64; 2],
        /// Half its height.
        reach: f64,
    },
    /// See [`arrow`].
    Arrow {
        /// Its tail.
        from_px: [f64; 2],
        /// Its point.
        to_px: [f64; 2],
    },
    /// Straight from point to point.
    Line {
        /// The points.
        along_px: Vec<[f64; 2]>,
        /// Of the line.
        width: f64,
    },
    /// Words at the right of the ring about a shadow.
    Words {
        /// Centre of the ring.
        at_px: [f64; 2],
        /// Of the shadow.
        radius_px: f64,
        /// Below it, else above.
        below: bool,
        /// The words.
        text: String,
    },
}

/// A figure.
#[derive(Clone, Debug, PartialEq)]
pub struct Figure {
    /// What it tells of.
    pub tells: Tells,
    /// Its colour.
    pub colour: Rgb,
    /// Its form.
    pub form: Form,
}

impl PairMarks {
    /// All of them; later ones lie over earlier ones.
    #[must_use]
    pub fn figures(&self) -> Vec<Figure> {
        let mut figures = Vec::new();
        self.robot.iter().for_each(|mark| robot(mark, &mut figures));
        figures.extend(self.strays().map(|shadow| {
            let form = Form::Ring { at_px: shadow.image_px, radius_px: shadow.radius_px, width: 1.0 };
            Figure { tells: Tells::Seen, colour: if shadow.flagged { FLAGGED } else { SHADOW }, form }
        }));
        self.beads.iter().for_each(|mark| bead(mark, &mut figures));
        self.landmarks.iter().for_each(|mark| landmark(mark, &mut figures));
        figures
    }

    /// The rank of each shadow beside it.
    #[must_use]
    pub fn ranks(&self) -> Vec<Figure> {
        let rank = |shadow: &ShadowMark| {
            let (at_px, radius_px, text) = (shadow.image_px, shadow.radius_px, shadow.rank.to_string());
            Figure { tells: Tells::Seen, colour: SHADOW, form: Form::Words { at_px, radius_px, below: true, text } }
        };
        self.shadows.iter().map(rank).collect()
    }
}

fn robot(mark: &RobotMark, figures: &mut Vec<Figure>) {
    let along_px = mark.centreline_px.iter().copied().chain([mark.tip_px]).collect();
    let forms = [Form::Line { along_px, width: 1.6 }, Form::Spot { at_px: mark.tip_px, reach: 5.0, width: 1.8 }];
    figures.extend(forms.map(|form| Figure { tells: Tells::Robot, colour: ROBOT, form }));
}

fn bead(mark: &BeadMark, figures: &mut Vec<Figure>) {
    let mut add = |tells, colour, form| figures.push(Figure { tells, colour, form });
    let radius_px = mark.radius_px.unwrap_or(RADIUS_PX);
    if let Some(at_px) = mark.found_px {
        let colour = match (mark.used, mark.by_hand) {
            (true, true) => BY_HAND,
            (true, false) => USED,
            (false, _) => LEFT_OUT,
        };
        add(Tells::Seen, colour, Form::Ring { at_px, radius_px, width: 1.8 });
    }
    if let Some(at_px) = mark.predicted_px {
        add(Tells::Predicted, PREDICTED, Form::Cross { at_px, reach: 4.0 });
    }
    if let Some((from_px, [du, dv])) = mark.predicted_px.zip(mark.residual_px) {
        let to_px = [from_px[0] + STRETCH * du, from_px[1] + STRETCH * dv];
        add(Tells::Residual, RESIDUAL, Form::Arrow { from_px, to_px });
    }
    if let Some(at_px) = mark.found_px.or(mark.predicted_px) {
        let colour = if mark.used { USED } else { PREDICTED };
        add(Tells::Name, colour, Form::Words { at_px, radius_px, below: false, text: mark.name.clone() });
    }
}

fn landmark(mark: &LandmarkMark, figures: &mut Vec<Figure>) {
    let Some(at_px) = mark.image_px else { return };
    let mut add = |tells, form| figures.push(Figure { tells, colour: LANDMARK, form });
    add(Tells::Landmark, Form::Cross { at_px, reach: 6.0 });
    if let Some(covariance_px2) = mark.covariance_px2 {
        add(Tells::Landmark, Form::Line { along_px: ellipse(at_px, covariance_px2), width: 1.4 });
    }
    add(Tells::LandmarkName, Form::Words { at_px, radius_px: 0.0, below: true, text: mark.name.clone() });
}

/// Places one standard deviation from a place, [`STRETCH`] times as far away, back to the first one.
fn ellipse([u, v]: [f64; 2], [[uu, uv], [_, vv]]: [[f64; 2]; 2]) -> Vec<[f64; 2]> {
    // A symmetric 2×2 matrix is its mean, half its trace, and a deviation (½(uu − vv), uv), whose length the eigenvalues are above and below
    // the mean; a turn of the matrix turns the deviation twice as far, so that the long axis lies at half its angle.
    let (mean, deviation) = (0.5 * (uu + vv), DVec2::new(0.5 * (uu - vv), uv));
    let variances = [mean + deviation.length(), mean - deviation.length()];
    let [long, narrow] = variances.map(|variance| (STRETCH * variance.max(0.0).sqrt()).max(LEAST_AXIS_PX));
    let axis = DVec2::from_angle(0.5 * deviation.y.atan2(deviation.x));
    let corner = |n: u32| {
        let (sin, cos) = (TAU * f64::from(n % CORNERS) / f64::from(CORNERS)).sin_cos();
        let off = axis.rotate(DVec2::new(long * cos, narrow * sin));
        [u + off.x, v + off.y]
    };
    (0..=CORNERS).map(corner).collect()
}

/// Radius of the ring about a shadow on a screen that has `scale` points per pixel of the frame, points.
#[must_use]
pub fn ring_reach(radius_px: f64, scale: f64) -> f64 {
    ((radius_px + GAP_PX) * scale).max(LEAST_RING)
}

/// The lines of an arrow between two points of the screen: its shaft, and its head where it is long enough for one.
#[must_use]
pub fn arrow(from: [f64; 2], to: [f64; 2]) -> Vec<[[f64; 2]; 2]> {
    let (start, end) = (DVec2::from_array(from), DVec2::from_array(to));
    let mut lines = vec![[from, to]];
    if start.distance(end) > HEAD {
        let back = HEAD * (start - end).normalize();
        let aside = 0.6 * back.perp();
        lines.extend([back + aside, back - aside].map(|off| [to, (end + off).to_array()]));
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_ellipse_has_the_axes_of_its_covariance() {
        // Standard deviations of 0.5 and 0.2 px; the long axis is turned by 30 degrees towards increasing rows.
        let (sin, cos) = 30f64.to_radians().sin_cos();
        let (long, narrow) = (0.25, 0.04);
        let uv = (long - narrow) * sin * cos;
        let covariance = [[long * cos * cos + narrow * sin * sin, uv], [uv, long * sin * sin + narrow * cos * cos]];
        let corners = ellipse([100.0, 50.0], covariance).into_iter().map(|at| DVec2::from_array(at) - DVec2::new(100.0, 50.0));
        let corners: Vec<DVec2> = corners.collect();
        assert_eq!(corners.first(), corners.last());
        let reach = |towards: DVec2| corners.iter().map(|off| off.dot(towards)).fold(0.0, f64::max);
        let (along, across) = (DVec2::new(cos, sin), DVec2::new(-sin, cos));
        assert!((reach(along) - 10.0).abs() < 1e-9 && (reach(across) - 4.0).abs() < 0.02, "{} {}", reach(along), reach(across));
        // Along columns and rows it reaches as far as their own standard deviations.
        for (towards, variance) in [(DVec2::X, covariance[0][0]), (DVec2::Y, covariance[1][1])] {
            assert!((reach(towards) - 20.0 * variance.sqrt()).abs() < 0.1, "{towards}: {}", reach(towards));
        }
        assert!(reach(DVec2::new(cos, -sin)) < 8.0, "control: the mirrored ellipse would reach 10");
    }

    #[test]
    fn a_flagged_shadow_is_drawn_fainter() {
        let shadow = |flagged: bool| ShadowMark { rank: 1, image_px: [5.0, 5.0], radius_px: 3.0, snr: 9.0, flagged, bead: None };
        let marks = PairMarks { shadows: vec![shadow(false), shadow(true)], ..PairMarks::default() };
        let brightness: Vec<u32> =
            marks.figures().iter().map(|figure| figure.colour.iter().map(|channel| u32::from(*channel)).sum()).collect();
        assert!(brightness.len() == 2 && 4 * brightness[1] < 3 * brightness[0], "{brightness:?}");
    }

    #[test]
    fn arrows_have_heads_that_point_at_their_ends() {
        assert_eq!(arrow([0.0, 0.0], [3.0, 0.0]).len(), 1, "too short");
        let lines = arrow([10.0, 5.0], [30.0, 5.0]);
        assert_eq!(lines.len(), 3);
        for [end, back] in &lines[1..] {
            assert!(*end == [30.0, 5.0] && (back[0] - 25.0).abs() < 1e-12 && (back[1] - 5.0).abs() > 2.0, "{back:?}");
        }
    }
}
