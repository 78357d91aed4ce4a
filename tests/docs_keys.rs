//! `docs/file-formats.md` names every key of every file, as the types in the source have them.

use std::collections::BTreeSet;
use std::path::Path;

use crate::architecture::rust_files;

/// No names.
const ALL: &[&str] = &[];

/// Sources, and the heading under which the keys of their types stand. No names: every type that refuses unknown keys.
const DESCRIBED: [(&str, &[&str], &str); 44] = [
    ("src/session/file.rs", &[], "Session"),
    ("src/session/servers.rs", &[], "Session"),
    ("src/acquire/video/settings.rs", &[], "Session"),
    ("src/geometry/console/declared.rs", &[], "Session"),
    ("src/scene/file.rs", &[], "Scene"),
    ("src/scene/object_file.rs", &[], "Scene"),
    ("src/scene/object_file.rs", &["ObjectFile"], "Scene"),
    ("src/scene/optics_file.rs", &[], "Scene"),
    ("src/scene/optics.rs", &[], "Scene"),
    ("src/scene/model.rs", &[], "Scene"),
    ("src/pose/record.rs", &[], "Pose"),
    ("src/pose/shadow.rs", &[], "Pose"),
    ("src/beads/flags.rs", &[], "Pose"),
    ("src/pose/hand_marks.rs", &[], "Pose"),
    ("src/session/edit.rs", &[], "The log"),
    ("src/pose/explained.rs", &[], "Pose"),
    ("src/pose/residual.rs", &[], "Pose"),
    ("src/pose/unseen.rs", &[], "Pose"),
    ("src/pose/together/record.rs", &[], "Poses of several views"),
    ("src/pose/intrinsics_file.rs", &[], "K"),
    ("src/beads/correspondences.rs", &[], "Beads, landmarks, marks and tags"),
    ("src/beads/tags/file.rs", &[], "Beads, landmarks, marks and tags"),
    ("src/cli/calibrate_robot_shots.rs", &[], "Telemetry and tables"),
    ("src/cli/calibrate_intensifier.rs", &[], "Telemetry and tables"),
    ("src/geometry/carm.rs", &["JointOffsets"], "Telemetry and tables"),
    ("src/report/pair.rs", &["Pair", "TruthError", "Innovation"], "pairs.json"),
    ("src/report/bead_row.rs", &["BeadRow"], "pairs.json"),
    ("src/compare/scores.rs", &["Scores"], "pairs.json"),
    ("src/compare/ranking.rs", &["NullScore", "ShiftedScore"], "pairs.json"),
    ("src/compare/null.rs", &["NullPlan"], "pairs.json"),
    ("src/compare/elsewhere.rs", &["Elsewhere"], "pairs.json"),
    ("src/compare/domain.rs", &["AirReport"], "pairs.json"),
    ("src/compare/pedestal.rs", &["OffsetReport"], "pairs.json"),
    ("src/compare/tone.rs", &["ToneFit"], "pairs.json"),
    ("src/mask/layers.rs", &["MaskShares"], "pairs.json"),
    ("src/calibrate/robot/in_frame.rs", &["SeenTip"], "pairs.json"),
    ("src/compare/comparison.rs", &["Comparison"], "compare.json"),
    ("src/render/plan.rs", &["Plan", "ErrorParts"], "IMAGE.tif.json"),
    ("src/render/plan_parts.rs", &["Choice", "Node"], "IMAGE.tif.json"),
    ("src/render/trade.rs", &["Trade", "Row"], "Other results"),
    ("src/session/attach.rs", &["Attached", "AttachReport"], "Other results"),
    ("src/calibrate/layout/mod.rs", &["LayoutScore"], "Other results"),
    ("src/acquire/tags.rs", &["FrameTags"], "The log"),
    ("src/acquire/beam_tags.rs", &["FilterTags", "FilterLayer", "CollimatorTags"], "The log"),
];

