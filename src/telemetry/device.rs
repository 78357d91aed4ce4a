//! Which device.

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
