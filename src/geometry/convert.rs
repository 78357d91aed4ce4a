//! Other tools' conventions, converted at import and export only.

use glam::{DQuat, DVec3};

use super::Rigid;

/// NIfTI and Slicer RAS coordinates of a point in `lps`.
#[must_use]
pub fn ras_from_lps(p_in_lps: DVec3) -> DVec3 {
    DVec3::new(-p_in_lps.x, -p_in_lps.y, p_in_lps.z)
}

/// The same as a motion, half a turn about z: its own inverse.
pub const RAS_FROM_LPS: Rigid = Rigid::rotation(DQuat::from_xyzw(0.0, 0.0, 1.0, 0.0));

/// `lps` coordinates of a point in RAS.
#[must_use]
pub fn lps_from_ras(p_in_ras: DVec3) -> DVec3 {
    ras_from_lps(p_in_ras)
}

/// DICOM positioner angles (primary, secondary) in degrees of a beam direction (focal spot to detector) in `lps`.
///
/// Primary + = LAO (0018,1510): the detector moves to the patient's left (+x); secondary + = CRA (0018,1511): it moves to the head
/// (+z). At (0, 0) the detector is anterior of the supine patient, the beam runs along −y.
#[must_use]
pub fn dicom_angles_deg(beam_in_lps: DVec3) -> (f64, f64) {
    let beam = beam_in_lps.normalize_or_zero();
    (beam.x.atan2(-beam.y).to_degrees(), beam.z.clamp(-1.0, 1.0).asin().to_degrees())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dicom_angles_have_the_standard_signs_in_every_octant() {
        let mut cases = 0;
        for primary in [-30.0f64, 20.0, -120.0, 140.0] {
            for secondary in [-25.0f64, 15.0] {
                let (p, s) = (primary.to_radians(), secondary.to_radians());
                let beam = DVec3::new(p.sin() * s.cos(), -p.cos() * s.cos(), s.sin());
                let found = dicom_angles_deg(beam * 3.0);
                assert!((found.0 - primary).abs() < 1e-9 && (found.1 - secondary).abs() < 1e-9);
                cases += 1;
            }
        }
        assert_eq!(cases, 8);
    }

    #[test]
    fn ras_and_lps_differ_in_two_signs() {
        let p_in_ras = DVec3::new(1.0, 2.0, 3.0);
        assert_eq!(lps_from_ras(p_in_ras), DVec3::new(-1.0, -2.0, 3.0));
        assert_eq!(RAS_FROM_LPS.transform_point(p_in_ras), lps_from_ras(p_in_ras));
    }
}
