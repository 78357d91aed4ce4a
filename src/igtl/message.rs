//! What is sent: a content of a device at a time, and its bytes.
//!
//! f64 until here; the protocol has float32 (`Documents/Protocol/transform.md`, `position.md`, `string.md`, `status.md`, `capability.md`).

use super::header::{BODY_CRC, EXTENDED_BYTES, HEADER_BYTES, Header, HeaderVersion, TYPE_BYTES, float32, padded, stamp_of_us};
use super::picture::Picture;
use crate::geometry::Rigid;

/// Longest text that is sent, in bytes; longer ones are cut.
const MOST_TEXT_BYTES: usize = 4000;
/// Codes of the characters of a STRING (IANA MIBenum).
const ASCII: u16 = 3;
const UTF8: u16 = 106;
/// Message types that are sent, for whoever asks for them.
const TYPES: [&str; 6] = ["TRANSFORM", "POSITION", "IMAGE", "STRING", "STATUS", "CAPABILITY"];

/// A message.
#[derive(Clone, Debug, PartialEq)]
pub struct Message {
    /// Of whom: ASCII, at most 20 characters.
    pub device: String,
    /// When it was so, host time; negative for no time.
    pub time_us: i64,
    /// What.
    pub content: Content,
}

/// What a message says.
#[derive(Clone, Debug, PartialEq)]
pub enum Content {
    /// A rigid transform, mm.
    Transform(Rigid),
    /// A place, mm, with the orientation there.
    Position(Rigid),
    /// A picture and where it lies.
    Image(Picture),
    /// A line for a person.
    Text(String),
    /// How the sender is.
    Status(Status),
    /// The types that are sent.
    Capability,
}

/// How the sender is (`status.md`).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Status {
    /// The protocol's code: [`Status::OK`] ….
    pub code: u16,
    /// The sender's own number: that of the frame, 0 where there is none.
    pub frame: i64,
    /// In a word or two: ASCII, at most 20 characters.
    pub name: String,
    /// In a sentence.
    pub words: String,
}

impl Status {
    /// All is well.
    pub const OK: u16 = 1;
    /// Something is not well; the words say what.
    pub const ERROR: u16 = 2;
    /// Nothing to tell yet.
    pub const NOT_READY: u16 = 13;
    /// The sender is about to leave.
    pub const LEAVING: u16 = 19;
}

impl Content {
    /// The name of its type.
    #[must_use]
    pub fn type_name(&self) -> &'static str {
        match self {
            Self::Transform(_) => "TRANSFORM",
            Self::Position(_) => "POSITION",
            Self::Image(_) => "IMAGE",
            Self::Text(_) => "STRING",
            Self::Status(_) => "STATUS",
            Self::Capability => "CAPABILITY",
        }
    }

    fn write(&self, out: &mut Vec<u8>) {
        match self {
            Self::Transform(transform) => {
                let rows = transform.to_rows();
                // Column by column: three of the rotation, then the translation.
                (0..4).flat_map(|column| rows[..3].iter().map(move |row| row[column])).for_each(|value| float32(out, value));
            }
            Self::Position(place) => {
                place
                    .translation_mm
                    .to_array()
                    .into_iter()
                    .chain(place.rotation.to_array())
                    .for_each(|value| float32(out, value));
            }
            Self::Image(picture) => picture.write(out),
            Self::Text(text) => {
                let text = cut(text);
                let encoding = if text.is_ascii() { ASCII } else { UTF8 };
                out.extend(encoding.to_be_bytes());
                out.extend((text.len() as u16).to_be_bytes());
                out.extend(text.as_bytes());
            }
            Self::Status(status) => {
                out.extend(status.code.to_be_bytes());
                out.extend(status.frame.to_be_bytes());
                out.extend(padded::<20>(&status.name));
                out.extend(cut(&status.words).as_bytes());
                // The library counts the closing zero in.
                out.push(0);
            }
            Self::Capability => TYPES.iter().for_each(|name| out.extend(padded::<TYPE_BYTES>(name))),
        }
    }
}

