//! From a device's clock to the host's: offset and drift from one-way stamps.
//!
//! A sample taken at device time x arrives at host time y = x + offset + drift·x + delay, and the delay is never negative. So the map
//! is the line under all points (x, y − x) that lies closest to them: of all lines below the points the one that is highest at their
//! mean x, which is the edge of the lower convex hull that spans the mean (Zhang, Liu and Xia 2002). The least delay itself cannot be
//! seen one way; it stays in the offset and is stated as [`LEAST_DELAY_US`].

use std::collections::VecDeque;

use crate::estimate::median;

/// Steepest slope that is believed: crystals are better than this by far.
pub const MAX_DRIFT: f64 = 500e-6;
/// Standard deviation of the slope before anything is known.
const PRIOR_DRIFT_SIGMA: f64 = 100e-6;
/// Same, when the same device's slope was known before a step or a re-opening.
const CARRIED_DRIFT_SIGMA: f64 = 10e-6;
/// Of the points in this much device time only the one that came fastest is kept.
const BUCKET_US: i64 = 1_000_000;
/// Points kept: 10 minutes.
const BUCKETS: usize = 600;
/// What one-way stamps cannot show: transmission (1.1 ms for 104 bytes at 921 600 baud) and the driver's shortest hand-over.
pub const LEAST_DELAY_US: f64 = 1_000.0;
/// Arrivals that are all later than before by more than this …
const STANDS_US: f64 = 250_000.0;
/// … and by the same, but for this much and this share of it …
const STANDS_WITHIN_US: f64 = 50_000.0;
const STANDS_WITHIN_SHARE: f64 = 0.05;
/// … for so much device time are no backlog: one is worked off. The clock stood still meanwhile.
const STANDS_FOR_US: f64 = 5_000_000.0;
/// Below this the scatter of the fastest arrivals is not believed.
const LEAST_SCATTER_US: f64 = 20.0;

/// x: device time since the reference; r: host time minus device time, since the reference.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Point {
    x_us: f64,
    r_us: f64,
}

/// r = offset + drift·x.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Line {
    offset_us: f64,
    drift: f64,
    drift_sigma: f64,
    /// Where the slope was taken.
    centre_us: f64,
    /// Median height of the kept points above the line.
    scatter_us: f64,
    /// How far even the fastest of the latest arrivals lie above the line, and since when they have: the clock may have stood still for so
    /// long, or all may have been held up.
    excess_us: f64,
    excess_from_us: f64,
    /// The excess lasts, and does not change.
    stands: bool,
}

/// Maps the time of one device, between two of its clock's steps, to host time.
#[derive(Clone, Debug)]
pub struct ClockMap {
    reference_device_us: i64,
    reference_host_us: i64,
    /// The fastest arrival of each bucket, in order.
    buckets: VecDeque<(i64, Point)>,
    prior_drift: f64,
    prior_sigma: f64,
    line: Line,
    points: u64,
    /// The device has no clock and its times are the host's: this is their standard deviation, and nothing is learnt of them.
    host_sigma_us: Option<f64>,
}

/// What the map believes, for people and logs.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize)]
pub struct ClockEstimate {
    /// Host minus device time at the latest sample.
    pub offset_us: f64,
    /// Rate of the host's clock against the device's, minus 1, in parts per million.
    pub drift_ppm: f64,
    /// One standard deviation of it.
    pub drift_sigma_ppm: f64,
    /// Uncertainty of mapped times at the latest sample.
    pub uncertainty_us: f64,
    /// Samples seen.
    pub points: u64,
}

impl ClockMap {
    /// Starts with one pair of stamps; `carried_drift` is the slope of this device's clock if it is known from before.
    #[must_use]
    pub fn new(device_us: i64, host_us: i64, carried_drift: Option<f64>) -> Self {
        let line = Line {
            offset_us: 0.0,
            drift: 0.0,
            drift_sigma: 0.0,
            centre_us: 0.0,
            scatter_us: 0.0,
            excess_us: 0.0,
            excess_from_us: f64::INFINITY,
            stands: false,
        };
        let mut map = Self {
            reference_device_us: device_us,
            reference_host_us: host_us,
            buckets: VecDeque::new(),
            prior_drift: carried_drift.unwrap_or(0.0).clamp(-MAX_DRIFT, MAX_DRIFT),
            prior_sigma: if carried_drift.is_some() { CARRIED_DRIFT_SIGMA } else { PRIOR_DRIFT_SIGMA },
            line,
            points: 0,
            host_sigma_us: None,
        };
        map.push(device_us, host_us);
        map
    }

