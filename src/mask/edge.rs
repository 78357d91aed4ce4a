//! Judges a candidate edge at full resolution: puts it where the signal rises, measures its penumbra, and asks whether what lies beyond
//! is shut.

use super::cells::Cells;
use super::fit::{quantile, robust_fit};
use super::penumbra::{Penumbra, WIDTHS_PX, penumbra, stepping, unbent};
use super::profile::{Edge, Profiles, REACH_PX};
use super::refusal::Refusal;
use super::shape::FieldShape;
use super::signal::Signal;
use crate::estimate::median;

/// Penumbras up to this width, from fully shut to fully open.
const WIDEST_PENUMBRA_PX: f64 = 26.0;
/// Half of the window that a step is sought with.
const STEP_WINDOW_PX: isize = 8;
/// Between the penumbra and the windows beside it.
const GAP_PX: f64 = 1.5;

/// Letters cover at most this share of the frame …
const TEXT_SHARE: f64 = 0.006;
/// … and this share of what a blade shuts.
const MOST_TEXT_SHARE: f64 = 0.2;

/// An edge that holds.
#[derive(Clone, Copy, Debug)]
pub(super) struct Judged {
    pub edge: Edge,
    /// From fully shut to fully open.
    pub penumbra_px: f64,
    /// Length of edge that is seen to be one.
    pub matched_px: f64,
    /// Share of the edge with signal inside that is seen to be one.
    pub share: f64,
    /// Median signal just outside, and the step to what is inside.
    pub level: f64,
    pub step: f64,
}

/// The edge moved to where the signal rises most; looks `search_px` to both sides.
fn settled(signal: &Signal, mut edge: Edge, shape: &FieldShape, search_px: f64) -> Option<(Edge, Profiles)> {
    let mut search = search_px.ceil() as isize;
    for _ in 0..3 {
        let profiles = Profiles::new(signal, &edge, shape, search + STEP_WINDOW_PX);
        let steps: Vec<([f64; 3], f64, f64)> = (0..profiles.stations.len())
            .filter_map(|k| {
                let (offset, rise) = steepest(&profiles, k, search)?;
                Some((edge.basis(&profiles.stations[k]), offset, rise))
            })
            .collect();
        if steps.len() < 3 {
            return None;
        }
        let high = quantile(&mut steps.iter().map(|step| step.2).collect::<Vec<_>>(), 0.9)?;
        if !(high > 0.0) {
            return None;
        }
        let weighted: Vec<([f64; 3], f64, f64)> = steps
            .iter()
            .filter(|step| step.2 > 0.15 * high)
            .map(|&(basis, offset, rise)| (basis, offset, rise.min(high)))
            .collect();
        let unknowns = if matches!(edge, Edge::Line(_)) { 2 } else { 3 };
        let fit = robust_fit(&weighted, unknowns)?;
        let moved = edge.moved(&fit);
        if matches!(moved, Edge::Circle(disc) if !(disc.radius_px > 8.0)) {
            return None;
        }
        edge = moved;
        search = (search / 2).max(4);
    }
    Some((edge, Profiles::new(signal, &edge, shape, REACH_PX)))
}

/// The offset of station `k` where the means of two neighbouring windows differ most, and that rise.
fn steepest(profiles: &Profiles, k: usize, search: isize) -> Option<(f64, f64)> {
    let mut best: Option<(f64, f64)> = None;
    for offset in -search..=search {
        let Some((outside, n)) = profiles.mean(k, offset - STEP_WINDOW_PX, offset) else { continue };
        let Some((inside, m)) = profiles.mean(k, offset, offset + STEP_WINDOW_PX) else { continue };
        // A difference of short windows is noisier: near the border of the frame.
        let rise = (inside - outside) * (n.min(m) as f64 / STEP_WINDOW_PX as f64).sqrt();
        if best.is_none_or(|(_, most)| rise > most) {
            // Offset 0 is the station's own pixel: a step between −1 and 0 is at −0.5.
            best = Some((offset as f64 - 0.5, rise));
        }
    }
    best
}

/// How an edge is judged.
#[derive(Clone, Copy)]
pub(super) struct Terms<'a> {
    /// What other edges leave open.
    pub shape: &'a FieldShape,
    /// How far off the candidate may be; 0: it is where it was put before.
    pub search_px: f64,
    /// It must be seen along this length.
    pub least_px: f64,
    /// The level beyond other edges.
    pub shut_level: Option<f64>,
}

