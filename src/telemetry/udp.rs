//! Datagrams of a device: one sender at a time, whose bytes are those of a line.

use std::net::SocketAddr;
use std::path::Path;

use tokio::net::UdpSocket;

use super::outlet::{Deaf, Ended, Outlet, PortEvent};
use super::port_error::PortError;
use crate::time::host_now_us;

/// Longest datagram.
const DATAGRAM_BYTES: usize = 64 << 10;
/// A sender that was silent for so long has gone: another one, or the same program started again, may take its place.
const SILENT_US: i64 = 1_000_000;

/// Listens at an address.
pub(super) struct Listener {
    address: SocketAddr,
    /// Kept from one opening to the next: what comes between them waits in it.
    socket: Option<UdpSocket>,
    /// The end of a datagram ends a line.
    of_lines: bool,
    /// The sender that is listened to, and when it was heard last.
    sender: Option<(SocketAddr, i64)>,
    /// A datagram of another sender that came when the last one had gone: the first one after the next opening.
    waiting: Option<(i64, Vec<u8>)>,
    told: bool,
}

impl Listener {
    pub(super) fn new(address: SocketAddr, of_lines: bool) -> Self {
        Self { address, socket: None, of_lines, sender: None, waiting: None, told: false }
    }

    /// The socket; it is given back by [`Listener::pump`].
    pub(super) async fn open(&mut self, path: &Path) -> Result<UdpSocket, PortError> {
        if let Some(socket) = self.socket.take() {
            return Ok(socket);
        }
        UdpSocket::bind(self.address).await.map_err(|error| PortError::of(path, &error))
    }

    /// Reads until another sender begins: what follows is of another opening, for nothing is known of how the two belong together.
    pub(super) async fn pump(&mut self, socket: UdpSocket, epoch: u32, outlet: &mut Outlet) -> Result<Ended, Deaf> {
        let mut buffer = vec![0; DATAGRAM_BYTES];
        let mut received = false;
        if let Some((host_us, bytes)) = self.waiting.take() {
            received = true;
            outlet.send(PortEvent::Bytes { host_us, epoch, bytes }).await?;
        }
        loop {
            let outcome = tokio::select! {
                biased;
                outcome = socket.recv_from(&mut buffer) => outcome,
                () = outlet.asked_to_finish() => return Err(Deaf),
            };
            let host_us = host_now_us();
            let (count, from) = match outcome {
                Ok(found) => found,
                Err(error) if error.kind() == std::io::ErrorKind::Interrupted => continue,
                Err(error) => return Ok((error.to_string(), received)),
            };
            let bytes = self.bytes(&buffer[..count]);
            match self.sender {
                Some((sender, heard_us)) if sender != from => {
                    if host_us.saturating_sub(heard_us) < SILENT_US {
                        self.tell_intruder(host_us, outlet).await?;
                        continue;
                    }
                    (self.sender, self.waiting, self.socket) = (Some((from, host_us)), Some((host_us, bytes)), Some(socket));
                    return Ok(("datagrams come from another sender now".to_owned(), received));
                }
                _ => self.sender = Some((from, host_us)),
            }
            if bytes.is_empty() {
                continue;
            }
            received = true;
            outlet.send(PortEvent::Bytes { host_us, epoch, bytes }).await?;
        }
    }

    fn bytes(&self, datagram: &[u8]) -> Vec<u8> {
        let mut bytes = datagram.to_vec();
        if self.of_lines && datagram.last().is_some_and(|last| *last != b'\n') {
            bytes.push(b'\n');
        }
        bytes
    }

    /// Two devices in one line would be one that jumps.
    async fn tell_intruder(&mut self, host_us: i64, outlet: &Outlet) -> Result<(), Deaf> {
        if std::mem::replace(&mut self.told, true) {
            return Ok(());
        }
        let words = "datagrams of a second sender come to the same port and are not taken; send them to a port of their own";
        outlet.send(PortEvent::Said { host_us, words: words.to_owned() }).await
    }
}
