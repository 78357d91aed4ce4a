//! The names in a log that may be those of persons or places, and what stands for each: the same in every message, so that a replay of the
//! redacted log still agrees with it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde_json::{Map, Value, json};

use super::super::file::{NO_INTENSIFIER, Setup};
use crate::acquire::{hashed_input_label, input_label};
use crate::beads::{Bead, BeadLayout, DEFAULT_BODY, parse_landmarks, parse_markups};
use crate::scene::{hidden_label, is_hidden_label};
use crate::telemetry::PortAddress;

/// What stands in place of free text.
const REMOVED: &str = "removed";

/// What is written in place of what.
#[derive(Debug, Default)]
pub(super) struct Names {
    instead: BTreeMap<String, String>,
    /// Of labels of the scene's label maps, and nowhere else: the label volume, which is not in the log, knows them by no other name.
    labels: BTreeMap<String, String>,
    /// Notes of the bead layout, which are gone with its file.
    layout_notes: Vec<String>,
}

/// The layout of `setup`, if it can be read.
fn layout(setup: &Setup) -> Option<BeadLayout> {
    setup.beads.as_ref().and_then(|(path, text)| parse_markups(path, text.as_bytes()).ok())
}

/// Whether a name is made of words that nobody is called by, and of short numbers.
fn is_harmless(name: &str) -> bool {
    name == DEFAULT_BODY || input_label(Path::new(name), "") == name
}

impl Names {
    /// Of a logged session: files, beads, landmarks, the bodies that they are of, and the labels of which the scene makes bodies and materials.
    pub(super) fn of(setup: &Setup) -> Self {
        let mut names = Self::default();
        for input in setup.inputs.iter().skip(1).filter(|input| input.bytes > 0) {
            let label = hashed_input_label(&input.label.to_ascii_lowercase(), &input.sha256);
            names.instead.insert(input.label.clone(), label);
        }
        let layout = layout(setup);
        let beads: Vec<&Bead> = layout.iter().flat_map(|layout| layout.beads.iter().chain(&layout.checks)).collect();
        names.hide("bead", beads.iter().map(|bead| bead.name.as_str()));
        let of_tags = setup.tag_layout().map(|layout| layout.tags).unwrap_or_default();
        let scene: Value = serde_json::from_str(&setup.scene_json).unwrap_or_default();
        let mut bodies: Vec<String> = beads.iter().map(|bead| bead.body.clone()).collect();
        bodies.extend(of_tags.into_iter().map(|tag| tag.body));
        bodies_of(&scene, &mut bodies);
        names.hide("body", bodies.iter().map(String::as_str));
        names.hide("landmark", setup.landmark_points().iter().map(|landmark| landmark.name.as_str()));
        names.hide_labels(&scene);
        names.layout_notes = layout.map(|layout| layout.notes).unwrap_or_default();
        names
    }

