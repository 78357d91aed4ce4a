//! Logs whose replay lied, from `../shared/data/bad-files`: they were "identical" or "largest difference 0".
#![cfg(unix)]

use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;

fn bad_file(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data/bad-files").join(name);
    if !path.exists() {
        println!("skipped: {} is not there", path.display());
    }
    Some(path).filter(|path| path.exists())
}

/// Replays `log` with the kit of the mock, from which it was made; exit code and answer.
fn replayed(log: &Path) -> Option<(Option<i32>, Value)> {
    let lab = crate::live_lab::Lab::start(&["--kit-only", "--exposures", "0"])?;
    let mut lab = lab;
    lab.mock.end(crate::live_lab::HANG_S).expect("the kit is written");
    let out = lab.kit.with_file_name("replayed");
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    let run = command.arg("replay").arg(log).arg("--data").arg(&lab.kit).arg("--out").arg(out).arg("--json").output();
    let run = run.expect("the program starts");
    let words = String::from_utf8_lossy(&run.stderr).into_owned();
    assert!(!words.contains("panicked"), "{words}");
    let answer = serde_json::from_slice(&run.stdout).unwrap_or_else(|error| panic!("{error}: {words}"));
    Some((run.status.code(), answer))
}

/// 195 703 pixels of its DRR are NaN, which the largest difference ignored.
#[test]
fn an_image_of_nan_is_not_identical() {
    let Some((code, answer)) = bad_file("nan_huge.mcap").and_then(|log| replayed(&log)) else { return };
    assert_eq!(code, Some(3), "{answer}");
    assert_eq!(answer["images_identical"], 0, "{answer}");
    let different = answer["images_different"].as_array().expect("a list");
    assert_eq!(different.len(), 1, "{answer}");
    assert!(!answer["images_different"].to_string().contains("0.0,"), "no difference of zero: {answer}");
}

/// An image that the replay did not render is different.
#[test]
fn an_image_that_was_not_rendered_is_not_identical() {
    let Some((code, answer)) = bad_file("norender.mcap").and_then(|log| replayed(&log)) else { return };
    assert_eq!(code, Some(3), "{answer}");
    assert_eq!(answer["images_identical"], 0, "{answer}");
}
