//! Arrows point one way: a module uses only modules before it in the data flow.

use std::path::{Path, PathBuf};

/// The data-flow order, as `lib.rs` declares it. `report` stands before `session`, because a session draws each strip as it goes.
const ORDER: [&str; 33] = [
    "units",
    "time",
    "random",
    "memory",
    "regular",
    "json",
    "spelling",
    "table",
    "image",
    "reporter",
    "foreign",
    "geometry",
    "estimate",
    "gpu",
    "telemetry",
    "acquire",
    "mask",
    "timeline",
    "beads",
    "pose",
    "infer",
    "scene",
    "render",
    "transport",
    "compare",
    "learn",
    "record",
    "calibrate",
    "report",
    "igtl",
    "session",
    "viewer",
    "cli",
];

fn rank(module: &str) -> Option<usize> {
    ORDER.iter().position(|known| *known == module)
}

pub fn rust_files(folder: &Path, found: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).expect("folder is readable").flatten() {
        let path = entry.path();
        if path.is_dir() {
            rust_files(&path, found);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            found.push(path);
        }
    }
}

/// Modules named by `crate::…` in `text`, braces one level deep included.
fn used_modules(text: &str) -> Vec<String> {
    let name = |rest: &str| rest.chars().take_while(|c| c.is_ascii_lowercase() || *c == '_').collect::<String>();
    let mut used = Vec::new();
    for (at, _) in text.match_indices("crate::") {
        let rest = &text[at + "crate::".len()..];
        if let Some(list) = rest.strip_prefix('{') {
            let mut depth = 0usize;
            let mut start = true;
            for (index, c) in list.char_indices() {
                match c {
                    '{' => depth += 1,
                    '}' if depth == 0 => break,
                    '}' => depth -= 1,
                    ',' if depth == 0 => start = true,
                    c if start && c.is_ascii_lowercase() => {
                        used.push(name(&list[index..]));
                        start = false;
                    }
                    _ => {}
                }
            }
        } else {
            used.push(name(rest));
        }
    }
    used
}

fn violations(module: &str, text: &str) -> Vec<String> {
    let own = rank(module);
    used_modules(text).into_iter().filter(|used| matches!((own, rank(used)), (Some(own), Some(used)) if used > own)).collect()
}

#[test]
fn modules_use_only_modules_before_them() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    rust_files(&root, &mut files);
    let mut checked = 0;
    for file in files {
        let relative = file.strip_prefix(&root).expect("below src");
        let first = relative.components().next().expect("has a name").as_os_str().to_string_lossy().into_owned();
        let module = first.trim_end_matches(".rs");
        if matches!(module, "lib" | "main" | "video_main") {
            continue;
        }
        assert!(rank(module).is_some(), "src/{module} is not in the order of DESIGN §2");
        let text = std::fs::read_to_string(&file).expect("source is text");
        let wrong = violations(module, &text);
        assert!(wrong.is_empty(), "{} uses later modules: {wrong:?}", relative.display());
        checked += 1;
    }
    assert!(checked > 10);
}

#[test]
fn lib_declares_modules_in_data_flow_order() {
    let lib = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("src/lib.rs")).expect("lib.rs");
    let ranks: Vec<usize> = lib
        .lines()
        .filter_map(|line| line.trim().strip_prefix("pub mod ")?.strip_suffix(';'))
        .map(|module| rank(module).unwrap_or_else(|| panic!("{module} is not in the order")))
        .collect();
    assert!(ranks.len() > 4 && ranks.is_sorted(), "{ranks:?}");
}

/// The control: an arrow that points backwards is found.
#[test]
fn a_backward_arrow_is_found() {
    assert_eq!(violations("geometry", "use crate::{time::now, render::{Plan, Pass}};"), ["render"]);
    assert_eq!(violations("geometry", "crate::viewer::show()"), ["viewer"]);
    assert!(violations("cli", "use crate::render::Plan;").is_empty());
}

/// What opens a file whatever it is, and waits for ever where that is a pipe.
const OPENINGS: [&str; 7] = [
    "File::open(",
    "fs::read(",
    "fs::read_to_string(",
    "ImageReader::open(",
    ".from_path(",
    "File::options(",
    "OpenOptions::new(",
];
/// Where one stands for a reason.
const OPENS: [(&str, &str); 8] = [
    ("regular.rs", "asks first what it is"),
    ("memory.rs", "the system's own figures"),
    ("cli/devices.rs", "the system's own figures"),
    ("cli/time.rs", "the system's own figures"),
    ("cli/signals.rs", "the system's own word"),
    ("record/recorder.rs", "makes a log, and reads none"),
    ("image/temporary.rs", "makes a file, and reads none"),
    ("image/new_file.rs", "puts on the disk what it has just written, and its folder"),
];

