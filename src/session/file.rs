//! The session file: which devices, which specimen, where results go (DESIGN §7).

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::geometry::{CarmCalibration, Rigid, RobotModel};

/// Why a session cannot start.
#[derive(Debug, thiserror::Error)]
pub enum SessionFileError {
    /// A file cannot be read.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// A file is not what it should be; `place` is the key.
    #[error("{path}: at {place}: {detail}", path = path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// The key where it stands.
        place: String,
        /// What is wrong there.
        detail: String,
    },
    /// A named file is nowhere.
    #[error("{path}: {key} names {named}, which is neither beside the session file nor in the current folder", path = path.display())]
    Missing {
        /// The session file.
        path: PathBuf,
        /// The key.
        key: &'static str,
        /// What it names.
        named: String,
    },
    /// A value makes no sense.
    #[error("{path}: {key} is {found}, expected {expected}", path = path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// The key.
        key: &'static str,
        /// What was found.
        found: String,
        /// What would be right.
        expected: &'static str,
    },
}

/// The C-arm's line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CarmLine {
    /// Serial device.
    pub port: PathBuf,
    /// Bits per second.
    #[serde(default = "default_baud")]
    pub baud: u32,
    /// A file of `calibration/carm/`.
    pub calibration: PathBuf,
}

/// The robot's line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotLine {
    /// Serial device.
    pub port: PathBuf,
    /// Bits per second.
    #[serde(default = "default_baud")]
    pub baud: u32,
    /// A file of `calibration/robot/`.
    pub model: PathBuf,
}

fn default_baud() -> u32 {
    921_600
}

/// Where frames appear.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FrameSource {
    /// Watched folder.
    pub folder: PathBuf,
    /// What the values mean, where the files do not say it (`linear`, `log`, `display`).
    #[serde(default)]
    pub domain: Option<crate::acquire::Domain>,
}

/// A session file as typed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SessionFile {
    /// C-arm telemetry, if there is any.
    #[serde(default)]
    pub carm: Option<CarmLine>,
    /// Robot telemetry, if there is any.
    #[serde(default)]
    pub robot: Option<RobotLine>,
    /// The frames.
    pub frames: FrameSource,
    /// Scene without a view.
    pub scene: PathBuf,
    /// Beads of the specimen.
    #[serde(default)]
    pub beads: Option<PathBuf>,
    /// Where the specimen lies in the room; solved from the first accepted frame when absent.
    #[serde(default)]
    pub world_from_lps: Option<Rigid>,
    /// Where the tracker stands in the room.
    #[serde(default)]
    pub world_from_tracker: Option<Rigid>,
    /// The session's folder; `--out` overrides it.
    #[serde(default)]
    pub out: Option<PathBuf>,
}

/// Everything that decides what a session computes, embedded in its log: replay needs only the CT beside it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Setup {
    /// The session file.
    pub session: SessionFile,
    /// The C-arm's calibration.
    pub carm: Option<CarmCalibration>,
    /// The robot's model.
    pub robot: Option<RobotModel>,
    /// Text of the scene file.
    pub scene_json: String,
    /// Where the scene file was.
    pub scene_path: PathBuf,
    /// Text of the markups file and its name.
    pub beads: Option<(PathBuf, String)>,
}

/// Reads text; the error names the file.
fn read_text(path: &Path) -> Result<String, SessionFileError> {
    std::fs::read_to_string(path).map_err(|source| SessionFileError::Io { path: path.to_owned(), source })
}

/// Parses JSON; the error names file and key.
pub(super) fn parse<T: serde::de::DeserializeOwned>(path: &Path, text: &str) -> Result<T, SessionFileError> {
    let mut deserializer = serde_json::Deserializer::from_str(text);
    let value: T = serde_path_to_error::deserialize(&mut deserializer).map_err(|error| SessionFileError::Json {
        path: path.to_owned(),
        place: error.path().to_string(),
        detail: error.inner().to_string(),
    })?;
    deserializer.end().map_err(|error| SessionFileError::Json {
        path: path.to_owned(),
        place: "the end".to_owned(),
        detail: error.to_string(),
    })?;
    Ok(value)
}

/// A path as a session file names it: beside the session file, else in the current folder.
fn locate(session: &Path, key: &'static str, named: &Path) -> Result<PathBuf, SessionFileError> {
    let beside = session.parent().unwrap_or(Path::new(".")).join(named);
    [beside, named.to_owned()].into_iter().find(|path| path.exists()).ok_or_else(|| SessionFileError::Missing {
        path: session.to_owned(),
        key,
        named: named.display().to_string(),
    })
}

/// A folder or device that need not exist yet: relative names are beside the session file.
fn beside(session: &Path, named: &Path) -> PathBuf {
    session.parent().unwrap_or(Path::new(".")).join(named)
}

impl Setup {
    /// Reads a session file and every small file that it names.
    ///
    /// # Errors
    /// When a file is missing, unreadable or wrong; the message names file and key.
    pub fn load(path: &Path) -> Result<Self, SessionFileError> {
        let mut session: SessionFile = parse(path, &read_text(path)?)?;
        session.frames.folder = beside(path, &session.frames.folder);
        let mut carm = None;
        if let Some(line) = &mut session.carm {
            check_baud(path, "carm.baud", line.baud)?;
            line.port = beside(path, &line.port);
            line.calibration = locate(path, "carm.calibration", &line.calibration)?;
            carm = Some(parse::<CarmCalibration>(&line.calibration, &read_text(&line.calibration)?)?);
        }
        let mut robot = None;
        if let Some(line) = &mut session.robot {
            check_baud(path, "robot.baud", line.baud)?;
            line.port = beside(path, &line.port);
            line.model = locate(path, "robot.model", &line.model)?;
            let model: RobotModel = parse(&line.model, &read_text(&line.model)?)?;
            model.check().map_err(|error| SessionFileError::Json {
                path: line.model.clone(),
                place: "the model".to_owned(),
                detail: error.to_string(),
            })?;
            robot = Some(model);
        }
        session.scene = locate(path, "scene", &session.scene)?;
        let scene_json = read_text(&session.scene)?;
        let beads = match &session.beads {
            Some(named) => {
                let found = locate(path, "beads", named)?;
                let text = read_text(&found)?;
                session.beads = Some(found.clone());
                Some((found, text))
            }
            None => None,
        };
        let scene_path = session.scene.clone();
        Ok(Self { session, carm, robot, scene_json, scene_path, beads })
    }
}

fn check_baud(path: &Path, key: &'static str, baud: u32) -> Result<(), SessionFileError> {
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
