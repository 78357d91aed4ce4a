//! C-arm angles in the conventions of DICOM, DeepDRR, xReg and of our own joints.
//!
//! Three angles fix how the camera is turned. Each convention names two that aim the beam and one that turns the detector in its plane:
//!
//! | convention | first | second | third | turned in |
//! |---|---|---|---|---|
//! | `dicom` | primary, + = LAO | secondary, + = CRA | detector, right-handed about the beam | the patient |
//! | `device` | angulation, about world x | orbital, about world y | detector rotation | the room of [`super::CarmCalibration`] |
//! | `deepdrr` | alpha, about device x | beta, about device y | gamma, left-handed about the beam | the world of its `MobileCArm` |
//! | `xreg` | tilt, about z | orbital, about x | detector, right-handed about the beam | the C-arm's isocentre frame |
//!
//! - `dicom`: at (0, 0, 0) the detector is anterior, columns run to the patient's right and rows to the feet. DICOM itself says nothing
//!   of the third angle. Its angles follow the patient, the others the room, so only these depend on how the patient lies.
//! - `device`: the table runs along world y. Head first: the head points to +y.
//! - `deepdrr`: `Volume.supine()` and `Volume.prone()` point the head to −x of the world; lying so (head first), alpha + is RAO and beta +
//!   is caudal, as its documentation says. Its own `orient_patient` turns the patient by 90° about the vertical.
//! - `xreg`: documented are the orbital turn about the extrinsic frame's x, and the nominal extrinsic of its C-arm (columns along +z, rows
//!   along −x, detector at +y). The tilt, and the head at +x of the frame, are our reading. Camera axes are ours, unmirrored.

use glam::{DMat3, DQuat, DVec3};

/// How the patient lies on the table (DICOM patient position).
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub enum PatientPosition {
    /// Head first, supine.
    #[serde(rename = "HFS")]
    HeadFirstSupine,
    /// Head first, prone.
    #[serde(rename = "HFP")]
    HeadFirstProne,
    /// Feet first, supine.
    #[serde(rename = "FFS")]
    FeetFirstSupine,
    /// Feet first, prone.
    #[serde(rename = "FFP")]
    FeetFirstProne,
}

impl PatientPosition {
    /// All four.
    pub const ALL: [Self; 4] = [Self::HeadFirstSupine, Self::HeadFirstProne, Self::FeetFirstSupine, Self::FeetFirstProne];

    /// As in DICOM.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::HeadFirstSupine => "HFS",
            Self::HeadFirstProne => "HFP",
            Self::FeetFirstSupine => "FFS",
            Self::FeetFirstProne => "FFP",
        }
    }

    /// Rotation from `lps` to a room in which a head points to `head` and an upright face to `up`.
    fn room_from_lps(self, head: DVec3, up: DVec3) -> DQuat {
        let superior = match self {
            Self::HeadFirstSupine | Self::HeadFirstProne => head,
            Self::FeetFirstSupine | Self::FeetFirstProne => -head,
        };
        let posterior = match self {
            Self::HeadFirstSupine | Self::FeetFirstSupine => -up,
            Self::HeadFirstProne | Self::FeetFirstProne => up,
        };
        DQuat::from_mat3(&DMat3::from_cols(posterior.cross(superior), posterior, superior))
    }
}

impl std::str::FromStr for PatientPosition {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        let known = || Self::ALL.map(Self::name).join(", ");
        let word = word.to_uppercase();
        Self::ALL.into_iter().find(|position| position.name() == word).ok_or_else(|| format!("expected one of {}", known()))
    }
}

/// Whose angles.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum AngleConvention {
    /// Positioner angles of DICOM, relative to the patient.
    Dicom,
    /// Our joints.
    Device,
    /// DeepDRR's `MobileCArm`.
    DeepDrr,
    /// xReg's C-arm frame.
    Xreg,
}

/// Three angles of one convention.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CarmAngles {
    /// See the table of the module.
    pub first_rad: f64,
    /// See the table of the module.
    pub second_rad: f64,
    /// See the table of the module.
    pub third_rad: f64,
}

impl CarmAngles {
    /// From degrees.
    #[must_use]
    pub fn from_degrees([first, second, third]: [f64; 3]) -> Self {
        Self { first_rad: first.to_radians(), second_rad: second.to_radians(), third_rad: third.to_radians() }
    }

    /// In degrees.
    #[must_use]
    pub fn to_degrees(self) -> [f64; 3] {
        [self.first_rad, self.second_rad, self.third_rad].map(f64::to_degrees)
    }
}

impl AngleConvention {
    /// All four.
    pub const ALL: [Self; 4] = [Self::Dicom, Self::Device, Self::DeepDrr, Self::Xreg];

