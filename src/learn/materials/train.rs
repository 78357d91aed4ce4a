//! The training of a materials network.

use std::collections::BTreeMap;
use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

use burn::tensor::Device;
use rayon::prelude::*;
use sha2::{Digest, Sha256};

use super::figures::MaterialsFigures;
use super::loss::Batch;
use super::patch::{Patch, Prepared};
use super::phantom::{PhantomMesh, phantom};
use super::recipe::MaterialsRecipe;
use crate::image::{hex, sha256_bytes, sha256_file, write_atomically};
use crate::infer::materials::{CubeNetwork, LoadedMaterials, MaterialsCard, Pass};
use crate::infer::{JudgedBy, Layer, NetworkCard, NetworkDevice, NetworkFiles, fetched, weights_file};
use crate::learn::adam::Adam;
use crate::learn::checkpoint::State;
use crate::learn::dataset::shuffle;
use crate::learn::epochs::{self, Learner, Pace, slopes_of};
use crate::learn::specimen::LabelledSpecimen;
use crate::learn::train::check_output;
use crate::learn::{HoldOut, LearnError, Progress, TrainFiles, TrainOptions, Trained, TrainingEnd, siblings};
use crate::random::{Purpose, Stream};
use crate::regular;
use crate::reporter::Reporter;

/// Patches of each pass that an epoch is judged by.
const JUDGED_PATCHES: usize = 16;
/// Seed of the first phantom that every network is judged by.
const FRESH_PHANTOMS: u64 = 4_000_000_000;
/// What the card says of the truth.
const TRUTH: &str = "bones of CTs: the labels of their scenes, whoever drew them (often another network), from 100 HU up; of phantoms: exact; \
                     air and lung: by rule, below -700 HU, whoever tells bone, so that no figure counts them";

/// A trained materials network, and its figures by name.
pub type TrainedMaterials = Trained<MaterialsCard, BTreeMap<String, f64>>;

/// Trains a network, tells `told` after every step, and writes the weights with their card, the history and a checkpoint after every epoch; the
/// figures come at the end. When `told` breaks, the unfinished epoch is dropped. The same options and specimens give the same weights to the bit,
/// on the same kind of processor, also when the training was interrupted and resumed.
///
/// # Errors
/// When specimens, options or a checkpoint cannot be used, a file cannot be written, the training diverges, or the device fails.
pub fn train_materials(
    options: &TrainOptions<MaterialsRecipe>,
    told: &mut dyn FnMut(&Progress<'_>) -> ControlFlow<()>,
) -> Result<TrainedMaterials, LearnError> {
    options.recipe.check()?;
    check_output(options)?;
    let paths = &options.recipe.meshes;
    let meshes = paths.iter().map(|path| PhantomMesh::read(path, &Reporter::silent()));
    let meshes: Vec<PhantomMesh> = meshes.collect::<Result<_, _>>().map_err(|error| LearnError::Mesh(Box::new(error)))?;
    let meshes_sha256 = paths.iter().map(|path| sha256_file(path)).collect::<Result<_, _>>()?;
    let recipe = MaterialsRecipe { meshes_sha256, ..options.recipe.clone() };
    let options = &TrainOptions { recipe, ..options.clone() };
    let recipe = &options.recipe;
    let (specimens, samples_sha256) = read(&options.dataset)?;
    let held = held_out(&specimens, &recipe.hold_out, recipe.seed)?;
    let aside = set_aside(&specimens, &held, recipe)?;
    let card = card_of(&specimens, (&held, &aside), recipe, samples_sha256);
    siblings::judge(&mut card.clone(), &options.siblings, false)?;
    let layers = recipe.materials.layers();
    let training = Training::new(options, &specimens, (&held, &aside), card);
    let mut state = if options.resume && training.files.checkpoint.exists() {
        let count = layers.iter().map(Layer::value_count).sum();
        State::read(&training.files.checkpoint, recipe, &training.card.samples_sha256, count)?
    } else {
        State::new(Adam::drawn(&layers, recipe.seed))
    };
    let end = epochs::run(&training, &options.device, &mut state, told)?;
    training.trained((&specimens, &held), &meshes, &state, end)
}

/// The specimens of `folder` by name, and the hash of their files.
fn read(folder: &Path) -> Result<(Vec<LabelledSpecimen>, String), LearnError> {
    let io = |source| LearnError::Io { path: folder.to_owned(), source };
    let mut paths: Vec<PathBuf> = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io)? {
        paths.push(entry.map_err(io)?.path());
    }
    let is_specimen = |name: &str| name.starts_with("materials-") && name.ends_with(".safetensors");
    paths.retain(|path| path.file_name().is_some_and(|name| is_specimen(&name.to_string_lossy())));
    paths.sort();
    if paths.is_empty() {
        return Err(LearnError::NoSpecimens { path: folder.to_owned() });
    }
    let mut hash = Sha256::new();
    let mut specimens: Vec<LabelledSpecimen> = Vec::new();
    for path in &paths {
        let bytes = regular::read(path).map_err(|source| LearnError::Io { path: path.clone(), source })?;
        let specimen = LabelledSpecimen::of_bytes(&bytes, path)?;
        hash.update(&bytes);
        if let Some(other) = specimens.iter().find(|other| other.name == specimen.name || other.hu == specimen.hu) {
            return Err(LearnError::SameSpecimen { path: path.clone(), name: other.name.clone() });
        }
        specimens.push(specimen);
    }
    Ok((specimens, hex(&hash.finalize())))
}

