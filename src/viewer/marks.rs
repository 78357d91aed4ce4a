//! What is drawn over a frame: beads with their residuals, landmarks with their uncertainty, the robot, a scale bar.

use eframe::egui::{Align2, Color32, Painter, Pos2, Shape, Stroke, Vec2, epaint::EllipseShape, pos2, vec2};

use super::editing::names;
use super::sight::Placed;
use super::state::{Mark, ViewState};
use super::theme::{SMALL, TEXT, font};
use crate::session::board::{BeadMark, LandmarkMark, PairView, RobotMark};

/// Residuals and uncertainties are drawn so many times as large as they are.
pub(super) const STRETCH: f64 = 20.0;
const USED: Color32 = Color32::from_rgb(40, 230, 80);
const LEFT_OUT: Color32 = Color32::from_rgb(240, 50, 40);
const PREDICTED: Color32 = Color32::from_rgb(250, 220, 30);
/// Put or named by a hand.
const OF_HAND: Color32 = Color32::from_rgb(80, 220, 250);
const CHOSEN: Color32 = Color32::WHITE;
const SHADOW: Color32 = Color32::from_rgb(190, 190, 200);
const RESIDUAL: Color32 = Color32::from_rgb(255, 110, 230);
const ROBOT: Color32 = Color32::from_rgb(90, 190, 255);
const LANDMARK: Color32 = Color32::from_rgb(255, 170, 90);
/// Between a shadow's rim and its ring, pixels of the frame.
const GAP_PX: f64 = 4.0;
/// Rings of shadows whose radius is not known.
const RADIUS_PX: f64 = 8.0;

/// Everything that `state` draws over a picture of the frame.
pub(super) fn all(painter: &Painter, placed: &Placed, pair: &PairView, state: &ViewState) {
    let marks = &pair.marks;
    if state.draws(Mark::Robot)
        && let Some(mark) = &marks.robot
    {
        robot(painter, placed, mark);
    }
    if state.draws(Mark::Beads) {
        for (at, radius_px) in &marks.shadows {
            ring(painter, placed, *at, *radius_px, 1.0, SHADOW);
        }
    }
    for mark in &marks.beads {
        let of_hand = pair.pair.edited.as_ref().is_some_and(|edited| edited.is_of(&mark.name));
        bead(painter, placed, mark, of_hand, state);
    }
    if state.draws(Mark::Landmarks) {
        marks.landmarks.iter().for_each(|mark| landmark(painter, placed, mark, state.draws(Mark::Names)));
    }
}

/// What is chosen while beads are edited, where it was moved to, and the names that it may get.
pub(super) fn chosen(painter: &Painter, placed: &Placed, pair: &PairView, state: &ViewState) {
    let Some(chosen) = state.editing.chosen().filter(|_| state.editing.is_on()) else { return };
    let at = chosen.now_px();
    ring(painter, placed, at, RADIUS_PX + GAP_PX, 2.5, CHOSEN);
    cross(painter, placed.screen(at), 7.0, CHOSEN);
    let beside = ring_points(placed, RADIUS_PX + GAP_PX) + 4.0;
    let listed: Vec<String> =
        names(pair, chosen.image_px).iter().enumerate().map(|(n, name)| format!("{} {name}", n + 1)).collect();
    let corner = placed.screen(at) + vec2(beside, beside);
    words(painter, corner, Align2::LEFT_TOP, &listed.join("  "), CHOSEN);
}

/// Where P puts things, over the DRR.
pub(super) fn predicted(painter: &Painter, placed: &Placed, pair: &PairView, state: &ViewState) {
    if state.draws(Mark::Robot)
        && let Some(mark) = &pair.marks.robot
    {
        robot(painter, placed, mark);
    }
    let at = pair.marks.beads.iter().filter_map(|bead| bead.predicted_px);
    at.filter(|_| state.draws(Mark::Beads)).for_each(|at| cross(painter, placed.screen(at), 5.0, PREDICTED));
}

fn bead(painter: &Painter, placed: &Placed, mark: &BeadMark, of_hand: bool, state: &ViewState) {
    let radius_px = mark.radius_px.unwrap_or(RADIUS_PX);
    if state.draws(Mark::Beads) {
        if let Some(at) = mark.found_px {
            let colour = match (mark.used, of_hand) {
                (true, true) => OF_HAND,
                (true, false) => USED,
                (false, _) => LEFT_OUT,
            };
            ring(painter, placed, at, radius_px, 1.8, colour);
        }
        if let Some(at) = mark.predicted_px {
            cross(painter, placed.screen(at), 4.0, PREDICTED);
        }
    }
    if state.draws(Mark::Residuals)
        && let Some((from, [du, dv])) = mark.predicted_px.zip(mark.residual_px)
    {
        let to = placed.screen([from[0] + STRETCH * du, from[1] + STRETCH * dv]);
        arrow(painter, placed.screen(from), to, RESIDUAL);
    }
    if state.draws(Mark::Names)
        && let Some(at) = mark.found_px.or(mark.predicted_px)
    {
        let beside = ring_points(placed, radius_px) + 2.0;
        let colour = if mark.used { USED } else { PREDICTED };
        words(painter, placed.screen(at) + vec2(beside, -beside), Align2::LEFT_BOTTOM, &mark.name, colour);
    }
}

