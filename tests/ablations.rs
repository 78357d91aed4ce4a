//! What each step of the image formation is worth on two real CTs: how far each is from photons followed through the same view.
//!
//! The paper renders its four ways side by side; here each is also measured against primary and scattered photons (Monte Carlo) through the CT
//! whose bone is its labels from 100 HU up. Networks that were trained without the specimen are asked where they are given; those that come with
//! the program have seen both.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use sidecarm::image::{Image, read_tiff_f32, write_png_rgb};
use sidecarm::reporter::Reporter;
use sidecarm::scene::{LabelledCt, load_labelled};

use crate::log_lab::{sidecarm, text};
use crate::volume_files::Sample;

const COLUMNS: usize = 310;
const ROWS: usize = 240;
/// Line integrals from white to black, and differences from −this to this, nepers.
const DARKEST: f64 = 6.5;
const DIFFERENCE: f64 = 1.0;

/// A specimen: its folder, and where the view's middle lies, `lps` mm.
const SPECIMENS: [(&str, [f64; 3]); 2] = [("pelvis", [-5.0, -163.0, 190.0]), ("chest", [14.0, 8.0, -190.0])];

/// One way to form the image.
struct Step {
    name: &'static str,
    formation: &'static str,
    /// `None`: the labels.
    materials: Option<&'static str>,
    scatter: &'static str,
    noise: bool,
}

const fn step(name: &'static str, formation: &'static str, materials: &'static str, scatter: &'static str, noise: bool) -> Step {
    Step { name, formation, materials: Some(materials), scatter, noise }
}

/// Where the CTs are, and the networks that were trained without one of them.
struct Given {
    data: PathBuf,
    networks: Option<PathBuf>,
}

impl Given {
    /// `KIND-without-NAME.safetensors`.
    fn network(&self, kind: &str, name: &str) -> Option<PathBuf> {
        let path = self.networks.as_ref()?.join(format!("{kind}-without-{name}.safetensors"));
        assert!(path.is_file(), "{} is not there", path.display());
        Some(path)
    }
}

const STEPS: [Step; 5] = [
    step("naive", "naive", "threshold", "off", false),
    step("spectrum", "deepdrr", "threshold", "off", false),
    step("spectrum, noise", "deepdrr", "threshold", "off", true),
    step("materials network", "deepdrr", "network", "off", false),
    step("materials and scatter networks", "deepdrr", "network", "network", false),
];
const TRUTH: Step = Step { name: "photons", formation: "deepdrr", materials: None, scatter: "monte_carlo", noise: false };

fn scene(folder: &Path, given: &Given, name: &str, middle: [f64; 3], step: &Step) -> Value {
    let ct = given.data.join(format!("ct-{name}"));
    let materials = match step.materials {
        Some("network") => given.network("materials", name).map_or(json!("network"), |path| json!({"network": text(&path)})),
        Some(materials) => json!(materials),
        None => json!({"labels": text(&bone(folder, &ct, name)), "map": {"1": "bone_cortical"}, "default": "soft_tissue"}),
    };
    let [x, y, z] = middle;
    json!({
        "objects": [{"ct": {"path": text(&ct.join("ct.nii.gz")), "materials": materials}}],
        "view": {"size_px": [COLUMNS, ROWS], "intrinsics": [[1033, 0, 154.5], [0, 1033, 119.5], [0, 0, 1]],
                 "camera_from_lps": [[1, 0, 0, -x], [0, 0, -1, z], [0, 1, 0, 700.0 - y], [0, 0, 0, 1]]},
        "beam": {"tube_kvp": 90, "anode_angle_deg": 12, "filtration_mm": {"aluminium": 4.3}, "photons_per_pixel": 5e4},
        "detector": {"response": "energy", "pitch_mm": 0.968},
        "model": {"formation": step.formation, "scatter": step.scatter, "noise": step.noise, "seed": 1}
    })
}

/// A label volume: 1 where a bone's label is and at least 100 HU. Marrow is soft tissue.
fn bone(folder: &Path, ct: &Path, name: &str) -> PathBuf {
    let path = folder.join(format!("bone-{name}.nii"));
    if path.is_file() {
        return path;
    }
    let labels = json!({"labels": text(&ct.join("labels.nii.gz")), "map": "totalsegmentator"});
    let scene =
        json!({"objects": [{"ct": {"path": text(&ct.join("ct.nii.gz")), "materials": labels}}], "beam": {"mono_kev": 60}});
    let labelled = folder.join("labelled.json");
    std::fs::write(&labelled, scene.to_string()).expect("written");
    let (mut found, _) = load_labelled(&labelled, &Reporter::silent()).expect("labels");
    let LabelledCt { ct, labels, bone_labels } = found.remove(0);
    let is_bone = |(label, hu): (&u32, &f32)| i16::from(bone_labels.contains(label) && *hu >= 100.0);
    let hu = labels.iter().zip(&ct.values).map(is_bone).collect();
    Sample { size: ct.size, lps_from_voxel: ct.lps_from_voxel, hu }.nifti(&path);
    path
}

