//! Where exposures lie along the strip: by their times, as far as each keeps a width that can be seen and hit; and round times between them.

use crate::time::utc;

/// Widest tile, points.
pub(super) const WIDEST: f32 = 46.0;
/// Tiles are not pushed closer than this while there is room.
const LEAST_PITCH: f32 = 20.0;
/// Between two labels, points.
const LABEL: f32 = 64.0;
/// Lengths of a strip to which exposures are still to come, seconds: its scale changes rarely.
const SPANS_S: [i64; 16] =
    [30, 60, 120, 300, 600, 1200, 1800, 3600, 7200, 18_000, 36_000, 86_400, 172_800, 604_800, 2_592_000, 31_536_000];
/// Between two round times, seconds.
const STEPS_S: [i64; 19] =
    [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 21_600, 43_200, 86_400, 604_800, 2_592_000];
const SECOND_US: i64 = 1_000_000;

/// A round time on the strip.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct TimeTick {
    /// Points from the strip's left end.
    pub(super) x: f32,
    /// Clock time, UTC; empty where there is no room for it.
    pub(super) label: String,
}

/// See the module.
#[derive(Clone, Debug)]
pub(super) struct TimeAxis {
    /// Of the tiles, points from the strip's left end; ascending.
    lefts: Vec<f32>,
    /// Of the exposures, never before that of the one before.
    times_us: Vec<i64>,
    end_us: i64,
    width: f32,
}

impl TimeAxis {
    /// Of exposures at `times_us`, in the order in which they are shown, on a strip of `width` points; `goes_on` where more are to come.
    pub(super) fn of(times_us: impl Iterator<Item = i64>, goes_on: bool, width: f32) -> Self {
        let mut latest_us = i64::MIN;
        // A frame that came late stands where it came.
        let in_order = times_us.map(|time_us| {
            latest_us = latest_us.max(time_us);
            latest_us
        });
        let times_us: Vec<i64> = in_order.collect();
        let (first_us, last_us) = times_us.first().zip(times_us.last()).map_or((0, 0), |(first, last)| (*first, *last));
        let needed_us = last_us.saturating_sub(first_us);
        let round = SPANS_S.into_iter().map(|span_s| span_s * SECOND_US).find(|span_us| *span_us >= needed_us);
        let span_us = round.filter(|_| goes_on).unwrap_or(needed_us).max(1);
        let end_us = first_us.saturating_add(span_us);

        let count = times_us.len() as f32;
        let pitch = LEAST_PITCH.min(width / count.max(1.0));
        let room = (width - last_width(width, times_us.len())).max(0.0);
        let by_time = |time_us: i64| (time_us.saturating_sub(first_us) as f64 / span_us as f64) as f32 * room;
        let mut lefts: Vec<f32> = Vec::with_capacity(times_us.len());
        for time_us in &times_us {
            let least = lefts.last().map_or(0.0, |before| before + pitch);
            lefts.push(by_time(*time_us).max(least));
        }
        // What is pushed beyond the end is pushed back: as many as there are fit.
        for (n, left) in lefts.iter_mut().enumerate() {
            *left = left.min(width - pitch * (count - n as f32));
        }
        Self { lefts, times_us, end_us, width }
    }

    /// Left and right end of a tile.
    pub(super) fn tile(&self, n: usize) -> [f32; 2] {
        let left = self.lefts[n];
        let next = self.lefts.get(n + 1).copied().unwrap_or(self.width);
        [left, next.min(left + WIDEST)]
    }

    /// The exposure to which a place belongs: that whose tile is at it, or before it.
    pub(super) fn at(&self, x: f32) -> Option<usize> {
        let before = self.lefts.partition_point(|left| *left <= x);
        (!self.lefts.is_empty()).then(|| before.saturating_sub(1))
    }

