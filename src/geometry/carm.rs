//! The C-arm's kinematic chain: joints to the pose of the camera in the room.

use glam::{DQuat, DVec2, DVec3};
use serde::{Deserialize, Serialize};

use super::joints::{CarmJoints, JOINT_KEYS};
use super::sag::{GravitySag, Misalignment, sag_terms};
use super::{Intrinsics, Rigid, turned_camera};

/// Why joints and calibration give no camera.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CarmCalibrationError {
    /// A joint that the chain needs was not measured.
    #[error("C-arm joint {joint} is not measured{}", stated(.joint))]
    NotMeasured {
        /// Key of the joint.
        joint: &'static str,
    },
    /// A length must be positive.
    #[error("C-arm calibration: {key} is {value}, it must be positive")]
    NotPositive {
        /// Key in the file.
        key: &'static str,
        /// Value found.
        value: f64,
    },
}

/// The calibration may state the distance, and no joint.
fn stated(joint: &str) -> &'static str {
    if joint == "source_to_detector_mm" { ", and the calibration does not state it" } else { "" }
}

/// A calibration file of `calibration/carm/`: geometry, detector and offsets of one C-arm.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CarmCalibration {
    /// Who measured it, when, with what.
    pub origin: String,
    /// Columns of the frames.
    pub columns_px: u32,
    /// Rows of the frames.
    pub rows_px: u32,
    /// Pixel pitch at the detector.
    pub pitch_mm: f64,
    /// Principal point; the middle of the frame if absent.
    #[serde(default)]
    pub principal_point_px: Option<[f64; 2]>,
    /// Focal spot to isocentre (SOD).
    pub source_to_isocentre_mm: f64,
    /// Used where the telemetry has no `source_to_detector_mm`.
    #[serde(default)]
    pub source_to_detector_mm: Option<f64>,
    /// From the column's axis to the isocentre, at zero.
    pub column_to_isocentre_mm: [f64; 3],
    /// Added to the joint readings; its own zero offsets where absent.
    #[serde(default)]
    pub offsets: JointOffsets,
    /// Non-isocentric arms: where the principal ray passes the isocentre, along camera x and y.
    #[serde(default)]
    pub principal_ray_offset_mm: [f64; 2],
    /// How far the picture is turned clockwise against the panel about the beam: the camera's axes are the picture's.
    #[serde(default)]
    pub picture_turn_deg: f64,
    /// Sag: displacement of the camera (mm, camera axes) and tilt (degrees) as linear functions of sin and cos of the C's angles.
    #[serde(default)]
    pub sag: Option<Sag>,
    /// How axes and detector stand to each other; as drawn where absent.
    #[serde(default, skip_serializing_if = "is_default")]
    pub misalignment: Misalignment,
    /// Gravity's effect as `calibrate carm` fits it; comes on top of `sag`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub gravity_sag: Option<GravitySag>,
    /// Standard deviation, per axis, of where joint readings put the isocentre in the camera, against the pose that beads give with this
    /// calibration's own K; K's error moves both alike and is not in it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera_sigma_mm: Option<f64>,
    /// Standard deviation, per axis, of the camera's attitude by joint readings, likewise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub camera_sigma_deg: Option<f64>,
    /// Standard deviation, per axis, of where joint readings put the isocentre in the true camera: K's error, which the beads of few shots
    /// hardly tell from a turn and a shift of the camera, is in it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub true_camera_sigma_mm: Option<f64>,
    /// Standard deviation, per axis, of the true camera's attitude by joint readings, likewise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub true_camera_sigma_deg: Option<f64>,
    /// Lowest and highest orbital reading, then those of the angulation, between which the standard deviations hold.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub calibrated_angles_deg: Option<[[f64; 2]; 2]>,
}

fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

/// What calibration adds to each joint reading.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct JointOffsets {
    /// See [`CarmJoints`].
    pub lift_mm: f64,
    /// See [`CarmJoints`].
    pub wig_wag_deg: f64,
    /// See [`CarmJoints`].
    pub longitudinal_mm: f64,
    /// See [`CarmJoints`].
    pub angulation_deg: f64,
    /// See [`CarmJoints`].
    pub orbital_deg: f64,
    /// See [`CarmJoints`].
    pub detector_rotation_deg: f64,
    /// See [`CarmJoints`].
    pub source_to_detector_mm: f64,
}