/// What writes a file under its name, where it is seen half written and a loss of power leaves it empty.
const WRITINGS: [&str; 4] = ["fs::write(", " File::create(", "(File::create(", "fs::File::create("];
/// Where one stands for a reason.
const WRITES: [(&str, &str); 2] =
    [("image/video.rs", "under a name that is no file's yet"), ("session/chime.rs", "in a temporary folder")];

/// Which of `calls` stand in `text`, tests left out.
fn calls(text: &str, calls: &[&'static str]) -> Vec<&'static str> {
    let code = text.split("\n#[cfg(test)]\nmod ").next().unwrap_or_default();
    calls.iter().copied().filter(|call| code.contains(call)).collect()
}

/// Asserts that no file of the library but those of `exceptions` has one of `listed`, and that each of those has.
fn assert_only(exceptions: &[(&str, &str)], listed: &[&'static str], remedy: &str) {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let (mut files, mut known) = (Vec::new(), 0);
    rust_files(&root, &mut files);
    for file in files.iter().filter(|file| !file.ends_with("tests.rs")) {
        let found = calls(&std::fs::read_to_string(file).expect("source is text"), listed);
        let name = file.strip_prefix(&root).expect("below src").to_string_lossy().replace('\\', "/");
        let is_known = exceptions.iter().any(|(of, _)| *of == name);
        assert!(found.is_empty() || is_known, "{name}: {found:?}: {remedy}");
        known += usize::from(is_known && !found.is_empty());
    }
    assert_eq!(known, exceptions.len(), "an exception that is none any more");
}

#[test]
fn files_are_opened_where_it_is_asked_what_they_are() {
    assert_only(&OPENS, &OPENINGS, "open it with crate::regular");
    // The control, and what tests open.
    assert_eq!(calls("let text = std::fs::read(path)?;", &OPENINGS), ["fs::read("]);
    assert!(calls("regular::read(path);\n#[cfg(test)]\nmod tests { std::fs::read(path) }", &OPENINGS).is_empty());
}

/// Bindings of `attach` were written under their own name.
#[test]
fn files_are_written_where_they_appear_whole() {
    assert_only(&WRITES, &WRITINGS, "write it with crate::image::write_atomically, or with NewFile");
    assert_eq!(calls("std::fs::write(path, text)?; NewFile::create(path)?", &WRITINGS), ["fs::write("], "the control");
    assert_eq!(calls("let file = File::create(path)?;", &WRITINGS), [" File::create("], "the control");
}

/// Why a test is ignored names the command of `scripts/evaluate` that runs it, and that command runs it.
fn unrun(file: &str, text: &str, script: &str) -> Vec<String> {
    let mut missing = Vec::new();
    let mut lines = text.lines();
    while let Some(line) = lines.next() {
        let Some(reason) = line.trim().strip_prefix("#[ignore = \"").and_then(|rest| rest.strip_suffix("\"]")) else { continue };
        let name = lines.by_ref().find_map(|line| line.trim().strip_prefix("fn ")?.split('(').next()).unwrap_or_default();
        let command = reason.split("scripts/evaluate ").nth(1).and_then(|rest| rest.split(' ').next()).unwrap_or_default();
        let body = script.split(&format!("\n  {command})")).nth(1).and_then(|rest| rest.split(";;").next()).unwrap_or_default();
        let filters = body
            .match_indices("ignored ")
            .map(|(at, word)| body[at + word.len()..].split_whitespace().next().unwrap_or_default());
        let path = format!("{file}::{name}");
        if command.is_empty() || !filters.into_iter().any(|filter| !filter.is_empty() && path.contains(filter)) {
            missing.push(format!("{path}: {reason}"));
        }
    }
    missing
}

#[test]
fn every_ignored_test_is_run_by_the_command_that_it_names() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let script = std::fs::read_to_string(root.join("scripts/evaluate")).expect("the script");
    let (mut ignored, mut missing) = (0, Vec::new());
    let mut files = Vec::new();
    ["tests", "src", "mocks"].iter().for_each(|folder| rust_files(&root.join(folder), &mut files));
    for file in files {
        let text = std::fs::read_to_string(&file).expect("source is text");
        ignored += text.lines().filter(|line| line.trim().starts_with("#[ignore")).count();
        missing.extend(unrun(&file.file_stem().expect("a name").to_string_lossy(), &text, &script));
    }
    assert!(ignored >= 15 && missing.is_empty(), "{missing:#?}");
    // The control: no command, one that is not there, one that runs another test.
    let of = |reason: &str| {
        unrun("a", &format!("#[ignore = \"{reason}\"]\nfn many() {{}}"), "case\n  all) ignored a::many ;;\n  b) ignored b:: ;;")
    };
    assert_eq!([of("long"), of("scripts/evaluate c runs it"), of("scripts/evaluate b runs it")].map(|found| found.len()), [1; 3]);
    assert!(of("scripts/evaluate all runs it").is_empty());
}
