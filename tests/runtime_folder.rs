//! What libraries under the program would say on its standard error.
#![cfg(target_os = "linux")]

use std::process::Command;

use serde_json::{Value, json};

/// Mesa's Vulkan layer that chooses among devices asks Wayland, and Wayland's library complains on standard error of a machine without a
/// folder for sessions (a service, a container, `su`): a line that means nothing to whoever renders, before each image. The scripts of this
/// project set the variable, so nobody saw it here.
#[test]
fn a_command_without_a_window_says_nothing_of_the_runtime_folder() {
    let folder = tempfile::tempdir().expect("folder");
    let scene = json!({
        "objects": [{"sphere": {"centre_lps_mm": [0, 0, 0], "radius_mm": 20, "material": "water"}}],
        "view": {"size_px": [16, 12], "intrinsics": [[500, 0, 7.5], [0, 500, 5.5], [0, 0, 1]],
                 "camera_from_lps": [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 600], [0, 0, 0, 1]]},
        "beam": {"mono_kev": 60}, "detector": {"pitch_mm": 2.0}
    });
    std::fs::write(folder.path().join("scene.json"), scene.to_string()).expect("written");
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    command.args(["render", "scene.json", "--out", "drr.tif", "--json"]).current_dir(folder.path());
    let ran = command.env_remove("XDG_RUNTIME_DIR").env_remove("WAYLAND_DISPLAY").output().expect("it starts");
    let said = String::from_utf8_lossy(&ran.stderr);
    assert_eq!(ran.status.code(), Some(0), "{said}");
    let told: Value = serde_json::from_slice(&ran.stdout).expect("JSON");
    let is_on_gpu = told["adapter"].as_str().is_some_and(|adapter| !adapter.starts_with("CPU executor"));
    assert!(is_on_gpu || said.contains("no hardware GPU found"), "the control, it looked for devices: {said} {told}");
    assert!(!said.contains("XDG_RUNTIME_DIR"), "{said}");
}
