//! Faults of a line: what happens to packets between the device's encoder and the receiver's port.
//!
//! ```no_run
//! use mock_lab::fault::{Channel, FaultKind};
//! use mock_lab::pty::Line;
//! use rand::SeedableRng;
//!
//! # fn main() -> Result<(), mock_lab::MockError> {
//! let mut channel = Channel::new(Line::open("/tmp/lab/ttyCARM".as_ref())?);
//! let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(1);
//! channel.inject(FaultKind::Tear); // befalls the next packet
//! channel.send(b"\x03\x01\x02\x00", 0.0, &mut random)?;
//! # Ok(())
//! # }
//! ```

use std::collections::VecDeque;

use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};

use crate::MockError;
use crate::pty::Line;

/// What goes wrong on a line: with one packet, for a while (`Delay`, `Unplug`, `Away`), or for good (`Mute`, `Gone`,
/// `Freeze`, `Stuck`, `Stale`, `Restart`, `Jump`, `Ahead`, `Back`, `Millis`, `Other`).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FaultKind {
    /// The packet is not sent: one lost.
    Drop,
    /// One bit is wrong: one corrupt and one lost.
    Flip,
    /// The second half, delimiter included, is not sent, so that what is left runs into the next packet: one corrupt, two lost.
    Tear,
    /// The packet is sent twice.
    Duplicate,
    /// The packet changes places with the next one.
    Reorder,
    /// This packet and those of the next 80 ms arrive at once, in order.
    Delay,
    /// The plug is pulled; [`Channel::unplugged_s`] later there is another pseudo-terminal behind the same link.
    Unplug,
    /// The same, and by the device an hour has passed when it is back: its clock, which gains 200 ppm meanwhile, and its count went on.
    Away,
    /// The line stays open, and nothing is sent any more.
    Mute,
    /// The plug is pulled and stays out.
    Gone,
    /// The device's clock stands still; packets go on.
    Freeze,
    /// All that the device measures has the same time for ever; what it says of itself has the right one.
    Stuck,
    /// All that the device measures stays what it was, but for noise; its clock and its numbers go on.
    Stale,
    /// The device begins anew: its clock and the numbers of its packets start at zero.
    Restart,
    /// The device's clock is set 5 s ahead; the numbers of its packets go on.
    Jump,
    /// The same, an hour ahead.
    Ahead,
    /// The same, an hour back, to zero at most.
    Back,
    /// The device's clock counts milliseconds in place of microseconds.
    Millis,
    /// Another device of the same kind goes on in its place: by its serial number alone.
    Other,
}

impl FaultKind {
    /// All of them.
    pub const ALL: [Self; 19] = [
        Self::Drop,
        Self::Flip,
        Self::Tear,
        Self::Duplicate,
        Self::Reorder,
        Self::Delay,
        Self::Unplug,
        Self::Away,
        Self::Mute,
        Self::Gone,
        Self::Freeze,
        Self::Stuck,
        Self::Stale,
        Self::Restart,
        Self::Jump,
        Self::Ahead,
        Self::Back,
        Self::Millis,
        Self::Other,
    ];

    /// The kind's name in files, events and on the command line.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Drop => "drop",
            Self::Flip => "flip",
            Self::Tear => "tear",
            Self::Duplicate => "duplicate",
            Self::Reorder => "reorder",
            Self::Delay => "delay",
            Self::Unplug => "unplug",
            Self::Away => "away",
            Self::Mute => "mute",
            Self::Gone => "gone",
            Self::Freeze => "freeze",
            Self::Stuck => "stuck",
            Self::Stale => "stale",
            Self::Restart => "restart",
            Self::Jump => "jump",
            Self::Ahead => "ahead",
            Self::Back => "back",
            Self::Millis => "millis",
            Self::Other => "other",
        }
    }
}

/// How long [`FaultKind::Delay`] holds packets back.
const DELAY_S: f64 = 0.08;

/// Packets held back.
#[derive(Debug)]
enum Held {
    Nothing,
    /// Goes out after the next packet.
    Behind(Vec<u8>),
    /// Go out together, in order, at `until_s`.
    Together {
        packets: Vec<u8>,
        until_s: f64,
    },
}

