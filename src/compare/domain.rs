//! Brings the acquired frame into the domain in which it can be compared: nepers where the domain and the air level allow it.

use super::filters::{each, erode, median_and_spread};
use super::pedestal::{self, OffsetReport, OffsetRule};
use crate::acquire::{Domain, Frame};
use crate::image::{Image, quantile};

/// How the air level (the signal with nothing in the beam) is known.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum AirLevel {
    /// From pixels which the simulation predicts to be in air (simulated intensity above 0.999); unknown when there are too few.
    #[default]
    Open,
    /// The paper's rule: the highest value is N₀. Flagged, because in a frame without open air it errs a hundredfold.
    Maximum,
    /// Measured elsewhere, in the frame's own unit.
    Value(f64),
    /// Not known.
    Unknown,
}

impl std::str::FromStr for AirLevel {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        match word {
            "open" => Ok(Self::Open),
            "maximum" => Ok(Self::Maximum),
            "unknown" => Ok(Self::Unknown),
            number => match number.parse::<f64>() {
                Ok(value) if value.is_finite() => Ok(Self::Value(value)),
                _ => Err(format!("air level '{number}' is none of open, maximum, unknown or a number")),
            },
        }
    }
}

/// The domain in which the two images were compared; larger is more attenuation in each.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CommonDomain {
    /// −ln(signal / air level), in nepers.
    LineIntegral,
    /// A line integral whose offset (and, for some log frames, scale) is not known.
    RelativeLineIntegral,
    /// Gray values of a display image: an unknown monotone function of the line integral.
    GrayValues,
}

/// The air level that was used, and where it came from.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct AirReport {
    /// `open`, `maximum`, `value`, `calibration`, `file` (the frame says so itself) or `unknown`.
    pub rule: String,
    /// In the frame's unit, offset subtracted; `None` when unknown.
    pub level: Option<f64>,
    /// Pixels that it rests on, for `open`.
    pub pixels: Option<usize>,
    /// Robust standard deviation of those pixels relative to the level (linear) or in the frame's unit (log).
    pub spread: Option<f64>,
    /// Why it is unknown, or what to beware of.
    pub reason: Option<String>,
    /// The stored value without X-rays that was subtracted; `None` for frames that are not linear.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub offset: Option<OffsetReport>,
}

/// A declared air level that the frame itself contradicts.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
#[error(
    "air level {level:?} is not the signal with nothing in the beam: the frame's own values are {low} to {high}; measure it without specimen, \
     or leave it out"
)]
pub struct AirContradiction {
    /// Declared, a stored value.
    pub level: f64,
    /// Smallest stored value of a usable pixel.
    pub low: f32,
    /// Largest stored value of a usable pixel.
    pub high: f32,
}

/// Simulated line integrals below this are open air: intensity above 0.999.
const OPEN_AIR_NEPERS: f32 = 1.0005e-3;
/// An open-air level needs at least this many pixels…
const OPEN_AIR_PIXELS: usize = 200;
/// … this far (in pixels, both ways) from anything that the simulation sees.
const OPEN_AIR_MARGIN: usize = 3;
/// The signal in "open air" must be this uniform, or the simulation is wrong about what is open.
const OPEN_AIR_SPREAD: f64 = 0.1;

/// The acquired frame in the common domain.
pub(super) struct Common {
    pub acquired: Image<f32>,
    pub domain: CommonDomain,
    pub air: AirReport,
    /// Pixels without any signal, whose logarithm does not exist.
    pub no_signal: Image<bool>,
}

/// The evidence for air level and offset.
pub(super) struct Evidence<'a> {
    /// Pixels that are neither masked nor invalid so far; only they may carry the air level.
    pub usable: &'a Image<bool>,
    /// The collimated area.
    pub shuttered: Option<&'a Image<bool>>,
    /// Pixels that no cause but collimation takes.
    pub clean: &'a Image<bool>,
    pub air: AirLevel,
    pub offset: OffsetRule,
}

