//! Finds the open field of a frame.

use glam::DVec2;
use rayon::prelude::*;

use super::cells::Cells;
use super::contour::{Bright, Found};
use super::edge::{Judged, Terms, judge};
use super::outline::{Outline, SHORT_SHARE, alike};
use super::profile::Edge;
use super::shape::{Disc, FieldShape, HalfPlane};
use super::signal::Signal;
use crate::image::{Image, block_means};

/// The open field of a frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Field {
    /// Pixels that are shut or in the penumbra.
    pub outside: Image<bool>,
    /// Where half of the beam passes.
    pub shape: FieldShape,
    /// Width of the widest edge, from fully shut to fully open; 0 for a step.
    pub penumbra_px: f64,
    /// Short, for people: "left edge 120 px deep; disc of radius 500 px about (512, 512); penumbra 3 px".
    pub description: String,
}

/// Frames smaller than this are not searched.
const SMALLEST_PX: usize = 32;
/// Shares of the cells that may be dark; thresholds are put between neighbours, where the levels leave the widest gap.
const DARK_SHARES: [f64; 26] = [
    0.002, 0.005, 0.01, 0.02, 0.035, 0.05, 0.075, 0.1, 0.13, 0.17, 0.21, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5, 0.55, 0.6, 0.65, 0.7,
    0.75, 0.8, 0.85, 0.9, 0.96,
];
/// Larger frames are searched in blocks of pixels.
const LARGEST_PX: usize = 1024;
/// Lines judged at full resolution, at most.
const MOST_JUDGED: usize = 28;

/// The open field of `pixels`; `None` when no edge of a field shows in the frame. Works on linear, logarithmic and display values.
/// `may_be_bright`: a console may have painted what is shut as bright as open air, as only processed frames have it.
#[must_use]
pub fn find_field(pixels: &Image<f32>, larger_is_more_attenuation: bool, may_be_bright: bool) -> Option<Field> {
    find_told_field(pixels, larger_is_more_attenuation, may_be_bright, &FieldShape::default())
}

/// [`find_field`], where somebody says that the edges of `told` are there: they are looked at as those that the picture suggests, and taken
/// only if it shows them.
#[must_use]
pub fn find_told_field(
    pixels: &Image<f32>,
    larger_is_more_attenuation: bool,
    may_be_bright: bool,
    told: &FieldShape,
) -> Option<Field> {
    let (width, height) = (pixels.width, pixels.height);
    if width < SMALLEST_PX || height < SMALLEST_PX || pixels.pixels.len() != width * height {
        return None;
    }
    // Edges of shutters are straight or round over the whole frame: larger pixels place them as well, and sooner.
    let factor = width.max(height).div_ceil(LARGEST_PX);
    let (shape, penumbra_px) = if factor > 1 {
        let coarse = block_means(pixels, &pixels.map(|value| value.is_finite()), factor).0;
        let (shape, penumbra_px) =
            outline_of(&coarse, larger_is_more_attenuation, may_be_bright, &told.enlarged(1.0 / factor as f64))?;
        (shape.enlarged(factor as f64), penumbra_px * factor as f64)
    } else {
        outline_of(pixels, larger_is_more_attenuation, may_be_bright, told)?
    };
    let margin_px = penumbra_px / 2.0 + 0.5 * factor as f64;
    let description = format!("{}; penumbra {:.0} px", shape.describe(width, height), penumbra_px);
    Some(Field { outside: shape.outside(width, height, margin_px), shape, penumbra_px, description })
}

