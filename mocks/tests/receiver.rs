//! A receiver that reads ports the plain way and counts what `PROTOCOL.md` says a receiver counts.

use std::fs::File;
use std::io::Read;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

/// Packets and counts of one stream of bytes.
#[derive(Debug, Default, PartialEq, Eq)]
pub struct Heard {
    /// Message, flags, sequence, device time, payload.
    pub packets: Vec<(u8, u16, u32, u64, Vec<u8>)>,
    pub corrupt: usize,
    pub lost: u32,
    pub duplicate: usize,
    pub reordered: usize,
}

/// Opens a port without waiting for data.
pub fn open(path: &Path) -> File {
    // O_NONBLOCK | O_NOCTTY as Linux has them.
    File::options().read(true).custom_flags(0o4000 | 0o400).open(path).expect("port opens")
}

/// What the port holds now.
pub fn read_available(port: &mut File) -> Vec<u8> {
    let mut out = Vec::new();
    let mut buffer = [0; 4096];
    while let Ok(count @ 1..) = port.read(&mut buffer) {
        out.extend(&buffer[..count]);
    }
    out
}

/// Decodes a stream from its beginning.
pub fn hear(bytes: &[u8]) -> Heard {
    let mut heard = Heard::default();
    let mut expected: Option<u32> = None;
    for encoded in bytes.split(|byte| *byte == 0).filter(|encoded| !encoded.is_empty()) {
        let Some(packet) = uncobs(encoded).filter(|packet| packet.len() >= 20 && packet[0] == 1 && crc_fits(packet)) else {
            heard.corrupt += 1;
            continue;
        };
        let word = |at: usize| u32::from_le_bytes(packet[at..at + 4].try_into().expect("four bytes"));
        let sequence = word(4);
        match expected.map(|expected| sequence.wrapping_sub(expected) as i32) {
            None | Some(0) => expected = Some(sequence.wrapping_add(1)),
            Some(-1) => heard.duplicate += 1,
            Some(ahead @ 1..) => {
                heard.lost += ahead as u32;
                expected = Some(sequence.wrapping_add(1));
            }
            Some(_) => {
                heard.reordered += 1;
                heard.lost = heard.lost.saturating_sub(1);
            }
        }
        let device_us = u64::from_le_bytes(packet[8..16].try_into().expect("eight bytes"));
        let flags = u16::from_le_bytes([packet[2], packet[3]]);
        heard.packets.push((packet[1], flags, sequence, device_us, packet[16..packet.len() - 4].to_vec()));
    }
    heard
}

fn uncobs(encoded: &[u8]) -> Option<Vec<u8>> {
    let mut out = Vec::new();
    let mut rest = encoded;
    while let Some((code, tail)) = rest.split_first() {
        let block = usize::from(*code) - 1;
        out.extend(tail.get(..block)?);
        rest = &tail[block..];
        if *code != 255 && !rest.is_empty() {
            out.push(0);
        }
    }
    Some(out)
}

/// CRC-32C by polynomial division of the whole message at once, most significant bit last.
fn crc_fits(packet: &[u8]) -> bool {
    let (body, found) = packet.split_at(packet.len() - 4);
    let message = 0x9A57_EB41u32.to_le_bytes();
    let mut register = u32::MAX;
    for byte in message.iter().chain(body) {
        for bit in 0..8 {
            let feedback = (register ^ u32::from(byte >> bit)) & 1;
            register = (register >> 1) ^ (feedback * 0x82F6_3B78);
        }
    }
    (register ^ u32::MAX).to_le_bytes() == found
}
