//! How deep a shadow may be at a place: a bead that should be seen and is not speaks against a pose.

use glam::DVec2;

use super::detect::Polarity;
use crate::acquire::{Domain, Frame};
use crate::image::Image;

/// Looks at places of a frame.
#[derive(Clone, Copy, Debug)]
pub struct Probe<'a> {
    frame: &'a Frame,
    usable: &'a Image<bool>,
    polarity: Polarity,
}

/// Radii (in those of the shadow) of the disc that is looked at, and of the ring around it.
const DISC: f64 = 0.7;
const RING: (f64, f64) = (1.4, 2.1);
/// Share of disc and ring that must be usable.
const COVERED: f64 = 0.8;
/// Mean over the disc of a sphere's chord, as a share of its diameter; blur makes it less.
const MEAN_CHORD: f64 = 0.7;

/// Sum, sum of squares, count.
#[derive(Clone, Copy, Default)]
struct Moments([f64; 3]);

impl Moments {
    fn take(&mut self, value: f64) {
        self.0.iter_mut().zip([value, value * value, 1.0]).for_each(|(sum, term)| *sum += term);
    }

    fn mean(&self) -> f64 {
        self.0[0] / self.0[2]
    }

    fn variance(&self) -> f64 {
        (self.0[1] / self.0[2] - self.mean().powi(2)).max(0.0)
    }
}

impl<'a> Probe<'a> {
    /// For a frame in which metal goes the way of `polarity`.
    #[must_use]
    pub fn new(frame: &'a Frame, usable: &'a Image<bool>, polarity: Polarity) -> Self {
        Self { frame, usable, polarity }
    }

    /// Whether values are proportional to quanta, or logarithms of such.
    #[must_use]
    pub fn is_quantitative(&self) -> bool {
        match self.frame.domain {
            Domain::Linear => true,
            Domain::Log => self.frame.unit.as_deref() == Some("neper"),
            Domain::Display | Domain::Unknown => false,
        }
    }

    /// Whether the place may be used at all.
    #[must_use]
    pub fn is_usable(&self, at_px: DVec2) -> bool {
        let inside = at_px.x > -0.5 && at_px.y > -0.5;
        inside && self.usable_at(at_px.x.round() as usize, at_px.y.round() as usize)
    }

    fn usable_at(&self, column: usize, row: usize) -> bool {
        column < self.usable.width && row < self.usable.height && *self.usable.at(column, row)
    }

    /// Depth of a sphere's shadow of `radius_px` at `at_px` as a detection's contrast has it, and its standard deviation, structure of the
    /// surroundings included; `None` where too little of the place can be used, or where the frame is saturated or black all about: what is in
    /// front of that does not show.
    #[must_use]
    pub fn contrast(&self, at_px: DVec2, radius_px: f64) -> Option<(f64, f64)> {
        let radius = radius_px.max(1.5);
        let reach = RING.1 * radius;
        if !(at_px.is_finite() && reach < 200.0) {
            return None;
        }
        let (mut disc, mut ring, mut sectors) = (Moments::default(), Moments::default(), [Moments::default(); 8]);
        let (mut wanted, mut saturated) = (0u32, 0.0);
        // Pixels of disc and ring below which the scale has nothing.
        let mut black = [0.0; 2];
        let range = |centre: f64| (centre - reach).floor() as i64..=(centre + reach).ceil() as i64;
        for row in range(at_px.y) {
            for column in range(at_px.x) {
                let d = DVec2::new(column as f64, row as f64) - at_px;
                let distance = d.length() / radius;
                let in_ring = distance >= RING.0 && distance <= RING.1;
                if !(in_ring || distance <= DISC) {
                    continue;
                }
                wanted += 1;
                let (Ok(column), Ok(row)) = (usize::try_from(column), usize::try_from(row)) else { continue };
                if !self.usable_at(column, row) {
                    continue;
                }
                let value = self.value(column, row);
                let is_black = self.frame.clipping.black_at == Some(*self.frame.pixels.at(column, row));
                black[usize::from(in_ring)] += f64::from(u8::from(is_black));
                if in_ring {
                    let sector = ((d.y.atan2(d.x) / std::f64::consts::TAU + 0.5) * 8.0) as usize;
                    sectors[sector.min(7)].take(value);
                    ring.take(value);
                } else {
                    disc.take(value);
                    saturated +=
                        f64::from(u8::from(self.frame.clipping.saturated_at == Some(*self.frame.pixels.at(column, row))));
                }
            }
        }
        let seen = disc.0[2] + ring.0[2];
        let hidden = black[0] > 0.5 * disc.0[2] && black[1] > 0.5 * ring.0[2];
        if hidden || saturated > 0.5 * disc.0[2] {
            return None;
        }
        if !(disc.0[2] >= 2.0 && ring.0[2] >= 8.0 && seen >= COVERED * f64::from(wanted)) {
            return None;
        }
        let means: Vec<f64> = sectors.iter().filter(|sector| sector.0[2] > 0.0).map(Moments::mean).collect();
        let structure = means.iter().map(|mean| (mean - ring.mean()).powi(2)).sum::<f64>() / means.len().max(1) as f64;
        let within = sectors.iter().filter(|s| s.0[2] > 1.0).map(|s| s.variance() * s.0[2]).sum::<f64>() / ring.0[2];
        let sigma = (structure / 4.0 + within / disc.0[2] + within / ring.0[2]).sqrt();
        let (depth, sigma) = if self.is_transmission() {
            let least = 0.02 * ring.mean().abs();
            let (here, around) = (disc.mean().max(least), ring.mean());
            if !(around > 0.0) {
                return None;
            }
            ((around / here).ln(), sigma / here.min(around))
        } else {
            let sign = if self.polarity == Polarity::Bright { 1.0 } else { -1.0 };
            (sign * (disc.mean() - ring.mean()), sigma)
        };
        (depth.is_finite() && sigma.is_finite()).then_some((depth / MEAN_CHORD, sigma / MEAN_CHORD))
    }

