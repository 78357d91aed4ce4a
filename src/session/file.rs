//! The session file: which devices, which specimen, where results go (DESIGN §7).

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::adapters::Adapters;
use super::air_word::AirWord;
pub use super::file_error::SessionFileError;
use super::named_files::{adapter_of, beside, check_baud, locate, port_of, read_text, refuse_intensifier, video_of};
use super::servers::{DicomServer, IgtlServer};
use crate::acquire::video::VideoSettings;
use crate::acquire::{DetectorCalibration, Domain, Frame};
use crate::beads::tags::{TagLayout, parse_tags};
use crate::beads::{Landmark, parse_landmarks};
use crate::compare::Tone;
use crate::geometry::{CarmCalibration, ConsoleGeometry, IntensifierCalibration, Rigid, RobotModel};
use crate::json::{JsonFault, parse_json};
use crate::pose::IntrinsicsFile;
use crate::telemetry::{DeviceKind, Link, PortConfig};

/// The C-arm's line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CarmLine {
    /// Serial device, `udp://ADDRESS:PORT`, or `file:PATH` for what is written to a file's end.
    pub port: PathBuf,
    /// Bits per second.
    #[serde(default = "default_baud")]
    pub baud: u32,
    /// A file of `calibration/carm/`.
    pub calibration: PathBuf,
    /// How its lines are read, where it does not speak packets: a file such as those of `calibration/telemetry/`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub adapter: Option<PathBuf>,
    /// Whether telemetry is a measurement beside the beads, with the standard deviations that the calibration states; else it only says where
    /// to look for them.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub fuse: bool,
}

/// The robot's line.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotLine {
    /// As the C-arm's.
    pub port: PathBuf,
    /// Bits per second.
    #[serde(default = "default_baud")]
    pub baud: u32,
    /// A file of `calibration/robot/`.
    pub model: PathBuf,
    /// As the C-arm's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub adapter: Option<PathBuf>,
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
    /// Folders below it are watched as well.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub sub_folders: bool,
    /// As the session's `domain`, which is the better place.
    #[serde(default)]
    pub domain: Option<Domain>,
    /// DICOM storage into that folder, if frames are also sent.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dicom: Option<DicomServer>,
    /// A video output of which pictures come into that folder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub video: Option<VideoSettings>,
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
    /// Where the specimen lies in the room; solved from the first accepted frame when absent. Kept as rows, because they come back
    /// from a log bit for bit.
    #[serde(default)]
    pub world_from_lps: Option<[[f64; 4]; 4]>,
    /// Where the tracker stands in the room.
    #[serde(default)]
    pub world_from_tracker: Option<[[f64; 4]; 4]>,
    /// The session's folder; `--out` overrides it.
    #[serde(default)]
    pub out: Option<PathBuf>,
    /// What the frames' values mean, where the files do not say it (`linear`, `log`, `display`); beats what they say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub domain: Option<Domain>,
    /// What may be fitted between a frame and its DRR; when absent, `monotone` for display frames and `none` for all others.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tone: Option<Tone>,
    /// The stored value of the unattenuated signal, or `open`, `maximum`, `unknown`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub air_level: Option<AirWord>,
    /// Radius of beads whose description gives none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub bead_radius_mm: Option<f64>,
    /// Points of the specimen where uncertainty is wanted: a Slicer markups file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub landmarks: Option<PathBuf>,
    /// What the console does to the panel's picture before it stores it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub console: Option<ConsoleGeometry>,
    /// The panel: a file of `calibrate detector`, or of `calibration/detector/`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub detector: Option<PathBuf>,
    /// The image intensifier: a file of `calibrate intensifier`. K is that of the undistorted picture; DRRs are distorted as the frames are.
    /// `none`: there is none, the detector is flat.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub intensifier: Option<PathBuf>,
    /// K, as `register --intrinsics` reads it, for frames of which no calibrated arm tells it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub intrinsics: Option<PathBuf>,
    /// AprilTags of the specimen, as `register --tags` reads them: they start the search for beads and are checked against it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tags: Option<PathBuf>,
    /// OpenIGTLink, if others are to hear of poses and pictures.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub igtl: Option<IgtlServer>,
}

