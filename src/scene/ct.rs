//! A CT of a scene file becomes matter.

use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use super::SceneError;
use super::builder::Builder;
use super::hounsfield::{self, Heard};
use super::inpaint::{Ball, inpaint_labels, inpaint_metal};
use super::label_names::{LabelNames, preset_material};
use super::matter::{self, Air, Class, Classes, Labelled};
use super::model::{LabelledBody, Matter};
#[cfg(feature = "learn")]
use super::network_bone::BoneNetwork;
use super::object_file::{AirFile, BODY, CtFile, DensityFile, ElseFile, LabelMaterialFile, LabelsFile, MapFile, MaterialsFile};
use super::physics::Material;
use super::volumes::VolumeFile;
use crate::foreign::read_small_text;
#[cfg(feature = "learn")]
use crate::image::sha256_file;
#[cfg(feature = "learn")]
use crate::infer::NetworkFiles;

/// Matter without bone of which more than this is remarkable.
const SPECIMEN_MM3: f64 = 1e5;
/// What a threshold takes for bone.
const BONE: &str = "bone_cortical";
/// The network that comes with the program.
#[cfg(feature = "learn")]
const SHIPPED_BONE: &str = "calibration/networks/materials.safetensors";
/// Beyond any metal: tantalum is 60 000 to 100 000 HU on an extended scale.
const MOST_HU: f32 = 2e5;

/// A CT whose labels say what is bone.
#[derive(Clone, Debug)]
pub struct LabelledCt {
    /// The CT.
    pub ct: VolumeFile,
    /// Label of each voxel.
    pub labels: Vec<u32>,
    /// Labels of bones, ascending.
    pub bone_labels: Vec<u32>,
}

