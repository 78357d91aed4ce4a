//! What clients send: bytes in, whole messages out. Of a body nothing is kept but what its check needs.

use super::header::{BODY_CRC, EXTENDED_BYTES, HEADER_BYTES, Header, HeaderVersion};

/// The largest body that a client may send; a CT that Slicer passes on is larger, and nothing here would use it.
pub const MOST_BODY_BYTES: u64 = 64 << 20;

/// A message that arrived whole.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Received {
    /// `GET_STATUS`, `TRANSFORM` ….
    pub type_name: String,
    /// Whom it is for, or from.
    pub device: String,
    /// How the client writes its headers, and reads those of others.
    pub version: HeaderVersion,
}

/// Why bytes are no messages; what follows them has no beginning.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum IgtlFault {
    /// Not the version of a header.
    #[error("header version is {found}, expected 1 to 3")]
    Version {
        /// The version found.
        found: u16,
    },
    /// Not the name of a type.
    #[error("message type is {found:?}, expected capitals, digits and _")]
    Type {
        /// The name found.
        found: String,
    },
    /// More than anybody sends.
    #[error("message is {found} bytes long, limit {limit}")]
    TooLarge {
        /// Its size by its header.
        found: u64,
        /// The largest.
        limit: u64,
    },
    /// Extended header and metadata do not fit into the body.
    #[error("extended header and metadata take {found} bytes of a body of {body}")]
    Extended {
        /// What they take by their own word.
        found: u64,
        /// The body.
        body: u64,
    },
    /// The body is not what its sender sent.
    #[error("checksum is {found:016x}, the header says {expected:016x}")]
    Checksum {
        /// By the header.
        expected: u64,
        /// Of the body.
        found: u64,
    },
}

impl IgtlFault {
    /// The kind of warning that this is.
    #[must_use]
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Version { .. } | Self::Type { .. } | Self::Extended { .. } => "OpenIGTLink garbage",
            Self::TooLarge { .. } => "OpenIGTLink message too large",
            Self::Checksum { .. } => "OpenIGTLink checksum",
        }
    }
}

/// A body that is arriving.
struct Body {
    header: Header,
    crc: crc::Digest<'static, u64, crc::Table<16>>,
    /// Its first bytes.
    first: Vec<u8>,
    left: u64,
}

/// See the module.
#[derive(Default)]
pub struct Decoder {
    header: Vec<u8>,
    body: Option<Body>,
}

impl Decoder {
    /// Nothing received yet.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Whether a message has begun and not ended.
    #[must_use]
    pub fn is_within(&self) -> bool {
        !self.header.is_empty() || self.body.is_some()
    }

    /// Takes what arrived; `sink` gets the messages that it completes.
    ///
    /// # Errors
    /// When the bytes are no messages; then the connection is of no use any more.
    pub fn push(&mut self, mut bytes: &[u8], sink: &mut dyn FnMut(Received)) -> Result<(), IgtlFault> {
        while !bytes.is_empty() {
            if let Some(body) = &mut self.body {
                let (now, later) = bytes.split_at(bytes.len().min(usize::try_from(body.left).unwrap_or(usize::MAX)));
                bytes = later;
                body.take(now);
            } else {
                let (now, later) = bytes.split_at(bytes.len().min(HEADER_BYTES - self.header.len()));
                bytes = later;
                self.header.extend_from_slice(now);
                let Ok(whole) = <&[u8; HEADER_BYTES]>::try_from(self.header.as_slice()) else { continue };
                self.body = Some(Body::behind(Header::from_bytes(whole))?);
                self.header.clear();
            }
            if let Some(whole) = self.body.take_if(|body| body.left == 0) {
                sink(whole.finish()?);
            }
        }
        Ok(())
    }
}

impl Body {
    fn behind(header: Header) -> Result<Self, IgtlFault> {
        if !(1..=3).contains(&header.version) {
            return Err(IgtlFault::Version { found: header.version });
        }
        let is_letter = |c: char| c.is_ascii_uppercase() || c.is_ascii_digit() || c == '_';
        if header.type_name.is_empty() || !header.type_name.chars().all(is_letter) {
            return Err(IgtlFault::Type { found: header.type_name });
        }
        if header.body_bytes > MOST_BODY_BYTES {
            return Err(IgtlFault::TooLarge { found: header.body_bytes, limit: MOST_BODY_BYTES });
        }
        let left = header.body_bytes;
        Ok(Self { header, crc: BODY_CRC.digest(), first: Vec::new(), left })
    }