/// What stands in place of an intensifier's file where the detector is flat.
pub(super) const NO_INTENSIFIER: &str = "none";

impl SessionFile {
    /// Whether the session says that the detector is flat.
    pub(super) fn is_flat(&self) -> bool {
        self.intensifier.as_deref() == Some(Path::new(NO_INTENSIFIER))
    }
}

/// A file that went into a session's scene, as its log knows it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LoggedInput {
    /// Its name in the log's scene.
    pub label: String,
    /// Lower-case hexadecimal.
    pub sha256: String,
    /// Its size, that of all its files together.
    pub bytes: u64,
    /// One of its files, where they are several or DICOM: by it they are found.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub part: Option<LoggedPart>,
}

/// A file of an input that has several.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LoggedPart {
    /// Lower-case hexadecimal.
    pub sha256: String,
    /// Its size.
    pub bytes: u64,
}

/// Everything that decides what a session computes, embedded in its log without the names of folders ([`super::inputs`]): replay needs only
/// the files that the scene names.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Setup {
    /// The session file.
    pub session: SessionFile,
    /// The C-arm's calibration.
    pub carm: Option<CarmCalibration>,
    /// The robot's model.
    pub robot: Option<RobotModel>,
    /// How the lines of devices are read that do not speak packets.
    #[serde(default, skip_serializing_if = "Adapters::is_empty")]
    pub adapters: Adapters,
    /// Text of the scene file.
    pub scene_json: String,
    /// Where the scene file was.
    pub scene_path: PathBuf,
    /// Text of the markups file and its name.
    pub beads: Option<(PathBuf, String)>,
    /// Text of the landmarks' file and its name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub landmarks: Option<(PathBuf, String)>,
    /// The detector calibration, maps included.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub detector: Option<Box<DetectorCalibration>>,
    /// The image intensifier's calibration.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub intensifier: Option<Box<IntensifierCalibration>>,
    /// K that the session states.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub intrinsics: Option<IntrinsicsFile>,
    /// Text of the tags' file and its name: as text, they come back from a log bit for bit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tags: Option<(PathBuf, String)>,
    /// In a log: the scene file and the files that it names, by the labels that stand in [`Setup::scene_json`].
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub inputs: Vec<LoggedInput>,
    /// Where those files lie on this machine, by label.
    #[serde(skip)]
    pub places: BTreeMap<String, PathBuf>,
}

/// Parses JSON; the error names file and key.
pub(super) fn parse<T: serde::de::DeserializeOwned>(path: &Path, text: &str) -> Result<T, SessionFileError> {
    let json = |JsonFault { place, detail }| SessionFileError::Json { path: path.to_owned(), place, detail };
    parse_json(text.as_bytes()).map_err(json)
}

impl Setup {
    /// The devices that are heard.
    pub(super) fn devices(&self) -> impl Iterator<Item = DeviceKind> + use<> {
        let present = [(DeviceKind::Carm, self.carm.is_some()), (DeviceKind::Robot, self.robot.is_some())];
        present.into_iter().filter(|(_, there)| *there).map(|(device, _)| device)
    }

    /// Where C-arm and robot are heard, if they are.
    #[must_use]
    pub fn ports(&self) -> [Option<PortConfig>; 2] {
        let carm = self.session.carm.as_ref().map(|line| (DeviceKind::Carm, &line.port, line.baud));
        let robot = self.session.robot.as_ref().map(|line| (DeviceKind::Robot, &line.port, line.baud));
        let config = |(device, path, baud): (DeviceKind, &PathBuf, u32)| {
            let adapter = self.adapters.of(device).cloned();
            PortConfig { device, path: path.clone(), baud, adapter }
        };
        [carm, robot].map(|line| line.map(config))
    }

