//! Air frames sorted by tube voltage and exposure.

use super::error::{DetectorError, kvp_words};
use super::measurement::PanelFrame;
use crate::acquire::ExposureLevel;

/// Frames of one tube voltage; saturated levels are counted, not kept.
pub(super) struct Group<'a> {
    pub kvp: Option<f64>,
    pub frames: Vec<&'a PanelFrame>,
    pub saturated: Vec<ExposureLevel>,
    pub left_out: Vec<String>,
}

/// Voltages this close are one.
const SAME_KVP: f64 = 0.6;
/// A frame with a larger share of saturated pixels is not used.
const MOST_SATURATED: f64 = 1e-3;

pub(super) fn group(air: &[PanelFrame], saturation: Option<f64>) -> Result<Vec<Group<'_>>, DetectorError> {
    stated_by_all_or_none(air, "tube voltage", |frame| frame.tube_kvp)?;
    stated_by_all_or_none(air, "mAs", |frame| frame.exposure_mas)?;
    let mut groups: Vec<Group> = Vec::new();
    for frame in air {
        let same = |group: &&mut Group| match (group.kvp, frame.tube_kvp) {
            (Some(a), Some(b)) => (a - b).abs() <= SAME_KVP,
            (None, None) => true,
            _ => false,
        };
        let share = saturated_share(frame, saturation);
        let found = groups.iter_mut().find(same);
        let group = match found {
            Some(group) => group,
            None => {
                groups.push(Group { kvp: frame.tube_kvp, frames: Vec::new(), saturated: Vec::new(), left_out: Vec::new() });
                let last = groups.len() - 1;
                &mut groups[last]
            }
        };
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
    groups.sort_by(|a, b| a.kvp.unwrap_or(0.0).total_cmp(&b.kvp.unwrap_or(0.0)));
    for group in &groups {
        if group.frames.is_empty() {
            let share = group.saturated.iter().map(|level| level.saturated_share).fold(1.0, f64::min);
            return Err(DetectorError::Saturated { kvp: kvp_words(group.kvp), share: 100.0 * share });
        }
    }
    Ok(groups)
}

fn stated_by_all_or_none(
    air: &[PanelFrame],
    what: &'static str,
    value: impl Fn(&PanelFrame) -> Option<f64>,
) -> Result<(), DetectorError> {
    let silent = air.iter().find(|frame| value(frame).is_none());
    match silent {
        Some(frame) if air.iter().any(|frame| value(frame).is_some()) => {
            Err(DetectorError::NotStated { label: frame.label.clone(), what })
        }
        _ => Ok(()),
    }
}

fn saturated_share(frame: &PanelFrame, saturation: Option<f64>) -> f64 {
    let Some(end) = saturation else { return 0.0 };
    frame.pixels.pixels.iter().filter(|v| f64::from(**v) >= end).count() as f64 / frame.pixels.pixels.len() as f64
}

/// The middle value; 0 of nothing.
pub(super) fn median(mut values: Vec<f32>) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    f64::from(*values.select_nth_unstable_by(middle, f32::total_cmp).1)
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
