//! Units that a declaration may state, and what they are in the units of [`super::super::sample`].

/// What a number measures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Quantity {
    /// To degrees.
    Angle,
    /// To millimetres.
    Length,
    /// To mm/s.
    Velocity,
    /// To newtons.
    Force,
    /// To amperes.
    MotorCurrent,
    /// To milliamperes.
    TubeCurrent,
    /// To kilovolts.
    Voltage,
    /// To milliseconds.
    Duration,
    /// To revolutions per minute.
    Rotation,
    /// To microseconds.
    Time,
    /// Has no unit.
    Number,
}

const DEG_PER_RAD: f64 = 180.0 / std::f64::consts::PI;

/// Whether the program knows `word` as a unit.
pub(in crate::telemetry) fn is_unit(word: &str) -> bool {
    Quantity::ALL.iter().any(|quantity| quantity.units().iter().any(|(name, _)| *name == word))
}

impl Quantity {
    const ALL: [Self; 11] = [
        Self::Angle,
        Self::Length,
        Self::Velocity,
        Self::Force,
        Self::MotorCurrent,
        Self::TubeCurrent,
        Self::Voltage,
        Self::Duration,
        Self::Rotation,
        Self::Time,
        Self::Number,
    ];

    /// Units by name, and what one of each is in the program's.
    fn units(self) -> &'static [(&'static str, f64)] {
        match self {
            Self::Angle => &[("deg", 1.0), ("rad", DEG_PER_RAD), ("mrad", DEG_PER_RAD * 1e-3)],
            Self::Length => &[("mm", 1.0), ("cm", 10.0), ("m", 1e3), ("um", 1e-3), ("in", 25.4)],
            Self::Velocity => &[("mm/s", 1.0), ("cm/s", 10.0), ("m/s", 1e3), ("um/s", 1e-3), ("in/s", 25.4)],
            Self::Force => &[("N", 1.0), ("mN", 1e-3), ("kN", 1e3), ("kgf", 9.80665), ("lbf", 4.448_221_615_260_5)],
            Self::MotorCurrent => &[("A", 1.0), ("mA", 1e-3)],
            Self::TubeCurrent => &[("mA", 1.0), ("A", 1e3), ("uA", 1e-3)],
            Self::Voltage => &[("kV", 1.0), ("V", 1e-3)],
            Self::Duration => &[("ms", 1.0), ("s", 1e3), ("us", 1e-3)],
            Self::Rotation => &[("rpm", 1.0), ("Hz", 60.0), ("deg/s", 1.0 / 6.0), ("rad/s", DEG_PER_RAD / 6.0)],
            Self::Time => &[("us", 1.0), ("ms", 1e3), ("s", 1e6), ("ns", 1e-3)],
            Self::Number => &[],
        }
    }

    fn name(self) -> &'static str {
        match self {
            Self::Angle => "an angle",
            Self::Length => "a length",
            Self::Velocity => "a velocity",
            Self::Force => "a force",
            Self::MotorCurrent | Self::TubeCurrent => "a current",
            Self::Voltage => "a voltage",
            Self::Duration | Self::Time => "a time",
            Self::Rotation => "a speed of rotation",
            Self::Number => "a plain number",
        }
    }

    /// What one of `unit` is in the program's unit, or in words why it is none.
    pub(super) fn factor(self, unit: Option<&str>) -> Result<f64, String> {
        let known: Vec<&str> = self.units().iter().map(|(name, _)| *name).collect();
        let expected = known.join(", ");
        match (unit, &known[..]) {
            (None, []) => Ok(1.0),
            (Some(unit), []) => Err(format!("\"{unit}\" is a unit, expected none: this is {}", self.name())),
            (None, _) => Err(format!("no unit is stated of {}, expected one of {expected}", self.name())),
            (Some(unit), _) => {
                let found = self.units().iter().find(|(name, _)| *name == unit).map(|(_, factor)| *factor);
                found.ok_or_else(|| format!("\"{unit}\" is no unit of {}, expected one of {expected}", self.name()))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_unit_of_another_quantity_is_refused_and_says_what_would_be_right() {
        assert_eq!(Quantity::Length.factor(Some("in")), Ok(25.4));
        assert!((Quantity::Angle.factor(Some("rad")).expect("a unit") * std::f64::consts::FRAC_PI_2 - 90.0).abs() < 1e-12);
        assert_eq!(Quantity::Rotation.factor(Some("Hz")), Ok(60.0));
        assert!((Quantity::Rotation.factor(Some("deg/s")).expect("a unit") * 360.0 - 60.0).abs() < 1e-12);
        let wrong = Quantity::Angle.factor(Some("mm")).expect_err("no angle");
        assert_eq!(wrong, "\"mm\" is no unit of an angle, expected one of deg, rad, mrad");
        assert!(Quantity::Angle.factor(None).is_err_and(|words| words.contains("no unit is stated")));
        assert!(Quantity::Number.factor(Some("deg")).is_err_and(|words| words.contains("expected none")));
        assert_eq!(Quantity::Number.factor(None), Ok(1.0));
    }
}
