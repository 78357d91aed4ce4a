//! A frame freed of what console and panel did to it: offset, gain and heel, bad pixels; what was done stays with the frame.

use std::path::Path;
use std::sync::Arc;

use glam::DVec2;

use super::detector_record::{AirBeam, DetectorCalibration, DetectorCalibrationError};
use super::panel_maps::{AT_LOW_END, BURNED_IN, DEAD, HOT, SATURATED, UNSTABLE};
use super::{Domain, Frame, FrameTags, Stored};
use crate::geometry::{ConsoleGeometry, Intensifier, IntensifierError, PanelWindow};
use crate::image::Image;

/// Tube voltages this close are the same.
const SAME_KVP: f64 = 1.0;
/// What interpolation between two voltages may err.
const INTERPOLATED_SIGMA: f64 = 0.01;

/// How a beam of the calibration fits a frame.
struct ChosenBeam {
    index: usize,
    /// Air value of the frame's exposure, median over the panel.
    air_value: Result<f64, String>,
    relative_sigma: f64,
    evidence: String,
}

/// Tube current times time of a frame, mAs.
#[must_use]
pub fn exposure_mas(tags: &FrameTags) -> Option<f64> {
    let product = tags.tube_ma.zip(tags.exposure_ms).map(|(ma, ms)| 1e-3 * ma * ms);
    tags.exposure_uas.map(|uas| 1e-3 * uas).or(product).filter(|mas| *mas > 0.0 && mas.is_finite())
}

impl Frame {
    /// What an intensifier that is `whole` in the panel's picture did to this frame, in its own pixels.
    ///
    /// # Errors
    /// When the panel's picture is no other size of the one it was measured in.
    pub fn seen_through(&self, whole: &Intensifier) -> Result<Intensifier, IntensifierError> {
        match self.correction.as_ref().and_then(|correction| correction.stored.as_ref()) {
            Some(stored) => stored.seen_through(whole),
            None => whole.for_size(self.size_px.map(|side| side as u32)),
        }
    }

    /// The frame as it lies on the panel: quarter turns and mirroring undone pixel by pixel, declared writing marked, and what the
    /// console left empty beside a panel of `panel_px`, where that is known.
    #[must_use]
    pub fn oriented(&self, console: &ConsoleGeometry, panel_px: Option<[u32; 2]>) -> Self {
        let stored_px = self.size_px.map(|side| side as u32);
        let mut frame = self.clone();
        let mut correction = frame.correction.take().unwrap_or_default();
        let mut words = console.words();
        if self.unmirrored && !words.is_empty() {
            words.push("the file says itself that its columns were reversed; that was undone once".to_owned());
        }
        frame.pixels = console.orient(&self.pixels, self.unmirrored);
        frame.size_px = [frame.pixels.width, frame.pixels.height];
        if !console.burned_in_px.is_empty() {
            let mut written = Image::filled(self.pixels.width, self.pixels.height, 0u8);
            for &[left, top, columns, rows] in &console.burned_in_px {
                let right = (left.saturating_add(columns) as usize).min(written.width);
                let bottom = (top.saturating_add(rows) as usize).min(written.height);
                for row in top as usize..bottom {
                    for column in left as usize..right {
                        // The areas are given as stored, before the import put mirrored columns back in order.
                        let column = if self.unmirrored { written.width - 1 - column } else { column };
                        *written.at_mut(column, row) |= BURNED_IN;
                    }
                }
            }
            correction.flags = Some(Arc::new(console.orient(&written, self.unmirrored)));
        }
        if let Some(beside) = panel_px.and_then(|panel_px| console.beside_the_panel(panel_px, stored_px)) {
            let (width, height) = (frame.pixels.width, frame.pixels.height);
            let mut flags = correction.flags.take().map_or_else(|| Image::filled(width, height, 0), Arc::unwrap_or_clone);
            for (_, flag) in flags.pixels.iter_mut().enumerate().filter(|(at, _)| beside(at % width, at / width)) {
                *flag |= BURNED_IN;
            }
            correction.flags = Some(Arc::new(flags));
        }
        if let (Some(pitch), true) = (&mut frame.tags.pitch_mm, self.size_px[0] != frame.size_px[0]) {
            pitch.reverse();
        }
        correction.console = words;
        correction.stored = Some(Stored { console: console.clone(), size_px: stored_px, panel_px });
        correction.panel_px_per_px = console.window(stored_px).step;
        frame.correction = Some(correction);
        frame
    }
}