    /// Reads a session file and every small file that it names.
    ///
    /// # Errors
    /// When a file is missing, unreadable or wrong; the message names file and key.
    pub fn load(path: &Path) -> Result<Self, SessionFileError> {
        let mut session: SessionFile = parse(path, &read_text(path)?)?;
        session.frames.folder = beside(path, &session.frames.folder);
        if let Some(video) = &mut session.frames.video {
            video.from = video_of(path, &video.from);
        }
        for (key, rows) in [("world_from_lps", session.world_from_lps), ("world_from_tracker", session.world_from_tracker)] {
            if let Some(Err(error)) = rows.map(|rows| Rigid::from_rows(&rows)) {
                return Err(SessionFileError::Json { path: path.to_owned(), place: key.to_owned(), detail: error.to_string() });
            }
        }
        let mut adapters = Adapters::default();
        let mut carm = None;
        if let Some(line) = &mut session.carm {
            check_baud(path, "carm.baud", line.baud)?;
            line.port = port_of(path, "carm.port", &line.port)?;
            adapters.carm = adapter_of(path, "carm.adapter", &mut line.adapter, DeviceKind::Carm)?;
            line.calibration = locate(path, "carm.calibration", &line.calibration)?;
            carm = Some(parse::<CarmCalibration>(&line.calibration, &read_text(&line.calibration)?)?);
        }
        let mut robot = None;
        if let Some(line) = &mut session.robot {
            check_baud(path, "robot.baud", line.baud)?;
            line.port = port_of(path, "robot.port", &line.port)?;
            adapters.robot = adapter_of(path, "robot.adapter", &mut line.adapter, DeviceKind::Robot)?;
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
        refuse_intensifier(&session.scene, &scene_json)?;
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
        let (inputs, places) = Default::default();
        let (landmarks, detector, intensifier, intrinsics, tags) = (None, None, None, None, None);
        let mut setup = Self {
            session,
            carm,
            robot,
            adapters,
            scene_json,
            scene_path,
            beads,
            landmarks,
            detector,
            intensifier,
            intrinsics,
            tags,
            inputs,
            places,
        };
        setup.load_declared(path)?;
        Ok(setup)
    }

    /// What a session declares about its frames: checked here, once, so that a wrong word is found before the first exposure.
    fn load_declared(&mut self, path: &Path) -> Result<(), SessionFileError> {
        let wrong = |key, found: String, expected| SessionFileError::Value { path: path.to_owned(), key, found, expected };
        let place =
            |place: &str, detail: String| SessionFileError::Json { path: path.to_owned(), place: place.to_owned(), detail };
        let session = &mut self.session;
        if let Some(title) = session.frames.dicom.as_ref().and_then(DicomServer::wrong_title) {
            let expected = "AE titles of 1 to 16 ASCII characters, no backslash, no space at either end";
            return Err(wrong("frames.dicom", format!("{title:?}"), expected));
        }
        if let Some((key, found, expected)) = session.frames.video.as_ref().and_then(VideoSettings::wrong) {
            return Err(place(&format!("frames.video.{key}"), format!("found {found}, expected {expected}")));
        }
        if let (Some(of_session), Some(of_frames)) = (session.domain, session.frames.domain)
            && of_session != of_frames
        {
            return Err(wrong(
                "frames.domain",
                of_frames.to_string(),
                "the same as the session's domain, or only one of the two",
            ));
        }
        if let Some(AirWord::Value(value)) = session.air_level
            && !(value.is_finite() && value > 0.0)
        {
            return Err(wrong("air_level", value.to_string(), "a positive stored value, or open, maximum, unknown"));
        }
        if let Some(radius_mm) = session.bead_radius_mm
            && !(0.05..=20.0).contains(&radius_mm)
        {
            return Err(wrong("bead_radius_mm", radius_mm.to_string(), "0.05 to 20 mm"));
        }
        if let Some(console) = &session.console {
            console.check().map_err(|error| place("console", error.to_string()))?;
            if let Some(carm) = &self.carm {
                console.check_on(carm).map_err(|error| place("console", error.to_string()))?;
            }
        }
        if let Some(named) = &session.landmarks {
            let found = locate(path, "landmarks", named)?;
            let text = read_text(&found)?;
            parse_landmarks(&found, text.as_bytes()).map_err(|error| place("landmarks", error.to_string()))?;
            session.landmarks = Some(found.clone());
            self.landmarks = Some((found, text));
        }
        if let Some(named) = &session.detector {
            let found = locate(path, "detector", named)?;
            self.detector = Some(Box::new(DetectorCalibration::read(&found)?));
            session.detector = Some(found);
        }
        let is_flat = session.is_flat();
        if let Some(named) = session.intensifier.as_ref().filter(|_| !is_flat) {
            let found = locate(path, "intensifier", named)?;
            let read = IntensifierCalibration::read(&found);
            let calibration = read.map_err(|error| place("intensifier", format!("{}: {error}", found.display())))?;
            let of_carm = self.carm.as_ref().map(|carm| [carm.columns_px, carm.rows_px]);
            let sized = of_carm.map_or(Ok(()), |size_px| calibration.check_size(size_px));
            sized
                .map_err(|error| place("intensifier", format!("{error}; the C-arm's calibration has columns_px and rows_px")))?;
            self.intensifier = Some(Box::new(calibration));
            session.intensifier = Some(found);
        }
        if let Some(named) = &session.intrinsics {
            let found = locate(path, "intrinsics", named)?;
            self.intrinsics = Some(IntrinsicsFile::read(&found).map_err(|error| place("intrinsics", error.to_string()))?);
            session.intrinsics = Some(found);
        }
        if let Some(named) = &session.tags {
            let found = locate(path, "tags", named)?;
            let text = read_text(&found)?;
            parse_tags(&found, text.as_bytes()).map_err(|error| place("tags", error.to_string()))?;
            session.tags = Some(found.clone());
            self.tags = Some((found, text));
        }
        Ok(())
    }

    /// The same with frames from this folder alone: nothing listens to others, and no video is grabbed.
    #[must_use]
    pub(super) fn with_frames_in(&self, folder: &Path) -> Self {
        let mut own = self.clone();
        let frames = &mut own.session.frames;
        frames.folder = folder.to_owned();
        (frames.dicom, frames.video, own.session.igtl) = (None, None, None);
        own
    }

    /// The port of `device` as the session names it, if it has one.
    fn port(&self, device: DeviceKind) -> Option<&Path> {
        match device {
            DeviceKind::Carm => self.session.carm.as_ref().map(|line| line.port.as_path()),
            DeviceKind::Robot => self.session.robot.as_ref().map(|line| line.port.as_path()),
        }
    }

    /// The decoder of a device's bytes.
    #[must_use]
    pub fn link(&self, device: DeviceKind) -> Link {
        self.adapters.link(device, self.port(device))
    }

    /// The C-arm's calibration with cropping, binning and enlargement of the console folded in, as it holds for an imported frame; as it
    /// is where the frame does not fit.
    #[must_use]
    pub fn carm_of_frame(&self, imported: &Frame) -> Option<CarmCalibration> {
        let carm = self.carm.as_ref()?;
        let stored = imported.correction.as_ref().and_then(|correction| correction.stored.as_ref());
        let folded = stored.and_then(|stored| stored.console.calibration_of(carm, stored.size_px).ok());
        Some(folded.unwrap_or_else(|| carm.clone()))
    }

    /// What the frames' values mean, by the person's word.
    #[must_use]
    pub fn domain(&self) -> Option<Domain> {
        self.session.domain.or(self.session.frames.domain)
    }

    /// The specimen's tags, if the session names any.
    #[must_use]
    pub fn tag_layout(&self) -> Option<TagLayout> {
        self.tags.as_ref().and_then(|(path, text)| parse_tags(path, text.as_bytes()).ok())
    }

    /// Points where uncertainty is wanted.
    #[must_use]
    pub fn landmark_points(&self) -> Vec<Landmark> {
        let parsed = self.landmarks.as_ref().and_then(|(path, text)| parse_landmarks(path, text.as_bytes()).ok());
        parsed.unwrap_or_default()
    }
}
