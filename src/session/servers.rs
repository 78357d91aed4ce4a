//! The servers that a session file names: where each listens. This machine alone reaches them unless another address is given.

use std::net::{IpAddr, Ipv4Addr, SocketAddr};

use serde::{Deserialize, Serialize};

use crate::acquire::ReceiverOptions;

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

/// DICOM storage (C-STORE), whose objects become files of the watched folder: the key `dicom` of the session's `frames`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DicomServer {
    /// TCP port.
    #[serde(default = "dicom_port")]
    pub port: u16,
    /// Address of this machine on which it listens.
    #[serde(default = "loopback")]
    pub bind: IpAddr,
    /// The name that senders must call.
    #[serde(default = "ae_title")]
    pub ae_title: String,
    /// Names of those who may send; anybody where there are none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub calling_ae_titles: Vec<String>,
}

/// The one that IANA has for DICOM.
fn dicom_port() -> u16 {
    11_112
}

fn ae_title() -> String {
    "SIDECARM".to_owned()
}

impl DicomServer {
    /// On this machine, for whoever calls the default title.
    #[must_use]
    pub fn on_port(port: u16) -> Self {
        Self { port, bind: loopback(), ae_title: ae_title(), calling_ae_titles: Vec::new() }
    }

    /// The first name in it that is none (PS3.5 §6.2, AE: 1 to 16 characters, no backslash, no control characters, not only spaces).
    #[must_use]
    pub fn wrong_title(&self) -> Option<&str> {
        let is_title = |title: &str| {
            let fits = (1..=16).contains(&title.len()) && title.trim() == title;
            fits && title.bytes().all(|byte| (byte.is_ascii_graphic() || byte == b' ') && byte != b'\\')
        };
        std::iter::once(&self.ae_title).chain(&self.calling_ae_titles).map(String::as_str).find(|title| !is_title(title))
    }

    /// How to listen.
    #[must_use]
    pub fn options(&self) -> ReceiverOptions {
        ReceiverOptions {
            address: SocketAddr::new(self.bind, self.port),
            ae_title: self.ae_title.clone(),
            calling_ae_titles: self.calling_ae_titles.clone(),
        }
    }
}

impl IgtlServer {
    /// On this machine, for its own programs.
    #[must_use]
    pub fn on_port(port: u16) -> Self {
        Self { port, bind: loopback() }
    }
}