/// Gravity's effect: translation and rotation vector, each a row of coefficients of (sin orbital, cos orbital − 1, sin angulation).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sag {
    /// Rows x, y, z.
    pub translation_mm: [[f64; 3]; 3],
    /// Rows about x, y, z.
    pub rotation_deg: [[f64; 3]; 3],
}

impl CarmCalibration {
    /// The pose of the camera in the room:
    /// `T(longitudinal, 0, lift) · Rz(wig_wag) · T(column_to_isocentre) · Rx(angulation) · Ry(orbital) · T(0, 0, −SOD) · Rz(detector_rotation)`,
    /// with [`Misalignment`] beside the axes and [`GravitySag`] before the detector's rotation; then sag, then the picture's turn.
    ///
    /// # Errors
    /// When a joint is not measured.
    pub fn world_from_camera(&self, joints: &CarmJoints) -> Result<Rigid, CarmCalibrationError> {
        for ((joint, _), value) in JOINT_KEYS.iter().zip(joints.to_array()).take(6) {
            if !value.is_finite() {
                return Err(CarmCalibrationError::NotMeasured { joint });
            }
        }
        let o = &self.offsets;
        let angulation = joints.angulation_rad + o.angulation_deg.to_radians();
        let orbital = joints.orbital_rad + o.orbital_deg.to_radians();
        let wig_wag = joints.wig_wag_rad + o.wig_wag_deg.to_radians();
        let detector_rotation = joints.detector_rotation_rad + o.detector_rotation_deg.to_radians();
        let [ray_x, ray_y] = self.principal_ray_offset_mm;
        let m = &self.misalignment;
        let (source, c_from_panel, _) = self.bent(angulation, orbital, detector_rotation);
        let carriage = DVec3::new(joints.longitudinal_mm + o.longitudinal_mm, 0.0, joints.lift_mm + o.lift_mm);
        let mut ideal = Rigid::translation(carriage)
            * Rigid::rotation(DQuat::from_rotation_z(wig_wag))
            * Rigid::translation(DVec3::from_array(self.column_to_isocentre_mm));
        // What is as drawn is left out: a product with nothing still rounds.
        if m.angulation_axis_tilt_deg != 0.0 {
            ideal = ideal * Rigid::rotation(DQuat::from_rotation_y(m.angulation_axis_tilt_deg.to_radians()));
        }
        ideal = ideal * Rigid::rotation(DQuat::from_rotation_x(angulation));
        if (m.orbital_axis_skew_deg, m.orbital_axis_offset_mm) != (0.0, 0.0) {
            let rotation = DQuat::from_rotation_z(m.orbital_axis_skew_deg.to_radians());
            ideal = ideal * Rigid { rotation, translation_mm: DVec3::new(0.0, 0.0, m.orbital_axis_offset_mm) };
        }
        let ideal = ideal
            * Rigid::rotation(DQuat::from_rotation_y(orbital))
            * Rigid::translation(DVec3::new(ray_x, ray_y, -self.source_to_isocentre_mm) + source)
            * Rigid::rotation(c_from_panel);
        let picture = |camera: Rigid| match self.picture_turn_deg {
            0.0 => camera,
            turn => camera * turned_camera(turn.to_radians()).inverse(),
        };
        let Some(sag) = &self.sag else { return Ok(picture(ideal)) };
        let basis = DVec3::new(orbital.sin(), orbital.cos() - 1.0, angulation.sin());
        let apply = |rows: &[[f64; 3]; 3]| DVec3::from_array(rows.map(|row| DVec3::from_array(row).dot(basis)));
        let rotation_rad = apply(&sag.rotation_deg).map(f64::to_radians);
        Ok(picture(ideal * Rigid { rotation: DQuat::from_scaled_axis(rotation_rad), translation_mm: apply(&sag.translation_mm) }))
    }

