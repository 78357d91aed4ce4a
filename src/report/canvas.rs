//! A small canvas for pictures: rectangles, paths, gray and colour rasters, and text in an embedded font.

use std::ops::Range;

use ab_glyph::{Font, FontRef, PxScale, ScaleFont, point};
use tiny_skia::{FillRule, LineCap, LineJoin, Mask, Path, PathBuilder, Stroke, Transform};

use crate::image::Image;

/// 8-bit sRGB.
pub type Rgb = [u8; 3];

/// Which end of a text lies at the given point.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Align {
    /// Text begins there.
    Left,
    /// Text is centred there.
    Centre,
    /// Text ends there.
    Right,
}

/// An RGB raster to draw on.
pub struct Canvas {
    /// The pixels so far.
    pub image: Image<Rgb>,
    font: FontRef<'static>,
}

impl Canvas {
    /// `width` × `height` pixels of `background`.
    #[must_use]
    pub fn new(width: usize, height: usize, background: Rgb) -> Self {
        Self::over(Image::filled(width, height, background))
    }

    /// To draw on `image`.
    #[must_use]
    pub fn over(image: Image<Rgb>) -> Self {
        let font = FontRef::try_from_slice(epaint_default_fonts::UBUNTU_LIGHT).expect("the embedded font is a font");
        Self { image, font }
    }

    /// Blends `colour` over the pixel with `opacity` in 0..=1; outside the canvas nothing happens.
    pub fn blend(&mut self, u: i64, v: i64, colour: Rgb, opacity: f32) {
        let inside = u >= 0 && v >= 0 && (u as usize) < self.image.width && (v as usize) < self.image.height;
        if !inside {
            return;
        }
        let pixel = self.image.at_mut(u as usize, v as usize);
        for (old, new) in pixel.iter_mut().zip(colour) {
            *old = (f32::from(*old) + (f32::from(new) - f32::from(*old)) * opacity.clamp(0.0, 1.0)).round() as u8;
        }
    }

    /// Of `length` pixels from `from` on those that lie on the `end` of the canvas.
    fn inside(from: i64, length: i64, end: usize) -> Range<usize> {
        let on_canvas = |at: i64| at.clamp(0, end as i64) as usize;
        on_canvas(from)..on_canvas(from.saturating_add(length)).max(on_canvas(from))
    }

    /// A filled rectangle.
    pub fn fill(&mut self, u: i64, v: i64, width: i64, height: i64, colour: Rgb) {
        let [columns, rows] = [Self::inside(u, width, self.image.width), Self::inside(v, height, self.image.height)];
        for row in rows {
            self.image.pixels[row * self.image.width..][columns.clone()].fill(colour);
        }
    }

    /// The outline of a rectangle, `thickness` pixels inwards.
    pub fn outline(&mut self, u: i64, v: i64, width: i64, height: i64, thickness: i64, colour: Rgb) {
        self.fill(u, v, width, thickness, colour);
        self.fill(u, v + height - thickness, width, thickness, colour);
        self.fill(u, v, thickness, height, colour);
        self.fill(u + width - thickness, v, thickness, height, colour);
    }

    /// A filled disc.
    pub fn disc(&mut self, centre_u: f32, centre_v: f32, radius: f32, colour: Rgb) {
        if let Some(disc) = PathBuilder::from_circle(centre_u, centre_v, radius) {
            self.cover(&disc, colour);
        }
    }

    /// The lines of `path`, with round ends and corners.
    pub(super) fn stroke(&mut self, path: &Path, width: f32, colour: Rgb) {
        let pen = Stroke { width, line_cap: LineCap::Round, line_join: LineJoin::Round, ..Stroke::default() };
        if let Some(outline) = path.stroke(&pen, 1.0) {
            self.cover(&outline, colour);
        }
    }

    /// The inside of `path`: each pixel takes as much colour as it is covered.
    fn cover(&mut self, path: &Path, colour: Rgb) {
        // The canvas counts from the first pixel's centre, a path from its corner.
        let within = |low: f32, high: f32, end: usize| -> Range<usize> {
            let cut = |at: f32| at.clamp(0.0, end as f32) as usize;
            cut((low + 0.5).floor())..cut((high + 0.5).ceil())
        };
        let bounds = path.bounds();
        let columns = within(bounds.left(), bounds.right(), self.image.width);
        let rows = within(bounds.top(), bounds.bottom(), self.image.height);
        let Some(mut mask) = Mask::new(columns.len() as u32, rows.len() as u32) else { return };
        let into_mask = Transform::from_translate(0.5 - columns.start as f32, 0.5 - rows.start as f32);
        mask.fill_path(path, FillRule::Winding, true, into_mask);
        for (row, covered) in rows.zip(mask.data().chunks_exact(columns.len())) {
            for (column, share) in columns.clone().zip(covered).filter(|(_, share)| **share > 0) {
                self.blend(column as i64, row as i64, colour, f32::from(*share) / 255.0);
            }
        }
    }

