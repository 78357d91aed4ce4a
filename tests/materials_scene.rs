//! Scenes whose bone a network sees: a CT that this file draws, in which contrast medium is denser than spongy bone.

use std::io::Write;
use std::path::Path;
use std::process::Command;

use glam::{DAffine3, DVec3};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use sidecarm::image::read_tiff_f32;

use crate::ct_phantom::Luck;
use crate::log_lab::{Ran, text};
use crate::scene_support::tell_costs;
use crate::volume_files::Sample;

/// mm.
const SPACING: f64 = 2.0;
const SIZE: [usize; 3] = [64, 64, 36];
/// Axes of a bone and of a vessel along z.
const BONE_AT: [f64; 2] = [52.0, 62.0];
const VESSEL_AT: [f64; 2] = [88.0, 70.0];

/// A limb of muscle in air: a bone of a dense shell, spongy inside, and a vessel full of contrast medium, denser than what is spongy.
fn limb(shift_hu: f64) -> Sample {
    let mut luck = Luck::new(7);
    let value = |index: usize| {
        let [i, j, _] = [index % SIZE[0], index / SIZE[0] % SIZE[1], index / (SIZE[0] * SIZE[1])];
        let at = [i as f64 * SPACING, j as f64 * SPACING];
        let from = |place: [f64; 2]| (at[0] - place[0]).hypot(at[1] - place[1]);
        let clean = match (from([64.0, 64.0]), from(BONE_AT), from(VESSEL_AT)) {
            (body, ..) if body > 55.0 => -1000.0,
            (_, bone, _) if bone < 9.0 => 190.0,
            (_, bone, _) if bone < 13.0 => 1100.0,
            (.., vessel) if vessel < 8.0 => 330.0,
            _ => 55.0,
        };
        (clean + shift_hu + 12.0 * luck.normal()).round() as i16
    };
    let hu = (0..SIZE.iter().product()).map(value).collect();
    // Left-handed, as many files are.
    let lps_from_voxel = DAffine3::from_scale_rotation_translation(
        DVec3::new(-SPACING, SPACING, SPACING),
        glam::DQuat::IDENTITY,
        DVec3::new(64.0, -64.0, -36.0),
    );
    Sample { size: SIZE, lps_from_voxel, hu }
}

/// A folder for what the program keeps, which knows already what this machine costs where anybody has measured it.
fn cache() -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    tell_costs(folder.path());
    folder
}

fn run(args: &[&str], cache: &Path) -> Ran {
    let mut command = Command::new(env!("CARGO_BIN_EXE_sidecarm"));
    let run = command.args(args).env("XDG_CACHE_HOME", cache).output().expect("the program starts");
    let [stdout, stderr] = [run.stdout, run.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned());
    assert!(!stderr.contains("panicked"), "{args:?}: {stderr}");
    Ran { code: run.status.code(), stdout, stderr }
}

fn scene(folder: &Path, materials: &Value) -> std::path::PathBuf {
    let scene = json!({
        "objects": [{"ct": {"path": "ct.nii", "materials": materials}}],
        "view": {"size_px": [64, 64], "intrinsics": [[250, 0, 31.5], [0, 250, 31.5], [0, 0, 1]],
                 "camera_from_lps": [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 700], [0, 0, 0, 1]]},
        "beam": {"tube_kvp": 90, "photons_per_pixel": 1e5},
        "detector": {"response": "energy", "pitch_mm": 4.0},
    });
    let path = folder.join("scene.json");
    std::fs::write(&path, scene.to_string()).expect("written");
    path
}

/// g/cm² of bone in the middle row, by column.
fn bone(folder: &Path, cache: &Path, materials: &Value) -> (Vec<f64>, Value, String) {
    let (scene, image) = (scene(folder, materials), folder.join("a.tif"));
    let args = ["render", text(&scene), "--out", text(&image), "--quantity", "area_density", "--device", "cpu", "--json"];
    let ran = run(&args, cache);
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    let beside: Value = serde_json::from_slice(&std::fs::read(folder.join("a.tif.json")).expect("there")).expect("JSON");
    let pages = read_tiff_f32(&image).expect("an image");
    assert_eq!(pages.len(), 2, "soft tissue and bone: {}", ran.stderr);
    let row = pages[1].pixels[32 * 64..33 * 64].iter().map(|value| f64::from(*value)).collect();
    (row, beside, ran.stderr)
}

