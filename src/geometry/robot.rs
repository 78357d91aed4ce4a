//! The snake robot's kinematics: five control angles to the poses of its 28 rigid pieces (Gao et al. 2021's model, DESIGN §4).

use glam::{DQuat, DVec3};
use serde::{Deserialize, Serialize};

use super::Rigid;

/// Control angles of the spline.
pub const CONTROL_COUNT: usize = 5;

/// Why a robot model file is unusable.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RobotModelError {
    /// A size must be positive.
    #[error("robot model: {key} is {value}, it must be positive")]
    NotPositive {
        /// Key in the file.
        key: &'static str,
        /// Value found.
        value: f64,
    },
    /// The lumen must be narrower than the tube.
    #[error("robot model: inner diameter {inner_mm} mm is not smaller than outer diameter {outer_mm} mm")]
    Lumen {
        /// Inner diameter.
        inner_mm: f64,
        /// Outer diameter.
        outer_mm: f64,
    },
    /// A control angle is not a number.
    #[error("control angle {index} is {value_deg} deg, it must be finite")]
    Angle {
        /// Which of the five.
        index: usize,
        /// Value found.
        value_deg: f64,
    },
}

/// A robot model file of `calibration/robot/`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotModel {
    /// Who measured it, when, with what.
    pub origin: String,
    /// Notches; pieces are one more.
    pub notch_count: usize,
    /// Distance of notch centres.
    pub pitch_mm: f64,
    /// Length of the notched body.
    pub length_mm: f64,
    /// Bends are clamped to ± this.
    pub max_bend_deg: f64,
    /// The notched tube.
    pub body: TubeSize,
    /// The flexible core inside the lumen, along the body.
    pub shaft: TubeSize,
    /// The cutter beyond the tip.
    pub drill: TubeSize,
}

/// Size and material of a tube or rod.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TubeSize {
    /// Outer diameter.
    #[serde(alias = "diameter_mm")]
    pub outer_diameter_mm: f64,
    /// Diameter of the lumen; 0 for a rod.
    #[serde(default)]
    pub inner_diameter_mm: f64,
    /// Its own length; absent for parts as long as the body.
    #[serde(default)]
    pub length_mm: Option<f64>,
    /// Name as in the materials table.
    pub material: String,
}

/// Where everything is for given control angles.
#[derive(Clone, Debug, PartialEq)]
pub struct RobotShape {
    /// Start (piece's origin, +z along it) and length in mm of each rigid piece, base first.
    pub base_from_pieces: Vec<(Rigid, f64)>,
    /// End of the body, +z onward; the drill starts here.
    pub base_from_body_end: Rigid,
    /// Drill tip.
    pub base_from_tip: Rigid,
    /// Bend of each notch after clamping.
    pub notch_bends_deg: Vec<f64>,
    /// Notches that were clamped.
    pub clamped: usize,
}

impl RobotModel {
    /// Whether both are the same robot, whoever measured it: a log that was redacted does not say that any more.
    #[must_use]
    pub fn is_like(&self, other: &Self) -> bool {
        Self { origin: other.origin.clone(), ..self.clone() } == *other
    }

    /// Checks what JSON cannot.
    ///
    /// # Errors
    /// When a size is not positive or a lumen is wider than its tube.
    pub fn check(&self) -> Result<(), RobotModelError> {
        let sizes = [
            ("notch_count", self.notch_count as f64),
            ("pitch_mm", self.pitch_mm),
            ("length_mm", self.length_mm),
            ("max_bend_deg", self.max_bend_deg),
            ("body.outer_diameter_mm", self.body.outer_diameter_mm),
            ("shaft.diameter_mm", self.shaft.outer_diameter_mm),
            ("drill.diameter_mm", self.drill.outer_diameter_mm),
            ("drill.length_mm", self.drill.length_mm.unwrap_or(f64::NAN)),
        ];
        for (key, value) in sizes {
            if !(value > 0.0 && value.is_finite()) {
                return Err(RobotModelError::NotPositive { key, value });
            }
        }
        for tube in [&self.body, &self.shaft, &self.drill] {
            if !(tube.inner_diameter_mm >= 0.0 && tube.inner_diameter_mm < tube.outer_diameter_mm) {
                return Err(RobotModelError::Lumen { inner_mm: tube.inner_diameter_mm, outer_mm: tube.outer_diameter_mm });
            }
        }
        Ok(())
    }

