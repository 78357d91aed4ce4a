//! The panes with pictures: one zoom, one window and one cursor for all of them.

use std::sync::Arc;

use eframe::egui::{
    Align2, Color32, Context, Painter, PointerButton, Pos2, Rect, Response, RichText, Role, Sense, Stroke, TextureHandle, Ui,
    Vec2, WidgetInfo, pos2, vec2,
};

use super::arrange::{Pane, panes};
use super::marks;
use super::picture_cache::Picture;
use super::sight::Placed;
use super::state::{Mark, Overlay, ViewState};
use super::theme::{BODY, CAUTION, DIM, EDGE, TEXT, WELL, font};
use crate::report::figures::STRETCH;
use crate::report::{NOT_COMPARABLE, PoseSource, diverging, short};
use crate::session::board::{BoardState, PairView};

/// How often the blinking picture changes, a second.
const BLINKS_HZ: f64 = 2.0;
/// Squares of the checkerboard across the frame.
const SQUARES: usize = 8;
/// Points of the screen within which a click means a bead.
const REACH_POINTS: f32 = 18.0;
/// The whole range of gray is moved, or doubled, by dragging so many points.
const WINDOW_POINTS: f64 = 300.0;

/// Draws the panes into what is left of `ui`; without a pair it says so.
pub(super) fn show(ui: &mut Ui, board: &BoardState, state: &mut ViewState) {
    let area = ui.available_rect_before_wrap();
    let Some(pair) = state.shown(board).map(Arc::clone) else {
        let words = match (board.frames_seen, board.replayed) {
            (0, false) => "No frame yet",
            (0, true) => "The replay has not come to a frame yet",
            _ => "The first frame is being registered and rendered",
        };
        ui.centered_and_justified(|ui| ui.label(RichText::new(words).size(24.0).color(DIM)));
        return;
    };
    let size_px = pair.pictures.size_px;
    let window = state.window_of(&pair);
    state.cache.show(&pair.pictures, window);
    let aspect = size_px[0].max(1) as f32 / size_px[1].max(1) as f32;
    let mut under = None;
    for (pane, rect) in panes(area, aspect, state.arrangement) {
        let response = ui.interact(rect, ui.scope_id().with(format!("{pane:?}")), Sense::click_and_drag());
        // What eyes see is also said, for those who are read to and for tests.
        response.widget_info(|| WidgetInfo::labeled(Role::Image, true, said(pane, board, &pair, state)));
        let placed = state.sight.place(rect, size_px);
        if !edit(ui, pane, &response, &placed, &pair, state) {
            steer(ui, &response, &placed, &pair, state);
        }
        let placed = state.sight.place(rect, size_px);
        let cursor = state.cursor_px.filter(|_| !response.hovered()).map(|at| placed.screen(at));
        draw(ui, pane, &placed, (board, &pair), state, cursor);
        if let Some(at) = response.hover_pos() {
            under = Some(placed.image(at));
        }
    }
    ui.advance_cursor_after_rect(area);
    state.cursor_px = under;
}

fn title(pane: Pane, state: &ViewState) -> String {
    match pane {
        Pane::Acquired => "acquired".to_owned(),
        Pane::Drr => "matched DRR".to_owned(),
        Pane::Difference => "acquired − DRR".to_owned(),
        Pane::Overlay => match state.overlay {
            Overlay::Edges => "edges of the DRR over acquired".to_owned(),
            Overlay::Blink => "acquired and DRR in turn".to_owned(),
            Overlay::Checkerboard => "acquired and DRR in squares".to_owned(),
            Overlay::Opacity => format!("DRR over acquired, {:.0} %", 100.0 * state.opacity),
        },
    }
}

/// Why a pane is empty.
fn empty(pane: Pane, pair: &PairView) -> Option<String> {
    let why = match (pair.pair.pose_source, pair.complete) {
        (PoseSource::None, _) => "the frame has no pose to render it at",
        (_, false) => "it is being made",
        (_, true) => "none could be made or compared, see what to beware of",
    };
    match (pane, pair.pictures.simulated()) {
        (Pane::Acquired, _) => None,
        (Pane::Difference, Some(_)) if !pair.pictures.difference.is_some_and(|scale| scale.comparable) => {
            Some(NOT_COMPARABLE.to_owned())
        }
        (_, Some(_)) => None,
        (Pane::Drr, None) => Some(format!("no matched DRR: {why}")),
        (Pane::Difference, None) => Some(format!("no difference without a DRR: {why}")),
        (Pane::Overlay, None) => Some(format!("no DRR to lay over the frame: {why}")),
    }
}