impl Message {
    /// Whether every number in it is one; NaN and infinity are not sent.
    #[must_use]
    pub fn is_finite(&self) -> bool {
        match &self.content {
            Content::Transform(rigid) | Content::Position(rigid) => {
                rigid.rotation.is_finite() && rigid.translation_mm.is_finite()
            }
            Content::Image(picture) => picture.placement.is_finite(),
            Content::Text(_) | Content::Status(_) | Content::Capability => true,
        }
    }

    /// Header and body.
    #[must_use]
    pub fn encode(&self, version: HeaderVersion) -> Vec<u8> {
        let mut bytes = vec![0; HEADER_BYTES];
        if version == HeaderVersion::V2 {
            // Sizes of extended header, metadata's header and metadata; the message's number, which is not used.
            bytes.extend((EXTENDED_BYTES as u16).to_be_bytes());
            bytes.extend(2u16.to_be_bytes());
            bytes.extend([0; 8]);
        }
        self.content.write(&mut bytes);
        if version == HeaderVersion::V2 {
            // The metadata's header: how many entries there are.
            bytes.extend(0u16.to_be_bytes());
        }
        let body = &bytes[HEADER_BYTES..];
        let header = Header {
            version: if version == HeaderVersion::V2 { 2 } else { 1 },
            type_name: self.content.type_name().to_owned(),
            device: self.device.clone(),
            stamp: stamp_of_us(self.time_us),
            body_bytes: body.len() as u64,
            crc: BODY_CRC.checksum(body),
        };
        bytes[..HEADER_BYTES].copy_from_slice(&header.to_bytes());
        bytes
    }
}

fn cut(text: &str) -> &str {
    &text[..text.floor_char_boundary(MOST_TEXT_BYTES)]
}

#[cfg(test)]
mod tests {
    use glam::{DQuat, DVec3};

    use super::*;

    #[test]
    fn a_transform_is_sent_column_by_column() {
        let rotation = DQuat::from_rotation_z(std::f64::consts::FRAC_PI_2);
        let transform = Rigid { rotation, translation_mm: DVec3::new(1.0, 2.0, 3.0) };
        let message = Message { device: "BaseToLps".to_owned(), time_us: 0, content: Content::Transform(transform) };
        let bytes = message.encode(HeaderVersion::V1);
        let values: Vec<f32> = bytes[58..].chunks(4).map(|b| f32::from_be_bytes([b[0], b[1], b[2], b[3]])).collect();
        // x goes to y, y to −x.
        let wanted = [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 2.0, 3.0];
        assert!(values.len() == 12 && values.iter().zip(wanted).all(|(a, b): (&f32, f32)| (a - b).abs() < 1e-6), "{values:?}");
    }

    #[test]
    fn the_second_header_version_wraps_the_same_content() {
        let message = Message { device: "Frame".to_owned(), time_us: 5, content: Content::Text("frame 1 · ok".to_owned()) };
        let (one, two) = (message.encode(HeaderVersion::V1), message.encode(HeaderVersion::V2));
        assert_eq!(two.len(), one.len() + EXTENDED_BYTES + 2);
        assert_eq!(two[58 + EXTENDED_BYTES..two.len() - 2], one[58..]);
        assert_eq!((one[1], two[1]), (1, 2));
        assert_eq!(one[58..62], [0, 106, 0, 13], "the point is no ASCII");
    }

    #[test]
    fn what_is_not_a_number_is_known_and_long_text_is_cut_between_characters() {
        let transform = Rigid { translation_mm: DVec3::new(0.0, f64::NAN, 0.0), ..Rigid::IDENTITY };
        let message = Message { device: String::new(), time_us: 0, content: Content::Transform(transform) };
        assert!(!message.is_finite());
        assert_eq!(cut(&"µ".repeat(3000)).len(), 4000);
        assert_eq!(cut(&format!("a{}", "µ".repeat(3000))).len(), 3999);
    }
}
