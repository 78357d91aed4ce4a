//! The stored value without X-rays, read from the shuttered part of the frame where no calibration gives it.
//!
//! Lead lets a little through: behind the blades a frame reads `pedestal + leak · transmitted share`. The simulation knows the share, so a
//! straight line through the shuttered pixels tells the two apart wherever the specimen varies there. Scatter that reaches the panel
//! behind the blades cannot be told from a pedestal, and is counted in.

use super::filters::erode;
use crate::image::{Image, quantile};

/// What to take for the stored value without X-rays.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum OffsetRule {
    /// The calibration's where the frame has one, else from the shuttered area.
    #[default]
    Shutters,
    /// Measured elsewhere.
    Value(f64),
    /// Zero, unless a calibration was applied.
    None,
}

impl std::str::FromStr for OffsetRule {
    type Err = String;

    fn from_str(word: &str) -> Result<Self, String> {
        match word {
            "shutters" => Ok(Self::Shutters),
            "none" => Ok(Self::None),
            number => match number.parse::<f64>() {
                Ok(value) if value.is_finite() => Ok(Self::Value(value)),
                _ => Err(format!("offset '{number}' is none of shutters, none or a number")),
            },
        }
    }
}

/// The offset that was subtracted, and where it came from.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct OffsetReport {
    /// `calibration`, `shutters`, `value`, or `none` (nothing was subtracted).
    pub rule: String,
    /// Subtracted stored value; 0 for `none`.
    pub value: f64,
    /// Standard deviation of `value`, where it was estimated.
    pub sigma: Option<f64>,
    /// Shuttered pixels that it rests on.
    pub pixels: Option<usize>,
    /// Share of the unattenuated signal that the blades let through, as far as it could be told apart; in stored value.
    pub leak_value: Option<f64>,
    /// What to beware of, or why nothing was subtracted.
    pub reason: Option<String>,
    /// Nothing was subtracted because the shuttered area reads zero.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub zero_seen: bool,
}

impl OffsetReport {
    /// Whether the frame still holds it; a calibration's was subtracted at import.
    pub(super) fn is_subtracted_here(&self) -> bool {
        self.value != 0.0 && self.rule != "calibration"
    }

    pub(super) fn none(reason: &str) -> Self {
        Self { rule: "none".into(), reason: Some(reason.to_owned()), ..Self::default() }
    }

    pub(super) fn known(rule: &str, value: f64) -> Self {
        Self { rule: rule.into(), value, ..Self::default() }
    }
}

/// Distances from the blades' edge that are tried: penumbra and glare reach some way behind it.
const MARGINS_PX: [usize; 3] = [16, 8, 4];
/// A pedestal needs this many pixels.
const FEWEST_PIXELS: usize = 300;
/// Neighbouring pixels share structure: this many count as one in the uncertainty.
const PIXELS_PER_SAMPLE: f64 = 25.0;
/// A pedestal is believed above this many standard deviations …
const BELIEVED_SIGMAS: f64 = 4.0;
/// … and above this share of the frame's brightest signal; electronic noise cut at zero looks like less than that.
const LEAST_SHARE: f64 = 3e-4;
/// Noise about a pedestal does not reach zero; more exact zeros than this are noise about zero, cut off.
const MOST_AT_ZERO: f64 = 0.02;
/// Blades let through at most this share of the unattenuated signal.
const MOST_LEAK: f64 = 2e-3;
/// Transmitted shares that vary less than this behind the blades tell nothing apart.
const LEAST_VARIATION: f64 = 5e-3;

