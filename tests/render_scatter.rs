//! Scatter in a render: what was followed is added, beside the field too, and brings its own quanta.

use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::Arc;

use clap::Parser;
use glam::{DVec2, DVec3};
use sidecarm::cli::{render, scatter};
use sidecarm::gpu::DeviceChoice;
use sidecarm::image::{Image, read_tiff_f32, sha256_file};
use sidecarm::render::{Options, Quantity, Renderer, Scatter};
use sidecarm::reporter::Reporter;
use sidecarm::scene;
use sidecarm::scene::model::{Noise, Response, ScatterModel, Scene};
use sidecarm::scene::optics::{Field, Heel, Towards};
use sidecarm::transport::{BATCH, Checkpoint, Histories, Simulation, Tally};

use crate::live_lab::{HANG_S, eventually};
use crate::log_lab::{sidecarm, text};
use crate::render_scenes::{With, cuboid, empty, solids, spectrum};

#[derive(Parser)]
pub struct Render {
    #[command(flatten)]
    pub args: render::RenderArgs,
}

#[derive(Parser)]
pub struct Follow {
    #[command(flatten)]
    pub args: scatter::ScatterArgs,
}

const SCENE: &str = r#"{
    "objects": [{"box": {"centre_lps_mm": [0, 0, 0], "size_mm": [300, 200, 300], "material": "water"}}],
    "view": {"size_px": [160, 120], "intrinsics": [[625, 0, 79.5], [0, 625, 59.5], [0, 0, 1]],
             "camera_from_lps": [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 700], [0, 0, 0, 1]]},
    "beam": {"mono_kev": 60, "photons_per_pixel": 1e5},
    "detector": {"response": "energy", "pitch_mm": 1.6},
    "model": {"scatter": "monte_carlo", "seed": 7}
}"#;

fn rendered(folder: &Path, scene: &str, more: &[&str]) -> (Image<f32>, serde_json::Value) {
    let path = folder.join("scene.json");
    std::fs::write(&path, scene).expect("writes");
    let (scene, out) = (path.display().to_string(), folder.join("drr.tif"));
    let words = ["render", &scene, "--device", "cpu", "--out", out.to_str().expect("UTF-8")];
    let typed = Render::try_parse_from(words.iter().chain(more)).expect("parses");
    assert_eq!(render::run(&typed.args, &Reporter::silent()).expect("renders"), 0);
    let json = std::fs::read_to_string(folder.join("drr.tif.json")).expect("beside it");
    (read_tiff_f32(&out).expect("a TIFF").remove(0), serde_json::from_str(&json).expect("JSON"))
}

/// Against the page that `sidecarm scatter` writes, followed from another seed on another raster; and the statement holds.
#[test]
fn a_render_has_the_scatter_that_is_followed_by_itself() {
    let folder = tempfile::tempdir().expect("folder");
    let (with, json) = rendered(folder.path(), SCENE, &["--scatter-error", "0.02"]);
    let (without, off) = rendered(folder.path(), &SCENE.replace("monte_carlo", "off"), &[]);
    let (scene, out) = (folder.path().join("scene.json"), folder.path().join("s.tif"));
    let words = ["scatter", scene.to_str().expect("UTF-8"), "--out", out.to_str().expect("UTF-8"), "--histories", "2e6"];
    let typed = Follow::try_parse_from(words.iter().chain(&["--grid-px", "8x6", "--seed", "99"])).expect("parses");
    assert_eq!(scatter::run(&typed.args, &Reporter::silent()).expect("follows"), 0);
    let pages = read_tiff_f32(&out).expect("a TIFF");
    let mut ratios = Vec::new();
    for row in 0..6 {
        for column in 0..8 {
            let cell = row * 8 + column;
            let own: f32 = (1..4).map(|page| pages[page].pixels[cell]).sum();
            let mut sum = 0.0;
            for y in 0..20 {
                for x in 0..20 {
                    let pixel = (row * 20 + y) * 160 + column * 20 + x;
                    sum += with.pixels[pixel] - without.pixels[pixel];
                }
            }
            ratios.push(f64::from(sum / 400.0 / own));
        }
    }
    let mean = ratios.iter().sum::<f64>() / ratios.len() as f64;
    let spread = (ratios.iter().map(|ratio| (ratio - mean).powi(2)).sum::<f64>() / ratios.len() as f64).sqrt();
    assert!((mean - 1.0).abs() < 0.01 && spread < 0.03, "{mean} ± {spread}");
    let said = &json["scatter"];
    let (ratio, added) =
        (said["scatter_to_primary"].as_f64().expect("a number"), said["stated_error"].as_f64().expect("a number"));
    assert!(ratio > 0.5 && added > 0.0 && off.get("scatter").is_none(), "{said}");
    assert!(
        (json["stated_error"].as_f64().expect("a number") - off["stated_error"].as_f64().expect("a number") - added).abs() < 1e-9
    );
    let choice = json["plan"]["choices"].as_array().expect("choices").iter().find(|choice| choice["what"] == "scatter");
    assert_eq!(choice.map(|choice| choice["modelled"].as_bool()), Some(Some(true)));
}

