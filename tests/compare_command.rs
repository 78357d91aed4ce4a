//! `sidecarm compare` on files, without a scene.

use std::path::Path;

use glam::DVec3;
use sidecarm::cli::compare::{CompareArgs, CompareCommandError, run};
use sidecarm::compare::{AirLevel, CompareError, OffsetRule, Tone};
use sidecarm::geometry::Rigid;
use sidecarm::image::{Image, ImageFileError, sha256_file, write_png_rgb, write_tiff_f32};
use sidecarm::pose::{Pose, Status};
use sidecarm::random::{Purpose, Stream};
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

/// Scene and pose were taken for those of the simulated image, whatever it had been rendered from: numbers in millimetres and the null were of
/// another picture.
#[test]
fn a_pose_that_is_not_the_simulated_image_s_is_refused_and_a_copy_of_it_is_said() {
    let folder = tempfile::tempdir().expect("scratch");
    let folder = folder.path();
    write_inputs(folder);
    let view = view();
    let pose = |shift_mm: f64, size_px: [u32; 2]| Pose {
        status: Status::Accepted,
        intrinsics: Some(view.intrinsics),
        camera_from_lps: Some(Rigid::translation(DVec3::X * shift_mm) * view.camera_from_lps),
        size_px: Some(size_px),
        ..Pose::default()
    };
    let path = folder.join("pose.json");
    pose(0.0, [310, 240]).write(&path).expect("writes");
    let camera = serde_json::json!({
        "size_px": view.size_px, "intrinsics": view.intrinsics, "camera_from_lps": view.camera_from_lps
    });
    let inputs = serde_json::json!([{"path": "pose.json", "sha256": sha256_file(&path).expect("hash")}]);
    let described = serde_json::json!({"quantity": "intensity", "view": camera, "inputs": inputs});
    let with_pose = CompareArgs { pose: Some(path.clone()), ..args(folder) };
    let compared = |described: &serde_json::Value| {
        std::fs::write(folder.join("drr.tif.json"), described.to_string()).expect("writes");
        let reporter = Reporter::silent();
        let warned = || reporter.warnings().get("not what was rendered").map(|warning| warning.latest.clone());
        run(&with_pose, &reporter).map(|_| warned())
    };
    assert_eq!(compared(&described).expect("its own pose"), None);
    let silent = compared(&serde_json::json!({"quantity": "intensity"})).expect("compares");
    assert!(silent.expect("a warning").contains("says what it was rendered from"));
    // Written anew, or registered anew: nearly the same.
    pose(0.01, [310, 240]).write(&path).expect("writes");
    let copy = compared(&described).expect("compares").expect("a warning");
    assert!(copy.contains("pose.json") && copy.contains("its camera is the same"), "{copy}");

    let mut refused = 0;
    for (shift_mm, size_px, words) in
        [(3.0, [310, 240], "another pose"), (0.0, [620, 240], "[620, 240]"), (0.0, [300, 240], "whole fraction")]
    {
        pose(shift_mm, size_px).write(&path).expect("writes");
        let error = compared(&described).expect_err("refused");
        assert!(matches!(error, CompareCommandError::Origin(_)) && error.to_string().contains(words), "{error}");
        refused += 1;
    }
    assert_eq!(refused, 3);
}

#[test]
fn what_disagrees_is_counted_and_a_contradicted_quantity_is_refused() {
    let folder = tempfile::tempdir().expect("scratch");
    write_inputs(folder.path());
    let plain = CompareArgs { air: AirLevel::Unknown, ..args(folder.path()) };
    let disagreeing = || {
        let reporter = Reporter::silent();
        run(&plain, &reporter).expect("compares");
        reporter.warnings().get("images disagree").map_or(0, |warning| warning.count)
    };
    assert_eq!(disagreeing(), 0, "control");
    let frame = acquired(&line_integral(&view()), 0.01).pixels.map(|v| 1000.0 - 900.0 * v);
    write_tiff_f32(&folder.path().join("frame.tif"), &[frame]).expect("writes");
    assert_eq!(disagreeing(), 1);
    let text = std::fs::read_to_string(plain.out.join("compare.json")).expect("written");
    assert!(text.contains("inverted_contrast"), "{text}");

    let contradicted = CompareArgs { quantity: Some("line_integral".into()), ..plain };
    let error = run(&contradicted, &Reporter::silent()).expect_err("refused");
    assert!(matches!(error, CompareCommandError::OtherQuantity { .. }), "{error}");
}

