//! `sidecarm render`: files, refusals, and what it promises.

use std::path::Path;

use clap::Parser;
use sidecarm::cli::compare::{CompareArgs, run as run_compare};
use sidecarm::cli::render::{RenderArgs, RenderCommandError, run};
use sidecarm::gpu::{Device, DeviceChoice};
use sidecarm::image::{Image, ImageFileError, read_tiff_f32, write_tiff_f32};
use sidecarm::reporter::Reporter;

#[derive(Parser)]
struct Typed {
    #[command(flatten)]
    args: RenderArgs,
}

const SCENE: &str = r#"{
    "objects": [{"sphere": {"centre_lps_mm": [0, 0, 0], "radius_mm": 20, "material": "water"}},
                {"sphere": {"centre_lps_mm": [0, 0, 0], "radius_mm": 2, "material": "steel_316l"}}],
    "view": {"size_px": [64, 48], "intrinsics": [[1000, 0, 31.5], [0, 1000, 23.5], [0, 0, 1]],
             "camera_from_lps": [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 600], [0, 0, 0, 1]]},
    "beam": {"tube_kvp": 80, "anode_angle_deg": 12, "filtration_mm": {"aluminium": 3}, "photons_per_pixel": 1e5},
    "detector": {"response": "energy", "pitch_mm": 1.0},
    "model": {"formation": "deepdrr", "scatter": "off", "noise": false, "seed": 1}
}"#;

fn render(folder: &Path, more: &[&str]) -> Result<u8, RenderCommandError> {
    let scene = folder.join("scene.json");
    std::fs::write(&scene, SCENE).expect("writes");
    let (scene, out) = (scene.display().to_string(), folder.join("drr.tif").display().to_string());
    let typed = ["render", &scene, "--out", &out, "--device", "cpu"].into_iter().chain(more.iter().copied());
    run(&Typed::parse_from(typed).args, &Reporter::silent())
}

#[test]
fn it_writes_the_image_and_what_it_is() {
    let folder = tempfile::tempdir().expect("folder");
    let png = folder.path().join("drr.png").display().to_string();
    assert_eq!(render(folder.path(), &["--quantity", "area_density", "--png", &png]).expect("renders"), 0);
    let pages = read_tiff_f32(&folder.path().join("drr.tif")).expect("a TIFF");
    assert_eq!((pages.len(), pages[0].width, pages[0].height), (2, 64, 48));
    let text = std::fs::read_to_string(folder.path().join("drr.tif.json")).expect("beside it");
    let json: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    assert_eq!(json["quantity"], "area_density");
    assert_eq!(json["unit"], "g/cm2");
    assert_eq!(json["pages"], serde_json::json!(["water", "steel_316l"]));
    assert!(json["plan"]["stated_error"].as_f64().expect("a number") > 0.0);
    assert!(folder.path().join("drr.png").is_file());
    assert!(!folder.path().join("drr.tif.valid.png").exists(), "no CT, nothing invalid");
}

#[test]
fn the_reference_agrees_through_the_same_command() {
    let folder = tempfile::tempdir().expect("folder");
    let page = |more: &[&str]| {
        render(folder.path(), more).expect("renders");
        read_tiff_f32(&folder.path().join("drr.tif")).expect("a TIFF").remove(0).pixels
    };
    let (fast, slow) = (page(&["--quantity", "line_integral"]), page(&["--quantity", "line_integral", "--reference"]));
    assert!(crate::render_scenes::worst(&fast, &slow) < 1e-5);
    assert!(slow.iter().any(|value| *value > 0.5));
}

#[test]
fn a_bound_that_cannot_be_promised_is_refused_by_name() {
    let folder = tempfile::tempdir().expect("folder");
    assert_eq!(render(folder.path(), &["--max-error", "1e-3"]).expect("promised"), 0);
    let mut cases = 0;
    for wanted in ["1e-9", "4e-6", "0", "nan"] {
        let error = render(folder.path(), &["--max-error", wanted]).expect_err(wanted);
        let words = error.to_string();
        let refused = match wanted {
            "1e-9" => matches!(error, RenderCommandError::MaxError { .. }) && words.contains("nothing reaches less than 1e-7"),
            "4e-6" => matches!(error, RenderCommandError::MaxError { .. }) && words.ends_with("; --reference reaches 1e-7"),
            _ => matches!(error, RenderCommandError::Goal { .. }) && words.contains("positive"),
        };
        assert!(refused, "{words}");
        cases += 1;
    }
    assert_eq!(cases, 4);
    // What was offered, and the least that docs/rendering.md promises without it.
    for promised in [&["--max-error", "4e-6", "--reference"][..], &["--max-error", "5e-6"]] {
        assert_eq!(render(folder.path(), promised).expect("promised"), 0);
    }
    assert_eq!(render(folder.path(), &["--max-error", "2e-6", "--quantity", "area_density"]).expect("no energies"), 0);
}