/// Whoever stopped an image lost its photons, hours of them perhaps. They are kept meanwhile, and the same command goes on to the same bits.
#[test]
fn an_image_goes_on_with_the_photons_of_an_interrupted_run_as_if_it_had_never_stopped() {
    let folder = tempfile::tempdir().expect("folder");
    let [path, out, checkpoint] = ["scene.json", "drr.tif", "drr.tif.checkpoint"].map(|name| folder.path().join(name));
    std::fs::write(&path, SCENE).expect("writes");
    let scene = scene::load(&path, true, &Reporter::silent()).expect("loads");
    let histories = |seed: u64| Histories { count: 1 << 40, seed, grid_px: [16, 12], ..Histories::default() };
    // The first step of a run, and how well it knows the scatter.
    let step = |seed: u64| -> (Tally, f64) {
        let simulation = Simulation::new(&scene, &scene.view.expect("a view"), histories(seed)).expect("prepares");
        let mut tally = simulation.tally();
        simulation.advance(&mut tally, simulation.batches_at_once());
        let error = simulation.relative_error(&tally);
        (tally, error)
    };
    let (tally, error) = step(7);
    let wish = (0.8 * error).to_string();
    let more = ["--scatter-error", wish.as_str()];
    let followed = |json: &serde_json::Value| json["scatter"]["from"]["photons"]["histories"].as_u64().expect("a count");
    let (straight, json) = rendered(folder.path(), SCENE, &more);
    assert!(followed(&json) > tally.histories() && !checkpoint.exists(), "{json}");
    let inputs: Vec<String> = std::iter::once(sha256_file(&path).expect("hashes"))
        .chain(scene.inputs.iter().map(|input| input.sha256.clone()))
        .collect();
    let leave = |tally: &Tally| Checkpoint::new(&histories(7), "cpu", &inputs, tally).write(&checkpoint).expect("writes");
    leave(&tally);
    let (again, json_again) = rendered(folder.path(), SCENE, &more);
    assert!(again == straight && followed(&json_again) == followed(&json), "bit for bit");
    assert!(!checkpoint.exists(), "the image is written");
    // The control: other sums give another image, so they are read.
    leave(&step(8).0);
    assert!(rendered(folder.path(), SCENE, &more).0 != straight, "the control");
    // Photons of another scene are refused before any are followed.
    leave(&tally);
    std::fs::write(&path, SCENE.replace("[300, 200, 300]", "[300, 210, 300]")).expect("writes");
    let words = ["render", text(&path), "--device", "cpu", "--out", text(&out)];
    let refused = render::run(&Render::try_parse_from(words).expect("parses").args, &Reporter::silent()).expect_err("refused");
    assert!(refused.to_string().contains("SHA-256") && refused.to_string().contains("--fresh"), "{refused}");
    assert!(checkpoint.exists(), "they are somebody's hours");
}

