//! The time zone in which a console's stamps are read.

use super::evidence::FrameEvidence;
use crate::acquire::FrameTags;

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
}
