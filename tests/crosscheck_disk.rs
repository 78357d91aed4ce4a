//! How much room a session has, through `check`, on file systems of known size.
#![cfg(target_os = "linux")]

use std::path::Path;
use std::process::{Command, Output};

use serde_json::{Value, json};

/// Said on standard error once the file system is there.
const MOUNTED: &str = "the file system is there";
/// Mounts an empty file system of size `$1` at `$2` and checks there, with the program `$4`, the session `$5`.
const SCRIPT: &str =
    r#"mount -t tmpfs -o "size=$1" tmpfs "$2" && echo "$3" >&2 && exec "$4" check "$5" --out "$2/session" --json --limit 200"#;

/// What `check` finds of a session on a file system of this size, which nobody else sees and which goes with the program; `None` (said)
/// where none can be mounted.
fn checked(size: &str, disk: &Path, session: &Path) -> Option<Vec<Value>> {
    // Where users may make namespaces no root is needed; where they may not, root can do without.
    for namespaces in [&["--map-root-user", "--mount"][..], &["--mount"]] {
        let mut command = Command::new("unshare");
        command.args(namespaces).args(["sh", "-c", SCRIPT, "sh", size]).arg(disk).arg(MOUNTED);
        let run = command.arg(env!("CARGO_BIN_EXE_sidecarm")).arg(session).output();
        let Ok(Output { stdout, stderr, .. }) = run else { continue };
        let words = String::from_utf8_lossy(&stderr);
        if words.contains(MOUNTED) {
            let found: Value = serde_json::from_slice(&stdout).unwrap_or_else(|error| panic!("{error}: {words}"));
            return Some(found["checks"].as_array().expect("a list").clone());
        }
    }
    println!("skipped: no file system can be mounted here (user namespaces or root are needed)");
    None
}

#[test]
fn a_disk_without_room_for_a_session_is_named_with_its_remedy() {
    let folder = tempfile::tempdir().expect("temporary folder");
    let (disk, frames, session) = (folder.path().join("disk"), folder.path().join("frames"), folder.path().join("session.json"));
    for made in [&disk, &frames] {
        std::fs::create_dir(made).expect("a folder");
    }
    std::fs::write(folder.path().join("scene.json"), "{}").expect("written");
    std::fs::write(&session, json!({"frames": {"folder": "frames"}, "scene": "scene.json"}).to_string()).expect("written");
    for (size, level, free, remedy) in [
        ("64m", "fail", "0.1 GB free", "free at least 1 GB, or choose another --out"),
        ("2g", "warn", "2.1 GB free", "a long session with full-size frames needs 10 GB"),
        ("12g", "pass", "12.9 GB free", ""),
    ] {
        let Some(rows) = checked(size, &disk, &session) else { return };
        let row =
            |name: &str| rows.iter().find(|row| row["check"] == name).unwrap_or_else(|| panic!("{size}: {name}: {rows:#?}"));
        let space = row("disk space");
        assert_eq!((&space["level"], space["remedy"].as_str().unwrap_or_default()), (&json!(level), remedy), "{size}: {space}");
        assert_eq!(space["detail"], format!("{free} where the session is written"), "{size}");
        assert_ne!(row("disk")["level"], "fail", "{size}: the folder itself can be written: {rows:#?}");
    }
}

/// The log and the pictures of a session were taken for frames that cannot be read, and said to be lost.
#[test]
fn a_session_that_would_write_among_its_frames_does_not_begin() {
    let folder = tempfile::tempdir().expect("temporary folder");
    std::fs::create_dir(folder.path().join("frames")).expect("a folder");
    std::fs::write(folder.path().join("scene.json"), "{}").expect("written");
    let session = json!({"frames": {"folder": "frames"}, "scene": "scene.json"});
    std::fs::write(folder.path().join("session.json"), session.to_string()).expect("written");
    let live = |out: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
        command.args(["live", "session.json", "--headless", "--seconds", "0.5", "--out", out]);
        let run = command.current_dir(folder.path()).output().expect("the program starts");
        (run.status.code(), String::from_utf8_lossy(&run.stderr).into_owned())
    };
    let (code, words) = live("frames/../frames");
    assert!(code == Some(1) && words.contains("is the folder in which frames are looked for; choose another --out"), "{words}");
    let left = std::fs::read_dir(folder.path().join("frames")).expect("the folder").count();
    assert_eq!(left, 0, "nothing is written there: {words}");
    let (_, words) = live("run");
    assert!(
        words.contains("scene.json") && !words.contains("frames are looked for"),
        "the control goes on to the scene: {words}"
    );
}
