//! Materials networks: specimens, what a training comes to, and the one that comes with the program.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use sidecarm::infer::materials::{CLASSES, INPUTS, LoadedMaterials, MaterialsArchitecture, MaterialsCard};
use sidecarm::infer::{JudgedBy, NetworkDevice, NetworkFiles};
use sidecarm::learn::materials::{MaterialsFigures, MaterialsRecipe, TrainedMaterials, phantom, train_materials};
use sidecarm::learn::{HoldOut, LabelledSpecimen, StepRule, TrainOptions, TrainingEnd};

use crate::log_lab::{sidecarm, text};

fn options(folder: &Path, name: &str, recipe: MaterialsRecipe) -> TrainOptions<MaterialsRecipe> {
    TrainOptions::new(folder.join("set"), folder.join(name), recipe)
}

fn short() -> MaterialsRecipe {
    MaterialsRecipe { epochs: 2, steps: 2, batch: 1, hold_out: HoldOut::Nothing, fresh_phantoms: 0, ..MaterialsRecipe::default() }
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

/// From the command line: specimens are made once, what is not there or damaged is said, and the card has the figures.
#[test]
fn specimens_are_made_and_trained_on() {
    let folder = tempfile::tempdir().expect("a folder");
    let at = |name: &str| folder.path().join(name);
    let set = at("set");
    let make = |more: &[&str]| sidecarm(&[&["dataset", "materials", "--out", text(&set)], more].concat());
    let ran = make(&["--phantoms", "1", "--first-seed", "40"]);
    assert!(ran.code == Some(0) && ran.stdout.contains("1 specimens made"), "{}", ran.stderr);
    let ran = make(&["--phantoms", "2", "--first-seed", "40"]);
    assert!(ran.code == Some(0) && ran.stdout.contains("1 specimens made, 1 were there"), "{}{}", ran.stdout, ran.stderr);
    let path = set.join("materials-phantom-41.safetensors");
    let read = |path: &Path| LabelledSpecimen::read(path).unwrap_or_else(|error| panic!("{error}"));
    assert!(read(&path) == phantom(41, &[], read(&path).origin));
    assert!(make(&["--phantoms", "0"]).stderr.contains("give SCENE.json"));
    let open = at("open.stl");
    std::fs::write(
        &open,
        "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 9 0 0\nvertex 0 9 0\nendloop\nendfacet\nendsolid a\n",
    )
    .expect("written");
    let ran = make(&["--phantoms", "1", "--mesh", text(&open)]);
    assert!(ran.code == Some(1) && ran.stderr.contains("open.stl"), "{}", ran.stderr);

    let train = |more: &[&str]| sidecarm(&[&["train", "materials", text(&set), "--out", text(&at("told"))], more].concat());
    let ran = train(&["--hold-out", "nobody"]);
    assert!(ran.code == Some(1) && ran.stderr.contains("nobody") && ran.stderr.contains("phantom-40"), "{}", ran.stderr);
    let ran = train(&["--epochs", "1", "--steps", "1", "--batch", "1", "--minutes", "0", "--hold-out", "phantom-41", "--json"]);
    assert_eq!(ran.code, Some(0), "{}", ran.stderr);
    let card = ran.json();
    let figure = |name: &str| card["held_out"][name].as_f64().expect("a figure");
    assert!(figure("error of phantoms held out") < 1.0 && figure("threshold error from 100 to 400 HU") > 0.0, "{card}");
    assert!(figure("dice bone of fresh phantoms") < 1.0 && card["kept_epoch"] == 1, "{card}");
    assert!(std::fs::read_to_string(at("told.svg")).expect("a drawing").contains("held out"));
    assert!(train(&[]).stderr.contains("is there already"));

    let bytes = std::fs::read(&path).expect("readable");
    std::fs::write(&path, &bytes[..bytes.len() / 2]).expect("written");
    let refused = |words: &[&str]| {
        let ran = sidecarm(&["train", "materials", text(&set), "--out", text(&at("no"))]);
        assert!(ran.code == Some(1) && words.iter().all(|words| ran.stderr.contains(words)), "{words:?}: {}", ran.stderr);
    };
    refused(&["materials-phantom-41", "delete it"]);
    // The same voxels under another name would be trained on where they are held out.
    let mut twin = read(&set.join("materials-phantom-40.safetensors"));
    twin.name = "somebody".to_owned();
    twin.write(&path).expect("written");
    refused(&["phantom-40", "keep one of them"]);
}

/// A training goes on where it was interrupted and comes to the same, bit for bit; held-out phantoms choose the epoch; siblings lend their figures
/// once they have them.
#[test]
fn a_resumed_training_is_the_straight_one() {
    let folder = tempfile::tempdir().expect("a folder");
    phantoms(folder.path(), 40..43);
    let straight = run(&options(folder.path(), "straight", short()));
    assert_eq!((straight.end, straight.epoch, straight.history.len()), (TrainingEnd::Complete, 2, 2));
    assert!(
        straight.history.iter().all(|record| record.train_loss > 0.0 && record.train_loss < 4.0 && record.held_out.is_none())
    );
    assert_eq!(
        (straight.card.judged_by.clone(), straight.card.specimens.clone()),
        (JudgedBy::Nothing, vec!["3 phantoms".to_owned()])
    );
    let stop = |options: &TrainOptions<MaterialsRecipe>| {
        let stopped = train_materials(options, &mut |progress| {
            if progress.done.is_some() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
        });
        stopped.unwrap_or_else(|error| panic!("{error}"))
    };
    let mut resumed = options(folder.path(), "resumed", short());
    assert_eq!(stop(&resumed).end, TrainingEnd::ByCaller);
    resumed.resume = true;
    let resumed = run(&resumed);
    assert_eq!((&resumed.card, &resumed.history), (&straight.card, &straight.history));

    // Of three phantoms some are held out, and their loss chooses; a seed that holds out all of them is refused.
    let chosen = (1..20).find_map(|seed| {
        let hold_out = HoldOut::Seeds { share: 0.4 };
        let recipe = MaterialsRecipe { seed, epochs: 3, steps: 1, hold_out, patience: Some(1), ..short() };
        let trained =
            train_materials(&options(folder.path(), &format!("chosen-{seed}"), recipe), &mut |_| ControlFlow::Continue(()));
        trained.ok().filter(|trained| trained.card.judged_by == JudgedBy::Seeds)
    });
    let chosen = chosen.expect("a seed that holds out some");
    let losses: Vec<f64> = chosen.history.iter().filter_map(|record| record.held_out).collect();
    assert!(losses.len() == chosen.history.len() && losses.iter().all(|loss| *loss >= losses[chosen.epoch - 1]), "{losses:?}");
    assert_eq!((chosen.card.judged_by, chosen.card.kept_epoch), (JudgedBy::Seeds, chosen.epoch));

    let one = |name: &str| MaterialsRecipe {
        epochs: 1,
        steps: 1,
        hold_out: HoldOut::Specimens { names: vec![name.to_owned()] },
        ..short()
    };
    let paths: Vec<PathBuf> = ["phantom-40", "phantom-41"].iter().map(|name| folder.path().join(name)).collect();
    let first = run(&options(folder.path(), "phantom-40", one("phantom-40")));
    let all = |recipe: MaterialsRecipe| TrainOptions { siblings: paths.clone(), ..options(folder.path(), "all", recipe) };
    let whole = MaterialsRecipe { epochs: 1, steps: 1, ..short() };
    let refused = |asked: &TrainOptions<MaterialsRecipe>, words: &str| {
        let error = train_materials(asked, &mut |_| ControlFlow::Continue(())).expect_err("refused").to_string();
        assert!(error.contains(words), "{words}: {error}");
    };
    refused(&all(whole.clone()), "phantom-41");
    let longer = MaterialsRecipe { epochs: 2, ..one("phantom-41") };
    stop(&options(folder.path(), "phantom-41", longer.clone()));
    refused(&all(whole.clone()), "its layers, its seed or its epochs are others");
    let second = run(&options(folder.path(), "second", one("phantom-41")));
    let paths = [folder.path().join("phantom-40"), folder.path().join("second")].to_vec();
    let together = run(&TrainOptions { siblings: paths, ..options(folder.path(), "all", whole) });
    let key = "error of phantoms held out";
    let mean = 0.5 * (first.card.held_out[key] + second.card.held_out[key]);
    assert!((together.card.held_out[key] - mean).abs() < 1e-12);
    assert_eq!(together.card.held_out[&format!("{key} of phantom-41")], second.card.held_out[key]);
    assert!(matches!(&together.card.judged_by, JudgedBy::Siblings { weights_sha256 } if weights_sha256.len() == 2));
    assert_eq!(together.card.specimens, ["3 phantoms"]);
    // One that is not at its end has no figures to lend.
    stop(&options(folder.path(), "third", longer));
    let paths = [folder.path().join("third")].to_vec();
    let whole = MaterialsRecipe { epochs: 2, steps: 1, fresh_phantoms: 1, ..short() };
    refused(&TrainOptions { siblings: paths, ..options(folder.path(), "other", whole) }, "not at its end");
}

/// "Patches with 128³ voxels with voxel sizes of 0.86×0.86×1.0 mm³ […] fed forward with stride of 64 since only labels for the central 64³ voxels are
/// accepted", "of encoder–decoder structure with skip-ahead connections", for air, soft tissue and bone.
#[test]
fn the_paper_s_pass_is_that_of_the_paper() {
    let [pass] = MaterialsArchitecture::Paper.passes() else { panic!("one pass") };
    assert_eq!((pass.spacing_mm, pass.patch, pass.keep, pass.fold), ([0.86, 0.86, 1.0], 128, 64, 1));
    // Patches follow each other as far as they are kept, and what is kept is their middle.
    assert_eq!((pass.patch - pass.keep) % 2, 0);
    let layers = pass.layers();
    assert!(layers.iter().all(|layer| layer.dimensions == 3));
    let halvings: Vec<usize> = layers.iter().map(|layer| layer.stride).filter(|stride| *stride == 2).collect();
    assert_eq!(halvings.len(), pass.channels.len() - 1);
    assert_eq!(pass.patch % (1 << halvings.len()), 0, "every level has whole points");
    // On the way up each level takes what the level below says and what itself said on the way down.
    let joined: Vec<usize> = layers.iter().filter(|layer| layer.name.contains(".up.")).map(|layer| layer.inputs).collect();
    assert_eq!(joined, pass.channels.windows(2).rev().map(|two| two[0] + two[1]).collect::<Vec<_>>());
    let (first, last) = (&layers[0], &layers[layers.len() - 1]);
    assert_eq!((first.inputs, last.outputs), (INPUTS, CLASSES));
    // Channels of 8, 16, 32 and 64, by hand: down, up, and to the classes.
    let down = 440 + 1_736 + 1_040 + 6_928 + 4_128 + 27_680 + 16_448 + 110_656;
    let count = pass.parameter_count();
    assert_eq!(count, down + 82_976 + 20_752 + 5_192 + 27);
    assert!(MaterialsArchitecture::Default.passes().iter().all(|other| other.parameter_count() != count), "the control");
}

/// The loss falls: two dozen steps over patches of one phantom are a beginning.
#[test]
fn a_training_learns_what_it_sees() {
    let folder = tempfile::tempdir().expect("a folder");
    phantoms(folder.path(), 3..4);
    let rule = StepRule { learning_rate: 4e-3, ..StepRule::default() };
    let trained = run(&options(folder.path(), "one", MaterialsRecipe { epochs: 3, steps: 8, batch: 1, rule, ..short() }));
    let losses: Vec<f64> = trained.history.iter().map(|record| record.train_loss).collect();
    println!("losses {losses:?}");
    // What learns nothing stays where it was.
    assert!(losses[2] < 0.85 * losses[0], "{losses:?}");
}

/// Bone of the network, of thresholding and of the truth, on phantoms that nothing was trained on.
#[test]
fn the_shipped_network_is_as_good_as_its_figures() {
    let network = LoadedMaterials::shipped(NetworkDevice::default()).expect("it comes with the program");
    let card = network.card();
    let JudgedBy::Siblings { weights_sha256 } = &card.judged_by else { panic!("{:?}", card.judged_by) };
    assert_eq!(weights_sha256.keys().collect::<Vec<_>>(), ["chest", "pelvis"]);
    // Of its share of errors over that of thresholding, in a pelvis and in a chest full of contrast medium; with a tenth of room for weights that
    // are a little worse.
    let share = |figure: &str, of: &str| {
        card.held_out[&format!("{figure} of {of}")] / card.held_out[&format!("threshold {figure} of {of}")]
    };
    for (figure, of, most) in [
        ("error", "pelvis", 0.75),
        ("error from 100 to 400 HU", "pelvis", 0.7),
        ("error within 5 mm of bone", "pelvis", 0.75),
        ("error", "chest", 0.65),
        ("error from 100 to 400 HU", "chest", 0.65),
        ("error within 5 mm of bone", "chest", 0.8),
    ] {
        assert!(share(figure, of) < most, "{figure} of {of}: {}", share(figure, of));
    }
    let files = NetworkFiles::of(&Path::new(env!("CARGO_MANIFEST_DIR")).join("calibration/networks/materials"));
    assert!(std::fs::metadata(&files.weights).expect("there").len() < 4 << 20);
    // Those of the phantoms are its own: made again, they are what the card says.
    let of = |network: &LoadedMaterials, seed: u64| {
        let specimen = phantom(seed, &[], String::new());
        MaterialsFigures::of(&specimen, &network.bone(&specimen.volume(), &mut |_, _, _| {}))
    };
    let each: Vec<MaterialsFigures> = FRESH.map(|seed| of(&network, seed)).collect();
    let figures = each.iter().copied().reduce(MaterialsFigures::and).expect("some").named(" of fresh phantoms");
    assert_eq!(figures.len(), 10);
    for (name, value) in &figures {
        // Another processor rounds otherwise, which moves few voxels across a half.
        assert!((value - card.held_out[name]).abs() < 2e-3, "{name}: {value} {}", card.held_out[name]);
    }
    let doubtful = "error from 100 to 400 HU of fresh phantoms";
    assert!(figures[doubtful] < 0.5 * figures[&format!("threshold {doubtful}")]);
    let (_, mut parameters) = files.read::<MaterialsCard>().expect("it comes with the program");
    parameters.iter_mut().step_by(2).for_each(|value| *value = 0.0);
    let off = of(&LoadedMaterials::new(card.clone(), &parameters, NetworkDevice::default()), FRESH.start);
    let [off, right] = [off, each[0]].map(|figures| figures.named("")["dice bone"]);
    assert!((off - right).abs() > 2e-2, "the control: {off} {right}");
}

/// Seeds of the phantoms that every card has figures of.
const FRESH: std::ops::Range<u64> = 4_000_000_000..4_000_000_006;