    /// Of a device without a clock, whose samples carry the host's time of their arrival with this standard deviation: no offset, no drift.
    #[must_use]
    pub fn of_host(host_us: i64, sigma_us: f64) -> Self {
        Self { host_sigma_us: Some(sigma_us), ..Self::new(host_us, host_us, None) }
    }

    /// Takes one more pair of stamps of the same clock; late and reordered ones do no harm.
    pub fn push(&mut self, device_us: i64, host_us: i64) {
        self.points += 1;
        if self.host_sigma_us.is_some() {
            return;
        }
        let point = self.point(device_us, host_us);
        let bucket = device_us.saturating_sub(self.reference_device_us).div_euclid(BUCKET_US);
        let height = |p: &Point, drift: f64| p.r_us - drift * p.x_us;
        match self.buckets.iter().rposition(|(index, _)| *index <= bucket) {
            Some(at) if self.buckets[at].0 == bucket => {
                if height(&point, self.line.drift) >= height(&self.buckets[at].1, self.line.drift) {
                    return;
                }
                self.buckets[at].1 = point;
            }
            Some(at) => self.buckets.insert(at + 1, (bucket, point)),
            None if self.buckets.len() < BUCKETS => self.buckets.push_front((bucket, point)),
            None => return,
        }
        while self.buckets.len() > BUCKETS {
            self.buckets.pop_front();
        }
        self.line = self.fit();
    }

    /// Host time of a device time.
    #[must_use]
    pub fn host_from_device_us(&self, device_us: i64) -> i64 {
        let x = device_us.saturating_sub(self.reference_device_us) as f64;
        self.reference_host_us.saturating_add((x + self.line.offset_us + self.line.drift * x).round() as i64)
    }

    /// Device time at a host time.
    #[must_use]
    pub fn device_from_host_us(&self, host_us: i64) -> i64 {
        let y = host_us.saturating_sub(self.reference_host_us) as f64;
        self.reference_device_us.saturating_add(((y - self.line.offset_us) / (1.0 + self.line.drift)).round() as i64)
    }

    /// Uncertainty (one standard deviation, least delay included) of the host time of `device_us`.
    #[must_use]
    pub fn uncertainty_us(&self, device_us: i64) -> f64 {
        if let Some(sigma_us) = self.host_sigma_us {
            return sigma_us;
        }
        let x = device_us.saturating_sub(self.reference_device_us) as f64;
        let tilt_us = self.line.drift_sigma * (x - self.line.centre_us);
        let excess_us = if x >= self.line.excess_from_us { self.line.excess_us } else { 0.0 };
        (LEAST_DELAY_US.powi(2) + self.line.scatter_us.powi(2) + tilt_us.powi(2) + excess_us.powi(2)).sqrt()
    }

    /// How far the arrival of a sample lies above the line: its delay beyond the least. Negative: earlier than the map allows.
    #[must_use]
    pub fn delay_us(&self, device_us: i64, host_us: i64) -> f64 {
        host_us.saturating_sub(self.host_from_device_us(device_us)) as f64
    }

    /// By how much the clock stood still, where all that comes has been later by that for longer than any backlog lasts.
    #[must_use]
    pub fn stood_still_us(&self) -> Option<f64> {
        (self.host_sigma_us.is_none() && self.line.stands).then_some(self.line.excess_us)
    }

    /// The slope and how well it is known.
    #[must_use]
    pub fn drift(&self) -> (f64, f64) {
        if self.host_sigma_us.is_some() { (0.0, 0.0) } else { (self.line.drift, self.line.drift_sigma) }
    }

    /// The numbers behind the map.
    #[must_use]
    pub fn estimate(&self) -> ClockEstimate {
        let latest = self.buckets.back().map_or(0.0, |(_, point)| point.x_us);
        let device_us = self.reference_device_us.saturating_add(latest as i64);
        ClockEstimate {
            offset_us: self.host_from_device_us(device_us).saturating_sub(device_us) as f64,
            drift_ppm: self.drift().0 * 1e6,
            drift_sigma_ppm: self.drift().1 * 1e6,
            uncertainty_us: self.uncertainty_us(device_us),
            points: self.points,
        }
    }

