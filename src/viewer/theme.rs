//! Colours and sizes of the window: those of strips and report.

use eframe::egui::{self, Color32, FontId, RichText, Ui};

use crate::report::{Rgb, Standing, colour};

/// A colour of the report.
#[must_use]
pub(super) const fn rgb([red, green, blue]: Rgb) -> Color32 {
    Color32::from_rgb(red, green, blue)
}

pub(super) const BACKGROUND: Color32 = rgb(colour::BACKGROUND);
pub(super) const WELL: Color32 = rgb(colour::WELL);
pub(super) const LINE: Color32 = rgb(colour::LINE);
pub(super) const TEXT: Color32 = rgb(colour::TEXT);
pub(super) const DIM: Color32 = rgb(colour::DIM);
pub(super) const GOOD: Color32 = rgb(colour::GOOD);
pub(super) const CAUTION: Color32 = rgb(colour::CAUTION);
pub(super) const BAD: Color32 = rgb(colour::BAD);
pub(super) const EDGE: Color32 = rgb(colour::EDGE);
/// What is too old to be relied on.
pub(super) const STALE: Color32 = Color32::from_rgb(0x78, 0x80, 0x88);
/// Words on a coloured ground.
pub(super) const INK: Color32 = rgb(colour::BACKGROUND);
/// What is chosen.
pub(super) const CHOSEN: Color32 = Color32::from_rgb(0x2f, 0x4a, 0x63);

/// Words that are read in passing.
pub(super) const SMALL: f32 = 12.0;
/// Words that are read.
pub(super) const BODY: f32 = 13.5;

/// Of a standing, on dark ground.
pub(super) fn of_standing(standing: Standing) -> Color32 {
    rgb(standing.colour())
}

/// Letters of `size` points.
pub(super) fn font(size: f32) -> FontId {
    FontId::proportional(size)
}

/// Lesser words.
pub(super) fn dim(words: impl Into<String>) -> RichText {
    RichText::new(words).size(SMALL).color(DIM)
}

/// The title of a part of the left column.
pub(super) fn title(ui: &mut Ui, words: &str) {
    ui.add_space(4.0);
    ui.separator();
    ui.label(RichText::new(words).size(SMALL).color(DIM).strong());
}

/// Dark ground, quiet frames.
pub(super) fn dress(ui: &mut Ui) {
    let style = ui.style_mut();
    style.spacing.item_spacing = egui::vec2(6.0, 3.0);
    style.spacing.button_padding = egui::vec2(6.0, 2.0);
    style.spacing.interact_size.y = 15.0;
    style.text_styles.insert(egui::TextStyle::Body, font(BODY));
    style.text_styles.insert(egui::TextStyle::Button, font(SMALL));
    style.text_styles.insert(egui::TextStyle::Small, font(SMALL));
    let visuals = &mut style.visuals;
    *visuals = egui::Visuals::dark();
    visuals.panel_fill = BACKGROUND;
    visuals.window_fill = WELL;
    visuals.extreme_bg_color = WELL;
    visuals.override_text_color = Some(TEXT);
    visuals.selection.bg_fill = CHOSEN;
    visuals.selection.stroke.color = TEXT;
    visuals.widgets.noninteractive.bg_stroke.color = LINE;
    visuals.widgets.noninteractive.fg_stroke.color = TEXT;
}
