//! A specimen: Hounsfield numbers, structures, and which of those are bone; with its file.

use std::collections::{BTreeSet, HashMap};
use std::path::{Path, PathBuf};

use glam::{DAffine3, DVec3};
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use serde::{Deserialize, Serialize};

use crate::geometry::VoxelGrid;
use crate::image::{ImageFileError, write_atomically};
use crate::infer::materials::HuVolume;
use crate::infer::{TensorFault, metadata_of, tensors_from_bytes};
use crate::regular;
use crate::scene::LabelledCt;

/// The structure of what is neither tissue nor bone: nothing is learnt and nothing judged there.
pub const METAL: u8 = 255;

/// From here on a CT's voxel is metal, whatever its label.
const METAL_FROM_HU: f32 = 2500.0;

/// The key of the metadata that holds [`About`].
const KEY: &str = "specimen";

/// A CT, or a phantom of one.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelledSpecimen {
    /// By it, specimens are kept out of training.
    pub name: String,
    /// Whether its truth is exact: nobody, and no other network, drew it.
    pub is_phantom: bool,
    /// Where its voxels lie.
    pub grid: VoxelGrid,
    /// Hounsfield numbers, i fastest.
    pub hu: Vec<f32>,
    /// Structure of each voxel; 0 is none.
    pub structure: Vec<u8>,
    /// Structures that are bones, ascending.
    pub bones: Vec<u8>,
    /// What made it: the hash of its file is that of its origin too.
    pub origin: String,
}

/// What of a file is no tensor.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct About {
    name: String,
    is_phantom: bool,
    /// Columns of the matrix, then the translation.
    lps_from_voxel: [f64; 12],
    bones: Vec<u8>,
    origin: String,
}

/// Why a specimen cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum SpecimenError {
    /// Writing.
    #[error(transparent)]
    File(#[from] ImageFileError),
    /// Reading.
    #[error("specimen {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// It is no such file, or a damaged one.
    #[error("specimen {}: {fault}; delete it and make it again", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        fault: TensorFault,
    },
    /// More structures than a file holds.
    #[error("{name}: {found} labels, at most 254 can be told apart")]
    Labels {
        /// The specimen.
        name: String,
        /// How many.
        found: usize,
    },
    /// Nothing to learn bone from.
    #[error(
        "{name}: no label that its voxels have is bone; the scene's materials must be labels with a map, \"map\": \"totalsegmentator\" for one"
    )]
    NoBone {
        /// The specimen.
        name: String,
    },
}

impl LabelledSpecimen {
    /// The specimen `name` of a labelled CT. Hounsfield numbers are rounded.
    ///
    /// # Errors
    /// When no label is bone, or there are too many of them.
    pub fn of_ct(name: &str, labelled: &LabelledCt, origin: String) -> Result<Self, SpecimenError> {
        let held: Vec<u32> =
            labelled.labels.iter().copied().filter(|label| *label != 0).collect::<BTreeSet<u32>>().into_iter().collect();
        if held.len() >= usize::from(METAL) {
            return Err(SpecimenError::Labels { name: name.to_owned(), found: held.len() });
        }
        let number = |label: &u32| held.binary_search(label).map_or(0, |at| at as u8 + 1);
        let bones: Vec<u8> = labelled.bone_labels.iter().map(number).filter(|number| *number != 0).collect();
        if bones.is_empty() {
            return Err(SpecimenError::NoBone { name: name.to_owned() });
        }
        Ok(Self {
            name: name.to_owned(),
            is_phantom: false,
            grid: labelled.ct.grid(),
            hu: labelled.ct.values.iter().map(|hu| rounded(*hu)).collect(),
            structure: labelled
                .labels
                .iter()
                .zip(&labelled.ct.values)
                .map(|(label, hu)| if *hu >= METAL_FROM_HU { METAL } else { number(label) })
                .collect(),
            bones,
            origin,
        })
    }

