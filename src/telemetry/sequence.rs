//! Lost, duplicate, reordered, restarted: what sequence numbers tell.

/// Frames remembered.
const WINDOW: usize = 1024;
/// A frame may be late by so many; one that is later begins a new count.
const REORDER_DEPTH: u32 = 1000;
/// A count may begin with packets in disorder: one from before the first is late by at most so many.
const EARLIER_DEPTH: u32 = 8;
/// Larger gaps are no losses but another count, unless the device's clock went on at the count's pace meanwhile.
const LARGEST_GAP: u32 = 1 << 16;
/// No device is away for longer than this and counts on: a week of 200 frames a second.
const LONGEST_GAP: u32 = 1 << 27;
/// By so much the pace of the count before a gap may differ from that within, and so many frames say what it was.
const PACE: f64 = 1.25;
const PACED: usize = 16;
/// So many known frames in a row, in order and from the first on, are no duplicates but a device that started over and repeats itself
/// exactly.
const REPEATED_RUN: u32 = 3;
/// A count that goes on after older frames came in between has lost at most so many of its own.
const RESUMED_GAP: u32 = 8;

/// What a sequence number says about its frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sequenced {
    /// Follows the last one.
    Next,
    /// Follows after a gap: so many are missing (yet).
    Gap(u32),
    /// As [`Sequenced::Gap`], but the port was closed in between.
    GapWhileClosed(u32),
    /// Was here before.
    Duplicate,
    /// Fills an earlier gap.
    Reordered,
    /// Was sent shortly before all that came so far; so many between them and it are missing (yet).
    Early(u32),
    /// The device counts anew.
    Reset,
}

/// Follows the sequence numbers of one device.
#[derive(Clone, Debug)]
pub struct SequenceTracker {
    /// The number that this count began with.
    first: u32,
    /// The newest number and its device time.
    last: Option<(u32, u64)>,
    /// Frames seen, at `sequence % WINDOW`.
    seen: Vec<Option<(u32, u64)>>,
    repeated: Option<(u32, u32)>,
    reopened: bool,
    /// The count before the latest restart, and frames since: whoever stores and forwards may have sent old frames in between.
    before: Option<(Box<SequenceTracker>, u32)>,
}

impl Default for SequenceTracker {
    fn default() -> Self {
        Self { first: 0, last: None, seen: vec![None; WINDOW], repeated: None, reopened: false, before: None }
    }
}

impl SequenceTracker {
    /// The port was opened again: the next gap happened while it was closed.
    pub fn reopen(&mut self) {
        self.reopened = self.last.is_some();
    }

    /// Takes the number and device time of an intact frame.
    pub fn take(&mut self, sequence: u32, device_us: u64) -> Sequenced {
        let reopened = std::mem::take(&mut self.reopened);
        if self.last.is_none() {
            self.first = sequence;
        }
        let verdict = self.judge(sequence, device_us, reopened);
        if let Some(resumed) = self.resumed(verdict, sequence, device_us) {
            return resumed;
        }
        match verdict {
            Sequenced::Duplicate => {
                let run = match self.repeated {
                    Some((last, run)) if sequence == last.wrapping_add(1) => run + 1,
                    _ => 1,
                };
                self.repeated = Some((sequence, run));
                let begins = sequence.wrapping_sub(run - 1);
                if run < REPEATED_RUN || begins.wrapping_sub(self.first) >= EARLIER_DEPTH {
                    return Sequenced::Duplicate;
                }
                self.restart(sequence, device_us);
                return Sequenced::Reset;
            }
            Sequenced::Reset => self.restart(sequence, device_us),
            Sequenced::Reordered => self.seen[sequence as usize % WINDOW] = Some((sequence, device_us)),
            Sequenced::Early(_) => {
                self.seen[sequence as usize % WINDOW] = Some((sequence, device_us));
                self.first = sequence;
            }
            Sequenced::Next | Sequenced::Gap(_) | Sequenced::GapWhileClosed(_) => {
                self.seen[sequence as usize % WINDOW] = Some((sequence, device_us));
                self.last = Some((sequence, device_us));
            }
        }
        self.repeated = None;
        verdict
    }

