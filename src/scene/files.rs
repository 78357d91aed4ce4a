//! Where the files that a scene names are, and what they hashed to.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

use super::SceneError;
use super::model::InputFile;
use super::volumes::{VolumeContent, VolumeSource};
use crate::foreign::{Kind, Limits, read_small};
use crate::image::{ImageFileError, sha256_bytes, sha256_file};
use crate::json::{self, JsonFault};

/// Calibration files that come with the program, so that a scene can name them wherever it lies.
const BUILT_IN: [(&str, &str); 3] = [
    ("calibration/carm/nominal-mobile.json", include_str!("../../calibration/carm/nominal-mobile.json")),
    ("calibration/carm/live-620x480.json", include_str!("../../calibration/carm/live-620x480.json")),
    ("calibration/robot/cdm.json", include_str!("../../calibration/robot/cdm.json")),
];

/// Keys under which a scene names files, wherever in it they stand, and whether a folder may be named too. Nothing is looked for under
/// another one.
pub const FILE_KEYS: [(&str, bool); 7] = [
    ("path", true),
    ("labels", true),
    ("names", false),
    ("model", false),
    ("network", false),
    ("calibration", false),
    ("spectrum_csv", false),
];

/// The text of a calibration file that comes with the program.
#[must_use]
pub fn built_in(name: &str) -> Option<&'static str> {
    BUILT_IN.iter().find(|(known, _)| *known == name).map(|(_, text)| *text)
}

/// Resolves names against the scene file's folder and keeps the list of inputs.
#[derive(Debug)]
pub(super) struct Files {
    scene: PathBuf,
    folder: PathBuf,
    /// Names that lie elsewhere.
    places: BTreeMap<String, PathBuf>,
    inputs: Vec<InputFile>,
}

impl Files {
    /// For the scene file at `scene`, some of whose files lie at `places`.
    pub(super) fn new(scene: &Path, places: &BTreeMap<String, PathBuf>) -> Self {
        let folder = scene.parent().map_or_else(PathBuf::new, Path::to_owned);
        Self { scene: scene.to_owned(), folder, places: places.clone(), inputs: Vec::new() }
    }

    /// `SCENE.json: key`, for messages.
    pub(super) fn place(&self, key: &str) -> String {
        format!("{}: {key}", self.scene.display())
    }

    /// The inputs so far.
    pub(super) fn into_inputs(self) -> Vec<InputFile> {
        self.inputs
    }

    /// The file `name`: where it is known to lie, absolute, or in the scene's folder, or (for `calibration/…`) in the current folder.
    pub(super) fn find(&mut self, key: &str, name: &str) -> Result<PathBuf, SceneError> {
        let path = self.locate(key, name, &Path::is_file)?;
        // A file that is too large for anything a scene names is not read to its end for a hash.
        let (bytes, limit) = (path.metadata().map_or(0, |metadata| metadata.len()), Limits::of(Kind::Volume).file_bytes);
        if bytes > limit {
            let source = std::io::Error::other(format!("{bytes} bytes, at most {limit} are read"));
            return Err(SceneError::Io { path, source });
        }
        let sha256 = sha256_file(&path).map_err(|error| io_error(&path, error))?;
        self.remember(name, sha256, Some(&path));
        Ok(path)
    }

    /// The volume `name`: a file as in [`Files::find`], or the folder of a DICOM series.
    pub(super) fn find_volume(&mut self, key: &str, name: &str) -> Result<VolumeSource, SceneError> {
        let path = self.locate(key, name, &|path| path.is_file() || path.is_dir())?;
        let source = VolumeSource::open(&path)?;
        let VolumeContent { sha256, parts } = source.content()?;
        self.note(InputFile { path: name.to_owned(), sha256, place: Some(path), parts });
        Ok(source)
    }