/// The field's outline and the width of its penumbra.
fn outline_of(
    pixels: &Image<f32>,
    larger_is_more_attenuation: bool,
    may_be_bright: bool,
    told: &FieldShape,
) -> Option<(FieldShape, f64)> {
    let signal = Signal::new(pixels, larger_is_more_attenuation)?;
    let cells = Cells::new(&signal);
    let dark = outline(&signal, &cells, &thresholds(&cells), told);
    let painted = paint_of(&cells).map(f32::from_bits).and_then(|paint| {
        let unlike = signal.unlike(paint);
        let mut found = outline(&unlike, &Cells::new(&unlike), &[0.5], told)?;
        found.round_corners(&unlike);
        (!signal.is_bright(paint) || may_be_bright && found.is_no_saturated_air()).then_some(found)
    });
    let matched = |outline: &Option<Outline>| outline.as_ref().map_or(0.0, Outline::matched_px);
    // Of the same edges, those in the signal are better: paint hides where the penumbra begins.
    let same = |a: &Outline, b: &Outline| a.edges.len() == b.edges.len() && a.matched_px() >= 0.9 * b.matched_px();
    let doubled = dark.as_ref().zip(painted.as_ref()).is_some_and(|(dark, painted)| same(dark, painted));
    let outline = if !doubled && matched(&painted) >= 0.8 * matched(&dark) {
        let mut painted = painted?;
        for judged in dark.iter().flat_map(|dark| &dark.edges) {
            painted.add_blade(&signal, &cells, judged);
        }
        painted
    } else {
        let mut dark = dark?;
        dark.round_corners(&signal);
        dark
    };
    let penumbra_px = outline.penumbra_px();
    Some((outline.shape, penumbra_px))
}

/// Levels between dark and bright cells: one for each pair of neighbouring shares, where the gap is widest compared with the height above
/// the darkest.
fn thresholds(cells: &Cells) -> Vec<f32> {
    let mut levels: Vec<f32> = cells.cells.iter().map(|cell| cell.level).collect();
    levels.sort_unstable_by(f32::total_cmp);
    let count = levels.len();
    let floor = levels[count / 500];
    let mut noise: Vec<f32> = cells.cells.iter().map(|cell| cell.noise).collect();
    noise.sort_unstable_by(f32::total_cmp);
    let softening = (0.2 * noise[count / 20]).max((levels[count - 1] - floor) * 1e-4);
    let index = |share: f64| ((count - 1) as f64 * share) as usize;
    let mut found = Vec::new();
    for pair in DARK_SHARES.windows(2) {
        let gaps = levels[index(pair[0])..=index(pair[1])].windows(2);
        let widest = gaps.map(|w| ((w[1] - w[0]) / ((w[1] - floor).max(0.0) + softening), f32::midpoint(w[0], w[1])));
        let best = widest.max_by(|a, b| a.0.total_cmp(&b.0)).filter(|(gap, _)| *gap > 0.0);
        found.extend(best.map(|(_, level)| level));
    }
    found
}

/// The bits of the value that most of the cells at the border hold everywhere, if they are many.
fn paint_of(cells: &Cells) -> Option<u32> {
    let (columns, rows) = (cells.columns, cells.rows);
    let border = (0..columns)
        .flat_map(|column| [column, (rows - 1) * columns + column])
        .chain((0..rows).flat_map(|row| [row * columns, row * columns + columns - 1]));
    let mut values: Vec<u32> = border.filter_map(|index| cells.cells[index].constant).collect();
    values.sort_unstable();
    let longest = values.chunk_by(|a, b| a == b).max_by_key(|run| run.len())?;
    (longest.len() * 20 >= columns + rows).then(|| longest[0])
}

