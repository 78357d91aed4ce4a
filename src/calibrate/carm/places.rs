//! What shots state of the beads' places: of one bead one place, and it is known as well as the most certain of them has it.
//!
//! The specimen has one place in the room for all shots, so their beads must be those of one layout in one scan's axes.

use std::collections::BTreeMap;

use glam::DVec3;

use super::CarmFitError;
use super::shot::{Shot, ShotBead};

/// Squared standard deviations (three degrees of freedom) beyond which two places are not one: 4 in 10⁶.
const SAME_PLACE: f64 = 27.6;

/// What a shot states of a bead.
#[derive(Clone, Copy)]
struct Stated<'s> {
    shot: &'s Shot,
    bead: &'s ShotBead,
}

impl Stated<'_> {
    fn is_alike(&self, other: &Self) -> bool {
        self.bead.lps_mm == other.bead.lps_mm && self.bead.place_mm2 == other.bead.place_mm2
    }

    /// Σ of variances along the axes, mm².
    fn variance_mm2(&self) -> f64 {
        let own = self.bead.place_mm2;
        own.x_axis.x + own.y_axis.y + own.z_axis.z
    }

    /// Squared distance in standard deviations of both, taken as independent; infinite where a number is none.
    fn off_sigmas2(&self, other: &Self) -> f64 {
        let off = self.bead.lps_mm - other.bead.lps_mm;
        if off == DVec3::ZERO {
            return 0.0;
        }
        let squares = off.dot((self.bead.place_mm2 + other.bead.place_mm2).inverse() * off);
        if squares.is_finite() { squares } else { f64::INFINITY }
    }
}

/// The shots, with one place and covariance of each bead: where several are stated, those of the smallest covariance, by its trace.
///
/// # Errors
/// [`CarmFitError::OtherPlace`], of the two statements that differ most, where two of one bead are farther apart than their covariances
/// allow.
pub(super) fn agreed(shots: &[Shot]) -> Result<Vec<Shot>, CarmFitError> {
    let mut stated: BTreeMap<&str, Vec<Stated>> = BTreeMap::new();
    for shot in shots {
        for bead in &shot.beads {
            let (own, of_bead) = (Stated { shot, bead }, stated.entry(bead.name.as_str()).or_default());
            if !of_bead.iter().any(|other| own.is_alike(other)) {
                of_bead.push(own);
            }
        }
    }
    let mut worst: Option<(f64, Stated, Stated)> = None;
    for all in stated.values() {
        for (n, later) in all.iter().enumerate() {
            for earlier in &all[..n] {
                let sigmas2 = earlier.off_sigmas2(later);
                if worst.as_ref().is_none_or(|(most, ..)| sigmas2 > *most) {
                    worst = Some((sigmas2, *earlier, *later));
                }
            }
        }
    }
    if let Some((sigmas2, earlier, later)) = worst
        && !(sigmas2 <= SAME_PLACE)
    {
        return Err(CarmFitError::OtherPlace {
            bead: later.bead.name.clone(),
            shots: [earlier, later].map(|own| own.shot.name.clone()),
            distance_mm: earlier.bead.lps_mm.distance(later.bead.lps_mm),
            sigmas: sigmas2.sqrt(),
            limit: SAME_PLACE.sqrt(),
        });
    }
    let mut agreed = shots.to_vec();
    for bead in agreed.iter_mut().flat_map(|shot| &mut shot.beads) {
        let of_bead = stated.get(bead.name.as_str()).into_iter().flatten();
        if let Some(best) = of_bead.min_by(|a, b| a.variance_mm2().total_cmp(&b.variance_mm2())) {
            (bead.lps_mm, bead.place_mm2) = (best.bead.lps_mm, best.bead.place_mm2);
        }
    }
    Ok(agreed)
}

#[cfg(test)]
mod tests {
    use glam::{DMat3, DVec2};

    use super::*;
    use crate::geometry::{CarmJoints, Rigid};

    /// Three shots of two beads, known to 0.1 mm; of the second bead each states another place along z, to another standard deviation.
    fn shots(second: [(f64, f64); 3]) -> Vec<Shot> {
        let bead = |name: &str, z_mm: f64, sigma_mm: f64| ShotBead {
            name: name.to_owned(),
            lps_mm: DVec3::new(10.0, 20.0, z_mm),
            image_px: DVec2::new(400.0, 300.0),
            noise_px2: [0.01, 0.0, 0.01],
            place_mm2: DMat3::from_diagonal(DVec3::splat(sigma_mm.powi(2))),
        };
        let shot = |(n, (z_mm, sigma_mm)): (usize, (f64, f64))| Shot {
            name: format!("shot-{n}"),
            size_px: [1536, 1536],
            joints: CarmJoints::from_array([0.0; 7]),
            beads: vec![bead("first", 30.0, 0.1), bead("second", z_mm, sigma_mm)],
            camera_from_lps: Rigid::IDENTITY,
        };
        second.into_iter().enumerate().map(shot).collect()
    }

    /// The first shot's place and covariance stood for all, without a word.
    #[test]
    fn of_places_that_agree_the_most_certain_counts() {
        let agreed = agreed(&shots([(40.0, 0.3), (40.1, 0.05), (39.9, 0.1)])).expect("within their standard deviations");
        for shot in &agreed {
            let [first, second] = [&shot.beads[0], &shot.beads[1]];
            assert_eq!((first.lps_mm.z, first.place_mm2.x_axis.x), (30.0, 0.1f64.powi(2)), "{}", shot.name);
            assert_eq!((second.lps_mm.z, second.place_mm2.z_axis.z), (40.1, 0.05f64.powi(2)), "{}", shot.name);
        }
        assert_eq!(agreed.len(), 3);
    }

    #[test]
    fn of_places_that_differ_both_shots_are_named() {
        let Err(CarmFitError::OtherPlace { bead, shots: named, distance_mm, sigmas, limit }) =
            agreed(&shots([(40.0, 0.1), (40.0, 0.1), (40.9, 0.1)]))
        else {
            panic!("0.9 mm is more than 0.1 mm allow");
        };
        assert_eq!((bead.as_str(), named), ("second", ["shot-0".to_owned(), "shot-2".to_owned()]));
        assert!((distance_mm - 0.9).abs() < 1e-9 && (sigmas - 0.9 / 0.02f64.sqrt()).abs() < 1e-6 && sigmas > limit);
        assert!(agreed(&shots([(40.0, 0.3), (40.0, 0.1), (40.9, 0.3)])).is_ok(), "2.8 standard deviations are no contradiction");
        assert!(agreed(&shots([(40.0, 0.1), (40.0, 0.1), (f64::NAN, 0.1)])).is_err(), "no number is no place");
    }
}