    /// K: focal length from the distance and the pitch; where the arm sags, distance and principal point with the angles.
    ///
    /// # Errors
    /// When neither telemetry nor calibration gives the distance, a length is not positive, or sag needs an angle that is not measured.
    pub fn intrinsics(&self, joints: &CarmJoints) -> Result<Intrinsics, CarmCalibrationError> {
        let measured = joints.source_to_detector_mm.is_finite().then_some(joints.source_to_detector_mm);
        let distance_mm = measured
            .or(self.source_to_detector_mm)
            .ok_or(CarmCalibrationError::NotMeasured { joint: "source_to_detector_mm" })?
            + self.offsets.source_to_detector_mm;
        let middle_mm = self.middle_from_source_mm(joints, distance_mm)?;
        for (key, value) in [("pitch_mm", self.pitch_mm), ("source_to_detector_mm", middle_mm.z)] {
            if !(value > 0.0 && value.is_finite()) {
                return Err(CarmCalibrationError::NotPositive { key, value });
            }
        }
        let middle = [f64::from(self.columns_px) * 0.5 - 0.5, f64::from(self.rows_px) * 0.5 - 0.5];
        let [cx, cy] = self.principal_point_px.unwrap_or(middle);
        let focal = middle_mm.z / self.pitch_mm;
        // The panel goes one way, the foot of the principal ray the other way on it.
        let foot_mm = match self.picture_turn_deg {
            0.0 => middle_mm.truncate(),
            turn => DVec2::from_angle(turn.to_radians()).rotate(middle_mm.truncate()),
        };
        let (cx, cy) = (cx - foot_mm.x / self.pitch_mm, cy - foot_mm.y / self.pitch_mm);
        Ok(Intrinsics { fx: focal, fy: focal, skew: 0.0, cx, cy })
    }

    /// How the focal spot moves in the C's axes, how the panel stands in them, and how the panel's middle moves against the focal spot.
    fn bent(&self, angulation: f64, orbital: f64, detector_rotation: f64) -> (DVec3, DQuat, DVec3) {
        let in_plane = DQuat::from_rotation_z(detector_rotation);
        let [tilt_x, tilt_y] = self.misalignment.detector_tilt_deg.map(f64::to_radians);
        let tilt = DQuat::from_scaled_axis(DVec3::new(tilt_x, tilt_y, 0.0));
        let Some(sag) = &self.gravity_sag else { return (DVec3::ZERO, tilt * in_plane, DVec3::ZERO) };
        let terms = sag_terms(angulation, orbital);
        let turn = DQuat::from_scaled_axis(GravitySag::at(&sag.rotation_deg, &terms).map(f64::to_radians));
        let source = GravitySag::at(&sag.source_mm, &terms);
        (source, turn * tilt * in_plane, GravitySag::at(&sag.detector_mm, &terms) - source)
    }