    fn locate(&self, key: &str, name: &str, is_there: &dyn Fn(&Path) -> bool) -> Result<PathBuf, SceneError> {
        let last = key.rsplit('.').next();
        debug_assert!(FILE_KEYS.iter().any(|(known, _)| Some(*known) == last), "{key} is none of FILE_KEYS");
        let beside = self.folder.join(name);
        let mut looked = vec![shown_folder(&self.folder)];
        let found = if let Some(place) = self.places.get(name) {
            Some(place.clone())
        } else if is_there(&beside) {
            Some(beside)
        } else if name.starts_with("calibration/") {
            looked.push("the current folder".to_owned());
            Some(PathBuf::from(name)).filter(|path| is_there(path))
        } else {
            None
        };
        let missing = || SceneError::Missing { place: self.place(key), path: name.to_owned(), looked: looked.join(" and ") };
        found.ok_or_else(missing)
    }

    /// Reads one of our JSON files that the scene names; those that come with the program are found anywhere.
    pub(super) fn read_json<T: DeserializeOwned>(&mut self, key: &str, name: &str) -> Result<T, SceneError> {
        match self.find(key, name) {
            Ok(path) => read_json(&path),
            Err(missing @ SceneError::Missing { .. }) => match built_in(name) {
                Some(text) => {
                    self.remember(name, sha256_bytes(text.as_bytes()), None);
                    parse_json(Path::new(name), text.as_bytes())
                }
                None => Err(missing),
            },
            Err(error) => Err(error),
        }
    }

    /// Notes an input once.
    pub(super) fn remember(&mut self, name: &str, sha256: String, place: Option<&Path>) {
        self.note(InputFile { path: name.to_owned(), sha256, place: place.map(Path::to_owned), parts: Vec::new() });
    }

    fn note(&mut self, input: InputFile) {
        if !self.inputs.contains(&input) {
            self.inputs.push(input);
        }
    }
}

fn shown_folder(folder: &Path) -> String {
    if folder.as_os_str().is_empty() { "the current folder".to_owned() } else { folder.display().to_string() }
}

fn io_error(path: &Path, error: ImageFileError) -> SceneError {
    let source = match error {
        ImageFileError::Io { source, .. } => source,
        other => std::io::Error::other(other.to_string()),
    };
    SceneError::Io { path: path.to_owned(), source }
}

/// Reads a file of ours, unknown keys being errors that name key and place.
///
/// # Errors
/// When the file cannot be read or is not what it should be.
pub(super) fn read_json<T: DeserializeOwned>(path: &Path) -> Result<T, SceneError> {
    let bytes = read_small(path).map_err(|source| SceneError::Io { path: path.to_owned(), source })?;
    parse_json(path, &bytes)
}

/// [`read_json`] for bytes at hand.
pub(super) fn parse_json<T: DeserializeOwned>(path: &Path, bytes: &[u8]) -> Result<T, SceneError> {
    let json = |JsonFault { place, detail }| {
        let detail = if is_kindless(&place, &detail) { format!("{detail}; {KINDS}") } else { detail };
        SceneError::Json { path: path.to_owned(), place, detail }
    };
    json::parse_json(bytes).map_err(json)
}

/// What an object of a scene is.
const KINDS: &str =
    "an object has one key, one of ct, mesh, voxels, sphere, ellipsoid, box, cylinder, robot, which holds all the others";

/// Whether an object of a scene has no kind, two of them, or only the name of one: of which the reader says no more than what sign it missed.
fn is_kindless(place: &str, detail: &str) -> bool {
    let is_object = place.starts_with("objects[") && place.matches('.').count() <= 1;
    // Below a kind that was read, something else is wrong.
    let is_object = is_object && (!place.contains('.') || detail.contains("unit variant") || !detail.contains("invalid type"));
    is_object && ["expected value", "key must be", "unit variant", "invalid type"].iter().any(|words| detail.contains(words))
}

#[cfg(test)]
mod tests {
    #[cfg(debug_assertions)]
    #[test]
    #[should_panic(expected = "FILE_KEYS")]
    fn no_file_is_looked_for_under_a_key_that_is_not_listed() {
        use super::*;
        let _ = Files::new(Path::new("scene.json"), &BTreeMap::new()).find("objects[0].ct.spare", "a.nii");
    }
}