/// `shuttered`: the collimated area; `clean`: pixels that no cause but collimation takes; `usable`: the open field.
pub(super) fn from_shutters(
    pixels: &Image<f32>,
    simulated: &Image<f32>,
    shuttered: Option<&Image<bool>>,
    clean: &Image<bool>,
    usable: &Image<bool>,
) -> OffsetReport {
    let Some(shuttered) = shuttered else {
        return OffsetReport::none("the frame shows no shuttered area to read a pedestal from");
    };
    let mut samples: Vec<[f64; 2]> = Vec::new();
    for margin in MARGINS_PX {
        let deep = erode(shuttered, margin);
        samples = (0..pixels.pixels.len())
            .filter(|&at| deep.pixels[at] && clean.pixels[at] && pixels.pixels[at].is_finite())
            .filter_map(|at| {
                let share = (-f64::from(simulated.pixels[at])).exp();
                share.is_finite().then_some([share.min(1.0), f64::from(pixels.pixels[at])])
            })
            .collect();
        if samples.len() >= FEWEST_PIXELS {
            break;
        }
    }
    if samples.len() < FEWEST_PIXELS {
        return OffsetReport::none(&format!(
            "{} shuttered pixels lie clear of the blades' edges, {FEWEST_PIXELS} are needed for a pedestal",
            samples.len()
        ));
    }
    let at_zero = samples.iter().filter(|sample| sample[1] == 0.0).count() as f64 / samples.len() as f64;
    if at_zero > MOST_AT_ZERO {
        let none = OffsetReport::none(&format!("no pedestal: {:.0} % of the shuttered pixels are exactly 0", 100.0 * at_zero));
        return OffsetReport { zero_seen: true, ..none };
    }
    let mut open: Vec<f32> =
        pixels.pixels.iter().zip(&usable.pixels).filter(|(v, u)| **u && v.is_finite()).map(|(v, _)| *v).collect();
    let brightest = quantile(&mut open, 0.99).unwrap_or(0.0);
    let Some(found) = intercept(&samples, brightest) else {
        return OffsetReport::none("the shuttered area is not uniform enough to read a pedestal from");
    };
    let least = LEAST_SHARE * (brightest - found.value).max(0.0);
    if !(found.value > BELIEVED_SIGMAS * found.sigma && found.value > least) {
        return OffsetReport {
            sigma: Some(found.sigma),
            pixels: Some(samples.len()),
            leak_value: found.leak,
            zero_seen: true,
            ..OffsetReport::none(&format!(
                "no pedestal: the shuttered area reads {} without what the blades let through",
                with_deviation(found.value, found.sigma)
            ))
        };
    }
    OffsetReport {
        rule: "shutters".into(),
        value: found.value,
        sigma: Some(found.sigma),
        pixels: Some(samples.len()),
        leak_value: found.leak,
        reason: Some(match found.leak {
            Some(_) => "estimated behind the shutters; scatter that reaches the panel there is counted in".into(),
            None => "estimated behind the shutters, where the simulation hardly varies: what the blades let through is counted in, as is \
                     scatter"
                .into(),
        }),
        zero_seen: false,
    }
}

/// A value of any unit with its deviation, to two digits of that: `712.3 ± 1.1`, `0.0500 ± 0.0012`.
pub(crate) fn with_deviation(value: f64, sigma: f64) -> String {
    let digits = if sigma > 0.0 && sigma.is_finite() { (1.0 - sigma.log10().floor()).clamp(1.0, 12.0) as usize } else { 6 };
    format!("{value:.digits$} ± {sigma:.digits$}")
}

struct Intercept {
    value: f64,
    sigma: f64,
    /// Slope against the transmitted share, where it could be told.
    leak: Option<f64>,
}

/// Value at a transmitted share of zero: least squares, once more without what lies beyond four robust deviations.
fn intercept(samples: &[[f64; 2]], brightest: f64) -> Option<Intercept> {
    let mut kept: Vec<[f64; 2]> = samples.to_vec();
    let mut line = straight_line(&kept)?;
    // What is rounded to steps is no outlier half a step off; values may be of any unit.
    let half_step = 0.5 * least_step(samples.iter().map(|[_, y]| *y));
    for _ in 0..3 {
        let mut deviations: Vec<f32> = kept.iter().map(|[x, y]| (y - line.at(*x)).abs() as f32).collect();
        let spread = 1.4826 * quantile(&mut deviations, 0.5)?;
        let limit = (4.0 * spread).max(1e-9 * brightest.abs()).max(half_step);
        kept.retain(|[x, y]| (y - line.at(*x)).abs() <= limit);
        line = straight_line(&kept)?;
    }
    if kept.len() * 2 < samples.len() {
        return None;
    }
    let air_at_least = (brightest - line.mean_y).max(0.0);
    let separable = line.deviation_x >= LEAST_VARIATION;
    if separable && line.slope >= 0.0 {
        return Some(Intercept { value: line.at(0.0), sigma: line.sigma_at(0.0), leak: Some(line.slope) });
    }
    // What the blades let through stays unknown, or the line falls, which no leak explains.
    let leak_bound = if line.slope < 0.0 && separable { 0.0 } else { MOST_LEAK * air_at_least * line.mean_x };
    Some(Intercept { value: line.mean_y, sigma: line.sigma_at(line.mean_x).hypot(0.5 * leak_bound), leak: None })
}