impl DetectorCalibration {
    /// A frame whose pixels lie on the panel as `window` says, corrected by the calibration at `path`.
    ///
    /// # Errors
    /// When the calibration cannot be read or does not apply; see [`DetectorCalibration::correct`].
    pub fn apply_file(path: &Path, frame: &Frame, window: PanelWindow) -> Result<Frame, DetectorCalibrationError> {
        let corrected = Self::read(path)?.correct(frame, window);
        corrected.map_err(|reason| DetectorCalibrationError::NotApplied { path: path.to_owned(), reason })
    }

    /// The frame with offset and gain maps undone and bad pixels interpolated, its values in the unit as stored: proportional to the
    /// signal, and zero without X-rays. `window` says where its pixels lie on the panel.
    ///
    /// # Errors
    /// In words, when the calibration does not apply: another size, or values that are not linear. The frame stays as it was then.
    pub fn correct(&self, frame: &Frame, window: PanelWindow) -> Result<Frame, String> {
        let record = &self.record;
        if frame.domain != Domain::Linear {
            return Err(format!(
                "the detector calibration was not applied: it is for linear values, the frame's domain is {}; export frames FOR \
                 PROCESSING, or declare \"domain\": \"linear\" if that is what they are",
                frame.domain
            ));
        }
        if let Some(unit) = frame.unit.as_deref().filter(|unit| *unit != "stored value") {
            return Err(format!("the detector calibration was not applied: it is for stored values, the frame's unit is {unit}"));
        }
        let panel_px = [record.columns_px as usize, record.rows_px as usize];
        let whole = window == PanelWindow::WHOLE;
        // Corners of a turned picture may lie beside the panel, its middle may not.
        let share = if window.turned_rad == 0.0 { 1.0 } else { 0.5 };
        let last = DVec2::from_array(frame.size_px.map(|side| share * side as f64)) - 0.5;
        let reach = window.detector_from_oriented().transform_point2(last).to_array();
        let fits = |axis: usize| reach[axis] + 0.5 < panel_px[axis] as f64 + 1.0;
        if (whole && frame.size_px != panel_px) || !fits(0) || !fits(1) {
            return Err(format!(
                "the detector calibration was not applied: it is for {panel_px:?} px, the frame has {:?}; calibrate this mode, or \
                 declare the \"console\" geometry",
                frame.size_px
            ));
        }
        let chosen = self.choose(&frame.tags);
        let mut corrected = frame.clone();
        let mut correction = corrected.correction.take().unwrap_or_default();
        let mut flags = match correction.flags.take() {
            Some(flags) => Arc::unwrap_or_clone(flags),
            None => Image::filled(frame.pixels.width, frame.pixels.height, 0u8),
        };
        let beam = chosen.as_ref().map(|chosen| &record.beams[chosen.index]);
        let air_share = chosen.as_ref().and_then(|chosen| self.maps.air_share.get(chosen.index));
        let offset_value = record.offset_value.unwrap_or(0.0);
        let [low_end, high_end] = [frame.clipping.black_at, frame.clipping.saturated_at];
        let saturated_from = record.saturation_value.map_or(f32::INFINITY, |value| value as f32);
        let places = Places { window, panel_px };
        let width = frame.pixels.width;
        for (at, (value, flag)) in corrected.pixels.pixels.iter_mut().zip(&mut flags.pixels).enumerate() {
            if high_end == Some(*value) || *value >= saturated_from {
                *flag |= SATURATED;
            }
            if low_end == Some(*value) {
                *flag |= AT_LOW_END;
            }
            let covered = places.covered(at % width, at / width);
            let offset = self.maps.offset_value.as_ref().map_or(offset_value, |map| covered.mean(map));
            let share = air_share.map_or(1.0, |map| covered.mean(map));
            if let Some(bad) = &self.maps.bad {
                *flag |= covered.union(bad);
            }
            if !(share > 0.0) {
                *flag |= DEAD;
            }
            let signal = f64::from(*value) - offset;
            *value = if share > 0.0 { (signal / share) as f32 } else { signal as f32 };
        }
        correction.bad_pixels = repair(&mut corrected.pixels, &flags);
        correction.offset_value = Some(offset_value);
        (correction.air_value, correction.air_relative_sigma, correction.air_evidence) = match (&chosen, record.air_value) {
            (Some(chosen), _) => match &chosen.air_value {
                Ok(value) => (Some(*value), Some(chosen.relative_sigma), chosen.evidence.clone()),
                Err(reason) => (None, None, reason.clone()),
            },
            (None, Some(air)) => (Some(air - offset_value), None, "the calibration's one air value, for any exposure".to_owned()),
            (None, None) => (None, None, "the calibration holds no air frames".to_owned()),
        };
        correction.gain_value_per_quantum = beam
            .and_then(|beam| beam.gain_value_per_quantum)
            .or_else(|| record.air_value.zip(record.photons_per_pixel).map(|(air, photons)| (air - offset_value) / photons));
        correction.readout_sigma_value = record.readout_sigma_value;
        correction.flags = Some(Arc::new(flags));
        // No value stands for an end of the scale any more; the flags do.
        corrected.clipping.saturated_at = None;
        corrected.clipping.black_at = None;
        corrected.unit = Some("stored value".to_owned());
        corrected.notes.push(format!(
            "detector calibration applied: offset {offset_value:.1}, {} bad pixels interpolated; {}",
            correction.bad_pixels, correction.air_evidence
        ));
        corrected.correction = Some(correction);
        Ok(corrected)
    }