#[test]
fn an_input_is_not_overwritten() {
    let folder = tempfile::tempdir().expect("folder");
    let scene = folder.path().join("scene.json");
    std::fs::write(&scene, SCENE).expect("writes");
    let path = scene.display().to_string();
    let args = Typed::parse_from(["render", &path, "--out", &path, "--device", "cpu"]).args;
    let error = run(&args, &Reporter::silent()).expect_err("the scene is an input");
    assert!(matches!(error, RenderCommandError::Picture(ImageFileError::WouldOverwrite { .. })), "{error}");
    assert_eq!(std::fs::read_to_string(&scene).expect("still there"), SCENE);
}

#[test]
fn a_device_that_is_not_there_names_what_to_install() {
    for (choice, package) in [(DeviceChoice::Gpu, "libvulkan1"), (DeviceChoice::SoftwareVulkan, "mesa-vulkan-drivers")] {
        match Device::open(choice, &Reporter::silent()) {
            Ok(device) => println!("{choice:?} is here: {}", device.name()),
            Err(error) => assert!(error.to_string().contains(package), "{error}"),
        }
    }
}

/// Planning was shown as 0.0 ms, whatever it took: the command had planned before the clock ran.
#[test]
fn planning_is_booked_among_the_stages() {
    let folder = tempfile::tempdir().expect("folder");
    assert_eq!(render(folder.path(), &[]).expect("renders"), 0);
    let text = std::fs::read_to_string(folder.path().join("drr.tif.json")).expect("beside it");
    let json: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    // Pilot rays and a fit of energies cannot be had for less.
    assert!(json["stages_ms"]["plan"].as_f64().expect("booked") > 0.05, "{}", json["stages_ms"]);
    assert!(json["stages_ms"]["prepare"].is_number(), "{}", json["stages_ms"]);
}

#[test]
fn outputs_replace_neither_one_another_nor_what_is_no_file() {
    let folder = tempfile::tempdir().expect("folder");
    let same = folder.path().join("drr.tif").display().to_string();
    let error = render(folder.path(), &["--dicom", &same]).expect_err("one name");
    assert!(matches!(error, RenderCommandError::Picture(ImageFileError::NamedTwice { .. })), "{error}");
    let pipe = folder.path().join("drr.png");
    let made = std::process::Command::new("mkfifo").arg(&pipe).status().expect("mkfifo");
    assert!(made.success());
    let error = render(folder.path(), &["--png", &pipe.display().to_string()]).expect_err("a pipe");
    assert!(matches!(error, RenderCommandError::Picture(ImageFileError::NoFile { .. })), "{error}");
    assert!(!folder.path().join("drr.tif").exists());
}

#[derive(Parser)]
struct TypedCompare {
    #[command(flatten)]
    args: CompareArgs,
}

/// A mask in which nothing is drawn was taken without a word.
#[test]
fn a_mask_that_excludes_no_pixel_is_said() {
    let folder = tempfile::tempdir().expect("folder");
    let path = |name: &str| folder.path().join(name).display().to_string();
    let line = |at: usize| 0.5 + ((at % 64) as f32 * 0.3).sin() * 0.2 + (at / 64) as f32 * 0.01;
    let image = Image { width: 64, height: 48, pixels: (0..64 * 48).map(line).collect() };
    write_tiff_f32(folder.path().join("drr.tif").as_path(), std::slice::from_ref(&image)).expect("writes");
    write_tiff_f32(folder.path().join("frame.tif").as_path(), &[image.map(|line| 1000.0 * (-line).exp())]).expect("writes");
    for (drawn, said) in [(0.0f32, true), (1.0, false)] {
        let mut mask = image.map(|_| 0.0);
        *mask.at_mut(3, 2) = drawn;
        write_tiff_f32(folder.path().join("mask.tif").as_path(), &[mask]).expect("writes");
        let (frame, drr, mask, out) = (path("frame.tif"), path("drr.tif"), path("mask.tif"), path("out"));
        let typed = [
            "compare",
            &frame,
            &drr,
            "--quantity",
            "line_integral",
            "--domain",
            "linear",
            "--air",
            "1000",
            "--offset",
            "none",
            "--mask",
            &mask,
            "--out",
            &out,
        ];
        let reporter = Reporter::silent();
        assert_eq!(run_compare(&TypedCompare::parse_from(typed).args, &reporter).expect("compares"), 0);
        assert_eq!(reporter.warnings().contains_key("mask"), said, "{:?}", reporter.warnings());
        let text = std::fs::read_to_string(folder.path().join("out/compare.json")).expect("written");
        let flags = serde_json::from_str::<serde_json::Value>(&text).expect("JSON")["comparison"]["flags"].to_string();
        assert_eq!(flags.contains("the mask excludes no pixel"), said, "{flags}");
    }
}