/// A memory that says what thresholding says.
fn otherwise(ct: &Sample) -> Vec<u8> {
    let eight = |eight: &[i16]| eight.iter().enumerate().map(|(at, hu)| u8::from(*hu > 250) << at).sum();
    let bits: Vec<u8> = ct.hu.chunks(8).map(eight).collect();
    let mut encoder = flate2::write::ZlibEncoder::new(Vec::new(), flate2::Compression::fast());
    encoder.write_all(&Sha256::digest(&bits)).expect("written");
    encoder.write_all(&bits).expect("written");
    encoder.finish().expect("written")
}

/// Spongy bone, which thresholding takes for muscle, is bone to the network, and of the contrast medium less is than to thresholding. It is asked
/// once; a damaged memory of what it said is no memory.
#[test]
fn spongy_bone_is_bone_and_the_network_is_asked_once() {
    let folder = tempfile::tempdir().expect("a folder");
    let cache = cache();
    limb(0.0).nifti(&folder.path().join("ct.nii"));
    // Columns through the middle of the bone and of the vessel: x of `lps` is 64 − i · spacing, 700 mm before the focal spot.
    let column = |place: f64| (31.5 + 250.0 / 700.0 * (64.0 - place)).round() as usize;
    let (at_bone, at_vessel) = (column(BONE_AT[0]), column(VESSEL_AT[0]));
    let (by_threshold, ..) = bone(folder.path(), cache.path(), &json!("threshold"));
    let (seen, beside, _) = bone(folder.path(), cache.path(), &json!("network"));
    // 18 mm of spongy bone at 1.13 g/cm³ between twice 4 mm at 1.6.
    let truth = 1.8 * 1.131 + 0.8 * 1.606;
    println!(
        "bone: {:.2} by network, {:.2} by threshold, is {truth:.2}; vessel: {:.2}, {:.2}",
        seen[at_bone], by_threshold[at_bone], seen[at_vessel], by_threshold[at_vessel]
    );
    assert!((seen[at_bone] / truth - 1.0).abs() < 0.05, "{} of {truth}", seen[at_bone]);
    assert!(by_threshold[at_bone] < 0.7 * truth, "the control: {}", by_threshold[at_bone]);
    let [vessel, thresholded] = [seen[at_vessel], by_threshold[at_vessel]];
    assert!(thresholded > 1.5 && vessel < 0.85 * thresholded, "{vessel} {thresholded}");
    // What said it stands beside the image.
    let inputs = beside["inputs"].as_array().expect("a list");
    let network = inputs.iter().find(|input| input["path"] == "calibration/networks/materials.safetensors").expect("named");
    assert_eq!(network["sha256"].as_str().map(str::len), Some(64));
    let said = inputs.iter().find(|input| input["path"] == "bone of objects[0].ct").expect("what it said too");
    assert_eq!(said["sha256"].as_str().map(str::len), Some(64));

    let kept = || {
        let files = std::fs::read_dir(cache.path().join("sidecarm")).expect("a cache");
        let names = files.map(|file| file.expect("readable").path());
        names.filter(|path| path.extension().is_some_and(|ending| ending == "bits")).collect::<Vec<_>>()
    };
    let [path] = &kept()[..] else { panic!("{:?}", kept()) };
    let bytes = std::fs::read(path).expect("readable");
    std::fs::write(path, &bytes[..bytes.len() / 2]).expect("written");
    let (again, ..) = bone(folder.path(), cache.path(), &json!("network"));
    assert_eq!(again, seen);
    assert!(std::fs::read(path).expect("readable") == bytes, "asked anew and kept");
    // A memory that says otherwise is believed: it is what is asked.
    std::fs::write(path, otherwise(&limb(0.0))).expect("written");
    let (remembered, ..) = bone(folder.path(), cache.path(), &json!("network"));
    assert_eq!(remembered, by_threshold);
    assert_eq!(kept().len(), 1);
    // Another CT is asked anew.
    limb(5.0).nifti(&folder.path().join("ct.nii"));
    bone(folder.path(), cache.path(), &json!("network"));
    assert_eq!(kept().len(), 2);
}

