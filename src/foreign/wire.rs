//! Messages from a helper to its parent: a kind, a length, that many bytes. Both are the same program on the same machine, so numbers are
//! in its own byte order.

use std::io::{self, Read, Write};

/// More than any header takes.
pub const MAX_JSON_BYTES: usize = 4 << 20;
/// Numbers go in blocks of at most this.
const BLOCK_BYTES: usize = 1 << 18;

const JSON: u8 = b'J';
const NUMBERS: u8 = b'N';
const END: u8 = b'E';

/// Why messages cannot be followed.
#[derive(Debug, thiserror::Error)]
pub enum WireError {
    /// The helper ended before its last message.
    #[error("the helper ended early")]
    Ended,
    /// The pipe broke.
    #[error("the pipe to the helper broke ({0})")]
    Io(io::Error),
    /// What came is no message, or not the one that is due.
    #[error("the helper's answer is not one that is known here ({0})")]
    Garbled(&'static str),
}

impl From<io::Error> for WireError {
    fn from(error: io::Error) -> Self {
        if error.kind() == io::ErrorKind::UnexpectedEof { Self::Ended } else { Self::Io(error) }
    }
}

/// The helper's side.
#[derive(Debug)]
pub struct Sender<W: Write> {
    out: W,
}

impl<W: Write> Sender<W> {
    /// Sends to `out`.
    pub fn new(out: W) -> Self {
        Self { out }
    }

    /// A header.
    ///
    /// # Errors
    /// When the parent has gone.
    pub fn json(&mut self, value: &impl serde::Serialize) -> io::Result<()> {
        self.document(JSON, value)
    }

    /// Numbers that follow a header.
    ///
    /// # Errors
    /// When the parent has gone.
    pub fn numbers(&mut self, values: &[f32]) -> io::Result<()> {
        for block in values.chunks(BLOCK_BYTES / 4) {
            self.message(NUMBERS, bytemuck::cast_slice(block))?;
        }
        Ok(())
    }

    /// The last message.
    ///
    /// # Errors
    /// When the parent has gone.
    pub fn end(&mut self, value: &impl serde::Serialize) -> io::Result<()> {
        self.document(END, value)?;
        self.out.flush()
    }

    fn document(&mut self, kind: u8, value: &impl serde::Serialize) -> io::Result<()> {
        let bytes = serde_json::to_vec(value)?;
        self.message(kind, &bytes)
    }

    fn message(&mut self, kind: u8, bytes: &[u8]) -> io::Result<()> {
        let length = u32::try_from(bytes.len()).map_err(io::Error::other)?;
        self.out.write_all(&[kind])?;
        self.out.write_all(&length.to_ne_bytes())?;
        self.out.write_all(bytes)
    }
}

/// One message.
#[derive(Debug)]
pub enum Message<'a> {
    /// A header.
    Json(&'a [u8]),
    /// Numbers, to be appended with [`Message::append`].
    Numbers(&'a [u8]),
    /// The last message.
    End(&'a [u8]),
}

impl Message<'_> {
    /// Appends the numbers of this message to `values`, which may hold `most` in the end.
    ///
    /// # Errors
    /// When there are more, or the memory for them is not to be had.
    pub fn append(bytes: &[u8], values: &mut Vec<f32>, most: usize) -> Result<(), WireError> {
        let count = bytes.len() / 4;
        if !bytes.len().is_multiple_of(4) || count > most.saturating_sub(values.len()) {
            return Err(WireError::Garbled("more numbers than announced"));
        }
        values.try_reserve(count).map_err(|_| WireError::Garbled("more numbers than fit the memory"))?;
        values.extend(bytes.chunks_exact(4).map(|four| f32::from_ne_bytes([four[0], four[1], four[2], four[3]])));
        Ok(())
    }
}

/// The parent's side; trusts nothing.
#[derive(Debug)]
pub struct Receiver<R: Read> {
    from: R,
    buffer: Vec<u8>,
}

impl<R: Read> Receiver<R> {
    /// Receives from `from`.
    pub fn new(from: R) -> Self {
        Self { from, buffer: Vec::new() }
    }

    /// Where the messages came from.
    pub fn into_inner(self) -> R {
        self.from
    }

    /// The next message.
    ///
    /// # Errors
    /// When the helper ended, or sent something else.
    pub fn receive(&mut self) -> Result<Message<'_>, WireError> {
        let mut head = [0u8; 5];
        self.from.read_exact(&mut head)?;
        let length = u32::from_ne_bytes([head[1], head[2], head[3], head[4]]) as usize;
        let most = match head[0] {
            NUMBERS => BLOCK_BYTES,
            JSON | END => MAX_JSON_BYTES,
            _ => return Err(WireError::Garbled("an unknown message")),
        };
        if length > most {
            return Err(WireError::Garbled("a message that is too long"));
        }
        self.buffer.resize(length, 0);
        self.from.read_exact(&mut self.buffer)?;
        Ok(match head[0] {
            NUMBERS => Message::Numbers(&self.buffer),
            JSON => Message::Json(&self.buffer),
            _ => Message::End(&self.buffer),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_come_as_sent_and_nothing_else_passes() {
        let mut sender = Sender::new(Vec::new());
        let values: Vec<f32> = (0..100_000).map(|i| i as f32 * 0.5).collect();
        sender.json(&"head").expect("sent");
        sender.numbers(&values).expect("sent");
        sender.end(&1).expect("sent");
        let bytes = sender.out;
        let mut receiver = Receiver::new(bytes.as_slice());
        assert!(matches!(receiver.receive(), Ok(Message::Json(b"\"head\""))));
        let mut back = Vec::new();
        loop {
            match receiver.receive().expect("a message") {
                Message::Numbers(bytes) => Message::append(bytes, &mut back, values.len()).expect("announced"),
                Message::End(end) => break assert_eq!(end, b"1"),
                Message::Json(_) => panic!("one header was sent"),
            }
        }
        assert_eq!(back, values);
        assert!(matches!(receiver.receive(), Err(WireError::Ended)));
        assert!(Message::append(&[0; 8], &mut back, values.len() + 1).is_err(), "more than announced");
        for wrong in [&[b'X', 0, 0, 0, 0][..], &[b'N', 255, 255, 255, 255], &[b'J', 255, 255, 255, 255]] {
            assert!(matches!(Receiver::new(wrong).receive(), Err(WireError::Garbled(_))), "{wrong:?}");
        }
    }
}
