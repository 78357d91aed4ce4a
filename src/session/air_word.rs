//! The air level as a session file says it.

use serde::{Deserialize, Serialize};

/// The air level as a session file says it: a number or a word.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "serde_json::Value", into = "serde_json::Value")]
pub enum AirWord {
    /// Stored value of the unattenuated signal.
    Value(f64),
    /// From pixels that the simulation predicts to be air.
    Open,
    /// The highest value in the frame.
    Maximum,
    /// Not known.
    Unknown,
}

impl TryFrom<serde_json::Value> for AirWord {
    type Error = String;

    fn try_from(value: serde_json::Value) -> Result<Self, String> {
        match (value.as_f64(), value.as_str()) {
            (Some(number), _) => Ok(Self::Value(number)),
            (_, Some("open")) => Ok(Self::Open),
            (_, Some("maximum")) => Ok(Self::Maximum),
            (_, Some("unknown")) => Ok(Self::Unknown),
            _ => Err(format!("air_level is {value}, expected a number or one of open, maximum, unknown")),
        }
    }
}

impl From<AirWord> for serde_json::Value {
    fn from(word: AirWord) -> Self {
        match word {
            AirWord::Value(value) => value.into(),
            AirWord::Open => "open".into(),
            AirWord::Maximum => "maximum".into(),
            AirWord::Unknown => "unknown".into(),
        }
    }
}
