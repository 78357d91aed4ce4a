//! What tells a bead from other metal, and from bone.

use super::fit::Fitted;
use super::lumps::{Lump, METAL_HU};
use crate::geometry::VoxelGrid;

/// A bead and its halo span less than this.
const LARGEST_MM: f64 = 14.0;
/// A centre that is less certain than this is none.
const MOST_SIGMA_MM: f64 = 0.4;
/// Radius up to which a ball is a bead.
const LARGEST_RADIUS_MM: f64 = 5.0;
/// A lump this many times as long as wide, and longer by more than [`LONGER_MM`], is no ball.
const ELONGATED: f64 = 1.7;
/// See [`ELONGATED`]: thick slices make a ball's lump longer by about a slice.
const LONGER_MM: f64 = 1.5;
/// Less contrast to its surroundings than this is bone, calcification or contrast medium: titanium has 8000 HU, dense bone 1500.
const LEAST_CONTRAST_HU: f64 = 3500.0;
/// No scanner's point spread is wider, full width at half maximum.
const WIDEST_BLUR_MM: f64 = 1.9;
/// Full width at half maximum of a Gaussian of σ = 1.
pub(super) const FWHM: f64 = 2.354_820_045;
/// A ball's model misses less than this share of the ball, root mean square.
const MISSED_SHARE: f64 = 0.25;

/// Why metal, or what looked like it, is not taken for a bead.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum NotBead {
    /// Longer than a bead and its halo.
    Large {
        /// Its length.
        longest_mm: f64,
    },
    /// A screw, a wire, a clip.
    Elongated {
        /// Longest and second axis.
        length_mm: f64,
        /// See `length_mm`.
        width_mm: f64,
    },
    /// Its values are those of bone or contrast medium.
    Faint {
        /// Contrast to the surroundings.
        contrast_hu: f64,
    },
    /// Wider than a scanner's point spread makes a ball.
    Unsharp {
        /// Full width at half maximum of the blur that it would need.
        fwhm_mm: f64,
    },
    /// It does not look like a blurred ball.
    Shape {
        /// What the model of a ball misses, of the ball.
        missed_share: f64,
        /// What it may.
        limit_share: f64,
    },
    /// The voxels do not say where its centre is.
    Uncertain {
        /// Largest standard deviation of a coordinate.
        sigma_mm: f64,
    },
    /// Cut by the end of the scan.
    Border,
    /// No tissue around it to compare with.
    Surrounded,
}

impl std::fmt::Display for NotBead {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Large { longest_mm } => {
                write!(f, "{longest_mm:.0} mm long: larger than a bead (screw, plate, implant, tooth filling)")
            }
            Self::Elongated { length_mm, width_mm } => {
                write!(f, "{length_mm:.1} mm long and {width_mm:.1} mm wide: elongated (screw, wire, clip)")
            }
            Self::Faint { contrast_hu } => {
                write!(f, "{contrast_hu:.0} HU above its surroundings, less than metal: bone, calcification or contrast medium")
            }
            Self::Unsharp { fwhm_mm } => {
                write!(f, "a ball blurred by {fwhm_mm:.1} mm, more than a scanner blurs: contrast medium, calcification or bone")
            }
            Self::Shape { missed_share, limit_share } => write!(
                f,
                "no blurred ball: the model misses {:.0} % of it, at most {:.0} % would do",
                100.0 * missed_share,
                100.0 * limit_share
            ),
            // Beyond any bead the number itself says nothing.
            Self::Uncertain { sigma_mm } if !(*sigma_mm < LARGEST_MM) => f.write_str("nothing tells where its centre is"),
            Self::Uncertain { sigma_mm } => write!(f, "its centre is known to {sigma_mm:.1} mm only"),
            Self::Border => f.write_str("its centre is cut off by the end of the scan"),
            Self::Surrounded => f.write_str("nothing but metal around it"),
        }
    }
}

/// What size and shape of a lump alone say; `None`: it may be a bead, or several.
pub(super) fn at_sight(lump: &Lump, spacing_mm: [f64; 3]) -> Option<NotBead> {
    let [length_mm, width_mm, _] = lump.extent_mm;
    let thick_mm = spacing_mm.into_iter().fold(0.0, f64::max);
    if length_mm > LARGEST_MM + thick_mm {
        let elongated = length_mm > ELONGATED * width_mm;
        return Some(if elongated {
            NotBead::Elongated { length_mm, width_mm }
        } else {
            NotBead::Large { longest_mm: length_mm }
        });
    }
    None
}

/// What the fit of a ball says; `alone`: the lump has one summit. `None`: it is a bead.
pub(super) fn of_fit(grid: &VoxelGrid, lump: &Lump, alone: bool, fitted: &Fitted, middle_hu: f64) -> Option<NotBead> {
    let [length_mm, width_mm, _] = lump.extent_mm;
    let ball = &fitted.ball;
    let at = grid.lps_from_voxel.inverse().transform_point3(ball.centre_lps_mm);
    let inside = (0..3).all(|axis| at[axis] > -0.5 && at[axis] < grid.size[axis] as f64 - 0.5);
    if !inside {
        return Some(NotBead::Border);
    }
    let variance_mm2 = (0..3).map(|axis| fitted.covariance_mm2[axis][axis]).fold(0.0, f64::max);
    if !(variance_mm2 <= MOST_SIGMA_MM * MOST_SIGMA_MM) {
        return Some(NotBead::Uncertain { sigma_mm: variance_mm2.sqrt() });
    }
    let contrast_hu = ball.contrast_hu().max(f64::from(lump.peak_hu) - middle_hu);
    if !(ball.contrast_hu() >= LEAST_CONTRAST_HU) || !(f64::from(lump.peak_hu) - middle_hu >= 0.5 * f64::from(METAL_HU)) {
        return Some(NotBead::Faint { contrast_hu: contrast_hu.min(f64::from(lump.peak_hu) - middle_hu) });
    }
    let fwhm_mm = FWHM * ball.blur_mm;
    if !(fwhm_mm <= WIDEST_BLUR_MM) {
        return Some(NotBead::Unsharp { fwhm_mm });
    }
    if !(ball.radius_mm <= LARGEST_RADIUS_MM) {
        return Some(NotBead::Large { longest_mm: length_mm });
    }
    let thick_mm = grid.spacing_mm().into_iter().fold(0.0, f64::max);
    if alone && length_mm > ELONGATED * width_mm && length_mm > width_mm + LONGER_MM + thick_mm {
        return Some(NotBead::Elongated { length_mm, width_mm });
    }
    let missed_share = fitted.missed_share;
    if !(missed_share <= MISSED_SHARE) {
        return Some(NotBead::Shape { missed_share, limit_share: MISSED_SHARE });
    }
    None
}
