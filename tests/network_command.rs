//! `sidecarm dataset scatter`, `train scatter`, and a render that asks what comes out.

use std::path::Path;

use serde_json::json;
use sidecarm::image::read_tiff_f32;
use sidecarm::learn::Shard;

use crate::log_lab::{sidecarm, text};

fn made(folder: &Path, more: &[&str]) -> (bool, String) {
    let base = ["dataset", "scatter", "--phantoms", "1", "--histories", "40960", "--out", text(folder)];
    said(&[&base, more].concat())
}

fn said(args: &[&str]) -> (bool, String) {
    let ran = sidecarm(args);
    (ran.code == Some(0), ran.stderr)
}

/// The files say what they hold; a file that is there is kept, a damaged one is named; what cannot be drawn is said.
#[test]
fn samples_are_made_once_and_are_those_of_their_seeds() {
    let folder = tempfile::tempdir().expect("a folder");
    let (good, said) = made(folder.path(), &["--count", "4", "--first-seed", "150"]);
    assert!(good, "{said}");
    let path = folder.path().join("scatter-000000150.safetensors");
    let shard = Shard::read(&path).expect("readable");
    let samples = shard.seeds.len();
    assert!((2..=4).contains(&samples), "{samples} samples");
    assert!(shard.seeds.iter().all(|seed| (150..154).contains(seed)) && shard.specimens.iter().all(|name| name == "phantom"));
    assert_eq!((shard.inputs.len(), shard.scalars.len()), (samples * 9 * 64 * 48, samples * 8));
    assert_eq!((shard.truth.len(), shard.truth_error.len()), (samples * 2 * 192, samples * 3 * 192));
    assert!(shard.truth.iter().chain(&shard.truth_error).all(|value| *value >= 0.0 && *value < 10.0));
    assert!(shard.truth.iter().sum::<f32>() > 0.0);
    assert_eq!(shard.asked, [150, 154]);
    let bytes = std::fs::read(&path).expect("readable");
    let (again, said) = made(folder.path(), &["--count", "4", "--first-seed", "150"]);
    assert!(again && std::fs::read(&path).expect("readable") == bytes, "{said}");
    // More seeds of the same file: it is made again; the same with other photons: not.
    let (good, said) = made(folder.path(), &["--count", "6", "--first-seed", "150"]);
    let more = Shard::read(&path).expect("readable");
    assert!(good && more.asked == [150, 156] && more.seeds.starts_with(&shard.seeds), "{said}");
    let parts = |shard: &Shard| [&shard.inputs, &shard.scalars, &shard.scale, &shard.truth, &shard.truth_error].map(Vec::clone);
    assert!(parts(&more).iter().zip(parts(&shard)).all(|(more, made)| more.starts_with(&made)), "a seed is a sample");
    let again = ["dataset", "scatter", "--phantoms", "1", "--count", "4", "--first-seed", "150", "--histories", "50000", "--out"];
    let (good, said) = self::said(&[&again[..], &[text(folder.path())]].concat());
    assert!(!good && said.contains("made otherwise"), "{said}");
    std::fs::write(&path, &bytes[..bytes.len() / 2]).expect("writable");
    let (good, said) = made(folder.path(), &["--count", "4", "--first-seed", "150"]);
    assert!(!good && said.contains("scatter-000000150.safetensors") && said.contains("delete it"), "{said}");
    let (good, said) = made(folder.path(), &["--count", "4", "--first-seed", "7"]);
    assert!(!good && said.contains("multiple of 50"), "{said}");
    let (good, said) = self::said(&["dataset", "scatter", "--out", text(folder.path())]);
    assert!(!good && said.contains("phantoms"), "{said}");
}