#[test]
fn an_image_that_is_killed_keeps_its_photons() {
    let folder = tempfile::tempdir().expect("folder");
    let [path, out, checkpoint] = ["scene.json", "drr.tif", "drr.tif.checkpoint"].map(|name| folder.path().join(name));
    std::fs::write(&path, SCENE).expect("writes");
    let base = ["render", text(&path), "--out", text(&out), "--device", "cpu", "--checkpoint-s", "0"];
    let mut running = Command::new(env!("CARGO_BIN_EXE_sidecarm"))
        .args(base)
        // More photons than any machine follows meanwhile.
        .args(["--scatter-error", "1e-6"])
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
    // What is there is enough.
    let ran = sidecarm(&[&base[..], &["--scatter-error", "0.9", "--json"]].concat());
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    assert!(ran.stderr.contains(&format!("going on after {followed} histories")), "{}", ran.stderr);
    assert_eq!(ran.json()["scatter"]["from"]["photons"]["histories"].as_u64(), Some(followed));
    assert!(!checkpoint.exists());
}

/// The image that was asked for is not the one that was made.
#[test]
fn an_error_that_the_scatter_does_not_keep_is_refused() {
    let folder = tempfile::tempdir().expect("folder");
    std::fs::write(folder.path().join("scene.json"), SCENE).expect("writes");
    let [scene, out] = ["scene.json", "drr.tif"].map(|name| folder.path().join(name).display().to_string());
    let words = ["render", &scene, "--device", "cpu", "--out", &out, "--max-error", "1e-4", "--scatter-error", "0.1"];
    let refused = render::run(&Render::try_parse_from(words).expect("parses").args, &Reporter::silent()).expect_err("refused");
    assert!(refused.to_string().contains("--scatter-error"), "{refused}");
    let none = ["render", &scene, "--device", "cpu", "--out", &out, "--scatter-error", "0"];
    let refused = render::run(&Render::try_parse_from(none).expect("parses").args, &Reporter::silent()).expect_err("refused");
    assert!(refused.to_string().contains("--scatter-error 0"), "{refused}");
    assert!(!folder.path().join("drr.tif").exists());
}

#[test]
fn what_scatters_nothing_is_rendered_as_it_was() {
    let folder = tempfile::tempdir().expect("folder");
    let objects = SCENE.find("\"objects\"").expect("there").."\"objects\"".len() + SCENE.find("\"objects\"").expect("there");
    let end = SCENE.find("\"view\"").expect("there");
    let scene = format!("{}: [],\n{}", &SCENE[..objects.end], &SCENE[end..]);
    let (page, json) = rendered(folder.path(), &scene, &[]);
    assert!(page.pixels.iter().all(|value| *value == 1.0));
    assert_eq!(
        (json["scatter"]["scatter_to_primary"].as_f64(), json["scatter"]["stated_error"].as_f64()),
        (Some(0.0), Some(0.0))
    );
}

fn even(signal: f64) -> Arc<Scatter> {
    let image = |value: f64| Image { width: 4, height: 4, pixels: vec![value; 16] };
    Arc::new(Scatter {
        signal: image(signal),
        error: image(0.0),
        unattenuated: image(1.0),
        from: sidecarm::render::Origin::Photons { histories: 1, seed: 1, device: "cpu".to_owned() },
        relative_error: 0.0,
    })
}

fn water(mm: f64) -> Scene {
    let water = cuboid(DVec3::new(0.0, 0.0, 600.0), DVec3::new(200.0, 200.0, 0.5 * mm), 0, 1.0);
    let mut scene = empty(&["water"]).with(solids(&[water]));
    scene.model.scatter = ScatterModel::MonteCarlo;
    scene
}

fn page(scene: &Scene, options: Options) -> (Vec<f32>, Vec<u8>, Vec<String>) {
    let rendered =
        Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("a CPU").render(scene, &options).expect("renders");
    (rendered.pages[0].pixels.clone(), rendered.valid.pixels, rendered.notes)
}

