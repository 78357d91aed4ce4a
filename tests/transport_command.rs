//! `sidecarm scatter`: files, refusals, and what an interrupted run leaves.

use std::path::Path;
use std::process::{Command, Stdio};

use clap::Parser;
use sidecarm::cli::scatter::{ScatterArgs, ScatterError, run};
use sidecarm::gpu::{Device, DeviceChoice};
use sidecarm::image::{Image, ImageFileError, read_tiff_f32, sha256_file};
use sidecarm::reporter::Reporter;
use sidecarm::scene;
use sidecarm::transport::{BATCH, Checkpoint, Estimator, GpuTransport, Histories, Simulation, TransportError};

use crate::live_lab::{HANG_S, eventually};
use crate::log_lab::{sidecarm, text};

#[derive(Parser)]
struct Typed {
    #[command(flatten)]
    args: ScatterArgs,
}

pub const SCENE: &str = r#"{
    "objects": [{"box": {"centre_lps_mm": [0, 0, 0], "size_mm": [200, 200, 200], "material": "water"}},
                {"cylinder": {"from_lps_mm": [-20, 0, 0], "to_lps_mm": [20, 5, 0], "radius_mm": 2, "material": "titanium"}}],
    "view": {"size_px": [64, 48], "intrinsics": [[250, 0, 31.5], [0, 250, 23.5], [0, 0, 1]],
             "camera_from_lps": [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 600], [0, 0, 0, 1]]},
    "beam": {"tube_kvp": 80, "anode_angle_deg": 12, "filtration_mm": {"aluminium": 3}, "photons_per_pixel": 1e5},
    "detector": {"response": "energy", "pitch_mm": 4.0},
    "model": {"formation": "deepdrr", "noise": false, "seed": 7}
}"#;

fn typed(folder: &Path, more: &[&str]) -> Result<ScatterArgs, clap::Error> {
    let path = folder.join("scene.json");
    if !path.is_file() {
        std::fs::write(&path, SCENE).expect("writes");
    }
    let (scene, out) = (path.display().to_string(), folder.join("scatter.tif").display().to_string());
    // Of a processor the bits are known.
    let device: &[&str] = if more.contains(&"--device") { &[] } else { &["--device", "cpu"] };
    let words = ["scatter", &scene, "--out", &out].into_iter().chain(device.iter().chain(more).copied());
    Typed::try_parse_from(words).map(|typed| typed.args)
}

fn transport(folder: &Path, more: &[&str]) -> Result<u8, ScatterError> {
    run(&typed(folder, more).expect("parses"), &Reporter::silent())
}

#[test]
fn it_writes_pages_their_errors_and_what_they_are() {
    let folder = tempfile::tempdir().expect("folder");
    assert_eq!(transport(folder.path(), &["--histories", "3e4", "--grid-px", "8x6"]).expect("transports"), 0);
    let pages = read_tiff_f32(&folder.path().join("scatter.tif")).expect("a TIFF");
    assert_eq!((pages.len(), pages[0].width, pages[0].height), (8, 8, 6));
    let (pages_of, errors_of) = pages.split_at(4);
    assert!(pages_of.iter().all(|page| page.pixels.iter().all(|value| value.is_finite() && *value >= 0.0)));
    // Rayleigh scattering is rare: of some cells too little came to tell its error.
    assert!(errors_of.iter().all(|page| page.pixels.iter().all(|value| value.is_nan() || value.is_finite() && *value >= 0.0)));
    assert!([0, 1, 3].iter().all(|page| errors_of[*page].pixels.iter().all(|value| value.is_finite())));
    assert!(pages[0].pixels[20] > 0.0 && pages[4].pixels[20] > 0.0 && pages[3].pixels[20] > 0.0);
    let text = std::fs::read_to_string(folder.path().join("scatter.tif.json")).expect("beside it");
    let json: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    assert_eq!(json["quantity"], "scatter");
    assert_eq!((json["histories"].as_u64(), json["seed"].as_u64()), (Some(32_768), Some(7)));
    assert_eq!(json["pages"].as_array().map(Vec::len), Some(8));
    assert!(json["energy_kev_per_history"]["absorbed"]["water"]["mean"].as_f64().expect("a number") > 10.0);
    assert!(json["stated_error"].as_f64().expect("a number") > 0.0);
    assert!(!folder.path().join("scatter.tif.checkpoint").exists(), "nothing is left to go on from");
}

