//! Joint readings of a C-arm, as files and the wire name them.

use serde::{Deserialize, Serialize};

/// Joint readings; angles in radians, NaN where a joint has no encoder.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CarmJoints {
    /// Vertical column.
    pub lift_mm: f64,
    /// About the vertical axis.
    pub wig_wag_rad: f64,
    /// Along the arm.
    pub longitudinal_mm: f64,
    /// About the arm's axis (x).
    pub angulation_rad: f64,
    /// Along the C (about y).
    pub orbital_rad: f64,
    /// Of the panel in its plane.
    pub detector_rotation_rad: f64,
    /// Focal spot to detector; NaN where the arm's distance is fixed and not reported.
    pub source_to_detector_mm: f64,
}

impl CarmJoints {
    /// All joints at zero, distance unknown.
    pub const ZERO: Self = Self {
        lift_mm: 0.0,
        wig_wag_rad: 0.0,
        longitudinal_mm: 0.0,
        angulation_rad: 0.0,
        orbital_rad: 0.0,
        detector_rotation_rad: 0.0,
        source_to_detector_mm: f64::NAN,
    };

    /// Focal spot to detector of C-arms, least and largest. What lies beyond is in another unit, or was never measured.
    pub const SOURCE_TO_DETECTOR_MM: (f64, f64) = (300.0, 2500.0);

    /// The same, with a distance that no C-arm has as one that is not measured.
    #[must_use]
    pub fn with_plausible_distance(self) -> Self {
        let (least_mm, largest_mm) = Self::SOURCE_TO_DETECTOR_MM;
        if self.source_to_detector_mm >= least_mm && self.source_to_detector_mm <= largest_mm {
            return self;
        }
        Self { source_to_detector_mm: f64::NAN, ..self }
    }

    /// In the order lift, wig-wag, longitudinal, angulation, orbital, detector rotation, source to detector.
    #[must_use]
    pub fn to_array(self) -> [f64; 7] {
        [
            self.lift_mm,
            self.wig_wag_rad,
            self.longitudinal_mm,
            self.angulation_rad,
            self.orbital_rad,
            self.detector_rotation_rad,
            self.source_to_detector_mm,
        ]
    }

    /// Inverse of [`CarmJoints::to_array`].
    #[must_use]
    pub fn from_array(a: [f64; 7]) -> Self {
        Self {
            lift_mm: a[0],
            wig_wag_rad: a[1],
            longitudinal_mm: a[2],
            angulation_rad: a[3],
            orbital_rad: a[4],
            detector_rotation_rad: a[5],
            source_to_detector_mm: a[6],
        }
    }
}

/// Joint keys of files and the wire, with whether each is an angle, in the order of [`CarmJoints::to_array`].
pub const JOINT_KEYS: [(&str, bool); 7] = [
    ("lift_mm", false),
    ("wig_wag_deg", true),
    ("longitudinal_mm", false),
    ("angulation_deg", true),
    ("orbital_deg", true),
    ("detector_rotation_deg", true),
    ("source_to_detector_mm", false),
];

impl Serialize for CarmJoints {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serde_json::Map::new();
        for ((key, is_angle), value) in JOINT_KEYS.iter().zip(self.to_array()) {
            let shown = if *is_angle { value.to_degrees() } else { value };
            map.insert((*key).to_owned(), serde_json::json!(shown.is_finite().then_some(shown)));
        }
        map.serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for CarmJoints {
    /// Missing joints and `null` are NaN (not measured); unknown keys are errors.
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let map = std::collections::BTreeMap::<String, Option<f64>>::deserialize(deserializer)?;
        let mut values = [f64::NAN; 7];
        for (key, value) in map {
            let Some(index) = JOINT_KEYS.iter().position(|(known, _)| *known == key) else {
                let known = JOINT_KEYS.map(|(known, _)| known).join(", ");
                return Err(serde::de::Error::custom(format!("unknown joint `{key}`, expected one of {known}")));
            };
            let value = value.unwrap_or(f64::NAN);
            values[index] = if JOINT_KEYS[index].1 { value.to_radians() } else { value };
        }
        Ok(Self::from_array(values))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_distance_that_no_arm_has_is_not_measured() {
        for (told_mm, taken_mm) in [(1020.0, Some(1020.0)), (300.0, Some(300.0)), (1.02, None), (102.0, None), (1e6, None)] {
            let told = CarmJoints { source_to_detector_mm: told_mm, lift_mm: 1.02, ..CarmJoints::ZERO };
            let taken = told.with_plausible_distance();
            assert_eq!(Some(taken.source_to_detector_mm).filter(|mm| mm.is_finite()), taken_mm, "{told_mm}");
            assert!((taken.lift_mm - told.lift_mm).abs() < 1e-12, "nothing else changes");
        }
        assert!(CarmJoints::ZERO.with_plausible_distance().source_to_detector_mm.is_nan());
    }

    #[test]
    fn unknown_joints_are_errors() {
        assert!(serde_json::from_str::<CarmJoints>(r#"{"orbital_rad": 1.0}"#).is_err());
        let joints: CarmJoints = serde_json::from_str(r#"{"orbital_deg": 90}"#).expect("known");
        assert!((joints.orbital_rad - std::f64::consts::FRAC_PI_2).abs() < 1e-12 && joints.lift_mm.is_nan());
    }
}
