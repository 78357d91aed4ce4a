//! Acquired minus simulated, as strips and the window show it.

use rayon::prelude::*;

use super::colour;
use crate::compare::Pictures;
use crate::image::{Image, quantile};

/// In place of a difference between what has no common unit.
pub const NOT_COMPARABLE: &str = "gray values and nepers have no difference; --tone monotone relates them";

/// How the difference of two pictures is shown: only where both mean something, about a common zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SignedDifference {
    /// Taken off everywhere: the median, where the pictures have no common zero.
    pub offset: f64,
    /// The ends of the colour scale are at ± this.
    pub limit: f64,
    /// Of offset and limit.
    pub unit: &'static str,
    /// Whether the pictures have a common unit at all.
    pub comparable: bool,
}

impl SignedDifference {
    /// The scale for `pictures`, and the difference itself: NaN where it means nothing.
    #[must_use]
    pub fn of(pictures: &Pictures) -> (Self, Image<f32>) {
        let Pictures { acquired, simulated, usable, .. } = pictures;
        let signed =
            |((usable, acquired), simulated): ((&bool, &f32), &f32)| if *usable { acquired - simulated } else { f32::NAN };
        let pixels = usable.pixels.par_iter().zip(&acquired.pixels).zip(&simulated.pixels).map(signed).collect();
        let difference = Image { width: acquired.width, height: acquired.height, pixels };
        // Nepers of unknown offset have no common zero; their medians are laid upon each other.
        let offset = if pictures.unit == "nepers (offset unknown)" { median(&difference) } else { 0.0 };
        let difference = if offset == 0.0 { difference } else { difference.map(|d| d - offset as f32) };
        let comparable = !pictures.unit.starts_with("gray") || spread_is_common(pictures);
        let unit = if offset == 0.0 { pictures.unit } else { "nepers, median removed" };
        (Self { offset, limit: symmetric_limit(&difference), unit, comparable }, difference)
    }

    /// Gray windows of both pictures: one where they have a common zero, the same width about medians that are laid upon each other where they
    /// have not, and each its own where they have no common unit.
    #[must_use]
    pub fn windows(&self, pictures: &Pictures) -> [[f64; 2]; 2] {
        let Pictures { acquired, simulated, usable, .. } = pictures;
        if !self.comparable {
            return [acquired, simulated].map(|image| colour::window(&[image], Some(usable)));
        }
        let moved = (self.offset != 0.0).then(|| simulated.map(|value| value + self.offset as f32));
        let window = colour::window(&[acquired, moved.as_ref().unwrap_or(simulated)], Some(usable));
        [window, window.map(|end| end - self.offset)]
    }

    /// The difference of two pixels that mean something.
    #[must_use]
    pub fn between(&self, acquired: f32, simulated: f32) -> f32 {
        acquired - simulated - self.offset as f32
    }
}

/// Gray values are comparable with the simulation once a tone has brought it to their range.
fn spread_is_common(pictures: &Pictures) -> bool {
    let (a, s) = (
        colour::window(&[&pictures.acquired], Some(&pictures.usable)),
        colour::window(&[&pictures.simulated], Some(&pictures.usable)),
    );
    let (wide_a, wide_s) = (a[1] - a[0], s[1] - s[0]);
    let apart = (0.5 * (a[0] + a[1]) - 0.5 * (s[0] + s[1])).abs();
    wide_a < 4.0 * wide_s && wide_s < 4.0 * wide_a && apart < wide_a.max(wide_s)
}

fn median(image: &Image<f32>) -> f64 {
    let mut values: Vec<f32> = image.pixels.iter().copied().filter(|v| v.is_finite()).collect();
    quantile(&mut values, 0.5).unwrap_or(0.0)
}

/// A round limit that 99 % of the differences stay within.
fn symmetric_limit(difference: &Image<f32>) -> f64 {
    let mut sizes: Vec<f32> = difference.pixels.iter().filter(|v| v.is_finite()).map(|v| v.abs()).collect();
    let at = (sizes.len().max(1) - 1) * 99 / 100;
    colour::round_up(colour::ranked(&mut sizes, at).unwrap_or(0.0).max(1e-6))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pictures(unit: &'static str, level: f32, scale: f32) -> Pictures {
        let simulated = Image { width: 40, height: 30, pixels: (0..1200).map(|n| (n % 40) as f32 * 0.1).collect() };
        let usable = simulated.map(|value| *value < 3.5);
        // What is masked is far from all else.
        let acquired = simulated.map(|value| if *value < 3.5 { scale * value + level } else { 90.0 });
        let nowhere = usable.map(|_| false);
        Pictures { acquired, edges: usable.clone(), simulated, usable, shut_off: nowhere, unit }
    }

    #[test]
    fn pictures_without_a_common_zero_are_shown_in_the_same_grays() {
        let of = |pictures: &Pictures| SignedDifference::of(pictures).0.windows(pictures);
        let width = |window: [f64; 2]| window[1] - window[0];
        let [acquired, simulated] = of(&pictures("nepers (offset unknown)", -10.0, 1.0));
        assert!(acquired[1] < -6.0 && simulated[0] > -1.0, "{acquired:?} {simulated:?}");
        assert!(width(acquired) < 4.0 && (width(acquired) - width(simulated)).abs() < 1e-9);
        // With a common zero there is one window, whatever lies between them.
        let [acquired, simulated] = of(&pictures("nepers", -1.0, 1.0));
        assert!(acquired == simulated && acquired[0] < -0.9 && acquired[1] > 3.4, "{acquired:?}");
        let [acquired, simulated] = of(&pictures("gray values", 500.0, 100.0));
        assert!(acquired[0] > 400.0 && simulated[1] < 4.0, "{acquired:?} {simulated:?}");
    }
}
