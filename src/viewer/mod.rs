//! The window: acquired, DRR and difference side by side, link states, stale marks. Panes draw; they decide nothing.

mod panes;
mod window;

pub use panes::draw;
pub use window::{ViewerError, run};

/// What the window remembers between frames: which pair is shown and how.
#[derive(Default)]
pub struct ViewState {
    /// Index of the pair shown; `None` follows the latest.
    pub selected: Option<usize>,
    /// Show acquired and DRR alternating in one place.
    pub blink: bool,
    /// Zoom factor, common to all panes; 0 means fit.
    pub zoom: f32,
    /// Common offset of the panes in screen points.
    pub pan: eframe::egui::Vec2,
    textures: Option<Textures>,
}

/// Uploaded pictures of one pair.
struct Textures {
    pair: (u32, usize),
    acquired: eframe::egui::TextureHandle,
    drr: Option<eframe::egui::TextureHandle>,
    difference: Option<eframe::egui::TextureHandle>,
}
