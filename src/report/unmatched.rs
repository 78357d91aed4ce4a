//! The strip of a frame that has no matched DRR: the frame large, with every shadow seen in it, and beside it why there is none.

use std::ops::Range;

use super::alone::Alone;
use super::canvas::{Align, Canvas};
use super::colour::{DIM, LINE, TEXT};
use super::drawn;
use super::marks::{PairMarks, ShadowMark};
use super::pair::Standing;
use super::panels::{Panels, frame_in_grays};
use crate::acquire::Frame;
use crate::mask::Masks;

/// See the module.
pub(super) struct Unmatched<'a> {
    pub frame: &'a Frame,
    pub masks: &'a Masks,
    pub marks: Option<&'a PairMarks>,
    pub standing: Standing,
    /// Why there is no DRR, a sentence each.
    pub reasons: Vec<&'a str>,
}

/// Where the numbers of a row end, from the left of its column of the table, and what they are.
const ENDS: [(f32, &str); 5] = [(28.0, "no."), (96.0, "column"), (160.0, "row"), (224.0, "radius"), (284.0, "SNR")];
/// Width of a column of the table.
const WIDE: i64 = 300;
/// Height of its rows.
const ROW: i64 = 19;
/// Height of a line of a reason.
const LINE_HIGH: i64 = 22;

/// Draws the frame, enlarged by `scale`, into the panel that begins at `left`, and the words into the columns of pixels `beside` it.
pub(super) fn show(panel: &mut Panels, shown: &Unmatched, left: i64, beside: Range<i64>, scale: f64) {
    let Alone { values, unit, shut_off, window, .. } = Alone::of(shown.frame, shown.masks);
    let mut picture = Canvas::over(frame_in_grays(&values, &shut_off, window, scale));
    let shadows = shown.marks.map(|marks| marks.shadows.as_slice()).unwrap_or_default();
    if let Some(marks) = shown.marks {
        drawn::draw(&mut picture, &marks.figures(), scale);
        drawn::draw(&mut picture, &marks.ranks(), scale);
    }
    let title = if shadows.is_empty() { "acquired" } else { "acquired, and the shadows seen" };
    panel.picture(left, title, &picture.image);
    panel.gray_scale(left, window, &unit);

    let (top, bottom) = (panel.top, panel.top + panel.height);
    let mut baseline = top + 16;
    for reason in &shown.reasons {
        panel.canvas.disc(beside.start as f32 + 5.0, baseline as f32 - 5.0, 4.0, shown.standing.colour());
        for line in panel.canvas.wrapped(reason, 16.0, (beside.end - beside.start) as f32 - 20.0) {
            panel.canvas.text(beside.start as f32 + 18.0, baseline as f32, &line, 16.0, TEXT, Align::Left);
            baseline += LINE_HIGH;
        }
        baseline += 6;
    }
    if !shadows.is_empty() {
        table(panel.canvas, shadows, &beside, baseline + 12..bottom);
    }
}

/// Where the shadows lie and how large they are, as far as there is room.
fn table(canvas: &mut Canvas, shadows: &[ShadowMark], columns: &Range<i64>, rows: Range<i64>) {
    let words = match shadows {
        [_] => "1 bead-like shadow; centre and radius in px".to_owned(),
        _ => format!("{} bead-like shadows, the most bead-like first; centre and radius in px", shadows.len()),
    };
    canvas.text(columns.start as f32, rows.start as f32, &words, 16.0, DIM, Align::Left);
    let beside = ((columns.end - columns.start) / WIDE).max(1);
    let first = rows.start + 26;
    let high = ((rows.end - first) / ROW).max(1);
    let room = (beside * high) as usize;
    let listed = if shadows.len() > room { room - 1 } else { shadows.len() };
    let slots = (listed + usize::from(listed < shadows.len())) as i64;
    let place = |at: usize| ((columns.start + at as i64 / high * WIDE) as f32, (first + (at as i64 % high + 1) * ROW) as f32);
    for column in 0..(slots + high - 1) / high {
        let from = (columns.start + column * WIDE) as f32;
        for (end, name) in ENDS {
            canvas.text(from + end, first as f32, name, 13.0, DIM, Align::Right);
        }
        canvas.fill(columns.start + column * WIDE, first + 4, WIDE - 12, 1, LINE);
    }
    for (at, shadow) in shadows[..listed].iter().enumerate() {
        let (left, baseline) = place(at);
        let [u, v] = shadow.image_px;
        let numbers = [
            shadow.rank.to_string(),
            format!("{u:.1}"),
            format!("{v:.1}"),
            format!("{:.1}", shadow.radius_px),
            format!("{:.0}", shadow.snr),
        ];
        for ((end, _), number) in ENDS.into_iter().zip(&numbers) {
            canvas.text(left + end, baseline, number, 14.0, TEXT, Align::Right);
        }
    }
    if listed < shadows.len() {
        let (left, baseline) = place(listed);
        canvas.text(left, baseline, &format!("and {} more", shadows.len() - listed), 14.0, DIM, Align::Left);
    }
}