    /// What the frame is to the count before the restart, where that goes on with it.
    fn resumed(&mut self, verdict: Sequenced, sequence: u32, device_us: u64) -> Option<Sequenced> {
        let (before, frames) = self.before.as_mut()?;
        *frames += 1;
        if *frames > REORDER_DEPTH {
            self.before = None;
            return None;
        }
        if matches!(verdict, Sequenced::Next | Sequenced::Duplicate) {
            return None;
        }
        let resumed = before.judge(sequence, device_us, false);
        if !matches!(resumed, Sequenced::Next | Sequenced::Gap(..=RESUMED_GAP)) {
            return None;
        }
        let (before, _) = self.before.take()?;
        *self = *before;
        self.seen[sequence as usize % WINDOW] = Some((sequence, device_us));
        self.last = Some((sequence, device_us));
        Some(resumed)
    }

    fn judge(&self, sequence: u32, device_us: u64, reopened: bool) -> Sequenced {
        let Some((last, last_us)) = self.last else { return Sequenced::Next };
        let ahead = sequence.wrapping_sub(last);
        if ahead == 1 && !reopened {
            return Sequenced::Next;
        }
        let goes_on = (1..=LARGEST_GAP).contains(&ahead) || ahead <= LONGEST_GAP && self.keeps_pace(ahead, device_us);
        if goes_on && device_us >= last_us {
            return match (ahead - 1, reopened) {
                (0, _) => Sequenced::Next,
                (missing, false) => Sequenced::Gap(missing),
                (missing, true) => Sequenced::GapWhileClosed(missing),
            };
        }
        let behind = last.wrapping_sub(sequence);
        if !reopened && behind <= REORDER_DEPTH {
            match self.seen[sequence as usize % WINDOW] {
                Some((number, time_us)) if number == sequence && time_us == device_us => return Sequenced::Duplicate,
                Some((number, _)) if number == sequence => return Sequenced::Reset,
                _ if sequence.wrapping_sub(self.first) < last.wrapping_sub(self.first)
                    && device_us <= last_us
                    && self.between_neighbours(sequence, device_us) =>
                {
                    return Sequenced::Reordered;
                }
                None if self.is_from_before_the_first(sequence, device_us, last) => {
                    return Sequenced::Early(self.first.wrapping_sub(sequence) - 1);
                }
                _ => {}
            }
        }
        Sequenced::Reset
    }

    /// Whether the device's clock has gone on by as much as it takes to send so many frames.
    fn keeps_pace(&self, ahead: u32, device_us: u64) -> bool {
        let Some((last, last_us)) = self.last else { return false };
        let known = || self.seen.iter().flatten();
        let Some((first, first_us)) = known().copied().max_by_key(|(number, _)| last.wrapping_sub(*number)) else { return false };
        let (Some(elapsed_us), Some(before_us)) = (device_us.checked_sub(last_us), last_us.checked_sub(first_us)) else {
            return false;
        };
        let counted = elapsed_us as f64 / before_us as f64 * f64::from(last.wrapping_sub(first));
        known().count() >= PACED && (1.0 / PACE..=PACE).contains(&(counted / f64::from(ahead)))
    }

    /// Whether the packet was sent shortly before the first one that came: packets that come in disorder do so at the start as well.
    fn is_from_before_the_first(&self, sequence: u32, device_us: u64, last: u32) -> bool {
        let seen = |(_, time_us): &(u32, u64)| *time_us;
        let oldest_us = self.seen.iter().flatten().map(seen).min();
        let before = self.first.wrapping_sub(sequence);
        before > 0
            && before < EARLIER_DEPTH
            && last.wrapping_sub(sequence) <= EARLIER_DEPTH
            && oldest_us.is_some_and(|us| device_us <= us)
    }

