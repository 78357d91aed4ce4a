//! Datagrams of a device: one sender at a time, whose bytes are those of a line.

use std::net::SocketAddr;
use std::path::PathBuf;

use tokio::net::UdpSocket;

use super::address::AddressError;
use super::byte_source::{ByteSource, Closing, Heard};
use super::port_error::PortError;
use crate::time::host_now_us;

/// Longest datagram.
const DATAGRAM_BYTES: usize = 64 << 10;
/// A sender that was silent for so long has gone: another one, or the same program started again, may take its place.
const SILENT_US: i64 = 1_000_000;
/// Said once.
const SECOND_SENDER: &str =
    "datagrams of a second sender come to the same port and are not taken; send them to a port of their own";

/// Listens at an address.
pub(super) struct Listener {
    /// As configured.
    port: PathBuf,
    address: Result<SocketAddr, AddressError>,
    /// Kept from one opening to the next: what comes between them waits in it.
    socket: Option<UdpSocket>,
    buffer: Vec<u8>,
    /// The end of a datagram ends a line.
    of_lines: bool,
    /// The sender that is listened to, and when it was heard last.
    sender: Option<(SocketAddr, i64)>,
    /// A datagram of another sender that came when the last one had gone: the first one after the next opening.
    waiting: Option<(i64, Vec<u8>)>,
    told: bool,
}

impl Listener {
    pub(super) fn new(port: PathBuf, address: Result<SocketAddr, AddressError>, of_lines: bool) -> Self {
        let buffer = vec![0; DATAGRAM_BYTES];
        Self { port, address, socket: None, buffer, of_lines, sender: None, waiting: None, told: false }
    }

    fn bytes(&self, datagram: &[u8]) -> Vec<u8> {
        let mut bytes = datagram.to_vec();
        if self.of_lines && datagram.last().is_some_and(|last| *last != b'\n') {
            bytes.push(b'\n');
        }
        bytes
    }
}

impl ByteSource for Listener {
    const KEEPS_BYTES: bool = true;

    async fn open(&mut self) -> Result<PathBuf, PortError> {
        let path = self.port.clone();
        if self.socket.is_none() {
            let address = self.address.clone();
            let address = address.map_err(|error| PortError::Io { path: path.clone(), reason: error.to_string() })?;
            self.socket = Some(UdpSocket::bind(address).await.map_err(|error| PortError::of(&path, &error))?);
        }
        Ok(path)
    }

    /// It ends where another sender begins: what follows is of another opening, for nothing is known of how the two belong together.
    async fn next(&mut self, closing: &mut Closing) -> Heard {
        if let Some((host_us, bytes)) = self.waiting.take() {
            return Heard::Bytes { host_us, bytes };
        }
        loop {
            let Some(socket) = &self.socket else { return Heard::Closed };
            let outcome = tokio::select! {
                biased;
                outcome = socket.recv_from(&mut self.buffer) => outcome,
                () = closing.asked() => return Heard::Closed,
            };
            let host_us = host_now_us();
            let (count, from) = match outcome {
                Ok(found) => found,
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => continue,
                Err(error) => {
                    self.socket = None;
                    return Heard::Lost { reason: error.to_string() };
                }
            };
            let bytes = self.bytes(&self.buffer[..count]);
            match self.sender {
                Some((sender, heard_us)) if sender != from => {
                    if host_us.saturating_sub(heard_us) >= SILENT_US {
                        (self.sender, self.waiting) = (Some((from, host_us)), Some((host_us, bytes)));
                        return Heard::Lost { reason: "datagrams come from another sender now".to_owned() };
                    }
                    // Two devices in one line would be one that jumps.
                    if !std::mem::replace(&mut self.told, true) {
                        return Heard::Said { host_us, words: SECOND_SENDER.to_owned() };
                    }
                    continue;
                }
                _ => self.sender = Some((from, host_us)),
            }
            if !bytes.is_empty() {
                return Heard::Bytes { host_us, bytes };
            }
        }
    }
}