/// A larger share of the frame that is dark in the difference is said to be.
const DARK_SHARE: f64 = 0.05;

/// Why much of the difference is dark.
fn dark(pair: &PairView) -> Option<String> {
    let masks = pair.pair.masks.as_ref().filter(|masks| masks.masked >= DARK_SHARE)?;
    let most = masks.causes.iter().max_by(|(_, a), (_, b)| a.total_cmp(b));
    let why = most.map(|(cause, share)| format!(", most of it {} ({:.0} %)", cause.words(), 100.0 * share)).unwrap_or_default();
    Some(format!("dark: left out, {:.0} %{why}", 100.0 * masks.masked))
}

fn said(pane: Pane, board: &BoardState, pair: &PairView, state: &ViewState) -> String {
    [Some(title(pane, state)), empty(pane, pair), small(board, pair)].into_iter().flatten().collect::<Vec<_>>().join(": ")
}

/// What the mouse does in a pane, to all panes.
fn steer(ui: &Ui, response: &Response, placed: &Placed, pair: &PairView, state: &mut ViewState) {
    if let Some(at) = response.hover_pos() {
        let (scroll, pinch) = ui.input(|input| (input.smooth_scroll_delta.y, input.zoom_delta()));
        let factor = (scroll * 0.004).exp() * pinch;
        if factor != 1.0 {
            state.sight.zoom_about(placed, at, factor);
        }
    }
    if response.dragged_by(PointerButton::Secondary) {
        let by = response.drag_delta();
        state.shift_window(pair, -f64::from(by.y) / WINDOW_POINTS, f64::from(by.x) / WINDOW_POINTS);
    } else if response.dragged() {
        state.sight.drag(placed, response.drag_delta());
    }
    if response.double_clicked() {
        state.sight = Default::default();
    }
}

/// What the mouse does where beads are edited; whether nothing else is to be done with it.
fn edit(ui: &Ui, pane: Pane, response: &Response, placed: &Placed, pair: &PairView, state: &mut ViewState) -> bool {
    if !(state.editing.is_on() && matches!(pane, Pane::Acquired | Pane::Overlay)) {
        return false;
    }
    let reach_px = f64::from(REACH_POINTS / placed.scale);
    if response.clicked()
        && let Some(at) = response.interact_pointer_pos()
    {
        state.editing.choose_at(pair, placed.image(at), reach_px);
    }
    if response.drag_started_by(PointerButton::Primary)
        && let Some(from) = ui.input(|input| input.pointer.press_origin())
    {
        state.editing.drag_from(pair, placed.image(from), reach_px);
        // The drag is told when it has gone some points.
        let gone = response.interact_pointer_pos().map_or(Vec2::ZERO, |at| at - from) - response.drag_delta();
        state.editing.drag(in_px(gone, placed), false, pair);
    }
    let moves = state.editing.is_dragging();
    if moves {
        state.editing.drag(in_px(response.drag_delta(), placed), response.drag_stopped(), pair);
    }
    // A double click shows the whole frame where nothing is edited; here it is two clicks.
    moves || response.double_clicked()
}

fn in_px(points: Vec2, placed: &Placed) -> [f64; 2] {
    [points.x, points.y].map(|points| f64::from(points / placed.scale))
}

