//! Round numbers along an axis.

/// How a value becomes a position.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Scale {
    /// Equal differences, equal lengths.
    #[default]
    Linear,
    /// Equal ratios, equal lengths; values must be positive.
    Log,
}

impl Scale {
    /// Whether `value` has a place on such an axis.
    #[must_use]
    pub fn can_show(self, value: f64) -> bool {
        value.is_finite() && (self == Self::Linear || value > 0.0)
    }

    /// Position of `value` between `range`'s ends, 0 to 1 inside it.
    #[must_use]
    pub fn fraction(self, value: f64, range: [f64; 2]) -> f64 {
        match self {
            Self::Linear => (value - range[0]) / (range[1] - range[0]),
            Self::Log => (value / range[0]).ln() / (range[1] / range[0]).ln(),
        }
    }
}

/// A labelled position.
#[derive(Clone, Debug, PartialEq)]
pub struct Tick {
    /// Where, in the axis's unit.
    pub value: f64,
    /// What is written there; empty for a line without a number.
    pub label: String,
}

/// Range that contains `low..=high` and ends at ticks, of which it holds about `count` (linear), or at 1, 2 or 5 times a power of ten
/// (logarithmic). Both finite, `low <= high`, positive on a logarithmic scale.
#[must_use]
pub fn round_range(scale: Scale, low: f64, high: f64, count: usize) -> [f64; 2] {
    match scale {
        Scale::Linear => {
            // A constant gets an axis around it; a hair above the data's own rounding.
            let spread = if high - low > 1e-12 * low.abs().max(high.abs()) { high - low } else { low.abs().max(1.0) };
            let step = round_step(spread, count);
            let (first, last) = ((low / step + 1e-9).floor() * step, (high / step - 1e-9).ceil() * step);
            if last > first { [first, last] } else { [first - step, last + step] }
        }
        Scale::Log => {
            let (first, last) = (below(low * (1.0 + 1e-9)), above(high * (1.0 - 1e-9)));
            if last > first * 1.001 { [first, last] } else { [first / 2.0, last * 2.0] }
        }
    }
}

/// Ticks within `range`: about `count` on a linear scale; on a logarithmic one a labelled tick a decade, with 2 and 5 between when there are few
/// decades.
#[must_use]
pub fn ticks(scale: Scale, range: [f64; 2], count: usize) -> Vec<Tick> {
    match scale {
        Scale::Linear => {
            let step = round_step(range[1] - range[0], count);
            let decimals = (-(step * 1.000_001).log10().floor()).max(0.0) as usize;
            let far = range[0].abs().max(range[1].abs());
            let label = |value: f64| {
                if !(1e-4..1e6).contains(&far) { trimmed_exponent(value) } else { format!("{value:.decimals$}") }
            };
            round_values(range, count).into_iter().map(|value| Tick { value, label: label(value) }).collect()
        }
        Scale::Log => {
            let (first, last) = (range[0].log10().floor() as i32, range[1].log10().ceil() as i32);
            let span = (range[1] / range[0]).log10();
            let every = ((span / 8.0).ceil() as i32).max(1);
            let mut found = Vec::new();
            for exponent in first..=last {
                for digit in [1.0, 2.0, 5.0] {
                    let value = digit * 10f64.powi(exponent);
                    if value < range[0] * (1.0 - 1e-9) || value > range[1] * (1.0 + 1e-9) || (digit > 1.0 && every > 1) {
                        continue;
                    }
                    let labelled = if digit > 1.0 { span <= 3.0 } else { exponent % every == 0 };
                    found.push(Tick { value, label: if labelled { power_label(value) } else { String::new() } });
                }
            }
            found
        }
    }
}

/// Round values within `range`, about `count` of them: multiples of 1, 2 or 5 times a power of ten. The ends are finite, the first the lower.
fn round_values(range: [f64; 2], count: usize) -> Vec<f64> {
    let step = round_step(range[1] - range[0], count);
    let (first, last) = ((range[0] / step - 1e-6).ceil() as i64, (range[1] / step + 1e-6).floor() as i64);
    (first..=last).map(|i| i as f64 * step).collect()
}

/// The largest of 1, 2, 5 times a power of ten that is not above `value`; 1 where there is none.
#[must_use]
pub fn round_down(value: f64) -> f64 {
    if value > 0.0 && value.is_finite() { below(value) } else { 1.0 }
}

/// 1, 2 or 5 times a power of ten, such that `spread` holds about `count` of them: 0.7 to 1.75 times as many.
fn round_step(spread: f64, count: usize) -> f64 {
    let raw = spread / count as f64;
    let power = 10f64.powf(raw.log10().floor());
    let digit = raw / power;
    power
        * if digit < 1.5 {
            1.0
        } else if digit < 3.5 {
            2.0
        } else if digit < 7.5 {
            5.0
        } else {
            10.0
        }
}

