//! Pinhole cameras: intrinsics, projection matrices, views. The centre of the first pixel is (0, 0).

use glam::{DMat3, DQuat, DVec2, DVec3};

use super::Rigid;

/// Why numbers are not a camera.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum CameraError {
    /// A number is NaN or infinite.
    #[error("{what} holds a number that is not finite")]
    NotFinite {
        /// Which matrix.
        what: &'static str,
    },
    /// The focal lengths must be positive.
    #[error("focal length is ({fx}, {fy}) px, both must be positive")]
    Focal {
        /// Horizontal.
        fx: f64,
        /// Vertical.
        fy: f64,
    },
    /// K must be upper triangular with 1 in the corner.
    #[error("intrinsics are not upper triangular with a last row of [0, 0, 1]: {found:?}")]
    NotUpperTriangular {
        /// Rows found.
        found: [[f64; 3]; 3],
    },
    /// The left 3×3 of P is singular: the focal spot lies at infinity.
    #[error("projection matrix is singular: determinant {determinant:.3e} of its left 3x3, the focal spot lies at infinity")]
    Singular {
        /// Determinant of the left 3×3 after scaling.
        determinant: f64,
    },
    /// P mirrors the image.
    #[error("projection matrix mirrors the image; un-mirror the frame first")]
    Mirrored,
    /// Focal lengths, skew or principal point that no X-ray camera has.
    #[error(
        "intrinsics see pixel ({u}, {v}) {slope:.3e} mm off the axis per mm of depth, expected at most {limit}; \
         are focal length, skew and principal point in px?"
    )]
    Slope {
        /// Column.
        u: f64,
        /// Row.
        v: f64,
        /// Distance from the axis over depth.
        slope: f64,
        /// What is accepted.
        limit: f64,
    },
    /// Pixels that are no pixels.
    #[error("focal lengths ({fx:.3e}, {fy:.3e}) px differ by more than a factor {limit}: pixels are about square")]
    Aspect {
        /// Horizontal.
        fx: f64,
        /// Vertical.
        fy: f64,
        /// What is accepted.
        limit: f64,
    },
    /// A camera at infinity.
    #[error(
        "the focal spot lies {distance_mm:.3e} mm from the origin of lps, expected at most {limit_mm:.0e} mm; is the pose in mm?"
    )]
    Distance {
        /// Of the focal spot from the origin.
        distance_mm: f64,
        /// What is accepted.
        limit_mm: f64,
    },
    /// No pixels.
    #[error("image size is {width}x{height} px, both must be at least 1")]
    Empty {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
}

/// K: focal lengths and principal point in pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Intrinsics {
    /// Focal length along columns, > 0.
    pub fx: f64,
    /// Focal length along rows, > 0.
    pub fy: f64,
    /// K₀₁; zero for real detectors.
    pub skew: f64,
    /// Principal point, column.
    pub cx: f64,
    /// Principal point, row.
    pub cy: f64,
}

impl Intrinsics {
    /// Reads a 3×3 K.
    ///
    /// # Errors
    /// When K is not finite, not upper triangular, or has a focal length that is not positive.
    pub fn from_rows(rows: &[[f64; 3]; 3]) -> Result<Self, CameraError> {
        if !rows.iter().flatten().all(|x| x.is_finite()) {
            return Err(CameraError::NotFinite { what: "intrinsics" });
        }
        if rows[1][0] != 0.0 || rows[2] != [0.0, 0.0, 1.0] {
            return Err(CameraError::NotUpperTriangular { found: *rows });
        }
        let (fx, fy) = (rows[0][0], rows[1][1]);
        if !(fx > 0.0 && fy > 0.0) {
            return Err(CameraError::Focal { fx, fy });
        }
        Ok(Self { fx, fy, skew: rows[0][1], cx: rows[0][2], cy: rows[1][2] })
    }

