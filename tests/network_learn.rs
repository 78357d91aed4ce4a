use std::ops::ControlFlow;
use std::path::Path;

use sidecarm::infer::{Architecture, CELLS, JudgedBy, LoadedNetwork, ScatterNetwork};
use sidecarm::learn::{
    Dataset, HoldOut, LearnError, Mirror, Recipe, StepRule, TrainOptions, Trained, TrainingEnd, recipe_of_checkpoint, train,
};

use crate::network_samples as samples;

fn options(folder: &Path, name: &str, recipe: Recipe) -> TrainOptions {
    TrainOptions::new(folder.join("samples"), folder.join(name), recipe)
}

fn folder_of(count: u64) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("the test's own files");
    std::fs::create_dir(folder.path().join("samples")).expect("the test's own files");
    samples::write(&folder.path().join("samples"), count);
    folder
}

fn run(options: &TrainOptions) -> Trained {
    train(options, &mut |_| ControlFlow::Continue(())).expect("the test's own files")
}

fn files(trained: &Trained) -> [Vec<u8>; 3] {
    [&trained.files.network.weights, &trained.files.network.card, &trained.files.history]
        .map(|path| std::fs::read(path).expect("the test's own files"))
}

/// Steps too large to learn by.
fn wild() -> StepRule {
    StepRule { learning_rate: 0.5, warm_up: 0.0, ..StepRule::default() }
}

fn short() -> Recipe {
    Recipe {
        epochs: 3,
        batch: 3,
        hold_out: HoldOut::Specimens { names: vec!["hip".to_owned()] },
        rule: StepRule { learning_rate: 5e-4, ..StepRule::default() },
        ..Recipe::default()
    }
}

/// To a hundredth of their squares, of which their noise is a fortieth.
#[test]
fn four_samples_are_learnt_by_heart() {
    let folder = folder_of(4);
    let recipe = Recipe { epochs: 36, batch: 1, mirror: false, hold_out: HoldOut::Nothing, ..Recipe::default() };
    let trained = run(&options(folder.path(), "heart", recipe));
    assert_eq!(trained.end, TrainingEnd::Complete);
    let network = LoadedNetwork::load(&folder.path().join("heart"), &samples::CHANNELS, &samples::SCALARS).unwrap();
    let dataset = Dataset::read(&folder.path().join("samples")).unwrap();
    assert_eq!(dataset.samples.len(), 4);
    let predicted: Vec<Vec<f64>> = dataset
        .samples
        .iter()
        .map(|sample| {
            let predicted = network.predict(&sample.input).unwrap();
            assert_eq!(predicted.outside, Vec::<String>::new(), "it was trained on this");
            predicted.single.iter().zip(&predicted.multiple).map(|(single, multiple)| single + multiple).collect()
        })
        .collect();
    // Of predictions `factor` times as large, against the truth of the sample so many places on.
    let nmse = |factor: f64, places: usize| {
        let of = predicted.iter().enumerate().map(|(index, predicted)| {
            let truth = &dataset.samples[(index + places) % 4].truth;
            let (mut difference, mut square) = (0.0, 0.0);
            for (cell, predicted) in predicted.iter().enumerate() {
                let truth = f64::from(truth[cell]) + f64::from(truth[CELLS + cell]);
                difference += (factor * predicted - truth).powi(2);
                square += truth * truth;
            }
            difference / square
        });
        of.sum::<f64>() / 4.0
    };
    println!("normalised mean squared error {}, by another sample's {}", nmse(1.0, 0), nmse(1.0, 1));
    assert!(nmse(1.0, 0) < 0.01, "{}", nmse(1.0, 0));
    assert!(nmse(1.2, 0) > 0.01, "the control: {}", nmse(1.2, 0));
    assert!(nmse(1.0, 1) > 0.05, "the control: each its own, not one for all: {}", nmse(1.0, 1));
}

