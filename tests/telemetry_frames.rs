//! Frames for the telemetry tests: the golden ones of `mocks/PROTOCOL.md`, and a sender written after it.

use crc::{CRC_32_ISCSI, Crc};
use sidecarm::telemetry::{Decoder, DeviceKind, Event, SCHEMA_HASH};

pub const GOLDEN_ROBOT: &str = "0401010303d2040105b168de3a010101010103803f010102400101023f010380bf010101010103903f010310400101023f0103a0bf0103803d01036040010380be010348410103403f010360c00103803e010318410101023f010101010420594001010101044034c0010101010470974001010101010101010101010101010111333333333333e33f9a9999999999e93f0103fa4501010105798fcff700";
pub const GOLDEN_CARM: &str = "04010201024d010106141a99be1c0101010101010104205e400101010101030ac0010101010103444001010101010329400101010104403ec0010101010103f87f0101010104e08f40010394420103604001010241010390400103803e0103f0c20103bac20103f0420104ba42110101010101010510ef226a00";
pub const GOLDEN_METADATA: &str = "03010301024e010101054599be1c0101030207013241eb579a094341524d2d3030343205312e342e320c6361726d2d6e6f6d696e616c0f6d6d2c6465672c6b562c6d412c6d73010101010103c843010320c101032041010101010103484301033ec301033e430103b4c20103b442010334c30103344301036144010796449845911500";

/// Bytes of hexadecimal digits.
pub fn bytes(hex: &str) -> Vec<u8> {
    (0..hex.len()).step_by(2).map(|at| u8::from_str_radix(&hex[at..at + 2], 16).expect("hexadecimal")).collect()
}

/// A whole frame, delimiter included.
pub fn frame(version: u8, message: u8, flags: u16, sequence: u32, device_us: u64, payload: &[u8]) -> Vec<u8> {
    frame_of_schema(SCHEMA_HASH, version, message, flags, sequence, device_us, payload)
}

pub fn frame_of_schema(
    schema: u32,
    version: u8,
    message: u8,
    flags: u16,
    sequence: u32,
    device_us: u64,
    payload: &[u8],
) -> Vec<u8> {
    let mut packet = vec![version, message];
    packet.extend(flags.to_le_bytes());
    packet.extend(sequence.to_le_bytes());
    packet.extend(device_us.to_le_bytes());
    packet.extend(payload);
    let crc = Crc::<u32>::new(&CRC_32_ISCSI);
    let mut digest = crc.digest();
    digest.update(&schema.to_le_bytes());
    digest.update(&packet);
    packet.extend(digest.finalize().to_le_bytes());
    let mut stuffed = cobs::encode_vec(&packet);
    stuffed.push(0);
    stuffed
}

/// A C-arm frame with joints in the units of the wire.
pub fn carm(sequence: u32, device_us: u64, joints: [f64; 7], xray_on: bool, counter: Option<u32>) -> Vec<u8> {
    let mut payload: Vec<u8> = joints.iter().flat_map(|joint| joint.to_le_bytes()).collect();
    for value in [74.0f32, 3.5, 8.0, 4.5, 0.25, -120.0, -93.0, 120.0, 93.0] {
        payload.extend(value.to_le_bytes());
    }
    payload.extend(counter.unwrap_or(u32::MAX).to_le_bytes());
    payload.extend(0u32.to_le_bytes());
    frame(1, 2, u16::from(xray_on), sequence, device_us, &payload)
}

/// A C-arm frame that says little.
pub fn plain(sequence: u32) -> Vec<u8> {
    carm(sequence, u64::from(sequence) * 33_333, [0.0, 0.0, 0.0, 0.0, f64::from(sequence % 90), 0.0, 1020.0], false, None)
}

/// All events of `stream`, pushed in chunks of `chunk` bytes, and the decoder afterwards.
pub fn decode(device: DeviceKind, stream: &[u8], chunk: usize) -> (Vec<Event>, Decoder) {
    let mut decoder = Decoder::new(device);
    let mut events = Vec::new();
    for part in stream.chunks(chunk) {
        decoder.push(part, &mut |event| events.push(event));
    }
    (events, decoder)
}
