//! The panels of a strip: pictures with a title, a scale bar and a legend.

use std::ops::Range;

use rayon::prelude::*;

use super::canvas::{Align, Canvas, Rgb};
use super::colour::{self, CAUTION, DIM, EDGE, LINE, TEXT, WELL};
use super::shut_off::{calm, dimmed};
use crate::image::{Image, round_down, zip};

/// Thickness of a legend bar.
const BAR: i64 = 8;

/// Panels of one size in a row.
pub(super) struct Panels<'a> {
    pub canvas: &'a mut Canvas,
    pub top: i64,
    pub width: i64,
    pub height: i64,
    /// At panel size.
    pub mm_per_px: Option<f64>,
}

impl Panels<'_> {
    fn title(&mut self, left: i64, title: &str) {
        self.canvas.text(left as f32, (self.top - 10) as f32, title, 16.0, DIM, Align::Left);
    }

    /// A picture in the middle of the panel that begins at `left`.
    pub fn picture(&mut self, left: i64, title: &str, image: &Image<Rgb>) {
        self.title(left, title);
        self.canvas.fill(left, self.top, self.width, self.height, WELL);
        let (du, dv) = ((self.width - image.width as i64) / 2, (self.height - image.height as i64) / 2);
        self.canvas.paste(left + du, self.top + dv, image);
        self.canvas.outline(left, self.top, self.width, self.height, 1, LINE);
        self.scale_bar(left);
    }

    /// Words in place of a picture.
    pub fn empty(&mut self, left: i64, title: &str, why: &str) {
        self.title(left, title);
        self.canvas.fill(left, self.top, self.width, self.height, WELL);
        self.canvas.outline(left, self.top, self.width, self.height, 1, LINE);
        let lines = self.canvas.wrapped(why, 16.0, self.width as f32 - 48.0);
        let (centre, first) =
            (left as f32 + 0.5 * self.width as f32, self.top as f32 + 0.5 * self.height as f32 - 11.0 * lines.len() as f32);
        self.canvas.disc(centre, first - 16.0, 4.0, CAUTION);
        for (index, line) in lines.iter().enumerate() {
            self.canvas.text(centre, first + 16.0 + 22.0 * index as f32, line, 16.0, DIM, Align::Centre);
        }
    }

    /// A bar of a round length, at most a quarter of the panel, at its lower left.
    fn scale_bar(&mut self, left: i64) {
        let Some(mm_per_px) = self.mm_per_px.filter(|mm| mm.is_finite() && *mm > 0.0) else {
            return;
        };
        let length = round_down(0.25 * self.width as f64 * mm_per_px);
        let pixels = (length / mm_per_px).round() as i64;
        let (u, v) = (left + 14, self.top + self.height - 16);
        self.canvas.fill(u - 1, v - 1, pixels + 2, 5, [0, 0, 0]);
        self.canvas.fill(u, v, pixels, 3, TEXT);
        let label = format!("{} mm", colour::short(length, length));
        let at = (u as f32 + 0.5 * pixels as f32).max(u as f32 + 0.5 * self.canvas.text_width(&label, 14.0));
        self.canvas.text(at + 1.0, v as f32 - 6.0, &label, 14.0, [0, 0, 0], Align::Centre);
        self.canvas.text(at, v as f32 - 7.0, &label, 14.0, TEXT, Align::Centre);
    }

    fn legend_bar(&mut self, left: i64, colour: impl Fn(f64) -> Rgb, labels: [String; 3], unit: &str) {
        let (v, width) = (self.top + self.height + 10, self.width);
        for u in 0..width {
            let shade = colour(u as f64 / (width - 1).max(1) as f64);
            self.canvas.fill(left + u, v, 1, BAR, shade);
        }
        self.canvas.outline(left, v, width, BAR, 1, LINE);
        let baseline = (v + BAR + 17) as f32;
        let [low, middle, high] = labels;
        self.canvas.text(left as f32, baseline, &low, 14.0, DIM, Align::Left);
        let words = if middle.is_empty() { unit.to_owned() } else { format!("{middle} {unit}") };
        self.canvas.text(left as f32 + 0.5 * width as f32, baseline, &words, 14.0, DIM, Align::Centre);
        self.canvas.text((left + width) as f32, baseline, &high, 14.0, DIM, Align::Right);
    }

    /// Below a picture: its gray values.
    pub fn gray_scale(&mut self, left: i64, window: [f64; 2], unit: &str) {
        let span = window[1] - window[0];
        let labels = [colour::short(window[0], span), String::new(), colour::short(window[1], span)];
        self.legend_bar(left, |share| colour::gray((window[0] + share * span) as f32, window), labels, unit);
    }

    /// Below a difference: its colours.
    pub fn diverging_scale(&mut self, left: i64, limit: f64, unit: &str) {
        let labels = [colour::short(-limit, limit), "0".into(), format!("+{}", colour::short(limit, limit))];
        self.legend_bar(left, |share| colour::diverging(2.0 * share as f32 - 1.0), labels, unit);
    }

    /// Below an overlay: what its edges are.
    pub fn legend(&mut self, left: i64, words: &str) {
        let v = self.top + self.height + 13;
        self.canvas.fill(left, v, 26, 2, EDGE);
        self.canvas.text((left + 34) as f32, (v + 6) as f32, words, 14.0, DIM, Align::Left);
    }

    /// Below a picture, at its right.
    pub fn right_note(&mut self, left: i64, words: &str) {
        let v = self.top + self.height + 19;
        self.canvas.text((left + self.width) as f32, v as f32, words, 14.0, DIM, Align::Right);
    }
}