    /// Whether the time lies after that of the nearest earlier frame that was seen.
    fn between_neighbours(&self, sequence: u32, device_us: u64) -> bool {
        let behind = |(number, _): &&(u32, u64)| sequence.wrapping_sub(*number);
        // Of the nearest alone: frames further back may be from before a step of the clock.
        let earlier = self.seen.iter().flatten().filter(|frame| (1..=REORDER_DEPTH).contains(&behind(frame))).min_by_key(behind);
        earlier.is_none_or(|(_, earlier_us)| device_us >= *earlier_us)
    }

    fn restart(&mut self, sequence: u32, device_us: u64) {
        let mut before = Box::new(std::mem::take(self));
        (before.before, before.repeated) = (None, None);
        *self = Self { first: sequence, before: Some((before, 0)), ..Self::default() };
        self.last = Some((sequence, device_us));
        self.seen[sequence as usize % WINDOW] = Some((sequence, device_us));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn verdicts(frames: &[(u32, u64)]) -> Vec<Sequenced> {
        let mut tracker = SequenceTracker::default();
        frames.iter().map(|(sequence, device_us)| tracker.take(*sequence, *device_us)).collect()
    }

    #[test]
    fn gaps_duplicates_and_late_frames_are_told_apart() {
        use Sequenced::{Duplicate, Gap, Next, Reordered};
        let seen = verdicts(&[(5, 50), (6, 60), (6, 60), (9, 90), (7, 70), (10, 100), (7, 70)]);
        assert_eq!(seen, [Next, Next, Duplicate, Gap(2), Reordered, Next, Duplicate]);
    }

    #[test]
    fn packets_that_come_in_disorder_at_the_start_are_late_and_no_restart() {
        use Sequenced::{Early, Gap, Next, Reordered, Reset};
        assert_eq!(verdicts(&[(6, 60), (5, 50), (7, 70)]), [Next, Early(0), Next]);
        assert_eq!(verdicts(&[(8, 80), (6, 60), (9, 90), (7, 70), (5, 50)]), [Next, Early(1), Next, Reordered, Early(0)]);
        assert_eq!(verdicts(&[(6, 60), (8, 80), (5, 50)]), [Next, Gap(1), Early(0)]);
        // Metadata and sample have one time.
        assert_eq!(verdicts(&[(1, 10), (0, 10), (3, 30)]), [Next, Early(0), Gap(1)]);
        // Around the wrap.
        assert_eq!(verdicts(&[(0, 60), (u32::MAX, 50), (1, 70)]), [Next, Early(0), Next]);
        // A time that does not lie before is another count's.
        assert_eq!(verdicts(&[(6, 60), (5, 61), (6, 71)]), [Next, Reset, Next]);
    }

    /// Of an arm whose clock had jumped ahead and back, each packet that came one place late was said to be a restart, and a loss.
    #[test]
    fn a_late_packet_after_the_clock_jumped_back_is_no_restart() {
        use Sequenced::{Gap, Next, Reordered, Reset};
        let at = |n: u32, ahead_us: u64| (n, 1_000_000 + 33_000 * u64::from(n) + ahead_us);
        let mut frames: Vec<(u32, u64)> = (0..10).map(|n| at(n, 0)).collect();
        frames.extend((10..20).map(|n| at(n, 7_000_000)));
        frames.extend([20, 21, 23, 22, 24, 26, 25, 27].map(|n| at(n, 0)));
        let seen = verdicts(&frames);
        assert!(seen[..22].iter().all(|verdict| *verdict == Next), "{seen:?}");
        assert_eq!(seen[22..], [Gap(1), Reordered, Next, Gap(1), Reordered, Next]);
        // One from before its neighbours is another count's.
        frames.truncate(23);
        frames.push((22, 40_000));
        assert_eq!(verdicts(&frames)[22..], [Gap(1), Reset]);
    }

    #[test]
    fn the_wrap_is_no_gap() {
        assert_eq!(
            verdicts(&[(u32::MAX - 1, 1), (u32::MAX, 2), (0, 3), (2, 5)])[1..],
            [Sequenced::Next, Sequenced::Next, Sequenced::Gap(1)]
        );
    }

    #[test]
    fn a_restart_is_a_reset_and_not_four_billion_losses() {
        use Sequenced::{Next, Reset};
        assert_eq!(verdicts(&[(70_000, 900_000), (70_001, 910_000), (0, 100), (1, 10_100)])[2..], [Reset, Next]);
        // Shortly after the start, within the window of reordering.
        assert_eq!(verdicts(&[(10, 100_000), (11, 110_000), (0, 3), (1, 10_003)])[2..], [Reset, Next]);
        // Exactly the same frames again.
        let twice: Vec<(u32, u64)> = (0..20u32).chain(0..20).map(|i| (i, u64::from(i) * 10)).collect();
        let seen = verdicts(&twice);
        assert_eq!(seen.iter().filter(|v| **v == Sequenced::Duplicate).count(), 2);
        assert_eq!(seen.iter().filter(|v| **v == Reset).count(), 1);
    }

    /// A gateway that sends again what it holds made a restart, and losses when the count went on.
    #[test]
    fn old_frames_in_between_are_no_losses() {
        use Sequenced::{Duplicate, Gap, Next, Reset};
        let frame = |n: u32| (n, 1_000_000 + 10_000 * u64::from(n));
        // Known ones.
        let recent: Vec<(u32, u64)> = (100..140).chain(120..135).chain(140..150).map(frame).collect();
        let seen = verdicts(&recent);
        assert_eq!(seen.iter().filter(|verdict| **verdict == Duplicate).count(), 15);
        assert!(seen.iter().all(|verdict| matches!(verdict, Next | Duplicate)), "{seen:?}");
        // Those from before anything that is remembered.
        let old: Vec<(u32, u64)> = (5_000..5_040).chain(2_000..2_020).chain(5_040..5_050).map(frame).collect();
        let seen = verdicts(&old);
        assert_eq!((seen[40], seen[60]), (Reset, Next));
        assert!(seen.iter().enumerate().all(|(at, verdict)| at == 40 || *verdict == Next), "{seen:?}");
        let lossy: Vec<(u32, u64)> = (5_000..5_040).chain(2_000..2_020).chain(5_043..5_050).map(frame).collect();
        assert_eq!(verdicts(&lossy)[60..62], [Gap(3), Next]);
        // A device that began anew goes on with its new count, whatever that loses.
        let anew: Vec<(u32, u64)> = (5_000..5_040).map(frame).chain([(0, 100), (1, 10_100), (40, 400_100)]).collect();
        assert_eq!(verdicts(&anew)[40..], [Reset, Next, Gap(38)]);
    }

    #[test]
    fn an_hour_away_is_a_gap_where_count_and_clock_went_on_together() {
        let after = |frames: u32, us: u64, reopened: bool| {
            let mut tracker = SequenceTracker::default();
            // A hundred a second; whoever joins late, near the wrap of the count.
            for n in 0..40u32 {
                tracker.take(n.wrapping_sub(20), 5_000_000 + 10_000 * u64::from(n));
            }
            if reopened {
                tracker.reopen();
            }
            tracker.take(19 + frames, 5_390_000 + us)
        };
        assert_eq!(after(360_000, 3_600_000_000, true), Sequenced::GapWhileClosed(359_999));
        assert_eq!(after(360_000, 3_610_000_000, false), Sequenced::Gap(359_999));
        // Another count: the clock stood, or ran off.
        assert_eq!(after(360_000, 360_000_000, true), Sequenced::Reset);
        assert_eq!(after(360_000, 36_000_000_000, true), Sequenced::Reset);
        assert_eq!(after(3_000_000_000, 30_000_000_000_000, true), Sequenced::Reset);
    }

    #[test]
    fn a_gap_over_a_closed_port_is_told_apart() {
        let mut tracker = SequenceTracker::default();
        tracker.take(1, 10);
        tracker.reopen();
        assert_eq!(tracker.take(101, 1010), Sequenced::GapWhileClosed(99));
        assert_eq!(tracker.take(103, 1030), Sequenced::Gap(1));
    }
}
