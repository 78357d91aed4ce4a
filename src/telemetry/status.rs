//! What the bits of a device's status word say: the devices' protocol, in words.

use super::device::DeviceKind;

/// The lowest bit first.
const CARM_STATUS: [&str; 2] = ["fault", "emergency stop"];
const ROBOT_STATUS: [&str; 3] = ["fault", "emergency stop", "homing"];

/// The bits of `status` that are set, in words, the lowest first; bits that the protocol does not know by their number.
#[must_use]
pub fn status_words(device: DeviceKind, status: u32) -> Vec<String> {
    let names: &[&str] = if device == DeviceKind::Carm { &CARM_STATUS } else { &ROBOT_STATUS };
    let word = |bit: usize| names.get(bit).map_or_else(|| format!("status bit {bit}"), |name| (*name).to_owned());
    (0..32).filter(|bit| status >> bit & 1 == 1).map(word).collect()
}
