//! A file of samples for a scatter network: safetensors, with its lists in the metadata.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

use crate::image::{ImageFileError, write_atomically};
use crate::infer::{PAGES, TensorFault, bytes_from_tensors, floats_of, metadata_of, tensors_from_bytes};
use crate::regular;

/// Pages of the standard errors: those of the truth, and their sum.
pub(super) const ERRORS: usize = PAGES + 1;

/// Samples of one file. Arrays lie sample by sample, row-major, row 0 at the top.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shard {
    /// Names of the channels, each with its unit.
    pub channels: Vec<String>,
    /// Names of the numbers of an image, each with its unit.
    pub scalar_names: Vec<String>,
    /// Columns and rows of `inputs`.
    pub grid_px: [usize; 2],
    /// Columns and rows of `truth`.
    pub truth_px: [usize; 2],
    /// [samples, channels, rows, columns].
    pub inputs: Vec<f32>,
    /// [samples, scalars].
    pub scalars: Vec<f32>,
    /// [samples], above 0: rough mean scatter, in units of `truth`.
    pub scale: Vec<f32>,
    /// [samples, 2, rows, columns]: scattered once, and more often, in units of the unattenuated signal.
    pub truth: Vec<f32>,
    /// [samples, 3, rows, columns]: standard errors of `truth`, and of the sum of its pages.
    pub truth_error: Vec<f32>,
    /// By sample.
    pub specimens: Vec<String>,
    /// By sample.
    pub seeds: Vec<u64>,
    /// First seed that was asked for, and the one after the last.
    pub asked: Vec<u64>,
    /// What made it: files that differ in it are not of one set.
    pub origin: String,
}

/// Why a file of samples cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ShardError {
    /// Writing.
    #[error(transparent)]
    File(#[from] ImageFileError),
    /// Reading.
    #[error("file of samples {}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// It is no such file, or a damaged one.
    #[error("file of samples {}: {fault}; delete it and make it again", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        fault: TensorFault,
    },
}

impl Shard {
    /// Writes it, whole or not at all.
    ///
    /// # Errors
    /// When its lengths disagree, a value is not finite, or the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), ShardError> {
        let samples = self.seeds.len();
        let ([columns, rows], [truth_columns, truth_rows]) = (self.grid_px, self.truth_px);
        let truth_shape = vec![samples, PAGES, truth_rows, truth_columns];
        let list = [
            ("inputs", vec![samples, self.channels.len(), rows, columns], self.inputs.as_slice()),
            ("scalars", vec![samples, self.scalar_names.len()], &self.scalars),
            ("scale", vec![samples], &self.scale),
            ("truth", truth_shape, &self.truth),
            ("truth_error", vec![samples, ERRORS, truth_rows, truth_columns], &self.truth_error),
        ];
        let lists = [
            ("channels", serde_json::json!(self.channels)),
            ("scalar_names", serde_json::json!(self.scalar_names)),
            ("specimens", serde_json::json!(self.specimens)),
            ("seeds", serde_json::json!(self.seeds)),
            ("asked", serde_json::json!(self.asked)),
            ("origin", serde_json::json!([self.origin])),
        ];
        let lists = lists.map(|(key, list)| (key.to_owned(), list.to_string()));
        let content = |fault| ShardError::Content { path: path.to_owned(), fault };
        for (name, _, values) in &list {
            if let Some(index) = values.iter().position(|value| !value.is_finite()) {
                return Err(content(TensorFault::NotFinite { name: (*name).to_owned(), index }));
            }
        }
        let bytes = bytes_from_tensors(&list, Some(HashMap::from(lists))).map_err(content)?;
        Ok(write_atomically(path, |file| file.write_all(&bytes))?)
    }

    /// Reads one.
    ///
    /// # Errors
    /// When it is not there, damaged, or something else, or holds NaN or an infinity.
    pub fn read(path: &Path) -> Result<Self, ShardError> {
        let bytes = regular::read(path).map_err(|source| ShardError::Io { path: path.to_owned(), source })?;
        Self::parse(&bytes).map_err(|fault| ShardError::Content { path: path.to_owned(), fault })
    }

    fn parse(bytes: &[u8]) -> Result<Self, TensorFault> {
        let tensors = tensors_from_bytes(bytes)?;
        let lists = metadata_of(bytes)?;
        let channels: Vec<String> = list_of(&lists, "channels")?;
        let scalar_names: Vec<String> = list_of(&lists, "scalar_names")?;
        let specimens: Vec<String> = list_of(&lists, "specimens")?;
        let seeds: Vec<u64> = list_of(&lists, "seeds")?;
        let samples = seeds.len();
        if specimens.len() != samples {
            let detail = format!("{} names for {samples} seeds", specimens.len());
            return Err(TensorFault::MetadataForm { key: "specimens".to_owned(), detail });
        }
        // Columns and rows are the file's own.
        let grid = |name: &str| match tensors.tensor(name).map(|view| view.shape().to_vec()).as_deref() {
            Ok(&[_, _, rows, columns]) => Ok([columns, rows]),
            Ok(found) => {
                Err(TensorFault::Shape { name: name.to_owned(), expected: vec![samples, 0, 0, 0], found: found.to_vec() })
            }
            Err(_) => Err(TensorFault::Missing { name: name.to_owned() }),
        };
        let (grid_px, truth_px) = (grid("inputs")?, grid("truth")?);
        let (truth_shape, error_shape) =
            ([samples, PAGES, truth_px[1], truth_px[0]], [samples, ERRORS, truth_px[1], truth_px[0]]);
        Ok(Self {
            inputs: floats_of(&tensors, "inputs", &[samples, channels.len(), grid_px[1], grid_px[0]])?,
            scalars: floats_of(&tensors, "scalars", &[samples, scalar_names.len()])?,
            scale: floats_of(&tensors, "scale", &[samples])?,
            truth: floats_of(&tensors, "truth", &truth_shape)?,
            truth_error: floats_of(&tensors, "truth_error", &error_shape)?,
            channels,
            scalar_names,
            grid_px,
            truth_px,
            specimens,
            seeds,
            asked: list_of(&lists, "asked")?,
            origin: list_of::<String>(&lists, "origin")?.concat(),
        })
    }
}

fn list_of<T: DeserializeOwned>(lists: &HashMap<String, String>, key: &str) -> Result<Vec<T>, TensorFault> {
    let text = lists.get(key).ok_or_else(|| TensorFault::MetadataMissing { key: key.to_owned() })?;
    serde_json::from_str(text).map_err(|error| TensorFault::MetadataForm { key: key.to_owned(), detail: error.to_string() })
}
