//! The strip: acquired | matched DRR | signed difference | edges over acquired, with scales, units and status, as one picture.

use rayon::prelude::*;

use super::alone::alone;
use super::canvas::{Align, Canvas, Rgb};
use super::colour::{self, BACKGROUND, CAUTION, DIM, EDGE, LINE, TEXT, WELL};
use super::pair::Standing;
use super::signed_difference::{NOT_COMPARABLE, SignedDifference};
use crate::acquire::Frame;
use crate::compare::Pictures;
use crate::image::Image;

/// What a strip shows.
#[derive(Clone, Copy, Debug)]
pub struct StripInput<'a> {
    /// The acquired frame; shown alone where there is nothing to compare with.
    pub acquired: &'a Frame,
    /// The compared images; `None` without a matched DRR.
    pub pictures: Option<&'a Pictures>,
    /// Why there is no DRR, or no comparison.
    pub without: Option<&'a str>,
    /// Colour and word of the status line.
    pub standing: Standing,
    /// The rest of the status line: `rms 0.05 px, 0.02 mm`, or the reason of a refusal.
    pub status: &'a str,
    /// Right of the status line: scores, each short, as `ZNCC 0.987`.
    pub scores: &'a [String],
    /// Millimetres at the depth of interest per pixel of the pictures (of the frame where there are none); `None`: no scale bar.
    pub mm_per_px: Option<f64>,
}

const PANELS: i64 = 4;
/// Panels are as wide as this allows, and no image is drawn more than twice its size.
const PANEL_WIDTH: usize = 460;
const MARGIN: i64 = 22;
const GAP: i64 = 16;
const TITLE: i64 = 30;
const HEADER: i64 = 58;
const SCALE: i64 = 52;
/// Thickness of a legend bar.
const BAR: i64 = 8;

/// Draws the strip.
#[must_use]
pub fn strip(input: &StripInput) -> Image<Rgb> {
    let (source_width, source_height) = match input.pictures {
        Some(pictures) => (pictures.acquired.width, pictures.acquired.height),
        None => (input.acquired.pixels.width, input.acquired.pixels.height),
    };
    let scale = (PANEL_WIDTH as f64 / source_width.max(1) as f64).min(2.0).min(700.0 / source_height.max(1) as f64);
    let panel_width = ((source_width as f64 * scale).round() as i64).max(220);
    let panel_height = ((source_height as f64 * scale).round() as i64).max(120);
    let width = 2 * MARGIN + PANELS * panel_width + (PANELS - 1) * GAP;
    let height = HEADER + TITLE + panel_height + SCALE + MARGIN / 2;
    let mut canvas = Canvas::new(width as usize, height as usize, BACKGROUND);
    let StripInput { standing, status, scores, .. } = *input;
    header(&mut canvas, &Header { name: &input.acquired.name, standing, status, scores }, width);
    let top = HEADER + TITLE;
    let place = |index: i64| MARGIN + index * (panel_width + GAP);
    let bar = input.mm_per_px.map(|mm| mm / scale);
    let mut panel = Panels { canvas: &mut canvas, top, width: panel_width, height: panel_height, mm_per_px: bar };
    match input.pictures {
        Some(pictures) => compared(&mut panel, pictures, place, scale),
        None => {
            let (shown, unit) = alone(input.acquired);
            let window = colour::window(&[&shown], None);
            panel.picture(place(0), "acquired", &scaled(&shown, scale), |v| colour::gray(v, window));
            panel.gray_scale(place(0), window, &unit);
            panel.empty(place(1), "matched DRR", input.without.unwrap_or("nothing to compare with"));
            panel.empty(place(2), "acquired − DRR", "no matched DRR");
            panel.empty(place(3), "DRR edges over acquired", "no matched DRR");
        }
    }
    canvas.image
}

/// Writes a new status over the header of a strip that was drawn before.
#[must_use]
pub fn restated(strip: Image<Rgb>, name: &str, standing: Standing, status: &str) -> Image<Rgb> {
    let width = strip.width as i64;
    let mut canvas = Canvas::over(strip);
    canvas.fill(0, 0, width, HEADER, BACKGROUND);
    header(&mut canvas, &Header { name, standing, status, scores: &[] }, width);
    canvas.image
}

/// The line above the pictures.
struct Header<'a> {
    name: &'a str,
    standing: Standing,
    status: &'a str,
    scores: &'a [String],
}

