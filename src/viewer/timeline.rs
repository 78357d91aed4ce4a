//! The exposures along their time, each in the colour of its state, with how far it has come and what was noted of it: to scrub, to step
//! through, to play.

use eframe::egui::{
    self, Align2, Color32, Label, Painter, Rect, RichText, Role, Sense, Stroke, StrokeKind, Ui, WidgetInfo, pos2, vec2,
};

use super::keys::{Command, run};
use super::note::Written;
use super::state::ViewState;
use super::theme::{CAUTION, DIM, INK, LINE, SMALL, TEXT, WELL, font, of_standing};
use super::time_axis::TimeAxis;
use super::told;
use crate::report::Standing;
use crate::session::board::{BoardState, PairView, Phase};
use crate::telemetry::Sample;
use crate::time::utc;

/// Of the tiles, and of the times below them.
const HEIGHT: f32 = 30.0;
const TIMES: f32 = 14.0;
/// Narrower tiles have no phase.
const PHASED: f32 = 32.0;
/// Letters of a phase.
const TINY: f32 = 9.5;
/// Frames in work of which is told in words.
const MOST_TOLD: usize = 3;

/// Moves on where it plays, and asks to be drawn again in time.
pub(super) fn advance(ui: &Ui, board: &BoardState, state: &mut ViewState) {
    if !state.player.is_playing() {
        return;
    }
    let Some(at) = state.shown_index(board) else { return state.player.stop() };
    let times_us: Vec<i64> = board.pairs.iter().map(|pair| pair.time_us).collect();
    let now = state.player.advance(ui.input(|input| input.time), &times_us, at);
    state.select(board, now);
    if let Some(rests_s) = state.player.rests_s(&times_us, now) {
        ui.ctx().request_repaint_after(std::time::Duration::from_secs_f64(rests_s));
    }
}

/// Draws it.
pub(super) fn show(ui: &mut Ui, board: &BoardState, state: &mut ViewState) {
    let mut asked = None;
    ui.horizontal(|ui| {
        let playing = state.player.is_playing();
        let buttons = [
            ("first", Command::Oldest),
            ("back", Command::Step(-1)),
            (if playing { "stop" } else { "play" }, Command::Play),
            ("next", Command::Step(1)),
            ("newest", Command::Newest),
            ("slower", Command::Speed(-1)),
            ("faster", Command::Speed(1)),
        ];
        for (words, command) in buttons {
            if ui.button(RichText::new(words).size(SMALL)).clicked() {
                asked = Some(command);
            }
        }
        if board.editable && state.note.is_none() && ui.button(RichText::new("note T").size(SMALL)).clicked() {
            asked = Some(Command::Note);
        }
        ui.label(RichText::new(format!("speed {}", state.player.speed().word())).size(SMALL).color(TEXT));
        if let Some(mut field) = state.note.take() {
            match field.show(ui) {
                Written::Open => state.note = Some(field),
                Written::Done(note) => note.into_iter().for_each(|(number, words)| state.editing.ask_note(number, words)),
            }
            return;
        }
        let words = match state.shown_index(board) {
            Some(at) => {
                let (pair, count) = (&board.pairs[at], board.pairs.len());
                let follows = if state.selected.is_none() { ", following" } else { "" };
                format!("frame {}, {} of {count}, {}{follows}", pair.number(), at + 1, utc(pair.time_us))
            }
            None => "no exposure yet".to_owned(),
        };
        ui.label(RichText::new(words).size(SMALL).color(DIM));
        // The newest first.
        for (number, phase) in board.phases.iter().rev().take(MOST_TOLD) {
            ui.label(RichText::new(format!("frame {number} {}", phase.words())).size(SMALL).color(TEXT));
        }
        if is_beam_on(board) {
            ui.label(RichText::new("X-RAY ON").size(SMALL).color(CAUTION));
        }
        if let Some(note) = state.shown(board).and_then(|pair| board.notes.get(&pair.number())) {
            ui.add(Label::new(RichText::new(format!("note: {note}")).size(SMALL).color(TEXT)).truncate())
                .on_hover_text(note.as_str());
        }
    });
    if let Some(command) = asked {
        run(command, ui.input(|input| input.time), board, state);
    }
    tiles(ui, board, state);
}