#[test]
fn a_resumed_training_ends_where_a_straight_one_does() {
    let folder = folder_of(12);
    let straight = run(&options(folder.path(), "straight", short()));
    assert_eq!((straight.history.len(), straight.card.specimens.clone()), (3, vec!["knee".to_owned()]));
    let mut parts = options(folder.path(), "parts", short());
    // Stopped in the middle of the second epoch, whose first step is then done twice.
    let stopped = train(&parts, &mut |progress| {
        if progress.epoch == 2 && progress.step == 1 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    let stopped = stopped.unwrap();
    assert_eq!((stopped.end, stopped.history.len()), (TrainingEnd::ByCaller, 1));
    assert_ne!(files(&stopped)[0], files(&straight)[0], "the control");
    parts.resume = true;
    assert_eq!(recipe_of_checkpoint(&parts.output).unwrap(), Some((short(), Vec::new())));
    let resumed = run(&parts);
    assert!(files(&resumed) == files(&straight), "weights, card or history differ");
    let checkpoint = |trained: &Trained| std::fs::read(&trained.files.checkpoint).unwrap();
    assert!(checkpoint(&resumed) == checkpoint(&straight), "the states differ");
}

#[test]
fn the_same_seed_gives_the_same_weights_and_another_seed_others() {
    let folder = folder_of(6);
    let weights =
        |name: &str, seed: u64| files(&run(&options(folder.path(), name, Recipe { seed, epochs: 1, ..short() })))[0].clone();
    let first = weights("first", 7);
    assert!(first == weights("second", 7));
    assert!(first != weights("third", 8), "the control");
}

#[test]
fn a_checkpoint_of_another_training_is_refused() {
    let folder = folder_of(6);
    let mut options = options(folder.path(), "one", Recipe { epochs: 1, ..short() });
    run(&options);
    options.resume = true;
    options.recipe.seed = 99;
    let refused = train(&options, &mut |_| ControlFlow::Continue(())).unwrap_err();
    assert!(matches!(&refused, LearnError::OtherTraining { what, .. } if what == "seed"), "{refused}");
    options.recipe.seed = short().seed;
    samples::shard(100, 2).write(&folder.path().join("samples/c.safetensors")).unwrap();
    let refused = train(&options, &mut |_| ControlFlow::Continue(())).unwrap_err();
    assert!(matches!(&refused, LearnError::OtherTraining { what, .. } if what.contains("samples")), "{refused}");
}

#[test]
fn a_training_that_no_longer_gets_better_stops_and_keeps_its_best() {
    let folder = folder_of(6);
    // So fast that it can only get worse.
    let hold_out = HoldOut::Seeds { share: 0.4 };
    let recipe = Recipe { epochs: 12, patience: Some(2), rule: wild(), hold_out, ..short() };
    let trained = run(&options(folder.path(), "fast", recipe));
    assert_eq!((trained.end, trained.history.len()), (TrainingEnd::NoBetter, trained.epoch + 2));
    let kept = trained.history[trained.epoch - 1].held_out;
    assert!(trained.history.iter().all(|record| record.held_out >= kept));
    assert_eq!(trained.card.held_out.get("nmse").copied(), kept);
    assert_eq!(trained.held_out.map(|figures| figures.nmse()), kept);
    // A specimen that is to be unknown chooses nothing.
    let recipe = Recipe { epochs: 12, patience: Some(2), rule: wild(), ..short() };
    let trained = run(&options(folder.path(), "specimen", recipe));
    assert_eq!((trained.end, trained.epoch, trained.history.len()), (TrainingEnd::Complete, 12, 12));
}

/// Views of the specimens that are trained on choose the epoch and when to stop; what is held out has no say in it, whatever it holds.
#[test]
fn a_held_out_specimen_does_not_choose_where_a_training_stops() {
    let hold_out = HoldOut::Specimens { names: vec!["hip".to_owned()] };
    let recipe = Recipe { epochs: 12, patience: Some(1), set_aside: 0.4, rule: wild(), hold_out, ..short() };
    let trained_with = |times: f32| {
        let folder = tempfile::tempdir().expect("the test's own files");
        let samples = folder.path().join("samples");
        std::fs::create_dir(&samples).expect("the test's own files");
        let mut shard = samples::shard(0, 12);
        shard.origin = r#"{"histories": 5000}"#.to_owned();
        shard.asked = vec![0, 12];
        let of_hip = shard.truth.chunks_exact_mut(2 * CELLS).zip(&shard.specimens).filter(|(_, name)| *name == "hip");
        of_hip.flat_map(|(truth, _)| truth).for_each(|value| *value *= times);
        shard.write(&samples.join("a.safetensors")).expect("the test's own files");
        let trained = run(&options(folder.path(), "early", recipe.clone()));
        let weights = files(&trained)[0].clone();
        (trained, weights)
    };
    let (trained, weights) = trained_with(1.0);
    assert_eq!((trained.end, trained.history.len()), (TrainingEnd::NoBetter, trained.epoch + 1));
    let kept = trained.history[trained.epoch - 1].held_out;
    assert!(trained.history.iter().all(|record| record.held_out >= kept));
    let card = &trained.card;
    // Of six samples of the knee three choose; the six of the hip are what the figures are of.
    assert_eq!((card.sample_count, card.set_aside, card.kept_epoch), (3, 3, Some(trained.epoch)));
    assert_eq!(card.judged_by, JudgedBy::Specimens { names: vec!["hip".to_owned()] });
    assert!(card.held_out["samples"] == 6.0 && card.held_out.get("nmse").copied() != kept, "{:?}", card.held_out);
    assert_eq!((card.histories_per_sample, card.sample_seeds.clone()), (Some(5000), vec![[0, 12]]));
    let (other, same) = trained_with(3.0);
    assert!(same == weights && other.epoch == trained.epoch, "it chose");
    assert_ne!(other.card.held_out["nmse"], card.held_out["nmse"], "the control: it is judged by it");
    // Nothing is left to train on.
    let folder = folder_of(4);
    let all = Recipe { set_aside: 0.9, ..recipe };
    let refused = train(&options(folder.path(), "none", all), &mut |_| ControlFlow::Continue(())).unwrap_err();
    assert!(matches!(refused, LearnError::Split { train: 0, .. }), "{refused}");
}

#[test]
fn an_output_that_cannot_be_kept_is_refused_at_once() {
    let folder = folder_of(4);
    let refused = |name: &str| {
        let mut steps = 0;
        let count = &mut |_: &sidecarm::learn::Progress<'_>| {
            steps += 1;
            ControlFlow::Continue(())
        };
        let said = train(&options(folder.path(), name, short()), count).unwrap_err();
        assert_eq!(steps, 0);
        said
    };
    assert!(matches!(refused("samples/net"), LearnError::AmongSamples { .. }));
    assert!(matches!(refused("nowhere/net"), LearnError::File(_)));
}

#[test]
fn the_paper_s_layers_train_too() {
    let folder = folder_of(2);
    let recipe = Recipe { epochs: 6, batch: 2, mirror: false, hold_out: HoldOut::Nothing, ..Recipe::of(Architecture::Paper) };
    let trained = run(&options(folder.path(), "paper", recipe));
    let losses: Vec<f64> = trained.history.iter().map(|record| record.train_loss).collect();
    assert!(losses[5] < 0.9 * losses[0], "{losses:?}");
    LoadedNetwork::load(&folder.path().join("paper"), &samples::CHANNELS, &samples::SCALARS).unwrap();
}

#[test]
fn a_symmetric_sample_is_its_own_mirror_image() {
    let folder = folder_of(2);
    let dataset = Dataset::read(&folder.path().join("samples")).unwrap();
    let original = &dataset.samples[0];
    let mirrors = [(true, false), (false, true), (true, true)].map(|(columns, rows)| Mirror { columns, rows });
    // The mean of a sample and its images is symmetric, to the bit as sums of two commute.
    let mean = |a: &[f32], b: &[f32]| -> Vec<f32> { a.iter().zip(b).map(|(a, b)| (a + b) / 2.0).collect() };
    for mirror in mirrors {
        let image = dataset.mirrored(original, mirror);
        assert_ne!(&image, original, "the control");
        assert_eq!(&dataset.mirrored(&image, mirror), original, "twice is nothing");
        let mut symmetric = original.clone();
        symmetric.input.inputs = mean(&original.input.inputs, &image.input.inputs);
        symmetric.truth = mean(&original.truth, &image.truth);
        symmetric.truth_error = mean(&original.truth_error, &image.truth_error);
        assert_eq!(dataset.mirrored(&symmetric, mirror), symmetric);
        assert!(symmetric.input.inputs.iter().any(|value| *value < 0.0), "a place that changes sign is left");
    }
    let columns = dataset.mirrored(original, mirrors[0]);
    let x_mm = |inputs: &[f32]| inputs[7 * 3072..8 * 3072].to_vec();
    assert_eq!(x_mm(&columns.input.inputs), x_mm(&original.input.inputs), "x grows to the right in the mirror too");
    assert_eq!(columns.truth[0], original.truth[15], "the first row is reversed");
    assert_eq!(dataset.mirrored(original, mirrors[1]).truth[0], original.truth[11 * 16], "the last row comes first");
}

#[test]
fn what_is_held_out_is_not_trained_on() {
    let folder = folder_of(12);
    let dataset = Dataset::read(&folder.path().join("samples")).unwrap();
    let names = vec!["hip".to_owned()];
    let (train, held_out) = dataset.split(&HoldOut::Specimens { names }, 1).unwrap();
    assert!(train.len() == 6 && train.iter().all(|index| dataset.samples[*index].specimen == "knee"));
    assert!(held_out.len() == 6 && held_out.iter().all(|index| dataset.samples[*index].specimen == "hip"));
    let seeds = |seed| dataset.split(&HoldOut::Seeds { share: 0.1 }, seed).unwrap();
    assert_eq!((seeds(1).0.len(), seeds(1).1.len()), (10, 2), "a tenth of twelve, rounded up");
    assert!((2..20).any(|seed| seeds(seed) != seeds(1)), "another seed holds out others");
    let missing = dataset.split(&HoldOut::Specimens { names: vec!["elbow".to_owned()] }, 1).unwrap_err();
    assert_eq!(missing.to_string(), "specimen `elbow` cannot be held out: the samples show [hip, knee]");
    let all = HoldOut::Specimens { names: vec!["hip".to_owned(), "knee".to_owned()] };
    assert!(matches!(dataset.split(&all, 1), Err(LearnError::Split { train: 0, held_out: 12 })));
}

#[test]
fn samples_that_cannot_be_learnt_from_are_refused_by_name() {
    let good = samples::shard(0, 2);
    let mut cases = Vec::new();
    for (words, edit) in [
        ("sample 1 (seed 1): scale is 0, expected above 0", (|shard| shard.scale[1] = 0.0) as fn(&mut sidecarm::learn::Shard)),
        ("sample 0 (seed 0): a cell of the truth is -1", |shard| shard.truth[5] = -1.0),
        ("tensor `inputs` is not finite at value 3", |shard| shard.inputs[3] = f32::NAN),
        ("the sum of the truth is 0", |shard| shard.truth[..384].fill(0.0)),
        ("tensor `truth_error` is not finite", |shard| shard.truth_error[0] = f32::INFINITY),
        ("are [32, 96], in the files before it [64, 48]", |shard| shard.grid_px = [32, 96]),
        ("are of another day, in the files before it ", |shard| shard.origin = "of another day".to_owned()),
    ] {
        let mut shard = good.clone();
        edit(&mut shard);
        cases.push((words, shard));
    }
    for (words, shard) in cases {
        let folder = tempfile::tempdir().unwrap();
        good.write(&folder.path().join("a.safetensors")).unwrap();
        assert!(Dataset::read(folder.path()).is_ok(), "the control");
        let said = match shard.write(&folder.path().join("b.safetensors")) {
            // What is not finite is not written in the first place.
            Err(error) => error.to_string(),
            Ok(()) => Dataset::read(folder.path()).unwrap_err().to_string(),
        };
        assert!(said.contains("b.safetensors") && said.contains(words), "{said}");
    }
    // Nor read, where somebody else wrote it.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.safetensors");
    good.write(&path).unwrap();
    let mut bytes = std::fs::read(&path).unwrap();
    let last = bytes.len() - 4;
    bytes[last..].copy_from_slice(&f32::NAN.to_le_bytes());
    std::fs::write(&path, bytes).unwrap();
    assert!(Dataset::read(folder.path()).unwrap_err().to_string().contains("is not finite"));
    let empty = tempfile::tempdir().unwrap();
    assert!(Dataset::read(empty.path()).unwrap_err().to_string().contains("sidecarm dataset scatter"));
}

#[test]
fn a_file_of_samples_comes_back_as_it_was() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.safetensors");
    let mut shard = samples::shard(0, 2);
    shard.seeds[1] = u64::MAX;
    shard.write(&path).unwrap();
    assert_eq!(sidecarm::learn::Shard::read(&path).unwrap(), shard);
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() - 4]).unwrap();
    let said = sidecarm::learn::Shard::read(&path).unwrap_err().to_string();
    assert!(said.contains("a.safetensors") && said.contains("no whole safetensors file"), "{said}");
}

