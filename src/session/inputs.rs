//! What the files that a session reads are called in what it writes. Names of folders, and names of files that are not made of harmless
//! words, may be those of patients: they reach neither log nor report. A file is its hash; where it lies is kept on this machine alone
//! ([`super::places`]).

use std::path::{Path, PathBuf};

use serde_json::Value;

pub use super::file::LoggedInput;
use super::file::{LoggedPart, Setup};
use crate::acquire::{hashed_input_label, input_label};
use crate::scene::{FILE_KEYS, InputFile, built_in};
use crate::telemetry::PortAddress;

/// What is written in place of what.
#[derive(Clone, Debug, Default)]
pub struct InputNames {
    inputs: Vec<(InputFile, LoggedInput)>,
    /// Texts and what stands for them, the longest first.
    hidden: Vec<(String, String)>,
}

impl InputNames {
    /// For the files of `setup`'s scene, the scene file first; a replay keeps the labels of its log.
    #[must_use]
    pub fn of(setup: &Setup, inputs: &[InputFile]) -> Self {
        let mut names = Self::default();
        for (number, input) in inputs.iter().enumerate() {
            // In a log's scene, names are labels; the scene itself is the first.
            let known =
                if number == 0 { setup.inputs.first() } else { setup.inputs.iter().find(|known| known.label == input.path) };
            let logged = known.cloned().unwrap_or_else(|| names.logged(input));
            names.inputs.push((input.clone(), logged));
        }
        let session = &setup.session;
        let folder = (session.frames.folder.as_path(), told_folder(&session.frames.folder));
        let files = [(setup.beads.as_ref(), "beads"), (setup.landmarks.as_ref(), "landmarks"), (setup.tags.as_ref(), "tags")];
        let files = files.into_iter().filter_map(|(file, role)| file.map(|(path, _)| (path.as_path(), told(path, role))));
        let calibrations = [
            (session.carm.as_ref().map(|line| &line.calibration), "carm"),
            (session.robot.as_ref().map(|line| &line.model), "robot"),
            (session.carm.as_ref().and_then(|line| line.adapter.as_ref()), "carm-lines"),
            (session.robot.as_ref().and_then(|line| line.adapter.as_ref()), "robot-lines"),
            (session.detector.as_ref(), "detector"),
            (session.intensifier.as_ref().filter(|_| !session.is_flat()), "intensifier"),
            (session.intrinsics.as_ref(), "intrinsics"),
        ];
        let calibrations =
            calibrations.into_iter().filter_map(|(file, role)| file.map(|path| (path.as_path(), told(path, role))));
        let mut hidden: Vec<(String, String)> = Vec::new();
        for (path, label) in std::iter::once(folder).chain(files).chain(calibrations) {
            hide(&mut hidden, path, &label.to_string_lossy());
        }
        let ports = [session.carm.as_ref().map(|line| &line.port), session.robot.as_ref().map(|line| &line.port)];
        for port in ports.into_iter().flatten() {
            match PortAddress::of(port) {
                Ok(PortAddress::File(path)) => hide(&mut hidden, &path, "the telemetry file"),
                Ok(PortAddress::Serial(path)) => hide(&mut hidden, &path, &PortAddress::told(port).to_string_lossy()),
                Ok(PortAddress::Udp(_)) | Err(_) => {}
            }
        }
        if let Some(video) = session.frames.video.as_ref().filter(|video| !video.from.starts_with("/dev/")) {
            hide(&mut hidden, Path::new(&video.from), "the video");
        }
        for (input, logged) in &names.inputs {
            let Some(place) = &input.place else { continue };
            hide(&mut hidden, Path::new(&input.path), &logged.label);
            hide(&mut hidden, place, &logged.label);
        }
        if inputs.is_empty() {
            // Of a scene that could not be loaded, errors name the file, its folder and what it names.
            hide_scene(&mut hidden, &setup.scene_path, &setup.scene_json);
        }
        hidden.sort_by_key(|(text, _)| std::cmp::Reverse(text.len()));
        names.hidden = hidden;
        names
    }

    fn logged(&self, input: &InputFile) -> LoggedInput {
        let Some(place) = &input.place else {
            return LoggedInput { label: input.path.clone(), sha256: input.sha256.clone(), bytes: 0, part: None };
        };
        // Slices and their folders are called after persons and numbers of examinations more often than not.
        let is_header = place.extension().is_some_and(|ending| ending == "nhdr" || ending == "mhd");
        let is_dicom = !input.parts.is_empty() && !is_header;
        let label = if is_dicom { hashed_input_label("", &input.sha256) } else { input_label(place, &input.sha256) };
        let taken = self.inputs.iter().any(|(_, known)| known.label == label && known.sha256 != input.sha256);
        let label = if taken { hashed_input_label(&label, &input.sha256) } else { label };
        // A header leads to its voxels, not the other way round.
        let part = input.parts.iter().find(|part| part.path == *place).or(input.parts.first());
        let part = part.map(|part| LoggedPart { sha256: part.sha256.clone(), bytes: part.bytes });
        let bytes = match &input.parts[..] {
            [] => place.metadata().map_or(0, |metadata| metadata.len()),
            parts => parts.iter().map(|part| part.bytes).sum(),
        };
        LoggedInput { label, sha256: input.sha256.clone(), bytes, part }
    }