    /// The 3×3 K, rows.
    #[must_use]
    pub fn to_rows(&self) -> [[f64; 3]; 3] {
        [[self.fx, self.skew, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
    }

    /// Projects a point in `camera`; meaningful for z > 0.
    #[must_use]
    #[inline(always)]
    pub fn project(&self, p_in_camera: DVec3) -> DVec2 {
        let (x, y) = (p_in_camera.x / p_in_camera.z, p_in_camera.y / p_in_camera.z);
        DVec2::new(self.fx * x + self.skew * y + self.cx, self.fy * y + self.cy)
    }

    /// How u and v move with a point of the camera frame that is in front of it: ∂u/∂p and ∂v/∂p, px per mm.
    #[must_use]
    pub fn slopes_px_per_mm(&self, p_in_camera: DVec3) -> [DVec3; 2] {
        let DVec3 { x, y, z } = p_in_camera;
        let du = DVec3::new(self.fx, self.skew, -(self.fx * x + self.skew * y) / z);
        let dv = DVec3::new(0.0, self.fy, -self.fy * y / z);
        [du / z, dv / z]
    }

    /// The point with z = 1 in `camera` that projects to `p_in_image`.
    #[must_use]
    pub fn unproject(&self, p_in_image: DVec2) -> DVec3 {
        let y = (p_in_image.y - self.cy) / self.fy;
        DVec3::new((p_in_image.x - self.cx - self.skew * y) / self.fx, y, 1.0)
    }

    /// Source-to-detector distance of a detector with pixels of `pitch_mm`: fx · pitch.
    #[must_use]
    pub fn source_to_detector_mm(&self, pitch_mm: f64) -> f64 {
        self.fx * pitch_mm
    }

    /// K of the same detector with `factor` × `factor` pixels averaged into one.
    #[must_use]
    pub fn binned(&self, factor: f64) -> Self {
        // The centre of the first coarse pixel lies at (factor − 1)/2 fine pixels.
        let offset = 0.5 * (factor - 1.0);
        Self {
            fx: self.fx / factor,
            fy: self.fy / factor,
            skew: self.skew / factor,
            cx: (self.cx - offset) / factor,
            cy: (self.cy - offset) / factor,
        }
    }
}

impl serde::Serialize for Intrinsics {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        self.to_rows().serialize(serializer)
    }
}

impl<'de> serde::Deserialize<'de> for Intrinsics {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Self::from_rows(&<[[f64; 3]; 3]>::deserialize(deserializer)?).map_err(serde::de::Error::custom)
    }
}

/// P (3×4): `lps` millimetres to `image` pixels, scaled so that the third coordinate is the depth in mm, positive in front (Eq. 2).
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(transparent)]
pub struct Projection(pub [[f64; 4]; 3]);

impl Projection {
    /// P = K [I|0] camera_from_lps.
    #[must_use]
    pub fn compose(intrinsics: &Intrinsics, camera_from_lps: &Rigid) -> Self {
        let k = intrinsics.to_rows();
        let m = camera_from_lps.to_rows();
        let entry = |row: usize, column: usize| (0..3).map(|i| k[row][i] * m[i][column]).sum::<f64>();
        Self(std::array::from_fn(|row| std::array::from_fn(|column| entry(row, column))))
    }

