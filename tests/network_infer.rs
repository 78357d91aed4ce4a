use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use sidecarm::image::sha256_bytes;
use sidecarm::infer::{Architecture, Card, InferError, Input, Layer, LoadedNetwork, NetworkFiles, ScatterNetwork, weights_file};
use sidecarm::learn::{Dataset, HoldOut, Recipe, TrainOptions, train};

use crate::network_samples as samples;

/// A network after one epoch, with its samples.
fn small(folder: &Path) -> (PathBuf, Dataset) {
    std::fs::create_dir(folder.join("samples")).expect("the test's own files");
    samples::write(&folder.join("samples"), 4);
    let recipe = Recipe { epochs: 1, batch: 2, hold_out: HoldOut::Nothing, ..Recipe::default() };
    let output = folder.join("net.v1");
    let options = TrainOptions::new(folder.join("samples"), output.clone(), recipe);
    train(&options, &mut |_| ControlFlow::Continue(())).expect("the test's own files");
    (output, Dataset::read(&folder.join("samples")).expect("the test's own files"))
}

fn load(name: &Path) -> Result<LoadedNetwork, InferError> {
    LoadedNetwork::load(name, &samples::CHANNELS, &samples::SCALARS)
}

#[test]
fn a_saved_and_reloaded_network_predicts_the_same_bits() {
    let folder = tempfile::tempdir().unwrap();
    let (name, dataset) = small(folder.path());
    let network = load(&name).unwrap();
    let (card, parameters) = NetworkFiles::of(&name).read::<Card>().unwrap();
    let again = folder.path().join("again");
    let files = NetworkFiles::of(&again);
    std::fs::write(&files.weights, weights_file(&card.architecture.layers(9, 6), &parameters).unwrap()).unwrap();
    std::fs::write(&files.card, serde_json::to_vec(&card).unwrap()).unwrap();
    let reloaded = load(&files.weights).unwrap();
    assert_eq!(reloaded.card(), network.card());
    let bits = |network: &LoadedNetwork, input: &Input| {
        let predicted = network.predict(input).unwrap();
        [predicted.single, predicted.multiple].concat().into_iter().map(f64::to_bits).collect::<Vec<_>>()
    };
    let inputs = dataset.samples.iter().map(|sample| &sample.input);
    assert_eq!(inputs.clone().map(|input| bits(&network, input)).filter(|bits| bits.len() == 384).count(), 4);
    for input in inputs {
        assert_eq!(bits(&network, input), bits(&reloaded, input));
    }
    let [first, second] = [0, 1].map(|index| bits(&network, &dataset.samples[index].input));
    assert_ne!(first, second, "the control");
}

#[test]
fn what_lies_outside_the_training_is_said_and_nan_too() {
    let folder = tempfile::tempdir().unwrap();
    let (name, dataset) = small(folder.path());
    let network = load(&name).unwrap();
    let good = &dataset.samples[0].input;
    assert_eq!(network.predict(good).unwrap().outside, Vec::<String>::new(), "the control");
    let outside = |edit: fn(&mut Input)| {
        let mut input = good.clone();
        edit(&mut input);
        network.predict(&input).unwrap()
    };
    let hot = outside(|input| input.inputs[3072 + 40] = 1e3).outside;
    assert!(hot.iter().any(|saying| saying.starts_with("maximum of channel compton is 1000.000000, in training ")), "{hot:?}");
    let kev = outside(|input| input.scalars[1] = 120.0);
    assert_eq!(kev.outside.len(), 1, "{:?}", kev.outside);
    assert!(kev.outside[0].starts_with("scalar mean_kev is 120.000000, in training "), "{:?}", kev.outside);
    assert!(kev.single.iter().chain(&kev.multiple).all(|value| value.is_finite() && *value > 0.0));
    let scale = outside(|input| input.scale *= 100.0).outside;
    assert!(scale.len() == 1 && scale[0].starts_with("scale is "), "{scale:?}");
    for (edit, names) in [
        ((|input| input.inputs[5] = f32::NAN) as fn(&mut Input), "maximum of channel transmission is NaN"),
        (|input| input.inputs[5] = f32::NEG_INFINITY, "mean of channel transmission is -inf"),
        (|input| input.scalars[0] = f32::NAN, "scalar sdd_mm is NaN"),
    ] {
        let predicted = outside(edit);
        assert!(predicted.outside.iter().any(|saying| saying.starts_with(names)), "{:?}", predicted.outside);
        assert!(predicted.single.iter().chain(&predicted.multiple).all(|value| value.is_nan()));
    }
    for scale in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        let input = Input { scale, ..good.clone() };
        assert!(matches!(network.predict(&input), Err(InferError::Scale { .. })), "{scale}");
    }
    let short = Input { scalars: vec![0.0; 5], ..good.clone() };
    assert!(matches!(network.predict(&short), Err(InferError::InputLength { what: "scalars", expected: 6, found: 5 })));
}

#[test]
fn a_mirrored_sample_lies_inside_the_training() {
    let folder = tempfile::tempdir().unwrap();
    let (name, dataset) = small(folder.path());
    let network = load(&name).unwrap();
    for sample in &dataset.samples {
        for (columns, rows) in [(true, false), (false, true), (true, true)] {
            let image = dataset.mirrored(sample, sidecarm::learn::Mirror { columns, rows });
            assert_eq!(network.predict(&image.input).unwrap().outside, Vec::<String>::new());
        }
    }
}