impl Builder<'_> {
    /// A CT without the metal of the beads that come after it, `balls`.
    pub fn ct(&mut self, file: &CtFile, balls: &[Ball]) -> Result<Matter, SceneError> {
        let source = self.find_volume("path", &file.path)?;
        let path = source.path().to_owned();
        let mut ct = source.read_voxels(self.reporter)?;
        let Heard { highest_hu, doubts, note } = hounsfield::heard(&ct);
        for (kind, words) in doubts {
            self.reporter.warn(kind, format_args!("{}: {words}", path.display()));
        }
        if let Some(words) = note {
            self.reporter.note(format_args!("{}: {words}", path.display()));
        }
        if !(highest_hu <= MOST_HU) {
            return Err(self.value(
                "path",
                format!("a CT with {highest_hu:.3e} HU"),
                "at most 200000 HU, twice the densest metal",
            ));
        }
        let inpainted = self.without_beads(&mut ct, balls);
        // Labels say what it is.
        if !matches!(file.materials, MaterialsFile::Labels(_))
            && let Some(words) = hounsfield::metal(&ct.values)
        {
            self.reporter.note(format_args!("{}: {words}", path.display()));
        }
        // Materials are numbered apart first: only those that have voxels enter the scene.
        let mut local = Vec::new();
        let air = match file.air {
            AirFile::Keep => Air::Keep(self.local_class(&mut local, "air", "air", DensityFile::Hu)?),
            AirFile::Drop => Air::Drop,
            AirFile::Ambient => Air::DropAmbient,
        };
        let classes = match &file.materials {
            MaterialsFile::Threshold => self.threshold_classes(&mut local)?,
            MaterialsFile::Labels(labels) => self.labels(&mut local, file, labels, &path, &ct, &inpainted)?,
            MaterialsFile::Network(name) => {
                let seen = self.seen_bone(name.as_deref(), &path, &ct)?;
                Classes { seen_bone: Some(seen), ..self.threshold_classes(&mut local)? }
            }
        };
        let (mut volume, order, doubtful_slices) = matter::from_ct(&self.files.place(&self.key), ct, &classes, air)?;
        if order.is_empty() {
            self.reporter.warn("empty CT", format_args!("{}: no voxel is matter: everything is air", path.display()));
        }
        let is_bone = |class: &Class| local[class.material].name == BONE;
        let matter_mm3 = || {
            let voxels = volume.class.iter().filter(|class| **class != 0).count();
            voxels as f64 * volume.lps_from_voxel.matrix3.determinant().abs()
        };
        if !matches!(file.materials, MaterialsFile::Labels(_)) && !order.iter().any(is_bone) && matter_mm3() > SPECIMEN_MM3 {
            let words =
                if file.materials == MaterialsFile::Threshold { "is dense enough for" } else { "looks to the network like" };
            self.reporter.note(format_args!("{}: no voxel {words} bone", path.display()));
        }
        if doubtful_slices > 0 {
            let words = format!(
                "{}: in {doubtful_slices} axial slices lung or foam reaches the border of the scan and counts as room air; crop \
                 wider, or name it by labels",
                path.display()
            );
            self.reporter.warn("open lung", words);
        }
        let mut index_of: HashMap<usize, usize> = HashMap::new();
        for class in &order {
            let index = self.scene.material_index(local[class.material].clone());
            index_of.insert(class.material, index);
        }
        volume.class_materials = order.iter().map(|class| index_of[&class.material]).collect();
        Ok(Matter::Volume(Arc::new(volume)))
    }

    /// The CT of `file`, the labels of its voxels, what they are called, and which of them are bone; `None` where it names no labels.
    pub fn labelled_ct(&mut self, file: &CtFile) -> Result<Option<LabelledCt>, SceneError> {
        let MaterialsFile::Labels(of_labels) = &file.materials else { return Ok(None) };
        let source = self.find_volume("path", &file.path)?;
        let path = source.path().to_owned();
        let ct = source.read_voxels(self.reporter)?;
        let (_, names, labels) = self.read_labels(of_labels, (&path, &ct))?;
        let mut local = Vec::new();
        let map = self.label_map(&mut local, of_labels, &names)?;
        let is_bone = |class: &Option<Class>| class.is_some_and(|class| local[class.material].name.starts_with("bone"));
        let bone_labels = map.iter().filter(|(_, class)| is_bone(class)).map(|(label, _)| *label).collect();
        Ok(Some(LabelledCt { ct, labels, bone_labels }))
    }

    /// Takes the metal of `balls` out of the CT and says so; the voxels that changed, ascending.
    fn without_beads(&self, ct: &mut VolumeFile, balls: &[Ball]) -> Vec<usize> {
        let grid = ct.grid();
        let inpainted = inpaint_metal(&grid, &mut ct.values, balls);
        if inpainted.balls > 0 {
            self.reporter.note(format_args!(
                "{}: {} of {} beads that the scene draws are metal in the CT too: replaced there by what surrounds them ({} voxels, \
                 halo up to {:.1} mm)",
                self.files.place(&self.key),
                inpainted.balls,
                balls.len(),
                inpainted.voxels.len(),
                inpainted.halo_mm
            ));
        }
        inpainted.voxels
    }

    fn threshold_classes(&self, local: &mut Vec<Material>) -> Result<Classes, SceneError> {
        Ok(Classes {
            soft_tissue: Some(self.local_class(local, "materials", "soft_tissue", DensityFile::Hu)?),
            bone: Some(self.local_class(local, "materials", BONE, DensityFile::Hu)?),
            seen_bone: None,
            labelled: None,
        })
    }

    /// Which voxels the network `name` says are bone, or the one that comes with the program.
    #[cfg(feature = "learn")]
    fn seen_bone(&mut self, name: Option<&str>, path: &Path, ct: &VolumeFile) -> Result<Vec<bool>, SceneError> {
        let own = match name {
            None => None,
            Some(name) if !name.ends_with(".safetensors") => {
                let expected = "the weights, NAME.safetensors, with NAME.json beside them";
                return Err(self.value("materials.network", format!("'{name}'"), expected));
            }
            Some(name) => match self.find("materials.network", name) {
                Ok(weights) => Some(weights),
                Err(SceneError::Missing { .. }) if name == SHIPPED_BONE => None,
                Err(missing) => return Err(missing),
            },
        };
        let network = BoneNetwork::open(own.as_deref());
        let network =
            network.map_err(|source| SceneError::Network { place: self.place("materials"), source: Box::new(source) })?;
        match &own {
            None => self.files.remember(SHIPPED_BONE, network.sha256().to_owned(), None),
            // Its card, which lies beside the weights, is an input too.
            Some(weights) => {
                let card = NetworkFiles::of(weights).card;
                if let (Ok(sha256), Some(name)) = (sha256_file(&card), card.file_name()) {
                    self.files.remember(&name.to_string_lossy(), sha256, Some(&card));
                }
            }
        }
        let name = path.file_name().map_or_else(|| path.display().to_string(), |name| name.to_string_lossy().into_owned());
        let refused = |detail| SceneError::Volume { path: path.to_owned(), detail };
        let (bone, sha256) = network.bone(ct, &name, self.reporter).map_err(refused)?;
        // Another processor may round otherwise: whoever compares two images shall see it.
        self.files.remember(&format!("bone of {}", self.key), sha256, None);
        Ok(bone)
    }

    /// Nobody says it in this build.
    #[cfg(not(feature = "learn"))]
    fn seen_bone(&mut self, _: Option<&str>, _: &Path, _: &VolumeFile) -> Result<Vec<bool>, SceneError> {
        let detail = "\"network\" needs the feature `learn`, which this program was built without".to_owned();
        Err(SceneError::Keys { place: self.place("materials"), detail })
    }

    /// Classes by the labels of `file`, and the bodies that it makes of them.
    fn labels(
        &mut self,
        local: &mut Vec<Material>,
        of: &CtFile,
        file: &LabelsFile,
        path: &Path,
        ct: &VolumeFile,
        inpainted: &[usize],
    ) -> Result<Classes, SceneError> {
        let (labels_path, names, mut numbers) = self.read_labels(file, (path, ct))?;
        inpaint_labels(&ct.grid(), &mut numbers, inpainted);
        self.labelled_bodies(of.body.as_deref().unwrap_or(BODY), file, &names, &numbers)?;
        let mut classes = match (file.otherwise, &file.default) {
            (Some(ElseFile::Threshold), None) => self.threshold_classes(local)?,
            (Some(ElseFile::Network), None) => {
                let seen = self.seen_bone(None, path, ct)?;
                Classes { seen_bone: Some(seen), ..self.threshold_classes(local)? }
            }
            (Some(_), Some(_)) => {
                let detail = "default and else both say what the other labels are; leave one out".to_owned();
                return Err(SceneError::Keys { place: self.place("materials"), detail });
            }
            (None, default) => {
                let name = default.as_deref().unwrap_or("soft_tissue");
                let default = self.local_class(local, "materials.default", name, DensityFile::Hu)?;
                let default = (local[default.material].name != "air").then_some(default);
                Classes { soft_tissue: default, bone: default, seen_bone: None, labelled: None }
            }
        };
        let map = self.label_map(local, file, &names)?;
        if map.is_empty() && file.otherwise.is_none() {
            let words = format!(
                "{}: no label is given a material, so that bone is {} too; add a map, \"map\": \"totalsegmentator\", or \"else\": \
                 \"threshold\" or \"network\"",
                labels_path.display(),
                file.default.as_deref().unwrap_or("soft_tissue")
            );
            self.reporter.warn("labels", words);
        }
        if file.preset.is_none() && matches!(file.map, MapFile::Own(_)) {
            self.warn_of_absent(&labels_path, &map, &numbers);
        }
        classes.labelled = Some(Labelled { numbers, map });
        Ok(classes)
    }

    /// The label volume of `file`: where it is, what its labels are called, and the label of each voxel of the CT.
    fn read_labels(
        &mut self,
        file: &LabelsFile,
        ct: (&Path, &VolumeFile),
    ) -> Result<(PathBuf, LabelNames, Vec<u32>), SceneError> {
        let source = self.find_volume("materials.labels", &file.labels)?;
        let path = source.path().to_owned();
        let grid = source.read_voxels(self.reporter)?;
        let names = self.names(file, &grid.label_names)?;
        let numbers = matter::labels_on_grid(ct, (&path, grid))?;
        Ok((path, names, numbers))
    }

    /// What the labels are called: by the file that the scene names, by the label volume itself, or by `label-names.csv` beside it.
    fn names(&mut self, file: &LabelsFile, own: &[(u32, String)]) -> Result<LabelNames, SceneError> {
        let beside = Path::new(&file.labels).with_file_name("label-names.csv").display().to_string();
        let (name, path): (&str, Option<PathBuf>) = match &file.names {
            Some(name) => (name, Some(self.find("materials.names", name)?)),
            None if !own.is_empty() => return Ok(LabelNames::new(&file.labels, own.to_vec())),
            None => match self.find("materials.labels", &beside) {
                Err(SceneError::Missing { .. }) => (&beside, None),
                found => (&beside, Some(found?)),
            },
        };
        let Some(path) = path else { return Ok(LabelNames::new(&file.labels, Vec::new())) };
        let text = read_small_text(&path).map_err(|source| SceneError::Io { path: path.clone(), source })?;
        LabelNames::from_csv(name, &text).map_err(|detail| SceneError::Keys { place: path.display().to_string(), detail })
    }

    /// Finds the voxels of the bodies that `file` makes of labels; `own` is that of all other voxels.
    fn labelled_bodies(&mut self, own: &str, file: &LabelsFile, names: &LabelNames, numbers: &[u32]) -> Result<(), SceneError> {
        let mut taken: HashMap<u32, &str> = HashMap::new();
        for (name, labels) in &file.bodies {
            let key = format!("materials.bodies.{name}");
            if name == own {
                let expected = "another name than that of the CT's other voxels (its \"body\")";
                return Err(self.value(&key, format!("the body '{name}'"), expected));
            }
            let labels = labels.iter().map(|label| self.label(&key, &label.0, names)).collect::<Result<Vec<u32>, _>>()?;
            if let Some((label, other)) = labels.iter().find_map(|label| taken.insert(*label, name).map(|other| (label, other))) {
                return Err(self.value(&key, format!("label {label}, which {other} has"), "each label once"));
            }
            let voxels: Vec<usize> = (0..numbers.len()).filter(|index| labels.contains(&numbers[*index])).collect();
            if voxels.is_empty() {
                return Err(self.value(
                    &key,
                    format!("labels {labels:?} without any voxel"),
                    "labels that the label volume holds",
                ));
            }
            let body = LabelledBody { name: name.clone(), object: self.key.clone(), voxels, filling: OnceLock::new() };
            self.scene.bodies.labelled.push(Arc::new(body));
        }
        Ok(())
    }

    /// The number of the label that `text` names, or is.
    fn label(&self, key: &str, text: &str, names: &LabelNames) -> Result<u32, SceneError> {
        names.number(text).map_err(|expected| self.value(key, format!("the label '{text}'"), &expected))
    }

    /// Class per label, ascending; `None` is air.
    fn label_map(
        &self,
        local: &mut Vec<Material>,
        file: &LabelsFile,
        names: &LabelNames,
    ) -> Result<Vec<(u32, Option<Class>)>, SceneError> {
        let mut entries: Vec<(u32, String, LabelMaterialFile)> = Vec::new();
        let (preset, own) = match (&file.map, file.preset) {
            (MapFile::Own(own), preset) => (preset, Some(own)),
            (MapFile::Preset(preset), _) => (Some(*preset), None),
        };
        for (label, entry) in own.into_iter().flatten() {
            let key = format!("materials.map.{label}");
            entries.push((self.label(&key, label, names)?, key, entry.clone()));
        }
        if let Some(preset) = preset {
            let known = names.iter().filter_map(|(number, name)| Some((number, name, preset_material(preset, name)?)));
            let added: Vec<_> = known
                .filter(|(number, ..)| entries.iter().all(|(own, ..)| own != number))
                .map(|(number, name, material)| {
                    let entry = LabelMaterialFile { material: material.to_owned(), density: DensityFile::Hu };
                    (number, format!("materials.map.{name}"), entry)
                })
                .collect();
            if added.is_empty() {
                let found = format!("a preset, but no label of {} has a name that it knows", file.labels);
                let expected =
                    "names in the label volume's own table, in label-names.csv beside it, or in a file that \"names\" says";
                return Err(self.value("materials.map", found, expected));
            }
            entries.extend(added);
        }
        let mut map = Vec::with_capacity(entries.len());
        for (number, key, entry) in &entries {
            let class = self.local_class(local, key, &entry.material, entry.density)?;
            map.push((*number, (local[class.material].name != "air").then_some(class)));
        }
        map.sort_by_key(|(number, _)| *number);
        if let Some(pair) = map.windows(2).find(|pair| pair[0].0 == pair[1].0) {
            return Err(self.value("materials.map", format!("label {} twice", pair[0].0), "each label once"));
        }
        Ok(map)
    }

    /// Labels that are named but that no voxel has: another file's numbers?
    fn warn_of_absent(&self, path: &Path, map: &[(u32, Option<Class>)], numbers: &[u32]) {
        let held: std::collections::HashSet<u32> = numbers.iter().copied().collect();
        let absent: Vec<String> =
            map.iter().filter(|(number, _)| !held.contains(number)).map(|(number, _)| number.to_string()).collect();
        if !absent.is_empty() {
            let (labels, absent) = (path.display(), absent.join(", "));
            let words = format!("{labels}: no voxel has the labels {absent} that materials.map names; are they another file's?");
            self.reporter.warn("labels", words);
        }
    }

    fn local_class(&self, local: &mut Vec<Material>, key: &str, name: &str, density: DensityFile) -> Result<Class, SceneError> {
        let material = self.material(key, name)?;
        let density_g_per_cm3 = match density {
            DensityFile::Hu => None,
            DensityFile::Nominal => Some(
                material
                    .nominal_density_or("say \"density\": \"hu\", or name one of `sidecarm materials` that has one")
                    .map_err(|source| SceneError::Physics { place: self.place(key), source })?,
            ),
        };
        let index = local.iter().position(|known| *known == material).unwrap_or_else(|| {
            local.push(material);
            local.len() - 1
        });
        Ok(Class { material: index, density_g_per_cm3 })
    }
}