    fn hide<'a>(&mut self, kind: &str, names: impl Iterator<Item = &'a str>) {
        for name in names.filter(|name| !is_harmless(name)) {
            let number = self.instead.len() + 1;
            self.instead.entry(name.to_owned()).or_insert_with(|| format!("{kind}-{number}"));
        }
    }

    /// All or none of them, numbers as well: each keeps its place among the others, on which the order of a scene's materials rests.
    fn hide_labels(&mut self, scene: &Value) {
        let mut found = BTreeSet::new();
        labels_of(scene, &mut found);
        let is_name = |label: &str| label.trim().parse::<u32>().is_err();
        if found.iter().any(|label| is_name(label) && !is_harmless(label) && !is_hidden_label(label)) {
            let hidden = found.iter().enumerate().map(|(rank, label)| hidden_label(rank, label)).collect::<Vec<_>>();
            self.labels = found.into_iter().zip(hidden).collect();
        }
    }

    /// Names that are replaced.
    pub(super) fn count(&self) -> usize {
        self.instead.len() + self.labels.len()
    }

    /// A label of a label map.
    fn label(&self, text: &str) -> String {
        self.labels.get(text).cloned().unwrap_or_else(|| text.to_owned())
    }

    /// A text with other names in it.
    pub(super) fn word(&self, text: &str) -> String {
        match self.instead.get(text) {
            Some(instead) => instead.clone(),
            // The longest first: one name may begin as another.
            None => self.instead.iter().rev().fold(text.to_owned(), |text, (name, instead)| replaced(&text, name, instead)),
        }
    }

    /// The same in all strings of a value.
    pub(super) fn reword(&self, value: &mut Value) {
        match value {
            Value::String(text) => *text = self.word(text),
            Value::Array(values) => values.iter_mut().for_each(|value| self.reword(value)),
            Value::Object(fields) => fields.values_mut().for_each(|value| self.reword(value)),
            Value::Null | Value::Bool(_) | Value::Number(_) => {}
        }
    }

    /// Takes the notes of the layout's file out of a pose.
    pub(super) fn without_layout_notes(&self, pose: &mut Value) {
        if let Some(notes) = pose.get_mut("notes").and_then(Value::as_array_mut) {
            notes.retain(|note| !self.layout_notes.iter().any(|known| note == known));
        }
    }

    /// The session without names of files and ports, and without free text.
    pub(super) fn setup(&self, setup: &Setup) -> Setup {
        let mut kept = setup.clone();
        let session = &mut kept.session;
        if let Some(line) = &mut session.carm {
            (line.port, line.calibration) = (port(&line.port, "carm"), "carm.json".into());
            line.adapter = line.adapter.as_ref().map(|_| "carm-lines.json".into());
        }
        if let Some(line) = &mut session.robot {
            (line.port, line.model) = (port(&line.port, "robot"), "robot.json".into());
            line.adapter = line.adapter.as_ref().map(|_| "robot-lines.json".into());
        }
        session.frames.folder = "frames".into();
        (session.frames.dicom, session.frames.video, session.igtl, session.out) = (None, None, None, None);
        let intensifier = if session.is_flat() { NO_INTENSIFIER } else { "intensifier.json" };
        let roles = [
            (&mut session.beads, "beads.mrk.json"),
            (&mut session.landmarks, "landmarks.mrk.json"),
            (&mut session.detector, "detector.json"),
            (&mut session.intensifier, intensifier),
            (&mut session.intrinsics, "intrinsics.json"),
            (&mut session.tags, "tags.json"),
        ];
        for (path, role) in roles {
            *path = path.as_ref().map(|_| PathBuf::from(role));
        }
        (session.scene, kept.scene_path) = ("scene.json".into(), "scene.json".into());
        kept.carm.iter_mut().for_each(|carm| REMOVED.clone_into(&mut carm.origin));
        kept.robot.iter_mut().for_each(|robot| REMOVED.clone_into(&mut robot.origin));
        kept.adapters = kept.adapters.nameless(REMOVED);
        if let Some(detector) = &mut kept.detector {
            let record = &mut detector.record;
            REMOVED.clone_into(&mut record.origin);
            record.notes.clear();
            record.maps.iter_mut().for_each(|maps| maps.file = "detector.tif".into());
        }
        if let Some(intensifier) = &mut kept.intensifier {
            REMOVED.clone_into(&mut intensifier.origin);
            intensifier.notes.clear();
            intensifier.views.iter_mut().for_each(|view| view.frame.clear());
        }
        kept.scene_json = self.scene(&setup.scene_json);
        for input in &mut kept.inputs {
            input.label = self.word(&input.label);
        }
        if let Some(scene) = kept.inputs.first_mut() {
            "scene.json".clone_into(&mut scene.label);
        }
        kept.beads = layout(setup).map(|layout| ("beads.mrk.json".into(), self.beads(&layout)));
        kept.landmarks = setup.landmarks.as_ref().map(|(path, text)| {
            let points = parse_landmarks(path, text.as_bytes()).unwrap_or_default();
            let points = points.iter().map(|point| (self.word(&point.name), String::new(), point.lps_mm.to_array()));
            ("landmarks.mrk.json".into(), markups(points))
        });
        kept.tags = setup.tags.as_ref().map(|(_, text)| {
            let mut tags: Value = serde_json::from_str(text).unwrap_or_default();
            self.reword(&mut tags);
            ("tags.json".into(), tags.to_string())
        });
        kept
    }

    fn beads(&self, layout: &BeadLayout) -> String {
        let point = |bead: &Bead, role: &str| {
            let number = |key: &str, value: Option<f64>| value.map(|value| format!("{key}={value} ")).unwrap_or_default();
            let covariance = bead.covariance_mm2.map(|own| format!("covariance_mm2={own} ")).unwrap_or_default();
            let sizes = number("radius_mm", bead.radius_mm) + &number("sigma_mm", bead.sigma_mm) + &covariance;
            let description = format!("{sizes}body={}{role}", self.word(&bead.body));
            (self.word(&bead.name), description, bead.lps_mm.to_array())
        };
        let beads = layout.beads.iter().map(|bead| point(bead, ""));
        markups(beads.chain(layout.checks.iter().map(|bead| point(bead, " role=check"))))
    }

    /// Names of bodies and labels are also keys.
    fn scene(&self, text: &str) -> String {
        let Ok(mut scene) = serde_json::from_str::<Value>(text) else { return "{}".to_owned() };
        self.reword_scene(&mut scene);
        format!("{scene:#}")
    }

    fn reword_scene(&self, value: &mut Value) {
        match value {
            Value::String(text) => *text = self.word(text),
            Value::Array(values) => values.iter_mut().for_each(|value| self.reword_scene(value)),
            Value::Object(fields) => {
                for (key, value) in fields {
                    match value {
                        // What a label is made of is no name.
                        Value::Object(labels) if key == "map" => rename_keys(labels, |name| self.label(name)),
                        Value::Object(bodies) if key == "bodies" => {
                            rename_keys(bodies, |name| self.word(name));
                            for label in bodies.values_mut().filter_map(Value::as_array_mut).flatten() {
                                if let Value::String(name) = label {
                                    *name = self.label(name);
                                }
                            }
                        }
                        other => self.reword_scene(other),
                    }
                }
            }
            Value::Null | Value::Bool(_) | Value::Number(_) => {}
        }
    }
}

