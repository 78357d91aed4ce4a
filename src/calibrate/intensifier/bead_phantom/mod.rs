//! The distortion of an image intensifier from frames of one phantom whose bead places are known.
//!
//! Nobody knows where the phantom is, and until the distortion is known no shadow lies where a camera would put it. So each frame is
//! registered through trial distortions until one explains its beads (`start`); then the poses of all frames at one angle of the C-arm
//! and the polynomial that they share are solved together by the estimation core, and shadows are named anew, by turns (`adjust`,
//! `held_out`). What poses can make up for is settled by convention, as for a grid (`shift_field`).

mod shift_field;
mod residual;
mod adjust;
mod held_out;
mod request;
mod start;
mod angles;

pub use request::PhantomRequest;

use super::error::IntensifierFault;
use super::frames::{GridFrame, check_sizes};
use super::spots::{self, Spot};
use crate::beads::{BeadLayout, Expectation, detect};
use crate::geometry::{DEFAULT_ORDER, IntensifierCalibration, IntensifierView, term_count};
use crate::mask::Disc;
use crate::pose::extents_mm;
use adjust::{Adjusted, KnownBead};
use angles::{AtOneAngle, by_angle};
use shift_field::ShiftField;
use start::{LEAST_BEADS, Seen, Started, ladder, start};

/// Order where beads do not suffice for the usual one.
const FEWER_BEADS_ORDER: usize = 3;
/// A phantom with less depth, as a share of its width, cannot tell its tilt from distortion.
const LEAST_DEPTH: f64 = 0.1;
/// Held-out beads further off than this share of the disc's radius speak against the layout, K or the names.
const MOST_HELD_OUT: f64 = 0.01;

/// Fits the distortion at every angle at which the phantom was seen; `step` is called after each frame.
///
/// # Errors
/// When sizes differ, angles are missing, no frame shows the beads, they are too few for the order, or they contradict each other.
pub fn calibrate_phantom(
    frames: &[GridFrame],
    request: &PhantomRequest,
    step: &dyn Fn(),
) -> Result<IntensifierCalibration, IntensifierFault> {
    let size_px = frames.first().ok_or(IntensifierFault::NoFrames)?.frame.size_px;
    check_sizes(frames)?;
    if let Some(detail) = &request.layout.refused {
        return Err(IntensifierFault::Layout { detail: detail.clone() });
    }
    let beads = known(request.layout);
    if beads.len() < LEAST_BEADS {
        return Err(IntensifierFault::SmallLayout { found: beads.len(), required: LEAST_BEADS });
    }
    let [first_mm, _, third_mm] = extents_mm(&beads.iter().map(|bead| bead.lps_mm).collect::<Vec<_>>());
    if !(third_mm >= LEAST_DEPTH * first_mm) {
        return Err(IntensifierFault::FlatLayout { first_mm, third_mm, required_mm: LEAST_DEPTH * first_mm });
    }
    let mut groups = by_angle(frames)?;
    let (disc, where_from) = spots::disc(frames, request.disc);
    let mut notes = vec![
        String::new(),
        "K was taken as given: an error of its focal length or principal point shows as distortion".to_owned(),
        where_from,
    ];
    if request.glare.is_none() {
        notes.push("veiling glare was not measured".to_owned());
    }
    let seen: Vec<Seen> = frames.iter().map(|frame| see(frame, &disc)).collect();
    let started = start_all(request, &seen, &groups, &beads, disc, step);
    for (frame, seen) in frames.iter().zip(&seen).zip(&started).filter(|(_, started)| started.is_none()).map(|(both, _)| both) {
        let shadows = seen.shadows.first().map_or(0, Vec::len);
        notes.push(format!("{} is left out: its {shadows} shadows were not recognised as the beads", frame.frame.name));
    }
    let used = started.iter().flatten().count();
    if used == 0 {
        let shadows = seen.iter().map(|seen| seen.shadows.first().map_or(0, Vec::len)).max().unwrap_or(0);
        return Err(IntensifierFault::NotRecognised { frames: frames.len(), beads: beads.len(), shadows });
    }
    notes[0] = format!(
        "measured from {used} of {} frames of a phantom of {} beads ({}), not from a grid",
        frames.len(),
        beads.len(),
        request.layout.source
    );
    groups.retain(|group| group.frames.iter().any(|n| started[*n].is_some()));
    let joined: Vec<Adjusted> = groups.iter().filter_map(|group| join(group, &started)).collect();
    let order = request.order.unwrap_or_else(|| {
        let enough = |view: &Adjusted| view.count() >= required(DEFAULT_ORDER, view.shots.len());
        if joined.iter().all(enough) { DEFAULT_ORDER } else { FEWER_BEADS_ORDER }
    });
    let (mut views, mut squares) = (Vec::new(), (0.0, 0usize));
    for (group, view) in groups.iter().zip(joined) {
        let (view, held_out_px2) = fit(view, order, &beads, request, &frames[group.frames[0]].frame.name)?;
        squares = (squares.0 + held_out_px2, squares.1 + view.count());
        views.push(row(group, &view, frames, held_out_px2));
    }
    let short = views.iter().filter_map(|view: &IntensifierView| view.reach).fold(f64::INFINITY, f64::min);
    if short < 0.9 {
        notes.push(format!("beads reach to {:.0} % of the disc's radius: the rest is extrapolated", 100.0 * short));
    }
    let calibration = IntensifierCalibration {
        origin: request.origin.clone(),
        size_px: size_px.map(|n| n as u32),
        disc_centre_px: disc.centre.to_array(),
        disc_radius_px: disc.radius_px,
        order,
        held_out_rms_px: Some((squares.0 / squares.1.max(1) as f64).sqrt()),
        angles_from: request.angles_from,
        plate_pitch_mm: None,
        veiling_glare: request.glare,
        views,
        notes,
    };
    calibration.check()?;
    Ok(calibration)
}