    /// From the focal spot to the panel's middle in the panel's axes: the distance and the foot of the principal ray follow from it. Plain
    /// where nothing bends and nothing is tilted.
    fn middle_from_source_mm(&self, joints: &CarmJoints, distance_mm: f64) -> Result<DVec3, CarmCalibrationError> {
        let [offset_x, offset_y] = self.misalignment.detector_offset_mm;
        let straight = DVec3::new(offset_x, offset_y, distance_mm);
        if self.gravity_sag.is_none() && self.misalignment == Misalignment::default() {
            return Ok(straight);
        }
        for index in [3, 4, 5] {
            if !joints.to_array()[index].is_finite() {
                return Err(CarmCalibrationError::NotMeasured { joint: JOINT_KEYS[index].0 });
            }
        }
        let o = &self.offsets;
        let (_, c_from_panel, moved) = self.bent(
            joints.angulation_rad + o.angulation_deg.to_radians(),
            joints.orbital_rad + o.orbital_deg.to_radians(),
            joints.detector_rotation_rad + o.detector_rotation_deg.to_radians(),
        );
        Ok(c_from_panel.conjugate() * (straight + moved))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn calibration() -> CarmCalibration {
        serde_json::from_value(serde_json::json!({
            "origin": "test", "columns_px": 620, "rows_px": 480, "pitch_mm": 0.5, "source_to_isocentre_mm": 600.0,
            "source_to_detector_mm": 1000.0, "column_to_isocentre_mm": [800.0, 0.0, 1000.0]
        }))
        .expect("valid")
    }

    #[test]
    fn at_zero_the_source_is_below_and_the_axes_are_parallel() {
        let camera = calibration().world_from_camera(&CarmJoints::ZERO).expect("all measured");
        assert!(camera.translation_mm.distance(DVec3::new(800.0, 0.0, 400.0)) < 1e-9);
        assert!(camera.angle_to_rad(&Rigid::IDENTITY) < 1e-12);
    }

    #[test]
    fn the_isocentre_stays_on_the_principal_ray_while_the_c_moves() {
        let mut cases = 0;
        for (orbital, angulation) in [(30.0f64, 0.0f64), (-90.0, 20.0), (170.0, -15.0)] {
            let joints =
                CarmJoints { orbital_rad: orbital.to_radians(), angulation_rad: angulation.to_radians(), ..CarmJoints::ZERO };
            let camera = calibration().world_from_camera(&joints).expect("all measured");
            let isocentre = camera.inverse().transform_point(DVec3::new(800.0, 0.0, 1000.0));
            assert!(isocentre.distance(DVec3::new(0.0, 0.0, 600.0)) < 1e-9);
            cases += 1;
        }
        assert_eq!(cases, 3);
    }

    #[test]
    fn without_sag_and_misalignment_the_chain_is_the_plain_one_bit_for_bit() {
        let c = calibration();
        let text = serde_json::to_string(&c).expect("serialises");
        assert!(!text.contains("misalignment") && !text.contains("gravity_sag") && !text.contains("camera_sigma"), "{text}");
        for n in 1..40 {
            let n = f64::from(n);
            let joints = CarmJoints::from_array([n, 0.01 * n, -n, 0.02 * n, -0.07 * n, 0.1 * n, 1000.0 + n]);
            let plain = Rigid::translation(DVec3::new(-n, 0.0, n))
                * Rigid::rotation(DQuat::from_rotation_z(0.01 * n))
                * Rigid::translation(DVec3::new(800.0, 0.0, 1000.0))
                * Rigid::rotation(DQuat::from_rotation_x(0.02 * n))
                * Rigid::rotation(DQuat::from_rotation_y(-0.07 * n))
                * Rigid::translation(DVec3::new(0.0, 0.0, -600.0))
                * Rigid::rotation(DQuat::from_rotation_z(0.1 * n));
            assert_eq!(c.world_from_camera(&joints).expect("all measured"), plain);
            let k = c.intrinsics(&joints).expect("all measured");
            assert_eq!((k.fx, k.cx, k.cy), ((1000.0 + n) / 0.5, 309.5, 239.5));
        }
    }

    #[test]
    fn a_sagging_detector_moves_the_foot_of_the_principal_ray_in_the_turned_panel() {
        let mut sag = GravitySag::default();
        sag.detector_mm[0][0] = 10.0;
        let c = CarmCalibration { gravity_sag: Some(sag), ..calibration() };
        let joints = CarmJoints { orbital_rad: 30f64.to_radians(), ..CarmJoints::ZERO };
        let k = c.intrinsics(&joints).expect("measured");
        // 10 mm · sin 30°, 0.5 mm a pixel.
        assert!((k.cx - 299.5).abs() < 1e-9 && (k.cy - 239.5).abs() < 1e-9, "{k:?}");
        let turned = CarmJoints { detector_rotation_rad: 90f64.to_radians(), ..joints };
        // The C's x is the turned panel's −y.
        let k = c.intrinsics(&turned).expect("measured");
        assert!((k.cx - 309.5).abs() < 1e-9 && (k.cy - 249.5).abs() < 1e-9, "{k:?}");
        assert!(c.intrinsics(&CarmJoints { orbital_rad: f64::NAN, ..joints }).is_err());
    }

    #[test]
    fn a_missing_encoder_is_named() {
        let joints = CarmJoints { orbital_rad: f64::NAN, ..CarmJoints::ZERO };
        let error = calibration().world_from_camera(&joints).expect_err("orbital is missing");
        assert_eq!(error.to_string(), "C-arm joint orbital_deg is not measured");
        let unstated = CarmCalibration { source_to_detector_mm: None, ..calibration() };
        let error = unstated.intrinsics(&CarmJoints { source_to_detector_mm: f64::NAN, ..joints }).expect_err("nobody says it");
        assert!(error.to_string().contains("source_to_detector_mm is not measured, and the calibration does not state it"));
    }
}