    fn is_nepers(&self) -> bool {
        self.frame.domain == Domain::Log && self.frame.unit.as_deref() == Some("neper")
    }

    fn is_transmission(&self) -> bool {
        self.frame.domain == Domain::Linear || self.is_nepers()
    }

    fn value(&self, column: usize, row: usize) -> f64 {
        let value = f64::from(*self.frame.pixels.at(column, row));
        if self.is_nepers() { (-value).clamp(-80.0, 80.0).exp() } else { value }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_shadow_is_deep_and_nothing_is_not() {
        let mut pixels = Image { width: 80, height: 60, pixels: (0..4800).map(|n| 1000.0 + (n % 80) as f32).collect() };
        for row in 0..60usize {
            for column in 0..80usize {
                let rho = DVec2::new(column as f64 - 20.0, row as f64 - 30.0).length() / 6.0;
                if rho < 1.0 {
                    *pixels.at_mut(column, row) *= (-0.8 * (1.0 - rho * rho).sqrt()).exp() as f32;
                }
            }
        }
        let usable = Image::filled(80, 60, true);
        let frame = Frame::from_pixels("probed", pixels, Domain::Linear).expect("a frame");
        let probe = Probe::new(&frame, &usable, Polarity::Dark);
        let (deep, sigma) = probe.contrast(DVec2::new(20.0, 30.0), 6.0).expect("inside");
        assert!((0.7..1.1).contains(&deep) && sigma < 0.1, "{deep} {sigma}");
        let (none, sigma) = probe.contrast(DVec2::new(55.0, 30.0), 6.0).expect("inside");
        assert!(none.abs() < 0.05 && sigma < 0.05, "{none} {sigma}");
        assert!(probe.contrast(DVec2::new(1.0, 1.0), 6.0).is_none() && probe.contrast(DVec2::NAN, 6.0).is_none());
        // Where the panel gives no more than this nobody sees what is in front of it; a shadow that goes below it is seen.
        let mut clipped = frame.clone();
        clipped.pixels = clipped.pixels.map(|value| value.min(900.0));
        clipped.clipping.saturated_at = Some(900.0);
        let probe = Probe::new(&clipped, &usable, Polarity::Dark);
        assert!(probe.contrast(DVec2::new(55.0, 30.0), 6.0).is_none());
        assert!(probe.contrast(DVec2::new(20.0, 30.0), 6.0).is_some_and(|(depth, _)| depth > 0.6));
        // Nor where a display has cut off all that is so dark.
        let mut dark = frame.clone();
        dark.pixels = dark.pixels.map(|value| (value - 2000.0).max(0.0));
        dark.clipping.black_at = Some(0.0);
        let probe = Probe::new(&dark, &usable, Polarity::Dark);
        assert!(probe.contrast(DVec2::new(20.0, 30.0), 6.0).is_none());
    }
}
