//! Metal beads in a CT: where their centres are, with covariance, and what else is metal.
//!
//! ```text
//! check ── lumps ── summits ── window ── fit ── judge ─┬─ names ── markups
//!                                  └── three rounds ───┘
//! ```
//! A ball blooms: the scanner blurs it by 0.5 to 1.5 mm, averages it over voxels, and most stored CTs end at 3071 HU, far below steel.
//! The model is the ball convolved with a Gaussian and averaged over each voxel, on the harmonic continuation of its surroundings;
//! clipped voxels are censored. The covariance of a centre holds the voxels' white noise, the misfit that neighbours share, which is
//! measured from what the model misses, and the doubt about the profile of the slices. Contrast, radius and point spread are stated with their σ: a small or a clipped ball tells
//! their combination only.

mod check;
mod ct_bead;
mod fit;
mod judge;
mod lumps;
mod markups;
mod names;
mod search;
mod slices;
mod sphere;
mod window;

use glam::DVec3;

use crate::beads::{BeadLayout, DEFAULT_BODY};
use crate::geometry::VoxelGrid;

pub use check::BeadsInCtError;
pub use ct_bead::CtBead;
pub use judge::NotBead;
pub use markups::{markups, point_list};

/// How far a bead may lie from its place in a list of names, unless said otherwise; mm.
pub const NAME_TOLERANCE_MM: f64 = 5.0;
/// A radius less certain than this share is not stated as the bead's.
const RADIUS_STATED_SHARE: f64 = 0.15;

/// What is known beforehand.
#[derive(Clone, Debug, Default)]
pub struct Known {
    /// Radius of every bead, mm; from the CT if absent.
    pub radius_mm: Option<f64>,
    /// Names, bodies and radii of beads by place.
    pub names: Option<BeadLayout>,
    /// How far a bead may lie from its place in `names`; [`NAME_TOLERANCE_MM`] if absent.
    pub tolerance_mm: Option<f64>,
}

impl Known {
    /// Radius of a bead near `place`: its own of the list, else that of all.
    fn radius_at(&self, place: DVec3) -> Option<f64> {
        let tolerance_mm = self.tolerance_mm.unwrap_or(NAME_TOLERANCE_MM);
        let listed = self.names.iter().flat_map(|names| &names.beads);
        let nearest = listed.map(|bead| (bead.lps_mm.distance(place), bead.radius_mm)).min_by(|a, b| a.0.total_cmp(&b.0));
        nearest.filter(|(apart_mm, _)| *apart_mm <= tolerance_mm).and_then(|(_, radius_mm)| radius_mm).or(self.radius_mm)
    }
}

/// Metal that is no bead.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct OtherMetal {
    /// Its middle.
    pub lps_mm: [f64; 3],
    /// Length along its principal axes, longest first.
    pub extent_mm: [f64; 3],
    /// Voxels above the threshold.
    pub voxels: usize,
    /// Largest value.
    pub peak_hu: f32,
    /// Why it is no bead.
    pub why: NotBead,
    /// The same in words.
    pub reason: String,
}

/// What a CT holds.
#[derive(Clone, Debug, PartialEq, serde::Serialize)]
pub struct CtBeads {
    /// At least one.
    pub beads: Vec<CtBead>,
    /// Metal that is no bead, largest value first.
    pub not_beads: Vec<OtherMetal>,
    /// Value from which on the CT is clipped, if it is.
    pub clip_hu: Option<f64>,
    /// Names of the list without a bead near their place.
    pub names_without_bead: Vec<String>,
    /// What was assumed or left out.
    pub notes: Vec<String>,
}

/// Finds the metal beads among the Hounsfield numbers `hu` (i fastest). `step` is told of every bead that is
/// looked at, with about how many times that will be, from any thread.
///
/// # Errors
/// When the volume cannot hold beads that could be found (one slice, voxels of 4 mm, no Hounsfield numbers, nothing metal), or all
/// metal is something else: which, and why.
pub fn find_beads(grid: &VoxelGrid, hu: &[f32], known: &Known, step: &(dyn Fn(usize) + Sync)) -> Result<CtBeads, BeadsInCtError> {
    check::volume(grid, hu)?;
    let clip_hu = search::clip_hu(hu);
    let found = search::search(grid, hu, clip_hu, &|place| known.radius_at(place), step);
    let mut notes = Vec::new();
    if found.left_out > 0 {
        notes.push(format!("{} more lumps above {} HU were not looked at", found.left_out, lumps::METAL_HU));
    }
    if let Some((given_mm, found_mm)) = found.contradicted_radius {
        notes.push(format!(
            "the beads are said to have a radius of {given_mm} mm, and look like {:.2} ± {:.2} mm: are they of that size?",
            found_mm.expected,
            found_mm.expected * found_mm.sigma_ln
        ));
    }
    // A box as wide as the slices are apart has the deviation that is expected.
    if (found.slice_sigma / slices::EXPECTED_SIGMA).ln().abs() > 0.2 {
        notes.push(format!(
            "the slices average over {:.1} times their distance, as their beads show",
            found.slice_sigma / slices::EXPECTED_SIGMA
        ));
    }
    let not_beads: Vec<OtherMetal> = found.others.iter().map(other_metal).collect();
    if found.beads.is_empty() {
        return Err(match not_beads.first() {
            Some(first) => {
                BeadsInCtError::NoBead { lumps: not_beads.len(), at_lps_mm: first.lps_mm, reason: first.reason.clone() }
            }
            None => BeadsInCtError::NoMetal {
                most_hu: hu.iter().copied().fold(f32::NEG_INFINITY, f32::max),
                needed_hu: lumps::METAL_HU,
            },
        });
    }
    let beads: Vec<CtBead> = found.beads.iter().map(bead).collect();
    let named = names::name(beads, known.names.as_ref(), known.tolerance_mm.unwrap_or(NAME_TOLERANCE_MM));
    notes.extend(named.notes);
    Ok(CtBeads {
        beads: named.beads,
        not_beads,
        clip_hu: clip_hu.is_finite().then_some(clip_hu),
        names_without_bead: named.without_bead,
        notes,
    })
}

fn bead(found: &search::Found) -> CtBead {
    let fitted = &found.fitted;
    let ball = &fitted.ball;
    let trace = (0..3).map(|axis| fitted.covariance_mm2[axis][axis]).sum::<f64>();
    CtBead {
        name: String::new(),
        body: DEFAULT_BODY.to_owned(),
        lps_mm: ball.centre_lps_mm.to_array(),
        covariance_mm2: fitted.covariance_mm2,
        sigma_mm: (trace / 3.0).max(0.0).sqrt(),
        radius_mm: ball.radius_mm,
        radius_sigma_mm: ball.radius_mm * fitted.radius_sigma_ln,
        radius_stated: fitted.radius_sigma_ln <= RADIUS_STATED_SHARE,
        contrast_hu: ball.contrast_hu(),
        mass_hu_mm3: ball.mass_hu_mm3,
        point_spread_fwhm_mm: judge::FWHM * ball.blur_mm,
        peak_hu: found.peak_hu,
        clipped_voxels: fitted.clipped,
        missed_hu: fitted.rms_hu,
    }
}

fn other_metal(other: &search::Other) -> OtherMetal {
    OtherMetal {
        lps_mm: other.lump.centre_lps_mm.to_array(),
        extent_mm: other.lump.extent_mm,
        voxels: other.lump.voxels.len(),
        peak_hu: other.lump.peak_hu,
        reason: other.why.to_string(),
        why: other.why.clone(),
    }
}
