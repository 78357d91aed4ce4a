//! What a session that nobody sees says once everything may come.

use std::path::Path;

use crate::session::file::Setup;
use crate::session::inputs::InputNames;

/// In a line: which lines are heard, which folder is watched, where it is recorded. Names are those that may be shown; what listens on the
/// network has said so itself.
pub(super) fn ready(setup: &Setup, names: &InputNames, out: &Path) -> String {
    let ports = setup.ports().into_iter().flatten();
    let heard: Vec<String> =
        ports.map(|port| format!("the {} on {}", port.device, names.hide(&port.path.display().to_string()))).collect();
    let heard = if heard.is_empty() { "no line".to_owned() } else { heard.join(" and ") };
    let folder = names.hide(&setup.session.frames.folder.display().to_string());
    format!("listening to {heard}, watching the folder {folder}, recording to {}: waiting for frames", out.display())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_folder_and_place_are_named_and_no_person() {
        let setup = |session: serde_json::Value| -> Setup {
            let whole = serde_json::json!({
                "session": session, "carm": null, "robot": null, "beads": null, "scene_json": "{}", "scene_path": "scene.json"
            });
            serde_json::from_value(whole).expect("a setup")
        };
        let said = |setup: &Setup| ready(setup, &InputNames::of(setup, &[]), Path::new("run-1"));
        let bare = setup(serde_json::json!({"frames": {"folder": "Meisterfolder"}, "scene": "scene.json"}));
        assert_eq!(said(&bare), "listening to no line, watching the folder frames, recording to run-1: waiting for frames");
        let heard = setup(serde_json::json!({
            "carm": {"port": "udp://:5005", "calibration": "x"}, "robot": {"port": "/dev/ttyUSB7", "model": "x"},
            "frames": {"folder": "lab/frames"}, "scene": "scene.json"
        }));
        let words = said(&heard);
        assert!(words.starts_with("listening to the C-arm on udp://:5005 and the robot on ttyUSB7, watching"), "{words}");
        assert!(words.contains("watching the folder frames, recording"), "{words}");
    }
}