/// Calibrations, their reports and networks: every type that refuses unknown keys.
const CALIBRATIONS: [(&str, &str); 15] = [
    ("src/geometry/carm.rs", "C-arm calibration"),
    ("src/geometry/sag.rs", "C-arm calibration"),
    ("src/calibrate/carm/report.rs", "C-arm calibration"),
    ("src/geometry/robot.rs", "Robot model and calibration"),
    ("src/geometry/robot_calibration.rs", "Robot model and calibration"),
    ("src/calibrate/robot/report.rs", "Robot model and calibration"),
    ("src/calibrate/robot/fit.rs", "Robot model and calibration"),
    ("src/calibrate/robot/tips.rs", "Robot model and calibration"),
    ("src/geometry/intensifier.rs", "Image intensifier"),
    ("src/acquire/detector_record.rs", "Detector"),
    ("src/acquire/added_filter.rs", "Detector"),
    ("src/scene/density.rs", "Density curve"),
    ("src/calibrate/phantom/report.rs", "Bead layout that was measured"),
    ("src/infer/card.rs", "Networks"),
    ("src/infer/materials/card.rs", "Networks"),
];

/// Types that refuse unknown keys and are in no file that a person writes or reads.
const INTERNAL: [(&str, &str); 11] = [
    ("src/telemetry/lines/declaration.rs", "its keys are in docs/robot-lines.md"),
    ("src/session/adapters.rs", "declarations inside a log"),
    ("src/acquire/panel_maps.rs", "maps inside a log"),
    ("src/json.rs", "an example in a test"),
    ("src/calibrate/robot/in_frame.rs", "stands in pairs.json, and is listed there by name"),
    ("src/transport/checkpoint.rs", "of an interrupted run"),
    ("src/learn/materials/recipe.rs", "of an interrupted training"),
    ("src/learn/recipe.rs", "of an interrupted training"),
    ("src/learn/figures.rs", "of an interrupted training"),
    ("src/learn/specimen.rs", "metadata of a data set's tensors"),
    ("src/learn/checkpoint.rs", "of an interrupted training"),
];

/// Files that are put together key by key: source, function, heading.
const ASSEMBLED: [(&str, &str, &str); 4] = [
    ("src/render/write.rs", "fn description(", "IMAGE.tif.json"),
    ("src/transport/image.rs", "fn describe(", "IMAGE.tif.json"),
    ("src/transport/dose.rs", "fn describe(", "IMAGE.tif.json"),
    ("src/cli/compare.rs", "let result = serde_json::json!(", "compare.json"),
];

fn read(path: &str) -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}

/// A type of a source file: its name and its keys as serde writes them.
#[derive(Debug, Default)]
struct Keys {
    name: String,
    refuses_unknown: bool,
    keys: Vec<String>,
}

fn snake(name: &str) -> String {
    let mut words = String::new();
    for c in name.chars() {
        if c.is_ascii_uppercase() && !words.is_empty() {
            words.push('_');
        }
        words.push(c.to_ascii_lowercase());
    }
    words
}

/// The value of `rename = "…"` among attributes.
fn renamed(attributes: &str) -> Option<String> {
    let rest = &attributes[attributes.find("rename = \"")? + 10..];
    Some(rest[..rest.find('"')?].to_owned())
}

/// Structs and enums of a source, up to its tests.
fn types(source: &str) -> Vec<Keys> {
    let text = source.split("#[cfg(test)]\nmod tests").next().unwrap_or_default();
    let lines: Vec<&str> = text.lines().collect();
    let mut found = Vec::new();
    let mut attributes = String::new();
    let mut at = 0;
    while at < lines.len() {
        let line = lines[at].trim();
        let head = line.strip_prefix("pub ").or_else(|| line.strip_prefix("pub(super) ")).unwrap_or(line);
        let named = head.strip_prefix("struct ").or_else(|| head.strip_prefix("enum "));
        if line.starts_with("#[") {
            attributes += line;
        } else if let Some(named) = named.filter(|named| named.ends_with('{')) {
            let name: String = named.chars().take_while(|c| c.is_alphanumeric()).collect();
            let is_enum = head.starts_with("enum");
            let mut keys = Keys { name, refuses_unknown: attributes.contains("deny_unknown_fields"), keys: Vec::new() };
            let end = format!("{}}}", &lines[at][..lines[at].len() - lines[at].trim_start().len()]);
            let inner = end.len() + 3;
            let mut own = String::new();
            at += 1;
            while lines[at] != end {
                let (field, depth) = (lines[at].trim(), lines[at].len() - lines[at].trim_start().len());
                if field.starts_with("#[") {
                    own += field;
                } else if depth == inner && !field.starts_with("//") && !field.starts_with('}') && !field.starts_with(')') {
                    let field = field.strip_prefix("pub ").unwrap_or(field);
                    let name: String = field.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
                    let is_key = if is_enum { !name.is_empty() } else { field[name.len()..].starts_with(':') };
                    if is_key && !own.contains("serde(skip)") {
                        keys.keys.push(renamed(&own).unwrap_or_else(|| if is_enum { snake(&name) } else { name }));
                    }
                    own.clear();
                }
                at += 1;
            }
            found.push(keys);
            attributes.clear();
        } else if !line.starts_with("//") {
            attributes.clear();
        }
        at += 1;
    }
    found
}

