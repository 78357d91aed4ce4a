//! A session whose scene has a materials network of its own.

use std::path::Path;

use serde_json::{Value, json};

use crate::acquire_identity::{hits, written};
use crate::calibrate_session::{pictures, session, write_png16};
use crate::live_lab::Lab;
use crate::log_lab::{sidecarm, text};

/// What the network is called reaches neither log nor report; a replay finds it by its content, wherever it lies, and gives the same bits.
#[test]
fn a_network_of_ones_own_says_the_bone_in_a_session_and_in_its_replay() {
    let Some(lab) = Lab::start(&["--kit-only", "--exposures", "1"]) else { return };
    for (index, picture) in pictures(&lab).iter().enumerate() {
        write_png16(&lab.frames().join(format!("frame-{:03}.png", index + 1)), picture);
    }
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("calibration/networks");
    let copy = |folder: &Path, name: &str| {
        std::fs::create_dir_all(folder).expect("a folder");
        for ending in ["safetensors", "json"] {
            std::fs::copy(shipped.join(format!("materials.{ending}")), folder.join(format!("{name}.{ending}"))).expect("copied");
        }
    };
    copy(&lab.kit, "Quaxwelk");
    let path = lab.kit.join("scene.json");
    let mut scene: Value = serde_json::from_slice(&std::fs::read(&path).expect("a scene")).expect("JSON");
    for object in scene["objects"].as_array_mut().expect("a list") {
        if let Some(materials) = object.get_mut("ct").map(|ct| &mut ct["materials"]) {
            *materials = json!({"network": "Quaxwelk.safetensors"});
        }
    }
    assert!(scene.to_string().contains("Quaxwelk"), "the kit has a CT");
    std::fs::write(&path, scene.to_string()).expect("written");
    let (_, pairs, said) = session(&lab, |session| session["domain"] = json!("linear"));
    assert_eq!(pairs.len(), 1, "{said}");
    let out = lab.kit.join("out");
    let outputs = written(&out);
    assert!(hits(&outputs, "quaxwelk").is_empty(), "{:?}", hits(&outputs, "quaxwelk"));
    assert!(!hits(&outputs, "bone of objects[0].ct").is_empty(), "the control: what it said stands there");
    // Elsewhere, under another name, and nowhere else.
    let data = lab.kit.join("data");
    copy(&data, "other");
    for ending in ["safetensors", "json"] {
        std::fs::remove_file(lab.kit.join(format!("Quaxwelk.{ending}"))).expect("removed");
    }
    let (log, again) = (out.join("session.mcap"), lab.kit.join("again"));
    let replayed = sidecarm(&["replay", text(&log), "--data", text(&lab.kit), "--json", "--out", text(&again)]);
    let found = replayed.json();
    let different = found["images_different"].as_array().map(Vec::len);
    assert_eq!((found["images_identical"].as_u64(), different), (Some(1), Some(0)), "{found:#}{}", replayed.stderr);
}