/// Whether the C-arm says so, now.
fn is_beam_on(board: &BoardState) -> bool {
    let says_so = |sample: &Sample| matches!(sample, Sample::Carm(carm) if carm.xray_on);
    !board.finished && board.links.iter().any(|link| !link.is_stale(board.now_us) && link.latest.as_ref().is_some_and(says_so))
}

/// What is still to come of a pair that is shown.
fn phase_of(board: &BoardState, pair: &PairView) -> Option<&'static str> {
    match board.phases.get(&pair.number()) {
        Some(phase) => Some(phase.short()),
        None => (!pair.complete).then_some("…"),
    }
}

fn tiles(ui: &mut Ui, board: &BoardState, state: &mut ViewState) {
    let (strip, response) = ui.allocate_exact_size(vec2(ui.available_width(), HEIGHT + TIMES), Sense::click_and_drag());
    let (row, times) = strip.split_top_bottom_at_y(strip.top() + HEIGHT);
    let painter = ui.painter_at(strip);
    painter.rect_filled(row, 2.0, WELL);
    let is_shown = |number: u32| board.pairs.iter().any(|pair| pair.number() == number);
    let coming: Vec<(u32, Phase)> =
        board.phases.iter().map(|(number, phase)| (*number, *phase)).filter(|(number, _)| !is_shown(*number)).collect();
    let unshown = board.frames_waiting.max(coming.len());
    // Whatever is in work came lately.
    let of_pairs = board.pairs.iter().map(|pair| pair.time_us);
    let axis = TimeAxis::of(of_pairs.chain((0..unshown).map(|_| board.now_us)), !board.finished, row.width());
    let shown = state.shown_index(board);
    let said =
        shown.map(|at| format!("exposure {} of {}", at + 1, board.pairs.len())).unwrap_or_else(|| "no exposures".to_owned());
    response.widget_info(|| WidgetInfo::labeled(Role::Slider, true, &said));
    let last = board.pairs.len().saturating_sub(1);
    let pair_at = |x: f32| axis.at(x - row.left()).filter(|_| !board.pairs.is_empty());
    if let Some(at) = response.interact_pointer_pos().filter(|_| response.dragged() || response.clicked())
        && let Some(n) = pair_at(at.x)
    {
        state.player.stop();
        state.select(board, n.min(last));
    }
    let tile = |n: usize| {
        let [left, right] = axis.tile(n);
        let gap = if right - left > 6.0 { 1.0 } else { 0.0 };
        Rect::from_min_max(pos2(row.left() + left + gap, row.top() + 2.0), pos2(row.left() + right - gap, row.bottom() - 2.0))
    };
    for (n, pair) in board.pairs.iter().enumerate() {
        of_pair(&painter, tile(n), board, pair);
    }
    for n in 0..unshown {
        to_come(&painter, tile(board.pairs.len() + n), coming.get(n));
    }
    numbers(&painter, row, board, shown, &tile);
    time_scale(&painter, times, &axis);
    if let Some(n) = response.hover_pos().filter(|at| row.contains(*at)).and_then(|at| pair_at(at.x))
        && let Some(pair) = board.pairs.get(n)
    {
        let words = hint(board, pair);
        response.on_hover_ui_at_pointer(|ui| {
            ui.label(egui::RichText::new(words).size(SMALL));
        });
    }
}

/// What the pointer is told of an exposure.
fn hint(board: &BoardState, pair: &PairView) -> String {
    let number = pair.number();
    let phase = board.phases.get(&number).map(|phase| format!("\n{}", phase.words())).unwrap_or_default();
    let note = board.notes.get(&number).map(|note| format!("\nnote: {note}")).unwrap_or_default();
    let standing = pair.pair.standing().word();
    let whole = pair.pair.reason.as_deref().unwrap_or_default();
    let mut status = pair.pair.status_line();
    if !whole.is_empty() {
        status = status.replace(whole, told::reason(pair));
    }
    format!("frame {number} ({}), {}\n{standing}\n{status}{phase}{note}", pair.pair.frame, utc(pair.time_us))
}