    /// A raster with its first pixel at (u, v).
    pub fn paste(&mut self, u: i64, v: i64, raster: &Image<Rgb>) {
        let columns = Self::inside(u, raster.width as i64, self.image.width);
        if columns.is_empty() {
            return;
        }
        for row in Self::inside(v, raster.height as i64, self.image.height) {
            let of_raster = &raster.pixels[(row as i64 - v) as usize * raster.width..][..raster.width];
            let first = (columns.start as i64 - u) as usize;
            let shown = &of_raster[first..][..columns.len()];
            self.image.pixels[row * self.image.width..][columns.clone()].copy_from_slice(shown);
        }
    }

    /// Width in pixels of `text` at `size` (height of a line in pixels).
    #[must_use]
    pub fn text_width(&self, text: &str, size: f32) -> f32 {
        let font = self.font.as_scaled(PxScale::from(size));
        let mut width = 0.0;
        let mut previous = None;
        for glyph in text.chars().map(|c| self.font.glyph_id(c)) {
            if let Some(before) = previous {
                width += font.kern(before, glyph);
            }
            width += font.h_advance(glyph);
            previous = Some(glyph);
        }
        width
    }

    /// `text` with its baseline at `v`. The light face is drawn slightly bolder, which small sizes on dark ground need.
    pub fn text(&mut self, u: f32, v: f32, text: &str, size: f32, colour: Rgb, align: Align) {
        let font = self.font.clone();
        let scaled = font.as_scaled(PxScale::from(size));
        let mut pen = match align {
            Align::Left => u,
            Align::Centre => u - 0.5 * self.text_width(text, size),
            Align::Right => u - self.text_width(text, size),
        };
        let mut previous = None;
        for id in text.chars().map(|c| font.glyph_id(c)) {
            if let Some(before) = previous {
                pen += scaled.kern(before, id);
            }
            let glyph = id.with_scale_and_position(PxScale::from(size), point(pen, v));
            if let Some(outline) = font.outline_glyph(glyph) {
                let bounds = outline.px_bounds();
                outline.draw(|x, y, coverage| {
                    let bolder = (1.35 * coverage).min(1.0);
                    self.blend(bounds.min.x as i64 + i64::from(x), bounds.min.y as i64 + i64::from(y), colour, bolder);
                });
            }
            pen += scaled.h_advance(id);
            previous = Some(id);
        }
    }

    /// `text` shortened with an ellipsis until it is at most `limit` pixels wide.
    #[must_use]
    pub fn fitted(&self, text: &str, size: f32, limit: f32) -> String {
        if self.text_width(text, size) <= limit {
            return text.to_owned();
        }
        let mut kept: Vec<char> = text.chars().collect();
        while kept.pop().is_some() {
            let shorter: String = kept.iter().collect::<String>().trim_end().to_owned() + "…";
            if self.text_width(&shorter, size) <= limit {
                return shorter;
            }
        }
        String::new()
    }

