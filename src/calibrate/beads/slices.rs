//! How the slices of a CT average along their normal, found from its beads. The files do not say; a bead of 1.5 mm in slices of 2 mm is
//! seen in two or three of them, and where its centre is follows from their ratio, which is the profile's.

use glam::{DMat3, DVec3};

use super::fit::Fitted;
use super::sphere::SliceProfile;
use crate::estimate::median;
use crate::geometry::VoxelGrid;

/// What is tried: thin slices with gaps, boxes as wide as their distance, overlapping ones, triangles, Gaussians, and boxes that are
/// sharper than the plane. Of equals the first counts.
pub(super) const PROFILES: [SliceProfile; 18] = [
    SliceProfile::BOX,
    SliceProfile::smooth(0.5, 0.0),
    SliceProfile::smooth(1.5, 0.0),
    SliceProfile::smooth(2.0, 0.0),
    SliceProfile::smooth(1.0, 0.25),
    SliceProfile::smooth(1.0, 0.4),
    SliceProfile::smooth(1.5, 0.4),
    SliceProfile::smooth(0.0, 0.2),
    SliceProfile::smooth(0.0, 0.27),
    SliceProfile::smooth(0.0, 0.34),
    SliceProfile::smooth(0.0, 0.42),
    SliceProfile::smooth(0.0, 0.5),
    SliceProfile::smooth(0.0, 0.58),
    SliceProfile::smooth(0.0, 0.66),
    SliceProfile::smooth(0.0, 0.76),
    SliceProfile::sharp(1.0, 0.35),
    SliceProfile::sharp(1.0, 0.45),
    SliceProfile::sharp(1.5, 0.35),
];
/// Standard deviation of a box as wide as the slices are apart: 1/√12.
pub(super) const EXPECTED_SIGMA: f64 = 0.288_675_134_594_812_9;
/// Beads that are asked, the ones that stand out most.
pub(super) const ASKED: usize = 16;
/// A profile whose misfit is larger than the best one's by this share counts e⁻¹: no profile of a scanner is exactly one of these, and
/// what lies between two of them fits better than either.
const DOUBT: f64 = 0.5;
/// Of what is taken out along the normal the plane is blurred by this much at least: the series is 6 % of a slice off there, and has lobes below
/// zero soon after.
const LEFT: f64 = 1.2;
/// A bead of which the model misses more than the noise is placed no better than to this share of a voxel's edges.
const UNLIKE: f64 = 0.005;
/// Profiles that count less are left out.
const LEAST_WEIGHT: f64 = 0.02;

/// The axis along which the slices follow each other: the longest edge of a voxel, the last of equals.
pub(super) fn slice_axis(grid: &VoxelGrid) -> usize {
    let spacing = grid.spacing_mm();
    (0..3).fold(2, |best, axis| if spacing[axis] > 1.01 * spacing[best] { axis } else { best })
}

/// A profile with how much it counts beside the best one, which counts 1.
#[derive(Clone, Copy, Debug)]
pub(super) struct Trial {
    pub profile: SliceProfile,
    pub weight: f64,
}

/// The profiles that the beads agree with, the best first. `fit` gives the fits of the same beads under a profile.
pub(super) fn choose(fit: impl Fn(SliceProfile) -> Vec<Option<Fitted>>) -> Vec<Trial> {
    let fits: Vec<Vec<Option<Fitted>>> = PROFILES.iter().map(|profile| fit(*profile)).collect();
    let beads = fits.first().map_or(0, Vec::len);
    let in_all: Vec<usize> = (0..beads).filter(|bead| fits.iter().all(|fits| fits[*bead].is_some())).collect();
    // Per bead the least misfit under any profile counts 1: a bead on a bone's edge has as much say as one in muscle.
    let missed =
        |fits: &[Option<Fitted>], bead: usize| fits[bead].as_ref().map_or(f64::INFINITY, |fitted| fitted.missed_sigmas.max(1.0));
    // Where less blur is left in the plane than is taken out along the normal, there is no such profile.
    let can_be = |profile: &SliceProfile, of_profile: &[Option<Fitted>]| {
        let blurs_mm = in_all.iter().filter_map(|bead| of_profile[*bead].as_ref()).map(|fitted| fitted.ball.blur_mm);
        profile.sharper_mm == 0.0 || median(blurs_mm).is_some_and(|blur_mm| blur_mm >= LEFT * profile.sharper_mm)
    };
    let excess: Vec<f64> = PROFILES
        .iter()
        .zip(&fits)
        .map(|(profile, of_profile)| {
            if !can_be(profile, of_profile) {
                return f64::INFINITY;
            }
            let logs = in_all.iter().map(|bead| {
                let least = fits.iter().map(|fits| missed(fits, *bead)).fold(f64::INFINITY, f64::min);
                (missed(of_profile, *bead) / least).ln()
            });
            logs.sum::<f64>() / in_all.len().max(1) as f64
        })
        .collect();
    let least = excess.iter().copied().fold(f64::INFINITY, f64::min);
    let trial = |(profile, excess): (SliceProfile, f64)| {
        let over = ((excess - least).exp() - 1.0) / DOUBT;
        Trial { profile, weight: (-over * over).exp() }
    };
    let mut trials: Vec<Trial> =
        PROFILES.into_iter().zip(excess).map(trial).filter(|trial| trial.weight >= LEAST_WEIGHT).collect();
    // Stable: of equals the plainest stays first.
    trials.sort_by(|a, b| b.weight.total_cmp(&a.weight));
    trials
}

/// Adds to the covariance of `fitted` what the doubt about the profile makes of its centre, and to its radius's σ likewise; `others` are
/// its fits under other profiles, with how much these count beside its own. Along the voxels' edges, the columns of `edges_mm`, comes
/// what no profile explains.
pub(super) fn doubt(fitted: &mut Fitted, others: &[(f64, Fitted)], edges_mm: DMat3) {
    let total = 1.0 + others.iter().map(|(weight, _)| weight).sum::<f64>();
    let (centre, radius_mm) = (fitted.ball.centre_lps_mm, fitted.ball.radius_mm);
    // Of the variance that the model misses, what is more than the noise.
    let unexplained = (1.0 - fitted.missed_sigmas.powi(-2)).max(0.0);
    let mut add = |share: f64, away: DVec3| {
        for (row, covariance) in fitted.covariance_mm2.iter_mut().enumerate() {
            for (column, value) in covariance.iter_mut().enumerate() {
                *value += share * away[row] * away[column];
            }
        }
    };
    for (weight, other) in others {
        add(weight / total, other.ball.centre_lps_mm - centre);
    }
    for axis in 0..3 {
        add(unexplained, UNLIKE * edges_mm.col(axis));
    }
    let of_radius = |(weight, other): &(f64, Fitted)| weight / total * (other.ball.radius_mm / radius_mm).ln().powi(2);
    fitted.radius_sigma_ln = fitted.radius_sigma_ln.hypot(others.iter().map(of_radius).sum::<f64>().sqrt());
}
