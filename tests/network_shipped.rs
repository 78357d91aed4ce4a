//! The network that comes with the program, on samples that nothing was trained on: seeds 900000 to 900015 of
//! `sidecarm dataset scatter pelvis.json chest.json --first-seed 900000 --count 16 --histories 1e6`, packed.

use std::io::Read;
use std::path::Path;

use sidecarm::image::sha256_bytes;
use sidecarm::infer::{CELLS, JudgedBy, LoadedNetwork, ScatterNetwork};
use sidecarm::learn::{Dataset, Sample};
use sidecarm::transport::{CHANNELS, SCALARS};

fn samples() -> Vec<Sample> {
    let packed = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/scatter-held-out.safetensors.gz");
    let mut bytes = Vec::new();
    let file = std::fs::File::open(packed).expect("the test's own file");
    flate2::read::GzDecoder::new(file).read_to_end(&mut bytes).expect("packed");
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::write(folder.path().join("a.safetensors"), bytes).expect("written");
    Dataset::read(folder.path()).expect("samples").samples
}

/// Mean over the samples of Σ(Ŝ−S)²/ΣS² without the noise of S, and mean of Ŝ's mean over S's less 1; `times` the prediction.
fn figures(network: &LoadedNetwork, samples: &[Sample], times: f64) -> (f64, f64) {
    let (mut nmse, mut bias) = (0.0, 0.0);
    for sample in samples {
        let found = network.predict(&sample.input).expect("an answer");
        let (mut difference, mut square, mut predicted, mut truth) = (0.0, 0.0, 0.0, 0.0);
        for cell in 0..CELLS {
            let there = f64::from(sample.truth[cell]) + f64::from(sample.truth[CELLS + cell]);
            let noise = f64::from(sample.truth_error[2 * CELLS + cell]).powi(2);
            let here = times * (found.single[cell] + found.multiple[cell]);
            difference += (here - there).powi(2) - noise;
            square += there * there - noise;
            (predicted, truth) = (predicted + here, truth + there);
        }
        nmse += difference / square / samples.len() as f64;
        bias += (predicted / truth - 1.0) / samples.len() as f64;
    }
    (nmse, bias)
}

#[test]
fn the_shipped_network_is_as_good_as_its_card_says() {
    let network = LoadedNetwork::shipped(&CHANNELS, &SCALARS).expect("it comes with the program");
    let card = network.card();
    assert_eq!(card.specimens, ["chest", "pelvis", "phantom"]);
    let JudgedBy::Siblings { weights_sha256 } = &card.judged_by else { panic!("{:?}", card.judged_by) };
    assert_eq!(weights_sha256.keys().collect::<Vec<_>>(), ["chest", "pelvis"]);
    let samples = samples();
    assert!(samples.len() > 12, "{}", samples.len());
    let (nmse, bias) = figures(&network, &samples, 1.0);
    println!("nmse {nmse:.4}, bias {bias:.4}; the card says {:.4} and {:.4}", card.held_out["nmse"], card.held_out["mean_bias"]);
    // Of specimens that it knows it is better than of those of its card; a few samples are not the mean of many.
    assert!(nmse < 1.5 * card.held_out["nmse"] && bias.abs() < 0.08, "{nmse} {bias}");
    assert!((nmse - PINNED.0).abs() < 0.02 * PINNED.0 && (bias - PINNED.1).abs() < 1e-3, "{nmse} {bias}");
    let (off, _) = figures(&network, &samples, 1.2);
    assert!(off > 1.5 * card.held_out["nmse"], "the control: {off}");
}

/// Whoever clones the program carries them: 10 MB in all, and every weights file is the one that its card speaks of.
#[test]
fn the_shipped_networks_are_few_bytes_and_those_of_their_cards() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("calibration/networks");
    let (mut bytes, mut networks) = (0, Vec::new());
    for entry in std::fs::read_dir(&folder).expect("networks") {
        let path = entry.expect("readable").path();
        bytes += std::fs::metadata(&path).expect("readable").len();
        if path.extension().is_none_or(|ending| ending != "json") {
            continue;
        }
        let card: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).expect("readable")).expect("JSON");
        let weights = std::fs::read(path.with_extension("safetensors")).expect("weights beside their card");
        assert_eq!(card["weights_sha256"].as_str(), Some(sha256_bytes(&weights).as_str()), "{}", path.display());
        networks.push(path.file_stem().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default());
    }
    networks.sort();
    assert_eq!(networks, ["materials", "scatter"]);
    assert!(bytes <= 10_000_000, "{bytes} bytes");
}

/// `nmse` and bias of these weights on these samples.
const PINNED: (f64, f64) = (0.021816, -0.029552);
