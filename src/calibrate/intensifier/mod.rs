//! The distortion of an image intensifier from frames of a square grid of beads or holes on its input, or of a phantom whose bead places
//! are known (`bead_phantom`).
//!
//! A grid's spots are found as bead shadows are (`spots`), named by the nodes of a square lattice that grows from the middle (`lattice`), and a
//! polynomial from places in the frame to places on the grid is fitted to them. What the frames leave open is settled by convention:
//! the disc's centre stays where it is, and there a pixel keeps its area and its direction.

mod error;
mod frames;
mod spots;
mod polynomial;
mod lattice;
mod outliers;
mod held_out;
mod glare;
mod bead_phantom;

pub use bead_phantom::{PhantomRequest, calibrate_phantom};
pub use error::IntensifierFault;
pub use frames::GridFrame;
pub use glare::measure_glare;
pub use spots::{GridOf, disc as disc_of};

use glam::{DMat2, DVec2};

use crate::acquire::Frame;
use crate::estimate::median;
use crate::geometry::{AnglesDeg, AnglesFrom, Glare, IntensifierCalibration, IntensifierView};
use crate::mask::Disc;
use held_out::ViewFit;
use polynomial::{Gauge, Node, Polynomial};

/// What is asked for.
#[derive(Clone, Debug)]
pub struct GridRequest {
    /// Beads or holes.
    pub grid: GridOf,
    /// Distance between neighbours on the plate.
    pub pitch_mm: Option<f64>,
    /// Order of the polynomials.
    pub order: usize,
    /// The plate was taken off between the frames: each keeps its own centre and direction.
    pub plate_moved: bool,
    /// The round mask, where somebody knows it.
    pub disc: Option<Disc>,
    /// Where the angles come from.
    pub angles_from: AnglesFrom,
    /// Veiling glare, if it was measured.
    pub glare: Option<Glare>,
    /// Who measured, when, with what.
    pub origin: String,
}

/// Nodes that must lie within a quarter of a cell from where the first view has them, for the plate to count as unmoved.
const UNMOVED_SHARE: f64 = 0.8;
const UNMOVED_CELLS: f64 = 0.25;

/// Fits the distortion of every frame.
///
/// # Errors
/// When sizes differ, angles are missing or given twice, no grid shows, or a distortion cannot be inverted.
pub fn calibrate(frames: &[GridFrame], request: &GridRequest) -> Result<IntensifierCalibration, IntensifierFault> {
    let first = &frames.first().ok_or(IntensifierFault::NoFrames)?.frame;
    frames::check(frames)?;
    let mut notes =
        vec!["the plate is taken to lie flat on the intensifier's input: a tilted plate shows as distortion".to_owned()];
    // One disc for all: it is the intensifier's own, and polynomials need one centre to be interpolated.
    let (disc, where_from) = spots::disc(frames, request.disc);
    notes.push(where_from);
    if request.glare.is_none() {
        notes.push("veiling glare was not measured".to_owned());
    }
    let mut views = Vec::new();
    let mut reference: Option<(Polynomial, Gauge)> = None;
    let mut held_out = (0.0, 0usize);
    for GridFrame { frame, angles_deg } in frames {
        let spots = spots::find(frame, request.grid, &disc);
        let required = lattice::required(request.order);
        let none = |named| IntensifierFault::NoGrid { frame: frame.name.clone(), spots: spots.len(), named, required };
        let mut nodes = lattice::name(&spots, &disc, request.order).map_err(none)?;
        let unmoved = reference.as_ref().filter(|_| !request.plate_moved).and_then(|(first, gauge)| {
            nodes = as_in(first, &nodes)?;
            Some(*gauge)
        });
        let named = nodes.len();
        let fit = ViewFit::new(&nodes, &disc, request.order).ok_or_else(|| none(named))?;
        let gauge = unmoved.unwrap_or_else(|| fit.polynomial.gauge());
        if reference.is_some() && !request.plate_moved && unmoved.is_none() {
            notes.push(format!(
                "{}: the plate lies otherwise than in the first frame: this view keeps its own centre",
                frame.name
            ));
        }
        let squares = fit.held_out_px2(&gauge, &disc).ok_or_else(|| none(named))?;
        held_out = (held_out.0 + squares, held_out.1 + fit.nodes.len());
        views.push(view(frame, *angles_deg, &fit, &gauge, &disc, (squares, spots.len())));
        reference.get_or_insert((fit.polynomial, gauge));
    }
    let short = views.iter().filter_map(|view: &IntensifierView| view.reach).fold(f64::INFINITY, f64::min);
    if short < 0.9 {
        notes.push(format!("spots reach to {:.0} % of the disc's radius: the rest is extrapolated", 100.0 * short));
    }
    let calibration = IntensifierCalibration {
        origin: request.origin.clone(),
        size_px: first.size_px.map(|n| n as u32),
        disc_centre_px: disc.centre.to_array(),
        disc_radius_px: disc.radius_px,
        order: request.order,
        held_out_rms_px: Some((held_out.0 / held_out.1.max(1) as f64).sqrt()),
        angles_from: request.angles_from,
        plate_pitch_mm: request.pitch_mm.zip(reference).map(|(pitch, (_, gauge))| pitch / gauge.cell_px()),
        veiling_glare: request.glare,
        views,
        notes,
    };
    calibration.check()?;
    Ok(calibration)
}

