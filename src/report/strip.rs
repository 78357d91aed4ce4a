//! The strip: acquired | matched DRR | signed difference | edges and marks over acquired, with scales, units and status, as one picture. A
//! frame without a DRR stands there alone, large, with what was seen in it and why there is none.

use super::canvas::{Align, Canvas, Rgb};
use super::colour::{self, BACKGROUND, DIM, EDGE, LINE, TEXT};
use super::drawn;
use super::figures::STRETCH;
use super::marks::PairMarks;
use super::pair::Standing;
use super::panels::{Panels, edge_opacity, frame_in_grays, scaled};
use super::signed_difference::{NOT_COMPARABLE, SignedDifference};
use super::unmatched::{self, Unmatched};
use crate::acquire::Frame;
use crate::compare::Pictures;
use crate::image::Image;
use crate::mask::Masks;

/// What a strip shows.
#[derive(Clone, Copy, Debug)]
pub struct StripInput<'a> {
    /// The acquired frame; shown alone where there is nothing to compare with.
    pub acquired: &'a Frame,
    /// The compared images; `None` without a matched DRR.
    pub pictures: Option<&'a Pictures>,
    /// Which pixels of a frame that stands alone mean anything; `None` where nobody looked.
    pub masks: Option<&'a Masks>,
    /// Why there is no DRR, or no comparison.
    pub without: Option<&'a str>,
    /// What is marked in the frame; `None` where nobody looked.
    pub marks: Option<&'a PairMarks>,
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
const PANEL_WIDTH: i64 = 460;
/// Pictures are no higher.
const MOST_HIGH: f64 = 700.0;
/// Of a frame that stands alone: so much room do the words beside it need at least.
const LEAST_HIGH: i64 = 320;
const MARGIN: i64 = 22;
const GAP: i64 = 16;
const TITLE: i64 = 30;
const HEADER: i64 = 58;
const SCALE: i64 = 52;

/// Draws the strip.
#[must_use]
pub fn strip(input: &StripInput) -> Image<Rgb> {
    let source = match input.pictures {
        Some(pictures) => [pictures.acquired.width, pictures.acquired.height],
        None => [input.acquired.pixels.width, input.acquired.pixels.height],
    };
    let scale = fit(source, PANEL_WIDTH);
    let [panel_width, panel_height] = source.map(|side| (side as f64 * scale).round() as i64);
    let (panel_width, panel_height) = (panel_width.max(220), panel_height.max(120));
    match input.pictures {
        Some(pictures) => {
            let mut canvas = begun(input, panel_width, panel_height);
            let mm_per_px = input.mm_per_px.map(|mm| mm / scale);
            let mut panels =
                Panels { canvas: &mut canvas, top: HEADER + TITLE, width: panel_width, height: panel_height, mm_per_px };
            compared(&mut panels, input, pictures, scale);
            canvas.image
        }
        None => {
            let (left, width) = place(0, 2, panel_width);
            let scale = fit(source, width);
            let height = ((source[1] as f64 * scale).round() as i64).max(LEAST_HIGH);
            let mut canvas = begun(input, panel_width, height);
            let mm_per_px = input.mm_per_px.map(|mm| mm / scale);
            let mut panel = Panels { canvas: &mut canvas, top: HEADER + TITLE, width, height, mm_per_px };
            let (from, wide) = place(2, 2, panel_width);
            let StripInput { acquired: frame, marks, standing, .. } = *input;
            let unmasked = Masks::default();
            let masks = input.masks.unwrap_or(&unmasked);
            let shown = Unmatched { frame, masks, marks, standing, reasons: reasons(input) };
            unmatched::show(&mut panel, &shown, left, from..from + wide, scale);
            canvas.image
        }
    }
}

/// By how much a picture of `source` columns and rows is enlarged in a panel of this width.
fn fit(source: [usize; 2], width: i64) -> f64 {
    let [columns, rows] = source.map(|side| side.max(1) as f64);
    (width as f64 / columns).min(2.0).min(MOST_HIGH / rows)
}

/// Left end and width of `panels` panels from the one at `index` on, gaps included.
fn place(index: i64, panels: i64, panel_width: i64) -> (i64, i64) {
    (MARGIN + index * (panel_width + GAP), panels * panel_width + (panels - 1) * GAP)
}

