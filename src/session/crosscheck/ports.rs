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
    match TcpListener::bind(address) {
        Ok(_) => Finding::pass(check, format!("{address} can be listened on")),
        Err(error) => {
            let remedy = "choose another port, end the program that has this one, or bind to an address of this machine";
            Finding::fail(check, format!("{address} cannot be listened on: {error}"), remedy)
        }
    }
}