/// Fewest shadows at one angle that determine a polynomial of `order` and the poses of `frames` with some to hold out.
fn required(order: usize, frames: usize) -> usize {
    // A shadow is two numbers, as a term is; a pose is six.
    2 * term_count(order) + 3 * frames
}

fn known(layout: &BeadLayout) -> Vec<KnownBead> {
    layout.beads.iter().map(|bead| KnownBead { lps_mm: bead.lps_mm, place_mm2: bead.place_mm2() }).collect()
}

fn see(GridFrame { frame, .. }: &GridFrame, disc: &Disc) -> Seen {
    let found = detect(frame, Some(&spots::inside(frame, disc)), &Expectation::default());
    let shadows = [found.found, found.opposite].into_iter().filter(|shadows| !shadows.is_empty()).collect();
    Seen { size_px: frame.size_px.map(|n| n as u32), shadows }
}

/// Every frame alone, distortions that explained others first.
fn start_all(
    request: &PhantomRequest,
    seen: &[Seen],
    groups: &[AtOneAngle],
    beads: &[KnownBead],
    disc: Disc,
    step: &dyn Fn(),
) -> Vec<Option<Started>> {
    let mut started: Vec<Option<Started>> = vec![None; seen.len()];
    let mut newest: Option<ShiftField> = None;
    for group in groups {
        for n in &group.frames {
            let trials: Vec<ShiftField> = newest.iter().cloned().chain(ladder(disc)).collect();
            started[*n] = start(request, &seen[*n], (*n, request.priors.get(*n)), beads, &trials);
            newest = started[*n].as_ref().map(|started| started.alone.field.clone()).or(newest);
            step();
        }
    }
    // A frame that came before any distortion was known.
    for (n, seen) in seen.iter().enumerate().filter(|_| newest.is_some()) {
        if started[n].is_none() {
            started[n] = start(request, seen, (n, request.priors.get(n)), beads, newest.as_slice());
        }
    }
    started
}

/// The frames of one angle with the distortion of the one that shows most beads.
fn join(group: &AtOneAngle, started: &[Option<Started>]) -> Option<Adjusted> {
    let own: Vec<&Started> = group.frames.iter().filter_map(|n| started[*n].as_ref()).collect();
    let best = own.iter().max_by_key(|started| started.alone.count())?;
    let shots = own.iter().flat_map(|started| started.alone.shots.clone()).collect();
    Some(Adjusted { shots, field: best.alone.field.clone() })
}

/// One angle solved, and the squares of its held-out beads.
fn fit(
    view: Adjusted,
    order: usize,
    beads: &[KnownBead],
    request: &PhantomRequest,
    frame: &str,
) -> Result<(Adjusted, f64), IntensifierFault> {
    let frame = || frame.to_owned();
    let enough = |view: &Adjusted| {
        let (found, frames) = (view.count(), view.shots.len());
        let required = required(order, frames);
        if found >= required {
            return Ok(());
        }
        Err(IntensifierFault::TooFewBeads { frame: frame(), frames, found, order, required })
    };
    enough(&view)?;
    let unsolved = |source| IntensifierFault::Unsolved { frame: frame(), source };
    let raised = Adjusted { field: view.field.of_order(order), ..view };
    let settled = raised.settled(beads, &request.intrinsics).map_err(unsolved)?;
    enough(&settled)?;
    let squares = settled.held_out_px2(beads, &request.intrinsics).map_err(unsolved)?;
    let (rms_px, limit_px) = ((squares / settled.count() as f64).sqrt(), MOST_HELD_OUT * settled.field.disc.radius_px);
    if !(rms_px <= limit_px) {
        return Err(IntensifierFault::Contradicted { frame: frame(), rms_px, limit_px });
    }
    Ok((settled, squares))
}

fn row(group: &AtOneAngle, view: &Adjusted, frames: &[GridFrame], held_out_px2: f64) -> IntensifierView {
    let spots = view.count();
    let used: Vec<&Spot> =
        view.shots.iter().flat_map(|shot| shot.matches.iter().map(|(_, shadow)| &shot.shadows[*shadow])).collect();
    let name = |n: usize| frames[view.shots[n].frame].frame.name.clone();
    let disc = view.field.disc;
    let shift = |spot: &&Spot| view.field.straight(spot.image_px).distance(spot.image_px);
    IntensifierView {
        frame: match view.shots.len() {
            1 => name(0),
            several => format!("{} and {} more", name(0), several - 1),
        },
        orbital_deg: group.angles_deg.map(|angles| angles[0]),
        angulation_deg: group.angles_deg.map(|angles| angles[1]),
        spots,
        left_out: view.shots.iter().map(|shot| shot.shadows.len()).sum::<usize>() - spots,
        held_out_rms_px: Some((held_out_px2 / spots as f64).sqrt()),
        raw_mean_px: Some(used.iter().map(shift).sum::<f64>() / spots as f64),
        reach: Some(used.iter().map(|spot| spot.image_px.distance(disc.centre)).fold(0.0, f64::max) / disc.radius_px),
        shift_u_px: view.field.shift_px.iter().map(|shift| shift.x).collect(),
        shift_v_px: view.field.shift_px.iter().map(|shift| shift.y).collect(),
    }
}