pub(super) fn into_common(
    frame: &Frame,
    pixels: &Image<f32>,
    simulated: &Image<f32>,
    evidence: &Evidence,
) -> Result<Common, AirContradiction> {
    let Evidence { usable, air: rule, .. } = *evidence;
    let never = Image::filled(pixels.width, pixels.height, false);
    Ok(match frame.domain {
        Domain::Linear => {
            let offset = offset_report(frame, pixels, simulated, evidence);
            let subtracted;
            let signal = if offset.is_subtracted_here() {
                subtracted = each(pixels, |&v| (f64::from(v) - offset.value) as f32);
                &subtracted
            } else {
                pixels
            };
            // A declared air level is a stored value, as a person reads it; it stands on the same offset as the frame.
            let rule = match rule {
                AirLevel::Value(value) => {
                    let value = as_turned(frame, value);
                    check_level(value, offset.value, signal, usable)?;
                    AirLevel::Value(value - offset.value)
                }
                other => other,
            };
            let mut air = match guessed_zero(frame, &offset, evidence.offset) {
                Some(reason) => unknown_air(&reason),
                None => linear_air(frame, signal, simulated, usable, rule),
            };
            air.offset = Some(offset);
            let reference = air.level.unwrap_or(1.0);
            Common {
                acquired: each(signal, |&v| if v > 0.0 { -(f64::from(v) / reference).ln() as f32 } else { f32::NAN }),
                domain: if air.level.is_some() { CommonDomain::LineIntegral } else { CommonDomain::RelativeLineIntegral },
                air,
                no_signal: each(signal, |&v| v <= 0.0),
            }
        }
        Domain::Log => {
            let in_nepers = frame.unit.as_deref() == Some("neper");
            let mut air = air_report(pixels, simulated, usable, rule, in_nepers.then_some(0.0), false);
            if !in_nepers {
                air.reason = Some("the frame's logarithmic scale has no unit, so nepers cannot be claimed".into());
            }
            let offset = air.level.unwrap_or(0.0);
            let absolute = in_nepers && air.level.is_some();
            Common {
                acquired: each(pixels, |&v| (f64::from(v) - offset) as f32),
                domain: if absolute { CommonDomain::LineIntegral } else { CommonDomain::RelativeLineIntegral },
                air,
                no_signal: never,
            }
        }
        Domain::Display | Domain::Unknown => Common {
            // Display images are brighter where there is more signal; of unknown ones the polarity is found later, and said.
            acquired: pixels.map(|&v| -v),
            domain: CommonDomain::GrayValues,
            air: unknown_air(&format!("domain is {}: gray values have no air level", frame.domain)),
            no_signal: never,
        },
    })
}

/// Bright pixels behind nothing read as much as air does, but for heel, gain and scatter: never ten times as much.
const BRIGHTER_THAN_AIR: f64 = 10.0;
/// Behind twenty nepers not a photon of any exposure is left.
const DARKER_THAN_AIR: f64 = 1e9;

/// Refuses a declared air level, a stored value, that the frame's own pixels contradict; `offset` is subtracted from `signal`.
fn check_level(declared: f64, offset: f64, signal: &Image<f32>, usable: &Image<bool>) -> Result<(), AirContradiction> {
    let at_usable = signal.pixels.iter().zip(&usable.pixels).filter(|(value, usable)| **usable && **value > 0.0);
    let mut values: Vec<f32> = at_usable.map(|(value, _)| *value).filter(|value| value.is_finite()).collect();
    let Some(bright) = quantile(&mut values, 0.99) else { return Ok(()) };
    let level = declared - offset;
    // What is not positive has no logarithm.
    if level > 0.0 && level * BRIGHTER_THAN_AIR >= bright && level <= bright * DARKER_THAN_AIR {
        return Ok(());
    }
    let [low, high] = values.iter().fold([f32::MAX, f32::MIN], |[low, high], value| [low.min(*value), high.max(*value)]);
    let stored = |value: f32| (f64::from(value) + offset) as f32;
    Err(AirContradiction { level: declared, low: stored(low), high: stored(high) })
}

fn unknown_air(reason: &str) -> AirReport {
    AirReport { rule: "unknown".into(), level: None, pixels: None, spread: None, reason: Some(reason.to_owned()), offset: None }
}

/// A stored value as the frame holds it: values that grow with attenuation were turned round at import.
fn as_turned(frame: &Frame, stored: f64) -> f64 {
    frame.turned_about.map_or(stored, |ends| ends - stored)
}

