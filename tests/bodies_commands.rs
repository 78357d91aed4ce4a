//! From the pose file that `register` writes to a DRR and a comparison in which a body has moved.

use std::path::{Path, PathBuf};

use clap::Parser;
use glam::DVec3;
use sidecarm::cli::compare::{CompareArgs, run as run_compare};
use sidecarm::cli::render::{PosedError, RenderArgs, RenderCommandError, run as run_render};
use sidecarm::geometry::{Rigid, View};
use sidecarm::image::{read_tiff_f32, write_tiff_f32};
use sidecarm::pose::{Pose, register_shadows};
use sidecarm::reporter::Reporter;

use crate::bodies_moved::{lps_from_bone, scene_text, write_ct};
use crate::pose_bodies::{motion, seen, two};
use crate::pose_registration::matching;
use crate::pose_synthetic as synthetic;

#[derive(Parser)]
struct TypedRender {
    #[command(flatten)]
    args: RenderArgs,
}

#[derive(Parser)]
struct TypedCompare {
    #[command(flatten)]
    args: CompareArgs,
}

/// A pose in which the femur has moved by 3° and 4 mm, and the truth: view, lps_from_femur.
fn registered() -> (Pose, View, Rigid) {
    let found = (0..12).find_map(|seed| {
        let (view, layout) = (synthetic::view(256, 256, seed), two(9, 7, seed));
        let truth = motion(&layout, 3.0, 4.0, seed);
        let found = seen(&view, &layout, &truth, seed);
        let pose = (found.len() >= 15).then(|| register_shadows(&matching(&view, &layout), &found))?;
        pose.is_accepted().then_some((pose, view, truth))
    });
    found.expect("some seed shows enough beads")
}

fn render(folder: &Path, scene: &str, pose: &Pose, out: &str) -> Result<u8, RenderCommandError> {
    let path = |name: &str| folder.join(name).display().to_string();
    std::fs::write(folder.join("scene.json"), scene).expect("writes");
    pose.write(&folder.join("pose.json")).expect("writes");
    let (scene, pose, out) = (path("scene.json"), path("pose.json"), path(out));
    let typed = ["render", &scene, "--out", &out, "--pose", &pose, "--device", "cpu", "--quantity", "line_integral"];
    run_render(&TypedRender::parse_from(typed).args, &Reporter::silent())
}

fn page(path: PathBuf) -> Vec<f32> {
    read_tiff_f32(&path).expect("a TIFF").remove(0).pixels
}

fn json(path: PathBuf) -> serde_json::Value {
    serde_json::from_slice(&std::fs::read(path).expect("written")).expect("JSON")
}

/// The rest of the pixels where the difference is: mean of |a − b| over all.
fn apart(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| f64::from((a - b).abs())).sum::<f64>() / a.len() as f64
}