/// In the middle of a cell the raster has the cell's own error: of that the statement counts 3.3 standard deviations, and in the corners, where
/// the raster goes on straight, at most 2.5 times as much.
#[test]
fn the_statement_counts_standard_errors() {
    let mut scene = empty(&["water"]);
    scene.model.scatter = ScatterModel::MonteCarlo;
    let mut scatter = even(0.01).as_ref().clone();
    scatter.error.pixels = vec![1e-4; 16];
    let options = Options { scatter: Some(Arc::new(scatter)), ..Options::default() };
    let rendered =
        Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("a CPU").render(&scene, &options).expect("renders");
    let of_cell = 3.3e-4 / 1.01;
    let stated = rendered.scatter.expect("added").stated_error;
    assert!((0.99 * of_cell..2.55 * of_cell).contains(&stated), "{stated:e} of {of_cell:e}");
}

#[test]
fn scatter_reaches_the_panel_beside_the_field() {
    let mut scene = water(200.0);
    let (open, ..) = page(&scene, Options { scatter: Some(even(0.0)), ..Options::default() });
    scene.beam.shape.field = Some(Field::Circle { diameter_mm: 60.0, centre_mm: DVec2::ZERO });
    let (seen, valid, _) = page(&scene, Options { scatter: Some(even(0.01)), ..Options::default() });
    let at = |column: usize, row: usize| row * 96 + column;
    for (n, outside) in [(at(48, 48), false), (at(5, 5), true), (at(90, 48), true)] {
        let expected = if outside { 0.01 } else { open[n] + 0.01 };
        // Obliquity: what is even on the panel is more of the little that arrives towards the corners.
        assert!((0.99..1.006).contains(&(seen[n] / expected)), "{} {expected}", seen[n]);
        assert_eq!(valid[n] == 0, outside);
    }
    // Where neither arrives, line integrals end where they always do.
    let line = Options { scatter: Some(even(0.0)), quantity: Quantity::LineIntegral, ..Options::default() };
    let (dark, ..) = page(&scene, line.clone());
    let (plain, ..) = page(&scene, Options { scatter: None, ..line });
    assert!((dark[at(5, 5)] - plain[at(5, 5)]).abs() < 1e-6 && plain[at(5, 5)].is_finite(), "{}", dark[at(5, 5)]);
    // Nobody followed photons: it is said.
    let (without, _, notes) = page(&scene, Options::default());
    assert!(without[at(5, 5)] == 0.0 && notes.iter().any(|note| note.contains("scatter is left out")), "{notes:?}");
}

/// Counting: var(intensity) = (T + S)/N₀ where S carries quanta of its own, T/N₀ where it did not.
#[test]
fn scattered_quanta_are_noisy_as_well() {
    let mut scene = water(200.0);
    (scene.detector.response, scene.model.noise) = (Response::Counting, Noise::True);
    scene.beam.photons_per_pixel = 1e4;
    let scattered = 0.05;
    let options = || Options { scatter: Some(even(scattered)), quantity: Quantity::Intensity, ..Options::default() };
    let (noisy, ..) = page(&scene, options());
    scene.model.noise = Noise::Off;
    let (clean, ..) = page(&scene, options());
    let count = clean.len() as f64;
    let variance = noisy.iter().zip(&clean).map(|(noisy, clean)| f64::from(noisy - clean).powi(2)).sum::<f64>() / count;
    // Obliquity takes a little of N₀ towards the corners.
    let expected = clean.iter().map(|clean| f64::from(*clean)).sum::<f64>() / count / 1e4;
    let off = |expected: f64| (variance / expected - 1.0).abs();
    let limit = 5.0 * (2.0 / count).sqrt() + 0.005;
    assert!(off(expected) < limit, "{variance:e} {expected:e}");
    assert!(off(expected - scattered / 1e4) > 5.0 * limit, "without quanta of its own");
}

