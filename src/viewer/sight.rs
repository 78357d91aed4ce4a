//! Which part of the frame all panes show, and where on the screen a pixel of it lies.

use eframe::egui::{Pos2, Rect, Vec2, pos2, vec2};

/// Largest magnification against the whole frame in its pane.
const MOST_ZOOM: f32 = 64.0;

/// Common to all panes, and to frames of all sizes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sight {
    /// Against the whole frame in its pane, 1 or more.
    pub zoom: f32,
    /// What lies in the middle of each pane, in shares of the frame.
    pub centre: [f32; 2],
}

impl Default for Sight {
    fn default() -> Self {
        Self { zoom: 1.0, centre: [0.5; 2] }
    }
}

/// A frame in a pane.
#[derive(Clone, Copy, Debug)]
pub(super) struct Placed {
    pub(super) pane: Rect,
    size_px: Vec2,
    /// Points of the screen per pixel of the frame.
    pub(super) scale: f32,
    origin: Pos2,
}

impl Sight {
    /// A frame of `size_px` as it lies in `pane`.
    pub(super) fn place(&self, pane: Rect, size_px: [usize; 2]) -> Placed {
        let size_px = vec2(size_px[0].max(1) as f32, size_px[1].max(1) as f32);
        let fit = (pane.width() / size_px.x).min(pane.height() / size_px.y).max(1e-6);
        let scale = fit * self.zoom;
        let middle = vec2(self.centre[0] * size_px.x, self.centre[1] * size_px.y);
        Placed { pane, size_px, scale, origin: pane.center() - scale * middle }
    }

    /// Magnifies by `factor` about what lies at `about` on the screen.
    pub(super) fn zoom_about(&mut self, placed: &Placed, about: Pos2, factor: f32) {
        let zoom = (self.zoom * factor).clamp(1.0, MOST_ZOOM);
        // What lies under the cursor stays there: its distance from the middle of the pane shrinks in the frame as the scale grows.
        let off = (about - placed.pane.center()) / placed.scale * (1.0 - self.zoom / zoom);
        self.zoom = zoom;
        self.shift(placed, off);
    }

    /// Moves the frame by `by` points of the screen.
    pub(super) fn drag(&mut self, placed: &Placed, by: Vec2) {
        self.shift(placed, -by / placed.scale);
    }

    /// Moves the middle by `off` pixels of the frame; the frame stays in sight.
    fn shift(&mut self, placed: &Placed, off: Vec2) {
        let half = 0.5 / self.zoom;
        let moved = |at: f32, by: f32| (at + by).clamp(half.min(0.5), (1.0 - half).max(0.5));
        self.centre = [moved(self.centre[0], off.x / placed.size_px.x), moved(self.centre[1], off.y / placed.size_px.y)];
    }

    /// Moves by shares of what is seen, as keys do.
    pub(super) fn step(&mut self, by: [f32; 2]) {
        let half = 0.5 / self.zoom;
        for (at, by) in self.centre.iter_mut().zip(by) {
            *at = (*at + by / self.zoom).clamp(half.min(0.5), (1.0 - half).max(0.5));
        }
    }
}

impl Placed {
    /// Where the pixel at (u, v) lies; the centre of the first one is (0, 0).
    pub(super) fn screen(&self, [u, v]: [f64; 2]) -> Pos2 {
        self.origin + self.scale * vec2(u as f32 + 0.5, v as f32 + 0.5)
    }

    /// What lies at `at`.
    pub(super) fn image(&self, at: Pos2) -> [f64; 2] {
        let from = (at - self.origin) / self.scale;
        [f64::from(from.x) - 0.5, f64::from(from.y) - 0.5]
    }

    /// The whole frame.
    pub(super) fn frame(&self) -> Rect {
        Rect::from_min_size(self.origin, self.scale * self.size_px)
    }

    /// As much of the frame as the pane shows.
    pub(super) fn seen(&self) -> Rect {
        self.frame().intersect(self.pane)
    }

    /// The part of the frame between shares of its sides, and the same of a texture.
    pub(super) fn part(&self, from: [f32; 2], to: [f32; 2]) -> (Rect, Rect) {
        let at = |share: [f32; 2]| self.origin + self.scale * vec2(share[0] * self.size_px.x, share[1] * self.size_px.y);
        (Rect::from_min_max(at(from), at(to)), Rect::from_min_max(pos2(from[0], from[1]), pos2(to[0], to[1])))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_lies_under_the_cursor_stays_there_and_the_frame_stays_in_sight() {
        let pane = Rect::from_min_size(pos2(100.0, 50.0), vec2(500.0, 400.0));
        let mut sight = Sight::default();
        let whole = sight.place(pane, [620, 480]);
        assert!(pane.expand(1e-3).contains_rect(whole.frame()));
        let at = pos2(340.0, 240.0);
        let before = whole.image(at);
        sight.zoom_about(&whole, at, 3.0);
        let near = sight.place(pane, [620, 480]);
        let after = near.image(at);
        assert!((before[0] - after[0]).abs() < 0.05 && (before[1] - after[1]).abs() < 0.05, "{before:?} {after:?}");
        assert!((near.scale / whole.scale - 3.0).abs() < 1e-4);
        let back = near.screen(near.image(at));
        assert!(back.distance(at) < 1e-2);
        sight.drag(&near, vec2(1e6, -1e6));
        assert!(sight.place(pane, [620, 480]).seen().area() > 0.8 * pane.area());
        // A frame of another size shows the same part.
        let other = sight.place(pane, [1240, 960]);
        assert!((other.scale * 2.0 - sight.place(pane, [620, 480]).scale).abs() < 1e-4);
    }
}
