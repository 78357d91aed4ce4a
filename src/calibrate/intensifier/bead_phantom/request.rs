//! What is known of the phantom, and asked for.

use crate::beads::BeadLayout;
use crate::geometry::{AnglesFrom, Glare, Intrinsics};
use crate::mask::Disc;
use crate::pose::Prior;

/// What is known of the phantom, and asked for.
#[derive(Clone, Debug)]
pub struct PhantomRequest<'a> {
    /// The beads.
    pub layout: &'a BeadLayout,
    /// K of the undistorted picture, for frames of the size given.
    pub intrinsics: Intrinsics,
    /// Side of a pixel, for the depths at which beads may lie.
    pub pitch_mm: f64,
    /// Where the phantom is expected: none, or one for each frame.
    pub priors: &'a [Prior],
    /// Radius of beads whose description gives none.
    pub bead_radius_mm: Option<f64>,
    /// Order of the polynomials; `None`: the usual one where beads suffice for it, else the third.
    pub order: Option<usize>,
    /// The round mask, where somebody knows it.
    pub disc: Option<Disc>,
    /// Where the angles come from.
    pub angles_from: AnglesFrom,
    /// Veiling glare, if it was measured.
    pub glare: Option<Glare>,
    /// Who measured, when, with what.
    pub origin: String,
}