/// The edge and its penumbra, or why `edge` is none.
pub(super) fn judge(signal: &Signal, cells: &Cells, edge: Edge, terms: &Terms) -> Result<Judged, Refusal> {
    let (edge, profiles) = if terms.search_px > 0.0 {
        settled(signal, edge, terms.shape, terms.search_px).ok_or(Refusal::NoStep)?
    } else {
        (edge, Profiles::new(signal, &edge, terms.shape, REACH_PX))
    };
    if profiles.stations.len() < 4 {
        return Err(Refusal::NotSeen);
    }
    let stations = stepping(&profiles);
    let mut penumbra = penumbra(&profiles, &stations, &WIDTHS_PX, 0.5).ok_or(Refusal::NoStep)?;
    if !(penumbra.width_px <= WIDEST_PENUMBRA_PX) {
        return Err(Refusal::Wide { width_px: penumbra.width_px });
    }
    // The mean profile knows the place better than the single stations.
    let edge = edge.moved(&[penumbra.shift_px, 0.0, 0.0]);
    let beside = Beside::new(&profiles, &penumbra).ok_or(Refusal::NoStep)?;
    beside.steep()?;
    let (share, matched) = beside.matched();
    let length_px = matched.len() as f64 * profiles.spacing_px;
    // Paint is exact; a blade over thick anatomy is not.
    let least_share = if signal.is_paint() { 0.85 } else { 0.6 };
    if !(share >= least_share && length_px >= terms.least_px) {
        return Err(Refusal::Mismatch { share, length_px });
    }
    let bright = beside.bright_outside();
    if !(bright <= if signal.is_paint() { 0.3 } else { 0.15 }) {
        return Err(Refusal::BrightBeside { share: bright });
    }
    penumbra.width_px = unbent(&profiles, &matched, &penumbra, matches!(edge, Edge::Circle(_)))?;
    beyond(signal, cells, &edge, terms, &beside, penumbra.width_px)?;
    let Beside { level, step, .. } = beside;
    Ok(Judged { edge, penumbra_px: penumbra.width_px, matched_px: length_px, share, level, step })
}

/// Mean signals beside the penumbra, station by station.
struct Beside {
    /// Their indices, and the signal just outside, just inside, further inside, far outside; of the stations where all but the last exist.
    station: Vec<usize>,
    near_out: Vec<f64>,
    near_in: Vec<f64>,
    far_in: Vec<f64>,
    far_out: Vec<f64>,
    /// Median just outside, its scatter, and the step that the brighter stations make.
    level: f64,
    scatter: f64,
    step: f64,
}

impl Beside {
    fn new(profiles: &Profiles, penumbra: &Penumbra) -> Option<Self> {
        let half = penumbra.width_px / 2.0 + GAP_PX;
        let outer = (penumbra.shift_px - half).floor() as isize;
        let inner = (penumbra.shift_px + half).ceil() as isize;
        let mut station = Vec::new();
        let (mut near_out, mut near_in, mut far_in, mut far_out) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
        for k in 0..profiles.stations.len() {
            let outermost = profiles.outermost(k);
            let outside = profiles.mean(k, outer - 6, outer).or_else(|| profiles.mean(k, outermost, outermost + 2));
            let (Some((outside, _)), Some((near, n)), Some((far, m))) =
                (outside, profiles.mean(k, inner, inner + 6), profiles.mean(k, inner + 6, inner + 16))
            else {
                continue;
            };
            if n < 3 || m < 5 {
                continue;
            }
            station.push(k);
            near_out.push(outside);
            near_in.push(near);
            far_in.push(far);
            far_out.push(profiles.mean(k, -REACH_PX, outer - 10).map_or(outside, |(value, _)| value));
        }
        if near_out.len() < 4 {
            return None;
        }
        let level = median(near_out.iter().copied())?;
        let scatter = 1.4826 * median(near_out.iter().map(|x| (x - level).abs()))?;
        let step = quantile(&mut near_in.iter().map(|x| x - level).collect::<Vec<_>>(), 0.8)?;
        Some(Self { station, near_out, near_in, far_in, far_out, level, scatter, step })
    }

    fn live(&self) -> f64 {
        0.15 * self.step + 4.0 * self.scatter
    }

