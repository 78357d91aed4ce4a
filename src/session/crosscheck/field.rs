//! What the shutters leave open, by telemetry, by the frame's tags and in its pixels: each against the others.

use glam::{DAffine2, DVec2};

use super::finding::Finding;
use crate::acquire::{CollimatorShape, CollimatorTags, Frame};
use crate::geometry::{CarmCalibration, ConsoleGeometry};
use crate::telemetry::CarmSample;

const CHECK: &str = "field";
/// Shutters are found in the pixels to within their penumbra.
const FIELD_SHARE: f64 = 0.15;
/// Share of the distance to the detector to within which a field that is indicated has to be the one that there is (21 CFR 1020.31). Tags
/// and telemetry come from the same shutters: what they round, and the plane that they mean, is not more than that.
const SHUTTER_SHARE: f64 = 0.02;
/// Share of the distance to the detector by which a field may be larger than the picture that is shown (21 CFR 1020.32).
const BESIDE_SHARE: f64 = 0.03;
/// The shutters of a picture that is turned by more than this, quarters aside, are not along its sides.
const TURNED_RAD: f64 = 1e-3;
const SIDES: [&str; 4] = ["left", "top", "right", "bottom"];

/// Left, top, right, bottom, in mm from the panel's middle.
type Sides = [f64; 4];

/// Telemetry's field against the frame's tags, and where they agree or say nothing, against the share of the frame that lies behind
/// shutters. `carm` is the calibration of this frame's pixels.
pub(super) fn check_field(
    beam: &CarmSample,
    carm: &CarmCalibration,
    frame: &Frame,
    shuttered_share: Option<f64>,
) -> Option<Finding> {
    let place = Place::of(frame, carm);
    let by_tags = || {
        let (place, sid_mm) = place.as_ref().zip(sid_mm(beam, carm, frame))?;
        let by_shutters = frame.tags.collimator.as_ref().and_then(|tags| against_collimator(beam.field_mm, tags, place, sid_mm));
        by_shutters.or_else(|| against_field_of_view(beam.field_mm, frame.tags.field_of_view_mm?, place, sid_mm))
    };
    let by_pixels = || {
        let [u, v] = [carm.columns_px, carm.rows_px].map(|side| 0.5 * f64::from(side) * carm.pitch_mm);
        let frame_mm = place.as_ref().map_or([-u, -v, u, v], |place| place.frame_mm);
        against_pixels(beam.field_mm, frame_mm, shuttered_share?)
    };
    by_tags().or_else(by_pixels)
}

/// The largest that is said of the distance to the detector: one in metres must not make the checks strict.
fn sid_mm(beam: &CarmSample, carm: &CarmCalibration, frame: &Frame) -> Option<f64> {
    let said_mm = [Some(beam.joints.source_to_detector_mm), carm.source_to_detector_mm, frame.tags.sid_mm];
    said_mm.into_iter().flatten().filter(|mm| mm.is_finite() && *mm > 0.0).reduce(f64::max)
}

/// Where a frame lies on the panel.
struct Place {
    /// Pixels of the picture in the file, centres at integers, to mm from the panel's middle.
    panel_from_file: DAffine2,
    /// The frame's sides.
    frame_mm: Sides,
    /// Those of the part of the panel that it shows.
    shown_mm: Sides,
}

impl Place {
    /// `None` where it is not known, or turned by more than quarters.
    fn of(frame: &Frame, carm: &CarmCalibration) -> Option<Self> {
        let size_px = frame.size_px.map(|side| side as u32);
        if size_px != [carm.columns_px, carm.rows_px] {
            return None;
        }
        let undeclared = ConsoleGeometry::default();
        let (console, stored_px, panel_px) = match frame.correction.as_ref().and_then(|correction| correction.stored.as_ref()) {
            Some(stored) => (&stored.console, stored.size_px, stored.panel_px?),
            None => (&undeclared, size_px, size_px),
        };
        let window = console.window(stored_px);
        // The calibration's pitch is that of the frame's pixels.
        let pitch_mm = carm.pitch_mm / window.step;
        if !(pitch_mm > 0.0 && window.turned_rad.abs() <= TURNED_RAD) {
            return None;
        }
        let [file_px, panel_px] = [stored_px, panel_px].map(|size_px| DVec2::from_array(size_px.map(f64::from)));
        let from_middle = DAffine2::from_translation(-0.5 * (panel_px - DVec2::ONE));
        let panel_from_file = DAffine2::from_scale(DVec2::splat(pitch_mm)) * from_middle * frame.panel_from_file();
        let frame_mm = sides(&panel_from_file, [-0.5, -0.5, file_px.x - 0.5, file_px.y - 0.5]);
        let half_mm = 0.5 * pitch_mm * panel_px;
        let shown_mm = within(frame_mm, [-half_mm.x, -half_mm.y, half_mm.x, half_mm.y]);
        Some(Self { panel_from_file, frame_mm, shown_mm })
    }
}

/// The box between two corners, given as left, top, right and bottom in the pixels of the file.
fn sides(panel_from_file: &DAffine2, [left, top, right, bottom]: [f64; 4]) -> Sides {
    let [a, b] = [DVec2::new(left, top), DVec2::new(right, bottom)].map(|corner| panel_from_file.transform_point2(corner));
    let (low, high) = (a.min(b), a.max(b));
    [low.x, low.y, high.x, high.y]
}

/// What of a box lies within `bounds`.
fn within(inner: Sides, bounds: Sides) -> Sides {
    std::array::from_fn(|side| inner[side].max(bounds[side % 2]).min(bounds[side % 2 + 2]))
}