#[test]
fn the_same_command_goes_on_from_a_checkpoint_as_if_it_had_never_stopped() {
    let folder = tempfile::tempdir().expect("folder");
    // The finer the raster, the fewer histories at once: a step and a half.
    let more = ["--histories", "400000", "--grid-px", "64x48"];
    transport(folder.path(), &more).expect("transports");
    let (out, json) = (folder.path().join("scatter.tif"), folder.path().join("scatter.tif.json"));
    let straight = std::fs::read(&out).expect("reads");
    // What a run leaves that was killed after its first step.
    let path = folder.path().join("scene.json");
    let scene = scene::load(&path, true, &Reporter::silent()).expect("loads");
    let histories = Histories { count: 400_000, seed: 7, grid_px: [64, 48], estimator: Estimator::Expected, rel_error: None };
    let simulation = Simulation::new(&scene, &scene.view.expect("a view"), histories).expect("prepares");
    let mut tally = simulation.tally();
    simulation.advance(&mut tally, simulation.batches_at_once());
    let inputs: Vec<String> = std::iter::once(sha256_file(&path).expect("hashes"))
        .chain(scene.inputs.iter().map(|input| input.sha256.clone()))
        .collect();
    let checkpoint = folder.path().join("scatter.tif.checkpoint");
    Checkpoint::new(&histories, "cpu", &inputs, &tally).write(&checkpoint).expect("writes");
    std::fs::remove_file(&out).expect("removed");
    transport(folder.path(), &more).expect("goes on");
    assert!(std::fs::read(&out).expect("reads") == straight, "bit for bit");
    assert!(json.is_file() && !checkpoint.exists());
    // The control: a checkpoint with other sums gives another image, so it is read.
    let again = Simulation::new(&scene, &scene.view.expect("a view"), Histories { seed: 8, ..histories }).expect("prepares");
    let mut other = again.tally();
    again.advance(&mut other, again.batches_at_once());
    Checkpoint::new(&histories, "cpu", &inputs, &other).write(&checkpoint).expect("writes");
    transport(folder.path(), &more).expect("goes on");
    assert!(std::fs::read(&out).expect("reads") != straight, "control");
}

/// Behind and around 30 mm of titanium at 25 keV hardly anything scatters onto the panel: cells read 1e-17 ± 1e-17, and some of 2e-7 hold one
/// spike. Such errors are not told, nor is that of the median cell, and no such run is precise.
#[test]
fn what_hardly_anything_came_of_claims_no_error() {
    let folder = tempfile::tempdir().expect("folder");
    let ball = r#"{"sphere": {"centre_lps_mm": [0, 0, 600], "radius_mm": 15, "material": "titanium"}}"#;
    let scene = format!(
        r#"{{"objects": [{ball}],
            "view": {{"size_px": [160, 120], "intrinsics": [[1000, 0, 79.5], [0, 1000, 59.5], [0, 0, 1]],
                      "camera_from_lps": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}},
            "beam": {{"mono_kev": 25, "photons_per_pixel": 1e5}},
            "detector": {{"response": "energy", "pitch_mm": 1.0}},
            "model": {{"formation": "deepdrr", "noise": false, "seed": 7}}}}"#
    );
    let path = folder.path().join("scene.json");
    std::fs::write(&path, scene).expect("writes");
    // A median error of 1 would do after the first step, 256 batches, were it known.
    let more = ["--histories", "1.2e6", "--grid-px", "16x12", "--rel-error", "1.5"];
    transport(folder.path(), &more).expect("transports");
    let pages = read_tiff_f32(&folder.path().join("scatter.tif")).expect("a TIFF");
    let text = std::fs::read_to_string(folder.path().join("scatter.tif.json")).expect("beside it");
    let json: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    assert!(json["histories"].as_u64() == Some(293 * BATCH) && json["stated_error"].is_null(), "{text}");
    let told = |page: usize| pages[4 + page].pixels.iter().filter(|error| **error >= 0.0).count();
    // Once Compton, once Rayleigh, more often: a few cells at most may be told by chance.
    assert!((1..4).all(|page| told(page) < 10), "{:?}", [1, 2, 3].map(told));
    assert!(pages[1..4].iter().any(|page| page.pixels.iter().any(|value| *value > 0.0)), "nothing scattered");
    // In the open and at the limb the primary is known, in the shadow's core it is not.
    assert!(told(0) > 150 && told(0) < 192, "{}", told(0));
    assert!(pages[4].pixels[6 * 16 + 8].is_nan() && pages[4].pixels[0] > 0.0);
    // The control: by the spread of batches as it is, cells are known to less than 1e-12.
    let scene = scene::load(&path, true, &Reporter::silent()).expect("loads");
    let histories = Histories { count: 100_000, seed: 7, grid_px: [16, 12], ..Histories::default() };
    let simulation = Simulation::new(&scene, &scene.view.expect("a view"), histories).expect("prepares");
    let mut tally = simulation.tally();
    simulation.advance(&mut tally, simulation.batches());
    let image = simulation.image(&tally);
    assert!(image.errors[2].pixels.iter().filter(|error| **error < 1e-12).count() > 150);
}

