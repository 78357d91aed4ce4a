//! Devices of a session that do not speak packets: how their lines are read, wherever their bytes come from.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::file_error::SessionFileError;
use crate::json::{JsonFault, parse_json};
use crate::telemetry::lines::{AdapterError, Declaration};
use crate::telemetry::{DeviceKind, LineAdapter, Link, PortAddress};
use crate::timeline::Timeline;

/// The declarations of a session, as its log keeps them.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Adapters {
    /// Of the C-arm.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub carm: Option<LineAdapter>,
    /// Of the robot.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub robot: Option<LineAdapter>,
}

impl Adapters {
    /// Whether all devices speak packets.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.carm.is_none() && self.robot.is_none()
    }

    /// How the lines of `device` are read; none where it speaks packets.
    #[must_use]
    pub fn of(&self, device: DeviceKind) -> Option<&LineAdapter> {
        match device {
            DeviceKind::Carm => self.carm.as_ref(),
            DeviceKind::Robot => self.robot.as_ref(),
        }
    }

    /// The decoder of `device` behind `port`.
    #[must_use]
    pub fn link(&self, device: DeviceKind, port: Option<&Path>) -> Link {
        match self.of(device) {
            Some(adapter) => Link::of_lines(adapter, port.is_some_and(PortAddress::begins_whole)),
            None => Link::new(device),
        }
    }

    /// An empty timeline that knows which device has no clock.
    #[must_use]
    pub fn timeline(&self) -> Timeline {
        let mut timeline = Timeline::new();
        for device in DeviceKind::ALL {
            if let Some(sigma_us) = self.of(device).and_then(LineAdapter::host_time_sigma_us) {
                timeline.keep_host_time(device, sigma_us);
            }
        }
        timeline
    }

    /// What cannot be known because the lines do not say it: of what, and a sentence.
    #[must_use]
    pub fn unknowns(&self) -> Vec<(&'static str, String)> {
        DeviceKind::ALL.into_iter().filter_map(|device| self.of(device)).flat_map(LineAdapter::unknowns).collect()
    }

    /// The same without words of those who wrote them ([`LineAdapter::nameless`]).
    #[must_use]
    pub fn nameless(&self, origin: &str) -> Self {
        let nameless = |adapter: &Option<LineAdapter>| adapter.as_ref().and_then(|adapter| adapter.nameless(origin));
        Self { carm: nameless(&self.carm), robot: nameless(&self.robot) }
    }
}

/// The declaration of `device`'s lines in `text`, the file at `path`.
///
/// # Errors
/// When it is none, contradicts itself, or is of the other device; the message names file and key.
pub(super) fn parse(path: &Path, text: &str, device: DeviceKind) -> Result<LineAdapter, SessionFileError> {
    let wrong = |place: String, detail: String| SessionFileError::Json { path: path.to_owned(), place, detail };
    let declaration: Declaration = parse_json(text.as_bytes()).map_err(|JsonFault { place, detail }| wrong(place, detail))?;
    let adapter = LineAdapter::try_from(declaration).map_err(|AdapterError { place, detail }| wrong(place, detail))?;
    if adapter.device() != device {
        let (found, key) = (adapter.device(), adapter.device().key());
        return Err(wrong(
            key.to_owned(),
            format!("these are the lines of a {found}, and the session names them for its {device}"),
        ));
    }
    Ok(adapter)
}