#[test]
fn a_registered_pose_moves_the_bone_in_render_and_masks_the_guess_in_compare() {
    let folder = tempfile::tempdir().expect("folder");
    let folder = folder.path();
    write_ct(folder, "ct", Some(lps_from_bone()));
    // Without a view of its own, as a session's scene.
    let scene = {
        let text = scene_text("ct", "", "");
        let (from, to) = (text.find("\"view\"").expect("there"), text.find("\"beam\"").expect("there"));
        format!("{}{}", &text[..from], &text[to..])
    };
    let scene = scene.replace(r#""pitch_mm": 1.0"#, r#""pitch_mm": 1.171875"#);
    let (pose, view, truth) = registered();
    // The camera's own error moves everything: what is looked at is the femur's place before the camera that was found.
    let lps_from_femur = pose.camera_from_lps.expect("accepted").inverse() * view.camera_from_lps * truth;
    let mut true_pose = pose.clone();
    true_pose.bodies.iter_mut().filter(|body| body.name == "femur").for_each(|body| body.lps_from_body = lps_from_femur);
    let mut as_scanned = true_pose.clone();
    as_scanned.bodies.iter_mut().for_each(|body| body.lps_from_body = Rigid::IDENTITY);
    for (pose, out) in [(&as_scanned, "scanned.tif"), (&true_pose, "frame.tif"), (&pose, "drr.tif")] {
        assert_eq!(render(folder, &scene, pose, out).expect("renders"), 0);
    }
    let [scanned, frame, drr] = ["scanned.tif", "frame.tif", "drr.tif"].map(|name| page(folder.join(name)));
    let (right, wrong) = (apart(&drr, &frame), apart(&scanned, &frame));
    assert!(right < 0.2 * wrong, "{right} nepers from the truth, as scanned {wrong}");

    let described = json(folder.join("drr.tif.json"));
    let share = described["share_guessed"].as_f64().expect("a share");
    assert!(share > 0.0 && share < 0.5 && folder.join("drr.tif.guessed.png").is_file(), "{share}");
    assert!(described["notes"].to_string().contains("a guess") && described["inputs"].to_string().contains("pose.json"));
    let choices = described["plan"]["choices"].to_string();
    assert!(choices.contains("femur moved by 3.") && choices.contains("pelvis unmoved"), "{choices}");
    assert!(!folder.join("scanned.tif.guessed.png").exists() && json(folder.join("scanned.tif.json"))["share_guessed"].is_null());

    // The frame as a detector has it, whose causes are counted with the scene, and with the picture that lies beside the DRR.
    let image = read_tiff_f32(&folder.join("frame.tif")).expect("a TIFF").remove(0);
    write_tiff_f32(&folder.join("acquired.tif"), &[image.map(|line| 1000.0 * (-line).exp())]).expect("writes");
    let path = |name: &str| folder.join(name).display().to_string();
    let (acquired, simulated, scene_path, pose_path) =
        (path("acquired.tif"), path("drr.tif"), path("scene.json"), path("pose.json"));
    let (out, other) = (path("compared"), path("compared-alone"));
    let plain = ["compare", &acquired, &simulated, "--domain", "linear", "--air", "1000", "--offset", "none", "--out"];
    let mut shares = Vec::new();
    for more in [vec![out.as_str(), "--pose", &pose_path, "--scene", &scene_path], vec![other.as_str()]] {
        let typed = TypedCompare::parse_from(plain.iter().copied().chain(more.iter().copied()));
        let reporter = Reporter::silent();
        assert_eq!(run_compare(&typed.args, &reporter).expect("compares"), 0);
        assert!(!reporter.warnings().contains_key("not what was rendered"), "{:?}", reporter.warnings());
        let compared = json(Path::new(more[0]).join("compare.json"));
        shares.push(compared["comparison"]["masks"]["causes"]["filled"].as_f64().expect("a share"));
        let zncc = compared["comparison"]["scores"]["zncc"].as_f64().expect("a score");
        assert!(zncc > 0.999, "{zncc}");
    }
    assert!(shares.iter().all(|found| (found - share).abs() < 1e-9), "{shares:?} {share}");

    // Another pose than the DRR's, by what `render` wrote of its view.
    let away = Rigid::translation(DVec3::new(4.0, 0.0, 0.0)) * pose.camera_from_lps.expect("accepted");
    Pose { camera_from_lps: Some(away), projection: None, ..pose.clone() }.write(&folder.join("away.json")).expect("writes");
    let (away, elsewhere) = (path("away.json"), path("elsewhere"));
    let typed = TypedCompare::parse_from(plain.iter().copied().chain([elsewhere.as_str(), "--pose", &away]));
    let error = run_compare(&typed.args, &Reporter::silent()).expect_err("another pose");
    assert!(error.to_string().contains("rendered from another pose") && !Path::new(&elsewhere).exists(), "{error}");

    // The same name again, of an image in which nothing has moved: the mask of the earlier one goes.
    assert_eq!(render(folder, &scene, &as_scanned, "drr.tif").expect("renders"), 0);
    assert!(!folder.join("drr.tif.guessed.png").exists());
}

#[test]
fn a_pose_with_a_body_that_the_scene_does_not_know_is_refused() {
    let folder = tempfile::tempdir().expect("folder");
    write_ct(folder.path(), "ct", Some(lps_from_bone()));
    let (pose, ..) = registered();
    let scene = scene_text("ct", "", "").replace(r#""femur": ["#, r#""tibia": ["#);
    let error = render(folder.path(), &scene, &pose, "drr.tif").expect_err("unknown");
    assert!(matches!(error, RenderCommandError::Posed(PosedError::Scene(_))) && error.to_string().contains("'femur'"), "{error}");
    assert!(!folder.path().join("drr.tif").exists());
    let refused = Pose { reason: Some("beads: none".to_owned()), status: sidecarm::pose::Status::Refused, ..pose };
    let error = render(folder.path(), &scene, &refused, "drr.tif").expect_err("refused");
    assert!(
        matches!(error, RenderCommandError::Posed(PosedError::NoView { .. })) && error.to_string().contains("beads: none"),
        "{error}"
    );
    assert_eq!(refused.place_of("femur", DVec3::X), DVec3::X, "a refused pose places nothing");
}