fn is_open([left, top, right, bottom]: Sides) -> bool {
    left < right && top < bottom
}

/// The smallest and the largest box that telemetry's shutters can have by the tags. They are alike where there are shutters alone; an
/// iris within them hides where they stand, up to the iris or out to the frame's sides.
fn opening(tags: &CollimatorTags, place: &Place) -> Option<[Sides; 2]> {
    if tags.shapes.contains(&CollimatorShape::Polygonal) {
        return None;
    }
    let is_named = |shape: CollimatorShape| tags.shapes.is_empty() || tags.shapes.contains(&shape);
    let shown = |px: [f64; 4]| within(sides(&place.panel_from_file, px), place.shown_mm);
    // The first column is 1, and its left side half a pixel before its centre.
    let shutters = tags.edges_px.filter(|_| is_named(CollimatorShape::Rectangular));
    let shutters = shutters.map(|[left, top, right, bottom]| shown([left - 1.5, top - 1.5, right - 0.5, bottom - 0.5]));
    let iris = tags.centre_px.zip(tags.radius_px).filter(|_| is_named(CollimatorShape::Circular));
    let iris = iris.map(|([u, v], r)| shown([u - 1.0 - r, v - 1.0 - r, u - 1.0 + r, v - 1.0 + r]));
    if shutters.is_none() && iris.is_none() {
        return None;
    }
    let largest = shutters.unwrap_or(place.shown_mm);
    let smallest = iris.map_or(largest, |iris| within(iris, largest));
    is_open(smallest).then_some([smallest, largest])
}

/// Telemetry's shutters against those of the tags, within what the frame shows: how far out a shutter stands that leaves all open is told
/// in many ways.
fn against_collimator(field_mm: Sides, tags: &CollimatorTags, place: &Place, sid_mm: f64) -> Option<Finding> {
    let [smallest, largest] = opening(tags, place)?;
    let [left, top, right, bottom] = field_mm;
    // A field without extent is none that was measured.
    if right <= left || bottom <= top {
        return None;
    }
    let told_mm = within(field_mm, place.shown_mm);
    let both = |side: usize| {
        let (low, high) = (smallest[side].min(largest[side]), smallest[side].max(largest[side]));
        (side, told_mm[side], told_mm[side].max(low).min(high))
    };
    let apart = |(_, told_mm, tag_mm): &(usize, f64, f64)| (told_mm - tag_mm).abs();
    // A shutter that was not measured is NaN and says nothing.
    let measured = (0..SIDES.len()).filter(|side| !field_mm[*side].is_nan()).map(both);
    let worst = measured.max_by(|a, b| apart(a).total_cmp(&apart(b)))?;
    if apart(&worst) <= SHUTTER_SHARE * sid_mm {
        return None;
    }
    let (side, told_mm, tag_mm) = worst;
    let detail = format!(
        "telemetry has the {} shutter at {told_mm:+.0} mm from the panel's middle, the frame's collimator tags have it at {tag_mm:+.0} mm",
        SIDES[side]
    );
    Some(Finding::warn(
        CHECK,
        detail,
        "check that the frame belongs to this exposure, and that telemetry's field is live and in mm at the detector",
    ))
}

/// No field may be much larger than the picture: where it is, the picture is a part that the session does not know of. Which side of the
/// tag is which, writers and turned pictures disagree about, so that long is held against long and short against short.
fn against_field_of_view(field_mm: Sides, tag_mm: [f64; 2], place: &Place, sid_mm: f64) -> Option<Finding> {
    if field_mm.iter().any(|side| side.is_nan()) {
        return None;
    }
    let [left, top, right, bottom] = within(field_mm, place.shown_mm);
    let ordered = |[a, b]: [f64; 2]| if a < b { [a, b] } else { [b, a] };
    let told_mm = [right - left, bottom - top];
    let pairs = ordered(told_mm).into_iter().zip(ordered(tag_mm));
    let most_mm = pairs.map(|(told_mm, tag_mm)| told_mm - tag_mm).fold(0.0, f64::max);
    if most_mm <= BESIDE_SHARE * sid_mm {
        return None;
    }
    let detail = format!(
        "telemetry's field covers {:.0} x {:.0} mm of the frame, the frame's tags say that it shows {:.0} x {:.0} mm in all",
        told_mm[0], told_mm[1], tag_mm[0], tag_mm[1]
    );
    Some(Finding::warn(
        CHECK,
        detail,
        "if the console enlarges or crops, declare `console` in the session or use the calibration of this field of view; else check that \
         the frame belongs to this exposure",
    ))
}

fn against_pixels(field_mm: Sides, frame_mm: Sides, shuttered_share: f64) -> Option<Finding> {
    // A field that was not measured is NaN and says nothing.
    if field_mm.iter().any(|side| side.is_nan()) {
        return None;
    }
    let open = |axis: usize| {
        let (low, high) = (frame_mm[axis], frame_mm[axis + 2]);
        (field_mm[axis + 2].min(high) - field_mm[axis].max(low)).max(0.0) / (high - low)
    };
    let told = 1.0 - open(0) * open(1);
    if !told.is_finite() || (told - shuttered_share).abs() <= FIELD_SHARE {
        return None;
    }
    let detail = format!(
        "telemetry's field leaves {:.0} % of the frame behind shutters, the frame shows {:.0} %",
        100.0 * told,
        100.0 * shuttered_share
    );
    Some(Finding::warn(
        CHECK,
        detail,
        "check that the frame belongs to this exposure, and the size of the panel in the calibration",
    ))
}