/// The frame of a panel that reads 3000 in air, noise included, and `pedestal` more everywhere; with a blade over its left 90 columns that
/// lets a thousandth through, where it is shut.
fn frame_on_pedestal(pedestal: f64, is_shut: bool) -> Image<f32> {
    let mut random = Stream::new(3, 0, 0, Purpose::Evaluation);
    let simulated = line_integral(&view());
    let value = |(at, l): (usize, &f32)| {
        let depth_px = (at % simulated.width) as f64 - 90.0;
        // A penumbra of four pixels.
        let share = if is_shut { (depth_px / 4.0 + 0.5).clamp(0.0, 1.0) } else { 1.0 };
        let open = share * share * (3.0 - 2.0 * share);
        let signal = 3000.0 * (open + 1e-3 * (1.0 - open)) * f64::from(-l).exp();
        (pedestal + signal * (1.0 + 0.004 * random.normal()) + 3.0 * random.normal()) as f32
    };
    let pixels = simulated.pixels.iter().enumerate().map(value).collect();
    Image { width: simulated.width, height: simulated.height, pixels }
}

#[test]
fn a_pedestal_is_read_from_the_shutters_and_an_open_frame_shows_none() {
    let folder = tempfile::tempdir().expect("scratch");
    write_inputs(folder.path());
    let compared = |frame: Image<f32>, offset: OffsetRule| -> serde_json::Value {
        write_tiff_f32(&folder.path().join("frame.tif"), &[frame]).expect("writes");
        let asked = CompareArgs { offset, ..args(folder.path()) };
        assert_eq!(run(&asked, &Reporter::silent()).expect("compares"), 0);
        let text = std::fs::read_to_string(asked.out.join("compare.json")).expect("written");
        let mut found: serde_json::Value = serde_json::from_str(&text).expect("json");
        found["comparison"].take()
    };
    let score =
        |found: &serde_json::Value, name: &str| found["scores"][name].as_f64().unwrap_or_else(|| panic!("{name}: {found:#}"));
    let says = |found: &serde_json::Value, rule: &str, reason: &str| {
        let offset = &found["air"]["offset"];
        assert!(offset["rule"] == rule && offset["reason"].as_str().is_some_and(|words| words.contains(reason)), "{offset}");
        assert_eq!(found["flags"].to_string().contains("pedestal of"), rule == "shutters", "{}", found["flags"]);
    };

    let raised = compared(frame_on_pedestal(212.0, true), OffsetRule::Shutters);
    says(&raised, "shutters", "estimated behind the shutters");
    let value = raised["air"]["offset"]["value"].as_f64().expect("a number");
    assert!((value - 212.0).abs() < 2.5, "{}", raised["air"]["offset"]);
    let shut = raised["masks"]["causes"]["collimation"].as_f64().expect("the blade is found");
    assert!((shut - 0.3).abs() < 0.02, "{shut}");
    let plain = compared(frame_on_pedestal(0.0, true), OffsetRule::Shutters);
    says(&plain, "none", "no pedestal");
    for (name, most) in [("zncc", 5e-3), ("gradient_ncc", 5e-3), ("ssim", 5e-3), ("rmse_nepers", 2e-3)] {
        let [with, without] = [&raised, &plain].map(|found| score(found, name));
        assert!((with - without).abs() < most, "{name}: {with}, without pedestal {without}");
    }
    assert!(score(&raised, "rmse_nepers") < 0.01, "{}", raised["scores"]);

    // The controls: left in, it costs a tenth of a neper; so it does where no shutters show it.
    let kept = compared(frame_on_pedestal(212.0, true), OffsetRule::None);
    says(&kept, "none", "declared");
    let open = compared(frame_on_pedestal(212.0, false), OffsetRule::Shutters);
    says(&open, "none", "no shuttered area");
    for found in [&kept, &open] {
        assert!(score(found, "rmse_nepers") > 0.05, "{}", found["scores"]);
    }
}