    /// The scene's inputs under the names that may be shown.
    #[must_use]
    pub fn shown(&self) -> Vec<InputFile> {
        let shown = |logged: LoggedInput| InputFile { path: logged.label, sha256: logged.sha256, place: None, parts: Vec::new() };
        self.labelled().into_iter().map(shown).collect()
    }

    /// What to say of files that come with the program and were others in the program that recorded the session: calibrations, and the network that
    /// says what of a CT is bone.
    pub(super) fn other_versions(&self) -> Vec<String> {
        let of_program = self.inputs.iter().skip(1).filter(|(input, _)| input.place.is_none());
        let others = of_program.filter(|(input, logged)| input.sha256 != logged.sha256);
        let said = |(now, then): &(InputFile, LoggedInput)| {
            let (label, then, now) = (&then.label, &then.sha256, &now.sha256);
            format!(
                "{label} was {then} in the program that recorded the session, it is {now} in this one: DRRs may differ by that"
            )
        };
        others.map(said).collect()
    }

    /// Each file once, however often the scene names it.
    fn labelled(&self) -> Vec<LoggedInput> {
        let mut labelled: Vec<LoggedInput> = Vec::new();
        for (_, logged) in &self.inputs {
            if !labelled.contains(logged) {
                labelled.push(logged.clone());
            }
        }
        labelled
    }

    /// Hashes and places of the files that were read.
    pub(super) fn places(&self) -> impl Iterator<Item = (&str, &Path)> {
        self.inputs.iter().filter_map(|(input, logged)| Some((logged.sha256.as_str(), input.place.as_deref()?)))
    }

    /// The session as a log keeps it.
    #[must_use]
    pub fn setup(&self, setup: &Setup) -> Setup {
        let mut kept = setup.clone();
        let session = &mut kept.session;
        if let Some(line) = &mut session.carm {
            line.port = PortAddress::told(&line.port);
            line.calibration = told(&line.calibration, "carm");
            line.adapter = line.adapter.as_deref().map(|path| told(path, "carm-lines"));
        }
        if let Some(line) = &mut session.robot {
            line.port = PortAddress::told(&line.port);
            line.model = told(&line.model, "robot");
            line.adapter = line.adapter.as_deref().map(|path| told(path, "robot-lines"));
        }
        session.frames.folder = told_folder(&session.frames.folder);
        session.out = None;
        // Nothing that is computed depends on who listens, or on how frames came into the folder.
        session.igtl = None;
        (session.frames.dicom, session.frames.video) = (None, None);
        session.beads = session.beads.as_deref().map(|path| told(path, "beads"));
        session.landmarks = session.landmarks.as_deref().map(|path| told(path, "landmarks"));
        session.detector = session.detector.as_deref().map(|path| told(path, "detector"));
        if !session.is_flat() {
            session.intensifier = session.intensifier.as_deref().map(|path| told(path, "intensifier"));
        }
        session.intrinsics = session.intrinsics.as_deref().map(|path| told(path, "intrinsics"));
        session.tags = session.tags.as_deref().map(|path| told(path, "tags"));
        for (file, role) in [(&mut kept.beads, "beads"), (&mut kept.landmarks, "landmarks"), (&mut kept.tags, "tags")] {
            if let Some((path, _)) = file {
                *path = told(path, role);
            }
        }
        if let Some(intensifier) = &mut kept.intensifier {
            // Names of the frames that it was measured in.
            intensifier.views.iter_mut().for_each(|view| view.frame.clear());
            intensifier.notes.clear();
        }
        kept.inputs = self.labelled();
        let scene = kept.inputs.first().map_or_else(|| "scene.json".to_owned(), |scene| scene.label.clone());
        session.scene = PathBuf::from(&scene);
        kept.scene_path = PathBuf::from(scene);
        kept.scene_json = self.scene_json(&setup.scene_json);
        kept
    }

    /// The scene with labels for the files that it names.
    fn scene_json(&self, text: &str) -> String {
        let Ok(mut scene) = serde_json::from_str::<Value>(text) else { return text.to_owned() };
        let mut changed = false;
        self.relabel(&mut scene, &mut changed);
        if changed { format!("{scene:#}") } else { text.to_owned() }
    }

    fn relabel(&self, value: &mut Value, changed: &mut bool) {
        match value {
            Value::String(text) => {
                let named = self.inputs.iter().skip(1).find(|(input, _)| input.path == *text);
                if let Some((_, logged)) = named.filter(|(_, logged)| logged.label != *text) {
                    text.clone_from(&logged.label);
                    *changed = true;
                }
            }
            Value::Array(values) => values.iter_mut().for_each(|value| self.relabel(value, changed)),
            Value::Object(fields) => fields.values_mut().for_each(|value| self.relabel(value, changed)),
            Value::Null | Value::Bool(_) | Value::Number(_) => {}
        }
    }

