//! A frame freed of what console and panel did to it: offset, gain and heel, bad pixels; what was done stays with the frame.

use std::path::Path;
use std::sync::Arc;

use glam::{DAffine2, DMat2, DVec2};

use super::detector_record::{DetectorCalibration, DetectorCalibrationError};
use super::flood::ChosenBeam;
use super::panel_maps::{AT_LOW_END, BURNED_IN, DEAD, HOT, SATURATED, UNSTABLE};
use super::{Domain, Frame, FrameTags, Stored};
use crate::geometry::{ConsoleGeometry, Intensifier, IntensifierError, PanelWindow};
use crate::image::{Image, quantile};
use crate::telemetry::CarmSample;

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

    /// Pixels of the picture in the file to those of the panel's picture; centres at integers. Without a console that was declared the frame is
    /// all of it.
    #[must_use]
    pub fn panel_from_file(&self) -> DAffine2 {
        let stored = self.correction.as_ref().and_then(|correction| correction.stored.as_ref());
        let stored_px = stored.map_or(self.size_px.map(|side| side as u32), |stored| stored.size_px);
        let panel_from_console = stored.map_or(DAffine2::IDENTITY, |stored| stored.console.detector_from_image(stored_px));
        // The import has put mirrored columns back in order; the console is declared for what came of it.
        if self.unmirrored && !stored.is_some_and(|stored| stored.console.is_mirrored()) {
            let mirror = DMat2::from_diagonal(DVec2::new(-1.0, 1.0));
            return panel_from_console * DAffine2::from_mat2_translation(mirror, DVec2::new(f64::from(stored_px[0]) - 1.0, 0.0));
        }
        panel_from_console
    }

    /// Pixels of the picture in the file to those of the frame; centres at integers.
    #[must_use]
    pub fn frame_from_file(&self) -> DAffine2 {
        let stored = self.correction.as_ref().and_then(|correction| correction.stored.as_ref());
        let window = stored.map_or(PanelWindow::WHOLE, |stored| stored.console.window(stored.size_px));
        window.detector_from_oriented().inverse() * self.panel_from_file()
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
        // Of a picture that was turned by a quarter, also a square one.
        if console.stored_size([false, true])[0] {
            let tags = &mut frame.tags;
            for pair in [&mut tags.pitch_mm, &mut tags.pixel_spacing_mm, &mut tags.pixel_aspect].into_iter().flatten() {
                pair.reverse();
            }
        }
        correction.console = words;
        correction.stored = Some(Stored { console: console.clone(), size_px: stored_px, panel_px });
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
        self.correct_told(frame, window, None)
    }

    /// [`DetectorCalibration::correct`] where telemetry has `told` of the exposure: voltage and filter that the header does not say.
    ///
    /// # Errors
    /// The same.
    pub fn correct_told(&self, frame: &Frame, window: PanelWindow, told: Option<&CarmSample>) -> Result<Frame, String> {
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
        let chosen = record.choose(&frame.tags, told);
        let mut corrected = frame.clone();
        let mut correction = corrected.correction.take().unwrap_or_default();
        let mut flags = match correction.flags.take() {
            Some(flags) => Arc::unwrap_or_clone(flags),
            None => Image::filled(frame.pixels.width, frame.pixels.height, 0u8),
        };
        let beam = chosen.as_ref().map(|chosen| &record.beams[chosen.index]);
        let offset_value = record.offset_value.unwrap_or(0.0);
        let [low_end, high_end] = [frame.clipping.black_at, frame.clipping.saturated_at];
        let saturated_from = record.saturation_value.map_or(f32::INFINITY, |value| value as f32);
        let panel = self.panel(window, frame.pixels.width, chosen.as_ref());
        for (at, (value, flag)) in corrected.pixels.pixels.iter_mut().zip(&mut flags.pixels).enumerate() {
            if high_end == Some(*value) || *value >= saturated_from {
                *flag |= SATURATED;
            }
            if low_end == Some(*value) {
                *flag |= AT_LOW_END;
            }
            let PanelPixel { offset, share, bad } = panel.at(at);
            *flag |= bad;
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
        correction.flood_doubt = chosen.as_ref().and_then(|chosen| chosen.doubt.clone());
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

    /// The signal of an exposure with these tags where nothing is in the beam, offset subtracted, as far as it is known.
    #[must_use]
    pub fn air_value(&self, tags: &FrameTags) -> Option<f64> {
        match self.record.choose(tags, None) {
            Some(chosen) => chosen.air_value.ok(),
            None => Some(self.record.air_value? - self.record.offset_value.unwrap_or(0.0)),
        }
    }

    /// What the panel stores of a picture that is 1 where the signal is `air_value`: what [`DetectorCalibration::correct`] undoes.
    #[must_use]
    pub fn stored(&self, picture: &Image<f32>, window: PanelWindow, tags: &FrameTags, air_value: f64) -> Image<f32> {
        let panel = self.panel(window, picture.width, self.record.choose(tags, None).as_ref());
        let value = |(at, value): (usize, &f32)| {
            let PanelPixel { offset, share, .. } = panel.at(at);
            (offset + share * air_value * f64::from(*value)) as f32
        };
        Image { pixels: picture.pixels.iter().enumerate().map(value).collect(), ..*picture }
    }

    fn panel(&self, window: PanelWindow, width: usize, chosen: Option<&ChosenBeam>) -> Panel<'_> {
        let panel_px = [self.record.columns_px as usize, self.record.rows_px as usize];
        let air_share = chosen.and_then(|chosen| self.maps.air_share.get(chosen.index));
        Panel { calibration: self, air_share, places: Places { window, panel_px }, width }
    }
}

/// What a calibration says of a pixel: the mean over those of the panel that it covers.
struct PanelPixel {
    offset: f64,
    /// Of the signal, relative to the median over the panel.
    share: f64,
    /// Flags of all that it covers.
    bad: u8,
}

/// A calibration as it lies below a frame.
struct Panel<'a> {
    calibration: &'a DetectorCalibration,
    air_share: Option<&'a Image<f32>>,
    places: Places,
    width: usize,
}

impl Panel<'_> {
    fn at(&self, at: usize) -> PanelPixel {
        let maps = &self.calibration.maps;
        let covered = self.places.covered(at % self.width, at / self.width);
        PanelPixel {
            offset: match &maps.offset_value {
                Some(map) => covered.mean(map),
                None => self.calibration.record.offset_value.unwrap_or(0.0),
            },
            share: self.air_share.map_or(1.0, |map| covered.mean(map)),
            bad: maps.bad.as_ref().map_or(0, |bad| covered.union(bad)),
        }
    }
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
                quantile(&mut good, 0.5).map(|middle| (at, middle as f32))
            })
        })
        .collect();
    for (at, value) in &mended {
        pixels.pixels[*at] = *value;
    }
    wrong.len()
}