#[test]
fn a_wrong_truncated_or_foreign_file_is_refused_with_its_reason() {
    let folder = tempfile::tempdir().unwrap();
    let (name, _) = small(folder.path());
    let files = NetworkFiles::of(&name);
    let (weights, card) = (std::fs::read(&files.weights).unwrap(), std::fs::read_to_string(&files.card).unwrap());
    let parameters = files.read::<Card>().unwrap().1;
    let with_sum = |weights: &[u8]| card.replace(&sha256_bytes(&std::fs::read(&files.weights).unwrap()), &sha256_bytes(weights));
    let truncated = &weights[..weights.len() - 1];
    let foreign = b"\x89PNG\r\n\x1a\nnot a network".as_slice();
    let paper_count = Architecture::Paper.layers(9, 6).iter().map(sidecarm::infer::Layer::value_count).sum();
    let paper = weights_file(&Architecture::Paper.layers(9, 6), &vec![0.0; paper_count]).unwrap();
    let mut not_finite = parameters;
    not_finite[17] = f32::NAN;
    let not_finite = weights_file(&Architecture::Default.layers(9, 6), &not_finite).unwrap();
    let mut flipped = weights.clone();
    *flipped.last_mut().unwrap() ^= 1;
    let cases: Vec<(&str, &[u8], String)> = vec![
        ("sha256 is", truncated, card.clone()),
        ("sha256 is", &flipped, card.clone()),
        ("no whole safetensors file", truncated, with_sum(truncated)),
        ("no whole safetensors file", foreign, with_sum(foreign)),
        ("is missing", &paper, with_sum(&paper)),
        ("is not finite", &not_finite, with_sum(&not_finite)),
        ("has shape [32, 15, 4, 4], expected [32, 14, 4, 4]", &weights, without_last_scalar(&card)),
        ("at arch: unknown field", &weights, card.replace("architecture", "arch")),
        ("deviation of compton is 0, expected a number above 0", &weights, with_first_deviation_zero(&card)),
        ("at the top level: expected ident", &weights, "no card".to_owned()),
    ];
    let other = folder.path().join("other");
    let other_files = NetworkFiles::of(&other);
    for (words, weights, card) in cases {
        std::fs::write(&other_files.weights, weights).unwrap();
        std::fs::write(&other_files.card, card).unwrap();
        let said = load(&other).unwrap_err().to_string();
        assert!(said.contains("other.") && said.contains(words), "{words}: {said}");
    }
    std::fs::write(&other_files.weights, &weights).unwrap();
    std::fs::write(&other_files.card, &card).unwrap();
    assert!(load(&other).is_ok(), "the control");
    let mut channels = samples::CHANNELS;
    channels.swap(0, 1);
    let said = LoadedNetwork::load(&other, &channels, &samples::SCALARS).unwrap_err().to_string();
    assert!(said.contains("this program computes [compton, transmission, "), "{said}");
    std::fs::remove_file(&other_files.card).unwrap();
    let said = load(&other).unwrap_err().to_string();
    assert!(said.contains("other.json") && said.contains("cannot be read"), "{said}");
}

fn without_last_scalar(card: &str) -> String {
    let mut card: serde_json::Value = serde_json::from_str(card).expect("the test's own files");
    card["scalars"].as_array_mut().expect("the test's own files").pop();
    card.to_string()
}

fn with_first_deviation_zero(card: &str) -> String {
    let mut card: serde_json::Value = serde_json::from_str(card).expect("the test's own files");
    card["channels"][1]["deviation"] = 0.0.into();
    card.to_string()
}

/// "The first six layers consist of 11×11 kernels arranged in multiple channels […] and the last four layers, with 31×31 kernels and a single
/// channel": but for the last one, which has a channel for what is scattered once and one for what is scattered more often.
#[test]
fn the_paper_s_layers_are_those_of_the_paper() {
    let layers = Architecture::Paper.layers(9, 6);
    assert!(layers.iter().all(|layer| (layer.dimensions, layer.stride) == (2, 1)), "at the resolution of the input");
    let shapes: Vec<Vec<usize>> = layers.iter().map(Layer::weight_shape).collect();
    let several = shapes[0][0];
    assert!(several > 1);
    let mut expected = vec![vec![several, 15, 11, 11]];
    expected.extend(std::iter::repeat_n(vec![several, several, 11, 11], 5));
    expected.push(vec![1, several, 31, 31]);
    expected.extend(std::iter::repeat_n(vec![1, 1, 31, 31], 2));
    expected.push(vec![2, 1, 31, 31]);
    assert_eq!(shapes, expected);
    // With 8 channels: 8·15·11² + 8, five times 8·8·11² + 8, 8·31² + 1, twice 31² + 1, 2·31² + 2.
    let count: usize = layers.iter().map(Layer::value_count).sum();
    assert_eq!((several, count), (8, 14_528 + 5 * 7_752 + 7_689 + 2 * 962 + 1_924));
    assert_ne!(Architecture::Default.layers(9, 6).len(), layers.len(), "the control");
}

#[test]
fn the_default_layers_are_few_enough() {
    let count: usize = Architecture::Default.layers(9, 6).iter().map(sidecarm::infer::Layer::value_count).sum();
    assert!((100_000..=400_000).contains(&count), "{count}");
}