/// Largest of 1, 2, 5 times a power of ten that is not above `value`.
fn below(value: f64) -> f64 {
    let power = 10f64.powf(value.log10().floor());
    [5.0, 2.0].into_iter().find(|digit| digit * power <= value).unwrap_or(1.0) * power
}

/// Smallest of 1, 2, 5, 10 times a power of ten that is not below `value`.
fn above(value: f64) -> f64 {
    let power = 10f64.powf(value.log10().floor());
    [1.0, 2.0, 5.0].into_iter().find(|digit| digit * power >= value).unwrap_or(10.0) * power
}

fn power_label(value: f64) -> String {
    if (1e-4..1e5).contains(&value) {
        let decimals = (-(value * 1.000_001).log10().floor()).max(0.0) as usize;
        format!("{value:.decimals$}")
    } else {
        trimmed_exponent(value)
    }
}

/// `2e-5`, `1.5e6`.
fn trimmed_exponent(value: f64) -> String {
    let text = format!("{value:.3e}");
    let Some((digits, exponent)) = text.split_once('e') else { return text };
    let digits = digits.trim_end_matches('0').trim_end_matches('.');
    if digits == "0" || digits == "-0" { "0".to_owned() } else { format!("{digits}e{exponent}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(scale: Scale, range: [f64; 2]) -> Vec<String> {
        ticks(scale, range, 6).into_iter().map(|tick| tick.label).collect()
    }

    #[test]
    fn linear_ticks_are_round() {
        assert_eq!(labels(Scale::Linear, [0.0, 120.0]), ["0", "20", "40", "60", "80", "100", "120"]);
        assert_eq!(labels(Scale::Linear, [0.0, 0.03]), ["0.000", "0.005", "0.010", "0.015", "0.020", "0.025", "0.030"]);
        assert_eq!(labels(Scale::Linear, [-1.0, 1.0])[0], "-1.0");
        assert_eq!(labels(Scale::Linear, [0.0, 6e6]), ["0", "1e6", "2e6", "3e6", "4e6", "5e6", "6e6"]);
    }

    #[test]
    fn round_values_lie_within_and_are_about_as_many_as_wanted() {
        assert_eq!(round_values([0.0, 20.0], 8), [0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0, 16.0, 18.0, 20.0]);
        let mut cases = 0;
        for count in [4, 6, 8] {
            for range in [[0.03, 0.98], [-7.0, 31.0], [1.0e6, 1.7e6], [-0.002, -0.001], [0.0, 1.08 * 341.0]] {
                let found = round_values(range, count);
                let hair = 1e-9 * (range[1] - range[0]);
                assert!(found.iter().all(|v| *v > range[0] - hair && *v < range[1] + hair), "{range:?}: {found:?}");
                let (wanted, found) = (count as f64, found.len() as f64);
                assert!(found >= 0.7 * wanted - 1.0 && found <= 1.75 * wanted + 1.0, "{count} in {range:?}: {found}");
                cases += 1;
            }
        }
        assert_eq!(cases, 15);
    }

    #[test]
    fn lengths_are_rounded_down() {
        let cases = [(18.6, 10.0), (46.5, 20.0), (5.0, 5.0), (0.49, 0.2), (20.0, 20.0), (f64::NAN, 1.0), (0.0, 1.0)];
        for (value, round) in cases {
            assert!((round_down(value) - round).abs() < 1e-12, "{value}: {}", round_down(value));
        }
    }

    #[test]
    fn logarithmic_ticks_are_decades() {
        assert_eq!(labels(Scale::Log, [1.0, 100.0]), ["1", "2", "5", "10", "20", "50", "100"]);
        let many = ticks(Scale::Log, [1e-12, 1e12], 6);
        assert!(many.len() < 30 && many.iter().filter(|tick| !tick.label.is_empty()).count() <= 9, "{}", many.len());
    }

    #[test]
    fn ranges_contain_the_data_even_when_it_is_constant() {
        let mut cases = 0;
        for (low, high) in [(0.0, 0.0), (3.7, 3.7), (0.013, 97.0), (1.0, 150.0), (1e-9, 1e9), (5.0, 5.000_000_000_000_1)] {
            for scale in [Scale::Linear, Scale::Log] {
                if !scale.can_show(low) {
                    continue;
                }
                let [first, last] = round_range(scale, low, high, 6);
                assert!(
                    first < last && first <= low * (1.0 + 1e-8) && last >= high * (1.0 - 1e-8),
                    "{scale:?} {low} {high}: {first} {last}"
                );
                assert!((0.0..=1.0 + 1e-8).contains(&(scale.fraction(low, [first, last]) + 1e-9)));
                cases += 1;
            }
        }
        assert_eq!(cases, 11);
        assert!(!Scale::Log.can_show(0.0) && !Scale::Linear.can_show(f64::NAN));
    }
}
