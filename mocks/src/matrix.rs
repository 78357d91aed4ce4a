//! Small matrices: rows of a 4×4 rigid transform, millimetres.

/// A 4×4 matrix, row-major.
pub type Mat4 = [[f64; 4]; 4];
/// A point or direction.
pub type Vec3 = [f64; 3];

/// Leaves everything where it is.
pub const IDENTITY: Mat4 = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];

/// `a_from_b · b_from_c`.
#[must_use]
pub fn mul(a: &Mat4, b: &Mat4) -> Mat4 {
    std::array::from_fn(|i| std::array::from_fn(|j| (0..4).map(|k| a[i][k] * b[k][j]).sum()))
}

/// A translation.
#[must_use]
pub fn translation(x: f64, y: f64, z: f64) -> Mat4 {
    let mut m = IDENTITY;
    (m[0][3], m[1][3], m[2][3]) = (x, y, z);
    m
}

/// A right-handed rotation about axis 0 (x), 1 (y) or 2 (z).
#[must_use]
pub fn rotation(axis: usize, angle_deg: f64) -> Mat4 {
    let (s, c) = angle_deg.to_radians().sin_cos();
    let (i, j) = ((axis + 1) % 3, (axis + 2) % 3);
    let mut m = IDENTITY;
    (m[i][i], m[j][j], m[i][j], m[j][i]) = (c, c, -s, s);
    m
}

/// Inverse of a rigid transform.
#[must_use]
pub fn inverse(m: &Mat4) -> Mat4 {
    let mut out = IDENTITY;
    for i in 0..3 {
        for j in 0..3 {
            out[i][j] = m[j][i];
        }
        out[i][3] = -(0..3).map(|k| m[k][i] * m[k][3]).sum::<f64>();
    }
    out
}

/// Maps a point.
#[must_use]
pub fn point(m: &Mat4, p: Vec3) -> Vec3 {
    std::array::from_fn(|i| m[i][0] * p[0] + m[i][1] * p[1] + m[i][2] * p[2] + m[i][3])
}

/// Maps a direction.
#[must_use]
pub fn direction(m: &Mat4, d: Vec3) -> Vec3 {
    std::array::from_fn(|i| m[i][0] * d[0] + m[i][1] * d[1] + m[i][2] * d[2])
}

/// Scalar product.
#[must_use]
pub fn dot(a: Vec3, b: Vec3) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// `a − b`.
#[must_use]
pub fn sub(a: Vec3, b: Vec3) -> Vec3 {
    std::array::from_fn(|i| a[i] - b[i])
}

/// `a + t·b`.
#[must_use]
pub fn along(a: Vec3, b: Vec3, t: f64) -> Vec3 {
    std::array::from_fn(|i| a[i] + t * b[i])
}

/// A frame with its origin at `origin` and +z along `z` (any length > 0).
#[must_use]
pub fn frame_along(origin: Vec3, z: Vec3) -> Mat4 {
    let length = dot(z, z).sqrt();
    let z = z.map(|c| c / length);
    let helper = if z[0].abs() < 0.9 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] };
    let x = sub(helper, z.map(|c| c * dot(helper, z)));
    let x = x.map(|c| c / dot(x, x).sqrt());
    let y = [z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]];
    std::array::from_fn(|i| if i < 3 { [x[i], y[i], z[i], origin[i]] } else { IDENTITY[3] })
}