fn landmark(painter: &Painter, placed: &Placed, mark: &LandmarkMark, named: bool) {
    let Some(at) = mark.image_px else { return };
    let centre = placed.screen(at);
    cross(painter, centre, 6.0, LANDMARK);
    if let Some([u, v]) = mark.sigma_px {
        let radius = vec2((STRETCH * u) as f32, (STRETCH * v) as f32) * placed.scale;
        painter.add(Shape::Ellipse(EllipseShape::stroke(centre, radius.max(vec2(1.0, 1.0)), Stroke::new(1.4, LANDMARK))));
    }
    if named {
        words(painter, centre + vec2(9.0, 4.0), Align2::LEFT_TOP, &mark.name, LANDMARK);
    }
}

fn robot(painter: &Painter, placed: &Placed, mark: &RobotMark) {
    let tip = placed.screen(mark.tip_px);
    let line: Vec<Pos2> = mark.centreline_px.iter().map(|at| placed.screen(*at)).chain([tip]).collect();
    painter.add(Shape::line(line, Stroke::new(1.6, ROBOT)));
    painter.circle_stroke(tip, 5.0, Stroke::new(1.8, ROBOT));
}

/// Radius of a bead's ring on the screen.
fn ring_points(placed: &Placed, radius_px: f64) -> f32 {
    ((radius_px + GAP_PX) as f32 * placed.scale).max(4.0)
}

fn ring(painter: &Painter, placed: &Placed, at: [f64; 2], radius_px: f64, width: f32, colour: Color32) {
    painter.circle_stroke(placed.screen(at), ring_points(placed, radius_px), Stroke::new(width, colour));
}

fn cross(painter: &Painter, at: Pos2, reach: f32, colour: Color32) {
    let stroke = Stroke::new(1.2, colour);
    painter.line_segment([at - vec2(reach, 0.0), at + vec2(reach, 0.0)], stroke);
    painter.line_segment([at - vec2(0.0, reach), at + vec2(0.0, reach)], stroke);
}

fn arrow(painter: &Painter, from: Pos2, to: Pos2, colour: Color32) {
    let stroke = Stroke::new(1.6, colour);
    painter.line_segment([from, to], stroke);
    let along = to - from;
    if along.length() > 5.0 {
        let back = -along.normalized() * 5.0;
        let aside = Vec2::new(-back.y, back.x) * 0.6;
        painter.line_segment([to, to + back + aside], stroke);
        painter.line_segment([to, to + back - aside], stroke);
    }
}

/// Words that can be read on any ground.
pub(super) fn words(painter: &Painter, at: Pos2, align: Align2, text: &str, colour: Color32) {
    for off in [vec2(1.0, 1.0), vec2(-1.0, 1.0), vec2(1.0, -1.0), vec2(-1.0, -1.0)] {
        painter.text(at + off, align, text, font(SMALL), Color32::from_black_alpha(150));
    }
    painter.text(at, align, text, font(SMALL), colour);
}

/// A bar of a round length at the depth of interest, in the pane's lower left corner.
pub(super) fn scale_bar(painter: &Painter, placed: &Placed, mm_per_px: f64) {
    let points_per_mm = f64::from(placed.scale) / mm_per_px;
    if !(points_per_mm > 0.0 && points_per_mm.is_finite()) {
        return;
    }
    let seen = placed.seen();
    let most_mm = 0.3 * f64::from(seen.width()) / points_per_mm;
    let decade = 10f64.powf(most_mm.max(1e-9).log10().floor());
    let length_mm = [5.0, 2.0, 1.0].map(|step| step * decade).into_iter().find(|mm| *mm <= most_mm).unwrap_or(decade);
    let from = pos2(seen.left() + 10.0, seen.bottom() - 10.0);
    let to = from + vec2((length_mm * points_per_mm) as f32, 0.0);
    for (width, colour) in [(5.0, Color32::from_black_alpha(150)), (2.0, TEXT)] {
        painter.line_segment([from, to], Stroke::new(width, colour));
        for end in [from, to] {
            painter.line_segment([end - vec2(0.0, 4.0), end + vec2(0.0, 4.0)], Stroke::new(width, colour));
        }
    }
    words(
        painter,
        from + vec2(0.0, -7.0),
        Align2::LEFT_BOTTOM,
        &format!("{} mm", crate::report::short(length_mm, length_mm)),
        TEXT,
    );
}