    /// `text` broken at spaces into lines at most `limit` pixels wide.
    #[must_use]
    pub fn wrapped(&self, text: &str, size: f32, limit: f32) -> Vec<String> {
        let mut lines: Vec<String> = Vec::new();
        for word in text.split_whitespace() {
            match lines.last_mut() {
                Some(line) if self.text_width(&format!("{line} {word}"), size) <= limit => {
                    line.push(' ');
                    line.push_str(word);
                }
                _ => lines.push(self.fitted(word, size, limit)),
            }
        }
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A line on a black canvas of 40 × 30 px.
    fn line(from: [f32; 2], to: [f32; 2], width: f32) -> Image<Rgb> {
        let (mut canvas, mut path) = (Canvas::new(40, 30, [0; 3]), PathBuilder::new());
        path.move_to(from[0], from[1]);
        path.line_to(to[0], to[1]);
        canvas.stroke(&path.finish().expect("finite"), width, [255; 3]);
        canvas.image
    }

    /// In whole pixels.
    fn ink(image: &Image<Rgb>) -> f64 {
        image.pixels.iter().map(|pixel| f64::from(pixel[0]) / 255.0).sum()
    }

    #[test]
    fn lines_cover_their_width_about_centres_of_pixels_and_slanted_ones_are_smooth() {
        // Two pixels wide on the border of two rows: both are covered, no other one is.
        let level = line([5.0, 10.5], [25.0, 10.5], 2.0);
        let rows = [9, 10, 11, 12].map(|row| level.at(15, row)[0]);
        assert!(rows[0] < 3 && rows[1] > 252 && rows[2] > 252 && rows[3] < 3, "{rows:?}");
        // As long as it is, and half a disc at either end.
        assert!((ink(&level) - (40.0 + std::f64::consts::PI)).abs() < 1.0, "{}", ink(&level));
        let slanted = line([3.0, 2.0], [35.0, 26.0], 1.2);
        assert!((ink(&slanted) - (40.0 * 1.2 + 0.36 * std::f64::consts::PI)).abs() < 3.0, "{}", ink(&slanted));
        let between = |image: &Image<Rgb>| image.pixels.iter().filter(|pixel| (30..226).contains(&pixel[0])).count();
        assert!(
            between(&slanted) > 30 && between(&level) < 12,
            "{} of the slanted, {} of the level",
            between(&slanted),
            between(&level)
        );
        // A point is a dot.
        assert!((ink(&line([20.0, 15.0], [20.0, 15.0], 4.0)) - 4.0 * std::f64::consts::PI).abs() < 1.0);
    }

    #[test]
    fn what_reaches_beyond_the_canvas_is_cut_there() {
        let across = line([-9e5, 15.0], [9e5, 15.0], 1.0);
        assert!((0..40).all(|column| across.at(column, 15)[0] > 252) && (ink(&across) - 40.0).abs() < 1.0, "{}", ink(&across));
        assert_eq!(ink(&line([60.0, 5.0], [90.0, 25.0], 3.0)), 0.0, "beside it");
        let mut canvas = Canvas::new(40, 30, [0; 3]);
        canvas.disc(0.0, 0.0, 10.0, [255; 3]);
        // A quarter of the disc and half a pixel along both of its straight sides.
        let expected = 25.0 * std::f64::consts::PI + 10.0 + 0.25;
        assert!((ink(&canvas.image) - expected).abs() < 2.5, "{} of {expected}", ink(&canvas.image));
        canvas.disc(f32::NAN, 5.0, 3.0, [255; 3]);
        canvas.disc(1e9, 1e9, 3.0, [255; 3]);
        assert!((ink(&canvas.image) - expected).abs() < 2.5, "no place, no disc");
    }

    #[test]
    fn rectangles_and_rasters_are_cut_at_the_canvas() {
        let raster = Image { width: 7, height: 5, pixels: (0..35).map(|at| [at as u8 + 1; 3]).collect() };
        let mut shown = 0;
        for (u, v) in [(0, 0), (-3, -2), (36, 27), (-7, 4), (40, 3), (3, 30), (900, -900)] {
            let mut pasted = Canvas::new(40, 30, [0; 3]);
            pasted.paste(u, v, &raster);
            let mut filled = Canvas::new(40, 30, [0; 3]);
            filled.fill(u, v, 7, 5, [9; 3]);
            for at in 0..40 * 30 {
                let (column, row) = ((at % 40) as i64 - u, (at / 40) as i64 - v);
                let inside = (0..7).contains(&column) && (0..5).contains(&row);
                let expected = if inside { [*raster.at(column as usize, row as usize), [9; 3]] } else { [[0; 3]; 2] };
                assert_eq!([pasted.image.pixels[at], filled.image.pixels[at]], expected, "{u}, {v}: {column}, {row}");
                shown += usize::from(inside);
            }
            filled.fill(5, 5, -3, 4, [200; 3]);
            assert!(filled.image.pixels.iter().all(|pixel| pixel[0] < 200), "nothing");
        }
        assert_eq!(shown, 35 + 12 + 12);
    }

    #[test]
    fn text_draws_ink_where_it_says_and_fits_its_limit() {
        let mut canvas = Canvas::new(200, 40, [0, 0, 0]);
        canvas.text(190.0, 28.0, "12.5 mm · −3°", 18.0, [255, 255, 255], Align::Right);
        let ink: Vec<usize> = (0..200 * 40).filter(|&at| canvas.image.pixels[at][0] > 100).map(|at| at % 200).collect();
        assert!(ink.len() > 100 && ink.iter().all(|&u| u <= 191));
        let short = canvas.fitted("a rather long reason that does not fit", 18.0, 100.0);
        assert!(short.ends_with('…') && canvas.text_width(&short, 18.0) <= 100.0);
        assert!(canvas.wrapped("one two three four five six", 18.0, 60.0).len() > 2);
    }
}
