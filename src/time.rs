//! The host clock, stopwatches and the calendar; the only place where the wall clock is read.

#![expect(clippy::disallowed_methods, reason = "this is the one place that reads clocks")]

use std::sync::OnceLock;
use std::time::{Instant, SystemTime, UNIX_EPOCH};

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

/// Year, month, day, and microseconds of the day, in UTC (days to civil date after H. Hinnant).
fn civil_from_us(us: i64) -> (i64, i64, i64, i64) {
    let (days, of_day_us) = (us.div_euclid(DAY_US), us.rem_euclid(DAY_US));
    let z = days + 719_468;
    let (era, of_era) = (z.div_euclid(146_097), z.rem_euclid(146_097));
    let year_of_era = (of_era - of_era / 1460 + of_era / 36_524 - of_era / 146_096) / 365;
    let of_year = of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let shifted = (5 * of_year + 2) / 153;
    let day = of_year - (153 * shifted + 2) / 5 + 1;
    let month = if shifted < 10 { shifted + 3 } else { shifted - 9 };
    (year_of_era + era * 400 + i64::from(month <= 2), month, day, of_day_us)
}

const DAY_US: i64 = 86_400_000_000;

/// `2024-02-29 12:00:00 UTC` of microseconds since the Unix epoch.
#[must_use]
pub fn utc(us: i64) -> String {
    let (year, month, day, of_day_us) = civil_from_us(us);
    let of_day = of_day_us / 1_000_000;
    format!("{year:04}-{month:02}-{day:02} {:02}:{:02}:{:02} UTC", of_day / 3600, of_day / 60 % 60, of_day % 60)
}

/// `2024-02-29T12:00:00.250000Z` of microseconds since the Unix epoch.
#[must_use]
pub fn rfc3339_from_us(us: i64) -> String {
    let (year, month, day, of_day_us) = civil_from_us(us);
    let (of_day, fraction_us) = (of_day_us / 1_000_000, of_day_us % 1_000_000);
    let (hour, minute, second) = (of_day / 3600, of_day / 60 % 60, of_day % 60);
    format!("{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}.{fraction_us:06}Z")
}

/// Microseconds since the Unix epoch of `2024-02-29T12:00:00.25+01:00`: date, time with any fraction, and a zone. `None` for what is none.
#[must_use]
pub fn us_from_rfc3339(text: &str) -> Option<i64> {
    let number = |text: &str, digits: usize| {
        let whole = text.len() == digits && text.bytes().all(|byte| byte.is_ascii_digit());
        whole.then(|| text.parse::<i64>().ok())?
    };
    let (date, time) = text.split_once(['T', 't', ' '])?;
    let mut parts = date.split('-');
    let (year, month, day) = (number(parts.next()?, 4)?, number(parts.next()?, 2)?, number(parts.next()?, 2)?);
    let at = time.find(['Z', 'z', '+', '-'])?;
    let (clock, zone) = time.split_at(at);
    let zone_min = match zone {
        "Z" | "z" => 0,
        _ => {
            let (hours, minutes) = zone.get(1..)?.split_once(':')?;
            let minutes = number(hours, 2)? * 60 + number(minutes, 2)?;
            if zone.starts_with('-') { -minutes } else { minutes }
        }
    };
    let (clock, fraction) = clock.split_once('.').unwrap_or((clock, "0"));
    let fraction_us = number(&format!("{fraction:0<6}").chars().take(6).collect::<String>(), 6)?;
    let mut clock = clock.split(':');
    let (hour, minute, second) = (number(clock.next()?, 2)?, number(clock.next()?, 2)?, number(clock.next()?, 2)?);
    let is_more = parts.next().is_some() || clock.next().is_some() || !fraction.bytes().all(|byte| byte.is_ascii_digit());
    // The days of a date, after H. Hinnant; a leap second is the second after it.
    let shifted_year = if month <= 2 { year - 1 } else { year };
    let (era, of_era) = (shifted_year.div_euclid(400), shifted_year.rem_euclid(400));
    let of_year = (153 * (month + if month > 2 { -3 } else { 9 }) + 2) / 5 + day - 1;
    let days = era * 146_097 + of_era * 365 + of_era / 4 - of_era / 100 + of_year - 719_468;
    let us = days * DAY_US + ((hour * 60 + minute - zone_min) * 60 + second) * 1_000_000 + fraction_us;
    let (_, found_month, found_day, _) = civil_from_us(days * DAY_US);
    let fits = (found_month, found_day) == (month, day) && hour < 24 && minute < 60 && second <= 60;
    (fits && !is_more).then_some(us)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_civil() {
        assert_eq!(utc(0), "1970-01-01 00:00:00 UTC");
        assert_eq!(utc(1_709_208_000_000_000), "2024-02-29 12:00:00 UTC");
        assert_eq!(utc(-1_000_000), "1969-12-31 23:59:59 UTC");
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
