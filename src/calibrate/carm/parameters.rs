//! What a C-arm's calibration may change, each with how far it usually lies from nominal.
//!
//! The priors are weak where bead shots decide, and narrow where only evidence may: what the shots leave undetermined stays at nominal, and its
//! standard deviation says so. Left out because nothing but the specimen's place in the room tells them apart: offsets of lift, wig-wag and
//! longitudinal travel.

use crate::geometry::{CarmCalibration, GravitySag, SAG_TERMS};

/// Terms of first order in gravity; the others say how the stiffness changes along the orbit.
const FIRST_ORDER: usize = 3;
/// Offsets of angle encoders, turns of axes and panel.
const ANGLE_DEG: f64 = 2.0;
/// Deflections of first and of second order: mm of focal spot and detector, degrees.
const SAG_MM: (f64, f64) = (10.0, 1.5);
const SAG_DEG: (f64, f64) = (2.0, 0.3);

#[derive(Clone, Copy, Debug, PartialEq)]
enum Target {
    AngulationOffset,
    OrbitalOffset,
    DetectorRotationOffset,
    SourceToDetectorOffset,
    PrincipalPoint(usize),
    ColumnToIsocentre(usize),
    SourceToIsocentre,
    PrincipalRay(usize),
    AngulationAxisTilt,
    OrbitalAxisSkew,
    OrbitalAxisOffset,
    DetectorTilt(usize),
    DetectorOffset(usize),
    SagOfSource(usize, usize),
    SagOfRotation(usize, usize),
    SagOfDetector(usize, usize),
}

/// A number of [`CarmCalibration`] that is fitted.
#[derive(Clone, Debug, PartialEq)]
pub struct Parameter {
    /// Key in the file, with its unit and its place in a list.
    pub key: String,
    /// Standard deviation about nominal before any shot is seen, in the key's unit.
    pub prior_sigma: f64,
    target: Target,
}

impl Parameter {
    fn new(key: impl Into<String>, prior_sigma: f64, target: Target) -> Self {
        Self { key: key.into(), prior_sigma, target }
    }

    /// All of them, for a panel of `pitch_mm`.
    #[must_use]
    pub fn all(pitch_mm: f64) -> Vec<Self> {
        let mut all = vec![
            Self::new("offsets.angulation_deg", ANGLE_DEG, Target::AngulationOffset),
            Self::new("offsets.orbital_deg", ANGLE_DEG, Target::OrbitalOffset),
            Self::new("offsets.detector_rotation_deg", ANGLE_DEG, Target::DetectorRotationOffset),
            Self::new("offsets.source_to_detector_mm", 10.0, Target::SourceToDetectorOffset),
            Self::new("source_to_isocentre_mm", 30.0, Target::SourceToIsocentre),
            Self::new("misalignment.angulation_axis_tilt_deg", 1.0, Target::AngulationAxisTilt),
            Self::new("misalignment.orbital_axis_skew_deg", 1.0, Target::OrbitalAxisSkew),
            Self::new("misalignment.orbital_axis_offset_mm", 30.0, Target::OrbitalAxisOffset),
        ];
        for axis in 0..2 {
            all.push(Self::new(format!("principal_point_px[{axis}]"), 5.0 / pitch_mm, Target::PrincipalPoint(axis)));
            all.push(Self::new(format!("principal_ray_offset_mm[{axis}]"), 30.0, Target::PrincipalRay(axis)));
            all.push(Self::new(format!("misalignment.detector_tilt_deg[{axis}]"), ANGLE_DEG, Target::DetectorTilt(axis)));
            all.push(Self::new(format!("misalignment.detector_offset_mm[{axis}]"), 10.0, Target::DetectorOffset(axis)));
        }
        for axis in 0..3 {
            all.push(Self::new(format!("column_to_isocentre_mm[{axis}]"), 30.0, Target::ColumnToIsocentre(axis)));
        }
        for (axis, term) in (0..3).flat_map(|axis| (0..SAG_TERMS).map(move |term| (axis, term))) {
            let of_order = |(first, second): (f64, f64)| if term < FIRST_ORDER { first } else { second };
            let mut sag = |table: &str, sigma: f64, target: Target| {
                all.push(Self::new(format!("gravity_sag.{table}[{axis}][{term}]"), sigma, target));
            };
            sag("source_mm", of_order(SAG_MM), Target::SagOfSource(axis, term));
            sag("rotation_deg", of_order(SAG_DEG), Target::SagOfRotation(axis, term));
            // The distance to the detector scales the image by a few parts in a thousand: first order is more than enough.
            if axis < 2 {
                sag("detector_mm", of_order(SAG_MM), Target::SagOfDetector(axis, term));
            } else if term < FIRST_ORDER {
                sag("detector_mm", 2.0, Target::SagOfDetector(axis, term));
            }
        }
        all
    }

    /// Its number in `carm`, made if it is not there.
    fn of<'a>(&self, carm: &'a mut CarmCalibration) -> &'a mut f64 {
        let middle = [f64::from(carm.columns_px) * 0.5 - 0.5, f64::from(carm.rows_px) * 0.5 - 0.5];
        let sag = |carm: &'a mut CarmCalibration| carm.gravity_sag.get_or_insert_with(GravitySag::default);
        match self.target {
            Target::AngulationOffset => &mut carm.offsets.angulation_deg,
            Target::OrbitalOffset => &mut carm.offsets.orbital_deg,
            Target::DetectorRotationOffset => &mut carm.offsets.detector_rotation_deg,
            Target::SourceToDetectorOffset => &mut carm.offsets.source_to_detector_mm,
            Target::PrincipalPoint(axis) => &mut carm.principal_point_px.get_or_insert(middle)[axis],
            Target::ColumnToIsocentre(axis) => &mut carm.column_to_isocentre_mm[axis],
            Target::SourceToIsocentre => &mut carm.source_to_isocentre_mm,
            Target::PrincipalRay(axis) => &mut carm.principal_ray_offset_mm[axis],
            Target::AngulationAxisTilt => &mut carm.misalignment.angulation_axis_tilt_deg,
            Target::OrbitalAxisSkew => &mut carm.misalignment.orbital_axis_skew_deg,
            Target::OrbitalAxisOffset => &mut carm.misalignment.orbital_axis_offset_mm,
            Target::DetectorTilt(axis) => &mut carm.misalignment.detector_tilt_deg[axis],
            Target::DetectorOffset(axis) => &mut carm.misalignment.detector_offset_mm[axis],
            Target::SagOfSource(axis, term) => &mut sag(carm).source_mm[axis][term],
            Target::SagOfRotation(axis, term) => &mut sag(carm).rotation_deg[axis][term],
            Target::SagOfDetector(axis, term) => &mut sag(carm).detector_mm[axis][term],
        }
    }

    /// The number as `carm` has it.
    #[must_use]
    pub fn value(&self, carm: &CarmCalibration) -> f64 {
        *self.of(&mut carm.clone())
    }

    /// Moves the number by so many of its prior's standard deviations.
    pub fn shift(&self, carm: &mut CarmCalibration, sigmas: f64) {
        *self.of(carm) += sigmas * self.prior_sigma;
    }
}

/// `nominal` with every parameter moved by its number of prior standard deviations.
#[must_use]
pub fn moved(nominal: &CarmCalibration, parameters: &[Parameter], sigmas: &[f64]) -> CarmCalibration {
    let mut carm = nominal.clone();
    parameters.iter().zip(sigmas).for_each(|(parameter, sigmas)| parameter.shift(&mut carm, *sigmas));
    carm
}