/// A run keeps what it has while it goes on: one that is killed loses what came since, and no more.
#[test]
fn a_run_that_is_killed_is_gone_on_with_from_what_it_kept() {
    let folder = tempfile::tempdir().expect("folder");
    let [path, out, checkpoint] = ["scene.json", "scatter.tif", "scatter.tif.checkpoint"].map(|name| folder.path().join(name));
    std::fs::write(&path, SCENE).expect("writes");
    let base = ["scatter", text(&path), "--out", text(&out), "--grid-px", "64x48", "--device", "cpu", "--checkpoint-s", "0"];
    // More than any machine follows meanwhile.
    let mut running = Command::new(env!("CARGO_BIN_EXE_sidecarm"))
        .args(base)
        .args(["--histories", "1e12"])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .expect("the program starts");
    let kept = eventually(HANG_S, || checkpoint.is_file().then_some(()));
    running.kill().expect("runs still");
    running.wait().expect("ends");
    assert!(kept.is_some() && !out.exists(), "nothing was kept");
    let saved: serde_json::Value = serde_json::from_slice(&std::fs::read(&checkpoint).expect("reads")).expect("whole");
    let followed = BATCH * saved["tally"]["batches"].as_u64().expect("a count");
    assert!(followed >= 200_000, "{followed}");
    // No more than are there: nothing is left to follow.
    let ran = sidecarm(&[&base[..], &["--histories", "2e5", "--json"]].concat());
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    assert!(ran.stderr.contains(&format!("going on after {followed} histories")), "{}", ran.stderr);
    assert_eq!(ran.json()["histories"].as_u64(), Some(followed));
    assert!(!checkpoint.exists());
}

#[test]
fn a_checkpoint_of_something_else_is_refused_and_fresh_starts_anew() {
    let folder = tempfile::tempdir().expect("folder");
    let checkpoint = folder.path().join("scatter.tif.checkpoint");
    std::fs::write(&checkpoint, "{}").expect("writes");
    let more = ["--histories", "8192", "--grid-px", "4x3"];
    let error = transport(folder.path(), &more).expect_err("no checkpoint").to_string();
    assert!(error.contains("--fresh") && error.contains("checkpoint"), "{error}");
    let path = folder.path().join("scene.json");
    let scene = scene::load(&path, true, &Reporter::silent()).expect("loads");
    let histories = Histories { count: 8192, seed: 8, grid_px: [4, 3], ..Histories::default() };
    let simulation = Simulation::new(&scene, &scene.view.expect("a view"), histories).expect("prepares");
    Checkpoint::new(&histories, "cpu", &[], &simulation.tally()).write(&checkpoint).expect("writes");
    let error = transport(folder.path(), &more).expect_err("another seed");
    assert!(matches!(&error, ScatterError::Transport(TransportError::Checkpoint { what: "the seed", .. })), "{error}");
    let fresh = ["--histories", "8192", "--grid-px", "4x3", "--fresh"];
    assert_eq!(transport(folder.path(), &fresh).expect("starts anew"), 0);
    assert!(!checkpoint.exists());
}