    /// The beam whose map fits best, and the air value of the frame's exposure if it can be known. `None` without beams.
    fn choose(&self, tags: &FrameTags) -> Option<ChosenBeam> {
        let beams = &self.record.beams;
        let distance = |beam: &AirBeam| tags.kvp.zip(beam.tube_kvp).map_or(0.0, |(a, b)| (a - b).abs());
        let index = (0..beams.len()).min_by(|a, b| distance(&beams[*a]).total_cmp(&distance(&beams[*b])))?;
        let beam = &beams[index];
        let unknown = |reason: String| ChosenBeam { index, air_value: Err(reason), relative_sigma: 0.0, evidence: String::new() };
        let (Some(kvp), Some(beam_kvp)) = (tags.kvp, beam.tube_kvp) else {
            if tags.kvp.is_none() && beam.tube_kvp.is_none() {
                return Some(at_exposure(index, beam, tags, beam.air_value_per_mas, "tube voltage not stated"));
            }
            return Some(unknown("air level unknown: the tube voltage of the frame or of the calibration is not stated".into()));
        };
        let near: Vec<&AirBeam> = beams.iter().filter(|beam| distance(beam) <= SAME_KVP).collect();
        if near.len() > 1 {
            let filters: Vec<&str> = near.iter().map(|beam| beam.filter.as_deref().unwrap_or("none")).collect();
            return Some(unknown(format!(
                "air level unknown: the calibration has filters {} at {kvp:.0} kVp, and the frame does not say which was in",
                filters.join(", ")
            )));
        }
        if near.len() == 1 {
            return Some(at_exposure(index, beam, tags, beam.air_value_per_mas, &format!("{beam_kvp:.0} kVp")));
        }
        // Tube output is close to a power of the voltage between two that were measured with the same filter.
        let same: Vec<&AirBeam> = beams.iter().filter(|other| other.filter == beam.filter).collect();
        let nearest = |above: bool| {
            let side = same.iter().filter(|b| b.tube_kvp.is_some_and(|v| (v > kvp) == above) && b.air_value_per_mas.is_some());
            side.min_by(|a, b| distance(a).total_cmp(&distance(b))).copied()
        };
        let (Some(below), Some(above)) = (nearest(false), nearest(true)) else {
            return Some(unknown(format!(
                "air level unknown: the frame was taken at {kvp:.0} kVp, the calibration ends at {beam_kvp:.0} kVp; calibrate this voltage"
            )));
        };
        let ends = [below, above].map(|b| [b.tube_kvp, b.air_value_per_mas].map(|v| v.unwrap_or(f64::NAN).ln()));
        let share = (kvp.ln() - ends[0][0]) / (ends[1][0] - ends[0][0]);
        let per_mas = (ends[0][1] + share * (ends[1][1] - ends[0][1])).exp();
        let words = format!("between {:.0} and {:.0} kVp", ends[0][0].exp(), ends[1][0].exp());
        let mut chosen = at_exposure(index, beam, tags, Some(per_mas).filter(|value| value.is_finite()), &words);
        chosen.relative_sigma = chosen.relative_sigma.hypot(INTERPOLATED_SIGMA);
        Some(chosen)
    }
}