/// What is trained on everything is judged by those that were not; one of other samples or without a specimen of its own says nothing.
#[test]
fn a_network_of_all_samples_has_the_figures_of_its_siblings() {
    let folder = folder_of(6);
    let without = |name: &str| {
        let recipe = Recipe { epochs: 1, hold_out: HoldOut::Specimens { names: vec![name.to_owned()] }, ..short() };
        run(&options(folder.path(), &format!("without-{name}"), recipe)).card
    };
    let (hip, knee) = (without("hip"), without("knee"));
    let all = Recipe { epochs: 1, hold_out: HoldOut::Nothing, ..short() };
    let mut asked = options(folder.path(), "all", all);
    asked.siblings = ["without-hip", "without-knee"].map(|name| folder.path().join(name)).to_vec();
    let card = run(&asked).card;
    assert_eq!(card.sample_count, 6);
    let [of_hip, of_knee] = [&hip, &knee].map(|card| card.held_out["nmse"]);
    assert_eq!(card.held_out["nmse of hip"], of_hip);
    assert_eq!(card.held_out["nmse of knee"], of_knee);
    // Three samples each.
    assert!((card.held_out["nmse"] - 0.5 * (of_hip + of_knee)).abs() < 1e-12 && card.held_out["samples"] == 6.0);
    let [rms_hip, rms_knee] = [&hip, &knee].map(|card| card.held_out["mean_rms"]);
    assert!((card.held_out["mean_rms"] - (0.5 * (rms_hip.powi(2) + rms_knee.powi(2))).sqrt()).abs() < 1e-12);
    // They go on being trained: the last word is theirs at the end.
    let longer = Recipe { epochs: 2, hold_out: HoldOut::Nothing, ..short() };
    let mut alike = options(folder.path(), "longer", longer.clone());
    alike.siblings = ["hip", "knee"].map(|name| folder.path().join(format!("longer-{name}"))).to_vec();
    let train_sibling = |name: &str, epochs: usize, resume: bool| {
        let hold_out = HoldOut::Specimens { names: vec![name.to_owned()] };
        let recipe = Recipe { hold_out, ..longer.clone() };
        let sibling = TrainOptions { resume, ..options(folder.path(), &format!("longer-{name}"), recipe) };
        let mut left = epochs;
        let stopped = train(&sibling, &mut |progress| {
            left -= usize::from(progress.done.is_some());
            if left == 0 { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        stopped.unwrap().card.held_out["nmse"]
    };
    let early = ["hip", "knee"].map(|name| train_sibling(name, 1, false));
    let mut late = early;
    let card_then = train(&alike, &mut |progress| {
        if progress.epoch == 1 && progress.done.is_some() {
            late = ["hip", "knee"].map(|name| train_sibling(name, 1, true));
        }
        ControlFlow::Continue(())
    });
    let found = card_then.unwrap().card.held_out["nmse of hip"];
    assert!(found == late[0] && late[0] != early[0], "{found} {early:?} {late:?}");
    let JudgedBy::Siblings { weights_sha256 } = &card.judged_by else { panic!("{:?}", card.judged_by) };
    assert_eq!(weights_sha256["hip"], hip.weights_sha256);
    assert_eq!(hip.judged_by, JudgedBy::Specimens { names: vec!["hip".to_owned()] });

    let refused = |asked: &TrainOptions, words: &str| {
        let said = train(asked, &mut |_| ControlFlow::Continue(())).unwrap_err().to_string();
        assert!(said.contains(words), "{said}");
    };
    asked.output = folder.path().join("other");
    asked.siblings.push(folder.path().join("without-hip"));
    refused(&asked, "the same specimen");
    asked.siblings = vec![folder.path().join("all")];
    refused(&asked, "holds out no specimen");
    asked.siblings = vec![folder.path().join("without-hip")];
    asked.recipe.seed += 1;
    refused(&asked, "its seed or its epochs are others");
    asked.recipe.seed -= 1;
    samples::shard(100, 2).write(&folder.path().join("samples/c.safetensors")).unwrap();
    refused(&asked, "other samples");
}