    fn take(&mut self, bytes: &[u8]) {
        self.crc.update(bytes);
        let missing = EXTENDED_BYTES - self.first.len();
        self.first.extend_from_slice(&bytes[..missing.min(bytes.len())]);
        self.left -= bytes.len() as u64;
    }

    fn finish(self) -> Result<Received, IgtlFault> {
        let Self { header, crc, first, .. } = self;
        let found = crc.finalize();
        // Queries have no body, and old clients put no checksum there.
        if header.body_bytes > 0 && found != header.crc {
            return Err(IgtlFault::Checksum { expected: header.crc, found });
        }
        let version = header.format();
        if version == HeaderVersion::V2 && header.body_bytes > 0 {
            check_extended(&first, header.body_bytes)?;
        }
        Ok(Received { type_name: header.type_name, device: header.device, version })
    }
}

/// Extended header and metadata are passed over; they have to fit.
fn check_extended(first: &[u8], body_bytes: u64) -> Result<(), IgtlFault> {
    let part = |at: usize, bytes: usize| first.iter().skip(at).take(bytes).fold(0, |number, byte| number << 8 | u64::from(*byte));
    let extended = part(0, 2);
    let found = extended + part(2, 2) + part(4, 4);
    if first.len() < EXTENDED_BYTES || extended < EXTENDED_BYTES as u64 || found > body_bytes {
        return Err(IgtlFault::Extended { found, body: body_bytes });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::message::{Content, Message};
    use super::*;

    fn header(type_name: &str, version: u16, body: &[u8]) -> Vec<u8> {
        let crc = BODY_CRC.checksum(body);
        let (type_name, body_bytes) = (type_name.to_owned(), body.len() as u64);
        let mut bytes = Header { version, type_name, device: "Slicer".to_owned(), stamp: 0, body_bytes, crc }.to_bytes().to_vec();
        bytes.extend(body);
        bytes
    }

    fn all(bytes: &[u8], chunk: usize) -> Result<Vec<Received>, IgtlFault> {
        let (mut decoder, mut found) = (Decoder::new(), Vec::new());
        for part in bytes.chunks(chunk) {
            decoder.push(part, &mut |received| found.push(received))?;
        }
        assert!(!decoder.is_within());
        Ok(found)
    }

    #[test]
    fn messages_come_out_however_they_are_cut() {
        let text = |version| {
            let content = Content::Text("hello".to_owned());
            Message { device: "Notes".to_owned(), time_us: 9, content }.encode(version)
        };
        let stream =
            [header("GET_STATUS", 1, b""), text(HeaderVersion::V1), text(HeaderVersion::V2), header("GET_CAPABIL", 2, b"")];
        let stream = stream.concat();
        for chunk in [1, 2, 57, 58, 59, 4096] {
            let found = all(&stream, chunk).expect("sound");
            let names: Vec<&str> = found.iter().map(|received| received.type_name.as_str()).collect();
            assert_eq!(names, ["GET_STATUS", "STRING", "STRING", "GET_CAPABIL"], "in parts of {chunk}");
            assert_eq!(found[2].version, HeaderVersion::V2);
            assert_eq!(found[1].device, "Notes");
        }
    }

    #[test]
    fn what_is_no_message_is_told_by_what_is_wrong_with_it() {
        let mut altered = header("TRANSFORM", 1, &[1; 48]);
        altered[80] ^= 1;
        assert!(matches!(all(&altered, 9), Err(IgtlFault::Checksum { .. })));
        assert_eq!(all(&[b'G'; 58], 58), Err(IgtlFault::Version { found: 0x4747 }));
        assert!(matches!(all(&header("get status", 1, b""), 58), Err(IgtlFault::Type { .. })));
        let mut huge = header("IMAGE", 1, b"");
        huge[42..50].copy_from_slice(&u64::MAX.to_be_bytes());
        assert_eq!(all(&huge, 58), Err(IgtlFault::TooLarge { found: u64::MAX, limit: MOST_BODY_BYTES }));
        // Metadata larger than the body, an extended header that is too short, none at all.
        for body in [&[0, 12, 0, 2, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0][..], &[0, 11, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0], &[0, 12, 0]] {
            assert!(matches!(all(&header("STRING", 2, body), 58), Err(IgtlFault::Extended { .. })), "{body:?}");
        }
    }
}
