//! The host clock and stopwatches; the only place where the wall clock is read.

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
