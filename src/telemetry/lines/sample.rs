//! The texts of a line into a sample.

use glam::{DQuat, DVec3};

use super::super::line_fault::LineFault;
use super::super::sample::{CarmSample, RobotSample, Sample, Tendon};
use super::declaration::{BaseFields, CarmFields, Direction, FlagSource, RobotFields, Source, TendonFields};
use super::error::AdapterError;
use super::quantity::Quantity;
use super::reading::{Counter, Flag, Number, Texts};
use super::split::Names;
use crate::geometry::{CarmJoints, Rigid};

/// A rotation in decimals may be off unit length by this much.
const QUATERNION_LIMIT: f64 = 1e-2;

/// Number and time of a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Stamp {
    pub(super) sequence: u32,
    pub(super) device_us: u64,
}

/// What is made of the texts.
#[derive(Clone, Debug)]
pub(super) enum Plan {
    Robot(Box<RobotPlan>),
    Carm(Box<CarmPlan>),
}

impl Plan {
    /// A sample at a stamp.
    pub(super) fn read(&self, stamp: Stamp, texts: &Texts<'_>) -> Result<Sample, LineFault> {
        match self {
            Self::Robot(plan) => plan.read(stamp, texts).map(Sample::Robot),
            Self::Carm(plan) => plan.read(stamp, texts).map(Sample::Carm),
        }
    }
}

fn number(source: Option<&Source>, quantity: Quantity, field: &str, names: &mut Names) -> Result<Option<Number>, AdapterError> {
    source.map(|source| Number::new(source, quantity, field, names)).transpose()
}

fn numbers<const N: usize>(
    sources: Option<&[Source; N]>,
    quantity: Quantity,
    field: &str,
    names: &mut Names,
) -> Result<Option<Vec<Number>>, AdapterError> {
    let one = |(at, source): (usize, &Source)| Number::new(source, quantity, &format!("{field}[{at}]"), names);
    sources.map(|sources| sources.iter().enumerate().map(one).collect()).transpose()
}

fn flag(source: Option<&FlagSource>, field: &str, names: &mut Names) -> Result<Option<Flag>, AdapterError> {
    source.map(|source| Flag::new(source, field, names)).transpose()
}

/// NaN where nothing is declared.
fn read(number: Option<&Number>, texts: &Texts<'_>) -> Result<f64, LineFault> {
    number.map_or(Ok(f64::NAN), |number| number.read(texts))
}

/// Bit 0 first.
fn bits(flags: &[Option<Flag>], texts: &Texts<'_>) -> Result<u32, LineFault> {
    let mut status = 0;
    for (bit, flag) in flags.iter().enumerate() {
        if let Some(flag) = flag {
            status |= u32::from(flag.read(texts)?) << bit;
        }
    }
    Ok(status)
}

fn array<const N: usize>(numbers: &[Number], texts: &Texts<'_>) -> Result<[f64; N], LineFault> {
    let mut values = [f64::NAN; N];
    for (value, number) in values.iter_mut().zip(numbers) {
        *value = number.read(texts)?;
    }
    Ok(values)
}

/// See [`RobotFields`].
#[derive(Clone, Debug)]
pub(super) struct RobotPlan {
    commanded: Option<Vec<Number>>,
    sensed: Option<Vec<Number>>,
    /// Position, velocity, tension, current of each.
    tendons: Option<[[Option<Number>; 4]; 2]>,
    base: Option<Base>,
    drill: Option<Number>,
    status: [Option<Flag>; 3],
}