    /// The signal is flat outside and nearly reached inside, right beside the penumbra.
    fn steep(&self) -> Result<(), Refusal> {
        let live: Vec<usize> = (0..self.near_in.len()).filter(|&k| self.near_in[k] - self.level > self.live()).collect();
        let mean = |values: &[f64]| live.iter().map(|&k| values[k]).sum::<f64>() / live.len() as f64;
        let rise = mean(&self.near_in) - mean(&self.near_out);
        let outside = (mean(&self.near_out) - mean(&self.far_out)) / rise;
        let inside = (mean(&self.far_in) - mean(&self.near_in)) / rise;
        if outside <= 0.2 && inside <= 0.4 { Ok(()) } else { Err(Refusal::Slope { outside, inside }) }
    }

    /// Of the stations with signal near the edge, the share that steps right at it, and which these are.
    fn matched(&self) -> (f64, Vec<usize>) {
        let live = self.live();
        let (mut relevant, mut matched) = (0usize, Vec::new());
        for k in 0..self.near_in.len() {
            let (near, far, outside) = (self.near_in[k] - self.level, self.far_in[k] - self.level, self.near_out[k] - self.level);
            if near > live || far > live {
                relevant += 1;
                if near > live && outside <= 0.25 * near + 3.0 * self.scatter && near >= 0.5 * far {
                    matched.push(self.station[k]);
                }
            }
        }
        (matched.len() as f64 / relevant.max(1) as f64, matched)
    }

    fn bright_outside(&self) -> f64 {
        let limit = 0.3 * self.step + 5.0 * self.scatter;
        self.near_out.iter().filter(|x| **x - self.level > limit).count() as f64 / self.near_out.len() as f64
    }
}

/// What lies beyond the edge is flat, the darkest of the frame, and without quantum noise.
fn beyond(signal: &Signal, cells: &Cells, edge: &Edge, terms: &Terms, beside: &Beside, width_px: f64) -> Result<(), Refusal> {
    let margin = width_px / 2.0 + cells.reach_px() + 1.0;
    let (mut outside, mut inside) = (Vec::new(), Vec::new());
    let (mut noise_outside, mut noise_inside) = (Vec::new(), Vec::new());
    for (centre, cell) in cells.iter() {
        let depth = edge.depth_px(centre);
        let level = f64::from(cell.level);
        if depth < -margin {
            outside.push(level);
            noise_outside.push(f64::from(cell.noise));
        } else if depth > margin && terms.shape.depth_px(centre) > margin {
            inside.push(level);
            if depth < margin + 4.0 * cells.reach_px() && level - beside.level > beside.live() {
                noise_inside.push(f64::from(cell.noise));
            }
        }
    }
    let step = beside.step;
    let noise = median(noise_outside).unwrap_or(0.0);
    let inner_noise = median(noise_inside).unwrap_or(0.0);
    // The mean of the middle half of a few pixels scatters by about 0.25 of one pixel's noise.
    let scatter = 0.25 * if outside.len() >= 8 { noise } else { inner_noise };
    let floor = if outside.len() >= 8 {
        let limit = beside.level + 0.15 * step + 5.0 * scatter;
        let bright = outside.iter().filter(|level| **level > limit).count();
        let share = bright as f64 / outside.len() as f64;
        // Letters over a shallow blade cover much of it.
        let letters = bright as f64 <= TEXT_SHARE * cells.cells.len() as f64 && share <= MOST_TEXT_SHARE;
        if !(share <= 0.03 || letters) {
            return Err(Refusal::BrightBeyond { share });
        }
        let text = if letters { share.max(0.1) } else { 0.1 };
        let (low, high) = (quantile(&mut outside, 0.05).unwrap_or(0.0), quantile(&mut outside, 0.98 - text).unwrap_or(0.0));
        let spread = (high - low - 4.0 * scatter) / step;
        if !(spread <= 0.1) {
            return Err(Refusal::Structured { spread });
        }
        low
    } else {
        beside.level
    };
    let limit = floor - 0.04 * step - 5.0 * scatter;
    let share = inside.iter().filter(|level| **level < limit).count() as f64 / inside.len().max(1) as f64;
    if !(share <= 0.003) {
        return Err(Refusal::DarkerInside { share });
    }
    let ratio = beside.level / (beside.level + step);
    let noise_ratio = noise / inner_noise;
    let known = terms.shut_level.is_some_and(|level| (beside.level - level).abs() <= 0.05 * step + 0.5 * noise);
    // The console paints every pixel; where only most are black, it is anatomy.
    let dark = signal.is_paint() && beside.level <= 0.002
        || !signal.is_paint() && (known || (beside.level + step > 0.0 && ratio <= 0.25) || noise_ratio <= 0.7);
    if dark { Ok(()) } else { Err(Refusal::NotDark { ratio, noise_ratio }) }
}