/// Line integrals, and what stands beside the image.
fn formed(folder: &Path, given: &Given, (name, middle): (&str, [f64; 3]), step: &Step, more: &[&str]) -> (Vec<f64>, Value) {
    let (path, image) = (folder.join("scene.json"), folder.join("image.tif"));
    std::fs::write(&path, scene(folder, given, name, middle, step).to_string()).expect("written");
    let device = std::env::var("SIDECARM_DEVICE").unwrap_or_else(|_| "auto".to_owned());
    let base = ["render", text(&path), "--out", text(&image), "--quantity", "line_integral", "--device", &device, "--json"];
    let network = given.network("scatter", name).filter(|_| step.scatter == "network");
    let with = network.as_ref().map_or(Vec::new(), |path| vec!["--scatter-network", text(path)]);
    let ran = sidecarm(&[&base, more, &with].concat());
    assert_eq!(ran.code, Some(0), "{name}, {}: {}", step.name, ran.stderr);
    let page = read_tiff_f32(&image).expect("an image").remove(0);
    (page.pixels.into_iter().map(f64::from).collect(), ran.json())
}

/// Mean and root mean square of the difference of two images, nepers.
fn apart(a: &[f64], b: &[f64]) -> (f64, f64) {
    let both = || a.iter().zip(b).filter(|(a, b)| a.is_finite() && b.is_finite()).map(|(a, b)| a - b);
    let count = both().count() as f64;
    assert!(count > 0.9 * a.len() as f64, "{count} of {} pixels", a.len());
    (both().sum::<f64>() / count, (both().map(|d| d * d).sum::<f64>() / count).sqrt())
}

/// `values` from `low` (black) to `high` (white).
fn grey(values: &[f64], low: f64, high: f64) -> impl Iterator<Item = u8> + '_ {
    values.iter().map(move |value| (255.0 * ((value - low) / (high - low)).clamp(0.0, 1.0)).round() as u8)
}

/// Tiles of equal size, row by row.
fn montage(tiles: &[Vec<u8>], across: usize) -> Image<[u8; 3]> {
    let mut image = Image::filled(across * COLUMNS, tiles.len().div_ceil(across) * ROWS, [255; 3]);
    for (number, tile) in tiles.iter().enumerate() {
        let (left, top) = (number % across * COLUMNS, number / across * ROWS);
        for (at, grey) in tile.iter().enumerate() {
            *image.at_mut(left + at % COLUMNS, top + at / COLUMNS) = [*grey; 3];
        }
    }
    image
}

/// Prints the table and draws the figure of docs/figures.md, into the folder `SIDECARM_OUT`. `SIDECARM_DATA` is the folder of `ct-pelvis` and
/// `ct-chest`, `SIDECARM_NETWORKS` that of networks trained without one of them; `SIDECARM_REL_ERROR` is how well the photons' scatter is known.
/// A GPU renders and follows the photons where there is one, unless `SIDECARM_DEVICE` says otherwise.
#[test]
#[ignore = "minutes long: scripts/evaluate ablations runs it"]
fn ablations() {
    let beside = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/data");
    let asked = std::env::var_os("SIDECARM_DATA").map(PathBuf::from);
    let given =
        Given { data: asked.clone().unwrap_or(beside), networks: std::env::var_os("SIDECARM_NETWORKS").map(PathBuf::from) };
    if !given.data.join("ct-pelvis/ct.nii.gz").is_file() {
        println!("skipped: {} has no ct-pelvis/ct.nii.gz", given.data.display());
        assert!(asked.is_none(), "asked for");
        return;
    }
    if given.networks.is_none() {
        println!("the networks that come with the program were trained on these specimens");
    }
    let out = PathBuf::from(std::env::var_os("SIDECARM_OUT").unwrap_or_else(|| "target/ablations".into()));
    std::fs::create_dir_all(&out).expect("a folder");
    let rel_error = std::env::var("SIDECARM_REL_ERROR").unwrap_or_else(|_| "0.01".to_owned());
    let folder = tempfile::tempdir().expect("a folder");
    let mut tiles = Vec::new();
    for (name, middle) in SPECIMENS {
        let (truth, beside) = formed(folder.path(), &given, (name, middle), &TRUTH, &["--scatter-error", &rel_error]);
        let scatter = &beside["scatter"];
        println!(
            "{name}: photons {} (scatter to primary {:.3})",
            scatter["from"],
            scatter["scatter_to_primary"].as_f64().unwrap_or(f64::NAN)
        );
        let primary = Step { scatter: "off", name: "labels, no scatter", ..TRUTH };
        let (without, _) = formed(folder.path(), &given, (name, middle), &primary, &[]);
        let mut images = Vec::new();
        let mut before = None;
        for step in &STEPS {
            let (image, _) = formed(folder.path(), &given, (name, middle), step, &[]);
            let ((mean, rms), (mean_primary, rms_primary)) = (apart(&image, &truth), apart(&image, &without));
            let closer =
                before.map_or_else(String::new, |before: f64| format!(" ({:+.0} % closer)", 100.0 * (1.0 - rms / before)));
            println!(
                "{name} | {:31} | to photons: mean {mean:+.4}, rms {rms:.4} nepers{closer} | to their primary: mean {mean_primary:+.4}, rms {rms_primary:.4}",
                step.name
            );
            if !step.noise {
                before = Some(rms);
            }
            images.push(image);
        }
        // As a radiologist sees them: bone is bright.
        let shown = [&images[0], &images[2], &images[3], &images[4], &truth];
        tiles.extend(shown.iter().map(|image| grey(image, 0.0, DARKEST).collect::<Vec<u8>>()));
        tiles.extend(shown.iter().map(|image| {
            let difference: Vec<f64> = image.iter().zip(&truth).map(|(a, b)| a - b).collect();
            grey(&difference, -DIFFERENCE, DIFFERENCE).collect::<Vec<u8>>()
        }));
    }
    write_png_rgb(&out.join("ablations.png"), &montage(&tiles, 5)).expect("written");
    println!("{}", out.join("ablations.png").display());
}