/// Which specimens are held out.
fn held_out(specimens: &[LabelledSpecimen], hold_out: &HoldOut, seed: u64) -> Result<Vec<bool>, LearnError> {
    let held: Vec<bool> = match hold_out {
        HoldOut::Nothing => vec![false; specimens.len()],
        HoldOut::Seeds { share } => {
            let is_held = |index: usize| Stream::new(seed, 0, index as u32, Purpose::HeldOut).uniform() < *share;
            specimens.iter().enumerate().map(|(index, specimen)| specimen.is_phantom && is_held(index)).collect()
        }
        HoldOut::Specimens { names } => {
            if let Some(name) = names.iter().find(|name| specimens.iter().all(|specimen| specimen.name != **name)) {
                let known = specimens.iter().map(|specimen| specimen.name.clone()).collect();
                return Err(LearnError::UnknownSpecimen { name: name.clone(), known });
            }
            specimens.iter().map(|specimen| names.contains(&specimen.name)).collect()
        }
    };
    let count = held.iter().filter(|held| **held).count();
    let nothing_to_judge_by = *hold_out != HoldOut::Nothing && count == 0;
    if count == specimens.len() || (nothing_to_judge_by && !matches!(hold_out, HoldOut::Seeds { .. })) {
        return Err(LearnError::Split { train: specimens.len() - count, held_out: count });
    }
    Ok(held)
}

/// Which phantoms of those not held out choose the epoch in their place.
fn set_aside(specimens: &[LabelledSpecimen], held: &[bool], recipe: &MaterialsRecipe) -> Result<Vec<bool>, LearnError> {
    let mut aside = vec![false; specimens.len()];
    if !(recipe.set_aside > 0.0) {
        return Ok(aside);
    }
    let is_phantom = |index: &usize| specimens[*index].is_phantom && !held[*index];
    let mut phantoms: Vec<usize> = (0..specimens.len()).filter(is_phantom).collect();
    shuffle(&mut phantoms, &mut Stream::new(recipe.seed, 2, 0, Purpose::HeldOut));
    phantoms.truncate((phantoms.len() as f64 * recipe.set_aside).ceil() as usize);
    if phantoms.is_empty() {
        let (setting, expected) = ("number of phantoms that can choose the epoch", "at least 1, or no patience");
        return Err(LearnError::Setting { setting, expected, found: "0".to_owned() });
    }
    phantoms.iter().for_each(|index| aside[*index] = true);
    if held.iter().zip(&aside).all(|(held, aside)| *held || *aside) {
        return Err(LearnError::Split { train: 0, held_out: specimens.len() });
    }
    Ok(aside)
}

