//! What a session declares about how its frames may be compared, and what is legal for each frame.

pub use super::air_word::AirWord;
use super::file::Setup;
use crate::acquire::{Domain, Frame};
use crate::compare::{AirLevel, Tone};

/// The comparison's part of a session file.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Declared {
    /// The tone, if the session names one.
    pub tone: Option<Tone>,
    /// The air level, if the session names one.
    pub air: Option<AirWord>,
}

impl Declared {
    /// Of a session.
    #[must_use]
    pub fn of(setup: &Setup) -> Self {
        Self { tone: setup.session.tone, air: setup.session.air_level }
    }

    /// The tone for `frame`: the declared one where its domain permits it, else the domain's own. What was not permitted is said in
    /// `flags`.
    #[must_use]
    pub fn tone_of(&self, frame: &Frame, flags: &mut Vec<String>) -> Tone {
        let own = if frame.domain == Domain::Display { Tone::Monotone } else { Tone::None };
        let Some(declared) = self.tone else { return own };
        if declared.is_permitted(frame.domain) {
            return declared;
        }
        flags.push(format!(
            "tone {} of the session does not suit this frame, whose domain is {}: compared with {}",
            declared.as_str(),
            frame.domain,
            own.as_str()
        ));
        own
    }

    /// How the air level of a frame is known.
    #[must_use]
    pub fn air_level(&self) -> AirLevel {
        match self.air {
            None | Some(AirWord::Open) => AirLevel::Open,
            Some(AirWord::Maximum) => AirLevel::Maximum,
            Some(AirWord::Unknown) => AirLevel::Unknown,
            Some(AirWord::Value(value)) => AirLevel::Value(value),
        }
    }
}