impl RobotPlan {
    pub(super) fn new(fields: &RobotFields, names: &mut Names) -> Result<Self, AdapterError> {
        let angles = |sources: &Option<[Source; 5]>, key: &str, names: &mut Names| {
            numbers(sources.as_ref(), Quantity::Angle, &format!("robot.{key}"), names)
        };
        let commanded = angles(&fields.commanded_angles, "commanded_angles", names)?;
        let sensed = angles(&fields.sensed_angles, "sensed_angles", names)?;
        if commanded.is_none() && sensed.is_none() {
            let detail = "says no angles, expected sensed_angles, commanded_angles or both: nothing else bends the robot";
            return Err(AdapterError::new("robot", detail));
        }
        for angles in commanded.iter().chain(&sensed) {
            if !angles.iter().any(Number::is_read) {
                let detail = "holds constants alone: give control_angles_deg in the scene to a robot that does not move";
                return Err(AdapterError::new("robot", detail));
            }
        }
        let tendon = |fields: &TendonFields, at: usize, names: &mut Names| {
            let mut one = |source: &Option<Source>, quantity, key: &str| {
                number(source.as_ref(), quantity, &format!("robot.tendons[{at}].{key}"), names)
            };
            Ok::<_, AdapterError>([
                one(&fields.position, Quantity::Length, "position")?,
                one(&fields.velocity, Quantity::Velocity, "velocity")?,
                one(&fields.tension, Quantity::Force, "tension")?,
                one(&fields.current, Quantity::MotorCurrent, "current")?,
            ])
        };
        let tendons = match &fields.tendons {
            Some([first, second]) => Some([tendon(first, 0, names)?, tendon(second, 1, names)?]),
            None => None,
        };
        Ok(Self {
            commanded,
            sensed,
            tendons,
            base: fields.base.as_ref().map(|base| Base::new(base, names)).transpose()?,
            drill: number(fields.drill_speed.as_ref(), Quantity::Rotation, "robot.drill_speed", names)?,
            status: [
                flag(fields.fault.as_ref(), "robot.fault", names)?,
                flag(fields.emergency_stop.as_ref(), "robot.emergency_stop", names)?,
                flag(fields.homing.as_ref(), "robot.homing", names)?,
            ],
        })
    }

    fn read(&self, stamp: Stamp, texts: &Texts<'_>) -> Result<RobotSample, LineFault> {
        let angles = |numbers: &Option<Vec<Number>>| numbers.as_ref().map(|numbers| array::<5>(numbers, texts)).transpose();
        let tendon = |at: usize| {
            let Some(tendons) = &self.tendons else { return Ok([f64::NAN; 4]) };
            let mut values = [f64::NAN; 4];
            for (value, number) in values.iter_mut().zip(&tendons[at]) {
                *value = read(number.as_ref(), texts)?;
            }
            Ok(values)
        };
        let told = |[position_mm, velocity_mm_per_s, tension_n, current_a]: [f64; 4]| Tendon {
            position_mm,
            velocity_mm_per_s,
            tension_n,
            current_a,
        };
        Ok(RobotSample {
            device_us: stamp.device_us,
            sequence: stamp.sequence,
            commanded_deg: angles(&self.commanded)?.unwrap_or([f64::NAN; 5]),
            sensed_deg: angles(&self.sensed)?,
            tendons: [told(tendon(0)?), told(tendon(1)?)],
            tracker_from_base: self.base.as_ref().map(|base| base.read(texts)).transpose()?.flatten(),
            drill_rpm: read(self.drill.as_ref(), texts)?,
            status: bits(&self.status, texts)?,
        })
    }
}

/// See [`BaseFields`].
#[derive(Clone, Debug)]
struct Base {
    holds: Direction,
    translation: Vec<Number>,
    rotation: Rotation,
    tracked: Option<Flag>,
}

#[derive(Clone, Debug)]
enum Rotation {
    Quaternion(Vec<Number>),
    Vector(Vec<Number>),
}

impl Base {
    fn new(fields: &BaseFields, names: &mut Names) -> Result<Self, AdapterError> {
        let translation = numbers(Some(&fields.translation), Quantity::Length, "robot.base.translation", names)?;
        let quaternion = numbers(fields.quaternion_xyzw.as_ref(), Quantity::Number, "robot.base.quaternion_xyzw", names)?;
        let vector = numbers(fields.rotation_vector.as_ref(), Quantity::Angle, "robot.base.rotation_vector", names)?;
        let rotation = match (quaternion, vector) {
            (Some(numbers), None) => Rotation::Quaternion(numbers),
            (None, Some(numbers)) => Rotation::Vector(numbers),
            _ => return Err(AdapterError::new("robot.base", "expected one of quaternion_xyzw and rotation_vector")),
        };
        let tracked = flag(fields.tracked.as_ref(), "robot.base.tracked", names)?;
        Ok(Self { holds: fields.holds, translation: translation.unwrap_or_default(), rotation, tracked })
    }

    /// None where the tracker does not see it, or does not say.
    fn read(&self, texts: &Texts<'_>) -> Result<Option<Rigid>, LineFault> {
        if let Some(tracked) = &self.tracked
            && !tracked.read(texts)?
        {
            return Ok(None);
        }
        let translation_mm = DVec3::from_array(array(&self.translation, texts)?);
        let rotation = match &self.rotation {
            Rotation::Quaternion(numbers) => DQuat::from_array(array(numbers, texts)?),
            Rotation::Vector(numbers) => DQuat::from_scaled_axis(DVec3::from_array(array(numbers, texts)?.map(f64::to_radians))),
        };
        if !translation_mm.is_finite() || !rotation.is_finite() {
            return Ok(None);
        }
        let length = rotation.length();
        if !((length - 1.0).abs() <= QUATERNION_LIMIT) {
            return Err(LineFault::NotARotation { field: "robot.base".to_owned(), length: format!("{length:.3}") });
        }
        let held = Rigid { rotation: rotation.normalize(), translation_mm };
        Ok(Some(match self.holds {
            Direction::TrackerFromBase => held,
            Direction::BaseFromTracker => held.inverse(),
        }))
    }
}

