//! Which beam of a detector calibration is a frame's flood: one with its filter, and of those the one of the nearest tube voltage. And the
//! signal that the frame's exposure gives with nothing in the beam.

use super::added_filter::{AddedFilter, Likeness};
use super::detector_record::{AirBeam, DetectorRecord};
use super::tags::FrameTags;
use crate::telemetry::CarmSample;

/// Tube voltages this close are the same.
const SAME_KVP: f64 = 1.0;
/// What interpolation between two voltages may err.
const INTERPOLATED_SIGMA: f64 = 0.01;

/// How a beam of the calibration fits a frame.
pub(super) struct ChosenBeam {
    pub(super) index: usize,
    /// Air value of the frame's exposure, median over the panel.
    pub(super) air_value: Result<f64, String>,
    pub(super) relative_sigma: f64,
    pub(super) evidence: String,
    /// Why its map may be that of another beam.
    pub(super) doubt: Option<String>,
}

/// Tube current times time of a frame, mAs.
#[must_use]
pub fn exposure_mas(tags: &FrameTags) -> Option<f64> {
    let product = tags.tube_ma.zip(tags.exposure_ms).map(|(ma, ms)| 1e-3 * ma * ms);
    tags.exposure_uas.map(|uas| 1e-3 * uas).or(product).filter(|mas| *mas > 0.0 && mas.is_finite())
}

/// A beam's filter in words.
fn filter_words(beam: &AirBeam) -> String {
    let stated = beam.added_filter.as_ref().map(AddedFilter::words);
    stated.or_else(|| beam.filter.clone()).unwrap_or_else(|| "none".to_owned())
}

impl DetectorRecord {
    /// The beam whose map fits best, and the air value of the frame's exposure if it can be known. What the header does not say of voltage
    /// and filter, telemetry may have `told`. `None` without beams.
    pub(super) fn choose(&self, tags: &FrameTags, told: Option<&CarmSample>) -> Option<ChosenBeam> {
        let beams = &self.beams;
        let told_kvp = told.map(|told| told.tube_kvp).filter(|kvp| *kvp > 0.0 && kvp.is_finite());
        let (kvp, filter) = (tags.kvp.or(told_kvp), AddedFilter::of(tags, told));
        let distance = |beam: &AirBeam| kvp.zip(beam.tube_kvp).map_or(0.0, |(a, b)| (a - b).abs());
        let likeness = |beam: &AirBeam| Likeness::between(filter.as_ref(), beam.added_filter.as_ref());
        let index = (0..beams.len()).min_by(|a, b| {
            let (a, b) = (&beams[*a], &beams[*b]);
            likeness(a).cmp(&likeness(b)).then(distance(a).total_cmp(&distance(b)))
        })?;
        let beam = &beams[index];
        let fits = likeness(beam);
        let unknown = |reason: &str, doubt: Option<String>| ChosenBeam {
            index,
            air_value: Err(format!("air level unknown: {reason}")),
            relative_sigma: 0.0,
            evidence: String::new(),
            doubt,
        };
        let stated = filter.as_ref().map_or_else(|| "a filter that is not stated".to_owned(), AddedFilter::words);
        if fits == Likeness::Other {
            let there = list(beams.iter().map(filter_words));
            let reason = format!("the frame was taken with {stated}, the calibration's air frames with {there}");
            let doubt = format!(
                "flat-fielded with the air frames of another filter: {reason}; take air frames with this filter and calibrate the detector anew"
            );
            return Some(unknown(&reason, Some(doubt)));
        }
        let alike: Vec<&AirBeam> = beams.iter().filter(|other| likeness(other) == fits).collect();
        let near: Vec<&AirBeam> = alike.iter().copied().filter(|other| distance(other) <= SAME_KVP).collect();
        let rivals = if near.is_empty() { &alike } else { &near };
        let ambiguous = || {
            let at = kvp.filter(|_| !near.is_empty()).map(|kvp| format!(" at {kvp:.0} kVp")).unwrap_or_default();
            let there = list(rivals.iter().map(|other| filter_words(other)));
            format!("the calibration has filters {there}{at}, and the frame does not say which was in")
        };
        let is_rival = |other: &AirBeam| match (&other.added_filter, &beam.added_filter) {
            (Some(others), Some(own)) => others.likeness(own) != Likeness::Same,
            (None, None) => false,
            (Some(_), None) | (None, Some(_)) => true,
        };
        if rivals.iter().any(|other| is_rival(other)) {
            let reason = ambiguous();
            let doubt =
                format!("flat-fielded with the air frames of {}, perhaps those of another filter: {reason}", filter_words(beam));
            return Some(unknown(&reason, Some(doubt)));
        }
        let (Some(kvp), Some(beam_kvp)) = (kvp, beam.tube_kvp) else {
            if kvp.is_none() && beam.tube_kvp.is_none() {
                return Some(at_exposure(index, beam, tags, beam.air_value_per_mas, "tube voltage not stated"));
            }
            return Some(unknown("the tube voltage of the frame or of the calibration is not stated", None));
        };
        if near.len() > 1 && beam.added_filter.is_none() {
            return Some(unknown(&ambiguous(), None));
        }
        let behind = match (&beam.added_filter, fits) {
            (None, _) => String::new(),
            (Some(own), Likeness::Same) => format!(", {}", own.words()),
            (Some(own), _) => format!(", taken as {} as the frame does not say its filter", own.words()),
        };
        if !near.is_empty() {
            let words = format!("{beam_kvp:.0} kVp{behind}");
            return Some(at_exposure(index, beam, tags, beam.air_value_per_mas, &words));
        }
        // Tube output is close to a power of the voltage between two that were measured with the same filter.
        let nearest = |above: bool| {
            let same = alike.iter().filter(|other| other.filter == beam.filter);
            let side = same.filter(|b| b.tube_kvp.is_some_and(|v| (v > kvp) == above) && b.air_value_per_mas.is_some());
            side.min_by(|a, b| distance(a).total_cmp(&distance(b))).copied()
        };
        let (Some(below), Some(above)) = (nearest(false), nearest(true)) else {
            let reason = format!(
                "the frame was taken at {kvp:.0} kVp, the calibration ends at {beam_kvp:.0} kVp{behind}; calibrate this voltage"
            );
            return Some(unknown(&reason, None));
        };
        let ends = [below, above].map(|b| [b.tube_kvp, b.air_value_per_mas].map(|v| v.unwrap_or(f64::NAN).ln()));
        let share = (kvp.ln() - ends[0][0]) / (ends[1][0] - ends[0][0]);
        let per_mas = (ends[0][1] + share * (ends[1][1] - ends[0][1])).exp();
        let words = format!("between {:.0} and {:.0} kVp{behind}", ends[0][0].exp(), ends[1][0].exp());
        let mut chosen = at_exposure(index, beam, tags, Some(per_mas).filter(|value| value.is_finite()), &words);
        chosen.relative_sigma = chosen.relative_sigma.hypot(INTERPOLATED_SIGMA);
        Some(chosen)
    }
}

/// Each once, in their order.
fn list(words: impl Iterator<Item = String>) -> String {
    let mut each: Vec<String> = Vec::new();
    for words in words {
        if !each.contains(&words) {
            each.push(words);
        }
    }
    each.join(", ")
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
    ChosenBeam { index, air_value, relative_sigma, evidence, doubt: None }
}