/// The air value of the frame's own exposure and distance.
fn at_exposure(index: usize, beam: &AirBeam, tags: &FrameTags, per_mas: Option<f64>, words: &str) -> ChosenBeam {
    let relative_sigma = beam.air_relative_sigma;
    let distance = tags.sid_mm.zip(beam.source_to_detector_mm).filter(|(frame, _)| *frame > 0.0);
    let inverse_square = distance.map_or(1.0, |(frame, calibrated)| (calibrated / frame).powi(2));
    let moved =
        if (inverse_square - 1.0).abs() > 1e-3 { format!(", times {inverse_square:.4} for the distance") } else { String::new() };
    let (air_value, evidence) = match (per_mas, exposure_mas(tags), beam.air_value) {
        (Some(per_mas), Some(mas), _) => {
            (Ok(per_mas * mas * inverse_square), format!("air level from the calibration: {words}, {mas:.3} mAs{moved}"))
        }
        (Some(_), None, _) => (Err("air level unknown: the frame does not say its mAs".to_owned()), String::new()),
        (None, _, Some(_)) => {
            (Err("air level unknown: the calibration's air frames did not say their mAs".to_owned()), String::new())
        }
        (None, _, None) => (Err("air level unknown: the calibration has none for this beam".to_owned()), String::new()),
    };
    ChosenBeam { index, air_value, relative_sigma, evidence }
}

/// From pixels of a frame to those of the panel.
struct Places {
    window: PanelWindow,
    panel_px: [usize; 2],
}

/// The panel pixels that a frame's pixel covers.
struct Covered {
    columns: std::ops::Range<usize>,
    rows: std::ops::Range<usize>,
}

impl Places {
    fn covered(&self, column: usize, row: usize) -> Covered {
        let step = self.window.step;
        if self.window.turned_rad != 0.0 {
            let centre = self.window.detector_from_oriented().transform_point2(DVec2::new(column as f64, row as f64)).to_array();
            let range = |axis: usize| {
                let side = self.panel_px[axis];
                // As many as a pixel is wide, about its middle.
                let start = ((centre[axis] + 0.5 - 0.5 * step).round().max(0.0) as usize).min(side - 1);
                start..(start + step.round().max(1.0) as usize).min(side)
            };
            return Covered { columns: range(0), rows: range(1) };
        }
        let range = |axis: usize, at: usize| {
            let first = self.window.first_px[axis];
            let last = self.panel_px[axis] - 1;
            // An enlarged pixel lies within one of the panel; a binned one covers whole ones.
            let centre = (first + step * (at as f64 + 0.5)).floor().max(0.0) as usize;
            if step <= 1.0 {
                return centre.min(last)..centre.min(last) + 1;
            }
            let start = ((first + step * at as f64).round().max(0.0) as usize).min(last);
            let end = (first + step * (at as f64 + 1.0)).round() as usize;
            start..end.clamp(start + 1, last + 1)
        };
        Covered { columns: range(0, column), rows: range(1, row) }
    }
}

impl Covered {
    fn mean(&self, map: &Image<f32>) -> f64 {
        let mut sum = 0.0;
        for row in self.rows.clone() {
            sum += map.pixels[row * map.width..][self.columns.clone()].iter().map(|v| f64::from(*v)).sum::<f64>();
        }
        sum / (self.rows.len() * self.columns.len()) as f64
    }

    fn union(&self, map: &Image<u8>) -> u8 {
        self.rows.clone().fold(0, |flags, row| {
            map.pixels[row * map.width..][self.columns.clone()].iter().fold(flags, |flags, flag| flags | flag)
        })
    }
}

/// Bad pixels get the median of their good neighbours, the nearest ring that has three; returns how many there are.
fn repair(pixels: &mut Image<f32>, flags: &Image<u8>) -> usize {
    let bad = |at: usize| flags.pixels[at] & (DEAD | HOT | UNSTABLE) != 0;
    let wrong: Vec<usize> = (0..flags.pixels.len()).filter(|at| bad(*at)).collect();
    let (width, height) = (pixels.width, pixels.height);
    let mended: Vec<(usize, f32)> = wrong
        .iter()
        .filter_map(|&at| {
            let (u, v) = (at % width, at / width);
            (1..=8usize).find_map(|reach| {
                let mut good = Vec::new();
                for row in v.saturating_sub(reach)..(v + reach + 1).min(height) {
                    for column in u.saturating_sub(reach)..(u + reach + 1).min(width) {
                        let beside = row * width + column;
                        if !bad(beside) {
                            good.push(pixels.pixels[beside]);
                        }
                    }
                }
                if good.len() < 3 {
                    return None;
                }
                let middle = good.len() / 2;
                Some((at, *good.select_nth_unstable_by(middle, f32::total_cmp).1))
            })
        })
        .collect();
    for (at, value) in &mended {
        pixels.pixels[*at] = *value;
    }
    wrong.len()
}
