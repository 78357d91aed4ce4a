//! Which device, and where it is plugged in.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// The devices that Sidecarm listens to.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DeviceKind {
    /// The mobile C-arm: joints, beam, exposures.
    Carm,
    /// The snake robot: control angles, tendons, tracked base.
    Robot,
}

impl DeviceKind {
    /// Both, in the order in which they are listed everywhere.
    pub const ALL: [Self; 2] = [Self::Carm, Self::Robot];

    /// The key in files and topics: `carm` or `robot`.
    #[must_use]
    pub fn key(self) -> &'static str {
        match self {
            Self::Carm => "carm",
            Self::Robot => "robot",
        }
    }
}

impl std::fmt::Display for DeviceKind {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Carm => "C-arm",
            Self::Robot => "robot",
        })
    }
}

/// Bits per second unless the session says otherwise: 104-byte frames at 100 Hz would fill 95 % of 115 200.
pub const DEFAULT_BAUD: u32 = 921_600;

/// A serial port and the device expected behind it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PortConfig {
    /// What speaks there.
    pub device: DeviceKind,
    /// Device file; a stable symbolic link (`/dev/serial/by-id/…`) survives unplugging, it is resolved anew at every opening.
    pub path: PathBuf,
    /// Bits per second; pseudo-terminals ignore it.
    pub baud: u32,
}

impl PortConfig {
    /// `path` at [`DEFAULT_BAUD`].
    #[must_use]
    pub fn new(device: DeviceKind, path: impl Into<PathBuf>) -> Self {
        Self { device, path: path.into(), baud: DEFAULT_BAUD }
    }
}