fn rename_keys(fields: &mut Map<String, Value>, name: impl Fn(&str) -> String) {
    *fields = std::mem::take(fields).into_iter().map(|(key, value)| (name(&key), value)).collect();
}

/// A port without its name; how its bytes begin stays.
fn port(port: &Path, device: &str) -> PathBuf {
    if PortAddress::begins_whole(port) { PortAddress::told(port) } else { device.into() }
}

/// Names of bodies in a scene.
fn bodies_of(value: &Value, found: &mut Vec<String>) {
    match value {
        Value::Array(values) => values.iter().for_each(|value| bodies_of(value, found)),
        Value::Object(fields) => {
            for (key, value) in fields {
                match value {
                    Value::String(name) if key == "body" => found.push(name.clone()),
                    Value::Object(bodies) if key == "bodies" => found.extend(bodies.keys().cloned()),
                    other => bodies_of(other, found),
                }
            }
        }
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
    }
}

/// Names of labels in a scene; their numbers are none.
fn labels_of(value: &Value, found: &mut BTreeSet<String>) {
    match value {
        Value::Array(values) => values.iter().for_each(|value| labels_of(value, found)),
        Value::Object(fields) => {
            for (key, value) in fields {
                match value {
                    Value::Object(labels) if key == "map" => {
                        found.extend(labels.keys().cloned());
                    }
                    Value::Object(bodies) if key == "bodies" => {
                        let labels = bodies.values().filter_map(Value::as_array).flatten().filter_map(Value::as_str);
                        found.extend(labels.map(str::to_owned));
                    }
                    other => labels_of(other, found),
                }
            }
        }
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => {}
    }
}

/// A markups file: label, description and place of each point.
fn markups(points: impl Iterator<Item = (String, String, [f64; 3])>) -> String {
    let points: Vec<Value> = points
        .map(|(label, description, position)| json!({"label": label, "description": description, "position": position}))
        .collect();
    let list = json!({"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm", "controlPoints": points});
    json!({"markups": [list]}).to_string()
}

