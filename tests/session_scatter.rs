//! Scatter in a session's DRRs, as the network has it.

use serde_json::{Value, json};

use crate::calibrate_session::{pictures, session, write_png16};
use crate::live_lab::Lab;
use crate::log_lab::{sidecarm, text};

/// `live` left scatter out whatever the scene asked for. With it a DRR is brighter where the specimen is, its pair and the null are made with
/// it, the report no longer calls it missing, and the log gives the same bits.
#[test]
fn a_session_asks_the_network_and_its_replay_asks_again() {
    let Some(lab) = Lab::start(&["--kit-only", "--exposures", "2"]) else { return };
    let pictures = pictures(&lab);
    let run = |model: &str| {
        for (index, picture) in pictures.iter().enumerate() {
            write_png16(&lab.frames().join(format!("frame-{:03}.png", index + 1)), picture);
        }
        let path = lab.kit.join("scene.json");
        let mut scene: Value = serde_json::from_slice(&std::fs::read(&path).expect("a scene")).expect("JSON");
        scene["model"]["scatter"] = json!(model);
        std::fs::write(&path, scene.to_string()).expect("written");
        let _ = std::fs::remove_dir_all(lab.kit.join("out"));
        let (_, pairs, said) = session(&lab, |session| session["domain"] = json!("linear"));
        assert_eq!(pairs.len(), 2, "{said}");
        let report = std::fs::read_to_string(lab.kit.join("out").join("report.html")).expect("a report");
        (pairs, report)
    };
    let (without, report) = run("off");
    assert!(report.contains("scatter: not asked for"), "the control");
    let (with, report) = run("network");
    assert!(!report.contains("scatter: not asked for") && report.contains("scatter network"), "{report}");
    let brightness = |pair: &Value| pair["scores"]["rmse_nepers"].as_f64().expect("a number");
    for (with, without) in with.iter().zip(&without) {
        assert!(with["stages_ms"]["scatter"].as_f64().is_some_and(|ms| ms > 0.0), "{with:#}");
        assert!(without["stages_ms"]["scatter"].is_null(), "the control");
        // The mock's frames have none.
        assert!(brightness(with) > brightness(without) + 0.02, "{} {}", brightness(with), brightness(without));
        assert!(with["scores"]["zncc"].as_f64().is_some_and(|zncc| zncc > 0.9), "{with:#}");
        assert!(!with["flags"].to_string().contains("scatter is left out"), "{with:#}");
    }
    let (log, again) = (lab.kit.join("out").join("session.mcap"), lab.kit.join("again"));
    let replayed = sidecarm(&["replay", text(&log), "--data", text(&lab.kit), "--json", "--out", text(&again)]);
    let found = replayed.json();
    let different = found["images_different"].as_array().map(Vec::len);
    assert_eq!((found["images_identical"].as_u64(), different), (Some(2), Some(0)), "{found:#}");
}