/// See [`CarmFields`].
#[derive(Clone, Debug)]
pub(super) struct CarmPlan {
    /// In the order of [`CarmJoints`]; degrees and millimetres.
    joints: [Option<Number>; 7],
    /// Voltage, current, pulse, aluminium, copper.
    beam: [Option<Number>; 5],
    field: Option<Vec<Number>>,
    xray_on: Option<Flag>,
    counter: Option<Counter>,
    status: [Option<Flag>; 2],
}

impl CarmPlan {
    pub(super) fn new(fields: &CarmFields, names: &mut Names) -> Result<Self, AdapterError> {
        let mut one =
            |source: &Option<Source>, quantity, key: &str| number(source.as_ref(), quantity, &format!("carm.{key}"), names);
        let joints = [
            one(&fields.lift, Quantity::Length, "lift")?,
            one(&fields.wig_wag, Quantity::Angle, "wig_wag")?,
            one(&fields.longitudinal, Quantity::Length, "longitudinal")?,
            one(&fields.angulation, Quantity::Angle, "angulation")?,
            one(&fields.orbital, Quantity::Angle, "orbital")?,
            one(&fields.detector_rotation, Quantity::Angle, "detector_rotation")?,
            one(&fields.source_to_detector, Quantity::Length, "source_to_detector")?,
        ];
        let beam = [
            one(&fields.tube_voltage, Quantity::Voltage, "tube_voltage")?,
            one(&fields.tube_current, Quantity::TubeCurrent, "tube_current")?,
            one(&fields.pulse_width, Quantity::Duration, "pulse_width")?,
            one(&fields.filter_aluminium, Quantity::Length, "filter_aluminium")?,
            one(&fields.filter_copper, Quantity::Length, "filter_copper")?,
        ];
        let xray_on = flag(fields.xray_on.as_ref(), "carm.xray_on", names)?;
        if !joints.iter().flatten().any(Number::is_read) && xray_on.is_none() {
            return Err(AdapterError::new("carm", "reads neither a joint nor xray_on, expected one of them at least"));
        }
        Ok(Self {
            joints,
            beam,
            field: numbers(fields.field.as_ref(), Quantity::Length, "carm.field", names)?,
            xray_on,
            counter: fields.exposure_counter.as_ref().map(|source| Counter::new(source, "carm.exposure_counter", names)),
            status: [
                flag(fields.fault.as_ref(), "carm.fault", names)?,
                flag(fields.emergency_stop.as_ref(), "carm.emergency_stop", names)?,
            ],
        })
    }

    fn read(&self, stamp: Stamp, texts: &Texts<'_>) -> Result<CarmSample, LineFault> {
        let one = |number: &Option<Number>| read(number.as_ref(), texts);
        let angle = |number: &Option<Number>| one(number).map(f64::to_radians);
        let [lift, wig_wag, longitudinal, angulation, orbital, detector_rotation, source_to_detector] = &self.joints;
        let [voltage, current, pulse, aluminium, copper] = &self.beam;
        Ok(CarmSample {
            device_us: stamp.device_us,
            sequence: stamp.sequence,
            joints: CarmJoints {
                lift_mm: one(lift)?,
                wig_wag_rad: angle(wig_wag)?,
                longitudinal_mm: one(longitudinal)?,
                angulation_rad: angle(angulation)?,
                orbital_rad: angle(orbital)?,
                detector_rotation_rad: angle(detector_rotation)?,
                source_to_detector_mm: one(source_to_detector)?,
            },
            tube_kvp: one(voltage)?,
            tube_ma: one(current)?,
            pulse_width_ms: one(pulse)?,
            filter_mm_al: one(aluminium)?,
            filter_mm_cu: one(copper)?,
            field_mm: self.field.as_ref().map_or(Ok([f64::NAN; 4]), |field| array(field, texts))?,
            xray_on: self.xray_on.as_ref().map_or(Ok(false), |flag| flag.read(texts))?,
            exposure_counter: self.counter.as_ref().map(|counter| counter.read(texts)).transpose()?.flatten(),
            status: bits(&self.status, texts)?,
        })
    }
}
