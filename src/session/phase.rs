//! How far a frame has come that is in work.

use std::collections::BTreeMap;

use super::engine::Engine;

/// What a frame waits for, or what is done with it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Phase {
    /// It waits for the telemetry of its exposure.
    Binding,
    /// It waits to be registered.
    Waiting,
    /// It is registered.
    Registering,
    /// Its DRR is made and compared.
    Rendering,
    /// Its null is made.
    Null,
}

impl Phase {
    /// What a person is told, behind "frame 7".
    #[must_use]
    pub fn words(self) -> &'static str {
        match self {
            Self::Binding => "waits for the telemetry of its exposure",
            Self::Waiting => "waits to be registered",
            Self::Registering => "is being registered",
            Self::Rendering => "is being rendered and compared",
            Self::Null => "is put against other poses",
        }
    }

    /// Where there is little room.
    #[must_use]
    pub fn short(self) -> &'static str {
        match self {
            Self::Binding => "bind",
            Self::Waiting => "wait",
            Self::Registering => "pose",
            Self::Rendering => "DRR",
            Self::Null => "null",
        }
    }
}

/// The frames that an engine has not handed on.
pub(super) fn of_engine(engine: &Engine) -> BTreeMap<u32, Phase> {
    let awaiting = engine.awaiting().map(|number| (number, Phase::Binding));
    awaiting.chain(engine.bound().map(|number| (number, Phase::Waiting))).collect()
}
