//! Whether the servers that a session names can listen.

use std::net::{IpAddr, SocketAddr, TcpListener};

use super::super::file::Setup;
use super::finding::Finding;

/// Checks each by listening for a moment.
#[must_use]
pub fn check_ports(setup: &Setup) -> Vec<Finding> {
    let igtl = setup.session.igtl.as_ref().map(|server| listening("OpenIGTLink", server.bind, server.port));
    let dicom = setup.session.frames.dicom.as_ref().map(|server| listening("DICOM", server.bind, server.port));
    igtl.into_iter().chain(dicom).collect()
}

fn listening(check: &str, bind: IpAddr, port: u16) -> Finding {
    let address = SocketAddr::new(bind, port);
    if port == 0 {
        let words = "port 0 is whichever is free at the start, and nobody knows where to connect";
        return Finding::warn(check, words, "write a port into the session, 1 to 65535");
    }
    match TcpListener::bind(address) {
        Ok(_) => Finding::pass(check, format!("{address} can be listened on")),
        Err(error) => {
            let remedy = "choose another port, end the program that has this one, or bind to an address of this machine";
            Finding::fail(check, format!("{address} cannot be listened on: {error}"), remedy)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::finding::Level;
    use super::*;

    #[test]
    fn a_port_that_nobody_can_know_is_warned_of() {
        let loopback = IpAddr::from([127, 0, 0, 1]);
        assert_eq!(listening("DICOM", loopback, 0).level, Level::Warn);
        // The control: whichever is free is free.
        let free = TcpListener::bind((loopback, 0)).and_then(|listener| listener.local_addr()).expect("a free port");
        assert_eq!(listening("DICOM", loopback, free.port()).level, Level::Pass);
    }
}
