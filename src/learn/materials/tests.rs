//! Trainings of small passes: what any passes do.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use super::{MaterialsRecipe, TrainedMaterials, phantom, train_materials};
use crate::infer::materials::MaterialsArchitecture;
use crate::infer::{JudgedBy, NetworkFiles};
use crate::learn::{HoldOut, LearnError, StepRule, TrainOptions, TrainingEnd};
use crate::random::{Purpose, Stream};

/// Phantoms of few voxels.
const SEEDS: [u64; 3] = [53, 96, 97];

fn options(folder: &Path, name: &str, recipe: MaterialsRecipe) -> TrainOptions<MaterialsRecipe> {
    TrainOptions::new(folder.join("set"), folder.join(name), recipe)
}

fn short() -> MaterialsRecipe {
    MaterialsRecipe {
        materials: MaterialsArchitecture::Small,
        epochs: 2,
        steps: 1,
        batch: 1,
        hold_out: HoldOut::Nothing,
        fresh_phantoms: 0,
        ..MaterialsRecipe::default()
    }
}

fn run(options: &TrainOptions<MaterialsRecipe>) -> TrainedMaterials {
    train_materials(options, &mut |_| ControlFlow::Continue(())).unwrap_or_else(|error| panic!("{error}"))
}

/// A folder with the phantoms of `seeds`.
fn phantoms(seeds: &[u64]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().expect("a folder");
    std::fs::create_dir(folder.path().join("set")).expect("a folder");
    for seed in seeds {
        let path = folder.path().join(format!("set/materials-phantom-{seed}.safetensors"));
        phantom(*seed, &[], "a test".to_owned()).write(&path).expect("written");
    }
    folder
}