    /// K and pose of any 3×4 projection matrix, whatever its scale; its sign makes the focal lengths positive.
    ///
    /// # Errors
    /// When P is not finite, singular, or mirrors.
    pub fn decompose(&self) -> Result<(Intrinsics, Rigid), CameraError> {
        if !self.0.iter().flatten().all(|x| x.is_finite()) {
            return Err(CameraError::NotFinite { what: "projection matrix" });
        }
        // Brought near 1 by a power of two, which rounds nothing, so that no product over- or underflows.
        let largest = self.0.iter().flatten().fold(0.0f64, |largest, x| largest.max(x.abs()));
        if !(largest > 0.0) {
            return Err(CameraError::Singular { determinant: 0.0 });
        }
        let near_one = Self(self.0.map(|row| row.map(|x| x * (-largest.log2().floor()).clamp(-1000.0, 1000.0).exp2())));
        let row = |i: usize| DVec3::new(near_one.0[i][0], near_one.0[i][1], near_one.0[i][2]);
        // P = s K [R | t]. The third row of K R is R's third row, so |s| is its length; det(K R) = fx fy > 0 gives the sign of s,
        // unless the image is mirrored, which a scale cannot express.
        let length = row(2).length();
        let determinant = row(0).dot(row(1).cross(row(2))) / (row(0).length() * row(1).length() * length);
        if !(determinant.abs() > 1e-12) {
            return Err(CameraError::Singular { determinant });
        }
        let scale = determinant.signum() / length;
        let [m1, m2, m3] = [row(0) * scale, row(1) * scale, row(2) * scale];
        // RQ decomposition by Gram–Schmidt from the last row up.
        let r3 = m3;
        let cy = m2.dot(r3);
        let rest2 = m2 - cy * r3;
        let fy = rest2.length();
        let r2 = rest2 / fy;
        let cx = m1.dot(r3);
        let skew = m1.dot(r2);
        let rest1 = m1 - cx * r3 - skew * r2;
        let fx = rest1.length();
        let r1 = rest1 / fx;
        if r1.dot(r2.cross(r3)) < 0.0 {
            return Err(CameraError::Mirrored);
        }
        let skew = if (skew / fx).abs() < 1e-9 { 0.0 } else { skew };
        let intrinsics = Intrinsics { fx, fy, skew, cx, cy };
        let p4 = DVec3::new(near_one.0[0][3], near_one.0[1][3], near_one.0[2][3]) * scale;
        let tz = p4.z;
        let ty = (p4.y - cy * tz) / fy;
        let tx = (p4.x - skew * ty - cx * tz) / fx;
        let rotation = DQuat::from_mat3(&DMat3::from_cols(r1, r2, r3).transpose()).normalize();
        Ok((intrinsics, Rigid { rotation, translation_mm: DVec3::new(tx, ty, tz) }))
    }

    /// Pixel and depth (mm) of a point; the pixel is meaningful where the depth is positive.
    #[must_use]
    pub fn project(&self, p_in_lps: DVec3) -> (DVec2, f64) {
        let h: [f64; 3] = self.0.map(|r| r[0] * p_in_lps.x + r[1] * p_in_lps.y + r[2] * p_in_lps.z + r[3]);
        (DVec2::new(h[0] / h[2], h[1] / h[2]), h[2])
    }
}

/// A camera with a raster: what a frame was or would be taken with.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct View {
    /// Columns and rows.
    pub size_px: [u32; 2],
    /// K.
    pub intrinsics: Intrinsics,
    /// Pose of the specimen in the camera.
    pub camera_from_lps: Rigid,
}

impl View {
    /// Refuses cameras whose rays numbers cannot hold: beyond a slope of 20 (87°), a ratio of 100 of the focal lengths, or 1e6 mm.
    ///
    /// # Errors
    /// When a number is not finite or beyond these limits.
    pub fn check(&self) -> Result<(), CameraError> {
        const SLOPE: f64 = 20.0;
        const ASPECT: f64 = 100.0;
        const DISTANCE_MM: f64 = 1e6;
        let k = &self.intrinsics;
        let [width, height] = self.size_px.map(|n| f64::from(n) - 1.0);
        for (u, v) in [(0.0, 0.0), (width, 0.0), (0.0, height), (width, height)] {
            let slope = k.unproject(DVec2::new(u, v)).truncate().length();
            if !(slope <= SLOPE) {
                return Err(CameraError::Slope { u, v, slope, limit: SLOPE });
            }
        }
        let aspect = k.fx / k.fy;
        if !(1.0 / ASPECT..=ASPECT).contains(&aspect) {
            return Err(CameraError::Aspect { fx: k.fx, fy: k.fy, limit: ASPECT });
        }
        let distance_mm = self.camera_from_lps.translation_mm.length();
        if !(distance_mm <= DISTANCE_MM) {
            return Err(CameraError::Distance { distance_mm, limit_mm: DISTANCE_MM });
        }
        Ok(())
    }

    /// P.
    #[must_use]
    pub fn projection(&self) -> Projection {
        Projection::compose(&self.intrinsics, &self.camera_from_lps)
    }

    /// The focal spot.
    #[must_use]
    pub fn source_in_lps(&self) -> DVec3 {
        self.camera_from_lps.inverse().translation_mm
    }