fn header(canvas: &mut Canvas, input: &Header, width: i64) {
    let (left, right) = (MARGIN as f32, (width - MARGIN) as f32);
    let baseline = 37.0;
    canvas.disc(left + 6.0, baseline - 6.0, 5.5, input.standing.colour());
    canvas.text(left + 20.0, baseline, input.standing.word(), 19.0, input.standing.colour(), Align::Left);
    let mut pen = left + 20.0 + canvas.text_width(input.standing.word(), 19.0) + 14.0;
    let scores = input.scores.join("    ");
    let scores_width = canvas.text_width(&scores, 17.0);
    canvas.text(right, baseline, &scores, 17.0, TEXT, Align::Right);
    let name = canvas.fitted(input.name, 19.0, (0.3 * (right - left)).max(120.0));
    canvas.text(pen, baseline, &name, 19.0, TEXT, Align::Left);
    pen += canvas.text_width(&name, 19.0) + 14.0;
    let status = canvas.fitted(input.status, 17.0, right - scores_width - 24.0 - pen);
    canvas.text(pen, baseline, &status, 17.0, DIM, Align::Left);
    canvas.fill(MARGIN, HEADER - 5, width - 2 * MARGIN, 1, LINE);
}

fn compared(panel: &mut Panels, pictures: &Pictures, place: impl Fn(i64) -> i64, scale: f64) {
    let (signed, difference) = SignedDifference::of(pictures);
    let [window, of_drr] = signed.windows(pictures);
    let acquired = scaled(&pictures.acquired, scale);
    panel.picture(place(0), "acquired", &acquired, |v| colour::gray(v, window));
    panel.gray_scale(place(0), window, pictures.unit);
    panel.picture(place(1), "matched DRR", &scaled(&pictures.simulated, scale), |v| colour::gray(v, of_drr));
    panel.gray_scale(place(1), of_drr, pictures.unit);

    if signed.comparable {
        let limit = signed.limit;
        panel.picture(place(2), "acquired − DRR", &scaled(&difference, scale), |v| colour::diverging(v / limit as f32));
        panel.diverging_scale(place(2), limit, signed.unit);
    } else {
        panel.empty(place(2), "acquired − DRR", NOT_COMPARABLE);
    }

    let edges = edge_opacity(&pictures.edges, scale);
    panel.picture(place(3), "DRR edges over acquired", &acquired, |v| {
        let [level, ..] = colour::gray(v, window);
        [(f32::from(level) * 0.82) as u8; 3]
    });
    panel.overlay(place(3), &edges);
    panel.legend(place(3), "edges of the DRR");
    let masked = pictures.usable.pixels.iter().filter(|u| !**u).count() as f64 / pictures.usable.pixels.len().max(1) as f64;
    panel.right_note(place(3), &format!("{:.0} % masked", 100.0 * masked));
}

/// Area means when shrinking, bilinear when enlarging; NaN counts for nothing, and stays where there is nothing else.
fn scaled(image: &Image<f32>, scale: f64) -> Image<f32> {
    let size = |n: usize| ((n as f64 * scale).round() as usize).max(1);
    let (width, height) = (size(image.width), size(image.height));
    let mut pixels = vec![0.0; width * height];
    pixels.par_chunks_mut(width).enumerate().for_each(|(v, row)| {
        for (u, pixel) in row.iter_mut().enumerate() {
            *pixel = if scale < 1.0 { mean_under(image, u, v, scale) } else { bilinear(image, u, v, scale) };
        }
    });
    Image { width, height, pixels }
}

fn mean_under(image: &Image<f32>, u: usize, v: usize, scale: f64) -> f32 {
    let span = |at: usize, end: usize| {
        let (from, to) = ((at as f64 / scale) as usize, ((at + 1) as f64 / scale).ceil() as usize);
        from.min(end - 1)..to.clamp(from.min(end - 1) + 1, end)
    };
    let (mut sum, mut count) = (0.0, 0usize);
    let (columns, rows) = (span(u, image.width), span(v, image.height));
    let total = columns.len() * rows.len();
    for row in rows {
        for column in columns.clone() {
            let value = *image.at(column, row);
            if value.is_finite() {
                sum += f64::from(value);
                count += 1;
            }
        }
    }
    if 2 * count >= total { (sum / count as f64) as f32 } else { f32::NAN }
}

fn bilinear(image: &Image<f32>, u: usize, v: usize, scale: f64) -> f32 {
    let at = |i: usize, end: usize| ((i as f64 + 0.5) / scale - 0.5).clamp(0.0, end as f64 - 1.0);
    image.bilinear(at(u, image.width), at(v, image.height)).map_or(f32::NAN, |value| value as f32)
}