fn card_of(
    specimens: &[LabelledSpecimen],
    (held, aside): (&[bool], &[bool]),
    recipe: &MaterialsRecipe,
    samples_sha256: String,
) -> MaterialsCard {
    let is_trained: Vec<bool> = held.iter().zip(aside).map(|(held, aside)| !held && !aside).collect();
    let trained = || specimens.iter().zip(&is_trained).filter(|(_, is_trained)| **is_trained).map(|(specimen, _)| specimen);
    let mut names: Vec<String> = trained().filter(|one| !one.is_phantom).map(|one| one.name.clone()).collect();
    names.sort();
    let phantoms = trained().filter(|one| one.is_phantom).count();
    if phantoms > 0 {
        names.push(format!("{phantoms} phantoms"));
    }
    let spacings = || trained().flat_map(|specimen| specimen.grid.spacing_mm());
    let of_held = || specimens.iter().zip(held).filter(|(_, held)| **held).map(|(specimen, _)| specimen.name.clone());
    MaterialsCard {
        materials: recipe.materials,
        weights_sha256: String::new(),
        training_seed: recipe.seed,
        training_epochs: recipe.epochs,
        kept_epoch: 0,
        training_steps: recipe.steps,
        training_batch: recipe.batch,
        training_devices: Vec::new(),
        set_aside: aside.iter().filter(|aside| **aside).count(),
        specimens: names,
        truth: TRUTH.to_owned(),
        samples_sha256,
        spacing_bounds_mm: [spacings().fold(f64::INFINITY, f64::min), spacings().fold(0.0, f64::max)],
        judged_by: match &recipe.hold_out {
            HoldOut::Specimens { .. } => JudgedBy::Specimens { names: of_held().collect() },
            HoldOut::Seeds { .. } if held.iter().any(|held| *held) => JudgedBy::Seeds,
            HoldOut::Seeds { .. } | HoldOut::Nothing => JudgedBy::Nothing,
        },
        held_out: BTreeMap::new(),
    }
}

/// What does not change from epoch to epoch.
struct Training<'a> {
    options: &'a TrainOptions<MaterialsRecipe>,
    recipe: &'a MaterialsRecipe,
    passes: &'static [Pass],
    /// CTs and phantoms trained on, as each pass sees them.
    trained: [Vec<Vec<Prepared>>; 2],
    /// Patches of what was set aside, else of what was held out, of each pass.
    judged: Vec<Vec<Patch>>,
    card: MaterialsCard,
    files: TrainFiles,
}

impl<'a> Training<'a> {
    fn new(
        options: &'a TrainOptions<MaterialsRecipe>,
        specimens: &[LabelledSpecimen],
        (held, aside): (&[bool], &[bool]),
        card: MaterialsCard,
    ) -> Self {
        let recipe = &options.recipe;
        let passes = recipe.materials.passes();
        let prepared = |specimen: &LabelledSpecimen| passes.iter().map(|pass| Prepared::new(specimen, pass)).collect::<Vec<_>>();
        let (mut trained, mut judging) = ([Vec::new(), Vec::new()], Vec::new());
        let judges = if aside.contains(&true) { aside } else { held };
        for (index, specimen) in specimens.iter().enumerate() {
            if judges[index] {
                judging.push(prepared(specimen));
            } else if !held[index] {
                trained[usize::from(specimen.is_phantom)].push(prepared(specimen));
            }
        }
        let judged = passes.iter().enumerate().map(|(place, pass)| {
            let count = if judging.is_empty() { 0 } else { JUDGED_PATCHES };
            let patch = |number: usize| {
                let mut stream = Stream::new(recipe.seed, 1, (number * passes.len() + place) as u32, Purpose::HeldOut);
                judging[number % judging.len()][place].patch(pass, &mut stream, false)
            };
            (0..count).map(patch).collect()
        });
        Self { judged: judged.collect(), files: TrainFiles::of(&options.output), options, recipe, passes, trained, card }
    }