    /// Round times, and the first exposure's; as many have labels as there is room for.
    pub(super) fn ticks(&self) -> Vec<TimeTick> {
        let Some(first_us) = self.times_us.first().copied() else { return Vec::new() };
        let most = (self.width / LABEL).max(1.0) as i64;
        let span_us = self.end_us.saturating_sub(first_us);
        let fits = |step_s: &i64| span_us / (step_s * SECOND_US) <= most;
        let step_us = STEPS_S.into_iter().find(fits).unwrap_or(STEPS_S[STEPS_S.len() - 1]) * SECOND_US;
        // No more than there are labels to a strip; those of a damaged log may be without number.
        let round = (1..=2 * most).filter_map(|n| first_us.div_euclid(step_us).checked_add(n)?.checked_mul(step_us));
        let times = [first_us].into_iter().chain(round.take_while(|time_us| *time_us <= self.end_us));
        let mut free_from = f32::MIN;
        let mut ticks = Vec::new();
        for time_us in times {
            let x = self.x(time_us);
            let is_free = x >= free_from && x + LABEL <= self.width;
            if is_free {
                free_from = x + LABEL;
            }
            ticks.push(TimeTick { x, label: if is_free { label(time_us, step_us) } else { String::new() } });
        }
        ticks
    }

    /// Where a time is, between the exposures about it.
    fn x(&self, time_us: i64) -> f32 {
        let after = self.times_us.partition_point(|of_exposure| *of_exposure <= time_us);
        let (Some(before_us), Some(before)) = (self.times_us[..after].last(), self.lefts[..after].last()) else { return 0.0 };
        let end = (self.end_us, (self.width - last_width(self.width, self.lefts.len())).max(*before));
        let (next_us, next) =
            self.times_us.get(after).zip(self.lefts.get(after)).map_or(end, |(time_us, left)| (*time_us, *left));
        let share = time_us.saturating_sub(*before_us) as f64 / next_us.saturating_sub(*before_us).max(1) as f64;
        before + (next - before) * share.min(1.0) as f32
    }
}

/// What is kept for the last tile.
fn last_width(width: f32, count: usize) -> f32 {
    WIDEST.min(width / count.max(1) as f32)
}

