//! Files, folders and ports as a session file names them: beside it, whoever starts the session wherever.

use std::path::{Path, PathBuf};

use super::adapters;
use super::file_error::SessionFileError;
use crate::foreign::read_small_text;
use crate::telemetry::{DeviceKind, LineAdapter, PortAddress};

/// Reads text; the error names the file.
pub(super) fn read_text(path: &Path) -> Result<String, SessionFileError> {
    read_small_text(path).map_err(|source| SessionFileError::Io { path: path.to_owned(), source })
}

/// Angles of the scene's file would hold for one frame only.
pub(super) fn refuse_intensifier(scene: &Path, text: &str) -> Result<(), SessionFileError> {
    let distorts = |scene: serde_json::Value| scene.pointer("/detector/intensifier").is_some_and(|value| !value.is_null());
    if !serde_json::from_str(text).is_ok_and(distorts) {
        return Ok(());
    }
    let detail = "in a session the distortion follows the arm: leave it out of the scene and name the calibration in the session, \
                  \"intensifier\": \"FILE.json\"";
    Err(SessionFileError::Json { path: scene.to_owned(), place: "detector.intensifier".to_owned(), detail: detail.to_owned() })
}

/// A path as a session file names it: beside the session file, else in the current folder.
pub(super) fn locate(session: &Path, key: &'static str, named: &Path) -> Result<PathBuf, SessionFileError> {
    let beside = session.parent().unwrap_or(Path::new(".")).join(named);
    [beside, named.to_owned()].into_iter().find(|path| path.exists()).ok_or_else(|| SessionFileError::Missing {
        path: session.to_owned(),
        key,
        named: named.display().to_string(),
    })
}

/// A folder that need not exist yet: relative names are beside the session file.
pub(super) fn beside(session: &Path, named: &Path) -> PathBuf {
    session.parent().unwrap_or(Path::new(".")).join(named)
}

/// A recording of a video, likewise; a device, its number and an address of the network stand as they are.
pub(super) fn video_of(session: &Path, from: &str) -> String {
    let is_number = from.bytes().all(|byte| byte.is_ascii_digit());
    if is_number || from.contains("://") {
        return from.to_owned();
    }
    // A pipe is no file, and found like one.
    let found = Some(beside(session, Path::new(from))).filter(|path| path.exists() && !path.is_dir());
    found.and_then(|path| path.to_str().map(str::to_owned)).unwrap_or_else(|| from.to_owned())
}

/// A port that need not be there yet, likewise.
pub(super) fn port_of(session: &Path, key: &'static str, named: &Path) -> Result<PathBuf, SessionFileError> {
    PortAddress::of(named).map_err(|error| SessionFileError::Json {
        path: session.to_owned(),
        place: key.to_owned(),
        detail: error.to_string(),
    })?;
    Ok(PortAddress::beside(named, session.parent().unwrap_or(Path::new("."))))
}

/// The adapter that a line names, if it does; the name becomes that of the file.
pub(super) fn adapter_of(
    session: &Path,
    key: &'static str,
    named: &mut Option<PathBuf>,
    device: DeviceKind,
) -> Result<Option<LineAdapter>, SessionFileError> {
    let Some(file) = named else { return Ok(None) };
    *file = locate(session, key, file)?;
    adapters::parse(file, &read_text(file)?, device).map(Some)
}

pub(super) fn check_baud(path: &Path, key: &'static str, baud: u32) -> Result<(), SessionFileError> {
    if (1200..=12_000_000).contains(&baud) {
        return Ok(());
    }
    Err(SessionFileError::Value {
        path: path.to_owned(),
        key,
        found: baud.to_string(),
        expected: "between 1200 and 12000000 bits per second",
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A recording that lay beside its session was looked for in the folder in which the program was started.
    #[test]
    fn a_recording_lies_beside_its_session_and_a_device_where_it_is() {
        let folder = tempfile::tempdir().expect("a folder");
        let session = folder.path().join("session.json");
        for name in ["case.avi", "0"] {
            std::fs::write(folder.path().join(name), "RIFF").expect("written");
        }
        let there = folder.path().join("case.avi").display().to_string();
        let mut cases = 0;
        for (from, expected) in [
            ("case.avi", there.as_str()),
            (&there, &there),
            ("0", "0"),
            ("/dev/video0", "/dev/video0"),
            ("rtsp://case.avi", "rtsp://case.avi"),
            ("elsewhere.avi", "elsewhere.avi"),
        ] {
            assert_eq!(video_of(&session, from), expected, "{from}");
            cases += 1;
        }
        assert_eq!(cases, 6);
    }
}
