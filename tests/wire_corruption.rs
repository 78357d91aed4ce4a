//! Corrupted packets by the million: how many pass the checksum with another content than was sent, against the odds of CRC-32C.
//!
//! CRC-32C has a Hamming distance of 6 up to 5 243 bits of data (Koopman 2002, "32-bit cyclic redundancy codes for Internet
//! applications"), and no packet of ours has more than 4 096: up to five wrong bits in a packet, and any burst up to 32 bits, are found
//! with certainty. On the line a wrong bit may hit the byte stuffing and so change the length; that, like any other damage, passes with a
//! probability of 2⁻³². `scripts/evaluate wire` runs as many as are asked for.

use std::sync::atomic::{AtomicU64, Ordering};

use crc::{CRC_32_ISCSI, Crc};
use sidecarm::telemetry::{DecodeFault, Decoder, DeviceKind, Event, FrameFault, SCHEMA_HASH, Sample};

use crate::telemetry_frames::frame;

/// Splitmix: fast, and every seed gives another stream.
struct Draw(u64);

impl Draw {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, n: usize) -> usize {
        ((u128::from(self.next()) * n as u128) >> 64) as usize
    }

    fn bytes(&mut self, count: usize) -> Vec<u8> {
        (0..count).map(|_| self.next() as u8).collect()
    }
}

/// What befalls a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Damage {
    /// So many wrong bits within the packet, before it is stuffed: found with certainty.
    PacketBits(usize),
    /// A burst of up to 32 bits within the packet, before it is stuffed: found with certainty.
    PacketBurst,
    /// So many wrong bits on the line.
    LineBits(usize),
    /// A burst of up to 64 wrong bits on the line.
    LineBurst,
    /// A run of random bytes.
    RandomBytes,
    /// Everything random, the length kept.
    AllRandom,
    /// The end is missing.
    Cut,
    /// The first half, and the second half of another packet.
    Joined,
    /// A byte more.
    Inserted,
    /// A byte less.
    Deleted,
    /// A run of bytes that became delimiters.
    Zeros,
    /// A stuck line: a run of 0xff.
    Ones,
}

const KINDS: [Damage; 15] = [
    Damage::PacketBits(1),
    Damage::PacketBits(2),
    Damage::PacketBits(3),
    Damage::PacketBurst,
    Damage::LineBits(1),
    Damage::LineBits(2),
    Damage::LineBits(3),
    Damage::LineBurst,
    Damage::RandomBytes,
    Damage::AllRandom,
    Damage::Cut,
    Damage::Joined,
    Damage::Inserted,
    Damage::Deleted,
    Damage::Zeros,
];

fn flip_bits(bytes: &mut [u8], count: usize, draw: &mut Draw) {
    let mut flipped: Vec<usize> = Vec::with_capacity(count);
    while flipped.len() < count {
        let bit = draw.below(bytes.len() * 8);
        if !flipped.contains(&bit) {
            flipped.push(bit);
            bytes[bit / 8] ^= 1 << (bit % 8);
        }
    }
}

/// Flips the first and the last of up to `longest` bits in a row, and those between at random.
fn burst(bytes: &mut [u8], longest: usize, draw: &mut Draw) {
    let length = 1 + draw.below(longest.min(bytes.len() * 8));
    let start = draw.below(bytes.len() * 8 - length + 1);
    for bit in start..start + length {
        if bit == start || bit + 1 == start + length || draw.next() & 1 == 1 {
            bytes[bit / 8] ^= 1 << (bit % 8);
        }
    }
}

fn run_of(bytes: &mut [u8], draw: &mut Draw, mut value: impl FnMut(&mut Draw) -> u8) {
    let start = draw.below(bytes.len());
    let end = (start + 1 + draw.below(24)).min(bytes.len());
    for byte in &mut bytes[start..end] {
        *byte = value(draw);
    }
}