/// Hours and minutes, seconds where they tell, the day where hours do not.
fn label(time_us: i64, step_us: i64) -> String {
    let whole = utc(time_us);
    let part = match step_us / SECOND_US {
        0..60 => 11..19,
        60..86_400 => 11..16,
        _ => 5..10,
    };
    // A damaged log may name times of no calendar.
    whole.get(part).unwrap_or_default().to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    const START_US: i64 = 1_709_208_000_000_000;

    fn axis(seconds: &[f64], goes_on: bool, width: f32) -> TimeAxis {
        TimeAxis::of(seconds.iter().map(|s| START_US + (s * 1e6) as i64), goes_on, width)
    }

    #[test]
    fn exposures_lie_by_their_times_and_none_over_another() {
        // A minute's session that has ended fills the strip.
        let ended = axis(&[0.0, 15.0, 60.0], false, 1046.0);
        assert_eq!([0, 1, 2].map(|n| ended.tile(n)), [[0.0, 46.0], [250.0, 296.0], [1000.0, 1046.0]]);
        // One that goes on leaves room for what is to come, and does not move when a second has gone by.
        let (now, later) = (axis(&[0.0, 15.0], true, 1046.0), axis(&[0.0, 15.0, 29.0], true, 1046.0));
        assert_eq!([now.tile(0), now.tile(1)], [later.tile(0), later.tile(1)]);
        assert!((now.tile(1)[0] - 500.0).abs() < 1.0, "{:?}", now.tile(1));
        // A burst is spread out, the one after it is pushed on, and what is far away stays.
        let burst: Vec<f64> = (0..10).map(|n| 20.0 + 0.06 * f64::from(n)).chain([60.0]).collect();
        let seconds: Vec<f64> = [0.0].into_iter().chain(burst).collect();
        let spread = axis(&seconds, false, 1046.0);
        let widths: Vec<f32> = (0..12).map(|n| spread.tile(n)[1] - spread.tile(n)[0]).collect();
        assert!(widths.iter().all(|width| *width >= 19.9), "{widths:?}");
        assert!((spread.tile(11)[0] - 1000.0).abs() < 1.0 && spread.tile(0)[0] == 0.0);
        // As many as there are fit, at the end of time too.
        let crowd: Vec<f64> = (0..500).map(|n| 1e-3 * f64::from(n)).collect();
        for goes_on in [false, true] {
            let crowd = axis(&crowd, goes_on, 1000.0);
            assert!((0..500).all(|n| crowd.tile(n)[1] - crowd.tile(n)[0] > 1.9 && crowd.tile(n)[1] < 1000.1), "{goes_on}");
        }
    }

    #[test]
    fn a_place_belongs_to_the_tile_at_it_or_before_it() {
        let axis = axis(&[0.0, 15.0, 60.0], false, 1046.0);
        assert_eq!([-5.0, 10.0, 200.0, 260.0, 999.0, 1040.0, 5000.0].map(|x| axis.at(x)), [0, 0, 0, 1, 1, 2, 2].map(Some));
        assert_eq!(TimeAxis::of(std::iter::empty(), true, 1046.0).at(10.0), None);
    }

    #[test]
    fn ticks_are_round_times_where_they_are_and_labels_do_not_touch() {
        let axis = axis(&[2.5, 15.0, 60.0], false, 1046.0);
        let ticks = axis.ticks();
        let labels: Vec<&str> = ticks.iter().map(|tick| tick.label.as_str()).filter(|label| !label.is_empty()).collect();
        assert_eq!(&labels[..2], ["12:00:02", "12:00:10"], "{labels:?}");
        let of = |label: &str| ticks.iter().find(|tick| tick.label == label).map(|tick| tick.x);
        // Half a minute from 2.5 s is 47.8 % of the way.
        let expected = (30.0 - 2.5) / 57.5 * 1000.0;
        assert!(of("12:00:30").is_some_and(|x| (x - expected).abs() < 1.0), "{ticks:?}");
        let labelled: Vec<f32> = ticks.iter().filter(|tick| !tick.label.is_empty()).map(|tick| tick.x).collect();
        assert!(labelled.len() > 4 && labelled.windows(2).all(|pair| pair[1] - pair[0] >= LABEL), "{labelled:?}");
        // An hour has minutes, and a month has days.
        let hour = self::axis(&[0.0, 3600.0], false, 1046.0).ticks();
        assert!(hour.iter().any(|tick| tick.label == "12:30"), "{hour:?}");
        // Steps of hours divide a day: every fifth hour is another one each day.
        let days = self::axis(&[0.0, 40.0 * 3600.0], false, 1046.0).ticks();
        for label in ["18:00", "00:00", "06:00"] {
            assert!(days.iter().any(|tick| tick.label == label), "{label}: {days:?}");
        }
        let month = self::axis(&[0.0, 30.0 * 86_400.0], false, 1046.0).ticks();
        assert!(month.iter().any(|tick| tick.label == "03-07") && month.len() < 40, "{month:?}");
        // Times of no calendar do no harm.
        let absurd = TimeAxis::of([i64::MIN, i64::MAX].into_iter(), true, 1046.0);
        assert!(absurd.ticks().len() < 60);
    }

    /// A frame that came late was before the one before it.
    #[test]
    fn exposures_out_of_order_stay_in_the_order_in_which_they_are_shown() {
        let axis = axis(&[0.0, 40.0, 20.0, 60.0], false, 1046.0);
        let lefts: Vec<f32> = (0..4).map(|n| axis.tile(n)[0]).collect();
        assert!(lefts.windows(2).all(|pair| pair[1] >= pair[0] + 19.9), "{lefts:?}");
    }
}
