//! The servers that a session file names: where each listens. This machine alone reaches them unless another address is given.

use std::net::{IpAddr, Ipv4Addr};

use serde::{Deserialize, Serialize};

/// OpenIGTLink, for 3D Slicer and others: the session's key `igtl`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IgtlServer {
    /// TCP port; 0 for one that is free.
    #[serde(default = "igtl_port")]
    pub port: u16,
    /// Address of this machine on which it listens.
    #[serde(default = "loopback")]
    pub bind: IpAddr,
}

/// The protocol's own.
fn igtl_port() -> u16 {
    18_944
}

fn loopback() -> IpAddr {
    Ipv4Addr::LOCALHOST.into()
}

impl IgtlServer {
    /// On this machine, for its own programs.
    #[must_use]
    pub fn on_port(port: u16) -> Self {
        Self { port, bind: loopback() }
    }
}