    fn point(&self, device_us: i64, host_us: i64) -> Point {
        let x = device_us.saturating_sub(self.reference_device_us);
        Point { x_us: x as f64, r_us: host_us.saturating_sub(self.reference_host_us).saturating_sub(x) as f64 }
    }

    fn fit(&self) -> Line {
        let points: Vec<Point> = self.buckets.iter().map(|(_, point)| *point).collect();
        let mean_us = points.iter().map(|p| p.x_us).sum::<f64>() / points.len() as f64;
        let hull = lower_hull(&points);
        // The hull's edge over the mean, or a flat one through its only point.
        let (left, right) =
            hull.windows(2).find(|edge| edge[1].x_us >= mean_us).map_or((hull[0], hull[0]), |edge| (edge[0], edge[1]));
        let length_us = right.x_us - left.x_us;
        let hull_drift = if length_us > 0.0 { (right.r_us - left.r_us) / length_us } else { 0.0 };
        let scatter_us = scatter_above(&points, hull_drift.clamp(-MAX_DRIFT, MAX_DRIFT)).max(LEAST_SCATTER_US);
        // Two ends, each uncertain by the scatter; the prior decides while the edge is short.
        let hull_variance = if length_us > 0.0 { 2.0 * (scatter_us / length_us).powi(2) } else { f64::INFINITY };
        let weight = self.prior_sigma.powi(2) / (self.prior_sigma.powi(2) + hull_variance);
        let drift = (self.prior_drift + weight * (hull_drift - self.prior_drift)).clamp(-MAX_DRIFT, MAX_DRIFT);
        let drift_sigma = (1.0 / (1.0 / self.prior_sigma.powi(2) + 1.0 / hull_variance)).sqrt();
        let offset_us = points.iter().map(|p| p.r_us - drift * p.x_us).fold(f64::INFINITY, f64::min);
        let line = |p: &Point| offset_us + drift * p.x_us;
        let excess = |p: &Point| p.r_us - line(p);
        let excess_us = points[points.len().saturating_sub(2)..].iter().map(excess).fold(f64::INFINITY, f64::min);
        let begun = points.iter().rposition(|p| !(excess(p) > 0.5 * excess_us)).map_or(0, |before| before + 1);
        let late = &points[begun.min(points.len() - 1)..];
        // The first bucket may hold a part of what came before.
        let of_all = late.iter().skip(1).map(excess).fold([f64::INFINITY, 0.0f64], |[low, high], e| [low.min(e), high.max(e)]);
        let lasts = late[late.len() - 1].x_us - late[0].x_us >= STANDS_FOR_US;
        let stands =
            excess_us >= STANDS_US && lasts && of_all[1] - of_all[0] <= STANDS_WITHIN_US.max(STANDS_WITHIN_SHARE * excess_us);
        Line {
            offset_us,
            drift,
            drift_sigma,
            centre_us: 0.5 * (left.x_us + right.x_us),
            scatter_us,
            excess_us,
            // It may have begun right after the last that came in time.
            excess_from_us: begun.checked_sub(1).map_or(late[0].x_us, |last| points[last].x_us + 1.0).min(late[0].x_us),
            stands,
        }
    }
}

/// Lower convex hull of points in ascending x (Andrew's chain).
fn lower_hull(points: &[Point]) -> Vec<Point> {
    let mut hull: Vec<Point> = Vec::new();
    for &c in points {
        while let [.., a, b] = hull[..] {
            let turn = (b.x_us - a.x_us) * (c.r_us - a.r_us) - (b.r_us - a.r_us) * (c.x_us - a.x_us);
            if turn > 0.0 {
                break;
            }
            hull.pop();
        }
        hull.push(c);
    }
    hull
}

/// Median height above the lowest line of this slope.
fn scatter_above(points: &[Point], drift: f64) -> f64 {
    let heights: Vec<f64> = points.iter().map(|p| p.r_us - drift * p.x_us).collect();
    let lowest = heights.iter().copied().min_by(f64::total_cmp);
    median(heights).zip(lowest).map_or(0.0, |(middle, lowest)| middle - lowest)
}
