//! Air frames sorted by tube voltage, filter and exposure.

use super::error::DetectorError;
use super::measurement::PanelFrame;
use crate::acquire::{AddedFilter, ExposureLevel, Likeness};
use crate::image::quantile;

/// What an air map holds for.
#[derive(Clone, Debug)]
pub(super) struct Beam {
    pub kvp: Option<f64>,
    pub filter: Option<AddedFilter>,
}

/// Frames of one beam; saturated levels are counted, not kept.
pub(super) struct Group<'a> {
    pub beam: Beam,
    pub frames: Vec<&'a PanelFrame>,
    pub saturated: Vec<ExposureLevel>,
    pub left_out: Vec<String>,
}

/// Voltages this close are one.
const SAME_KVP: f64 = 0.6;
/// A frame with a larger share of saturated pixels is not used.
const MOST_SATURATED: f64 = 1e-3;

impl Beam {
    fn is_of(&self, frame: &PanelFrame) -> bool {
        let same_kvp = match (self.kvp, frame.tube_kvp) {
            (Some(a), Some(b)) => (a - b).abs() <= SAME_KVP,
            (None, None) => true,
            _ => false,
        };
        let same_filter = match (&self.filter, &frame.filter) {
            (Some(a), Some(b)) => a.likeness(b) == Likeness::Same,
            (None, None) => true,
            _ => false,
        };
        same_kvp && same_filter
    }

    /// `90 kVp`, or that it is not stated, with the filter where that is.
    pub(super) fn words(&self) -> String {
        let kvp = self.kvp.map_or_else(|| "a tube voltage that is not stated".to_owned(), |kvp| format!("{kvp:.0} kVp"));
        match &self.filter {
            Some(filter) => format!("{kvp} with {}", filter.words()),
            None => kvp,
        }
    }
}

pub(super) fn group(air: &[PanelFrame], saturation: Option<f64>) -> Result<Vec<Group<'_>>, DetectorError> {
    stated_by_all_or_none(air, "tube voltage", |frame| frame.tube_kvp.is_some())?;
    stated_by_all_or_none(air, "mAs", |frame| frame.exposure_mas.is_some())?;
    stated_by_all_or_none(air, "added filter", |frame| frame.filter.is_some())?;
    let mut groups: Vec<Group> = Vec::new();
    for frame in air {
        let share = saturated_share(frame, saturation);
        let known = groups.iter().position(|group| group.beam.is_of(frame));
        let at = known.unwrap_or_else(|| {
            let beam = Beam { kvp: frame.tube_kvp, filter: frame.filter.clone() };
            groups.push(Group { beam, frames: Vec::new(), saturated: Vec::new(), left_out: Vec::new() });
            groups.len() - 1
        });
        let group = &mut groups[at];
        if share > MOST_SATURATED {
            group.left_out.push(format!("{}: {:.1} % of its pixels are saturated", frame.label, 100.0 * share));
            group.saturated.push(ExposureLevel {
                exposure_mas: frame.exposure_mas,
                frames: 1,
                air_value: median(frame.pixels.pixels.clone()),
                quanta_per_pixel: None,
                saturated_share: share,
            });
        } else {
            group.frames.push(frame);
        }
    }
    groups.sort_by(|a, b| a.beam.kvp.unwrap_or(0.0).total_cmp(&b.beam.kvp.unwrap_or(0.0)));
    for group in &groups {
        if group.frames.is_empty() {
            let share = group.saturated.iter().map(|level| level.saturated_share).fold(1.0, f64::min);
            return Err(DetectorError::Saturated { beam: group.beam.words(), share: 100.0 * share });
        }
    }
    Ok(groups)
}

fn stated_by_all_or_none(
    air: &[PanelFrame],
    what: &'static str,
    is_stated: impl Fn(&PanelFrame) -> bool,
) -> Result<(), DetectorError> {
    let silent = air.iter().find(|frame| !is_stated(frame));
    match silent {
        Some(frame) if air.iter().any(&is_stated) => Err(DetectorError::NotStated { label: frame.label.clone(), what }),
        _ => Ok(()),
    }
}

fn saturated_share(frame: &PanelFrame, saturation: Option<f64>) -> f64 {
    let Some(end) = saturation else { return 0.0 };
    frame.pixels.pixels.iter().filter(|v| f64::from(**v) >= end).count() as f64 / frame.pixels.pixels.len() as f64
}

/// The middle value; 0 of nothing.
pub(super) fn median(mut values: Vec<f32>) -> f64 {
    quantile(&mut values, 0.5).unwrap_or(0.0)
}

/// Median, and the standard deviation that the median absolute deviation of a normal distribution has.
pub(super) fn median_and_deviation(values: &[f64]) -> (f64, f64) {
    let middle = |values: &mut [f64]| {
        if values.is_empty() {
            return 0.0;
        }
        let (at, even) = (values.len() / 2, values.len().is_multiple_of(2));
        values.sort_by(f64::total_cmp);
        if even { 0.5 * (values[at - 1] + values[at]) } else { values[at] }
    };
    let centre = middle(&mut values.to_vec());
    let mut deviations: Vec<f64> = values.iter().map(|value| (value - centre).abs()).collect();
    (centre, 1.4826 * middle(&mut deviations))
}