/// `nodes` with the cells that the first view has there: quarter turns and whole steps apart. `None` when the plate lies otherwise.
fn as_in(first: &Polynomial, nodes: &[Node]) -> Option<Vec<Node>> {
    let quarter = |turns: usize| (0..turns).fold(DMat2::IDENTITY, |turned, _| DMat2::from_cols(DVec2::Y, DVec2::NEG_X) * turned);
    (0..4).find_map(|turns| {
        let turned = |node: &Node| quarter(turns) * node.cell.as_dvec2();
        let offsets: Vec<DVec2> = nodes.iter().map(|node| first.at(node.image_px) - turned(node)).collect();
        let usual = |of: fn(&DVec2) -> f64| median(offsets.iter().map(of));
        let whole = DVec2::new(usual(|offset| offset.x)?, usual(|offset| offset.y)?).round();
        let there = offsets.iter().filter(|offset| offset.distance(whole) < UNMOVED_CELLS).count();
        let moved = |node: &Node| Node { cell: (turned(node) + whole).round().as_ivec2(), ..*node };
        (there as f64 >= UNMOVED_SHARE * nodes.len() as f64).then(|| nodes.iter().map(moved).collect())
    })
}

fn view(
    frame: &Frame,
    angles_deg: Option<AnglesDeg>,
    fit: &ViewFit,
    gauge: &Gauge,
    disc: &Disc,
    (held_out_px2, found): (f64, usize),
) -> IntensifierView {
    let spots = fit.nodes.len();
    let place = |node: &Node| gauge.px_from_cells * fit.polynomial.at(node.image_px) + gauge.origin_px;
    let shift_px = fit.polynomial.shift_px(gauge);
    IntensifierView {
        frame: frame.name.clone(),
        orbital_deg: angles_deg.map(|angles| angles[0]),
        angulation_deg: angles_deg.map(|angles| angles[1]),
        spots,
        left_out: found - spots,
        held_out_rms_px: Some((held_out_px2 / spots as f64).sqrt()),
        raw_mean_px: Some(fit.nodes.iter().map(|node| place(node).distance(node.image_px)).sum::<f64>() / spots as f64),
        reach: Some(fit.nodes.iter().map(|node| node.image_px.distance(disc.centre)).fold(0.0, f64::max) / disc.radius_px),
        shift_u_px: shift_px.iter().map(|shift| shift.x).collect(),
        shift_v_px: shift_px.iter().map(|shift| shift.y).collect(),
    }
}
