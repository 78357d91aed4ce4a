//! What is drawn over a frame: the figures of its marks, what a hand has chosen, a scale bar.

use eframe::egui::{Align2, Color32, Painter, Pos2, Rect, Shape, Stroke, pos2, vec2};

use super::editing::names;
use super::sight::Placed;
use super::state::{Mark, ViewState};
use super::theme::{SMALL, TEXT, font, rgb};
use crate::image::round_down;
use crate::report::figures::{Figure, Form, GAP_PX, RADIUS_PX, Tells, arrow, ring_reach};
use crate::report::{BeadMark, PairMarks};
use crate::session::board::PairView;

/// What a hand has chosen.
const CHOSEN: Color32 = Color32::WHITE;
/// The robot as the frame shows it; unlike telemetry's it is dashed, and can be seen on the robot's own white.
const SEEN_ROBOT: Color32 = Color32::from_rgb(0xa5, 0x5f, 0xff);
const DASH: (f32, f32) = (6.0, 4.0);
/// Behind words.
const BACKING: Color32 = Color32::from_black_alpha(170);
/// Width of crosses.
const THIN: f32 = 1.2;
/// Width of arrows.
const ARROW: f32 = 1.6;

/// Everything that `state` draws over a picture of the frame.
pub(super) fn all(painter: &Painter, placed: &Placed, pair: &PairView, state: &ViewState) {
    let figures = pair.marks.figures();
    figures.iter().filter(|figure| draws(state, figure.tells)).for_each(|figure| paint(painter, placed, figure));
}

/// What is chosen while beads are edited, where it was moved to, and the names that it may get.
pub(super) fn chosen(painter: &Painter, placed: &Placed, pair: &PairView, state: &ViewState) {
    let Some(chosen) = state.editing.chosen().filter(|_| state.editing.is_on()) else { return };
    let (at, reach) = (placed.screen(chosen.now_px()), reach(placed, RADIUS_PX + GAP_PX));
    painter.circle_stroke(at, reach, Stroke::new(2.5, CHOSEN));
    cross(painter, at, 7.0, CHOSEN);
    let listed: Vec<String> =
        names(pair, chosen.image_px).iter().enumerate().map(|(n, name)| format!("{}: {name}", n + 1)).collect();
    words(painter, at + vec2(reach + 4.0, reach + 4.0), Align2::LEFT_TOP, &listed.join("   "), CHOSEN);
}

/// Where P puts things, over the DRR.
pub(super) fn predicted(painter: &Painter, placed: &Placed, pair: &PairView, state: &ViewState) {
    // A DRR has no shadows that were found: names stand where P has them.
    let by_p = |bead: &BeadMark| BeadMark { found_px: None, residual_px: None, ..bead.clone() };
    let beads = pair.marks.beads.iter().map(by_p).collect();
    let marks = PairMarks { beads, robot: pair.marks.robot.clone(), ..PairMarks::default() };
    let figures = marks.figures();
    figures.iter().filter(|figure| draws(state, figure.tells)).for_each(|figure| paint(painter, placed, figure));
}

/// The robot as the frame shows it, beside where telemetry has it.
pub(super) fn seen_robot(painter: &Painter, placed: &Placed, pair: &PairView, state: &ViewState) {
    let Some(tip) = pair.pair.tip.filter(|_| state.draws(Mark::Robot)) else { return };
    if let Some(seen) = &pair.seen_robot {
        let along: Vec<Pos2> = seen.centreline_px.iter().map(|at| placed.screen(*at)).collect();
        painter.extend(Shape::dashed_line(&along, Stroke::new(ARROW, SEEN_ROBOT), DASH.0, DASH.1));
    }
    let (at, reach) = (placed.screen(tip.image_px), 6.0);
    let corners = [vec2(0.0, -reach), vec2(reach, 0.0), vec2(0.0, reach), vec2(-reach, 0.0)].map(|off| at + off);
    painter.add(Shape::closed_line(corners.to_vec(), Stroke::new(1.8, SEEN_ROBOT)));
}

/// What the lines along the robot mean, from `right_top` downwards, each in its colour behind a piece of its line; where that is.
pub(super) fn robot_legend(painter: &Painter, right_top: Pos2, pair: &PairView, state: &ViewState) -> Vec<Rect> {
    if !state.draws(Mark::Robot) {
        return Vec::new();
    }
    let drawn = pair.marks.figures().iter().find(|figure| figure.tells == Tells::Robot).map(|figure| rgb(figure.colour));
    let drawn_as = if pair.pair.robot_source.as_deref() == Some("scene") { "as in the scene file" } else { "by telemetry" };
    let seen = pair.pair.tip.map(|_| SEEN_ROBOT);
    let rows = [(drawn, format!("robot {drawn_as}"), false), (seen, "robot as seen in the frame".to_owned(), true)];
    let (mut at, mut taken) = (right_top, Vec::new());
    for (colour, text, is_dashed) in rows {
        let Some(colour) = colour else { continue };
        let rect = words(painter, at, Align2::RIGHT_TOP, &text, colour);
        let sample = [rect.left_center() - vec2(26.0, 0.0), rect.left_center() - vec2(5.0, 0.0)];
        let backing = Rect::from_two_pos(sample[0], sample[1]).expand(4.0);
        painter.rect_filled(backing, 3.0, BACKING);
        if is_dashed {
            painter.extend(Shape::dashed_line(&sample, Stroke::new(ARROW, colour), DASH.0, DASH.1));
        } else {
            painter.line_segment(sample, Stroke::new(ARROW, colour));
        }
        at.y = rect.bottom() + 3.0;
        taken.push(rect.union(backing));
    }
    taken
}

