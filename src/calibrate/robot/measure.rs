//! Where the robot's shadow is in a frame, near where the model has it: profiles across the axis at many stations, and one along it at
//! the tip, each against what the model casts there.

use glam::{DVec2, DVec3};

use super::chain::{Posed, length_mm, on_axis};
use super::metal::{Metal, Rods};
use super::profile::{self, Sampled};
use super::shot::Shot;
use crate::scene::model::Robot;

/// Distance of stations along the axis, mm; a station averages over its own stretch.
const STATION_MM: f64 = 1.2;
/// Background beside the robot that a profile takes in, mm.
const BACKGROUND_MM: f64 = 2.0;
/// An axis seen shorter than this share runs along the beam: nothing is measured there.
const LEAST_SEEN: f64 = 0.35;
/// Inside the drill that the profile at its end takes in, mm.
const INSIDE_MM: f64 = 2.5;
/// Shares of the drill's length at which it is measured across.
const ON_DRILL: [f64; 3] = [0.2, 0.5, 0.8];
/// Contrast over its standard deviation, and share of the squares explained, from which on a profile is the robot's.
const LEAST_SIGNIFICANCE: f64 = 6.0;
const LEAST_EXPLAINED: f64 = 0.5;
/// Contrast in units of what the spectrum lets expect, where the frame is in nepers.
const CONTRASTS: (f64, f64) = (0.3, 2.0);
/// No edge is known better: px.
const FLOOR_PX: f64 = 0.04;
/// Steps of a template, px.
const TEMPLATE_STEP_PX: f64 = 0.5;

/// A measured place: the axis' point at `s_mm` lies at `place_px` along `normal`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Mark {
    pub s_mm: f64,
    pub place_px: DVec2,
    /// Of length 1.
    pub normal: DVec2,
    pub sigma_px: f64,
    /// The drill's end along the axis.
    pub is_end: bool,
}

/// Stations along the axis, mm from the base.
pub(super) fn stations_mm(robot: &Robot) -> Vec<f64> {
    let body_mm = robot.model.length_mm;
    let drill_mm = length_mm(&robot.model) - body_mm;
    let count = (body_mm / STATION_MM).floor().max(1.0) as usize;
    let on_body = (0..count).map(|n| (n as f64 + 0.5) * body_mm / count as f64);
    on_body.chain(ON_DRILL.map(|share| body_mm + share * drill_mm)).collect()
}

/// A point of the axis in the frame.
struct Station {
    s_mm: f64,
    at: DVec2,
    tangent: DVec2,
    px_per_mm: f64,
    /// Length in the frame over length.
    seen: f64,
}

fn station(shot: &Shot, posed: &Posed, s_mm: f64) -> Option<Station> {
    let place = |s_mm: f64| shot.image(posed.lps_from_base.transform_point(on_axis(&posed.shape, s_mm)));
    let ((at, depth_mm), half_mm) = (place(s_mm)?, 0.5 * STATION_MM);
    let along = place(s_mm + half_mm)?.0 - place(s_mm - half_mm)?.0;
    let px_per_mm = shot.view.intrinsics.fx / depth_mm;
    let seen = along.length() / (2.0 * half_mm * px_per_mm);
    (seen > LEAST_SEEN).then(|| Station { s_mm, at, tangent: along.normalize(), px_per_mm, seen })
}

/// What is needed of a shot to measure in it.
struct Cast<'a> {
    shot: &'a Shot,
    metal: &'a Metal,
    rods: Rods,
    focal_spot: DVec3,
}