    /// Bend of each notch in degrees before clamping: a natural cubic spline through the control angles at notch indices
    /// (n − 1)·k/6, k = 1..5, constant outside the first and last of them.
    #[must_use]
    pub fn spline_deg(&self, control_angles_deg: &[f64; CONTROL_COUNT]) -> Vec<f64> {
        let spacing = (self.notch_count as f64 - 1.0) / 6.0;
        let second = natural_second_derivatives(control_angles_deg);
        let bend = |notch: usize| {
            let position = (notch as f64 / spacing - 1.0).clamp(0.0, (CONTROL_COUNT - 1) as f64);
            let knot = (position as usize).min(CONTROL_COUNT - 2);
            let b = position - knot as f64;
            let a = 1.0 - b;
            let (y0, y1) = (control_angles_deg[knot], control_angles_deg[knot + 1]);
            a * y0 + b * y1 + ((a * a * a - a) * second[knot] + (b * b * b - b) * second[knot + 1]) / 6.0
        };
        (0..self.notch_count).map(bend).collect()
    }

    /// The shape for five control angles in degrees.
    ///
    /// # Errors
    /// When an angle is not finite.
    pub fn shape(&self, control_angles_deg: &[f64; CONTROL_COUNT]) -> Result<RobotShape, RobotModelError> {
        self.loaded_shape(control_angles_deg, [0.0; 2])
    }

    /// The same under a load across the bending plane: each notch turns about its own +x as well, by `sideways_deg` at the first and at
    /// the last notch and linearly between them.
    ///
    /// # Errors
    /// When a control angle is not finite.
    pub fn loaded_shape(
        &self,
        control_angles_deg: &[f64; CONTROL_COUNT],
        sideways_deg: [f64; 2],
    ) -> Result<RobotShape, RobotModelError> {
        if let Some(index) = control_angles_deg.iter().position(|angle| !angle.is_finite()) {
            return Err(RobotModelError::Angle { index, value_deg: control_angles_deg[index] });
        }
        let wanted = self.spline_deg(control_angles_deg);
        let notch_bends_deg: Vec<f64> = wanted.iter().map(|bend| bend.clamp(-self.max_bend_deg, self.max_bend_deg)).collect();
        let clamped = wanted.iter().zip(&notch_bends_deg).filter(|(a, b)| a != b).count();
        // Pivot i lies at z = (i + ½)·pitch of the straight robot; piece i runs from pivot i − 1 to pivot i, and what the pitch
        // leaves at either end belongs to the first and the last piece.
        let mut base_from_pieces = Vec::with_capacity(self.notch_count + 1);
        let mut base_from_piece = Rigid::IDENTITY;
        let mut start_mm = 0.0;
        for (notch, bend_deg) in notch_bends_deg.iter().enumerate() {
            let pivot_mm = (notch as f64 + 0.5) * self.pitch_mm;
            base_from_pieces.push((base_from_piece, pivot_mm - start_mm));
            let along = notch as f64 / (self.notch_count as f64 - 1.0).max(1.0);
            let across_deg = sideways_deg[0] + (sideways_deg[1] - sideways_deg[0]) * along;
            let bend = DQuat::from_rotation_y(bend_deg.to_radians()) * DQuat::from_rotation_x(across_deg.to_radians());
            base_from_piece =
                base_from_piece * Rigid::translation(DVec3::new(0.0, 0.0, pivot_mm - start_mm)) * Rigid::rotation(bend);
            start_mm = pivot_mm;
        }
        let last_mm = self.length_mm - start_mm;
        base_from_pieces.push((base_from_piece, last_mm));
        let base_from_body_end = base_from_piece * Rigid::translation(DVec3::new(0.0, 0.0, last_mm));
        let drill_mm = self.drill.length_mm.unwrap_or(0.0);
        let base_from_tip = base_from_body_end * Rigid::translation(DVec3::new(0.0, 0.0, drill_mm));
        Ok(RobotShape { base_from_pieces, base_from_body_end, base_from_tip, notch_bends_deg, clamped })
    }
}

