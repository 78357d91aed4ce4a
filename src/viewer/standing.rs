//! The state of the exposure shown, readable across the room: accepted, refused, or doubted, with the reason and what to do.

use eframe::egui::{self, Color32, RichText, Ui};

use super::theme::{BAD, BODY, CAUTION, DIM, INK, LINE, SMALL, TEXT, font, of_standing};
use super::told::{count, reason};
use crate::session::board::{BoardState, PairView};
use crate::session::edit::again;
use crate::time::utc;

/// Letters of the state where there is room; less where a word is long.
const LARGEST: f32 = 50.0;
const SMALLEST: f32 = 24.0;
/// Longest reason that is shown whole; the rest is under the cursor.
const REASON_CHARS: usize = 260;

/// Draws it; `pair` is the one shown.
pub(super) fn show(ui: &mut Ui, board: &BoardState, pair: Option<&PairView>) {
    match pair {
        Some(pair) => of_pair(ui, board, pair),
        None => {
            let small = match board.frames_waiting {
                // At the pace of the session the first exposure may be minutes away.
                0 if board.replayed && board.now_us > 0 => format!("no exposure yet · replayed up to {}", utc(board.now_us)),
                0 => "no exposure yet".to_owned(),
                1 => "the first frame is being developed".to_owned(),
                waiting => format!("{waiting} frames are being developed"),
            };
            block(ui, LINE, &small, "WAITING", TEXT);
        }
    }
}

fn of_pair(ui: &mut Ui, board: &BoardState, pair: &PairView) {
    let standing = pair.pair.standing();
    // "ACCEPTED, IMAGE DISAGREES": what doubts it is what must be read across the room.
    let word = standing.word();
    let (before, large) = word.rsplit_once(", ").unwrap_or(("", word));
    let again = again(pair.pair.edited.is_some(), pair.development);
    let before = if before.is_empty() { String::new() } else { format!(" · {} but", before.to_lowercase()) };
    block(ui, of_standing(standing), &format!("frame {} · {}{again}{before}", pair.number(), pair.pair.frame), large, INK);
    if let Some(words) = newer(board, pair) {
        ui.label(RichText::new(words).size(BODY).color(CAUTION));
    }
    if let Some(edited) = &pair.pair.edited {
        ui.label(RichText::new(edited.to_string()).size(BODY).color(CAUTION));
    }
    let words = reason(pair);
    if !words.is_empty() {
        let colour = if pair.pair.is_from_beads() { CAUTION } else { of_standing(standing) };
        let shown: String = words.chars().take(REASON_CHARS).collect();
        let more = if shown.len() < words.len() { " …" } else { "" };
        // As scripts and the report have it, and how else the same is told.
        let whole: Vec<&str> = pair.pair.reason.as_deref().into_iter().chain(pair.said_otherwise()).collect();
        ui.label(RichText::new(format!("{shown}{more}")).size(BODY).color(colour)).on_hover_text(whole.join("\n"));
    }
    if let Some(remedy) = &pair.remedy {
        ui.label(RichText::new(format!("What to do: {remedy}")).size(BODY).color(TEXT));
    }
}

/// That a newer frame is not shown.
fn newer(board: &BoardState, pair: &PairView) -> Option<String> {
    let newer = board.pairs.iter().filter(|other| other.number() > pair.number()).count();
    match (newer, board.frames_waiting) {
        (0, 0) => None,
        (0, 1) => Some("1 newer frame is being developed".to_owned()),
        (0, waiting) => Some(format!("{waiting} newer frames are being developed")),
        (newer, _) => Some(format!("an earlier exposure: {newer} newer")),
    }
}

fn block(ui: &mut Ui, ground: Color32, small: &str, large: &str, ink: Color32) {
    egui::Frame::new().fill(ground).corner_radius(4.0).inner_margin(egui::Margin::symmetric(10, 6)).show(ui, |ui| {
        ui.set_width(ui.available_width());
        ui.label(RichText::new(small).size(SMALL).color(ink));
        ui.spacing_mut().item_spacing.y = 0.0;
        let size = fitting(ui, large);
        ui.label(RichText::new(large).size(size).color(ink));
    });
}

/// The largest letters at which each word of `words` fits into a line.
fn fitting(ui: &Ui, words: &str) -> f32 {
    let width = |word: &str| ui.painter().layout_no_wrap(word.to_owned(), font(LARGEST), INK).size().x;
    let widest = words.split(' ').map(width).fold(1.0, f32::max);
    (LARGEST * ui.available_width() / widest).clamp(SMALLEST, LARGEST)
}

/// What must not be missed: that nothing is recorded any more, over the whole width.
pub(super) fn alarm(ui: &mut Ui, board: &BoardState) {
    let Some(failure) = &board.recorder_failure else { return };
    egui::Panel::top("alarm").frame(egui::Frame::new().fill(BAD).inner_margin(10)).show(ui, |ui| {
        ui.label(RichText::new("NOT RECORDING").size(40.0).color(INK));
        ui.label(RichText::new(failure).size(18.0).color(INK));
    });
}

/// Backlog and latency, always there.
pub(super) fn backlog(ui: &mut Ui, board: &BoardState, pair: Option<&PairView>) {
    ui.horizontal_wrapped(|ui| {
        let waiting = board.frames_waiting + board.frames_unread;
        let colour = if waiting > 1 { CAUTION } else { DIM };
        ui.label(RichText::new(format!("backlog {waiting}")).size(SMALL).color(colour));
        let late = pair.and_then(|pair| pair.latency_ms);
        let words = match (late, pair) {
            (Some(ms), _) => format!("latency {:.1} s", ms * 1e-3),
            (None, Some(pair)) => {
                format!("developed in {:.1} s", pair.pair.stages_ms.iter().map(|(_, ms)| ms).sum::<f64>() * 1e-3)
            }
            (None, None) => "latency unknown".to_owned(),
        };
        let hover =
            pair.map(|pair| pair.pair.stages_ms.iter().map(|(stage, ms)| format!("{stage} {ms:.0} ms")).collect::<Vec<_>>());
        let colour = if late.is_some_and(|ms| ms > 2_000.0) { CAUTION } else { DIM };
        ui.label(RichText::new(words).size(SMALL).color(colour)).on_hover_text(hover.unwrap_or_default().join("\n"));
        let frames = format!("{}, {} shown", count(board.frames_seen, "frame"), board.pairs.len());
        ui.label(RichText::new(frames).size(SMALL).color(DIM));
        if !board.replayed {
            let behind_ms = board.recorder_behind_ms;
            let colour = if behind_ms > 1_000.0 { CAUTION } else { DIM };
            ui.label(RichText::new(format!("log {behind_ms:.0} ms behind")).size(SMALL).color(colour));
        }
        for words in &board.slow {
            ui.label(RichText::new(words).size(SMALL).color(CAUTION));
        }
        for (kind, count) in &board.warnings {
            ui.label(RichText::new(format!("{kind}: {count}")).size(SMALL).color(CAUTION));
        }
        match (board.finished, board.replayed) {
            (true, false) => ui.label(RichText::new("Session ended").size(SMALL).color(TEXT)),
            (true, true) => ui.label(RichText::new("Replay ended").size(SMALL).color(TEXT)),
            (false, true) => ui.label(RichText::new("Replay").size(SMALL).color(TEXT)),
            (false, false) => ui.label(RichText::new("Live").size(SMALL).color(TEXT)),
        };
    });
}