    /// Patch `number` of an epoch, of the pass at `place`.
    fn patch(&self, epoch: usize, number: usize, place: usize) -> Patch {
        // The same specimen for all passes, each with its own place in it.
        let mut stream = Stream::new(self.recipe.seed, epoch as u32, (number * (self.passes.len() + 1)) as u32, Purpose::Epoch);
        let of_phantom = stream.uniform() < self.recipe.phantoms;
        let [cts, phantoms] = &self.trained;
        let from = if cts.is_empty() || (of_phantom && !phantoms.is_empty()) { phantoms } else { cts };
        let specimen = &from[(stream.uniform() * from.len() as f64) as usize];
        let stream_of_pass = (number * (self.passes.len() + 1) + place + 1) as u32;
        let mut stream = Stream::new(self.recipe.seed, epoch as u32, stream_of_pass, Purpose::Epoch);
        specimen[place].patch(&self.passes[place], &mut stream, true)
    }

    /// The networks of the passes.
    fn networks(&self, parameters: &[f32], device: &Device) -> Vec<CubeNetwork> {
        let mut rest = parameters;
        let network = |pass: &Pass| {
            let (own, behind) = rest.split_at(pass.parameter_count());
            rest = behind;
            CubeNetwork::new(pass, own, device).expect("parameters were drawn or read for these layers")
        };
        self.passes.iter().map(network).collect()
    }

    /// Writes the best parameters of `state`, then their card with `figures`: until it is there too, a reader meets a checksum that disagrees.
    /// `is_last`: they are what the training comes to.
    fn written(&self, state: &State, figures: BTreeMap<String, f64>, is_last: bool) -> Result<MaterialsCard, LearnError> {
        let Some((kept_epoch, parameters)) = &state.best else { return Err(LearnError::StoppedTooSoon) };
        let training_devices = state.devices.clone();
        let mut card = MaterialsCard { held_out: figures, kept_epoch: *kept_epoch, training_devices, ..self.card.clone() };
        let weights = weights_file(&card.layers(), parameters).map_err(LearnError::Encode)?;
        card.weights_sha256 = sha256_bytes(&weights);
        siblings::judge(&mut card, &self.options.siblings, is_last)?;
        let NetworkFiles { weights: weights_path, card: card_path } = &self.files.network;
        write_atomically(weights_path, |file| file.write_all(&weights))?;
        write_atomically(card_path, |file| Ok(serde_json::to_writer_pretty(file, &card)?))?;
        Ok(card)
    }

    fn trained(
        &self,
        (specimens, held): (&[LabelledSpecimen], &[bool]),
        meshes: &[PhantomMesh],
        state: &State,
        end: TrainingEnd,
    ) -> Result<TrainedMaterials, LearnError> {
        let Some((epoch, parameters)) = &state.best else { return Err(LearnError::StoppedTooSoon) };
        let figures = if end == TrainingEnd::ByCaller {
            BTreeMap::new()
        } else {
            let network = LoadedMaterials::new(self.card.clone(), parameters, NetworkDevice::default());
            let held_out = specimens.iter().zip(held).filter(|(_, held)| **held).map(|(specimen, _)| specimen);
            figures_of(&network, held_out, self.recipe.fresh_phantoms, meshes)
        };
        let card = self.written(state, figures.clone(), end != TrainingEnd::ByCaller)?;
        Ok(Trained { card, files: self.files.clone(), epoch: *epoch, held_out: figures, history: state.history.clone(), end })
    }
}

