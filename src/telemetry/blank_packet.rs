//! A packet without what a device tells of itself in words: whose it is, and whatever else somebody wrote there.

use std::ops::Range;

use super::lines::is_unit;
use super::wire::{CRC_BYTES, HEADER_BYTES, METADATA, SCHEMA_HASH, seeded_crc};

/// What a packet may tell of whose device it is, as it lies on the line without its delimiter.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Telling {
    /// Intact, and it tells nothing.
    Nothing,
    /// Intact; the same with other letters for serial number, firmware, calibration and what are no units, as long as it was.
    Blanked(Vec<u8>),
    /// Not intact: what its bytes mean is not known.
    Unknown,
}

/// Letters that may stand for others: with one of them the stuffing is as long as before.
const FILLERS: &[u8] = b"xyzwvutsrqponm";

/// Takes serial number, firmware and calibration out of a packet that tells them, and of its units whatever is none.
#[must_use]
pub fn blanked(stuffed: &[u8]) -> Telling {
    let mut packet = stuffed.to_vec();
    let Ok(length) = cobs::decode_in_place(&mut packet) else { return Telling::Unknown };
    packet.truncate(length);
    let Some((body, crc)) = packet.split_last_chunk::<CRC_BYTES>().filter(|(body, _)| body.len() >= HEADER_BYTES) else {
        return Telling::Unknown;
    };
    if u32::from_le_bytes(*crc) != seeded_crc(SCHEMA_HASH, body) {
        return Telling::Unknown;
    }
    if body[1] != METADATA {
        return Telling::Nothing;
    }
    let Some([serial_number, firmware, calibration_id, units]) = texts_of_metadata(body) else { return Telling::Unknown };
    let no_units = words_of(body, units).into_iter().filter(|word| !is_known(&body[word.clone()]));
    let places: Vec<Range<usize>> = [serial_number, firmware, calibration_id].into_iter().chain(no_units).collect();
    let with = |filler: u8| {
        let mut body = body.to_vec();
        for place in &places {
            body[place.clone()].iter_mut().filter(|byte| **byte != 0).for_each(|byte| *byte = filler);
        }
        let crc = seeded_crc(SCHEMA_HASH, &body);
        body.extend(crc.to_le_bytes());
        cobs::encode_vec(&body)
    };
    let as_long = FILLERS.iter().map(|filler| with(*filler)).find(|packet| packet.len() == stuffed.len());
    as_long.map_or(Telling::Unknown, Telling::Blanked)
}

/// Where the four texts of a metadata message lie in its packet.
fn texts_of_metadata(body: &[u8]) -> Option<[Range<usize>; 4]> {
    let mut at = HEADER_BYTES + 8;
    let mut places = [0..0, 0..0, 0..0, 0..0];
    for place in &mut places {
        let length = usize::from(*body.get(at)?);
        *place = at + 1..at + 1 + length;
        at += 1 + length;
    }
    (at <= body.len()).then_some(places)
}

/// Where the words of a list lie that is in `place`.
fn words_of(body: &[u8], place: Range<usize>) -> Vec<Range<usize>> {
    let is_between = |byte: &u8| matches!(byte, b',' | b';' | b' ');
    let mut at = place.start;
    let words = body[place].split(is_between).map(|word| {
        let start = at;
        at += word.len() + 1;
        start..start + word.len()
    });
    words.collect()
}

fn is_known(word: &[u8]) -> bool {
    std::str::from_utf8(word).is_ok_and(is_unit)
}