/// `text` with `name` replaced wherever it stands as a word.
fn replaced(text: &str, name: &str, instead: &str) -> String {
    let (mut out, mut rest) = (String::with_capacity(text.len()), text);
    while let Some(at) = rest.find(name).filter(|_| !name.is_empty()) {
        let (before, after) = (&rest[..at], &rest[at + name.len()..]);
        let is_inside = |c: char| c.is_alphanumeric() || c == '_';
        let joined = before.ends_with(is_inside) || before.is_empty() && out.ends_with(is_inside) || after.starts_with(is_inside);
        out.push_str(before);
        out.push_str(if joined { name } else { instead });
        rest = after;
    }
    out + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_replaced_as_words_and_not_within_others() {
        assert_eq!(replaced("Li, Lila and Li: Li_1 xLi Li", "Li", "bead-1"), "bead-1, Lila and bead-1: Li_1 xLi bead-1");
        assert_eq!(replaced("LiLi", "Li", "b"), "LiLi");
        assert_eq!(replaced("", "Li", "b"), "");
    }

    #[test]
    fn only_names_that_may_be_of_persons_are_replaced() {
        let mut names = Names::default();
        names.hide("bead", ["B1", "bead 12", "specimen", "Quaxwelk", "Quaxwelk-2"].into_iter());
        assert_eq!(names.count(), 2, "{names:?}");
        assert_eq!(names.word("bead Quaxwelk-2 is far from Quaxwelk and B1"), "bead bead-2 is far from bead-1 and B1");
    }

    /// Structure names of a label map were told, and a label that was called as a body is was renamed with it: then nothing had that name.
    #[test]
    fn labels_are_hidden_where_they_stand_and_keep_their_order() {
        let text = json!({"objects": [{"ct": {"path": "ct.nii", "materials": {
            "labels": "seg.nii", "default": "water",
            "map": {"1st rib": "bone_cortical", "77": "bone_cortical", "hip": "bone_cortical", "Quaxwelk soft": {"material": "soft_tissue"}, "zz Quaxwelk": "lung"},
            "bodies": {"Quaxwelk": ["Quaxwelk", 5, "6"], "femur": ["hip"]}
        }}}]});
        let mut names = Names::default();
        names.hide("body", ["Quaxwelk"].into_iter());
        names.hide_labels(&text);
        let scene = names.scene(&text.to_string());
        assert!(!scene.contains("Quaxwelk"), "{scene}");
        let materials = &serde_json::from_str::<Value>(&scene).expect("JSON")["objects"][0]["ct"]["materials"];
        let hidden = hidden_label;
        let map = [
            (hidden(0, "1st rib"), json!("bone_cortical")),
            (hidden(1, "6"), Value::Null),
            (hidden(2, "77"), json!("bone_cortical")),
            (hidden(3, "Quaxwelk"), Value::Null),
            (hidden(4, "Quaxwelk soft"), json!({"material": "soft_tissue"})),
            (hidden(5, "hip"), json!("bone_cortical")),
            (hidden(6, "zz Quaxwelk"), json!("lung")),
        ];
        assert!(map.is_sorted_by(|a, b| a.0 < b.0), "as before");
        for (label, made_of) in &map {
            assert_eq!(&materials["map"][label], made_of, "{label}: {scene}");
        }
        assert_eq!(
            materials["bodies"],
            json!({"body-1": [hidden(3, "Quaxwelk"), 5, hidden(1, "6")], "femur": [hidden(5, "hip")]})
        );
        // Once more there is nothing to hide.
        let mut again = Names::default();
        again.hide_labels(&serde_json::from_str(&scene).expect("JSON"));
        assert_eq!(again.count(), 0, "{again:?}");
        let mut plain = Names::default();
        plain.hide_labels(&json!({"materials": {"labels": "seg.nii", "map": {"77": "lung"}, "bodies": {"b": [5]}}}));
        assert_eq!(plain.count(), 0, "{plain:?}");
    }
}