    /// As a network sees it.
    #[must_use]
    pub fn volume(&self) -> HuVolume<'_> {
        HuVolume { grid: self.grid, hu: &self.hu }
    }

    /// Whether a voxel lies in a bone, marrow included.
    #[must_use]
    pub fn is_in_bone(&self, index: usize) -> bool {
        self.bones.contains(&self.structure[index])
    }

    /// Writes it, whole or not at all.
    ///
    /// # Errors
    /// When it cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), SpecimenError> {
        let [width, height, depth] = self.grid.size;
        let shape = vec![depth, height, width];
        let hu: Vec<u8> = self.hu.iter().flat_map(|hu| (rounded(*hu) as i16).to_le_bytes()).collect();
        let about = About {
            name: self.name.clone(),
            is_phantom: self.is_phantom,
            lps_from_voxel: self.grid.lps_from_voxel.to_cols_array(),
            bones: self.bones.clone(),
            origin: self.origin.clone(),
        };
        let text = serde_json::to_string(&about).expect("plain data");
        let content = |error: safetensors::SafeTensorError| {
            let fault = TensorFault::Form { detail: error.to_string() };
            SpecimenError::Content { path: path.to_owned(), fault }
        };
        let views = [
            ("hu", TensorView::new(Dtype::I16, shape.clone(), &hu).map_err(content)?),
            ("structure", TensorView::new(Dtype::U8, shape, &self.structure).map_err(content)?),
        ];
        let bytes = safetensors::serialize(views, Some(HashMap::from([(KEY.to_owned(), text)]))).map_err(content)?;
        Ok(write_atomically(path, |file| file.write_all(&bytes))?)
    }

    /// Reads one.
    ///
    /// # Errors
    /// When it is not there, damaged or something else.
    pub fn read(path: &Path) -> Result<Self, SpecimenError> {
        let bytes = regular::read(path).map_err(|source| SpecimenError::Io { path: path.to_owned(), source })?;
        Self::of_bytes(&bytes, path)
    }

    /// The one that the file at `path` holds, whose content is `bytes`.
    pub(super) fn of_bytes(bytes: &[u8], path: &Path) -> Result<Self, SpecimenError> {
        Self::parse(bytes).map_err(|fault| SpecimenError::Content { path: path.to_owned(), fault })
    }

    fn parse(bytes: &[u8]) -> Result<Self, TensorFault> {
        let tensors = tensors_from_bytes(bytes)?;
        let texts = metadata_of(bytes)?;
        let text = texts.get(KEY).ok_or_else(|| TensorFault::MetadataMissing { key: KEY.to_owned() })?;
        let form = |detail: String| TensorFault::MetadataForm { key: KEY.to_owned(), detail };
        let about: About = serde_json::from_str(text).map_err(|error| form(error.to_string()))?;
        let (shape, hu) = bytes_of(&tensors, "hu", Dtype::I16)?;
        let (other, structure) = bytes_of(&tensors, "structure", Dtype::U8)?;
        let [depth, height, width] = shape.as_slice() else {
            return Err(TensorFault::Shape { name: "hu".to_owned(), expected: vec![0; 3], found: shape });
        };
        if other != shape {
            return Err(TensorFault::Shape { name: "structure".to_owned(), expected: shape, found: other });
        }
        let lps_from_voxel = DAffine3::from_cols_array(&about.lps_from_voxel);
        if !(lps_from_voxel.is_finite() && lps_from_voxel.matrix3.determinant().abs() > 0.0) {
            return Err(form("lps_from_voxel places no volume".to_owned()));
        }
        let (words, _) = hu.as_chunks::<2>();
        Ok(Self {
            name: about.name,
            is_phantom: about.is_phantom,
            grid: VoxelGrid { size: [*width, *height, *depth], lps_from_voxel },
            hu: words.iter().map(|word| f32::from(i16::from_le_bytes(*word))).collect(),
            structure: structure.to_vec(),
            bones: about.bones,
            origin: about.origin,
        })
    }
}

/// What a file of whole numbers holds of it.
pub(super) fn rounded(hu: f32) -> f32 {
    hu.round().clamp(-32768.0, 32767.0)
}

fn bytes_of<'a>(tensors: &SafeTensors<'a>, name: &str, dtype: Dtype) -> Result<(Vec<usize>, &'a [u8]), TensorFault> {
    let view = tensors.tensor(name).map_err(|_| TensorFault::Missing { name: name.to_owned() })?;
    if view.dtype() != dtype {
        return Err(TensorFault::Type { name: name.to_owned(), found: format!("{:?}", view.dtype()) });
    }
    Ok((view.shape().to_vec(), view.data()))
}

/// Axes along x, y, z of `lps`, the first voxel at 0.
pub(super) fn upright(size: [usize; 3], spacing_mm: [f64; 3]) -> VoxelGrid {
    VoxelGrid { size, lps_from_voxel: DAffine3::from_scale(DVec3::from_array(spacing_mm)) }
}