    /// `text` without the folders and the file names of this machine, as far as the session named them.
    #[must_use]
    pub fn hide(&self, text: &str) -> String {
        self.hidden.iter().fold(text.to_owned(), |text, (from, to)| text.replace(from, to))
    }
}

/// Notes that `label` stands for `path`, however it is written.
fn hide(hidden: &mut Vec<(String, String)>, path: &Path, label: &str) {
    let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let real = std::fs::canonicalize(path).map(|path| path.display().to_string()).unwrap_or_default();
    for text in [path.display().to_string(), real, name] {
        // A word as short as this stands in sentences as well.
        if text.len() > 3 && text != label && !hidden.iter().any(|(known, _)| *known == text) {
            hidden.push((text, label.to_owned()));
        }
    }
}

/// As [`hide`], for the scene file at `scene` and the files that its text names.
fn hide_scene(hidden: &mut Vec<(String, String)>, scene: &Path, text: &str) {
    hide(hidden, scene, &told(scene, "scene").to_string_lossy());
    let folder = scene.parent().map(Path::to_owned).unwrap_or_default();
    let mut named = Vec::new();
    names_in(&serde_json::from_str(text).unwrap_or_default(), &mut named);
    // What comes with the program is called after nobody.
    for name in named.into_iter().filter(|name| built_in(name).is_none()) {
        let label = told(Path::new(&name), "file");
        hide(hidden, &folder.join(&name), &label.to_string_lossy());
        hide(hidden, Path::new(&name), &label.to_string_lossy());
    }
    // Its bare name may be a word of any sentence: only the whole path is hidden.
    let real = std::fs::canonicalize(&folder).unwrap_or_default();
    for path in [folder, real] {
        let path = path.display().to_string();
        if path.len() > 3 && !hidden.iter().any(|(known, _)| *known == path) {
            hidden.push((path, "the scene's folder".to_owned()));
        }
    }
}

/// Texts of a scene that stand where it names files.
fn names_in(value: &Value, named: &mut Vec<String>) {
    match value {
        Value::Object(fields) => {
            for (key, value) in fields {
                let of_files = FILE_KEYS.iter().find(|(known, _)| *known == key.as_str());
                // A word without an ending may be no file's, but a series is a folder.
                let is_file = |name: &str| of_files.is_some_and(|(_, folder)| *folder || Path::new(name).extension().is_some());
                match value {
                    Value::String(name) if is_file(name) => named.push(name.clone()),
                    other => names_in(other, named),
                }
            }
        }
        Value::Array(values) => values.iter().for_each(|value| names_in(value, named)),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
    }
}

/// A file whose content is in the log: its own name where that is harmless, else its role.
fn told(path: &Path, role: &str) -> PathBuf {
    let label = input_label(path, "");
    PathBuf::from(label.strip_prefix("input-").map_or_else(|| label.clone(), |ending| format!("{role}{ending}")))
}

fn told_folder(path: &Path) -> PathBuf {
    let name = last_part(path);
    let label = input_label(&name, "");
    if name.as_os_str().to_string_lossy() == label { name } else { PathBuf::from("frames") }
}

fn last_part(path: &Path) -> PathBuf {
    path.file_name().map(PathBuf::from).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_named_under_the_keys_by_which_a_scene_is_read() {
        let scene = serde_json::json!({
            "view": {"calibration": "carm.json", "carm": {"sid_mm": 1000.0}},
            "beam": {"spectrum_csv": "tube.csv", "name": "not.this"},
            "objects": [{"ct": {"path": "series", "materials": {"labels": "segments", "names": "names.csv", "network": "default"}}}],
        });
        let mut named = Vec::new();
        names_in(&scene, &mut named);
        named.sort();
        assert_eq!(named, ["carm.json", "names.csv", "segments", "series", "tube.csv"]);
    }

    #[test]
    fn a_file_that_came_with_the_program_in_another_version_is_said() {
        let pair = |label: &str, now: &str, then: &str, place: Option<&str>| {
            let input = InputFile { path: label.into(), sha256: now.into(), place: place.map(Into::into), parts: Vec::new() };
            (input, LoggedInput { label: label.into(), sha256: then.into(), bytes: 0, part: None })
        };
        let same = [
            pair("scene.json", "s2", "s1", None),
            pair("calibration/a.json", "a1", "a1", None),
            pair("ct.nii", "c2", "c1", Some("/ct.nii")),
        ];
        let mut names = InputNames { inputs: same.to_vec(), hidden: Vec::new() };
        assert_eq!(names.other_versions(), Vec::<String>::new(), "a scene, the same file, a file of the session's own");
        names.inputs.push(pair("bone of objects[0].ct", "b2", "b1", None));
        let said = names.other_versions();
        assert!(said.len() == 1 && said[0].contains("bone of objects[0].ct was b1") && said[0].contains("b2"), "{said:?}");
    }
}
