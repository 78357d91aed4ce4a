//! A pedestal without a calibration: radiographs that the project did not make hold 4000 where no X-ray falls.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use sidecarm::acquire::{Domain, read_frame};
use sidecarm::compare::{AirLevel, CompareInput, OffsetRule, compare};
use sidecarm::geometry::{Projection, View};
use sidecarm::gpu::DeviceChoice;
use sidecarm::render::{Options, Quantity, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene;

fn data(name: &str) -> Option<PathBuf> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data").join(name);
    if !path.exists() {
        println!("skipped: {} is not here", path.display());
    }
    Some(path).filter(|path| path.exists())
}

fn read_json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).expect("readable")).expect("JSON")
}

/// Frames of 16 bits with a pedestal were compared as if zero were dark: 0.5 nepers of error behind the pelvis, and no word.
#[test]
fn the_pedestal_is_read_behind_the_shutters_and_said() {
    let (Some(frames), Some(ct)) = (data("bead-frames"), data("ct-pelvis/ct.nii.gz")) else { return };
    let reporter = Reporter::silent();
    let ct = std::fs::canonicalize(ct).expect("exists");
    let mut renderer = Renderer::new(DeviceChoice::Cpu, &reporter).expect("CPU");
    let mut cases = 0;
    for name in ["case-00", "case-01", "case-02"] {
        let folder = frames.join(name);
        let truth = read_json(&folder.join("truth.json"));
        let projection: Projection = serde_json::from_value(truth["projection"].clone()).expect("3 x 4");
        let (intrinsics, camera_from_lps) = projection.decompose().expect("a camera");
        let full = View { size_px: [1024, 1024], intrinsics, camera_from_lps };
        let (view, factor) = full.at_most_wide(256);
        let pitch_mm = read_json(&folder.join("k.json"))["pitch_mm"].as_f64().expect("stated") * f64::from(factor);
        let text = json!({
            "objects": [{"ct": {"path": ct, "materials": "threshold"}}],
            "beam": {"tube_kvp": 90, "anode_angle_deg": 12, "filtration_mm": {"aluminium": 4.3}},
            "detector": {"response": "energy", "pitch_mm": pitch_mm}
        });
        let scene =
            scene::load_text(&text.to_string(), Path::new("pelvis.json"), false, &reporter).expect("loads").with_view(view);
        let options = Options { quantity: Quantity::LineIntegral, ..Options::default() };
        let rendered = renderer.render(&scene, &options).expect("renders");
        let frame = read_frame(&folder.join("frame_pedestal4000_u16.tif"), Some(Domain::Linear)).expect("reads");
        let compared = |offset: OffsetRule| {
            let input =
                CompareInput { air: AirLevel::Value(2.5e6 + 4000.0), offset, ..CompareInput::new(&frame, &rendered.pages[0]) };
            compare(&input).expect("compares").comparison
        };
        let found = compared(OffsetRule::Shutters);
        let offset = found.air.offset.as_ref().expect("linear");
        let sigma = offset.sigma.expect("estimated");
        assert_eq!(offset.rule, "shutters", "{name}: {offset:?}");
        assert!((offset.value - 4000.0).abs() < 4.0 * sigma && sigma < 20.0, "{name}: {} ± {sigma}", offset.value);
        assert!(found.flags.iter().any(|flag| flag.contains("pedestal of")), "{:?}", found.flags);
        let level = found.air.level.expect("declared");
        assert!((level / 2.5e6 - 1.0).abs() < 1e-4, "a declared stored value stands on the same pedestal: {level}");
        let told = compared(OffsetRule::Value(4000.0));
        let without = compared(OffsetRule::None);
        let rmse = |of: &sidecarm::compare::Comparison| of.scores.rmse_nepers.expect("absolute");
        println!(
            "{name}: pedestal {:.1} ± {sigma:.1}; rmse {:.4}, told {:.4}, not subtracted {:.4}",
            offset.value,
            rmse(&found),
            rmse(&told),
            rmse(&without)
        );
        assert!((rmse(&found) - rmse(&told)).abs() < 0.01, "{name}: as good as the true one");
        assert!(
            (without.scores.bias_nepers.expect("absolute") - told.scores.bias_nepers.expect("absolute")).abs() > 0.1,
            "control"
        );
        cases += 1;
    }
    assert_eq!(cases, 3);
}
