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
