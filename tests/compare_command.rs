//! `sidecarm compare` on files, without a scene.

use std::path::Path;

use sidecarm::cli::compare::{CompareArgs, CompareCommandError, run};
use sidecarm::compare::{AirLevel, CompareError, OffsetRule, Tone};
use sidecarm::image::{Image, ImageFileError, write_png_rgb, write_tiff_f32};
use sidecarm::reporter::Reporter;

use crate::compare_synthetic::{acquired, line_integral, view};

fn args(folder: &Path) -> CompareArgs {
    CompareArgs {
        acquired: folder.join("frame.tif"),
        simulated: folder.join("drr.tif"),
        scene: None,
        pose: None,
        mask: None,
        tone: Tone::None,
        air: AirLevel::Open,
        offset: OffsetRule::Shutters,
        detector: None,
        domain: Some(sidecarm::acquire::Domain::Linear),
        quantity: None,
        json: false,
        out: folder.join("compared"),
    }
}

fn write_inputs(folder: &Path) {
    let simulated = line_integral(&view());
    write_tiff_f32(&folder.join("frame.tif"), &[acquired(&simulated, 0.01).pixels.map(|v| 900.0 * v)]).expect("writes");
    write_tiff_f32(&folder.join("drr.tif"), &[simulated.map(|l| (-l).exp())]).expect("writes");
    std::fs::write(folder.join("drr.tif.json"), r#"{"quantity": "intensity"}"#).expect("writes");
}

#[test]
fn files_become_numbers_and_a_strip() {
    let folder = tempfile::tempdir().expect("scratch");
    write_inputs(folder.path());
    assert_eq!(run(&args(folder.path()), &Reporter::silent()).expect("compares"), 0);
    let text = std::fs::read_to_string(folder.path().join("compared/compare.json")).expect("written");
    let value: serde_json::Value = serde_json::from_str(&text).expect("json");
    assert!(value["comparison"]["scores"]["zncc"].as_f64().expect("number") > 0.99, "{text}");
    assert_eq!(value["comparison"]["air"]["rule"], "open");
    let strip = std::fs::read(folder.path().join("compared/strip.png")).expect("written");
    assert!(strip.starts_with(b"\x89PNG"));
}

#[test]
fn an_unknown_quantity_a_small_rest_and_overwriting_are_refused() {
    let folder = tempfile::tempdir().expect("scratch");
    write_inputs(folder.path());
    let reporter = Reporter::silent();
    let plain = args(folder.path());

    let mask = Image { width: 310, height: 240, pixels: (0..310 * 240).map(|at| [u8::from(at / 310 < 200) * 255; 3]).collect() };
    write_png_rgb(&folder.path().join("mask.png"), &mask).expect("writes");
    let masked = CompareArgs { mask: Some(folder.path().join("mask.png")), ..plain.clone() };
    assert!(matches!(run(&masked, &reporter), Err(CompareCommandError::Compare(CompareError::TooLittleLeft { .. }))));
    assert!(!plain.out.exists(), "nothing half-written");

    std::fs::remove_file(folder.path().join("drr.tif.json")).expect("is there");
    assert!(matches!(run(&plain, &reporter), Err(CompareCommandError::Quantity { .. })));
    let told = CompareArgs { quantity: Some("intensity".into()), ..plain.clone() };
    assert_eq!(run(&told, &reporter).expect("told"), 0);

    let over = CompareArgs { mask: Some(told.out.join("strip.png")), ..told };
    assert!(matches!(run(&over, &reporter), Err(CompareCommandError::Image(ImageFileError::WouldOverwrite { .. }))));
}