/// Keys of a file that is assembled, from `marker` to the end of the function.
fn assembled(source: &str, marker: &str) -> Vec<String> {
    let from = source.split(marker).nth(1).unwrap_or_else(|| panic!("no {marker}"));
    let body = from.split("\n}\n").next().unwrap_or_default();
    let body = body.split("let text = ").next().unwrap_or_default();
    let word =
        |text: &str| text.chars().take_while(|c| c.is_ascii_lowercase() || *c == '_' || c.is_ascii_digit()).collect::<String>();
    let mut keys = Vec::new();
    for (place, _) in body.match_indices('"') {
        let name = word(&body[place + 1..]);
        let after = &body[place + 1 + name.len()..];
        let is_inserted = body[..place].ends_with("insert(");
        if !name.is_empty() && (after.starts_with("\":") || (is_inserted && after.starts_with('"'))) {
            keys.push(name);
        }
    }
    keys
}

/// The text under `## heading` or `### heading`, to the next heading of its level or above.
fn section<'a>(document: &'a str, heading: &str) -> &'a str {
    for level in ["## ", "### "] {
        let title = format!("\n{level}{heading}\n");
        if let Some(at) = document.find(&title) {
            let rest = &document[at + title.len()..];
            let ends = ["\n## ", if level == "### " { "\n### " } else { "\n## " }];
            return &rest[..ends.iter().filter_map(|end| rest.find(end)).min().unwrap_or(rest.len())];
        }
    }
    panic!("docs/file-formats.md has no heading {heading:?}");
}

/// Every key with the heading under which it belongs, and where it comes from.
fn wanted() -> Vec<(String, &'static str, String)> {
    let mut wanted = Vec::new();
    let listed = DESCRIBED.iter().copied().chain(CALIBRATIONS.iter().map(|(path, heading)| (*path, ALL, *heading)));
    for (path, names, heading) in listed {
        let types = types(&read(path));
        let chosen: Vec<&Keys> = match names {
            [] => types.iter().filter(|found| found.refuses_unknown).collect(),
            names => types.iter().filter(|found| names.contains(&found.name.as_str())).collect(),
        };
        assert!(chosen.len() >= names.len().max(1), "{path}: {names:?} not found");
        for found in chosen {
            assert!(!found.keys.is_empty(), "{path}: {} has no keys", found.name);
            wanted.extend(found.keys.iter().map(|key| (key.clone(), heading, format!("{path}, {}", found.name))));
        }
    }
    for (path, marker, heading) in ASSEMBLED {
        let keys = assembled(&read(path), marker);
        assert!(keys.len() >= 4, "{path}: {keys:?}");
        wanted.extend(keys.into_iter().map(|key| (key, heading, path.to_owned())));
    }
    wanted
}

fn missing(document: &str) -> Vec<String> {
    let wanted = wanted();
    assert!(wanted.len() > 350, "{} keys", wanted.len());
    let is_described = |key: &str, heading: &str| section(document, heading).contains(&format!("`{key}`"));
    let left_out = wanted.iter().filter(|(key, heading, _)| !is_described(key, heading));
    left_out.map(|(key, heading, from)| format!("`{key}` under \"{heading}\" ({from})")).collect()
}

