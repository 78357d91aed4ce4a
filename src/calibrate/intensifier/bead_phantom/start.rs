//! The first pose of a frame whose distortion nobody knows: trial distortions, until one explains the beads.

use super::adjust::{Adjusted, KnownBead, Shot, Weighing};
use super::request::PhantomRequest;
use super::shift_field::ShiftField;
use crate::beads::{Bead, BeadLayout, Detection};
use crate::calibrate::intensifier::spots::Spot;
use crate::geometry::Intrinsics;
use crate::mask::Disc;
use crate::pose::{Prior, Registration, rough_pose};

/// Rim shifts in radii of the disc, and turns of the rim (rad), that are tried: the likeliest first.
const TRIALS: [(f64, f64); 10] = [
    (0.08, 0.0),
    (0.04, 0.0),
    (0.12, 0.0),
    (0.0, 0.0),
    (0.08, 0.05),
    (0.08, -0.05),
    (0.04, 0.05),
    (0.04, -0.05),
    (-0.04, 0.0),
    (-0.08, 0.0),
];
/// A trial is off by this share of the radius; beads are taken to be placed so badly while it stands for the distortion.
const TRIAL_OFF: f64 = 0.008;
/// Share of the distance from source to detector at which a phantom stands, to tell millimetres from pixels.
const DEPTH: f64 = 0.65;
/// Radii in which shadows are sought under the pose of a trial, in radii of the disc: growing certain.
const SOUGHT: [f64; 6] = [0.05, 0.035, 0.025, 0.016, 0.01, 0.008];
/// A frame is explained when so many of the beads that it should show are where they should be …
const EXPLAINED: f64 = 0.7;
/// … and so well explained that no other trial need be looked at.
const WELL_EXPLAINED: f64 = 0.9;
/// Fewest beads in a frame: with fewer a polynomial explains accidents.
pub const LEAST_BEADS: usize = 12;
/// Order of the polynomial of one frame alone.
const ORDER: usize = 3;

/// Round shadows of a frame.
pub struct Seen {
    pub size_px: [u32; 2],
    /// Of the polarity that most have, and of the other where it is not known.
    pub shadows: Vec<Vec<Detection>>,
}

/// A frame that has found its beads.
#[derive(Clone, Debug)]
pub struct Started {
    pub alone: Adjusted,
    /// Of the beads that the frame should show, those that it does.
    pub share: f64,
}

/// The distortions that are tried where none is known.
pub fn ladder(disc: Disc) -> Vec<ShiftField> {
    TRIALS.map(|(pincushion, turn_rad)| ShiftField::trial(disc, pincushion, turn_rad)).to_vec()
}

/// The pose and the distortion of one frame alone, under the best of `trials`; `None` where none explains it.
pub fn start(
    request: &PhantomRequest,
    seen: &Seen,
    (number, prior): (usize, Option<&Prior>),
    beads: &[KnownBead],
    trials: &[ShiftField],
) -> Option<Started> {
    let mut best: Option<Started> = None;
    for trial in trials {
        for shadows in &seen.shadows {
            let Some(started) = attempt(request, (number, seen.size_px, shadows), prior, beads, trial) else { continue };
            let well = started.share >= WELL_EXPLAINED;
            if best.as_ref().is_none_or(|best| started.share > best.share) {
                best = Some(started);
            }
            if well {
                return best;
            }
        }
    }
    best
}

fn attempt(
    request: &PhantomRequest,
    (frame, size_px, shadows): (usize, [u32; 2], &[Detection]),
    prior: Option<&Prior>,
    beads: &[KnownBead],
    trial: &ShiftField,
) -> Option<Started> {
    let radius_px = trial.disc.radius_px;
    let distortion = trial.distortion().ok()?;
    let loose_mm = TRIAL_OFF * radius_px * DEPTH * request.pitch_mm;
    let loose_of = |bead: &Bead| Some(bead.most_sigma_mm().max(loose_mm));
    let loose = |bead: &Bead| Bead { sigma_mm: loose_of(bead), covariance_mm2: None, ..bead.clone() };
    let layout =
        BeadLayout { beads: request.layout.beads.iter().map(loose).collect(), checks: Vec::new(), ..request.layout.clone() };
    let registration = Registration {
        intrinsics: Some(request.intrinsics),
        pitch_mm: Some(request.pitch_mm),
        prior,
        one_body: true,
        bead_radius_mm: request.bead_radius_mm,
        ..Registration::new(size_px, &layout)
    };
    let straight: Vec<Detection> = shadows.iter().map(|shadow| shadow.straightened(&distortion)).collect();
    let camera_from_lps = rough_pose(&registration, &straight)?;
    let spots = shadows.iter().map(Spot::of).collect();
    let shot = Shot { frame, shadows: spots, camera_from_lps, matches: Vec::new() };
    let mut alone = Adjusted { shots: vec![shot], field: trial.of_order(ORDER) };
    let k = &request.intrinsics;
    for share in SOUGHT {
        let sought_px = share * radius_px;
        alone = alone.rematched(beads, k, sought_px).solved(beads, k, Weighing::Sought { radius_px: sought_px }).ok()?;
    }
    let last_px = SOUGHT[SOUGHT.len() - 1] * radius_px;
    alone = alone.rematched(beads, k, last_px);
    let expected = in_view(&alone, beads, k)?;
    let share = alone.count() as f64 / expected.max(1) as f64;
    (alone.count() >= LEAST_BEADS && share >= EXPLAINED).then_some(Started { alone, share })
}

/// Beads whose shadow the disc should show, a little inside its rim, and those that were matched beside it; `None` where the distortion
/// folds.
fn in_view(alone: &Adjusted, beads: &[KnownBead], k: &Intrinsics) -> Option<usize> {
    const INSIDE: f64 = 0.96;
    let distortion = alone.field.distortion().ok()?;
    let shot = alone.shots.first()?;
    let shows = |bead: &KnownBead| {
        let at = k.project(shot.camera_from_lps.transform_point(bead.lps_mm));
        distortion.distorted(at).is_ok_and(|at| at.distance(distortion.centre_px()) < INSIDE * distortion.radius_px())
    };
    let matched = |n: &usize| shot.matches.iter().any(|(bead, _)| bead == n);
    Some((0..beads.len()).filter(|n| matched(n) || shows(&beads[*n])).count())
}