/// Even scatter is even in counts, before the heel's edge, on it and behind it, whatever it is over what would arrive.
#[test]
fn what_the_heel_leaves_dark_sees_the_same_scatter() {
    let mut scene = empty(&["water"]);
    scene.model.scatter = ScatterModel::MonteCarlo;
    scene.beam.spectrum = spectrum(&[(40.0, 1.0), (60.0, 2.0), (80.0, 1.0)]);
    scene.beam.shape.heel = Some(Heel { tube_kvp: 110.0, anode_angle_deg: 6.0, anode_towards: Towards::PlusColumn });
    let view = scene.view.as_mut().expect("a view");
    (view.intrinsics.fx, view.intrinsics.fy) = (350.0, 350.0);
    let counts = |scatter: Option<Arc<Scatter>>| {
        page(&scene, Options { scatter, quantity: Quantity::Counts, reference: true, ..Options::default() }).0
    };
    let air = counts(Some(even(0.0)));
    let dark = air.iter().filter(|count| **count == 0.0).count();
    assert!((500..6000).contains(&dark), "{dark} pixels are dark");
    let mut cells = [0.0f64; 16];
    air.iter().enumerate().for_each(|(n, count)| cells[n / 96 / 24 * 4 + n % 96 / 24] += f64::from(*count) / 576.0);
    let mut scatter = even(0.0).as_ref().clone();
    scatter.unattenuated.pixels = cells.to_vec();
    let wanted = 0.03 * cells.iter().copied().fold(0.0, f64::max);
    scatter.signal.pixels = vec![wanted; 16];
    let with = counts(Some(Arc::new(scatter)));
    for (n, (with, air)) in with.iter().zip(&air).enumerate() {
        let found = f64::from(with - air) / wanted;
        assert!((found - 1.0).abs() < 0.02, "pixel {n}: {found}, {air} in air");
    }
}

/// What few photons leave uncertain is within the statement, and not far below it.
#[test]
fn the_statement_covers_what_few_photons_leave_uncertain() {
    let folder = tempfile::tempdir().expect("folder");
    let lines = ["--quantity", "line_integral"];
    let (good, _) = rendered(
        folder.path(),
        &SCENE.replace("\"seed\": 7", "\"seed\": 8"),
        // Four times as well: what it does not know itself adds a thirtieth to what is seen.
        &[&lines[..], &["--scatter-error", "0.015"]].concat(),
    );
    let (poor, json) = rendered(folder.path(), SCENE, &[&lines[..], &["--scatter-error", "0.06"]].concat());
    let stated = json["stated_error"].as_f64().expect("a number");
    let mut off: Vec<f32> =
        poor.pixels.iter().zip(&good.pixels).map(|(poor, good)| (poor - good).abs() / good.max(1.0)).collect();
    off.sort_by(f32::total_cmp);
    let achieved = f64::from(off[off.len() * 999 / 1000]);
    assert!(achieved <= stated && achieved > 0.1 * stated, "{achieved:e} of {stated:e}");
}

/// 20 ms were asked for, the network took 200, and nothing was said of it.
#[cfg(feature = "learn")]
#[test]
fn a_budget_counts_the_network_that_is_asked() {
    let folder = tempfile::tempdir().expect("folder");
    let [path, out] = ["scene.json", "drr.tif"].map(|name| folder.path().join(name));
    let with = |model: &str, budget_ms: &str| {
        std::fs::write(&path, SCENE.replace("monte_carlo", model)).expect("writes");
        let ran = sidecarm(&["render", text(&path), "--out", text(&out), "--device", "cpu", "--json", "--budget-ms", budget_ms]);
        assert_eq!(ran.code, Some(0), "{}", ran.stderr);
        let is_told = ran.stderr.contains(&format!("--budget-ms {budget_ms} ms cannot be met"));
        (is_told, ran.stderr.contains("of which the scatter network takes"), ran.json())
    };
    // Weights and super-voxels alone take longer, on any machine.
    let (is_told, names_network, json) = with("network", "1");
    assert!(is_told && names_network, "{json}");
    let [predicted_ms, network_ms] =
        [&json["predicted_ms"], &json["stages_ms"]["scatter"]].map(|ms| ms.as_f64().expect("a time"));
    assert!(network_ms > 1.0 && predicted_ms > network_ms, "{predicted_ms} of {network_ms}");
    // The controls: a time that holds both, and the same without a network.
    let (is_told, names_network, _) = with("network", "1e6");
    assert!(!is_told && !names_network);
    let (_, names_network, json) = with("off", "1");
    assert!(!names_network && json["stages_ms"]["scatter"].is_null(), "{json}");
}
