//! The time zone in which a console's stamps are read.

use super::evidence::FrameEvidence;
use crate::acquire::FrameTags;

/// Time zones are this far apart.
const ZONE_US: i64 = 3_600_000_000;
/// But for these, with and without summer time, in minutes east of UTC (IANA time zone database, zones in use since 2010).
const BROKEN_ZONES_MIN: [i64; 15] = [-570, -270, -210, -150, 210, 270, 330, 345, 390, 510, 525, 570, 630, 765, 825];
/// A console whose clock is kept is not farther off than this.
pub(super) const BESIDE_ZONE_US: i64 = 300_000_000;
/// The farthest zone, either way.
const FARTHEST_MIN: i32 = 14 * 60;

/// The time zone of a console's stamps: that of the first file that states one. Stamps of another zone are brought to it, so that summer time
/// may begin in mid-session.
#[derive(Clone, Copy, Debug, Default)]
pub struct ConsoleZone {
    offset_min: Option<i32>,
}

impl ConsoleZone {
    /// The zone, where a file states one: minutes east of UTC.
    #[must_use]
    pub fn minutes(self) -> Option<i32> {
        self.offset_min
    }

    /// What a frame with these tags says, in the one zone.
    #[must_use]
    pub fn steady(&mut self, tags: &FrameTags, evidence: FrameEvidence) -> FrameEvidence {
        let Some(own_min) = tags.timezone_offset_min else { return evidence };
        let first_min = *self.offset_min.get_or_insert(own_min);
        let later_us = (i64::from(first_min) - i64::from(own_min)) * 60_000_000;
        FrameEvidence { console_us: evidence.console_us.map(|us| us.saturating_add(later_us)), ..evidence }
    }
}

/// What an offset (UTC minus the console's time) is beside the nearest time zone.
pub(super) fn off_zone_us(offset_us: i64) -> i64 {
    let beside_hours_us = offset_us.saturating_add(ZONE_US / 2).rem_euclid(ZONE_US) - ZONE_US / 2;
    let beside_broken_us = BROKEN_ZONES_MIN.iter().map(|minutes| offset_us.saturating_add(minutes * 60_000_000));
    beside_broken_us.fold(beside_hours_us, |best, beside| if beside.saturating_abs() < best.abs() { beside } else { best })
}

/// The zone, minutes east of UTC, beside which a clock is off by no more than a kept one is, by its offset (UTC minus the console's time).
pub(super) fn zone_beside(offset_us: i64) -> Option<i32> {
    let off_us = off_zone_us(offset_us);
    let minutes = i32::try_from(off_us.saturating_sub(offset_us) / 60_000_000).ok()?;
    (off_us.saturating_abs() <= BESIDE_ZONE_US && (-FARTHEST_MIN..=FARTHEST_MIN).contains(&minutes)).then_some(minutes)
}

/// Minutes east of UTC as `UTC+05:30`.
pub(super) fn zone_label(minutes: i32) -> String {
    let sign = if minutes < 0 { '-' } else { '+' };
    format!("UTC{sign}{:02}:{:02}", minutes.unsigned_abs() / 60, minutes.unsigned_abs() % 60)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn stamps_of_two_zones_come_to_one() {
        let at = |time: &str, offset_min: Option<i32>| FrameTags {
            acquired_date: Some("20261128".to_owned()),
            acquired_time: Some(time.to_owned()),
            timezone_offset_min: offset_min,
            ..FrameTags::default()
        };
        let mut zone = ConsoleZone::default();
        let mut stamp = |tags: FrameTags| {
            let said = FrameEvidence::of(1, &tags, "a", [0, 1], None);
            zone.steady(&tags, said).console_us.expect("a stamp")
        };
        let first_us = stamp(at("010000", None));
        assert_eq!(stamp(at("010010", Some(60))) - first_us, 10_000_000);
        // Summer time: an hour more on the clock, ten seconds later.
        assert_eq!(stamp(at("020020", Some(120))) - first_us, 20_000_000);
        assert_eq!(stamp(at("010030", Some(60))) - first_us, 30_000_000);
    }

    #[test]
    fn offsets_are_taken_beside_whole_hours_and_the_zones_between_them() {
        let minutes = |n: f64| (n * 60e6) as i64;
        for (offset_min, beside_min) in [
            (0.0, 0.0),
            (-60.1, -0.1),
            (300.2, 0.2),
            // India, Nepal, Newfoundland: east of UTC the console is ahead.
            (-330.1, -0.1),
            (-345.0, 0.0),
            (150.3, 0.3),
            // No zone is half an hour behind UTC, or ahead of it.
            (25.0, 25.0),
            (-25.0, -25.0),
        ] {
            assert_eq!(off_zone_us(minutes(offset_min)), minutes(beside_min), "{offset_min}");
        }
        assert!(off_zone_us(i64::MAX).abs() <= ZONE_US / 2 && off_zone_us(i64::MIN).abs() <= ZONE_US / 2);
    }

    #[test]
    fn a_zone_is_told_beside_which_a_clock_is_kept_and_none_far_from_all() {
        let zone = |offset_s: f64| zone_beside((offset_s * 1e6) as i64);
        assert_eq!([zone(-3602.0), zone(18_000.5), zone(-19_800.0), zone(240.0)], [Some(60), Some(-300), Some(330), Some(0)]);
        assert_eq!([zone(1_500.0), zone(86_400.0 * 3.0), zone_beside(i64::MAX), zone_beside(i64::MIN)], [None; 4]);
        assert_eq!([zone_label(330), zone_label(-210), zone_label(0)], ["UTC+05:30", "UTC-03:30", "UTC+00:00"]);
    }
}
