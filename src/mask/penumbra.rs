//! The penumbra of an edge: its place and width from mean profiles, and whether the edge is as straight or as round as it should be.

use super::fit::{quantile, solved};
use super::profile::{Profiles, REACH_PX};
use super::refusal::Refusal;

/// Where half of the beam passes, from the profiles' middle inwards, and the width from fully shut to fully open.
pub(super) struct Penumbra {
    pub shift_px: f64,
    pub width_px: f64,
}

/// Stations whose step is worth averaging.
pub(super) fn stepping(profiles: &Profiles) -> Vec<usize> {
    let rise = |k: usize| {
        let outside = profiles.mean(k, -REACH_PX, -6)?.0;
        Some(profiles.mean(k, 7, 24)?.0 - outside)
    };
    let rise = |k: usize| rise(k).or_else(|| Some(profiles.mean(k, 7, 24)?.0 - profiles.mean(k, profiles.outermost(k), 0)?.0));
    let rises: Vec<(usize, f64)> = (0..profiles.stations.len()).filter_map(|k| Some((k, rise(k)?))).collect();
    let Some(high) = quantile(&mut rises.iter().map(|rise| rise.1).collect::<Vec<_>>(), 0.8) else { return Vec::new() };
    rises.iter().filter(|rise| rise.1 > 0.25 * high).map(|rise| rise.0).collect()
}

pub(super) const WIDTHS_PX: [f64; 19] =
    [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 10.0, 12.0, 14.0, 16.0, 18.0, 20.0, 23.0, 26.0, 32.0, 40.0];
/// The ramp is fitted this far to both sides.
const RAMP_REACH_PX: f64 = 26.0;
const COARSE_WIDTHS_PX: [f64; 9] = [0.0, 2.0, 4.0, 7.0, 10.0, 14.0, 18.0, 23.0, 32.0];

/// The same edge in pieces: the width within a piece, or a refusal where the pieces do not lie on the edge, as those of a polygon do not
/// lie on a circle.
pub(super) fn unbent(profiles: &Profiles, stations: &[usize], whole: &Penumbra, is_circle: bool) -> Result<f64, Refusal> {
    let (pieces, rank) = if is_circle { (20, 0.3) } else { (8, 0.5) };
    let size = stations.len().div_ceil(pieces).max(4);
    let pieces: Vec<Penumbra> =
        stations.chunks_exact(size).filter_map(|piece| penumbra(profiles, piece, &COARSE_WIDTHS_PX, 0.75)).collect();
    if pieces.len() < 3 {
        return Ok(whole.width_px);
    }
    let mut widths: Vec<f64> = pieces.iter().map(|piece| piece.width_px).collect();
    let width_px = quantile(&mut widths, rank).unwrap_or(whole.width_px);
    let allowed = 1.6_f64.max(0.15 * width_px);
    let near = pieces.iter().filter(|piece| (piece.shift_px - whole.shift_px).abs() <= allowed).count();
    let share = near as f64 / pieces.len() as f64;
    let widening_px = whole.width_px - width_px;
    if share >= 0.7 && widening_px <= f64::max(if is_circle { 2.5 } else { 3.0 }, 0.4 * width_px) {
        Ok(whole.width_px.min(width_px + 1.0))
    } else {
        Err(Refusal::Bent { share, widening_px })
    }
}

/// The ramp that fits the mean profile of `stations` best: level, smooth step, and a slope inside.
pub(super) fn penumbra(profiles: &Profiles, stations: &[usize], widths_px: &[f64], step_px: f64) -> Option<Penumbra> {
    if stations.len() < 3 {
        return None;
    }
    let mean = |offset: isize| {
        let (mut sum, mut count) = (0.0, 0usize);
        for &k in stations {
            if let Some((value, _)) = profiles.mean(k, offset, offset + 1) {
                sum += value;
                count += 1;
            }
        }
        (count * 2 > stations.len()).then(|| sum / count as f64)
    };
    let curve: Vec<(f64, f64)> = (-REACH_PX..=REACH_PX).filter_map(|offset| Some((offset as f64, mean(offset)?))).collect();
    let mut best: Option<(f64, Penumbra)> = None;
    for &width_px in widths_px {
        for shift in -12..=12 {
            let shift_px = f64::from(shift) * step_px;
            let Some(error) = ramp_error(&curve, shift_px, width_px) else { continue };
            if best.as_ref().is_none_or(|(least, _)| error < *least) {
                best = Some((error, Penumbra { shift_px, width_px }));
            }
        }
    }
    best.map(|(_, penumbra)| penumbra)
}

/// Mean squared residual about outside level + smooth step · (inside level + slope · depth).
fn ramp_error(curve: &[(f64, f64)], shift_px: f64, width_px: f64) -> Option<f64> {
    let mut normal = [[0.0; 4]; 3];
    let (mut count, mut squares) = (0usize, 0.0);
    for &(offset, value) in curve {
        let depth = offset - shift_px;
        // The same pixels for all widths: errors over different ones cannot be compared.
        if offset.abs() > RAMP_REACH_PX {
            continue;
        }
        let share = if width_px > 0.0 { (depth / width_px + 0.5).clamp(0.0, 1.0) } else { (depth + 0.5).clamp(0.0, 1.0) };
        let open = share * share * (3.0 - 2.0 * share);
        let basis = [1.0, open, open * depth / 10.0];
        for i in 0..3 {
            for j in i..3 {
                normal[i][j] += basis[i] * basis[j];
            }
            normal[i][3] += basis[i] * value;
        }
        squares += value * value;
        count += 1;
    }
    if count < 12 {
        return None;
    }
    for (low, high) in [([1, 0], [0, 1]), ([2, 0], [0, 2]), ([2, 1], [1, 2])] {
        normal[low[0]][low[1]] = normal[high[0]][high[1]];
    }
    let fit = solved(normal, 3)?;
    // Σ(y − Xb)² = Σy² − b·Xᵀy.
    let explained: f64 = (0..3).map(|i| fit[i] * normal[i][3]).sum();
    Some((squares - explained).max(0.0) / count as f64)
}