fn outline(signal: &Signal, cells: &Cells, thresholds: &[f32], told: &FieldShape) -> Option<Outline> {
    let found: Vec<_> = thresholds
        .par_iter()
        .filter_map(|&threshold| {
            let bright = Bright::new(cells, threshold)?;
            let (lines, disc) = (bright.lines(cells), bright.disc(cells, &[]));
            Some((bright, lines, disc))
        })
        .collect();
    let cell_px = cells.size_px.max_element();
    let lines = distinct_lines(found.iter().flat_map(|found| found.1.iter().copied()).collect(), cells);
    let mut discs = distinct_discs(found.iter().filter_map(|found| found.2).collect(), cells);
    discs.extend(told.disc);
    let shortest = signal.pixels.width.min(signal.pixels.height) as f64;
    let search_px = (1.5 * cell_px).max(6.0);
    let none = FieldShape::default();
    let least_px = SHORT_SHARE * shortest;
    let alone = Terms { shape: &none, search_px, least_px, shut_level: None };
    let suggested = lines.into_iter().chain(border_lines(signal.pixels.width, signal.pixels.height));
    let lines: Vec<Edge> = suggested.chain(told.half_planes.iter().copied()).map(Edge::Line).collect();
    let mut judged: Vec<Judged> = lines
        .par_iter()
        .copied()
        .chain(discs.par_iter().map(|disc| Edge::Circle(*disc)))
        .filter_map(|edge| judge(signal, cells, edge, &alone).ok())
        .filter(|judged| judged.edge.is_sound(signal.pixels.width, signal.pixels.height))
        .collect();
    judged.sort_by(|a, b| b.matched_px.total_cmp(&a.matched_px));
    if judged.is_empty() {
        return None;
    }
    // What a longer blade shuts hides the ends of a shorter one: such edges hold only inside what is open so far.
    let mut waiting: Vec<(Edge, f64)> =
        judged.iter().map(|judged| (judged.edge, 0.0)).chain(lines.iter().map(|line| (*line, search_px))).collect();
    let mut outline = Outline { shape: none, edges: Vec::new() };
    // Edges seen well come first, then a disc between them, of which only short arcs may show: else its tangents would be taken for blades.
    for judged in judged.iter().filter(|judged| judged.share >= 0.8) {
        outline.add(signal, cells, judged.edge, 0.0, least_px);
    }
    outline.prune(signal, cells);
    if outline.shape.disc.is_none() && !outline.edges.is_empty() {
        let arcs = found.par_iter().filter_map(|found| found.0.disc(cells, &outline.shape.half_planes)).collect();
        for disc in distinct_discs(arcs, cells).into_iter().chain(told.disc).map(Edge::Circle) {
            if disc.is_sound(signal.pixels.width, signal.pixels.height) {
                outline.add(signal, cells, disc, search_px, least_px);
            }
        }
    }
    for _ in 0..3 {
        for (edge, search_px) in &waiting {
            outline.add(signal, cells, *edge, *search_px, least_px);
        }
        let dropped = outline.prune(signal, cells);
        if dropped.is_empty() {
            break;
        }
        waiting.retain(|(edge, _)| !dropped.iter().any(|other| alike(edge, other, cells)));
    }
    outline.long_enough(shortest).then_some(outline)
}

/// Just inside each side of the frame: blades that come in by less than a cell.
fn border_lines(width: usize, height: usize) -> Vec<HalfPlane> {
    let (right, bottom) = (width as f64 - 1.0, height as f64 - 1.0);
    [(DVec2::NEG_X, 0.0), (DVec2::X, right), (DVec2::NEG_Y, 0.0), (DVec2::Y, bottom)]
        .into_iter()
        .flat_map(|(normal, reach)| [4.0, 12.0].map(|depth| HalfPlane { normal, limit_px: reach - depth }))
        .collect()
}

/// Lines that differ, those that more thresholds and longer rims speak for first.
fn distinct_lines(mut found: Vec<Found<HalfPlane>>, cells: &Cells) -> Vec<HalfPlane> {
    found.sort_by_key(|line| std::cmp::Reverse(line.support));
    let mut groups: Vec<(HalfPlane, usize)> = Vec::new();
    for line in found {
        let plane = line.edge;
        let same = |other: &HalfPlane| alike(&Edge::Line(plane), &Edge::Line(*other), cells);
        if let Some(group) = groups.iter_mut().find(|group| same(&group.0)) {
            group.1 += line.support;
        } else {
            groups.push((plane, line.support));
        }
    }
    groups.sort_by_key(|group| std::cmp::Reverse(group.1));
    groups.truncate(MOST_JUDGED);
    groups.into_iter().map(|group| group.0).collect()
}

fn distinct_discs(mut found: Vec<Found<Disc>>, cells: &Cells) -> Vec<Disc> {
    found.sort_by_key(|disc| std::cmp::Reverse(disc.support));
    let mut discs: Vec<Disc> = Vec::new();
    for Found { edge: disc, .. } in found {
        if discs.len() < 6 && !discs.iter().any(|other| alike(&Edge::Circle(disc), &Edge::Circle(*other), cells)) {
            discs.push(disc);
        }
    }
    discs
}
