//! What a line has lost, in a sentence; counters alone do not reach anybody.

use crate::telemetry::{DeviceKind, Health};

/// `None` when nothing was lost.
pub(super) fn line_losses(device: DeviceKind, health: &Health) -> Option<String> {
    let counted = [
        (health.lost, "packets lost on the line"),
        (health.missed_unplugged, "packets missed while it was unplugged"),
        (health.corrupt, "corrupt packets"),
        (health.wrong_device, "packets of the other device (are the ports swapped?)"),
        (health.schema_mismatch + health.version_mismatch, "packets of another protocol (other firmware?)"),
        (health.malformed + health.unknown_message, "packets that make no sense"),
        (health.overlong, "stretches of bytes that are no packets (another speed, or another device?)"),
    ];
    let mut words: Vec<String> =
        counted.iter().filter(|(count, _)| *count > 0).map(|(count, what)| format!("{count} {what}")).collect();
    if health.bytes > 0 && health.frames == 0 {
        words.push(format!("{} bytes and not one packet of it", health.bytes));
    }
    (!words.is_empty()).then(|| format!("{device}: {}", words.join(", ")))
}
