//! The host clock, stopwatches and the calendar; the only place where the wall clock is read.

#![expect(clippy::disallowed_methods, reason = "this is the one place that reads clocks")]

use std::sync::OnceLock;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use chrono::DateTime;

/// Host time in microseconds since the Unix epoch; never runs backwards within one process.
#[must_use]
pub fn host_now_us() -> i64 {
    static ANCHOR: OnceLock<(Instant, i64)> = OnceLock::new();
    let (start, start_us) = ANCHOR.get_or_init(|| {
        let since_epoch = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        (Instant::now(), since_epoch.as_micros() as i64)
    });
    start_us + start.elapsed().as_micros() as i64
}

/// Measures how long something took. Results never depend on it.
#[derive(Clone, Copy, Debug)]
pub struct Stopwatch(Instant);

impl Stopwatch {
    /// Starts now.
    #[must_use]
    pub fn start() -> Self {
        Self(Instant::now())
    }

    /// Milliseconds since the start.
    #[must_use]
    pub fn ms(&self) -> f64 {
        self.0.elapsed().as_secs_f64() * 1e3
    }
}

/// Wall milliseconds per named stage, in the order in which the stages ran.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(transparent)]
pub struct StageTimes(serde_json::Map<String, serde_json::Value>);

impl StageTimes {
    /// Adds `ms` to stage `name`.
    pub fn add(&mut self, name: &str, ms: f64) {
        let before = self.get(name).unwrap_or(0.0);
        self.0.insert(name.to_owned(), serde_json::json!(before + ms));
    }

    /// Runs `work` and books its time under `name`.
    pub fn measure<T>(&mut self, name: &str, work: impl FnOnce() -> T) -> T {
        let watch = Stopwatch::start();
        let result = work();
        self.add(name, watch.ms());
        result
    }

    /// Milliseconds booked under `name`.
    #[must_use]
    pub fn get(&self, name: &str) -> Option<f64> {
        self.0.get(name).and_then(serde_json::Value::as_f64)
    }

    /// Stages and their milliseconds, in order.
    pub fn iter(&self) -> impl Iterator<Item = (&str, f64)> {
        self.0.iter().map(|(name, ms)| (name.as_str(), ms.as_f64().unwrap_or(0.0)))
    }

    /// Books all stages of `other` here as well.
    pub fn merge(&mut self, other: &StageTimes) {
        for (name, ms) in other.iter() {
            self.add(name, ms);
        }
    }
}

/// `2024-02-29 12:00:00 UTC` of microseconds since the Unix epoch.
#[must_use]
pub fn utc(us: i64) -> String {
    formatted(us, "%Y-%m-%d %H:%M:%S UTC")
}

/// `2024-02-29T12:00:00.250000Z` of microseconds since the Unix epoch.
#[must_use]
pub fn rfc3339_from_us(us: i64) -> String {
    formatted(us, "%Y-%m-%dT%H:%M:%S%.6fZ")
}

/// A damaged log may name times of no calendar.
fn formatted(us: i64, form: &str) -> String {
    DateTime::from_timestamp_micros(us).map_or_else(|| format!("{us} us"), |time| time.format(form).to_string())
}

/// Microseconds since the Unix epoch of `2024-02-29T12:00:00.25+01:00`: date, time with any fraction, and a zone. `None` for what is none.
#[must_use]
pub fn us_from_rfc3339(text: &str) -> Option<i64> {
    DateTime::parse_from_rfc3339(text).ok().map(|time| time.timestamp_micros())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_civil() {
        assert_eq!(utc(0), "1970-01-01 00:00:00 UTC");
        assert_eq!(utc(1_709_208_000_000_000), "2024-02-29 12:00:00 UTC");
        assert_eq!(utc(-1_000_000), "1969-12-31 23:59:59 UTC");
        assert_eq!(rfc3339_from_us(i64::MAX), "9223372036854775807 us");
    }

    #[test]
    fn times_are_read_as_they_are_written_and_nothing_else_is_one() {
        for us in [0, 1_709_208_000_250_000, -1, 1_795_255_200_123_456] {
            assert_eq!(us_from_rfc3339(&rfc3339_from_us(us)), Some(us));
        }
        for (text, us) in [
            ("2024-02-29T12:00:00Z", 1_709_208_000_000_000),
            ("2024-02-29 13:30:00.25+01:30", 1_709_208_000_250_000),
            ("2024-02-29T11:00:00.1234567-01:00", 1_709_208_000_123_456),
        ] {
            assert_eq!(us_from_rfc3339(text), Some(us), "{text}");
        }
        for text in [
            "2024-02-30T12:00:00Z",
            "2024-13-01T12:00:00Z",
            "2024-02-29T24:00:00Z",
            "2024-02-29T12:00:00",
            "2024-02-29",
            "2024-02-29T12:00Z",
            "2024-02-29T12:00:00.x5Z",
            "2024-2-29T12:00:00Z",
            "12.5",
            "",
        ] {
            assert_eq!(us_from_rfc3339(text), None, "{text}");
        }
    }
}
