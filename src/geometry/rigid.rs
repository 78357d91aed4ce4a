//! Rigid motions and their exponential map.

use glam::{DMat3, DMat4, DQuat, DVec3};

/// Why numbers are not a rigid transform.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RigidError {
    /// A number is NaN or infinite.
    #[error("transform holds a number that is not finite")]
    NotFinite,
    /// The upper left 3×3 is not a rotation.
    #[error("transform is not rigid: rotation part is off by {deviation:.2e} (limit {limit:.0e}), determinant {determinant:.6}{}", mirrors(*determinant))]
    NotRotation {
        /// Largest entry of |RᵀR − 1|.
        deviation: f64,
        /// What is accepted.
        limit: f64,
        /// Determinant of R; −1 means mirrored.
        determinant: f64,
    },
    /// The last row is not (0, 0, 0, 1).
    #[error("transform's last row is {found:?}, expected [0, 0, 0, 1]")]
    LastRow {
        /// The row found.
        found: [f64; 4],
    },
}

/// What else there is to say of a rotation part with this determinant.
fn mirrors(determinant: f64) -> &'static str {
    if determinant < 0.0 {
        "; it mirrors, which no rigid motion does: un-mirror the frame first, or turn one axis round"
    } else {
        ""
    }
}

/// A rotation and a translation in millimetres: `a_from_b` maps points in `b` to points in `a`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rigid {
    /// Unit quaternion.
    pub rotation: DQuat,
    /// Where b's origin lies in a.
    pub translation_mm: DVec3,
}

impl Rigid {
    /// Leaves every point where it is.
    pub const IDENTITY: Self = Self { rotation: DQuat::IDENTITY, translation_mm: DVec3::ZERO };

    /// A pure translation.
    #[must_use]
    pub const fn translation(translation_mm: DVec3) -> Self {
        Self { rotation: DQuat::IDENTITY, translation_mm }
    }

    /// A pure rotation.
    #[must_use]
    pub const fn rotation(rotation: DQuat) -> Self {
        Self { rotation, translation_mm: DVec3::ZERO }
    }

    /// `a_from_b.inverse()` is `b_from_a`.
    #[must_use]
    pub fn inverse(self) -> Self {
        let rotation = self.rotation.conjugate();
        Self { rotation, translation_mm: -(rotation * self.translation_mm) }
    }

    /// Maps a point.
    #[must_use]
    pub fn transform_point(&self, point_mm: DVec3) -> DVec3 {
        self.rotation * point_mm + self.translation_mm
    }

    /// Maps a direction: rotation only.
    #[must_use]
    pub fn transform_vector(&self, vector: DVec3) -> DVec3 {
        self.rotation * vector
    }

    /// Rotation as a matrix.
    #[must_use]
    pub fn rotation_matrix(&self) -> DMat3 {
        DMat3::from_quat(self.rotation)
    }