#[test]
fn every_key_stands_in_the_file_formats() {
    let document = read("docs/file-formats.md");
    let missing_now = missing(&document);
    assert!(missing_now.is_empty(), "{} keys are not described:\n{}", missing_now.len(), missing_now.join("\n"));
    // Control: a key that is taken out is missed, under its own heading alone.
    for key in ["world_from_lps", "blur_fwhm_mm", "chi2_per_dof", "discriminating", "orbital_axis_skew_deg"] {
        let without = document.replace(&format!("`{key}`"), "");
        assert!(missing(&without).iter().any(|one| one.starts_with(&format!("`{key}`"))), "{key} is not missed");
    }
}

#[test]
fn no_type_that_refuses_unknown_keys_is_left_out() {
    let mut files = Vec::new();
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    rust_files(&root.join("src"), &mut files);
    let known: BTreeSet<&str> = DESCRIBED
        .iter()
        .map(|(path, ..)| *path)
        .chain(CALIBRATIONS.iter().map(|(path, _)| *path))
        .chain(INTERNAL.iter().map(|(path, _)| *path))
        .collect();
    let mut seen = 0;
    for file in files {
        let text = std::fs::read_to_string(&file).expect("readable");
        let refuses = text.lines().any(|line| line.trim().starts_with("#[serde(") && line.contains("deny_unknown_fields"));
        if refuses {
            let path = file.strip_prefix(root).expect("inside").display().to_string();
            assert!(
                known.contains(path.as_str()),
                "{path} has keys of a file: list it here, and its keys in docs/file-formats.md"
            );
            seen += 1;
        }
    }
    assert!(seen > 30, "{seen} files");
}

#[test]
fn keys_are_read_as_serde_writes_them() {
    let source = "#[derive(Deserialize)]\n#[serde(deny_unknown_fields)]\npub struct A {\n    /// x\n    pub one_mm: f64,\n    #[serde(default, rename = \"else\")]\n    pub \
                  otherwise: u8,\n    #[serde(skip)]\n    pub hidden: u8,\n}\n\n#[serde(rename_all = \"snake_case\")]\npub enum B {\n    /// y\n    TwoWords(u8),\n}\n";
    let found = types(source);
    assert_eq!(found.len(), 2);
    assert!(found[0].refuses_unknown && !found[1].refuses_unknown);
    assert_eq!(found[0].keys, ["one_mm", "else"]);
    assert_eq!(found[1].keys, ["two_words"]);
    assert_eq!(
        assembled("fn f(a) {\n    j!({\"a_b\": 1});\n    map.insert(\"c\".to_owned(), \"d\");\n}\n", "fn f("),
        ["a_b", "c"]
    );
}

/// The table of joints in DICOM's words, against the program's own conversion.
#[test]
fn the_angles_in_the_conventions_are_those_of_the_program() {
    use sidecarm::geometry::{AngleConvention, CarmAngles, PatientPosition};
    let document = read("docs/conventions.md");
    let mut rows = 0;
    for line in
        document.lines().filter(|line| ["| HFS ", "| HFP ", "| FFS ", "| FFP "].iter().any(|start| line.starts_with(start)))
    {
        let cells: Vec<&str> = line.trim_matches('|').split('|').map(str::trim).collect();
        let [position, joints, stated @ ..] = &cells[..] else { panic!("{line}") };
        let position: PatientPosition = position.parse().expect("a position");
        let degrees = match joints.split_once(' ') {
            None => [0.0; 3],
            Some(("angulation", degrees)) => [degrees.parse().expect("a number"), 0.0, 0.0],
            Some((_, degrees)) => [0.0, degrees.parse().expect("a number"), 0.0],
        };
        let device = CarmAngles::from_degrees(degrees);
        let found = AngleConvention::Device.convert(device, AngleConvention::Dicom, position).to_degrees();
        for (stated, found) in stated.iter().zip(found) {
            let off = (stated.parse::<f64>().expect("a number") - found).rem_euclid(360.0);
            assert!(off.min(360.0 - off) < 1e-9, "{line}: {found}");
        }
        rows += 1;
    }
    assert_eq!(rows, 12);
}