/// A frame of `packet` without its delimiter, damaged; the damage may contain delimiters.
fn damaged(kind: Damage, line: &[u8], other: &[u8], draw: &mut Draw) -> Vec<u8> {
    let mut out = line.to_vec();
    match kind {
        Damage::PacketBits(_) | Damage::PacketBurst => {
            let mut packet = cobs::decode_vec(line).expect("a sound frame");
            match kind {
                Damage::PacketBits(count) => flip_bits(&mut packet, count, draw),
                _ => burst(&mut packet, 32, draw),
            }
            out = cobs::encode_vec(&packet);
        }
        Damage::LineBits(count) => flip_bits(&mut out, count, draw),
        Damage::LineBurst => burst(&mut out, 64, draw),
        Damage::RandomBytes => run_of(&mut out, draw, |draw| draw.next() as u8),
        Damage::AllRandom => out = draw.bytes(line.len()),
        Damage::Cut => out.truncate(draw.below(line.len())),
        Damage::Joined => {
            out.truncate(draw.below(line.len()));
            out.extend_from_slice(&other[draw.below(other.len())..]);
        }
        Damage::Inserted => out.insert(draw.below(line.len() + 1), draw.next() as u8),
        Damage::Deleted => {
            out.remove(draw.below(line.len()));
        }
        Damage::Zeros => run_of(&mut out, draw, |_| 0),
        Damage::Ones => run_of(&mut out, draw, |_| 0xff),
    }
    out
}

/// A packet of the C-arm with random joints and its number.
fn packet(sequence: u32, draw: &mut Draw) -> Vec<u8> {
    let mut payload: Vec<u8> = Vec::with_capacity(100);
    for _ in 0..7 {
        payload.extend(((draw.next() as f64 / u64::MAX as f64) * 360.0 - 180.0).to_le_bytes());
    }
    payload.extend(draw.bytes(36));
    payload.extend(sequence.to_le_bytes());
    payload.extend(0u32.to_le_bytes());
    let mut line = frame(1, 2, 1, sequence, u64::from(sequence) * 33_333, &payload);
    line.pop();
    line
}

#[derive(Debug, Default)]
struct Tally {
    packets: AtomicU64,
    /// Accepted with another content than any that was sent.
    undetected: AtomicU64,
    /// Of those, with a damage that must be found with certainty.
    impossible: AtomicU64,
    /// Accepted as they were sent: the damage missed the packet.
    intact: AtomicU64,
    /// Accepted by a checksum of which only eight bits are compared.
    weakly_accepted: AtomicU64,
}

/// The control's own check: of the checksum only the lowest eight bits.
fn accepted_weakly(pieces: &[u8], checksum: &Crc<u32>) -> bool {
    pieces.split(|byte| *byte == 0).any(|piece| {
        let Ok(packet) = cobs::decode_vec(piece) else { return false };
        let Some((body, found)) = packet.split_last_chunk::<4>().filter(|(body, _)| body.len() >= 16) else { return false };
        let mut digest = checksum.digest();
        digest.update(&SCHEMA_HASH.to_le_bytes());
        digest.update(body);
        (digest.finalize() ^ u32::from_le_bytes(*found)) & 0xff == 0
    })
}

/// Damages `count` packets of `seed`; every 64th also goes to the control.
fn search(seed: u64, count: u64, tally: &Tally) {
    let checksum = Crc::<u32>::new(&CRC_32_ISCSI);
    let mut draw = Draw(seed);
    let mut decoder = Decoder::new(DeviceKind::Carm);
    decoder.push(&[0], &mut |_| {});
    let mut other = packet(0, &mut draw);
    for trial in 0..count {
        // Numbers go on, so that whatever passes is not taken for a repetition.
        let line = packet(trial as u32 + 1, &mut draw);
        let kind = match trial % 16 {
            15 => Damage::Ones,
            index => KINDS[index as usize],
        };
        let wrong = damaged(kind, &line, &other, &mut draw);
        if wrong == line {
            other = line;
            continue;
        }
        let mut passed: Vec<Option<Sample>> = Vec::new();
        let mut stream = wrong.clone();
        stream.push(0);
        decoder.push(&stream, &mut |event| match event {
            Event::Sample(sample, _) => passed.push(Some(sample)),
            // Framing and checksum said no; lost numbers and resets come with a sample.
            Event::Fault(
                DecodeFault::Frame(FrameFault::Corrupt { .. } | FrameFault::Stuffing { .. })
                | DecodeFault::Overlong { .. }
                | DecodeFault::Lost { .. }
                | DecodeFault::Reordered { .. }
                | DecodeFault::Reset { .. }
                | DecodeFault::Duplicate { .. },
            ) => {}
            Event::Fault(_) => passed.push(None),
        });
        tally.packets.fetch_add(1, Ordering::Relaxed);
        for sample in passed {
            if sample.as_ref().is_some_and(|sample| sent(sample, &line) || sent(sample, &other)) {
                tally.intact.fetch_add(1, Ordering::Relaxed);
            } else {
                println!("undetected: {kind:?}, seed {seed:#x}, trial {trial}: {sample:?}");
                tally.undetected.fetch_add(1, Ordering::Relaxed);
                let certain = matches!(kind, Damage::PacketBits(_) | Damage::PacketBurst);
                tally.impossible.fetch_add(u64::from(certain), Ordering::Relaxed);
            }
        }
        if trial % 64 < 16 && !matches!(kind, Damage::Zeros | Damage::Inserted | Damage::Joined) {
            tally.weakly_accepted.fetch_add(u64::from(accepted_weakly(&wrong, &checksum)), Ordering::Relaxed);
        }
        other = line;
    }
}

