//! The texts of a line into numbers, in the units of the program.

use super::super::line_fault::{LineFault, quoted};
use super::declaration::{CounterSource, FlagSource, SequenceSource, Source, TimeSource};
use super::error::AdapterError;
use super::quantity::Quantity;
use super::split::{Names, Splitter};

/// The texts of a line, and what they are called.
pub(super) struct Texts<'a> {
    pub(super) texts: &'a [Option<String>],
    pub(super) splitter: &'a Splitter,
}

impl Texts<'_> {
    /// Empty texts are none, in every format.
    fn get(&self, index: usize) -> Option<&str> {
        self.texts.get(index)?.as_deref().filter(|text| !text.is_empty())
    }

    fn needed(&self, index: usize, field: &str) -> Result<&str, LineFault> {
        let missing = || LineFault::Missing { field: field.to_owned(), from: self.splitter.name(index).to_owned() };
        self.get(index).ok_or_else(missing)
    }

    /// A finite number: words such as `nan` and `inf` are none.
    fn number(&self, text: &str, field: &str) -> Result<f64, LineFault> {
        let parsed = match self.splitter.decimal_comma {
            // There a point groups thousands, if it is anything.
            true if text.contains('.') => None,
            true => text.replace(',', ".").parse::<f64>().ok(),
            false => text.parse::<f64>().ok(),
        };
        parsed.filter(|value| value.is_finite()).ok_or_else(|| wrong(field, text, "a finite number"))
    }
}

fn wrong(field: &str, found: &str, expected: impl Into<String>) -> LineFault {
    LineFault::Value { field: field.to_owned(), found: quoted(found), expected: expected.into() }
}

/// Where a number comes from.
#[derive(Clone, Debug)]
pub(super) struct Number {
    place: Place,
    field: String,
    /// Sign and scale.
    slope: f64,
    offset: f64,
    /// Of the program's unit in the declared one.
    factor: f64,
    min: f64,
    max: f64,
    unit: String,
    optional: bool,
}

/// Where it stands.
#[derive(Clone, Copy, Debug)]
enum Place {
    /// Among the texts of a line.
    Line(usize),
    /// In the declaration, in the declared unit.
    Declaration(f64),
}

impl Number {
    pub(super) fn new(source: &Source, quantity: Quantity, field: &str, names: &mut Names) -> Result<Self, AdapterError> {
        let at = |key: &str, detail: String| AdapterError::new(format!("{field}.{key}"), detail);
        let factor = quantity.factor(source.unit.as_deref()).map_err(|detail| at("unit", detail))?;
        if !(source.scale.is_finite() && source.scale > 0.0) {
            return Err(at("scale", format!("is {}, expected a positive number; a \"sign\" turns a value round", source.scale)));
        }
        if source.sign.abs() != 1.0 {
            return Err(at("sign", format!("is {}, expected 1 or -1", source.sign)));
        }
        if !source.offset.is_finite() {
            return Err(at("offset", format!("is {}, expected a finite number", source.offset)));
        }
        let (min, max) = (source.min.unwrap_or(f64::NEG_INFINITY), source.max.unwrap_or(f64::INFINITY));
        if !(min < max) {
            return Err(at("min", format!("is {min}, expected less than max, {max}")));
        }
        Ok(Self {
            place: place(source, field, names)?,
            field: field.to_owned(),
            slope: source.sign * source.scale,
            offset: source.offset,
            factor,
            min,
            max,
            unit: source.unit.as_ref().map(|unit| format!(" {unit}")).unwrap_or_default(),
            optional: source.optional,
        })
    }

    /// Whether a line says it.
    pub(super) fn is_read(&self) -> bool {
        matches!(self.place, Place::Line(_))
    }

    /// In the program's unit; NaN where it was not measured and need not be.
    pub(super) fn read(&self, texts: &Texts<'_>) -> Result<f64, LineFault> {
        let index = match self.place {
            Place::Declaration(constant) => return Ok(constant * self.factor),
            Place::Line(index) => index,
        };
        if self.optional && texts.get(index).is_none() {
            return Ok(f64::NAN);
        }
        let text = texts.needed(index, &self.field)?;
        let declared = self.slope * texts.number(text, &self.field)? + self.offset;
        if !(declared >= self.min && declared <= self.max) {
            return Err(wrong(&self.field, text, format!("{} to {}{}", self.min, self.max, self.unit)));
        }
        let value = declared * self.factor;
        if value.is_finite() { Ok(value) } else { Err(wrong(&self.field, text, "a finite number")) }
    }
}

fn place(source: &Source, field: &str, names: &mut Names) -> Result<Place, AdapterError> {
    let constant = match (&source.from, source.constant) {
        (Some(from), None) => return Ok(Place::Line(names.index(from, field))),
        (None, Some(constant)) => constant,
        _ => {
            let detail = "expected one of the keys from and constant: where a line says it, or what it is where none does";
            return Err(AdapterError::new(field, detail));
        }
    };
    let at = |detail: String| AdapterError::new(format!("{field}.constant"), detail);
    if !constant.is_finite() {
        return Err(at(format!("is {constant}, expected a finite number")));
    }
    let plain = Source { from: None, constant: Some(constant), unit: source.unit.clone(), ..Source::default() };
    if *source != plain {
        return Err(at("is the value itself: leave out scale, sign, offset, min, max and optional".to_owned()));
    }
    let unit = source.unit.as_ref().map(|unit| format!(" {unit}")).unwrap_or_default();
    names.constants.push(format!("{field} ({constant}{unit})"));
    Ok(Place::Declaration(constant))
}

