//! How fast a device's clock runs against the host's, where no crystal is so far off: it counts in another unit, or is wrong.
//!
//! Device time over host time is a straight line, however fast the clock runs. A clock that stands still for a while, a machine that is busy and
//! what waits somewhere and is worked off bend it, and nothing is told of a bent one. What waits from the first bends it only when it is worked off.

use super::clock::MAX_DRIFT;

/// Of the arrivals in so much host time, at first, the one that came fastest counts.
const BUCKET_US: i64 = 1_000_000;
/// When there are more, two become one.
const BUCKETS: usize = 64;
/// So many tell of a rate …
const FEWEST: usize = 10;
/// … and so many of one that is off by more than half: no delay looks like that.
const FEWEST_GROSS: usize = 4;
const GROSS: f64 = 0.5;
/// What had waited in front of a port just opened may be worked off for so long, and looks like a fast clock meanwhile …
const WORKED_OFF_US: f64 = 60e6;
/// … of at most this rate: no line is so much faster than its device.
const FASTEST_BACKLOG: f64 = 9.0;
/// What is nearer to the host's rate is mapped away.
const LEAST_OFF: f64 = 2.0 * MAX_DRIFT;
/// Both clocks must have come so far apart …
const LEAST_APART_US: f64 = 300_000.0;
/// … and nothing may lie off the line by more than this share of that, and of what the clock advanced.
const BENT_SHARE: f64 = 0.05;
/// Units that a clock may count in place of microseconds: what it then advances in a second, and its name.
const UNITS: [(f64, &str); 4] = [(1e-3, "milliseconds"), (1e3, "nanoseconds"), (10.0, "units of 100 ns"), (1e-6, "seconds")];
/// A clock that is so near to one of them counts in it.
const UNIT_WITHIN: f64 = 0.1;

/// An arrival, since the first of its stretch.
#[derive(Clone, Copy, Debug)]
struct Point {
    bucket: i64,
    host_us: f64,
    device_us: f64,
}

impl Point {
    fn ahead_us(&self) -> f64 {
        self.device_us - self.host_us
    }
}

/// See the module; of one stretch of a clock.
#[derive(Clone, Debug)]
pub(super) struct ClockRate {
    first_device_us: i64,
    first_host_us: i64,
    bucket_us: i64,
    points: Vec<Point>,
}

impl ClockRate {
    pub(super) fn new(first_device_us: i64, first_host_us: i64) -> Self {
        Self { first_device_us, first_host_us, bucket_us: BUCKET_US, points: Vec::new() }
    }

    /// Takes one more pair of stamps.
    pub(super) fn push(&mut self, device_us: i64, host_us: i64) {
        let since_us = host_us.saturating_sub(self.first_host_us);
        self.keep(Point {
            bucket: since_us.div_euclid(self.bucket_us),
            host_us: since_us as f64,
            device_us: device_us.saturating_sub(self.first_device_us) as f64,
        });
        if self.points.len() > BUCKETS {
            self.bucket_us = self.bucket_us.saturating_mul(2);
            for point in std::mem::take(&mut self.points) {
                self.keep(Point { bucket: point.bucket.div_euclid(2), ..point });
            }
        }
    }

    fn keep(&mut self, point: Point) {
        match self.points.last_mut() {
            Some(last) if last.bucket > point.bucket => {}
            Some(last) if last.bucket == point.bucket => {
                if point.ahead_us() > last.ahead_us() {
                    *last = point;
                }
            }
            _ => self.points.push(point),
        }
    }

    /// How many seconds the clock advances in one, where that is known and no crystal's drift.
    pub(super) fn wrong(&self) -> Option<f64> {
        // In the first there may be what had waited in front of a port just opened.
        let points = self.points.get(1..)?;
        let (first, last) = (points.first()?, points.last()?);
        let (host_us, device_us) = (last.host_us - first.host_us, last.device_us - first.device_us);
        let (rate, apart_us) = (device_us / host_us, (device_us - host_us).abs());
        // A clock that shows the same time for ever has no rate; that it stands still is said elsewhere.
        if !(rate > 0.0 && rate.is_finite()) {
            return None;
        }
        let fewest = if (rate - 1.0).abs() > GROSS { FEWEST_GROSS } else { FEWEST };
        let bend_us = |point: &Point| (point.device_us - first.device_us - rate * (point.host_us - first.host_us)).abs();
        let most_us = BENT_SHARE * apart_us.min(device_us);
        let is_straight = points.iter().all(|point| bend_us(point) <= most_us);
        let is_off = (rate - 1.0).abs() >= LEAST_OFF && apart_us >= LEAST_APART_US;
        let may_be_backlog = rate > 1.0 && rate < FASTEST_BACKLOG && !(last.host_us >= WORKED_OFF_US);
        (points.len() >= fewest && is_off && is_straight && !may_be_backlog).then_some(rate)
    }
}

/// The unit in which a clock seems to count that advances by `rate` seconds of microseconds in one; `None` where it is none that is known.
#[must_use]
pub fn unit_of_clock(rate: f64) -> Option<&'static str> {
    UNITS.iter().find(|(of_unit, _)| (rate / of_unit - 1.0).abs() <= UNIT_WITHIN).map(|(_, name)| *name)
}