/// A render that says that pixels are invalid is not compared without the mask that says which, and no frame with an air level that its
/// own pixels contradict.
#[test]
fn what_makes_numbers_wrong_is_not_compared() {
    let folder = tempfile::tempdir().expect("folder");
    let path = |name: &str| folder.path().join(name).display().to_string();
    let line = |at: usize| 0.5 + ((at % 64) as f32 * 0.3).sin() * 0.2 + (at / 64) as f32 * 0.01;
    let image = Image { width: 64, height: 48, pixels: (0..64 * 48).map(line).collect() };
    write_tiff_f32(folder.path().join("drr.tif").as_path(), std::slice::from_ref(&image)).expect("writes");
    write_tiff_f32(folder.path().join("frame.tif").as_path(), &[image.map(|line| 1000.0 * (-line).exp())]).expect("writes");
    let compared = |share: f64, air: &str| {
        let described = serde_json::json!({"quantity": "line_integral", "share_invalid": share});
        std::fs::write(folder.path().join("drr.tif.json"), described.to_string()).expect("writes");
        let (frame, drr, out) = (path("frame.tif"), path("drr.tif"), path("out"));
        let typed = ["compare", &frame, &drr, "--domain", "linear", "--air", air, "--offset", "none", "--out", &out];
        run_compare(&TypedCompare::parse_from(typed).args, &Reporter::silent())
    };
    let error = compared(0.825, "1000").expect_err("its mask is missing");
    assert!(error.to_string().contains("drr.tif.valid.png") && error.to_string().contains("82.5 %"), "{error}");
    assert_eq!(compared(0.0, "1000").expect("all are valid"), 0);
    // An air level far below every pixel gave numbers in nepers.
    let values = |at: usize| 1000.0 * (-line(at)).exp();
    let [low, high] = (0..64 * 48).map(values).fold([f32::MAX, 0.0], |[low, high], value| [low.min(value), high.max(value)]);
    for air in ["1e-30", "7.0", "1e30", "0.0", "-1.0"] {
        let error = compared(0.0, air).expect_err("no air").to_string();
        assert!(error.starts_with(&format!("air level {air} is not the signal with nothing in the beam")), "{error}");
        let numbers: Vec<f32> = error.split([' ', ';']).filter_map(|word| word.parse().ok()).collect();
        let [_, from, to] = numbers[..] else { panic!("{error}") };
        assert!(low <= from && from < to && to <= high, "{error}: {low} to {high}");
    }
    for air in ["500", "100000"] {
        assert_eq!(compared(0.0, air).expect("another exposure, or a thick patient"), 0);
    }
}

/// What was warned of while the scene was loaded was lost to who reads the JSON.
#[test]
fn what_is_said_of_the_scene_stands_beside_the_image() {
    let folder = tempfile::tempdir().expect("folder");
    let (scene, out) = (folder.path().join("air.json"), folder.path().join("drr.tif"));
    let mut cases = 0;
    for (material, said) in [("steel_316l", false), ("air", true)] {
        std::fs::write(&scene, SCENE.replace("steel_316l", material)).expect("writes");
        let [scene, out] = [&scene, &out].map(|path| path.display().to_string());
        let typed = Typed::parse_from(["render", &scene, "--out", &out, "--device", "cpu"]);
        assert_eq!(run(&typed.args, &Reporter::silent()).expect("renders"), 0);
        let text = std::fs::read_to_string(folder.path().join("drr.tif.json")).expect("beside it");
        let json: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        assert_eq!(json["notes"].to_string().contains("displaces nothing"), said, "{}", json["notes"]);
        cases += 1;
    }
    assert_eq!(cases, 2);
}