fn draw(
    ui: &Ui,
    pane: Pane,
    placed: &Placed,
    (board, pair): (&BoardState, &PairView),
    state: &mut ViewState,
    cursor: Option<Pos2>,
) {
    let painter = ui.painter_at(placed.pane);
    painter.rect_filled(placed.pane, 2.0, WELL);
    let within = painter.with_clip_rect(placed.seen());
    let (why_empty, mut taken) = (empty(pane, pair), Vec::new());
    let is_empty = why_empty.is_some();
    if let Some(words) = why_empty {
        let galley = painter.layout(words, font(BODY), DIM, placed.pane.width() - 20.0);
        painter.galley(placed.pane.center() - 0.5 * galley.size(), galley, DIM);
    } else {
        let context = ui.ctx();
        match pane {
            Pane::Acquired => paint(&painter, placed, state.cache.texture(context, Picture::Acquired), Color32::WHITE),
            Pane::Drr => paint(&painter, placed, state.cache.texture(context, Picture::Drr), Color32::WHITE),
            Pane::Difference => paint(&painter, placed, state.cache.texture(context, Picture::Difference), Color32::WHITE),
            Pane::Overlay => overlay(ui, &painter, placed, state),
        }
        if state.draws(Mark::Masks) && pane != Pane::Difference {
            paint(&painter, placed, state.cache.texture(context, Picture::Masks), Color32::WHITE);
        }
        match pane {
            Pane::Acquired | Pane::Overlay => {
                marks::all(&within, placed, pair, state);
                marks::seen_robot(&within, placed, pair, state);
                marks::chosen(&within, placed, pair, state);
            }
            Pane::Drr => marks::predicted(&within, placed, pair, state),
            Pane::Difference => {}
        }
        let scale = pair.mm_per_px.and_then(|mm_per_px| marks::scale_bar(&within, placed, mm_per_px));
        taken.extend(in_corner(placed.seen().left_bottom(), scale));
        taken.extend(legend(&within, pane, placed, pair, state));
    }
    let mut corner = placed.pane.left_top() + vec2(7.0, 5.0);
    let is_dark = (pane == Pane::Difference && !is_empty).then(|| dark(pair)).flatten();
    let lines =
        [Some((title(pane, state), TEXT)), is_dark.map(|words| (words, DIM)), small(board, pair).map(|words| (words, CAUTION))];
    let mut head = Vec::new();
    for (line, colour) in lines.into_iter().flatten() {
        let told = marks::words(&painter, corner, Align2::LEFT_TOP, &line, colour);
        corner.y = told.bottom() + 3.0;
        head.push(told);
    }
    taken.extend(in_corner(placed.pane.left_top(), head));
    // Last: what the words take is known when they are laid out.
    if let Some(at) = cursor.filter(|_| !is_empty) {
        crosshair(&within, at, &taken);
    }
}

/// That the pictures are small ones, and where the whole ones are.
fn small(board: &BoardState, pair: &PairView) -> Option<String> {
    let where_they_are = if board.away.contains(&pair.number()) { "loading" } else { "the log has it" };
    pair.pictures.is_small().then(|| format!("small picture: {where_they_are}"))
}

fn paint(painter: &Painter, placed: &Placed, texture: Option<TextureHandle>, tint: Color32) {
    if let Some(texture) = texture {
        painter.image(texture.id(), placed.frame(), whole(), tint);
    }
}

fn whole() -> Rect {
    Rect::from_min_max(pos2(0.0, 0.0), pos2(1.0, 1.0))
}

fn overlay(ui: &Ui, painter: &Painter, placed: &Placed, state: &mut ViewState) {
    let context: &Context = ui.ctx();
    let mut texture = |picture| state.cache.texture(context, picture);
    match state.overlay {
        Overlay::Edges => {
            paint(painter, placed, texture(Picture::Acquired), Color32::from_gray(210));
            paint(painter, placed, texture(Picture::Edges), Color32::WHITE);
        }
        Overlay::Blink => {
            let beats = ui.input(|input| input.time) * BLINKS_HZ;
            let picture = if (beats as u64).is_multiple_of(2) { Picture::Acquired } else { Picture::Drr };
            paint(painter, placed, texture(picture), Color32::WHITE);
            let rests_s = (1.0 - beats.fract()) / BLINKS_HZ;
            context.request_repaint_after(std::time::Duration::from_secs_f64(rests_s));
        }
        Overlay::Checkerboard => {
            paint(painter, placed, texture(Picture::Acquired), Color32::WHITE);
            let Some(drr) = texture(Picture::Drr) else { return };
            let side = |n: usize| n as f32 / SQUARES as f32;
            for square in (0..SQUARES * SQUARES).filter(|n| (n / SQUARES + n % SQUARES) % 2 == 1) {
                let (row, column) = (square / SQUARES, square % SQUARES);
                let (on_screen, of_texture) = placed.part([side(column), side(row)], [side(column + 1), side(row + 1)]);
                painter.image(drr.id(), on_screen, of_texture, Color32::WHITE);
            }
        }
        Overlay::Opacity => {
            paint(painter, placed, texture(Picture::Acquired), Color32::WHITE);
            let over = Color32::from_white_alpha((255.0 * state.opacity).round() as u8);
            paint(painter, placed, texture(Picture::Drr), over);
        }
    }
}

/// What a pane's `corner` has words in, to their ends and what is behind them.
fn in_corner(corner: Pos2, words: impl IntoIterator<Item = Rect>) -> Option<Rect> {
    let words = words.into_iter().reduce(Rect::union)?;
    Some(words.expand(3.0).union(Rect::from_min_max(corner, corner)))
}