/// Whether figures that tell of this are drawn.
fn draws(state: &ViewState, tells: Tells) -> bool {
    match tells {
        Tells::Seen | Tells::Predicted => state.draws(Mark::Beads),
        Tells::Residual => state.draws(Mark::Residuals),
        Tells::Name => state.draws(Mark::Names),
        Tells::Landmark => state.draws(Mark::Landmarks),
        Tells::LandmarkName => state.draws(Mark::Landmarks) && state.draws(Mark::Names),
        Tells::Robot => state.draws(Mark::Robot),
    }
}

fn paint(painter: &Painter, placed: &Placed, figure: &Figure) {
    let colour = rgb(figure.colour);
    match &figure.form {
        Form::Ring { at_px, radius_px, width } => {
            painter.circle_stroke(placed.screen(*at_px), reach(placed, *radius_px), Stroke::new(*width as f32, colour));
        }
        Form::Spot { at_px, reach, width } => {
            painter.circle_stroke(placed.screen(*at_px), *reach as f32, Stroke::new(*width as f32, colour));
        }
        Form::Cross { at_px, reach } => cross(painter, placed.screen(*at_px), *reach as f32, colour),
        Form::Arrow { from_px, to_px } => {
            let on_screen = |at: [f64; 2]| {
                let at = placed.screen(at);
                [f64::from(at.x), f64::from(at.y)]
            };
            for line in arrow(on_screen(*from_px), on_screen(*to_px)) {
                painter.line_segment(line.map(|[x, y]| pos2(x as f32, y as f32)), Stroke::new(ARROW, colour));
            }
        }
        Form::Line { along_px, width } => {
            let along = along_px.iter().map(|at| placed.screen(*at)).collect();
            painter.add(Shape::line(along, Stroke::new(*width as f32, colour)));
        }
        Form::Words { at_px, radius_px, below, text } => {
            let aside = reach(placed, *radius_px) + 2.0;
            let (corner, off) =
                if *below { (Align2::LEFT_TOP, vec2(aside, aside)) } else { (Align2::LEFT_BOTTOM, vec2(aside, -aside)) };
            words(painter, placed.screen(*at_px) + off, corner, text, colour);
        }
    }
}

/// Radius of the ring about a shadow on the screen.
fn reach(placed: &Placed, radius_px: f64) -> f32 {
    ring_reach(radius_px, f64::from(placed.scale)) as f32
}

fn cross(painter: &Painter, at: Pos2, reach: f32, colour: Color32) {
    let stroke = Stroke::new(THIN, colour);
    painter.line_segment([at - vec2(reach, 0.0), at + vec2(reach, 0.0)], stroke);
    painter.line_segment([at - vec2(0.0, reach), at + vec2(0.0, reach)], stroke);
}

/// Words that can be read on any ground; where they are.
pub(super) fn words(painter: &Painter, at: Pos2, align: Align2, text: &str, colour: Color32) -> Rect {
    let galley = painter.layout_no_wrap(text.to_owned(), font(SMALL), colour);
    let rect = align.anchor_size(at, galley.size());
    if !text.is_empty() {
        painter.rect_filled(rect.expand2(vec2(3.0, 0.0)), 3.0, BACKING);
        painter.galley(rect.min, galley, colour);
    }
    rect
}

/// A bar of a round length at the depth of interest, in the pane's lower left corner; where it and its words are.
pub(super) fn scale_bar(painter: &Painter, placed: &Placed, mm_per_px: f64) -> Option<Rect> {
    let points_per_mm = f64::from(placed.scale) / mm_per_px;
    if !(points_per_mm > 0.0 && points_per_mm.is_finite()) {
        return None;
    }
    let seen = placed.seen();
    let most_mm = 0.3 * f64::from(seen.width()) / points_per_mm;
    let length_mm = round_down(most_mm);
    let from = pos2(seen.left() + 10.0, seen.bottom() - 10.0);
    let to = from + vec2((length_mm * points_per_mm) as f32, 0.0);
    for (width, colour) in [(5.0, Color32::from_black_alpha(150)), (2.0, TEXT)] {
        painter.line_segment([from, to], Stroke::new(width, colour));
        for end in [from, to] {
            painter.line_segment([end - vec2(0.0, 4.0), end + vec2(0.0, 4.0)], Stroke::new(width, colour));
        }
    }
    let length = format!("{} mm", crate::report::short(length_mm, length_mm));
    let told = words(painter, from + vec2(0.0, -7.0), Align2::LEFT_BOTTOM, &length, TEXT);
    Some(told.union(Rect::from_two_pos(from, to)))
}
