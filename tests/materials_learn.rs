//! Materials networks: specimens, what a training comes to, and the one that comes with the program.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use sidecarm::infer::materials::LoadedMaterials;
use sidecarm::infer::{JudgedBy, NetworkFiles};
use sidecarm::learn::materials::{MaterialsFigures, MaterialsRecipe, TrainedMaterials, phantom, train_materials};
use sidecarm::learn::{HoldOut, LabelledSpecimen, StepRule, TrainOptions, TrainingEnd};

use crate::log_lab::{sidecarm, text};

fn options(folder: &Path, name: &str, recipe: MaterialsRecipe) -> TrainOptions<MaterialsRecipe> {
    TrainOptions { dataset: folder.join("set"), output: folder.join(name), resume: false, siblings: Vec::new(), recipe }
}

fn short() -> MaterialsRecipe {
    MaterialsRecipe { epochs: 2, steps: 2, batch: 1, hold_out: HoldOut::Nothing, ..MaterialsRecipe::default() }
}

fn run(options: &TrainOptions<MaterialsRecipe>) -> TrainedMaterials {
    train_materials(options, &mut |_| ControlFlow::Continue(())).unwrap_or_else(|error| panic!("{error}"))
}

fn phantoms(folder: &Path, seeds: std::ops::Range<u64>) {
    std::fs::create_dir_all(folder.join("set")).expect("a folder");
    for seed in seeds {
        let path = folder.join(format!("set/materials-phantom-{seed}.safetensors"));
        phantom(seed, &[], "a test".to_owned()).write(&path).expect("written");
    }
}

/// From the command line: specimens are made once, a training goes on where it was interrupted and comes to the same, bit for bit; a tenth of the
/// phantoms judges, siblings lend their figures, and what is not there is said.
#[test]
fn a_resumed_training_is_the_straight_one() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let set = at("set");
    let make = |more: &[&str]| sidecarm(&[&["dataset", "materials", "--out", text(&set)], more].concat());
    let ran = make(&["--phantoms", "2", "--first-seed", "40"]);
    assert!(ran.code == Some(0) && ran.stdout.contains("2 specimens made"), "{}", ran.stderr);
    let ran = make(&["--phantoms", "3", "--first-seed", "40"]);
    assert!(ran.code == Some(0) && ran.stdout.contains("1 specimens made, 2 were there"), "{}{}", ran.stdout, ran.stderr);
    let path = set.join("materials-phantom-41.safetensors");
    assert!(
        LabelledSpecimen::read(&path).expect("readable")
            == phantom(41, &[], LabelledSpecimen::read(&path).expect("readable").origin)
    );
    assert!(make(&["--phantoms", "0"]).stderr.contains("give SCENE.json"));

    let straight = run(&options(folder.path(), "straight", short()));
    assert_eq!((straight.end, straight.epoch, straight.history.len()), (TrainingEnd::Complete, 2, 2));
    assert!(
        straight.history.iter().all(|record| record.train_loss > 0.0 && record.train_loss < 1.0 && record.held_out.is_none())
    );
    assert_eq!(
        (straight.card.judged_by.clone(), straight.card.specimens.clone()),
        (JudgedBy::Nothing, vec!["3 phantoms".to_owned()])
    );
    let mut resumed = options(folder.path(), "resumed", short());
    let stopped = train_materials(&resumed, &mut |progress| {
        if progress.done.is_some() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    });
    assert_eq!(stopped.expect("an epoch").end, TrainingEnd::ByCaller);
    resumed.resume = true;
    let resumed = run(&resumed);
    assert_eq!((&resumed.card, &resumed.history), (&straight.card, &straight.history));

    let ran = sidecarm(&[
        "train",
        "materials",
        text(&set),
        "--out",
        text(&at("told")),
        "--epochs",
        "1",
        "--steps",
        "1",
        "--hold-out",
        "phantom-41",
        "--json",
    ]);
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    let card = ran.json();
    let figure = |name: &str| card["held_out"][name].as_f64().expect("a figure");
    assert!(figure("error of phantoms") < 1.0 && figure("threshold error from 100 to 400 HU of phantoms") > 0.0, "{card}");
    assert!(std::fs::read_to_string(at("told.svg")).expect("a drawing").contains("held out"));
    let ran = sidecarm(&["train", "materials", text(&set), "--out", text(&at("no")), "--hold-out", "nobody"]);
    assert!(ran.code == Some(1) && ran.stderr.contains("nobody") && ran.stderr.contains("phantom-40"), "{}", ran.stderr);
    let bytes = std::fs::read(&path).expect("readable");
    std::fs::write(&path, &bytes[..bytes.len() / 2]).expect("written");
    let ran = sidecarm(&["train", "materials", text(&set), "--out", text(&at("no"))]);
    assert!(
        ran.code == Some(1) && ran.stderr.contains("materials-phantom-41") && ran.stderr.contains("delete it"),
        "{}",
        ran.stderr
    );
    let siblings: Vec<PathBuf> = vec![at("told")];
    let wrong = TrainOptions { siblings, ..options(folder.path(), "all", short()) };
    std::fs::write(&path, &bytes).expect("written");
    let refused = train_materials(&wrong, &mut |_| ControlFlow::Continue(())).expect_err("trained otherwise");
    assert!(refused.to_string().contains("its layers, its seed or its epochs are others"), "{refused}");
}