/// The smallest step from one value to another; 0 where there is but one.
fn least_step(values: impl Iterator<Item = f64>) -> f64 {
    // Stored values are few, and each occurs many times: one that was met lately is not sorted again.
    let mut lately = vec![f64::NAN.to_bits(); 1 << LATELY_BITS];
    let mut levels: Vec<f64> = Vec::new();
    for value in values {
        let bits = value.to_bits();
        // Fibonacci hashing (Knuth, TAOCP 6.4).
        let place = bits.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> (64 - LATELY_BITS);
        let met = &mut lately[place as usize];
        if *met != bits {
            *met = bits;
            levels.push(value);
        }
    }
    levels.sort_unstable_by(f64::total_cmp);
    let steps = levels.windows(2).map(|two| two[1] - two[0]).filter(|step| *step > 0.0);
    steps.min_by(f64::total_cmp).unwrap_or(0.0)
}

/// Of how many values it is known that they were met lately: 2 to the power of this.
const LATELY_BITS: u32 = 12;

struct Line {
    mean_x: f64,
    mean_y: f64,
    slope: f64,
    deviation_x: f64,
    residual: f64,
    count: f64,
}

impl Line {
    fn at(&self, x: f64) -> f64 {
        self.mean_y + self.slope * (x - self.mean_x)
    }

    fn sigma_at(&self, x: f64) -> f64 {
        let independent = (self.count / PIXELS_PER_SAMPLE).max(1.0);
        let lever = if self.deviation_x > 0.0 { (x - self.mean_x) / self.deviation_x } else { 0.0 };
        self.residual * ((1.0 + lever * lever) / independent).sqrt()
    }
}