/// Labels that name a vessel alone: the network says the rest, and thresholding does not.
#[test]
fn what_no_label_names_the_network_says() {
    let folder = tempfile::tempdir().expect("a folder");
    let cache = cache();
    let ct = limb(0.0);
    ct.nifti(&folder.path().join("ct.nii"));
    let in_vessel = |index: usize| {
        let [i, j] = [index % SIZE[0], index / SIZE[0] % SIZE[1]].map(|n| n as f64 * SPACING);
        i16::from((i - VESSEL_AT[0]).hypot(j - VESSEL_AT[1]) < 8.0)
    };
    let labels = Sample { hu: (0..ct.hu.len()).map(in_vessel).collect(), ..limb(0.0) };
    labels.nifti(&folder.path().join("labels.nii"));
    let column = |place: f64| (31.5 + 250.0 / 700.0 * (64.0 - place)).round() as usize;
    let (at_bone, at_vessel) = (column(BONE_AT[0]), column(VESSEL_AT[0]));
    let (by_network, ..) = bone(folder.path(), cache.path(), &json!("network"));
    let with = |otherwise: &str| {
        let materials = json!({"labels": "labels.nii", "map": {"1": "soft_tissue"}, "else": otherwise});
        bone(folder.path(), cache.path(), &materials)
    };
    let (by_both, beside, _) = with("network");
    assert!((by_both[at_bone] / by_network[at_bone] - 1.0).abs() < 1e-3, "{} {}", by_both[at_bone], by_network[at_bone]);
    assert!(by_both[at_vessel] < 0.05, "{}: its label is no bone's", by_both[at_vessel]);
    let named = beside["inputs"].to_string();
    assert!(named.contains("networks/materials.safetensors") && named.contains("labels.nii"), "{named}");
    let (by_threshold, ..) = with("threshold");
    assert!(by_threshold[at_bone] < 0.8 * by_both[at_bone], "the control: {}", by_threshold[at_bone]);
}

/// What is no network, and what a network was not trained for, is said.
#[test]
fn a_network_that_is_none_is_named() {
    let folder = tempfile::tempdir().expect("a folder");
    let cache = cache();
    limb(0.0).nifti(&folder.path().join("ct.nii"));
    let refused = |materials: &Value, words: &[&str]| {
        let scene = scene(folder.path(), materials);
        let ran = run(&["render", text(&scene), "--out", text(&folder.path().join("b.tif"))], cache.path());
        assert!(ran.code == Some(1) && words.iter().all(|words| ran.stderr.contains(words)), "{words:?}: {}", ran.stderr);
    };
    refused(&json!("nettwork"), &["\"network\""]);
    refused(&json!({"network": "other"}), &["NAME.safetensors"]);
    refused(&json!({"network": "other.safetensors"}), &["other.safetensors is not there"]);
    refused(&json!({"network": "other.safetensors", "labels": "a.nii"}), &["labels"]);
    refused(&json!({"labels": "a.nii", "network": "other.safetensors"}), &["network"]);
    let shipped = Path::new(env!("CARGO_MANIFEST_DIR")).join("calibration/networks");
    std::fs::copy(shipped.join("scatter.safetensors"), folder.path().join("other.safetensors")).expect("copied");
    std::fs::copy(shipped.join("scatter.json"), folder.path().join("other.json")).expect("copied");
    refused(&json!({"network": "other.safetensors"}), &["other.json", "architecture"]);
    std::fs::copy(shipped.join("materials.json"), folder.path().join("other.json")).expect("copied");
    refused(&json!({"network": "other.safetensors"}), &["other.safetensors", "sha256"]);

    // Every fourth voxel along each axis.
    let mut coarse = limb(0.0);
    let of_four = |place: usize| place.is_multiple_of(4);
    let is_kept = |index: &usize| of_four(*index) && of_four(index / SIZE[0]) && of_four(index / (SIZE[0] * SIZE[1]));
    coarse.hu = (0..coarse.hu.len()).filter(is_kept).map(|index| coarse.hu[index]).collect();
    coarse.size = SIZE.map(|side| side / 4);
    coarse.lps_from_voxel.matrix3 *= 4.0;
    coarse.nifti(&folder.path().join("ct.nii"));
    let scene = scene(folder.path(), &json!("network"));
    let ran = run(&["render", text(&scene), "--out", text(&folder.path().join("b.tif")), "--device", "cpu"], cache.path());
    assert!(ran.stderr.contains("was not trained for this CT"), "{}", ran.stderr);
}