/// Area means when shrinking, bilinear when enlarging; NaN counts for nothing, and stays where there is nothing else.
pub(super) fn scaled(image: &Image<f32>, scale: f64) -> Image<f32> {
    if scale < 1.0 {
        return shrunk(image, scale, |value| *value);
    }
    let [width, height] = [image.width, image.height].map(|n| size(n, scale));
    let mut pixels = vec![0.0; width * height];
    pixels.par_chunks_mut(width).enumerate().for_each(|(v, row)| {
        row.iter_mut().enumerate().for_each(|(u, pixel)| *pixel = bilinear(image, u, v, scale));
    });
    Image { width, height, pixels }
}

fn size(n: usize, scale: f64) -> usize {
    ((n as f64 * scale).round() as usize).max(1)
}

/// What share of each pixel at panel size is marked.
fn scaled_share(marked: &Image<bool>, scale: f64) -> Image<f32> {
    let share = |marked: &bool| f32::from(u8::from(*marked));
    if scale < 1.0 { shrunk(marked, scale, share) } else { scaled(&marked.map(share), scale) }
}

/// Means of `value` under each of the fewer pixels.
fn shrunk<T: Sync>(image: &Image<T>, scale: f64, value: impl Fn(&T) -> f32 + Sync) -> Image<f32> {
    let [width, height] = [image.width, image.height].map(|n| size(n, scale));
    let span = |at: usize, end: usize| {
        let (from, to) = ((at as f64 / scale) as usize, ((at + 1) as f64 / scale).ceil() as usize);
        from.min(end - 1)..to.clamp(from.min(end - 1) + 1, end)
    };
    let columns: Vec<Range<usize>> = (0..width).map(|u| span(u, image.width)).collect();
    let mut pixels = vec![0.0; width * height];
    pixels.par_chunks_mut(width).enumerate().for_each(|(v, out)| {
        let rows = span(v, image.height);
        let mut sums = vec![(0.0f64, 0usize); width];
        for row in rows.clone().map(|row| &image.pixels[row * image.width..][..image.width]) {
            for ((sum, count), columns) in sums.iter_mut().zip(&columns) {
                for value in row[columns.clone()].iter().map(&value).filter(|value| value.is_finite()) {
                    *sum += f64::from(value);
                    *count += 1;
                }
            }
        }
        for ((pixel, (sum, count)), columns) in out.iter_mut().zip(sums).zip(&columns) {
            *pixel = if 2 * count >= columns.len() * rows.len() { (sum / count as f64) as f32 } else { f32::NAN };
        }
    });
    Image { width, height, pixels }
}

fn bilinear(image: &Image<f32>, u: usize, v: usize, scale: f64) -> f32 {
    let at = |i: usize, end: usize| ((i as f64 + 0.5) / scale - 0.5).clamp(0.0, end as f64 - 1.0);
    image.bilinear(at(u, image.width), at(v, image.height)).map_or(f32::NAN, |value| value as f32)
}

/// A frame at panel size, gray between the ends of `window`; dim and calm where it is shut off.
pub(super) fn frame_in_grays(values: &Image<f32>, shut_off: &Image<bool>, window: [f64; 2], scale: f64) -> Image<Rgb> {
    let grays = scaled(&calm(values, shut_off, window), scale).map(|value| colour::gray(*value, window));
    let share = scaled_share(shut_off, scale);
    zip(&grays, &share, |gray, share| dimmed(*gray, *share))
}

/// Opacity of the edges at panel size: a pixel of the panel is as bright as it is covered.
pub(super) fn edge_opacity(edges: &Image<bool>, scale: f64) -> Image<f32> {
    let mut drawn = scaled_share(edges, scale);
    if scale < 1.0 {
        // A line one source pixel wide covers `scale` of a panel pixel.
        drawn.pixels.iter_mut().for_each(|v| *v = (*v / (0.6 * scale as f32)).min(1.0));
    }
    drawn
}