fn straight_line(samples: &[[f64; 2]]) -> Option<Line> {
    let count = samples.len() as f64;
    if samples.len() < 8 {
        return None;
    }
    let (sum_x, sum_y) = samples.iter().fold((0.0, 0.0), |(x, y), sample| (x + sample[0], y + sample[1]));
    let (mean_x, mean_y) = (sum_x / count, sum_y / count);
    let (mut xx, mut xy) = (0.0, 0.0);
    for [x, y] in samples {
        xx += (x - mean_x) * (x - mean_x);
        xy += (x - mean_x) * (y - mean_y);
    }
    let slope = if xx > 1e-12 * count { xy / xx } else { 0.0 };
    let squares: f64 = samples.iter().map(|[x, y]| (y - mean_y - slope * (x - mean_x)).powi(2)).sum();
    let line =
        Line { mean_x, mean_y, slope, deviation_x: (xx / count).sqrt(), residual: (squares / (count - 2.0)).sqrt(), count };
    line.mean_y.is_finite().then_some(line)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::{Purpose, Stream};

    /// 200 × 160 px, the left 80 columns behind blades that let through `leak` of an air signal of 50 000; noise of 8.
    fn frame(pedestal: f64, leak: f64, thickness: impl Fn(usize, usize) -> f64) -> [Image<f32>; 2] {
        let mut random = Stream::new(3, 0, 0, Purpose::Evaluation);
        let (mut pixels, mut simulated) = (Image::filled(200, 160, 0.0f32), Image::filled(200, 160, 0.0f32));
        for v in 0..160 {
            for u in 0..200 {
                let line_integral = thickness(u, v);
                let passed = if u < 80 { leak } else { 1.0 };
                let value = pedestal + 50_000.0 * passed * (-line_integral).exp() + 8.0 * random.normal();
                *pixels.at_mut(u, v) = value.round().clamp(0.0, 65_535.0) as f32;
                *simulated.at_mut(u, v) = line_integral as f32;
            }
        }
        [pixels, simulated]
    }

    fn found(pedestal: f64, leak: f64, thickness: impl Fn(usize, usize) -> f64) -> OffsetReport {
        let [pixels, simulated] = frame(pedestal, leak, thickness);
        let mut shuttered = Image::filled(200, 160, false);
        (0..shuttered.pixels.len()).for_each(|at| shuttered.pixels[at] = at % 200 < 80);
        let clean = Image::filled(200, 160, true);
        let usable = shuttered.map(|behind| !behind);
        from_shutters(&pixels, &simulated, Some(&shuttered), &clean, &usable)
    }

    fn varying(u: usize, v: usize) -> f64 {
        2.0 + 1.8 * ((u as f64 * 0.07).sin() * (v as f64 * 0.05).cos())
    }

    #[test]
    fn a_pedestal_is_told_from_what_the_blades_let_through() {
        let report = found(212.0, 1e-3, varying);
        assert!(report.rule == "shutters" && (report.value - 212.0).abs() < 1.5, "{report:?}");
        assert!((report.leak_value.expect("varies") - 50.0).abs() < 8.0, "{report:?}");
        let leak_only = found(0.0, 1e-3, varying);
        assert!(leak_only.rule == "none" && leak_only.value == 0.0 && leak_only.zero_seen, "control: no pedestal, {leak_only:?}");
    }

    /// Readout noise about zero is cut off at zero by unsigned pixels; its mean looked like a pedestal of 0.4 σ.
    #[test]
    fn noise_cut_at_zero_is_no_pedestal() {
        let [pixels, simulated] = frame(0.0, 0.0, varying);
        let noisy = pixels.map(|v| (v * 5.0).clamp(0.0, 65_535.0));
        let mut shuttered = Image::filled(200, 160, false);
        (0..shuttered.pixels.len()).for_each(|at| shuttered.pixels[at] = at % 200 < 80);
        let report =
            from_shutters(&noisy, &simulated, Some(&shuttered), &Image::filled(200, 160, true), &shuttered.map(|behind| !behind));
        assert!(report.rule == "none" && report.reason.as_deref().is_some_and(|why| why.contains("exactly 0")), "{report:?}");
        assert!(report.zero_seen);
        assert!(!OffsetReport::none("the frame shows no shuttered area").zero_seen, "control");
    }

    /// A label behind the blades, in stored values and in shares of the unattenuated signal.
    #[test]
    fn what_is_an_outlier_hangs_on_no_unit() {
        let [mut pixels, simulated] = frame(655.0, 0.0, |_, _| 2.0);
        (0..pixels.pixels.len()).filter(|at| at % 200 < 80 && at / 200 < 18).for_each(|at| pixels.pixels[at] = 19_660.0);
        let mut shuttered = Image::filled(200, 160, false);
        (0..shuttered.pixels.len()).for_each(|at| shuttered.pixels[at] = at % 200 < 80);
        for scale in [1.0, 1.0 / 65_535.0] {
            let pixels = pixels.map(|value| value * scale);
            let clean = Image::filled(200, 160, true);
            let report = from_shutters(&pixels, &simulated, Some(&shuttered), &clean, &shuttered.map(|behind| !behind));
            assert!(report.rule == "shutters" && (report.value / f64::from(scale) - 655.0).abs() < 2.0, "{scale}: {report:?}");
        }
        assert_eq!(with_deviation(0.05, 0.0012), "0.0500 ± 0.0012");
        assert_eq!(with_deviation(655.04, 12.0), "655.0 ± 12.0");
    }

    /// Against the steps between all values in their order.
    #[test]
    fn the_smallest_step_is_that_of_all_values_in_their_order() {
        let mut random = Stream::new(11, 0, 0, Purpose::Evaluation);
        let mut found = Vec::new();
        // Few values many times; more than are kept in mind; all different.
        for (kinds, step) in [(1.0, 1.0), (7.0, 3.0), (90.0, 0.25), (20_000.0, 1.0), (1e9, 1e-3)] {
            let draw = |_| (f64::from(random.next_u32()) / f64::from(u32::MAX) * kinds).floor() * step - 5.0 * step;
            let values: Vec<f64> = (0..30_000).map(draw).collect();
            let mut sorted = values.clone();
            sorted.sort_by(f64::total_cmp);
            let steps = sorted.windows(2).map(|two| two[1] - two[0]).filter(|step| *step > 0.0);
            let expected = steps.min_by(f64::total_cmp).unwrap_or(0.0);
            assert_eq!(least_step(values.into_iter()).to_bits(), expected.to_bits(), "{kinds} values, {step} apart");
            found.push(expected);
        }
        assert_eq!(found[..4], [0.0, 3.0, 0.25, 1.0]);
    }

    #[test]
    fn behind_a_uniform_specimen_the_uncertainty_says_so() {
        let thin = found(400.0, 1e-3, |_, _| 0.3);
        // 37 of the 437 stored are leak; nothing in the frame says so, but the stated uncertainty does.
        assert!(thin.rule == "shutters" && thin.leak_value.is_none(), "{thin:?}");
        let off = thin.value - 400.0;
        assert!(off > 20.0 && off < 3.0 * thin.sigma.expect("estimated"), "{thin:?}");
        let none = found(0.0, 1e-3, |_, _| 0.3);
        assert_eq!(none.rule, "none", "leak alone is no pedestal: {none:?}");
    }
}