/// What it has seen often enough it knows: the loss of one phantom falls to a fraction.
#[test]
fn a_training_learns_what_it_sees() {
    let folder = tempfile::tempdir().expect("a folder");
    phantoms(folder.path(), 3..4);
    let rule = StepRule { learning_rate: 4e-3, ..StepRule::default() };
    let trained = run(&options(folder.path(), "one", MaterialsRecipe { epochs: 4, steps: 10, batch: 1, rule, ..short() }));
    let losses: Vec<f64> = trained.history.iter().map(|record| record.train_loss).collect();
    println!("losses {losses:?}");
    assert!(losses[3] < 0.6 * losses[0], "{losses:?}");
}

/// Bone of the network, of thresholding and of the truth, on phantoms that nothing was trained on.
#[test]
fn the_shipped_network_is_as_good_as_its_figures() {
    let network = LoadedMaterials::shipped().expect("it comes with the program");
    let card = network.card();
    let JudgedBy::Siblings { weights_sha256 } = &card.judged_by else { panic!("{:?}", card.judged_by) };
    assert_eq!(weights_sha256.keys().collect::<Vec<_>>(), ["chest", "pelvis"]);
    for of in ["chest", "pelvis"] {
        let [network, threshold] = ["", "threshold "].map(|by| card.held_out[&format!("{by}error from 100 to 400 HU of {of}")]);
        assert!(network < threshold, "{of}: {network} {threshold}");
    }
    let files = NetworkFiles::of(&Path::new(env!("CARGO_MANIFEST_DIR")).join("calibration/networks/materials"));
    assert!(std::fs::metadata(files.weights).expect("there").len() < 4 << 20);
    let mut found = MaterialsFigures::default();
    for seed in PINNED_SEEDS {
        let specimen = phantom(seed, &[], String::new());
        found = found.and(MaterialsFigures::of(&specimen, &network.bone(&specimen.volume(), &mut |_, _, _| {})));
    }
    let figures = found.named("");
    println!("{figures:#?}");
    for (name, expected) in PINNED {
        assert!((figures[name] - expected).abs() < 2e-3, "{name}: {} {expected}", figures[name]);
    }
    assert!(figures["error from 100 to 400 HU"] < 0.5 * figures["threshold error from 100 to 400 HU"]);
}

const PINNED_SEEDS: std::ops::Range<u64> = 900_000..900_003;
/// Of these weights on these phantoms.
const PINNED: [(&str, f64); 3] = [("error", 0.0), ("error from 100 to 400 HU", 0.0), ("dice bone", 0.0)];