/// On a GPU: another image within the errors, in two dispatches of 32 batches; what a processor has left is none of it.
#[test]
fn a_gpu_follows_photons_too_and_goes_on_only_from_its_own() {
    let folder = tempfile::tempdir().expect("folder");
    let more = |device| ["--histories", "2e5", "--grid-px", "4x3", "--device", device];
    if let Err(error) = transport(folder.path(), &more("software-vulkan")) {
        println!("skipped: {error}");
        return;
    }
    let read = || {
        let pages = read_tiff_f32(&folder.path().join("scatter.tif")).expect("a TIFF");
        let json = std::fs::read(folder.path().join("scatter.tif.json")).expect("beside it");
        let json: serde_json::Value = serde_json::from_slice(&json).expect("JSON");
        (pages, json)
    };
    let (gpu, json) = read();
    assert_eq!((json["histories"].as_u64(), json["plan"]["histories_per_batch"].as_u64()), (Some(262_144), Some(4096)));
    assert!(json["adapter"].as_str().is_some_and(|adapter| adapter.contains("Vulkan")), "{json}");
    transport(folder.path(), &more("cpu")).expect("transports");
    let (cpu, json) = read();
    assert!(json["adapter"].as_str().is_some_and(|adapter| adapter.starts_with("CPU")), "{json}");
    for page in 0..4 {
        let is_told = |pages: &[Image<f32>]| pages[4 + page].pixels.iter().all(|error| *error > 0.0);
        assert!(is_told(&gpu) && is_told(&cpu), "page {page}");
        let cells = gpu[page].pixels.iter().zip(&cpu[page].pixels).zip(gpu[4 + page].pixels.iter().zip(&cpu[4 + page].pixels));
        let worst = cells.map(|((a, b), (e, f))| (a - b).abs() / (e.hypot(*f) + 1e-4 * a)).fold(0.0, f32::max);
        assert!(worst < 5.0, "page {page}: {worst}");
    }
    assert!(gpu[3].pixels != cpu[3].pixels, "random numbers of its own");
    let path = folder.path().join("scene.json");
    let scene = scene::load(&path, true, &Reporter::silent()).expect("loads");
    let histories = Histories { count: 200_000, seed: 7, grid_px: [4, 3], ..Histories::default() };
    let simulation = Simulation::new(&scene, &scene.view.expect("a view"), histories).expect("prepares");
    let checkpoint = folder.path().join("scatter.tif.checkpoint");
    Checkpoint::new(&histories, "cpu", &[], &simulation.tally()).write(&checkpoint).expect("writes");
    let error = transport(folder.path(), &more("software-vulkan")).expect_err("a processor's");
    assert!(matches!(&error, ScatterError::Transport(TransportError::Checkpoint { what: "the device", .. })), "{error}");
}

