//! What the window shows for a given state.

use eframe::egui::{self, Color32, ColorImage, RichText, TextureHandle, TextureOptions, Ui, Vec2};

use super::{Textures, ViewState};
use crate::image::Image;
use crate::session::board::{BoardState, Link, PairView};

const ACCEPTED: Color32 = Color32::from_rgb(90, 190, 120);
const REFUSED: Color32 = Color32::from_rgb(225, 110, 90);
const STALE: Color32 = Color32::from_rgb(230, 180, 60);

/// Draws everything into `ui`.
pub fn draw(ui: &mut Ui, board: &BoardState, state: &mut ViewState) {
    egui::Panel::top("links").show(ui, |ui| links(ui, board));
    egui::Panel::bottom("controls").show(ui, |ui| controls(ui, board, state));
    egui::Panel::right("scores").default_size(230.0).show(ui, |ui| scores(ui, shown(board, state)));
    egui::CentralPanel::default().show(ui, |ui| pictures(ui, board, state));
}

fn shown<'a>(board: &'a BoardState, state: &ViewState) -> Option<&'a PairView> {
    match state.selected {
        Some(index) => board.pairs.get(index).map(AsRef::as_ref),
        None => board.pairs.last().map(AsRef::as_ref),
    }
}

fn links(ui: &mut Ui, board: &BoardState) {
    ui.horizontal_wrapped(|ui| {
        if board.links.is_empty() {
            ui.weak("No serial lines in this session");
        }
        for link in &board.links {
            link_state(ui, link, board.now_us);
            ui.separator();
        }
        ui.label(format!("{} frames, {} pairs", board.frames_seen, board.pairs.len()));
        for (kind, count) in &board.warnings {
            ui.colored_label(STALE, format!("{kind}: {count}"));
        }
        if board.finished {
            ui.strong("Session ended");
        }
    });
}

fn link_state(ui: &mut Ui, link: &Link, now_us: i64) {
    let age = link.last_byte_us.map(|last_us| (now_us - last_us) as f64 * 1e-6);
    let (colour, words) = match (link.open, link.is_stale(now_us), age) {
        (false, _, _) => (REFUSED, "unplugged".to_owned()),
        (true, true, Some(age_s)) => (STALE, format!("STALE {age_s:.1} s")),
        (true, true, None) => (STALE, "silent".to_owned()),
        (true, false, _) => (ACCEPTED, "live".to_owned()),
    };
    ui.colored_label(colour, RichText::new(format!("{:?} {words}", link.device)).strong());
    let health = &link.health;
    ui.weak(format!(
        "{} ok, {} lost, {} corrupt, {} duplicate, {} reordered",
        health.frames, health.lost, health.corrupt, health.duplicate, health.reordered
    ));
    if let Some(trouble) = &link.trouble {
        ui.colored_label(REFUSED, trouble);
    }
}

fn controls(ui: &mut Ui, board: &BoardState, state: &mut ViewState) {
    ui.horizontal(|ui| {
        let latest = board.pairs.len().saturating_sub(1);
        let mut index = state.selected.unwrap_or(latest).min(latest);
        let slider = egui::Slider::new(&mut index, 0..=latest).text("frame");
        if ui.add_enabled(!board.pairs.is_empty(), slider).changed() {
            state.selected = Some(index);
        }
        if ui.button("Latest").clicked() {
            state.selected = None;
        }
        ui.checkbox(&mut state.blink, "Blink");
        if ui.button("Fit").clicked() {
            state.zoom = 0.0;
            state.pan = Vec2::ZERO;
        }
        ui.weak("scroll to zoom, drag to move: all panes together");
    });
}

