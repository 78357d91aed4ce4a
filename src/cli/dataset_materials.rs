//! `sidecarm dataset materials`: labelled CTs and phantoms, as a materials network is trained on them.

use std::path::{Path, PathBuf};

use super::dataset_error::DatasetError;
use crate::image::sha256_file;
use crate::learn::LabelledSpecimen;
use crate::learn::materials::{PhantomMesh, phantom};
use crate::reporter::Reporter;
use crate::scene;

/// Labelled CTs, and phantoms whose truth is exact.
#[derive(Clone, Debug, clap::Args)]
#[command(after_help = "Examples:
  sidecarm dataset materials pelvis.json chest.json --phantoms 40 --mesh femur.stl --out materials-set
  sidecarm dataset materials --phantoms 40 --out materials-set

Of each scene the CTs are taken whose \"materials\" are labels with a map (\"map\": \"totalsegmentator\" for one): bone is what the map says is bone.
Phantoms are bones of the meshes and of simple shapes in soft tissue, with contrast medium, chalk, screws and beads, as a CT sees them. Each becomes
one file, materials-NAME.safetensors; those that are there already are kept.")]
pub struct MaterialsSetArgs {
    /// Scenes with labelled CTs; a specimen is named by its scene's file
    #[arg(value_name = "SCENE.json")]
    scenes: Vec<PathBuf>,
    /// Where the files go
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Phantoms
    #[arg(long, value_name = "N", default_value_t = 40)]
    phantoms: u64,
    /// Seed of the first phantom
    #[arg(long, value_name = "SEED", default_value_t = 0)]
    first_seed: u64,
    /// A closed surface of a bone, in mm (repeatable)
    #[arg(long, value_name = "FILE.stl")]
    mesh: Vec<PathBuf>,
}

/// Makes what is asked for; 0 on success.
pub(super) fn materials_set(args: &MaterialsSetArgs, reporter: &Reporter) -> Result<u8, DatasetError> {
    let wrong = |what: String| Err(DatasetError::Arguments(what));
    if args.scenes.is_empty() && args.phantoms == 0 {
        return wrong("neither a scene nor a phantom: give SCENE.json, or --phantoms N".to_owned());
    }
    let Some(end) = args.first_seed.checked_add(args.phantoms) else {
        return wrong(format!("--first-seed {}: there are no {} seeds after it", args.first_seed, args.phantoms));
    };
    std::fs::create_dir_all(&args.out).map_err(|source| DatasetError::Io { path: args.out.clone(), source })?;
    let version = env!("CARGO_PKG_VERSION");
    let progress = reporter.progress("specimens", args.scenes.len() as u64 + args.phantoms);
    let mut counts = [0, 0];
    for path in &args.scenes {
        let name = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
        let file = |number: usize| {
            let name = if number == 0 { name.clone() } else { format!("{name}-{number}") };
            (args.out.join(format!("materials-{name}.safetensors")), name)
        };
        let (found, inputs) = scene::load_labelled(path, reporter)?;
        if found.is_empty() {
            return wrong(format!("{}: none of its objects is a CT whose materials are labels", path.display()));
        }
        let hashes: Vec<String> = inputs.iter().map(|input| input.sha256.clone()).collect();
        let origin = serde_json::json!({"sha256": hashes, "version": version}).to_string();
        for (number, labelled) in found.iter().enumerate() {
            let (path, name) = file(number);
            let specimen = LabelledSpecimen::of_ct(&name, labelled, origin.clone())?;
            counts[usize::from(keep_or_write(&specimen, &path)?)] += 1;
        }
        progress.advance(1);
    }
    let mut meshes = Vec::new();
    let mut hashes = Vec::new();
    for path in &args.mesh {
        meshes.push(PhantomMesh::read(path, reporter)?);
        hashes.push(sha256_file(path)?);
    }
    let origin = serde_json::json!({"sha256": hashes, "version": version}).to_string();
    for seed in args.first_seed..end {
        let path = args.out.join(format!("materials-phantom-{seed}.safetensors"));
        // A file that is there is of this seed, or of other meshes.
        if path.is_file() {
            let there = LabelledSpecimen::read(&path)?;
            if there.origin != origin {
                return wrong(format!(
                    "{}: was made otherwise ({}, now {origin}); take another folder",
                    path.display(),
                    there.origin
                ));
            }
            counts[0] += 1;
        } else {
            phantom(seed, &meshes, origin.clone()).write(&path)?;
            counts[1] += 1;
        }
        progress.advance(1);
    }
    drop(progress);
    println!("{}: {} specimens made, {} were there", args.out.display(), counts[1], counts[0]);
    Ok(0)
}

/// Writes it; `false` where the very same is there.
fn keep_or_write(specimen: &LabelledSpecimen, path: &Path) -> Result<bool, DatasetError> {
    if !path.is_file() {
        specimen.write(path)?;
        return Ok(true);
    }
    if LabelledSpecimen::read(path)? == *specimen {
        return Ok(false);
    }
    Err(DatasetError::Arguments(format!("{}: is of another CT or of other labels; take another folder", path.display())))
}
