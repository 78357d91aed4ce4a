//! Whether the messages of a log stand in the order in which they were recorded, on which a replay rests.
//!
//! Results carry the time of their exposure and are recorded when they are made, behind what the devices sent meanwhile. Programs that write a log
//! anew by time put them before it, and with them frames and ticks of the clock: which came first cannot be told any more.

use std::collections::BTreeMap;

use crate::record::{LogEntry, topic};

/// Reads from devices from which on a session's results cannot all have been recorded before the next message.
const READS: u64 = 100;

/// Looks at messages as they stand.
#[derive(Debug, Default)]
pub(super) struct AsRecorded {
    latest_us: Option<i64>,
    /// A message is of an earlier time than one before it.
    has_earlier: bool,
    /// Of poses and scores: the last count.
    counts: BTreeMap<&'static str, u32>,
    /// One of them stands behind one that was recorded later.
    is_mixed: bool,
    reads: u64,
    scores: u64,
}

impl AsRecorded {
    /// The next message.
    pub(super) fn see(&mut self, entry: &LogEntry) {
        self.has_earlier |= self.latest_us.is_some_and(|latest_us| entry.host_us < latest_us);
        self.latest_us = self.latest_us.max(Some(entry.host_us));
        match &*entry.topic {
            topic::CARM_RAW | topic::ROBOT_RAW => self.reads += 1,
            topic::SCORES => {
                self.scores += 1;
                self.count(topic::SCORES, entry.sequence);
            }
            topic::POSE => self.count(topic::POSE, entry.sequence),
            _ => {}
        }
    }

    /// Other programs count otherwise, or not at all (0); one that stands there twice is no other order.
    fn count(&mut self, of: &'static str, sequence: u32) {
        let last = self.counts.insert(of, sequence).unwrap_or(0);
        self.is_mixed |= sequence > 0 && sequence < last;
    }

    /// What is to be said of the log once all was seen.
    pub(super) fn words(&self) -> Option<&'static str> {
        let is_by_time = !self.has_earlier && self.reads >= READS && self.scores > 0;
        (self.is_mixed || is_by_time).then_some(
            "messages are not in the order in which they were recorded: has another program written the log anew, by time? A replay of it comes to \
             other results; replay the original",
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn entry(of: &str, host_us: i64, sequence: u32) -> LogEntry {
        let (schema, encoding) = ("".into(), "json".into());
        LogEntry { topic: of.into(), schema, encoding, host_us, sequence, data: Vec::new() }
    }

    /// A log that a reader had put in order of time was said to be whole, and replayed to other poses.
    #[test]
    fn a_log_in_order_of_time_is_told_from_one_as_it_was_recorded() {
        let reads = || (0..200u32).map(|n| entry(topic::CARM_RAW, 33_000 * i64::from(n), n + 1));
        let scores = || [(60_000, 1), (2_000_000, 2)].map(|(host_us, sequence)| entry(topic::SCORES, host_us, sequence));
        let words = |entries: &[LogEntry]| {
            let mut seen = AsRecorded::default();
            entries.iter().for_each(|entry| seen.see(entry));
            seen.words()
        };
        let recorded: Vec<LogEntry> = reads().chain(scores()).collect();
        let mut by_time = recorded.clone();
        by_time.sort_by_key(|entry| entry.host_us);
        assert_eq!(words(&recorded), None);
        assert!(words(&by_time).is_some_and(|words| words.contains("replay the original")));
        // What was never drawn stands in order of time by itself.
        assert_eq!(words(&reads().collect::<Vec<_>>()), None);
        let mut mixed = recorded;
        mixed.swap(200, 201);
        assert!(words(&mixed).is_some());
        assert_eq!(words(&[]), None);
    }
}
