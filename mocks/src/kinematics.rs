//! The chains of `PROTOCOL.md`: C-arm joints to P, control angles to the robot's pieces.

use crate::matrix::{Mat4, inverse, mul, rotation, translation};

/// What the chain needs to know of a C-arm.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CarmGeometry {
    /// From the column to the isocentre.
    pub column_to_isocentre_mm: [f64; 3],
    /// Focal spot to isocentre.
    pub source_to_isocentre_mm: f64,
    /// Focal length in pixels.
    pub focal_px: f64,
    /// Principal point.
    pub principal_px: [f64; 2],
}

/// `world_from_camera` for lift, wig-wag, longitudinal, angulation, orbital, detector rotation (mm, degrees).
#[must_use]
pub fn world_from_camera(geometry: &CarmGeometry, joints: &[f64; 6]) -> Mat4 {
    let [lift, wig_wag, longitudinal, angulation, orbital, detector_rotation] = *joints;
    let [x, y, z] = geometry.column_to_isocentre_mm;
    [
        rotation(2, wig_wag),
        translation(x, y, z),
        rotation(0, angulation),
        rotation(1, orbital),
        translation(0.0, 0.0, -geometry.source_to_isocentre_mm),
        rotation(2, detector_rotation),
    ]
    .iter()
    .fold(translation(longitudinal, 0.0, lift), |chain, link| mul(&chain, link))
}

/// `camera_from_lps`.
#[must_use]
pub fn camera_from_lps(geometry: &CarmGeometry, joints: &[f64; 6], world_from_lps: &Mat4) -> Mat4 {
    mul(&inverse(&world_from_camera(geometry, joints)), world_from_lps)
}

/// P, rows.
#[must_use]
pub fn projection(geometry: &CarmGeometry, camera_from_lps: &Mat4) -> [[f64; 4]; 3] {
    let (f, [cx, cy]) = (geometry.focal_px, geometry.principal_px);
    let m = camera_from_lps;
    [std::array::from_fn(|j| f * m[0][j] + cx * m[2][j]), std::array::from_fn(|j| f * m[1][j] + cy * m[2][j]), m[2]]
}

/// Notches of the robot.
pub const NOTCHES: usize = 27;
/// Distance of notch centres.
pub const PITCH_MM: f64 = 35.0 / 27.0;
/// Length of the notched body.
pub const BODY_MM: f64 = 35.0;

/// Outer and inner radius of the body's tube.
pub const BODY_RADII_MM: [f64; 2] = [3.0, 2.0];
/// Radius of the core inside the body.
pub const SHAFT_RADIUS_MM: f64 = 1.0;
/// Length of the drill beyond the body's end.
pub const DRILL_LENGTH_MM: f64 = 4.0;
/// Radius of the drill.
pub const DRILL_RADIUS_MM: f64 = 2.5;

/// Bends of the notches, degrees.
#[must_use]
pub fn bends_deg(control_deg: &[f64; 5]) -> [f64; NOTCHES] {
    let spacing = 26.0 / 6.0;
    // Second derivatives at the three inner knots by Cramer's rule on the natural spline's tridiagonal system [4 1 0; 1 4 1; 0 1 4].
    let r: [f64; 3] = std::array::from_fn(|i| 6.0 * (control_deg[i] - 2.0 * control_deg[i + 1] + control_deg[i + 2]));
    let inner = [
        (15.0 * r[0] - 4.0 * r[1] + r[2]) / 56.0,
        (-4.0 * r[0] + 16.0 * r[1] - 4.0 * r[2]) / 56.0,
        (r[0] - 4.0 * r[1] + 15.0 * r[2]) / 56.0,
    ];
    let m = [0.0, inner[0], inner[1], inner[2], 0.0];
    std::array::from_fn(|notch| {
        let t = (notch as f64 / spacing - 1.0).clamp(0.0, 4.0);
        let k = (t.floor() as usize).min(3);
        let u = t - k as f64;
        let d = 1.0 - u;
        let value = m[k] * d.powi(3) / 6.0
            + m[k + 1] * u.powi(3) / 6.0
            + (control_deg[k] - m[k] / 6.0) * d
            + (control_deg[k + 1] - m[k + 1] / 6.0) * u;
        value.clamp(-7.9, 7.9)
    })
}

/// Start frame and length of each of the 28 pieces, and the frame at the body's end.
#[must_use]
pub fn pieces(control_deg: &[f64; 5]) -> (Vec<(Mat4, f64)>, Mat4) {
    let mut out = Vec::with_capacity(NOTCHES + 1);
    let mut frame = translation(0.0, 0.0, 0.0);
    let mut start = 0.0;
    for (notch, bend) in bends_deg(control_deg).iter().enumerate() {
        let pivot = (notch as f64 + 0.5) * PITCH_MM;
        out.push((frame, pivot - start));
        frame = mul(&mul(&frame, &translation(0.0, 0.0, pivot - start)), &rotation(1, *bend));
        start = pivot;
    }
    out.push((frame, BODY_MM - start));
    (out, mul(&frame, &translation(0.0, 0.0, BODY_MM - start)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::matrix::point;

    const PROTOCOL: &str = include_str!("../PROTOCOL.md");

    #[test]
    fn worked_poses_are_what_the_protocol_prints() {
        let geometry = CarmGeometry {
            column_to_isocentre_mm: [800.0, 0.0, 1000.0],
            source_to_isocentre_mm: 631.8,
            focal_px: 1020.0 / 0.388,
            principal_px: [309.5, 239.5],
        };
        let world_from_lps = [[1.0, 0.0, 0.0, 800.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 1000.0], [0.0, 0.0, 0.0, 1.0]];
        let section =
            PROTOCOL.split("## The C-arm's chain").nth(1).and_then(|s| s.split("## The robot's").next()).expect("section");
        let mut cases = 0;
        let poses = [[0.0; 6], [25.0, 4.0, -30.0, 12.5, -30.0, 0.0], [-10.0, -6.0, 15.0, -15.0, 25.0, 90.0]];
        for (joints, block) in poses.iter().zip(section.split("```").skip(1).step_by(2)) {
            let printed: Vec<f64> = block.split_whitespace().map(|word| word.parse().expect("number")).collect();
            let found = projection(&geometry, &camera_from_lps(&geometry, joints, &world_from_lps));
            for (a, b) in found.iter().flatten().zip(&printed) {
                assert!((a - b).abs() < 1e-6, "{a} {b}");
            }
            cases += printed.len();
        }
        assert_eq!(cases, 36);
    }

    #[test]
    fn the_worked_robot_is_what_the_protocol_prints() {
        let (_, end) = pieces(&[1.0, 2.0, 0.5, -1.0, 0.0]);
        let tip = point(&end, [0.0, 0.0, DRILL_LENGTH_MM]);
        let printed = PROTOCOL.split("tip at (").nth(1).and_then(|s| s.split(')').next()).expect("tip");
        for (a, b) in tip.iter().zip(printed.split(", ")) {
            assert!((a - b.parse::<f64>().expect("number")).abs() < 1e-8, "{a} {b}");
        }
    }
}