/// A strip with nothing below its header.
fn begun(input: &StripInput, panel_width: i64, height: i64) -> Canvas {
    let width = 2 * MARGIN + place(0, PANELS, panel_width).1;
    let mut canvas = Canvas::new(width as usize, (HEADER + TITLE + height + SCALE + MARGIN / 2) as usize, BACKGROUND);
    let StripInput { standing, status, scores, .. } = *input;
    header(&mut canvas, &Header { name: &input.acquired.name, standing, status, scores }, width);
    canvas
}

/// Why there is no DRR, a sentence each.
fn reasons<'a>(input: &StripInput<'a>) -> Vec<&'a str> {
    let without = input.without.filter(|words| !input.status.contains(*words));
    let told: Vec<&str> = [input.status].into_iter().chain(without).filter(|words| !words.is_empty()).collect();
    if told.is_empty() { vec!["nothing to compare with"] } else { told }
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

fn compared(panel: &mut Panels, input: &StripInput, pictures: &Pictures, scale: f64) {
    let (signed, difference) = SignedDifference::of(pictures);
    let [window, of_drr] = signed.windows(pictures);
    let panel_width = panel.width;
    let left = |index: i64| place(index, 1, panel_width).0;
    let acquired = frame_in_grays(&pictures.acquired, &pictures.shut_off, window, scale);
    panel.picture(left(0), "acquired", &acquired);
    panel.gray_scale(left(0), window, pictures.unit);
    panel.picture(left(1), "matched DRR", &scaled(&pictures.simulated, scale).map(|v| colour::gray(*v, of_drr)));
    panel.gray_scale(left(1), of_drr, pictures.unit);

    if signed.comparable {
        let limit = signed.limit;
        let difference = scaled(&difference, scale).map(|v| colour::diverging(v / limit as f32));
        panel.picture(left(2), "acquired − DRR", &difference);
        panel.diverging_scale(left(2), limit, signed.unit);
    } else {
        panel.empty(left(2), "acquired − DRR", NOT_COMPARABLE);
    }

    panel.picture(left(3), "DRR edges over acquired", &overlaid(&acquired, input, pictures, scale));
    let enlarged = input.marks.is_some_and(|marks| !(marks.beads.is_empty() && marks.landmarks.is_empty()));
    let words = if enlarged { format!("edges of the DRR; residuals {STRETCH:.0}×") } else { "edges of the DRR".to_owned() };
    panel.legend(left(3), &words);
    let masked = pictures.usable.pixels.iter().filter(|u| !**u).count() as f64 / pictures.usable.pixels.len().max(1) as f64;
    panel.right_note(left(3), &format!("{:.0} % masked", 100.0 * masked));
}

/// The frame, a little darker, with the DRR's edges and with its marks.
fn overlaid(acquired: &Image<Rgb>, input: &StripInput, pictures: &Pictures, scale: f64) -> Image<Rgb> {
    let mut canvas = Canvas::over(acquired.map(|shown| shown.map(|level| (f32::from(level) * 0.82) as u8)));
    let edges = edge_opacity(&pictures.edges, scale);
    for (at, opacity) in edges.pixels.iter().enumerate().filter(|(_, opacity)| **opacity > 0.02) {
        canvas.blend((at % edges.width) as i64, (at / edges.width) as i64, EDGE, 0.9 * opacity);
    }
    if let Some(marks) = input.marks {
        // Places are those of the frame, of which a picture may have one pixel for a whole block.
        let block = (input.acquired.pixels.width / pictures.acquired.width.max(1)).max(1);
        drawn::draw(&mut canvas, &marks.figures(), scale / block as f64);
    }
    canvas.image
}

/// Where the picture that tells most lies in a strip of `width` × `height` pixels (left, top, width, height): edges and marks over a frame that
/// was `compared`, else the frame.
#[must_use]
pub(super) fn telling_rectangle(compared: bool, width: usize, height: usize) -> [f64; 4] {
    let panel_width = (width as f64 - (2 * MARGIN + (PANELS - 1) * GAP) as f64) / PANELS as f64;
    let (index, panels) = if compared { (3.0, 1.0) } else { (0.0, 2.0) };
    let (top, gap) = ((HEADER + TITLE) as f64, GAP as f64);
    let left = MARGIN as f64 + index * (panel_width + gap);
    [left, top, panels * panel_width + (panels - 1.0) * gap, height as f64 - top - (SCALE + MARGIN / 2) as f64]
}
