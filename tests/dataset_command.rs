//! `sidecarm dataset scatter`: what networks are trained on.

use std::path::Path;

use sidecarm::learn::Shard;

use crate::log_lab::{sidecarm, text};

fn made(folder: &Path, more: &[&str]) -> (bool, String) {
    let base = ["dataset", "scatter", "--phantoms", "1", "--count", "4", "--histories", "40960", "--out", text(folder)];
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
    let (good, said) = made(folder.path(), &["--first-seed", "150"]);
    assert!(good, "{said}");
    let path = folder.path().join("scatter-000000150.safetensors");
    let shard = Shard::read(&path).expect("readable");
    let samples = shard.seeds.len();
    assert!((2..=4).contains(&samples), "{samples} samples");
    assert!(shard.seeds.iter().all(|seed| (150..154).contains(seed)) && shard.specimens.iter().all(|name| name == "phantom"));
    assert_eq!((shard.inputs.len(), shard.scalars.len()), (samples * 9 * 64 * 48, samples * 6));
    assert_eq!((shard.truth.len(), shard.truth_error.len()), (samples * 2 * 192, samples * 2 * 192));
    assert!(shard.truth.iter().chain(&shard.truth_error).all(|value| *value >= 0.0 && *value < 10.0));
    assert!(shard.truth.iter().sum::<f32>() > 0.0);
    let bytes = std::fs::read(&path).expect("readable");
    let (again, said) = made(folder.path(), &["--first-seed", "150"]);
    assert!(again && std::fs::read(&path).expect("readable") == bytes, "{said}");
    let other = tempfile::tempdir().expect("a folder");
    assert!(made(other.path(), &["--first-seed", "150"]).0);
    // Not `assert_eq`: nobody wants to read all of it.
    assert!(Shard::read(&other.path().join("scatter-000000150.safetensors")).expect("readable") == shard, "a seed is a sample");
    std::fs::write(&path, &bytes[..bytes.len() / 2]).expect("writable");
    let (good, said) = made(folder.path(), &["--first-seed", "150"]);
    assert!(!good && said.contains("scatter-000000150.safetensors") && said.contains("delete it"), "{said}");
    let (good, said) = made(folder.path(), &["--first-seed", "7"]);
    assert!(!good && said.contains("multiple of 50"), "{said}");
    let (good, said) = self::said(&["dataset", "scatter", "--out", text(folder.path())]);
    assert!(!good && said.contains("phantoms"), "{said}");
}