/// Second derivatives of the natural cubic spline through values at unit spacing (zero at both ends).
fn natural_second_derivatives(values: &[f64; CONTROL_COUNT]) -> [f64; CONTROL_COUNT] {
    // Tridiagonal system: m[i−1] + 4 m[i] + m[i+1] = 6 (y[i−1] − 2 y[i] + y[i+1]), solved by elimination.
    let mut upper = [0.0; CONTROL_COUNT];
    let mut right = [0.0; CONTROL_COUNT];
    for i in 1..CONTROL_COUNT - 1 {
        let pivot = 4.0 - upper[i - 1];
        upper[i] = 1.0 / pivot;
        right[i] = (6.0 * (values[i - 1] - 2.0 * values[i] + values[i + 1]) - right[i - 1]) / pivot;
    }
    let mut second = [0.0; CONTROL_COUNT];
    for i in (1..CONTROL_COUNT - 1).rev() {
        second[i] = right[i] - upper[i] * second[i + 1];
    }
    second
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model() -> RobotModel {
        serde_json::from_value(serde_json::json!({
            "origin": "test", "notch_count": 27, "pitch_mm": 35.0 / 27.0, "length_mm": 35.0, "max_bend_deg": 7.9,
            "body": {"outer_diameter_mm": 6.0, "inner_diameter_mm": 4.0, "material": "nitinol"},
            "shaft": {"diameter_mm": 2.0, "material": "steel_316l"},
            "drill": {"diameter_mm": 5.0, "length_mm": 4.0, "material": "steel_316l"}
        }))
        .expect("valid")
    }

    #[test]
    fn straight_robot_ends_where_its_lengths_say() {
        let shape = model().shape(&[0.0; 5]).expect("finite");
        assert_eq!(shape.base_from_pieces.len(), 28);
        assert!(shape.base_from_tip.translation_mm.distance(DVec3::new(0.0, 0.0, 39.0)) < 1e-9);
        assert_eq!(shape.clamped, 0);
    }

    #[test]
    fn equal_bends_accumulate_about_y_towards_x() {
        let shape = model().shape(&[2.0; 5]).expect("finite");
        assert!((shape.base_from_tip.angle_to_rad(&Rigid::IDENTITY).to_degrees() - 54.0).abs() < 1e-9);
        assert!(shape.base_from_tip.translation_mm.x > 5.0 && shape.base_from_tip.translation_mm.y.abs() < 1e-12);
    }

    #[test]
    fn a_load_across_the_plane_bends_the_straight_robot_out_of_it() {
        let shape = model().loaded_shape(&[0.0; 5], [0.2, 0.0]).expect("finite");
        // 27 notches, on average 0.1 degrees, all of them about −x towards −y; the first turn the tip most.
        let tip = shape.base_from_tip.translation_mm;
        assert!((shape.base_from_tip.angle_to_rad(&Rigid::IDENTITY).to_degrees() - 2.7).abs() < 1e-9);
        assert!(tip.y < -1.0 && tip.x.abs() < 1e-12, "{tip}");
    }

    #[test]
    fn the_spline_passes_its_knots_and_bends_are_clamped() {
        // A 25-notch robot has its knots on notches 4, 8, 12, 16, 20.
        let robot = RobotModel { notch_count: 25, ..model() };
        let angles = [1.0, -2.0, 9.0, 0.5, 3.0];
        let bends = robot.spline_deg(&angles);
        for (k, angle) in angles.iter().enumerate() {
            assert!((bends[4 * (k + 1)] - angle).abs() < 1e-12);
        }
        assert_eq!((bends[0], bends[24]), (1.0, 3.0), "constant outside");
        assert!(robot.shape(&angles).expect("finite").clamped > 0);
    }

    #[test]
    fn nan_is_refused() {
        assert!(matches!(model().shape(&[0.0, f64::NAN, 0.0, 0.0, 0.0]), Err(RobotModelError::Angle { index: 1, .. })));
    }
}