impl Cast<'_> {
    /// What the model casts at a pixel, nepers.
    fn nepers(&self, pixel: DVec2, scratch: &mut Vec<(usize, f64, f64)>) -> f64 {
        let in_camera = self.shot.view.intrinsics.unproject(pixel);
        let direction = (self.shot.view.camera_from_lps.rotation.conjugate() * in_camera).normalize();
        self.metal.nepers(self.rods.paths_mm(self.focal_spot, direction, scratch))
    }

    /// Mean over a line of points about `middle`, along `line`, of what the frame shows; `None` where less than half is usable.
    fn shown(&self, middle: DVec2, line: DVec2, half_px: f64) -> Option<f64> {
        let steps = half_px.round().max(0.0) as i64;
        let (mut sum, mut count) = (0.0, 0);
        for n in -steps..=steps {
            let at = middle + line * (n as f64 * half_px / steps.max(1) as f64);
            let near = at.round();
            let inside = near.min_element() >= 0.0
                && near.x < self.shot.usable.width as f64
                && near.y < self.shot.usable.height as f64
                && *self.shot.usable.at(near.x as usize, near.y as usize);
            if let Some(value) = self.shot.attenuation.bilinear(at.x, at.y).filter(|value| inside && value.is_finite()) {
                sum += value;
                count += 1;
            }
        }
        (2 * count > 2 * steps).then(|| sum / count as f64)
    }

    /// Fits the profile through `at` along `along` between `from_px` and `to_px`, averaged over `half_px` along the line across it.
    fn fit(
        &self,
        at: DVec2,
        along: DVec2,
        span_px: (f64, f64),
        half_px: f64,
        reach_px: f64,
        degree: usize,
    ) -> Option<profile::Shift> {
        let line = along.perp();
        let samples: Vec<(f64, f64)> = (span_px.0.ceil() as i64..=span_px.1.floor() as i64)
            .filter_map(|x| Some((x as f64, self.shown(at + along * x as f64, line, half_px)?)))
            .collect();
        let mut scratch = Vec::new();
        let first = span_px.0 - reach_px;
        let count = ((span_px.1 - span_px.0 + 2.0 * reach_px) / TEMPLATE_STEP_PX).ceil() as usize + 1;
        let mut cast = |n: usize| {
            let middle = at + along * (first + n as f64 * TEMPLATE_STEP_PX);
            [-0.67, 0.0, 0.67].map(|share| self.nepers(middle + line * (share * half_px), &mut scratch)).iter().sum::<f64>() / 3.0
        };
        let template = Sampled { first, step: TEMPLATE_STEP_PX, values: (0..count).map(&mut cast).collect() };
        let found = profile::fit(&samples, &template, reach_px, degree)?;
        let is_metal = found.contrast > LEAST_SIGNIFICANCE * found.contrast_sigma
            && found.explained > LEAST_EXPLAINED
            && (!self.shot.in_nepers || (CONTRASTS.0..=CONTRASTS.1).contains(&found.contrast));
        is_metal.then_some(found)
    }
}

/// Measures a shot about the model's prediction, up to `reach_mm` from it; `with_end` the drill's end as well.
pub(super) fn measure(shot: &Shot, robot: &Robot, metal: &Metal, posed: &Posed, reach_mm: f64, with_end: bool) -> Vec<Mark> {
    let solids = robot.solids(&posed.shape, &posed.lps_from_base);
    let focal_spot = shot.view.camera_from_lps.inverse().translation_mm;
    let cast = Cast { shot, metal, rods: Rods::of(robot, &solids), focal_spot };
    let widest_mm = 0.5 * robot.model.body.outer_diameter_mm.max(robot.model.drill.outer_diameter_mm);
    let across = |s_mm: f64| {
        let Station { s_mm, at, tangent, px_per_mm, seen } = station(shot, posed, s_mm)?;
        let normal = tangent.perp();
        let half_px = (widest_mm + reach_mm + BACKGROUND_MM) * px_per_mm;
        let stretch_px = 0.5 * STATION_MM * seen * px_per_mm;
        let found = cast.fit(at, normal, (-half_px, half_px), stretch_px, reach_mm * px_per_mm, 2)?;
        let sigma_px = found.sigma_px.hypot(FLOOR_PX);
        Some(Mark { s_mm, place_px: at + normal * found.px, normal, sigma_px, is_end: false })
    };
    let mut marks: Vec<Mark> = stations_mm(robot).into_iter().filter_map(across).collect();
    let end = || {
        let end_mm = length_mm(&robot.model);
        let Station { s_mm, at, tangent, px_per_mm, seen } = station(shot, posed, end_mm - 0.5 * STATION_MM)?;
        let span_px = (-INSIDE_MM * seen * px_per_mm, (BACKGROUND_MM + reach_mm) * px_per_mm);
        let half_px = 0.25 * robot.model.drill.outer_diameter_mm * px_per_mm;
        let found = cast.fit(at, tangent, span_px, half_px, reach_mm * px_per_mm, 1)?;
        let sigma_px = found.sigma_px.hypot(FLOOR_PX);
        Some(Mark { s_mm, place_px: at + tangent * found.px, normal: tangent, sigma_px, is_end: true })
    };
    if with_end {
        marks.extend(end());
    }
    marks
}

/// Places of the axis for a coarse search: each station's point, tangent and scale.
pub(super) fn outline(shot: &Shot, posed: &Posed, stations_mm: &[f64]) -> Vec<(f64, DVec2, DVec2, f64)> {
    let of = |s_mm: &f64| station(shot, posed, *s_mm).map(|found| (found.s_mm, found.at, found.tangent, found.px_per_mm));
    stations_mm.iter().filter_map(of).collect()
}