/// Why nobody knows at which value of a frame that was turned round there is no signal. Its logarithm hangs on that: 14 bits of data in 16
/// bits stored would put it 49152 too high.
fn guessed_zero(frame: &Frame, offset: &OffsetReport, asked: OffsetRule) -> Option<String> {
    let is_known = offset.rule != "none" || offset.zero_seen || asked == OffsetRule::None;
    (frame.inverted && frame.unit.is_none() && !is_known).then(|| {
        "larger stored values mean fewer X-rays, and neither a tag nor a shuttered area says which of them means none; give that stored value \
         as --offset VALUE, or --offset none where it is the largest that can be stored"
            .to_owned()
    })
}

/// The offset of a linear frame; a calibration's was subtracted at import.
fn offset_report(frame: &Frame, pixels: &Image<f32>, simulated: &Image<f32>, evidence: &Evidence) -> OffsetReport {
    let calibrated = frame.correction.as_ref().and_then(|correction| correction.offset_value);
    if let Some(value) = calibrated {
        return OffsetReport::known("calibration", value);
    }
    match evidence.offset {
        OffsetRule::Value(value) => OffsetReport::known("value", as_turned(frame, value)),
        OffsetRule::None => OffsetReport::none("declared: none"),
        OffsetRule::Shutters if frame.unit.is_some() => OffsetReport::none("the frame's unit says that its values start at zero"),
        OffsetRule::Shutters => pedestal::from_shutters(pixels, simulated, evidence.shuttered, evidence.clean, evidence.usable),
    }
}

/// Open air that differs by more than this from the calibration's air level is said.
const AIR_AGREES: f64 = 0.05;

/// The air level of a linear frame: the calibration's where it has one and the person names no other rule.
fn linear_air(frame: &Frame, signal: &Image<f32>, simulated: &Image<f32>, usable: &Image<bool>, rule: AirLevel) -> AirReport {
    let by_file = if frame.unit.as_deref() == Some("1") { Some(1.0) } else { None };
    let calibration = frame.correction.as_ref().filter(|correction| correction.offset_value.is_some());
    let (Some(calibration), AirLevel::Open) = (calibration, rule) else {
        return air_report(signal, simulated, usable, rule, by_file, true);
    };
    let open = air_report(signal, simulated, usable, rule, None, true);
    let Some(level) = calibration.air_value else {
        let reason = match (&open.level, &open.reason) {
            (None, Some(reason)) => format!("{}; {reason}", calibration.air_evidence),
            _ => calibration.air_evidence.clone(),
        };
        return AirReport { reason: Some(reason), ..open };
    };
    let mut reason = calibration.air_evidence.clone();
    if let Some(seen) = open.level.filter(|seen| !((seen / level - 1.0).abs() <= AIR_AGREES)) {
        reason = format!(
            "{reason}; but open air in this frame reads {:.3} of that: another exposure, filter or distance than the file says",
            seen / level
        );
    }
    AirReport {
        rule: "calibration".into(),
        level: Some(level),
        pixels: open.pixels,
        spread: calibration.air_relative_sigma,
        reason: Some(reason),
        offset: None,
    }
}

/// `by_file`: the level that the frame's own unit implies. `signal`: larger is more signal (linear), not more attenuation (log).
fn air_report(
    pixels: &Image<f32>,
    simulated: &Image<f32>,
    usable: &Image<bool>,
    rule: AirLevel,
    by_file: Option<f64>,
    signal: bool,
) -> AirReport {
    let known = |rule: &str, level: f64, reason: Option<&str>| AirReport {
        rule: rule.into(),
        level: Some(level),
        pixels: None,
        spread: None,
        reason: reason.map(str::to_owned),
        offset: None,
    };
    match rule {
        AirLevel::Value(value) if !signal || value > 0.0 => known("value", value, None),
        AirLevel::Value(value) => unknown_air(&format!("air level {value} is not positive, so it has no logarithm")),
        AirLevel::Maximum => {
            let values =
                pixels.pixels.iter().zip(&usable.pixels).filter(|(v, u)| **u && v.is_finite()).map(|(v, _)| f64::from(*v));
            let extreme = if signal { values.fold(f64::NAN, f64::max) } else { values.fold(f64::NAN, f64::min) };
            if extreme.is_finite() && (extreme > 0.0 || !signal) {
                known(
                    "maximum",
                    extreme,
                    Some("the highest signal is taken as air: without open air in the frame this errs a hundredfold"),
                )
            } else {
                unknown_air("the frame's highest signal is not positive")
            }
        }
        AirLevel::Unknown => unknown_air("declared unknown"),
        AirLevel::Open => match by_file {
            Some(level) => known("file", level, None),
            None => open_air(pixels, simulated, usable, signal),
        },
    }
}