/// A training goes on where it was interrupted and comes to the same, bit for bit; held-out phantoms choose the epoch; siblings lend their figures
/// once they have them.
#[test]
fn a_resumed_training_is_the_straight_one() {
    let folder = phantoms(&SEEDS);
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

    // Of three phantoms one is held out, by a seed that does so, and its loss chooses.
    let share = 0.4;
    let held = |seed: &u64| (0..3).filter(|at| Stream::new(*seed, 0, *at, Purpose::HeldOut).uniform() < share).count();
    let seed = (1..40).find(|seed| held(seed) == 1).expect("a seed that holds out one");
    let mesh = folder.path().join("wedge.stl");
    let hold_out = HoldOut::Seeds { share };
    let recipe = MaterialsRecipe {
        seed,
        epochs: 4,
        hold_out,
        patience: Some(1),
        fresh_phantoms: 1,
        meshes: vec![mesh.clone()],
        ..short()
    };
    let asked = options(folder.path(), "chosen", recipe);
    let missing = train_materials(&asked, &mut |_| ControlFlow::Continue(())).expect_err("no mesh").to_string();
    assert!(missing.contains("wedge.stl"), "{missing}");
    std::fs::write(&mesh, wedge()).expect("written");
    let chosen = run(&asked);
    let losses: Vec<f64> = chosen.history.iter().filter_map(|record| record.held_out).collect();
    assert!(losses.len() == chosen.history.len() && losses.iter().all(|loss| *loss >= losses[chosen.epoch - 1]), "{losses:?}");
    assert_eq!((chosen.card.judged_by, chosen.card.kept_epoch), (JudgedBy::Seeds, chosen.epoch));
    let [plain, meshed] =
        ["", " with meshes"].map(|with| chosen.card.held_out[&format!("threshold error of fresh phantoms{with}")]);
    assert!(plain > 0.0 && meshed > 0.0 && plain != meshed, "other bones: {plain} {meshed}");
    assert!(chosen.card.held_out["dice bone of fresh phantoms"] < 1.0);

    // A mesh that was edited since is another; the same content, written anew, is the one that the training began with.
    let mut begun = options(folder.path(), "begun", MaterialsRecipe { meshes: vec![mesh.clone()], ..short() });
    assert_eq!(stop(&begun).end, TrainingEnd::ByCaller);
    begun.resume = true;
    std::fs::write(&mesh, wedge().replace("60", "61")).expect("written");
    let refused = train_materials(&begun, &mut |_| ControlFlow::Continue(())).expect_err("another mesh");
    assert!(matches!(&refused, LearnError::OtherTraining { what, .. } if what == "meshes_sha256"), "{refused}");
    std::fs::write(&mesh, wedge()).expect("written");
    assert_eq!(run(&begun).history.len(), 2);

    // Where a specimen is held out, one of the two others chooses in its place.
    let hold_out = HoldOut::Specimens { names: vec!["phantom-53".to_owned()] };
    let recipe = MaterialsRecipe { epochs: 4, hold_out, set_aside: 0.4, patience: Some(1), ..short() };
    let aside = run(&options(folder.path(), "aside", recipe.clone()));
    let losses: Vec<f64> = aside.history.iter().filter_map(|record| record.held_out).collect();
    assert!(losses.len() == aside.history.len() && losses.iter().all(|loss| *loss >= losses[aside.epoch - 1]), "{losses:?}");
    assert_eq!((aside.card.set_aside, aside.card.specimens.clone()), (1, vec!["1 phantoms".to_owned()]));
    assert_eq!(aside.card.judged_by, JudgedBy::Specimens { names: vec!["phantom-53".to_owned()] });
    let last = HoldOut::Specimens { names: vec!["phantom-53".to_owned(), "phantom-96".to_owned()] };
    let none = options(folder.path(), "none", MaterialsRecipe { hold_out: last, ..recipe });
    let refused = train_materials(&none, &mut |_| ControlFlow::Continue(())).expect_err("nothing is left").to_string();
    assert!(refused.starts_with("0 samples to train on"), "{refused}");

    let one = |name: &str| {
        let hold_out = HoldOut::Specimens { names: vec![name.to_owned()] };
        MaterialsRecipe { epochs: 1, hold_out, ..short() }
    };
    let names = ["phantom-53", "phantom-96"];
    let paths: Vec<PathBuf> = names.iter().map(|name| folder.path().join(name)).collect();
    let first = run(&options(folder.path(), names[0], one(names[0])));
    let all = |recipe: MaterialsRecipe| TrainOptions { siblings: paths.clone(), ..options(folder.path(), "all", recipe) };
    let whole = MaterialsRecipe { epochs: 1, ..short() };
    let refused = |asked: &TrainOptions<MaterialsRecipe>, words: &str| {
        let error = train_materials(asked, &mut |_| ControlFlow::Continue(())).expect_err("refused").to_string();
        assert!(error.contains(words), "{words}: {error}");
    };
    refused(&all(whole.clone()), names[1]);
    let longer = MaterialsRecipe { epochs: 2, ..one(names[1]) };
    stop(&options(folder.path(), names[1], longer));
    refused(&all(whole.clone()), "its layers, its seed or its epochs are others");
    // As the first, but for its specimen and its figures: another training would say no more of how they are joined.
    let mut second = first.card.clone();
    second.judged_by = JudgedBy::Specimens { names: vec![names[1].to_owned()] };
    second.held_out.values_mut().for_each(|figure| *figure = 1.5 * *figure + 0.01);
    let files = NetworkFiles::of(&folder.path().join("second"));
    std::fs::copy(&first.files.network.weights, &files.weights).expect("copied");
    std::fs::write(&files.card, serde_json::to_vec(&second).expect("JSON")).expect("written");
    let siblings = [names[0], "second"].map(|name| folder.path().join(name)).to_vec();
    let together = run(&TrainOptions { siblings, ..options(folder.path(), "all", whole) });
    let key = "error of phantoms held out";
    let mean = 0.5 * (first.card.held_out[key] + second.held_out[key]);
    assert!((together.card.held_out[key] - mean).abs() < 1e-12);
    assert_eq!(together.card.held_out[&format!("{key} of {}", names[1])], second.held_out[key]);
    assert!(matches!(&together.card.judged_by, JudgedBy::Siblings { weights_sha256 } if weights_sha256.len() == 2));
    assert_eq!(together.card.specimens, ["3 phantoms"]);
    // One that is not at its end has no figures to lend.
    // A training that has no figures of its own is at its end as well as any: its card said that nothing judged it.
    for fresh_phantoms in [1, 0] {
        let whole = MaterialsRecipe { fresh_phantoms, ..short() };
        let name = format!("other-{fresh_phantoms}");
        refused(&TrainOptions { siblings: vec![paths[1].clone()], ..options(folder.path(), &name, whole) }, "not at its end");
    }
}

/// A closed surface: the corner of a cube of 60 mm.
fn wedge() -> String {
    let corners = [[0, 0, 0], [60, 0, 0], [0, 60, 0], [0, 0, 60]];
    let vertex = |at: usize| format!("vertex {} {} {}\n", corners[at][0], corners[at][1], corners[at][2]);
    let facet = |corners: [usize; 3]| {
        let vertices: String = corners.map(vertex).concat();
        format!("facet normal 0 0 0\nouter loop\n{vertices}endloop\nendfacet\n")
    };
    format!("solid wedge\n{}endsolid wedge\n", [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]].map(facet).concat())
}

/// The loss falls: sixty steps over patches of one phantom are a beginning.
#[test]
fn a_training_learns_what_it_sees() {
    let folder = phantoms(&SEEDS[..1]);
    let rule = StepRule { learning_rate: 4e-3, ..StepRule::default() };
    let trained = run(&options(folder.path(), "one", MaterialsRecipe { epochs: 3, steps: 20, batch: 2, rule, ..short() }));
    let losses: Vec<f64> = trained.history.iter().map(|record| record.train_loss).collect();
    println!("losses {losses:?}");
    // What learns nothing stays where it was.
    assert!(losses[2] < 0.85 * losses[0], "{losses:?}");
}