/// Where the cursor is in another pane; it leaves out what would lie over words.
fn crosshair(painter: &Painter, at: Pos2, taken: &[Rect]) {
    let stroke = Stroke::new(1.0, Color32::from_white_alpha(110));
    for towards in [vec2(1.0, 0.0), vec2(-1.0, 0.0), vec2(0.0, 1.0), vec2(0.0, -1.0)] {
        let ends = [at + 5.0 * towards, at + 16.0 * towards];
        let arm = Rect::from_two_pos(ends[0], ends[1]);
        if !taken.iter().any(|words| words.intersects(arm)) {
            painter.line_segment(ends, stroke);
        }
    }
}

/// What the colours of a pane mean, in its lower right corner, and its marks, in its upper one; where that is.
fn legend(painter: &Painter, pane: Pane, placed: &Placed, pair: &PairView, state: &ViewState) -> impl Iterator<Item = Rect> {
    let seen = placed.seen();
    let bar = Rect::from_min_max(seen.right_bottom() - vec2(130.0, 16.0), seen.right_bottom() - vec2(10.0, 9.0));
    let scale = |low: f64, high: f64, colour: &dyn Fn(f32) -> Color32| {
        const STEPS: u32 = 24;
        for step in 0..STEPS {
            let at = |n: u32| bar.left() + bar.width() * n as f32 / STEPS as f32;
            let part = Rect::from_min_max(pos2(at(step), bar.top()), pos2(at(step + 1), bar.bottom()));
            painter.rect_filled(part, 0.0, colour((step as f32 + 0.5) / STEPS as f32));
        }
        let range = high - low;
        let low = marks::words(painter, bar.left_top() - vec2(0.0, 2.0), Align2::LEFT_BOTTOM, &short(low, range), TEXT);
        let high = marks::words(painter, bar.right_top() - vec2(0.0, 2.0), Align2::RIGHT_BOTTOM, &short(high, range), TEXT);
        bar.union(low).union(high)
    };
    let mut colours = match (pane, pair.pictures.difference) {
        (Pane::Acquired | Pane::Drr, _) => {
            let window = state.window_of(pair);
            let [low, high] = if pane == Pane::Drr { pair.pictures.drr_window(window) } else { window };
            Some(scale(low, high, &|share| Color32::from_gray((10.0 + 240.0 * share) as u8)))
        }
        (Pane::Difference, Some(difference)) => {
            let colour = |share: f32| {
                let [red, green, blue] = diverging(2.0 * share - 1.0);
                Color32::from_rgb(red, green, blue)
            };
            Some(scale(-difference.limit, difference.limit, &colour))
        }
        (Pane::Overlay, _) if state.overlay == Overlay::Edges => {
            Some(marks::words(painter, seen.right_bottom() - vec2(10.0, 8.0), Align2::RIGHT_BOTTOM, "edges of the DRR", EDGE))
        }
        _ => None,
    };
    let unit = match (pane, pair.pictures.difference) {
        (Pane::Difference, Some(difference)) if difference.offset != 0.0 => {
            format!("{} ({})", difference.unit, short(difference.offset, 1.0))
        }
        (Pane::Difference | Pane::Acquired | Pane::Drr, _) => pair.pictures.unit.clone(),
        (Pane::Overlay, _) => String::new(),
    };
    if let Some(numbers) = colours.filter(|_| !unit.is_empty()) {
        let above = pos2(bar.center().x, numbers.top() - 2.0);
        colours = Some(numbers.union(marks::words(painter, above, Align2::CENTER_BOTTOM, &unit, TEXT)));
    }
    let mut of_marks = Vec::new();
    let mut corner = seen.right_top() + vec2(-7.0, 5.0);
    let enlarged = [Mark::Residuals, Mark::Landmarks].into_iter().any(|mark| state.draws(mark));
    if pane == Pane::Acquired && enlarged && !(pair.marks.beads.is_empty() && pair.marks.landmarks.is_empty()) {
        let words = format!("residuals and uncertainties {STRETCH:.0}×");
        let told = marks::words(painter, corner, Align2::RIGHT_TOP, &words, TEXT);
        corner.y = told.bottom() + 3.0;
        of_marks.push(told);
    }
    if pane == Pane::Acquired {
        of_marks.extend(marks::robot_legend(painter, corner, pair, state));
    }
    [in_corner(seen.right_bottom(), colours), in_corner(seen.right_top(), of_marks)].into_iter().flatten()
}