/// Where it stands whether something is.
#[derive(Clone, Debug)]
pub(super) struct Flag {
    index: usize,
    field: String,
    on: Vec<String>,
    off: Vec<String>,
}

impl Flag {
    pub(super) fn new(source: &FlagSource, field: &str, names: &mut Names) -> Result<Self, AdapterError> {
        let FlagSource { from, on, off } = source;
        for (key, words) in [("on", on), ("off", off)] {
            if words.is_empty() {
                let detail = "is empty, expected the words that say so";
                return Err(AdapterError::new(format!("{field}.{key}"), detail));
            }
        }
        if let Some(both) = on.iter().find(|word| off.contains(word)) {
            return Err(AdapterError::new(format!("{field}.off"), format!("{both:?} stands under \"on\" as well")));
        }
        Ok(Self { index: names.index(from, field), field: field.to_owned(), on: on.clone(), off: off.clone() })
    }

    pub(super) fn read(&self, texts: &Texts<'_>) -> Result<bool, LineFault> {
        let text = texts.needed(self.index, &self.field)?;
        let is = |words: &[String]| words.iter().any(|word| word == text);
        match (is(&self.on), is(&self.off)) {
            (true, _) => Ok(true),
            (_, true) => Ok(false),
            _ => Err(wrong(&self.field, text, format!("{} or {}", self.on.join(", "), self.off.join(", ")))),
        }
    }
}

/// Where a count comes from that need not be there.
#[derive(Clone, Debug)]
pub(super) struct Counter {
    index: usize,
    field: String,
    none: Vec<String>,
}

impl Counter {
    pub(super) fn new(source: &CounterSource, field: &str, names: &mut Names) -> Self {
        Self { index: names.index(&source.from, field), field: field.to_owned(), none: source.none.clone() }
    }

    pub(super) fn read(&self, texts: &Texts<'_>) -> Result<Option<u32>, LineFault> {
        let is_none = |text: &str| self.none.iter().any(|word| word == text);
        if self.none.iter().any(String::is_empty) && texts.get(self.index).is_none() {
            return Ok(None);
        }
        let text = texts.needed(self.index, &self.field)?;
        if is_none(text) {
            return Ok(None);
        }
        // The largest is none in packets, and what a device writes that has -1 for it.
        let expected = format!("a whole number from 0 to {}", u32::MAX - 1);
        let counter: u32 = text.parse().map_err(|_| wrong(&self.field, text, expected))?;
        Ok(Some(counter).filter(|counter| *counter != u32::MAX))
    }
}

/// A number that begins anew at some value, as it stands in a line.
#[derive(Clone, Debug)]
pub(super) struct Cyclic {
    index: usize,
    field: &'static str,
    /// Of the program's unit in that of the line.
    factor: f64,
    /// Where it begins anew, in the program's unit.
    pub(super) period: Option<i64>,
    /// Fractions are none of it.
    is_whole: bool,
}

/// Larger times are none: 285 years in microseconds.
const LARGEST: f64 = (1u64 << 53) as f64;

impl Cyclic {
    pub(super) fn time(source: &TimeSource, names: &mut Names) -> Result<Self, AdapterError> {
        let factor = Quantity::Time.factor(Some(&source.unit)).map_err(|detail| AdapterError::new("device_time.unit", detail))?;
        let period_us = source.wraps_at.map(|wraps_at| (wraps_at * factor).round());
        // A clock that begins anew every second cannot be followed through a pause.
        if period_us.is_some_and(|period_us| !(1e6..=LARGEST).contains(&period_us)) {
            let detail = format!("is {} {}, expected a second or more", source.wraps_at.unwrap_or_default(), source.unit);
            return Err(AdapterError::new("device_time.wraps_at", detail));
        }
        let field = "device_time";
        let period = period_us.map(|period_us| period_us as i64);
        Ok(Self { index: names.index(&source.from, field), field, factor, period, is_whole: false })
    }

    pub(super) fn sequence(source: &SequenceSource, names: &mut Names) -> Result<Self, AdapterError> {
        let period = source.wraps_at.unwrap_or(1 << 32);
        if !(16..=1 << 32).contains(&period) {
            let detail = format!("is {period}, expected 16 to {}", 1u64 << 32);
            return Err(AdapterError::new("sequence.wraps_at", detail));
        }
        let field = "sequence";
        Ok(Self { index: names.index(&source.from, field), field, factor: 1.0, period: Some(period as i64), is_whole: true })
    }

    /// As it stands in the line, in the program's unit; at least 0, and less than the period.
    pub(super) fn read(&self, texts: &Texts<'_>) -> Result<i64, LineFault> {
        let text = texts.needed(self.index, self.field)?;
        let value = texts.number(text, self.field)? * self.factor;
        let limit = self.period.map_or(LARGEST, |period| period as f64);
        if self.is_whole && value.fract() != 0.0 {
            return Err(wrong(self.field, text, "a whole number"));
        }
        if value >= 0.0 && value < limit {
            return Ok(value.round().min(limit - 1.0) as i64);
        }
        let expected = match self.period {
            Some(_) => "at least 0 and less than where it wraps",
            None => "at least 0, and less than 285 years",
        };
        Err(wrong(self.field, text, expected))
    }
}