fn open_air(pixels: &Image<f32>, simulated: &Image<f32>, usable: &Image<bool>, signal: bool) -> AirReport {
    let open = simulated.map(|&l| l < OPEN_AIR_NEPERS);
    let deep = erode(&open, OPEN_AIR_MARGIN);
    let is_open = |at: &usize| deep.pixels[*at] && pixels.pixels[*at].is_finite();
    let (seen, masked): (Vec<usize>, Vec<usize>) = (0..pixels.pixels.len()).filter(is_open).partition(|at| usable.pixels[*at]);
    let mut values: Vec<f32> = seen.into_iter().map(|at| pixels.pixels[at]).collect();
    let count = values.len();
    if count < OPEN_AIR_PIXELS {
        let why = masked_words(pixels, &masked, signal);
        return unknown_air(&format!(
            "{count} usable pixels are open air according to the simulation{why}, {OPEN_AIR_PIXELS} are needed; measure it without specimen and say it (--air, a session's \"air_level\")"
        ));
    }
    let Some((level, spread)) = median_and_spread(&mut values) else {
        return unknown_air("no open air");
    };
    if signal && !(level > 0.0) {
        return unknown_air(&format!(
            "the {count} pixels that the simulation predicts to be open air hold no signal in the frame (median {level}): is it inverted, or are pose or field wrong?"
        ));
    }
    if signal && !(spread <= OPEN_AIR_SPREAD * level) {
        return unknown_air(&format!(
            "the {count} pixels that the simulation predicts to be open air vary by {:.0} % in the frame (limit {:.0} %): pose or field disagree",
            100.0 * spread / level,
            100.0 * OPEN_AIR_SPREAD
        ));
    }
    let spread = if signal { spread / level } else { spread };
    AirReport { rule: "open".into(), level: Some(level), pixels: Some(count), spread: Some(spread), reason: None, offset: None }
}

/// What to add where pixels that should be open air are masked: how many, and how many of those hold the frame's brightest value.
fn masked_words(pixels: &Image<f32>, masked: &[usize], signal: bool) -> String {
    if masked.is_empty() {
        return String::new();
    }
    // Nepers fall with the signal.
    let brightness = |at: usize| if signal { pixels.pixels[at] } else { -pixels.pixels[at] };
    let brightest = (0..pixels.pixels.len()).map(brightness).filter(|value| value.is_finite()).fold(f32::NEG_INFINITY, f32::max);
    let at_end = masked.iter().filter(|at| brightness(**at) >= brightest).count();
    // One may be a dead pixel.
    let saturated = if 2 * at_end > masked.len() {
        format!(", {at_end} of them at the frame's brightest value: saturated?")
    } else {
        String::new()
    };
    format!(" ({} more are masked{saturated})", masked.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn image<T: Clone>(value: T) -> Image<T> {
        Image { width: 40, height: 40, pixels: vec![value; 1600] }
    }

    /// A frame saturated in open air was said to have none; an inverted one, 0 in open air, to "vary by NaN %".
    #[test]
    fn open_air_that_is_saturated_or_dark_is_said_to_be_that() {
        let said = |value: f32, usable: bool| {
            let report = open_air(&image(value), &image(0.0), &image(usable), true);
            (report.level, report.reason.unwrap_or_default())
        };
        assert_eq!(said(900.0, true), (Some(900.0), String::new()), "the control");
        let (level, words) = said(65535.0, false);
        assert!(level.is_none() && words.starts_with("0 usable pixels") && words.contains("saturated?"), "{words}");
        assert!(words.contains(" more are masked, ") && words.contains(" of them at the frame's brightest value"), "{words}");
        let (level, words) = said(0.0, true);
        assert!(level.is_none() && words.contains("hold no signal") && words.contains("inverted"), "{words}");
        assert!(!words.contains("NaN"), "{words}");
    }
}