/// On a GPU as on a processor: what the first round of batches left is gone on from to the same bits, and a precision that is there ends a run.
#[test]
fn a_gpu_goes_on_from_its_checkpoint_and_ends_at_a_precision() {
    let folder = tempfile::tempdir().expect("folder");
    // Two rounds.
    let more = ["--histories", "2e5", "--grid-px", "4x3", "--device", "software-vulkan"];
    if let Err(error) = transport(folder.path(), &more) {
        println!("skipped: {error}");
        return;
    }
    let [path, out, checkpoint] = ["scene.json", "scatter.tif", "scatter.tif.checkpoint"].map(|name| folder.path().join(name));
    let straight = std::fs::read(&out).expect("reads");
    let Ok(Device::Gpu(gpu)) = Device::open(DeviceChoice::SoftwareVulkan, &Reporter::silent()) else { panic!("it was there") };
    let scene = scene::load(&path, true, &Reporter::silent()).expect("loads");
    let inputs: Vec<String> = std::iter::once(sha256_file(&path).expect("hashes"))
        .chain(scene.inputs.iter().map(|input| input.sha256.clone()))
        .collect();
    let histories = Histories { count: 200_000, seed: 7, grid_px: [4, 3], ..Histories::default() };
    // Leaves what a run of this seed does that is killed after its first round, and says how well that knows the scatter.
    let leave = |seed: u64| {
        let simulation =
            Simulation::new(&scene, &scene.view.expect("a view"), Histories { seed, ..histories }).expect("prepares");
        let mut followed = GpuTransport::new(&gpu, &simulation).expect("the shader takes it");
        let mut tally = followed.tally();
        followed.advance(&mut tally).expect("runs");
        assert!(tally.histories() < followed.histories(), "half of it");
        Checkpoint::new(&histories, followed.adapter(), &inputs, &tally).write(&checkpoint).expect("writes");
        (tally.histories(), simulation.relative_error(&tally))
    };
    let (round, error) = leave(7);
    std::fs::remove_file(&out).expect("removed");
    transport(folder.path(), &more).expect("goes on");
    assert!(std::fs::read(&out).expect("reads") == straight && !checkpoint.exists(), "bit for bit");
    leave(8);
    transport(folder.path(), &more).expect("goes on");
    assert!(std::fs::read(&out).expect("reads") != straight, "the control: other sums are read");

    let ends_after = |wanted: f64| {
        let wanted = wanted.to_string();
        let more =
            ["--histories", "1e9", "--grid-px", "4x3", "--device", "software-vulkan", "--rel-error", wanted.as_str(), "--fresh"];
        transport(folder.path(), &more).expect("transports");
        let text = std::fs::read_to_string(folder.path().join("scatter.tif.json")).expect("beside it");
        let json: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        (json["histories"].as_u64().expect("a count"), json["stated_error"].as_f64().expect("a number"))
    };
    let (histories, reached) = ends_after(1.1 * error);
    assert!(histories == round && (reached / error - 1.0).abs() < 1e-9, "{histories}: {reached}, {error} after a round");
    // Errors fall with the root of the histories.
    let (histories, reached) = ends_after(0.8 * error);
    assert!(histories > round && histories <= 4 * round && reached <= 0.8 * error, "{histories}: {reached} of {error}");
}

#[test]
fn it_refuses_what_makes_no_sense() {
    let folder = tempfile::tempdir().expect("folder");
    let mut cases = 0;
    for more in
        [["--histories", "0"], ["--histories", "1e99"], ["--histories", "nan"], ["--histories", "1.5"], ["--histories", "many"]]
    {
        assert!(typed(folder.path(), &more).is_err(), "{more:?}");
        cases += 1;
    }
    assert!(typed(folder.path(), &[]).is_err() && typed(folder.path(), &["--histories", "10", "--grid-px", "64"]).is_err());
    assert!(typed(folder.path(), &["--histories", "10", "--checkpoint-s", "nan"]).is_err());
    assert!(typed(folder.path(), &["--histories", "10", "--checkpoint-s", "0"]).is_ok(), "the control");
    for (more, says) in [
        (["--histories", "10", "--rel-error", "nan"], "positive"),
        (["--histories", "10", "--rel-error", "0"], "positive"),
        (["--histories", "10", "--grid-px", "0x4"], "1 to 1024"),
        (["--histories", "10", "--grid-px", "4x99999"], "1 to 1024"),
    ] {
        let error = transport(folder.path(), &more).expect_err("refused").to_string();
        assert!(error.contains(says), "{more:?}: {error}");
        cases += 1;
    }
    assert_eq!(cases, 9);
    std::fs::write(folder.path().join("scene.json"), SCENE.replace(r#", "pitch_mm": 4.0"#, "")).expect("writes");
    let error = transport(folder.path(), &["--histories", "10"]).expect_err("no detector geometry").to_string();
    assert!(error.contains("pitch_mm"), "{error}");
}

#[test]
fn it_does_not_write_over_its_inputs() {
    let folder = tempfile::tempdir().expect("folder");
    let args = typed(folder.path(), &["--histories", "10"]).expect("parses");
    let scene = folder.path().join("scene.json");
    for out in ["scene.json", "linked.tif"] {
        // IMAGE.tif.json is an output too.
        if out == "linked.tif" {
            std::fs::hard_link(&scene, folder.path().join("linked.tif.json")).expect("links");
        }
        let error = run(&ScatterArgs { out: folder.path().join(out), ..args.clone() }, &Reporter::silent()).expect_err(out);
        assert!(matches!(error, ScatterError::File(ImageFileError::WouldOverwrite { .. })), "{error}");
    }
    assert_eq!(std::fs::read_to_string(&scene).expect("reads"), SCENE);
}