    /// As in files.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Dicom => "dicom",
            Self::Device => "device",
            Self::DeepDrr => "deepdrr",
            Self::Xreg => "xreg",
        }
    }

    /// What its three angles are called.
    #[must_use]
    pub fn angle_names(self) -> [&'static str; 3] {
        match self {
            Self::Dicom => ["primary", "secondary", "detector"],
            Self::Device => ["angulation", "orbital", "detector_rotation"],
            Self::DeepDrr => ["alpha", "beta", "gamma"],
            Self::Xreg => ["tilt", "orbital", "detector"],
        }
    }

    /// Rotation of the camera in the patient: `lps` axes of a direction given in camera axes.
    #[must_use]
    pub fn lps_from_camera(self, angles: CarmAngles, position: PatientPosition) -> DQuat {
        let about_beam = DQuat::from_rotation_z(self.third_sign() * angles.third_rad);
        let room_from_camera = self.aim(angles.first_rad, angles.second_rad) * self.room_from_camera_at_zero() * about_beam;
        (self.room_from_lps(position).conjugate() * room_from_camera).normalize()
    }

    /// The angles of a camera that is turned so in the patient; the inverse of [`AngleConvention::lps_from_camera`].
    ///
    /// One of the two aiming angles is in [−90°, 90°]: DICOM's secondary, our angulation, DeepDRR's alpha, xReg's tilt. Where it is ±90° the
    /// other is 0.
    #[must_use]
    pub fn angles(self, lps_from_camera: DQuat, position: PatientPosition) -> CarmAngles {
        let room_from_camera = self.room_from_lps(position) * lps_from_camera;
        let beam = room_from_camera * DVec3::Z;
        let (first_rad, second_rad) = self.aimed_at(beam);
        let rest = (self.aim(first_rad, second_rad) * self.room_from_camera_at_zero()).conjugate() * room_from_camera;
        let columns = rest * DVec3::X;
        CarmAngles { first_rad, second_rad, third_rad: self.third_sign() * columns.y.atan2(columns.x) }
    }

    /// These angles in another convention.
    #[must_use]
    pub fn convert(self, angles: CarmAngles, to: Self, position: PatientPosition) -> CarmAngles {
        to.angles(self.lps_from_camera(angles, position), position)
    }

    /// Sense of the third angle about the beam.
    fn third_sign(self) -> f64 {
        // DeepDRR turns camera coordinates by gamma, hence the camera by −gamma.
        if self == Self::DeepDrr { -1.0 } else { 1.0 }
    }

    /// The rotation that aims the beam.
    fn aim(self, first_rad: f64, second_rad: f64) -> DQuat {
        match self {
            Self::Dicom => DQuat::from_rotation_z(first_rad) * DQuat::from_rotation_x(-second_rad),
            Self::Device => DQuat::from_rotation_x(first_rad) * DQuat::from_rotation_y(second_rad),
            Self::DeepDrr => DQuat::from_rotation_y(second_rad) * DQuat::from_rotation_x(first_rad),
            Self::Xreg => DQuat::from_rotation_z(first_rad) * DQuat::from_rotation_x(second_rad),
        }
    }

    /// The two angles that aim along `beam` (in the room).
    fn aimed_at(self, beam: DVec3) -> (f64, f64) {
        // A numerical beam almost along the axis of the outer turn leaves that turn free: it is 0.
        let free = |a: f64, b: f64| a.hypot(b) < 1e-12;
        match self {
            // (sin p cos s, −cos p cos s, sin s)
            Self::Dicom => {
                let first = if free(beam.x, beam.y) { 0.0 } else { beam.x.atan2(-beam.y) };
                (first, beam.z.atan2(beam.x.hypot(beam.y)))
            }
            // (sin o, −sin a cos o, cos a cos o); a ∈ [−90°, 90°], as a C passes the floor by its orbit and not by its tilt.
            Self::Device => {
                let flat = beam.y.hypot(beam.z);
                let under = if beam.z < 0.0 { -1.0 } else { 1.0 };
                let angulation = if free(beam.y, beam.z) { 0.0 } else { (-beam.y * under).atan2(beam.z * under) };
                (angulation, beam.x.atan2(under * flat))
            }
            // (sin β cos α, −sin α, cos β cos α)
            Self::DeepDrr => {
                let beta = if free(beam.x, beam.z) { 0.0 } else { beam.x.atan2(beam.z) };
                ((-beam.y).atan2(beam.x.hypot(beam.z)), beta)
            }
            // (−sin t cos o, cos t cos o, sin o); t ∈ [−90°, 90°].
            Self::Xreg => {
                let flat = beam.x.hypot(beam.y);
                let under = if beam.y < 0.0 { -1.0 } else { 1.0 };
                let tilt = if free(beam.x, beam.y) { 0.0 } else { (-beam.x * under).atan2(beam.y * under) };
                (tilt, beam.z.atan2(under * flat))
            }
        }
    }

    /// Camera axes in the room when all angles are 0.
    fn room_from_camera_at_zero(self) -> DQuat {
        let axes = |columns: DVec3, rows: DVec3| DQuat::from_mat3(&DMat3::from_cols(columns, rows, columns.cross(rows)));
        match self {
            Self::Dicom => axes(-DVec3::X, -DVec3::Z),
            Self::Device => axes(DVec3::X, DVec3::Y),
            // Its camera is turned by 90° about the beam, so that rows run along +x of the device: to the feet of a patient lying head first.
            Self::DeepDrr => axes(-DVec3::Y, DVec3::X),
            Self::Xreg => axes(-DVec3::Z, -DVec3::X),
        }
    }

    fn room_from_lps(self, position: PatientPosition) -> DQuat {
        match self {
            Self::Dicom => DQuat::IDENTITY,
            Self::Device => position.room_from_lps(DVec3::Y, DVec3::Z),
            Self::DeepDrr => position.room_from_lps(-DVec3::X, DVec3::Z),
            Self::Xreg => position.room_from_lps(DVec3::X, DVec3::Y),
        }
    }
}
