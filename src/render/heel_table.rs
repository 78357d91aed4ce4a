//! What the anode's heel leaves of the tube's output, by energy and take-off angle.

use glam::DVec3;

use super::RenderError;
use super::plan_parts::Node;
use crate::scene::optics::Heel;
use crate::scene::physics::{ANODE_ANGLES_DEG, Spectrum};

/// Tungsten output at each node over that on the principal ray, by take-off angle in whole degrees.
// The tables hold even angles and are interpolated linearly, so whole degrees lose nothing.
pub(super) struct HeelTable {
    heel: Heel,
    rows: Vec<Vec<f64>>,
    /// ln of how much more there is at the end of the first and the last whole degree than at its beginning, at least 0; NaN where there
    /// was none.
    rises: [Vec<f64>; 2],
}

impl HeelTable {
    pub(super) fn new(heel: Heel, nodes: &[Node], padded: usize) -> Result<Self, RenderError> {
        let at = |angle_deg: f64| Spectrum::tungsten_output(heel.tube_kvp, angle_deg, &[]);
        let centre = at(heel.anode_angle_deg)?;
        let first_kev = centre.bins.first().map_or(0.0, |bin| bin.energy_kev - 0.5);
        let index = |node: &Node| ((node.energy_kev - first_kev).max(0.0) as usize).min(centre.bins.len().saturating_sub(1));
        let mut rows = Vec::new();
        for angle_deg in ANODE_ANGLES_DEG.0 as u32..=ANODE_ANGLES_DEG.1 as u32 {
            let output = at(f64::from(angle_deg))?;
            let share = |node: &Node| {
                let (here, there) = (output.bins[index(node)].fluence, centre.bins[index(node)].fluence);
                if there > 0.0 { here / there } else { 1.0 }
            };
            let mut row: Vec<f64> = nodes.iter().map(share).collect();
            row.resize(padded, 0.0);
            rows.push(row);
        }
        let rise = |first: usize| {
            let pairs = rows[first].iter().zip(&rows[first + 1]);
            pairs.map(|(low, high)| if *low > 0.0 { (high / low).max(1.0).ln() } else { f64::NAN }).collect()
        };
        let rises = [rise(0), rise(rows.len() - 2)];
        Ok(Self { heel, rows, rises })
    }

    /// Factors for a ray of the camera; false where nothing comes out.
    // Beyond the tables, ln of the output is linear in 1/sin of the angle, to which the mean path inside the target is proportional; it
    // never falls as the angle grows, as single tabulated bins at the end of the spectrum do by rounding.
    pub(super) fn fill(&self, ray: DVec3, factors: &mut [f32]) -> bool {
        let sine = self.heel.sine_of_take_off(ray);
        if !(sine > 0.0) {
            return false;
        }
        let (first_deg, last_deg) = ANODE_ANGLES_DEG;
        let angle_deg = sine.asin().to_degrees();
        let position = (angle_deg.clamp(first_deg, last_deg) - first_deg).min((self.rows.len() - 2) as f64 + 1.0);
        let below = (position as usize).min(self.rows.len() - 2);
        let (low, high) = (&self.rows[below], &self.rows[below + 1]);
        let weight = position - below as f64;
        if !Self::is_outside(sine) {
            for ((factor, low), high) in factors.iter_mut().zip(low).zip(high) {
                *factor = (low + (high - low) * weight) as f32;
            }
            return true;
        }
        let inverse_sine = |degrees: f64| 1.0 / degrees.to_radians().sin();
        let (a, b) = (first_deg + below as f64, first_deg + below as f64 + 1.0);
        let step = (1.0 / sine - inverse_sine(a)) / (inverse_sine(b) - inverse_sine(a));
        // The weight is 0 or 1 outside, so that the table's end is what goes on.
        let (end, rises) = if weight > 0.5 { (high, &self.rises[1]) } else { (low, &self.rises[0]) };
        for ((factor, end), rise) in factors.iter_mut().zip(end).zip(rises) {
            *factor = if rise.is_nan() { *end } else { end * (rise * (step - weight)).exp() } as f32;
        }
        true
    }

    /// Whether the take-off angle of a ray lies beyond the tables.
    pub(super) fn is_beyond(&self, ray: DVec3) -> bool {
        Self::is_outside(self.heel.sine_of_take_off(ray))
    }

    fn is_outside(sine: f64) -> bool {
        let (first_deg, last_deg) = ANODE_ANGLES_DEG;
        sine < first_deg.to_radians().sin() || sine > last_deg.to_radians().sin()
    }
}