/// From nothing to a picture with a network's scatter: whatever it is worth, it is added, its error is stated, and that it was never shown such
/// a scene is said. What is not there, or damaged, is named.
#[test]
fn a_network_is_trained_and_asked() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let [set, network, image] = ["set", "network", "drr.tif"].map(at);
    let (good, words) = made(&set, &["--count", "12"]);
    assert!(good, "{words}");
    let train = |more: &[&str]| {
        let base = ["train", "scatter", text(&set), "--out", text(&network), "--json"];
        sidecarm(&[&base, more].concat())
    };
    let refused = |more: &[&str], words: &str| {
        let ran = train(more);
        assert!(ran.code != Some(0) && ran.stderr.contains(words), "{}", ran.stderr);
    };
    refused(&["--resume"], "nothing to go on from");
    refused(&["--patience", "0"], "patience is 0");
    refused(&["--patience", "3", "--sibling", "other"], "cannot be used with");
    let ran = train(&["--epochs", "2"]);
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    let card = ran.json();
    assert!(card["sample_count"].as_u64().is_some_and(|count| (6..12).contains(&count)), "{card}");
    assert!(card["held_out"]["nmse"].as_f64().is_some_and(f64::is_finite), "{card}");
    // What was asked for is what made the samples.
    assert_eq!((&card["histories_per_sample"], &card["sample_seeds"]), (&json!(40_960), &json!([[0, 12]])), "{card}");
    assert!(card["training_devices"][0].as_str().is_some_and(|name| name.starts_with("processor")), "{card}");
    let svg = std::fs::read_to_string(at("network.svg")).expect("a drawing");
    assert!(svg.starts_with("<svg") && svg.contains("held out"));
    // As far as it was to go: the same network.
    assert_eq!(train(&["--resume"]).json(), card);
    refused(&[], "is there already");
    refused(&["--resume", "--epochs", "3"], "cannot be used with");

    let scene_at = |model: &str| {
        let scene = json!({
            "objects": [{"box": {"centre_lps_mm": [0, 0, 0], "size_mm": [200, 150, 200], "material": "water"}}],
            "view": {"size_px": [64, 48], "intrinsics": [[200, 0, 31.5], [0, 200, 23.5], [0, 0, 1]],
                     "camera_from_lps": [[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 700], [0, 0, 0, 1]]},
            "beam": {"tube_kvp": 42, "filtration_mm": {"aluminium": 3}, "photons_per_pixel": 1e5},
            "detector": {"response": "energy", "pitch_mm": 5.0},
            "model": {"formation": "deepdrr", "scatter": model, "noise": false, "seed": 1}
        });
        let path = at("scene.json");
        std::fs::write(&path, scene.to_string()).expect("written");
        path
    };
    let render = |model: &str, more: &[&str]| {
        let scene = scene_at(model);
        let base = ["render", text(&scene), "--out", text(&image), "--device", "cpu", "--json"];
        sidecarm(&[&base, more].concat())
    };
    assert_eq!(render("off", &[]).code, Some(0));
    let without = read_tiff_f32(&image).expect("an image").remove(0);
    let ran = render("network", &["--scatter-network", text(&network)]);
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    let with = read_tiff_f32(&image).expect("an image").remove(0);
    let scatter = ran.json()["scatter"].clone();
    assert_eq!(scatter["from"]["network"]["sha256"], card["weights_sha256"]);
    assert!(with.pixels.iter().zip(&without.pixels).all(|(with, without)| with > without), "scatter is added everywhere");
    let [added, primary] = [&with, &without].map(|page| page.pixels.iter().map(|value| f64::from(*value)).sum::<f64>());
    let ratio = added / primary - 1.0;
    assert!((scatter["scatter_to_primary"].as_f64().expect("a ratio") / ratio - 1.0).abs() < 1e-3, "{ratio} of {scatter}");
    // Softer than any beam of the samples: it is said, and the statement is as large as the scatter.
    let outside = scatter["from"]["network"]["outside"].as_array().expect("a list");
    assert_eq!(ran.stderr.contains("was not trained for this scene"), !outside.is_empty(), "{}", ran.stderr);
    assert!(!outside.is_empty(), "softer than any beam of the samples");
    assert!(
        scatter["relative_error"] == 1.0 && scatter["stated_error"].as_f64().is_some_and(|error| error > 0.5 * ratio),
        "{scatter}"
    );

    // And of the three ways, beside what it costs.
    let ran = render("network", &["--scatter-network", text(&network), "--explain"]);
    let row = ran.stdout.lines().find(|line| line.starts_with("  network (asked for): "));
    assert!(row.is_some_and(|row| row.contains(" ms; ") && row.contains("was not trained for this scene")), "{}", ran.stdout);

    // The one that comes with the program, and what every way costs.
    let ran = render("network", &["--explain"]);
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    for words in ["off: nothing; lacks", "network (asked for): ", "monte_carlo: about "] {
        assert!(ran.stdout.contains(words), "{words}: {}", ran.stdout);
    }
    let other = read_tiff_f32(&image).expect("an image").remove(0);
    let ran = render("monte_carlo", &["--scatter-error", "0.3", "--budget-ms", "1"]);
    assert!(ran.code == Some(0) && ran.stderr.contains("following photons is predicted to take"), "{}", ran.stderr);
    let ran = render("monte_carlo", &["--scatter-error", "0.3", "--budget-ms", "1e6"]);
    assert!(ran.code == Some(0) && !ran.stderr.contains("is predicted to take"), "the control: {}", ran.stderr);
    assert!(other.pixels.iter().zip(&with.pixels).any(|(other, with)| other != with), "another network says another thing");
    let weights = at("network.safetensors");
    let bytes = std::fs::read(&weights).expect("weights");
    std::fs::write(&weights, &bytes[..bytes.len() - 4]).expect("written");
    let ran = render("network", &["--scatter-network", text(&network)]);
    assert!(ran.code == Some(1) && ran.stderr.contains("network.safetensors") && ran.stderr.contains("sha256"), "{}", ran.stderr);
    let ran = sidecarm(&["train", "scatter", text(&at("nothing")), "--out", text(&at("other"))]);
    assert!(ran.code == Some(1) && ran.stderr.contains("nothing"), "{}", ran.stderr);
}
