//! An OpenIGTLink client of its own, written from the protocol's documents: it shares no code with the server.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

/// CRC-64 of ECMA-182, bit by bit.
pub fn crc64(bytes: &[u8]) -> u64 {
    let mut crc = 0u64;
    for byte in bytes {
        for bit in (0..8).rev() {
            let carry = crc >> 63 ^ u64::from(byte >> bit & 1);
            crc = crc << 1 ^ if carry == 1 { 0x42f0_e1eb_a9ea_3693 } else { 0 };
        }
    }
    crc
}

#[test]
fn the_checksum_is_that_of_the_catalogue() {
    assert_eq!(crc64(b"123456789"), 0x6c40_df5f_0b49_7347);
}

/// A message as it came.
#[derive(Clone, Debug)]
pub struct Told {
    pub version: u16,
    pub type_name: String,
    pub device: String,
    pub stamp: u64,
    pub content: Vec<u8>,
}

impl Told {
    /// Microseconds since 1970, to the nearest.
    pub fn time_us(&self) -> i64 {
        let (seconds, fraction) = (self.stamp >> 32, self.stamp & 0xffff_ffff);
        seconds as i64 * 1_000_000 + (fraction as f64 / 4_294_967_296.0 * 1e6).round() as i64
    }

    pub fn float32(&self, at: usize) -> f64 {
        f64::from(f32::from_be_bytes(self.content[at..at + 4].try_into().expect("four bytes")))
    }

    pub fn uint16(&self, at: usize) -> u16 {
        u16::from_be_bytes(self.content[at..at + 2].try_into().expect("two bytes"))
    }

    /// Rows of a TRANSFORM.
    pub fn matrix(&self) -> [[f64; 4]; 4] {
        assert_eq!((self.type_name.as_str(), self.content.len()), ("TRANSFORM", 48));
        let row = |row: usize| std::array::from_fn(|column| self.float32(4 * (3 * column + row)));
        [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
    }

    /// Of a STRING.
    pub fn text(&self) -> String {
        assert_eq!(self.type_name, "STRING");
        assert_eq!(usize::from(self.uint16(2)), self.content.len() - 4);
        String::from_utf8(self.content[4..].to_vec()).expect("UTF-8")
    }

    /// Code and sentence of a STATUS.
    pub fn status(&self) -> (u16, String) {
        assert_eq!((self.type_name.as_str(), self.content.last()), ("STATUS", Some(&0)));
        let words = &self.content[30..self.content.len() - 1];
        (self.uint16(0), String::from_utf8(words.to_vec()).expect("UTF-8"))
    }
}

pub struct Client {
    stream: TcpStream,
}

/// A message of a client: header version 1 or 2.
pub fn packed(version: u16, type_name: &str, content: &[u8]) -> Vec<u8> {
    let mut body = content.to_vec();
    if version == 2 {
        // One entry of metadata, "k" = "v" in ASCII: a receiver passes over it.
        body = [&[0, 12, 0, 10, 0, 0, 0, 2, 0, 0, 0, 9][..], content, &[0, 1, 0, 1, 0, 3, 0, 0, 0, 1], b"kv"].concat();
    }
    let mut bytes = version.to_be_bytes().to_vec();
    bytes.extend(type_name.bytes().chain(std::iter::repeat(0)).take(12));
    bytes.extend(b"test".iter().copied().chain(std::iter::repeat(0)).take(20));
    bytes.extend([0; 8]);
    bytes.extend((body.len() as u64).to_be_bytes());
    bytes.extend(crc64(&body).to_be_bytes());
    bytes.extend(body);
    bytes
}

impl Client {
    pub fn connect(address: SocketAddr) -> Self {
        let stream = TcpStream::connect(address).expect("somebody listens");
        stream.set_read_timeout(Some(Duration::from_secs(20))).expect("a timeout");
        Self { stream }
    }

    pub fn send(&mut self, bytes: &[u8]) {
        self.stream.write_all(bytes).expect("the server reads");
    }

    /// The next message; `None` when the connection has ended.
    pub fn next(&mut self) -> Option<Told> {
        let mut header = [0; 58];
        self.stream.read_exact(&mut header).ok()?;
        let number = |at: usize| u64::from_be_bytes(header[at..at + 8].try_into().expect("eight bytes"));
        let name = |from: usize, to: usize| {
            let end = header[from..to].iter().position(|byte| *byte == 0).unwrap_or(to - from);
            assert!(header[from + end..to].iter().all(|byte| *byte == 0), "names are padded with zeros");
            String::from_utf8(header[from..from + end].to_vec()).expect("ASCII")
        };
        let mut body = vec![0; number(42) as usize];
        self.stream.read_exact(&mut body).ok()?;
        assert_eq!(crc64(&body), number(50), "checksum of {}", name(2, 14));
        let version = u16::from_be_bytes([header[0], header[1]]);
        let content = match version {
            1 => body,
            2 => {
                let [extended, of_metadata] = [0, 2].map(|at| usize::from(u16::from_be_bytes([body[at], body[at + 1]])));
                let metadata = u32::from_be_bytes(body[4..8].try_into().expect("four bytes")) as usize;
                body[extended..body.len() - of_metadata - metadata].to_vec()
            }
            _ => panic!("header version {version}"),
        };
        Some(Told { version, type_name: name(2, 14), device: name(14, 34), stamp: number(34), content })
    }

    /// The next message that is `wanted`.
    pub fn find(&mut self, wanted: impl Fn(&Told) -> bool) -> Told {
        std::iter::from_fn(|| self.next()).find(wanted).expect("it comes before the connection ends")
    }
}
