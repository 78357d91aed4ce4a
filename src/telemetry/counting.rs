//! What the number of an intact frame or line says, counted and told.

use super::event::{DecodeFault, Event};
use super::health::Health;
use super::sequence::{SequenceTracker, Sequenced};

/// Takes a number with its device time; faults go to `sink`. `None` for one that was here before.
pub(super) fn count(
    tracker: &mut SequenceTracker,
    health: &mut Health,
    sequence: u32,
    device_us: u64,
    sink: &mut dyn FnMut(Event),
) -> Option<Sequenced> {
    let sequenced = tracker.take(sequence, device_us);
    let fault = match sequenced {
        Sequenced::Next => None,
        Sequenced::Gap(count) => {
            health.lost += u64::from(count);
            Some(DecodeFault::Lost { count, while_closed: false })
        }
        Sequenced::GapWhileClosed(count) => {
            health.missed_unplugged += u64::from(count);
            Some(DecodeFault::Lost { count, while_closed: true })
        }
        Sequenced::Duplicate => {
            health.duplicate += 1;
            sink(Event::Fault(DecodeFault::Duplicate { sequence }));
            return None;
        }
        Sequenced::Reordered => {
            health.reordered += 1;
            // It was counted as lost when the later one came.
            health.lost = health.lost.saturating_sub(1);
            Some(DecodeFault::Reordered { sequence })
        }
        Sequenced::Early(missing) => {
            health.reordered += 1;
            health.lost += u64::from(missing);
            Some(DecodeFault::Reordered { sequence })
        }
        Sequenced::Reset => {
            health.resets += 1;
            Some(DecodeFault::Reset { sequence })
        }
    };
    if let Some(fault) = fault {
        sink(Event::Fault(fault));
    }
    Some(sequenced)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A packet that came one place late was told as a frame lost and a frame late.
    #[test]
    fn a_late_packet_is_counted_late_and_not_lost() {
        let (mut tracker, mut health) = (SequenceTracker::default(), Health::default());
        let mut told = Vec::new();
        for n in [1, 2, 4, 3, 5, 8, 6] {
            count(&mut tracker, &mut health, n, 10 * u64::from(n), &mut |event| {
                if let Event::Fault(fault) = event {
                    told.push(fault.to_string());
                }
            });
        }
        // The seventh never came.
        assert_eq!((health.lost, health.reordered, health.resets), (1, 2, 0));
        let missing = |count: u32| format!("packets missing: {count}, lost unless they come late");
        assert_eq!(told, [missing(1), "packet 3 came late".to_owned(), missing(2), "packet 6 came late".to_owned()]);
    }
}
