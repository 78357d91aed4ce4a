//! Simulates a C-arm, a snake robot and a detector at the wire. Shares no code with the program that it tests: it encodes from
//! `mocks/PROTOCOL.md`, and what both sides must know is data in `mocks/data/`.
//!
//! A test that drives a receiver takes what it needs: [`wire`] for single packets, [`pty::Line`] for a port that can be unplugged,
//! [`fault::Channel`] for a port that damages what it carries, [`radiograph::take`] for a frame whose P and noise are known, and
//! [`play::play`] for a whole session.

pub mod matrix;
pub mod wire;
pub mod pty;
pub mod fault;
pub mod lab;
pub mod kinematics;
pub mod phantom;
pub mod radiograph;
pub mod voxels;
pub mod drawn;
pub mod dicom;
pub mod tag_lie;
pub mod detector;
pub mod script;
pub mod dialect;
pub mod monitor;
pub mod storescu;
pub mod kit;
pub mod delivery;
pub mod oddity;
pub mod play;

/// Why the mock cannot go on.
#[derive(Debug, thiserror::Error)]
pub enum MockError {
    /// A file or device.
    #[error("{what}: {source}")]
    Io {
        /// Path or device.
        what: String,
        /// What the system said.
        source: std::io::Error,
    },
    /// Embedded or given data are wrong.
    #[error("{what}: {detail}")]
    Data {
        /// Which data.
        what: String,
        /// What is wrong.
        detail: String,
    },
}

impl MockError {
    /// For `map_err`.
    pub fn io(what: impl std::fmt::Display) -> impl FnOnce(std::io::Error) -> Self {
        move |source| Self::Io { what: what.to_string(), source }
    }
}
