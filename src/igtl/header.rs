//! The 58 bytes in front of each message (`Documents/Protocol/header.md`, `timestamp.md`): all numbers big-endian, text padded with zeros.

use crc::{CRC_64_ECMA_182, Crc, Table};

/// Bytes of a header.
pub const HEADER_BYTES: usize = 58;
/// Characters of a type's name.
pub const TYPE_BYTES: usize = 12;
/// Characters of a device's name.
pub const DEVICE_BYTES: usize = 20;
/// Bytes of the extended header that header version 2 puts in front of the content.
pub const EXTENDED_BYTES: usize = 12;

/// CRC-64 of ECMA-182, as the protocol takes it over a body: not reflected, from zero.
pub(super) static BODY_CRC: Crc<u64, Table<16>> = Crc::<u64, Table<16>>::new(&CRC_64_ECMA_182);

/// The format of header and body.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum HeaderVersion {
    /// Protocol versions 1 and 2: the body is the content.
    #[default]
    V1,
    /// Protocol version 3: the body is extended header, content and metadata.
    V2,
}

/// A message's header.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Header {
    /// As written; the format of the body goes by [`Header::format`].
    pub version: u16,
    /// `TRANSFORM`, `GET_STATUS` ….
    pub type_name: String,
    /// Of whom.
    pub device: String,
    /// Seconds since 1970 in 32.32 bits; 0 where there is none.
    pub stamp: u64,
    /// Bytes behind the header.
    pub body_bytes: u64,
    /// Of the body.
    pub crc: u64,
}

impl Header {
    /// The format of what follows; a later version is taken for the latest that is known.
    #[must_use]
    pub fn format(&self) -> HeaderVersion {
        if self.version < 2 { HeaderVersion::V1 } else { HeaderVersion::V2 }
    }

    /// As bytes; names that are too long are cut.
    #[must_use]
    pub fn to_bytes(&self) -> [u8; HEADER_BYTES] {
        let mut bytes = [0; HEADER_BYTES];
        bytes[..2].copy_from_slice(&self.version.to_be_bytes());
        bytes[2..14].copy_from_slice(&padded::<TYPE_BYTES>(&self.type_name));
        bytes[14..34].copy_from_slice(&padded::<DEVICE_BYTES>(&self.device));
        bytes[34..42].copy_from_slice(&self.stamp.to_be_bytes());
        bytes[42..50].copy_from_slice(&self.body_bytes.to_be_bytes());
        bytes[50..].copy_from_slice(&self.crc.to_be_bytes());
        bytes
    }

    /// From bytes, as they are: nothing is checked but that names are read up to their first zero.
    #[must_use]
    pub fn from_bytes(bytes: &[u8; HEADER_BYTES]) -> Self {
        let number = |at: usize| bytes[at..at + 8].iter().fold(0, |number, byte| number << 8 | u64::from(*byte));
        Self {
            version: u16::from_be_bytes([bytes[0], bytes[1]]),
            type_name: text(&bytes[2..14]),
            device: text(&bytes[14..34]),
            stamp: number(34),
            body_bytes: number(42),
            crc: number(50),
        }
    }
}

/// `host_us` since 1970 as 32.32 bits of seconds, rounded to the nearest; 0 (no stamp) before 1970.
#[must_use]
pub fn stamp_of_us(host_us: i64) -> u64 {
    let us = u128::try_from(host_us).unwrap_or(0);
    // Seconds run over in 2106, as the protocol has it.
    (((us << 32) + 500_000) / 1_000_000) as u64
}

/// `text` in exactly `N` bytes, ASCII, cut or padded with zeros.
pub(super) fn padded<const N: usize>(text: &str) -> [u8; N] {
    let mut bytes = [0; N];
    for (byte, c) in bytes.iter_mut().zip(text.chars()) {
        *byte = if c.is_ascii_graphic() || c == ' ' { c as u8 } else { b'?' };
    }
    bytes
}

/// Appends `value` as the protocol's float32.
pub(super) fn float32(out: &mut Vec<u8>, value: f64) {
    out.extend((value as f32).to_be_bytes());
}

fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stamp_is_seconds_and_their_fraction() {
        assert_eq!(stamp_of_us(1_500_000), 0x0000_0001_8000_0000);
        assert_eq!(stamp_of_us(-1), 0);
        // A microsecond is 4295 parts of 2⁻³² s; going there and back keeps it.
        let back = |stamp: u64| (u128::from(stamp) * 1_000_000 + (1 << 31)) >> 32;
        for us in [1, 999_999, 1_700_000_000_123_456] {
            assert_eq!(back(stamp_of_us(us)), us as u128);
        }
    }

    #[test]
    fn a_header_comes_back_from_its_bytes_and_names_fit() {
        let header = Header {
            version: 2,
            type_name: "GET_STATUS".to_owned(),
            device: "A name that is too long for it".to_owned(),
            stamp: 7,
            body_bytes: 12,
            crc: u64::MAX - 3,
        };
        let back = Header::from_bytes(&header.to_bytes());
        assert_eq!(back.device, "A name that is too l");
        assert_eq!(back, Header { device: back.device.clone(), ..header });
        assert_eq!(padded::<4>("aµ"), *b"a?\0\0");
    }
}