fn of_pair(painter: &Painter, tile: Rect, board: &BoardState, pair: &PairView) {
    exposure(painter, tile, pair.pair.standing());
    if let Some(phase) = phase_of(board, pair).filter(|_| tile.width() >= PHASED) {
        painter.text(pos2(tile.left() + 2.0, tile.top()), Align2::LEFT_TOP, phase, font(TINY), TEXT);
    }
    if board.notes.contains_key(&pair.number()) {
        let at = pos2(tile.right() - 5.0, tile.top() + 5.0);
        painter.circle(at, 3.5, Color32::WHITE, Stroke::new(1.0, INK));
    }
}

/// A frame that cannot be shown yet.
fn to_come(painter: &Painter, tile: Rect, known: Option<&(u32, Phase)>) {
    painter.rect_stroke(tile.shrink(0.5), 2.0, Stroke::new(1.0, LINE), StrokeKind::Inside);
    match known.filter(|_| tile.width() >= PHASED) {
        Some((number, phase)) => {
            let bottom = pos2(tile.center().x, tile.bottom() - 1.0);
            painter.text(pos2(tile.center().x, tile.top()), Align2::CENTER_TOP, phase.short(), font(TINY), TEXT);
            painter.text(bottom, Align2::CENTER_BOTTOM, number, font(SMALL), DIM);
        }
        None => _ = painter.text(tile.center(), Align2::CENTER_CENTER, "…", font(SMALL), DIM),
    }
}

/// The numbers of the exposures, as many as do not touch; that of the one shown is always there, over all else.
fn numbers(painter: &Painter, row: Rect, board: &BoardState, shown: Option<usize>, tile: &dyn Fn(usize) -> Rect) {
    let place = |n: usize| {
        let galley = painter.layout_no_wrap(board.pairs[n].number().to_string(), font(SMALL), INK);
        let size = galley.size();
        let middle = tile(n).center().x;
        // The first and the last stay within the strip.
        let left = (middle - 0.5 * size.x).clamp(row.left(), (row.right() - size.x).max(row.left()));
        (Rect::from_min_size(pos2(left, tile(n).bottom() - 1.0 - size.y), size), galley)
    };
    let of_shown = shown.map(|n| (n, place(n)));
    let mut free_from = f32::MIN;
    for n in (0..board.pairs.len()).filter(|n| shown != Some(*n)) {
        let (rect, galley) = place(n);
        let is_free = rect.left() >= free_from
            && of_shown.as_ref().is_none_or(|(_, (other, _))| !other.expand2(vec2(5.0, 0.0)).intersects(rect));
        if is_free {
            free_from = rect.right() + 3.0;
            painter.galley(rect.min, galley, INK);
        }
    }
    if let Some((n, (rect, galley))) = of_shown {
        painter.rect_stroke(tile(n).expand(1.5), 3.0, Stroke::new(2.5, Color32::WHITE), StrokeKind::Middle);
        painter.rect_filled(rect.expand2(vec2(3.0, 0.0)), 3.0, Color32::WHITE);
        painter.galley(rect.min, galley, INK);
    }
}

/// Round times below the tiles.
fn time_scale(painter: &Painter, times: Rect, axis: &TimeAxis) {
    painter.hline(times.x_range(), times.top() + 0.5, Stroke::new(1.0, LINE));
    for tick in axis.ticks() {
        let x = times.left() + tick.x;
        let length = if tick.label.is_empty() { 3.0 } else { 5.0 };
        painter.line_segment([pos2(x, times.top()), pos2(x, times.top() + length)], Stroke::new(1.0, DIM));
        painter.text(pos2(x + 3.0, times.top() + 2.0), Align2::LEFT_TOP, tick.label, font(TINY), DIM);
    }
}

/// A tile whose height tells its state too, for those who do not tell its colours.
fn exposure(painter: &Painter, tile: Rect, standing: Standing) {
    let share = match standing {
        Standing::Accepted => 1.0,
        Standing::Refused | Standing::NoPose => 0.45,
        _ => 0.72,
    };
    let filled = Rect::from_min_max(pos2(tile.left(), tile.bottom() - share * tile.height()), tile.max);
    painter.rect_filled(filled, 2.0, of_standing(standing));
}
