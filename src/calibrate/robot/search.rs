//! Where the robot is in a frame, from far: its predicted axis is shifted, turned and bent in the picture until it lies on a dark band
//! of its width that ends where the drill does.

use glam::DVec2;

use super::chain::{State, length_mm};
use super::measure::{Mark, outline};
use super::shot::Shot;
use crate::image::{Image, block_means, quantile};
use crate::scene::model::Robot;

/// Pixels of the coarse frame, mm in the specimen.
const PIXEL_MM: f64 = 0.7;
/// Stations of the axis.
const STATIONS: usize = 24;
/// Offsets common to all control angles that are tried, degrees.
const BENDS_DEG: [f64; 7] = [-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5];
/// Turns in the picture beyond the guess's own, degrees, and their step.
const TURN_STEP_DEG: f64 = 2.5;
/// Steps of shifts, mm.
const STEP_MM: f64 = 1.0;
/// Standard deviations of the guess within which the robot is sought.
const WITHIN: f64 = 1.6;
/// Uncertainty of a station's place after the search, across and along the axis, mm.
const SIGMA_MM: [f64; 2] = [1.0, 2.5];
/// Beside the body's rim, mm.
const BESIDE_MM: f64 = 1.2;
/// Of grey levels' range, what counts as a neper.
const GREY_STEP: f64 = 0.25;
/// The drill's end counts as so many stations.
const END_WEIGHT: f64 = 3.0;

/// Coarse marks of the robot in a shot, two for each station; empty where no band is dark all along.
pub(super) fn search(shot: &Shot, robot: &Robot, state: &State, n: usize, guess: (f64, f64)) -> Vec<Mark> {
    let stations_mm: Vec<f64> =
        (0..STATIONS).map(|k| (k as f64 + 0.5) * (length_mm(&robot.model) - 0.8) / STATIONS as f64).collect();
    let bent = |by_deg: &f64| {
        let mut bent = state.clone();
        bent.offsets_deg.iter_mut().for_each(|offset| *offset += by_deg);
        let posed = bent.posed(&robot.model, shot, n)?;
        let points = outline(shot, &posed, &stations_mm);
        (2 * points.len() > STATIONS).then_some(points)
    };
    let outlines: Vec<Vec<(f64, DVec2, DVec2, f64)>> = BENDS_DEG.iter().filter_map(bent).collect();
    let Some(px_per_mm) = outlines.first().and_then(|points| points.first()).map(|point| point.3) else { return Vec::new() };
    let factor = (PIXEL_MM * px_per_mm).floor().max(1.0) as usize;
    let means = block_means(&shot.attenuation, &shot.usable, factor);
    let band = Band { unit: unit(shot, &means), means, factor: factor as f64, robot };
    let (step_px, reach) = (STEP_MM * px_per_mm, (WITHIN * guess.0 / STEP_MM).ceil() as i64);
    let turns = (WITHIN * guess.1 / TURN_STEP_DEG).ceil() as i64;
    let mut best: Option<(f64, Vec<Mark>)> = None;
    for points in &outlines {
        let middle = points.iter().map(|point| point.1).sum::<DVec2>() / points.len() as f64;
        for turn in -turns..=turns {
            let turn = DVec2::from_angle((turn as f64 * TURN_STEP_DEG).to_radians());
            let turned: Vec<(f64, DVec2, DVec2, f64)> = points
                .iter()
                .map(|(s, at, tangent, scale)| (*s, middle + turn.rotate(*at - middle), turn.rotate(*tangent), *scale))
                .collect();
            for row in -reach..=reach {
                for column in -reach..=reach {
                    let shift = DVec2::new(column as f64, row as f64) * step_px;
                    let score = band.score(&turned, shift);
                    if best.as_ref().is_none_or(|(most, _)| score > *most) {
                        best = Some((score, marks(&turned, shift)));
                    }
                }
            }
        }
    }
    best.filter(|(score, _)| *score > 0.0).map(|(_, marks)| marks).unwrap_or_default()
}

fn marks(points: &[(f64, DVec2, DVec2, f64)], shift: DVec2) -> Vec<Mark> {
    let of = |(s_mm, at, tangent, scale): &(f64, DVec2, DVec2, f64)| {
        [(tangent.perp(), SIGMA_MM[0]), (*tangent, SIGMA_MM[1])].map(|(normal, sigma_mm)| Mark {
            s_mm: *s_mm,
            place_px: *at + shift,
            normal,
            sigma_px: sigma_mm * scale,
            is_end: false,
        })
    };
    points.iter().flat_map(of).collect()
}

/// What counts as one step of darkness: a neper, or of grey levels a share of their range.
fn unit(shot: &Shot, (means, usable): &(Image<f32>, Image<bool>)) -> f64 {
    if shot.in_nepers {
        return 1.0;
    }
    let counts = means.pixels.iter().zip(&usable.pixels).filter(|(value, usable)| **usable && value.is_finite());
    let mut values: Vec<f32> = counts.map(|(value, _)| *value).collect();
    let range = quantile(&mut values, 0.98).zip(quantile(&mut values, 0.02)).map_or(1.0, |(high, low)| high - low);
    (GREY_STEP * range).max(f64::MIN_POSITIVE)
}

struct Band<'a> {
    means: (Image<f32>, Image<bool>),
    /// Of darkness.
    unit: f64,
    factor: f64,
    robot: &'a Robot,
}

impl Band<'_> {
    fn at(&self, pixel: DVec2) -> Option<f64> {
        let place = (pixel + 0.5) / self.factor - 0.5;
        let near = place.round();
        let (means, usable) = &self.means;
        let inside = near.min_element() >= 0.0 && near.x < usable.width as f64 && near.y < usable.height as f64;
        if !inside || !*usable.at(near.x as usize, near.y as usize) {
            return None;
        }
        Some(f64::from(*means.at(near.x as usize, near.y as usize))).filter(|value| value.is_finite())
    }

    /// Mean over the stations of how much darker the band is than the darker of its two sides, and at its end than what lies beyond;
    /// each counts up to a limit, so that a few black pixels do not outweigh a band.
    fn score(&self, points: &[(f64, DVec2, DVec2, f64)], shift: DVec2) -> f64 {
        let rim_mm = 0.5 * self.robot.model.body.outer_diameter_mm;
        let mut sum = 0.0;
        for (_, at, tangent, scale) in points {
            let (at, normal) = (*at + shift, tangent.perp() * *scale);
            let place = |mm: f64| self.at(at + normal * mm);
            let inside = [-0.6, 0.0, 0.6].map(|share| place(share * rim_mm));
            let beside = [-1.0, 1.0].map(|side| place(side * (rim_mm + BESIDE_MM)));
            // Behind shutters and outside the frame nothing speaks for the robot.
            let ([Some(a), Some(b), Some(c)], [Some(left), Some(right)]) = (inside, beside) else { continue };
            sum += ((a.min(b).min(c) - left.max(right)) / self.unit).clamp(-1.0, 1.0);
        }
        if let Some((_, at, tangent, scale)) = points.last() {
            let beyond = |mm: f64| self.at(*at + shift + *tangent * (*scale * mm));
            if let (Some(inside), Some(outside)) = (beyond(-0.5), beyond(3.5)) {
                sum += END_WEIGHT * ((inside - outside) / self.unit).clamp(-1.0, 1.0);
            }
        }
        sum / points.len() as f64
    }
}
