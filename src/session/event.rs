//! What the session's own thread is told.

use super::input::Input;
use super::posed::Posed;
use super::posing::Registered;
use crate::telemetry::DeviceKind;

/// Which thread has ended, of those that hand things to the session's.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Source {
    Lines,
    Frames,
    Registrar,
    Editor,
}

/// See the module.
pub(super) enum Event {
    Input(Input),
    Registered(Box<Registered>),
    /// An edited frame with its pose.
    Edited(Box<Posed>),
    LineOpened {
        device: DeviceKind,
        host_us: i64,
    },
    LineLost {
        device: DeviceKind,
        host_us: i64,
        reason: String,
    },
    Ended(Source),
}