/// A line with faults. Time is the caller's, in seconds, and only ever grows.
#[derive(Debug)]
pub struct Channel {
    /// The line.
    pub line: Line,
    /// How long an unplugged line stays away.
    pub unplugged_s: f64,
    /// What ends a packet: a line that is plugged in again begins with it.
    pub delimiter: u8,
    due: VecDeque<FaultKind>,
    muted: bool,
    held: Held,
    plug_at_s: Option<f64>,
}

impl Channel {
    /// A faultless channel on `line`.
    #[must_use]
    pub fn new(line: Line) -> Self {
        Self { line, unplugged_s: 1.0, delimiter: 0, due: VecDeque::new(), muted: false, held: Held::Nothing, plug_at_s: None }
    }

    /// Lets `kind` befall the next packet that is not under the spell of an earlier fault.
    pub fn inject(&mut self, kind: FaultKind) {
        self.due.push_back(kind);
    }

    /// Replugs a line whose time has come; true when it did.
    ///
    /// # Errors
    /// When the system has no pseudo-terminal left or the link cannot be made.
    pub fn tick(&mut self, at_s: f64) -> Result<bool, MockError> {
        if !self.plug_at_s.is_some_and(|plug_at_s| at_s >= plug_at_s) {
            return Ok(false);
        }
        self.plug_at_s = None;
        self.line.plug()?;
        self.line.write(&[self.delimiter]);
        Ok(true)
    }

    /// Sends one framed packet, delimiter included, or what a fault leaves of it.
    ///
    /// # Errors
    /// As [`Channel::tick`].
    pub fn send(&mut self, packet: &[u8], at_s: f64, random: &mut impl Rng) -> Result<(), MockError> {
        self.tick(at_s)?;
        if self.muted {
            return Ok(());
        }
        match std::mem::replace(&mut self.held, Held::Nothing) {
            Held::Nothing => {}
            Held::Behind(earlier) => {
                self.line.write(packet);
                self.line.write(&earlier);
                return Ok(());
            }
            Held::Together { mut packets, until_s } => {
                packets.extend(packet);
                if at_s >= until_s {
                    self.line.write(&packets);
                } else {
                    self.held = Held::Together { packets, until_s };
                }
                return Ok(());
            }
        }
        match self.due.pop_front() {
            // A clock is the device's, not the line's, and so is its number.
            None
            | Some(
                FaultKind::Freeze
                | FaultKind::Stuck
                | FaultKind::Stale
                | FaultKind::Restart
                | FaultKind::Jump
                | FaultKind::Ahead
                | FaultKind::Back
                | FaultKind::Millis
                | FaultKind::Other,
            ) => self.line.write(packet),
            Some(FaultKind::Drop) => {}
            Some(FaultKind::Flip) => self.line.write(&flipped(packet, random)),
            Some(FaultKind::Tear) => self.line.write(&packet[..packet.len() / 2]),
            Some(FaultKind::Duplicate) => {
                self.line.write(packet);
                self.line.write(packet);
            }
            Some(FaultKind::Reorder) => self.held = Held::Behind(packet.to_vec()),
            Some(FaultKind::Delay) => self.held = Held::Together { packets: packet.to_vec(), until_s: at_s + DELAY_S },
            Some(FaultKind::Unplug | FaultKind::Away) => {
                self.line.unplug();
                self.plug_at_s = Some(at_s + self.unplugged_s);
            }
            Some(FaultKind::Mute) => self.muted = true,
            Some(FaultKind::Gone) => self.line.unplug(),
        }
        Ok(())
    }
}

/// `packet` with one bit wrong that does not turn into a delimiter, which would be a tear.
fn flipped(packet: &[u8], random: &mut impl Rng) -> Vec<u8> {
    let mut out = packet.to_vec();
    let at = random.random_range(0..out.len().saturating_sub(1).max(1));
    let bit = 1u8 << random.random_range(0..8u32);
    out[at] ^= if out[at] == bit { bit.rotate_left(1) } else { bit };
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    #[test]
    fn a_flip_changes_one_bit_and_makes_no_delimiter() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        let packet = [1, 2, 4, 8, 16, 32, 64, 128, 255, 0];
        for _ in 0..500 {
            let wrong = flipped(&packet, &mut random);
            let bits: u32 = wrong.iter().zip(&packet).map(|(a, b)| (a ^ b).count_ones()).sum();
            assert_eq!((bits, wrong.iter().filter(|byte| **byte == 0).count()), (1, 1), "{wrong:?}");
        }
    }
}