/// Figures of all of `held_out`, of each CT among them, of its phantoms, and of phantoms that no training sees: of simple shapes, and with bones of
/// `meshes` where there are any.
fn figures_of<'a>(
    network: &LoadedMaterials,
    held_out: impl Iterator<Item = &'a LabelledSpecimen>,
    fresh_phantoms: u64,
    meshes: &[PhantomMesh],
) -> BTreeMap<String, f64> {
    let of = |specimen: &LabelledSpecimen| MaterialsFigures::of(specimen, &network.bone(&specimen.volume(), &mut |_, _, _| {}));
    let (mut figures, mut all, mut phantoms) = (BTreeMap::new(), None, None);
    let and = |sum: &mut Option<MaterialsFigures>, found: MaterialsFigures| {
        *sum = Some(sum.map_or(found, |sum| sum.and(found)));
    };
    let (mut cts, mut held) = (0, 0);
    for specimen in held_out {
        let found = of(specimen);
        held += 1;
        and(&mut all, found);
        if specimen.is_phantom {
            and(&mut phantoms, found);
        } else {
            cts += 1;
            figures.extend(found.named(&format!(" of {}", specimen.name)));
        }
    }
    // Of one CT alone all are its own.
    if cts == 1 && held == 1 {
        figures.clear();
    }
    figures.extend(all.iter().flat_map(|all| all.named("")));
    figures.extend(phantoms.iter().flat_map(|phantoms| phantoms.named(" of phantoms held out")));
    let kinds: [(&[PhantomMesh], &str); 2] = [(&[], " of fresh phantoms"), (meshes, " of fresh phantoms with meshes")];
    for (bones, name) in kinds.into_iter().take(if meshes.is_empty() { 1 } else { 2 }) {
        let fresh = (0..fresh_phantoms).map(|number| of(&phantom(FRESH_PHANTOMS + number, bones, String::new())));
        let fresh = fresh.reduce(MaterialsFigures::and);
        figures.extend(fresh.iter().flat_map(|fresh| fresh.named(name)));
    }
    figures
}

impl Learner for Training<'_> {
    type Found = ();
    /// Of each pass.
    type Drawn = Vec<Vec<Patch>>;

    fn pace(&self) -> Pace {
        let MaterialsRecipe { epochs, batch, rule, hold_out, set_aside, patience, .. } = self.recipe;
        let chooses = (hold_out.chooses() || *set_aside > 0.0) && self.judged.iter().all(|patches| !patches.is_empty());
        Pace { epochs: *epochs, batch: *batch, rule: rule.clone(), chooses, patience: *patience }
    }

    fn order(&self, _: usize) -> Vec<usize> {
        (0..self.recipe.steps * self.recipe.batch).collect()
    }

    fn draw(&self, epoch: usize, chosen: &[usize]) -> Vec<Vec<Patch>> {
        let of_pass = |place: usize| chosen.par_iter().map(|number| self.patch(epoch, *number, place)).collect();
        (0..self.passes.len()).into_par_iter().map(of_pass).collect()
    }

    fn slopes(&self, drawn: Vec<Vec<Patch>>, parameters: &[f32], device: &Device) -> Result<(f64, Vec<f32>), String> {
        let (mut losses, mut slopes) = (0.0, Vec::new());
        for ((pass, patches), network) in self.passes.iter().zip(&drawn).zip(&self.networks(parameters, device)) {
            let loss = Batch::new(patches, pass, device).loss(network);
            let (loss, of_pass) = slopes_of(&loss, network.layers())?;
            slopes.extend(of_pass);
            losses += loss;
        }
        Ok((losses / self.passes.len() as f64, slopes))
    }

    fn judge(&self, parameters: &[f32], device: &Device) -> Result<([Option<f64>; 2], ()), String> {
        let networks = self.networks(parameters, device);
        let (mut losses, mut count) = (0.0, 0.0);
        for ((pass, patches), network) in self.passes.iter().zip(&self.judged).zip(&networks) {
            for some in patches.chunks(self.recipe.batch) {
                let loss = fetched(Batch::new(some, pass, device).loss(network))?;
                losses += f64::from(loss[0]) * some.len() as f64;
                count += some.len() as f64;
            }
        }
        // Without patches it is 0/0.
        let loss = Some(losses / count).filter(|loss| loss.is_finite());
        Ok(([loss, loss], ()))
    }

    fn write_network(&self, state: &State, _: &Self::Found) -> Result<(), LearnError> {
        // Figures cost minutes: they come at the end.
        self.written(state, BTreeMap::new(), false).map(drop)
    }

    fn files(&self) -> &TrainFiles {
        &self.files
    }

    fn keep(&self, state: &State) -> Result<(), LearnError> {
        state.write(&self.files.checkpoint, self.options, &self.card.samples_sha256)
    }
}