/// Whether `sample` is what `line` says, bit for bit.
fn sent(sample: &Sample, line: &[u8]) -> bool {
    let mut decoder = Decoder::new(DeviceKind::Carm);
    let mut same = false;
    decoder.push(&[&[0], line, &[0]].concat(), &mut |event| {
        // NaN differs from itself; its text does not.
        same |= matches!(&event, Event::Sample(found, _) if format!("{found:?}") == format!("{sample:?}"));
    });
    same
}

/// The largest count that chance brings with a probability above one in a million, when `expected` are expected (Poisson).
fn most_by_chance(expected: f64) -> u64 {
    let mut term = (-expected).exp();
    let mut below = term;
    let mut count = 0;
    while 1.0 - below > 1e-6 {
        count += 1;
        term *= expected / count as f64;
        below += term;
    }
    count
}

fn judge(count: u64, seed: u64) {
    let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get) as u64;
    let tally = Tally::default();
    std::thread::scope(|scope| {
        for thread in 0..threads {
            let share = count / threads + u64::from(thread < count % threads);
            let tally = &tally;
            scope.spawn(move || search(seed.wrapping_add(thread << 48), share, tally));
        }
    });
    let load = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
    let expected = load(&tally.packets) as f64 / 2f64.powi(32);
    let most = most_by_chance(expected);
    println!(
        "{} corrupted packets (seed {seed}): {} undetected, {expected:.4} expected by the odds of 2^-32 each, at most {most} by chance; \
         {} intact beside the damage; control with 8 bits of the checksum: {} accepted",
        load(&tally.packets),
        load(&tally.undetected),
        load(&tally.intact),
        load(&tally.weakly_accepted)
    );
    assert!(load(&tally.packets) > count / 2, "most damages change something");
    assert_eq!(load(&tally.impossible), 0, "up to five wrong bits and bursts of 32 are found with certainty");
    assert!(load(&tally.undetected) <= most, "{} undetected, at most {most} by chance", load(&tally.undetected));
    // The control: the same search finds what a weaker check lets through. About one in 256 of a fifth of the packets.
    assert!(load(&tally.weakly_accepted) * 256 * 16 > count, "{tally:?}");
}

#[test]
fn no_corrupted_packet_passes_beyond_the_odds() {
    judge(400_000, 2024);
}

#[test]
fn the_odds_are_poissons() {
    assert_eq!(most_by_chance(0.0), 0);
    assert_eq!(most_by_chance(1e-7), 0);
    // 1e8 packets: 0.023 expected; 1 - e^-0.0233 (1 + 0.0233 + 0.0233²/2) = 2.1e-6, with the next term 1.2e-8.
    assert_eq!(most_by_chance(1e8 / 2f64.powi(32)), 3);
}

#[test]
#[ignore = "minutes long: scripts/evaluate wire runs it"]
fn a_hundred_million_corrupted_packets_pass_only_by_the_odds() {
    let count = std::env::var("SIDECARM_PACKETS").ok().and_then(|count| count.parse().ok()).unwrap_or(100_000_000);
    judge(count, 1);
}