    /// Rows of the 4×4 matrix, as files have it.
    #[must_use]
    pub fn to_rows(&self) -> [[f64; 4]; 4] {
        let r = self.rotation_matrix();
        let t = self.translation_mm;
        [
            [r.x_axis.x, r.y_axis.x, r.z_axis.x, t.x],
            [r.x_axis.y, r.y_axis.y, r.z_axis.y, t.y],
            [r.x_axis.z, r.y_axis.z, r.z_axis.z, t.z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    }

    /// Reads rows of a 4×4 matrix; rotations off by no more than 1e-4 (rounded in a file) are made orthonormal.
    ///
    /// # Errors
    /// When a number is not finite, the rotation part is no rotation (or mirrors), or the last row is wrong.
    pub fn from_rows(rows: &[[f64; 4]; 4]) -> Result<Self, RigidError> {
        const LIMIT: f64 = 1e-4;
        if !rows.iter().flatten().all(|x| x.is_finite()) {
            return Err(RigidError::NotFinite);
        }
        if rows[3] != [0.0, 0.0, 0.0, 1.0] {
            return Err(RigidError::LastRow { found: rows[3] });
        }
        let matrix = DMat4::from_cols_array_2d(rows).transpose();
        let rotation = DMat3::from_mat4(matrix);
        let gram = rotation.transpose() * rotation - DMat3::IDENTITY;
        let deviation = gram.to_cols_array().iter().fold(0.0f64, |worst, x| worst.max(x.abs()));
        let determinant = rotation.determinant();
        if !(deviation <= LIMIT && determinant > 0.0) {
            return Err(RigidError::NotRotation { deviation, limit: LIMIT, determinant });
        }
        Ok(Self { rotation: DQuat::from_mat3(&nearest_rotation(rotation)).normalize(), translation_mm: matrix.w_axis.truncate() })
    }

    /// exp(ξ̂) for ξ = (ω, v): `ω` in radians, `v` in mm; the exponential map of SE(3).
    #[must_use]
    pub fn exp(omega_rad: DVec3, v_mm: DVec3) -> Self {
        let theta = omega_rad.length();
        // V = 1 + (1 − cos θ)/θ² [ω] + (θ − sin θ)/θ³ [ω]²; below 1e-4 the series is exact to double precision.
        let (b, c) = if theta < 1e-4 {
            (0.5 - theta * theta / 24.0, 1.0 / 6.0 - theta * theta / 120.0)
        } else {
            ((1.0 - theta.cos()) / (theta * theta), (theta - theta.sin()) / (theta * theta * theta))
        };
        let first = omega_rad.cross(v_mm);
        let translation_mm = v_mm + b * first + c * omega_rad.cross(first);
        Self { rotation: DQuat::from_scaled_axis(omega_rad), translation_mm }
    }

    /// (ω, v) with `Rigid::exp(ω, v) == self`; the rotation angle is at most π.
    #[must_use]
    pub fn log(&self) -> (DVec3, DVec3) {
        let rotation = if self.rotation.w < 0.0 { -self.rotation } else { self.rotation };
        let omega_rad = rotation.to_scaled_axis();
        let theta = omega_rad.length();
        // V⁻¹ = 1 − ½[ω] + (1/θ² − (1 + cos θ)/(2 θ sin θ)) [ω]²
        let c = if theta < 1e-4 {
            1.0 / 12.0 + theta * theta / 720.0
        } else {
            let half = 0.5 * theta;
            (1.0 - half * half.cos() / half.sin()) / (theta * theta)
        };
        let first = omega_rad.cross(self.translation_mm);
        (omega_rad, self.translation_mm - 0.5 * first + c * omega_rad.cross(first))
    }

    /// Between `self` (fraction 0) and `other` (1): shortest rotation, straight line of the origins.
    #[must_use]
    pub fn interpolate(&self, other: &Self, fraction: f64) -> Self {
        let towards = if self.rotation.dot(other.rotation) < 0.0 { -other.rotation } else { other.rotation };
        Self {
            rotation: self.rotation.slerp(towards, fraction).normalize(),
            translation_mm: self.translation_mm.lerp(other.translation_mm, fraction),
        }
    }

    /// Angle of the rotation between `self` and `other`, in [0, π] radians.
    #[must_use]
    pub fn angle_to_rad(&self, other: &Self) -> f64 {
        let difference = self.rotation.conjugate() * other.rotation;
        2.0 * difference.xyz().length().atan2(difference.w.abs())
    }
}

impl std::ops::Mul for Rigid {
    type Output = Self;

    /// `a_from_b * b_from_c` is `a_from_c`.
    fn mul(self, rhs: Self) -> Self {
        Self {
            rotation: (self.rotation * rhs.rotation).normalize(),
            translation_mm: self.rotation * rhs.translation_mm + self.translation_mm,
        }
    }
}

/// The rotation nearest to `matrix` in the Frobenius norm, by Newton's iteration for the polar factor.
fn nearest_rotation(matrix: DMat3) -> DMat3 {
    (0..8).fold(matrix, |r, _| (r + r.inverse().transpose()) * 0.5)
}

impl serde::Serialize for Rigid {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.to_rows().serialize(serializer)
    }
}

impl<'de> serde::Deserialize<'de> for Rigid {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let rows = <[[f64; 4]; 4]>::deserialize(deserializer)?;
        Self::from_rows(&rows).map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn close(a: Rigid, b: Rigid) -> bool {
        a.angle_to_rad(&b) < 1e-9 && a.translation_mm.distance(b.translation_mm) < 1e-9
    }

    #[test]
    fn inverse_undoes_and_rows_round_trip() {
        let a = Rigid::exp(DVec3::new(0.3, -1.2, 0.7), DVec3::new(10.0, -20.0, 5.0));
        assert!(close(a * a.inverse(), Rigid::IDENTITY));
        assert!(close(Rigid::from_rows(&a.to_rows()).expect("rigid"), a));
        assert!(!close(a, Rigid::IDENTITY));
    }

    #[test]
    fn log_inverts_exp_from_tiny_to_almost_half_a_turn() {
        let mut cases = 0;
        for scale in [1e-9, 1e-5, 1e-3, 0.5, 2.0, 3.1] {
            let (omega, v) = (DVec3::new(0.6, -0.48, 0.64) * scale, DVec3::new(3.0, -7.0, 11.0));
            let (omega_back, v_back) = Rigid::exp(omega, v).log();
            assert!(omega.distance(omega_back) < 1e-9 * (1.0 + scale), "{scale}");
            assert!(v.distance(v_back) < 1e-7, "{scale}: {v_back}");
            cases += 1;
        }
        assert_eq!(cases, 6);
    }

    #[test]
    fn mirrored_scaled_and_nan_matrices_are_refused() {
        let mut rows = Rigid::IDENTITY.to_rows();
        rows[0][0] = -1.0;
        assert!(matches!(Rigid::from_rows(&rows), Err(RigidError::NotRotation { .. })));
        rows[0][0] = 1.01;
        assert!(matches!(Rigid::from_rows(&rows), Err(RigidError::NotRotation { .. })));
        rows[0][0] = f64::NAN;
        assert!(matches!(Rigid::from_rows(&rows), Err(RigidError::NotFinite)));
    }
}