    /// From the focal spot to the plane z = 1 mm in `camera`, through pixel (u, v): times depth it reaches that depth.
    #[must_use]
    pub fn ray_in_lps(&self, p_in_image: DVec2) -> DVec3 {
        self.camera_from_lps.inverse().transform_vector(self.intrinsics.unproject(p_in_image))
    }

    /// The view at most `limit` pixels wide: binned by a whole factor where needed.
    #[must_use]
    pub fn at_most_wide(&self, limit: u32) -> (Self, u32) {
        let factor = self.size_px[0].max(1).div_ceil(limit.max(1)).max(1);
        (self.binned(factor), factor)
    }

    /// The view with `factor` × `factor` pixels in one; whole ones only.
    #[must_use]
    pub fn binned(&self, factor: u32) -> Self {
        let size_px = self.size_px.map(|n| (n / factor.max(1)).max(1));
        Self { size_px, intrinsics: self.intrinsics.binned(f64::from(factor)), camera_from_lps: self.camera_from_lps }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view() -> View {
        View {
            size_px: [620, 480],
            intrinsics: Intrinsics { fx: 5257.0, fy: 5250.0, skew: 0.0, cx: 309.5, cy: 239.5 },
            camera_from_lps: Rigid::exp(DVec3::new(0.4, -0.8, 2.0), DVec3::new(10.0, -20.0, 600.0)),
        }
    }

    #[test]
    fn slopes_are_those_of_the_projection() {
        let k = Intrinsics { fx: 5200.0, fy: 5100.0, skew: 40.0, cx: 300.0, cy: 250.0 };
        let (p, step) = (DVec3::new(31.0, -52.0, 640.0), 1e-3);
        let slopes = k.slopes_px_per_mm(p);
        for (n, axis) in DVec3::AXES.into_iter().enumerate() {
            let found = (k.project(p + axis * step) - k.project(p - axis * step)) / (2.0 * step);
            let expected = DVec2::new(slopes[0][n], slopes[1][n]);
            assert!(found.distance(expected) < 1e-6, "{n}: {found} {expected}");
        }
    }

    #[test]
    fn projection_decomposes_at_any_scale_and_sign() {
        let view = view();
        let mut cases = 0;
        for scale in [1.0, -1.0, 1e-6, -2e7] {
            let scaled = Projection(view.projection().0.map(|row| row.map(|x| x * scale)));
            let (k, pose) = scaled.decompose().expect("regular");
            assert!((k.fx - 5257.0).abs() < 1e-6 && (k.cx - 309.5).abs() < 1e-6 && k.skew == 0.0);
            assert!(pose.translation_mm.distance(view.camera_from_lps.translation_mm) < 1e-6);
            assert!(pose.angle_to_rad(&view.camera_from_lps) < 1e-9);
            cases += 1;
        }
        assert_eq!(cases, 4);
    }

    #[test]
    fn mirrored_and_singular_matrices_are_refused() {
        let mut mirrored = view().projection();
        mirrored.0[0] = mirrored.0[0].map(|x| -x);
        // Mirroring u turns the sign of the determinant; a scale of −1 turns it too, so the pose comes out behind the source.
        let behind = mirrored.decompose().map(|(_, pose)| pose.translation_mm.z);
        assert!(behind.is_err() || behind.is_ok_and(|z| z < 0.0));
        assert!(matches!(Projection([[1.0, 0.0, 0.0, 0.0]; 3]).decompose(), Err(CameraError::Singular { .. })));
    }

    #[test]
    fn a_ray_passes_through_what_projects_onto_its_pixel() {
        let view = view();
        let p = DVec3::new(20.0, -30.0, 15.0);
        let (pixel, depth) = view.projection().project(p);
        assert!(depth > 0.0);
        assert!((view.source_in_lps() + view.ray_in_lps(pixel) * depth).distance(p) < 1e-9);
    }

    #[test]
    fn binning_keeps_the_field() {
        let k = view().intrinsics;
        let coarse = k.binned(2.0);
        let p = DVec3::new(12.0, 7.0, 640.0);
        let (fine, binned) = (k.project(p), coarse.project(p));
        assert!(((fine + 0.5) / 2.0 - 0.5).distance(binned) < 1e-9);
    }
}
