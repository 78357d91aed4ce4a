//! The scores, each within what it is at poses known to be wrong.

use eframe::egui::{Align2, Color32, Rect, RichText, Role, Sense, Stroke, Ui, WidgetInfo, pos2, vec2};

use super::theme::{CAUTION, DIM, GOOD, LINE, SMALL, TEXT, WELL, dim, font, title};
use super::told::fixed;
use crate::compare::{NULL_SCORES, NullScore};
use crate::report::Pair;
use crate::session::board::PairView;

/// Scores that are shown, as people call them; `null` is the name under which wrong poses are scored.
const SHOWN: [Shown; 6] = [
    Shown { name: "zncc", null: "zncc", words: "ZNCC" },
    Shown { name: "gradient_ncc", null: "gradient_ncc", words: "gradient" },
    Shown { name: "local_ncc", null: "local_ncc", words: "local" },
    Shown { name: "ssim", null: "ssim", words: "SSIM" },
    Shown { name: "edge_distance_mm", null: "edge_distance_px", words: "edges" },
    Shown { name: "rmse_nepers", null: "rmse_nepers", words: "RMSE" },
];

struct Shown {
    name: &'static str,
    null: &'static str,
    words: &'static str,
}

/// Draws them.
pub(super) fn show(ui: &mut Ui, pair: Option<&PairView>) {
    let Some(view) = pair else { return };
    title(ui, "AGREEMENT, WITHIN THAT OF WRONG POSES");
    let pair = &view.pair;
    for shown in &SHOWN {
        score(ui, pair, shown);
    }
    if pair.null.is_empty() {
        let words = match (view.complete, view.pictures.simulated().is_some()) {
            (_, false) => "nothing was compared",
            (false, true) => "wrong poses are being scored",
            (true, true) => "wrong poses were not scored",
        };
        ui.label(dim(words));
    } else {
        ui.label(dim("grey: wrong poses · mark: this pose · right is better"));
    }
    if let Some(masks) = &pair.masks {
        let causes: Vec<String> =
            masks.causes.iter().map(|(cause, share)| format!("{} {:.0} %", cause.words(), 100.0 * share)).collect();
        ui.label(dim(format!("{:.0} % masked", 100.0 * masks.masked))).on_hover_text(causes.join("\n"));
    }
}

fn score(ui: &mut Ui, pair: &Pair, shown: &Shown) {
    let value = pair.scores.get(shown.name);
    let null = pair.null.get(shown.null);
    let unit = match shown.name.rsplit_once('_') {
        Some((_, "mm")) => " mm",
        Some((_, "nepers")) => " Np",
        _ => "",
    };
    let words = value.map_or_else(|| "not known".to_owned(), |value| format!("{}{unit}", fixed(value, 2)));
    let discriminates = null.is_none_or(|null| null.discriminating);
    let response = ui
        .horizontal(|ui| {
            let (name, _) = ui.allocate_exact_size(vec2(58.0, 15.0), Sense::hover());
            ui.painter().text(name.left_center(), Align2::LEFT_CENTER, shown.words, font(SMALL), DIM);
            let (bar, response) = ui.allocate_exact_size(vec2(ui.available_width() - 66.0, 14.0), Sense::hover());
            let larger_is_better = NULL_SCORES.iter().find(|(name, _)| *name == shown.null).is_none_or(|(_, larger)| *larger);
            let told = match null {
                Some(null) => band(ui, bar, null, larger_is_better),
                None => {
                    ui.painter().rect_filled(bar.shrink2(vec2(0.0, 4.0)), 2.0, WELL);
                    String::new()
                }
            };
            response.widget_info(|| WidgetInfo::labeled(Role::ProgressIndicator, true, format!("{} {words}{told}", shown.words)));
            let colour = if value.is_none() {
                DIM
            } else if discriminates {
                TEXT
            } else {
                CAUTION
            };
            ui.label(RichText::new(&words).size(SMALL).color(colour));
            response
        })
        .inner;
    let reason = pair.scores.reasons.get(shown.name).cloned();
    let of_null = null.map(|null| {
        let best =
            null.best_shifted.map(|value| format!("{value:.3} at {}", null.best_shift.as_deref().unwrap_or("another pose")));
        let tells = if null.discriminating {
            "tells this pose from wrong ones"
        } else {
            "not discriminating: a wrong pose scores as well"
        };
        format!("rank {} of {}; best wrong pose {}; {tells}", null.rank, null.of, best.unwrap_or_else(|| "not known".to_owned()))
    });
    if let Some(words) = reason.or(of_null) {
        response.on_hover_text(words);
    }
}

/// Wrong poses as a band with a line each, the stated pose as a mark; the better side is on the right. Gives it in words.
fn band(ui: &Ui, bar: Rect, null: &NullScore, larger_is_better: bool) -> String {
    let wrong: Vec<f64> = null.shifts.iter().filter(|shift| !shift.same_picture).filter_map(|shift| shift.value).collect();
    let all = || wrong.iter().copied().chain(null.at_pose).chain(null.best_shifted).filter(|value| value.is_finite());
    let (low, high) = all().fold((f64::MAX, f64::MIN), |(low, high), value| (low.min(value), high.max(value)));
    let painter = ui.painter();
    painter.rect_filled(bar.shrink2(vec2(0.0, 1.0)), 2.0, WELL);
    if !(high > low) {
        return String::new();
    }
    let inner = bar.shrink2(vec2(5.0, 2.0));
    let x = |value: f64| {
        let share = ((value - low) / (high - low)) as f32;
        inner.left() + inner.width() * if larger_is_better { share } else { 1.0 - share }
    };
    let ends = wrong.iter().map(|value| x(*value)).fold((f32::MAX, f32::MIN), |(low, high), at| (low.min(at), high.max(at)));
    if ends.1 >= ends.0 {
        let band = Rect::from_min_max(pos2(ends.0 - 1.0, inner.top()), pos2(ends.1 + 1.0, inner.bottom()));
        painter.rect_filled(band, 2.0, LINE);
    }
    for value in &wrong {
        let at = x(*value);
        painter.line_segment([pos2(at, inner.top()), pos2(at, inner.bottom())], Stroke::new(1.0, Color32::from_white_alpha(40)));
    }
    let Some(stated) = null.at_pose else { return String::new() };
    let colour = if null.discriminating { GOOD } else { CAUTION };
    let at = x(stated);
    painter.line_segment([pos2(at, bar.top()), pos2(at, bar.bottom())], Stroke::new(3.0, colour));
    if null.discriminating { ", better than all wrong poses".to_owned() } else { ", not discriminating".to_owned() }
}