fn scores(ui: &mut Ui, pair: Option<&PairView>) {
    ui.heading("Comparison");
    let Some(pair) = pair else {
        ui.weak("No frame yet");
        return;
    };
    ui.label(format!("{}  {}", pair.number, pair.name));
    let [red, green, blue] = pair.standing.colour();
    let colour = Color32::from_rgb(red, green, blue);
    ui.colored_label(colour, RichText::new(pair.standing.word()).strong());
    ui.colored_label(colour, &pair.status);
    egui::Grid::new("scores").striped(true).show(ui, |ui| {
        for (name, value) in &pair.scores {
            ui.label(name);
            match value {
                Some(value) => ui.monospace(format!("{value:.4}")),
                None => ui.weak("not known"),
            };
            ui.end_row();
        }
    });
}

fn pictures(ui: &mut Ui, board: &BoardState, state: &mut ViewState) {
    let Some(pair) = shown(board, state) else {
        ui.centered_and_justified(|ui| ui.weak("No matched frame yet"));
        return;
    };
    if state.textures.as_ref().is_none_or(|textures| textures.pair != key(pair)) {
        state.textures = Some(upload(ui, pair));
    }
    let Some(textures) = state.textures.take() else { return };
    let panes: Vec<(&str, Option<&TextureHandle>)> = if state.blink {
        let phase = (ui.input(|input| input.time) * 2.0) as u64 % 2;
        ui.ctx().request_repaint_after(std::time::Duration::from_millis(100));
        vec![if phase == 0 { ("Acquired", Some(&textures.acquired)) } else { ("DRR", textures.drr.as_ref()) }]
    } else {
        vec![
            ("Acquired", Some(&textures.acquired)),
            ("DRR", textures.drr.as_ref()),
            ("Acquired - DRR", textures.difference.as_ref()),
        ]
    };
    let width = ui.available_width() / panes.len() as f32 - 8.0;
    ui.horizontal_top(|ui| {
        for (title, texture) in panes {
            ui.vertical(|ui| {
                ui.set_width(width);
                ui.strong(title);
                match texture {
                    Some(texture) => picture(ui, texture, width, state),
                    None => {
                        ui.weak("no pose: nothing to render");
                    }
                }
            });
        }
    });
    state.textures = Some(textures);
}

fn picture(ui: &mut Ui, texture: &TextureHandle, width: f32, state: &mut ViewState) {
    let size = texture.size_vec2();
    let pane = Vec2::new(width, width * size.y / size.x.max(1.0));
    let (area, response) = ui.allocate_exact_size(pane, egui::Sense::drag());
    if response.hovered() {
        let scroll = ui.input(|input| input.smooth_scroll_delta.y);
        if scroll != 0.0 {
            state.zoom = (state.zoom.max(1.0) * (scroll * 0.002).exp()).clamp(1.0, 32.0);
        }
    }
    state.pan += response.drag_delta();
    let zoom = state.zoom.max(1.0);
    let drawn = egui::Rect::from_center_size(area.center() + state.pan, pane * zoom);
    let whole = egui::Rect::from_min_max(egui::pos2(0.0, 0.0), egui::pos2(1.0, 1.0));
    ui.painter_at(area).image(texture.id(), drawn, whole, Color32::WHITE);
}

/// What a picture is known by: it becomes smaller when its pair is old.
fn key(pair: &PairView) -> (u32, usize) {
    (pair.number, pair.acquired.width)
}

fn upload(ui: &Ui, pair: &PairView) -> Textures {
    let gray = |name: &str, image: &Image<u8>| {
        let picture = ColorImage::from_gray([image.width, image.height], &image.pixels);
        ui.ctx().load_texture(format!("{name} {}", pair.number), picture, TextureOptions::LINEAR)
    };
    let colour = |image: &Image<[u8; 3]>| {
        let bytes: Vec<u8> = image.pixels.iter().flatten().copied().collect();
        let picture = ColorImage::from_rgb([image.width, image.height], &bytes);
        ui.ctx().load_texture(format!("difference {}", pair.number), picture, TextureOptions::LINEAR)
    };
    Textures {
        pair: key(pair),
        acquired: gray("acquired", &pair.acquired),
        drr: pair.drr.as_ref().map(|image| gray("drr", image)),
        difference: pair.difference.as_ref().map(colour),
    }
}