/// Opacity of the edges at panel size: a pixel of the panel is as bright as it is covered.
fn edge_opacity(edges: &Image<bool>, scale: f64) -> Image<f32> {
    let mut drawn = scaled(&edges.map(|e| f32::from(u8::from(*e))), scale);
    if scale < 1.0 {
        // A line one source pixel wide covers `scale` of a panel pixel.
        drawn.pixels.iter_mut().for_each(|v| *v = (*v / (0.6 * scale as f32)).min(1.0));
    }
    drawn
}

struct Panels<'a> {
    canvas: &'a mut Canvas,
    top: i64,
    width: i64,
    height: i64,
    /// At panel size.
    mm_per_px: Option<f64>,
}

impl Panels<'_> {
    fn title(&mut self, left: i64, title: &str) {
        self.canvas.text(left as f32, (self.top - 10) as f32, title, 16.0, DIM, Align::Left);
    }

    fn picture(&mut self, left: i64, title: &str, image: &Image<f32>, colour: impl Fn(f32) -> Rgb) {
        self.title(left, title);
        self.canvas.fill(left, self.top, self.width, self.height, WELL);
        let (du, dv) = ((self.width - image.width as i64) / 2, (self.height - image.height as i64) / 2);
        self.canvas.paste(left + du, self.top + dv, &image.map(|v| colour(*v)));
        self.canvas.outline(left, self.top, self.width, self.height, 1, LINE);
        self.scale_bar(left);
    }

    fn empty(&mut self, left: i64, title: &str, why: &str) {
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
        let longest = 0.25 * self.width as f64 * mm_per_px;
        let upper = colour::round_up(longest);
        let length = [upper, upper / 2.0, upper / 2.5, upper / 5.0].into_iter().find(|l| *l <= longest).unwrap_or(longest);
        let pixels = (length / mm_per_px).round() as i64;
        let (u, v) = (left + 14, self.top + self.height - 16);
        self.canvas.fill(u - 1, v - 1, pixels + 2, 5, [0, 0, 0]);
        self.canvas.fill(u, v, pixels, 3, TEXT);
        let label = format!("{} mm", colour::short(length, length));
        let at = (u as f32 + 0.5 * pixels as f32).max(u as f32 + 0.5 * self.canvas.text_width(&label, 14.0));
        self.canvas.text(at + 1.0, v as f32 - 6.0, &label, 14.0, [0, 0, 0], Align::Centre);
        self.canvas.text(at, v as f32 - 7.0, &label, 14.0, TEXT, Align::Centre);
    }

    fn overlay(&mut self, left: i64, edges: &Image<f32>) {
        let (du, dv) = ((self.width - edges.width as i64) / 2, (self.height - edges.height as i64) / 2);
        for v in 0..edges.height {
            for u in 0..edges.width {
                let opacity = *edges.at(u, v);
                if opacity > 0.02 {
                    self.canvas.blend(left + du + u as i64, self.top + dv + v as i64, EDGE, 0.9 * opacity);
                }
            }
        }
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

    fn gray_scale(&mut self, left: i64, window: [f64; 2], unit: &str) {
        let span = window[1] - window[0];
        let labels = [colour::short(window[0], span), String::new(), colour::short(window[1], span)];
        self.legend_bar(left, |share| colour::gray((window[0] + share * span) as f32, window), labels, unit);
    }

    fn diverging_scale(&mut self, left: i64, limit: f64, unit: &str) {
        let labels = [colour::short(-limit, limit), "0".into(), format!("+{}", colour::short(limit, limit))];
        self.legend_bar(left, |share| colour::diverging(2.0 * share as f32 - 1.0), labels, unit);
    }

    fn legend(&mut self, left: i64, words: &str) {
        let v = self.top + self.height + 13;
        self.canvas.fill(left, v, 26, 2, EDGE);
        self.canvas.text((left + 34) as f32, (v + 6) as f32, words, 14.0, DIM, Align::Left);
    }

    fn right_note(&mut self, left: i64, words: &str) {
        let v = self.top + self.height + 19;
        self.canvas.text((left + self.width) as f32, v as f32, words, 14.0, DIM, Align::Right);
    }
}

/// Where panel `index` lies in a strip of `width` × `height` pixels: left, top, width, height.
#[must_use]
pub(super) fn panel_rectangle(index: usize, width: usize, height: usize) -> [f64; 4] {
    let panel_width = (width as f64 - (2 * MARGIN + (PANELS - 1) * GAP) as f64) / PANELS as f64;
    let top = (HEADER + TITLE) as f64;
    [
        MARGIN as f64 + index as f64 * (panel_width + GAP as f64),
        top,
        panel_width,
        height as f64 - top - (SCALE + MARGIN / 2) as f64,
    ]
}
