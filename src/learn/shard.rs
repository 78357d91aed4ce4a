//! A file of samples for a scatter network: safetensors, with its lists in the metadata.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use safetensors::tensor::{Dtype, SafeTensors, TensorView};

/// Samples of one file. Arrays lie sample by sample, `f32`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Shard {
    /// Names of the channels.
    pub channels: Vec<String>,
    /// Names of the numbers of an image.
    pub scalar_names: Vec<String>,
    /// Columns and rows of `inputs`.
    pub grid_px: [usize; 2],
    /// Columns and rows of `truth`.
    pub truth_px: [usize; 2],
    /// [samples, channels, rows, columns].
    pub inputs: Vec<f32>,
    /// [samples, scalars].
    pub scalars: Vec<f32>,
    /// [samples].
    pub scale: Vec<f32>,
    /// [samples, 2, rows, columns]: scattered once, and more often, in units of the unattenuated signal.
    pub truth: Vec<f32>,
    /// As `truth`: its standard errors.
    pub truth_error: Vec<f32>,
    /// By sample.
    pub specimens: Vec<String>,
    /// By sample.
    pub seeds: Vec<u64>,
}

/// Why a file of samples cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ShardError {
    /// Reading or writing.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// It is no such file.
    #[error("{}: no file of scatter samples, or a damaged one ({what}); delete it and let `sidecarm dataset scatter` make it again", path.display())]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        what: String,
    },
}

/// Pages of the truth.
const PAGES: usize = 2;

impl Shard {
    /// Writes it, whole or not at all.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), ShardError> {
        let samples = self.seeds.len();
        let [columns, rows] = self.grid_px;
        let [truth_columns, truth_rows] = self.truth_px;
        let truth_shape = vec![samples, PAGES, truth_rows, truth_columns];
        let arrays = [
            ("inputs", vec![samples, self.channels.len(), rows, columns], &self.inputs),
            ("scalars", vec![samples, self.scalar_names.len()], &self.scalars),
            ("scale", vec![samples], &self.scale),
            ("truth", truth_shape.clone(), &self.truth),
            ("truth_error", truth_shape, &self.truth_error),
        ];
        let content = |what: String| ShardError::Content { path: path.to_owned(), what };
        let mut views = Vec::with_capacity(arrays.len());
        for (name, shape, values) in arrays {
            let view = TensorView::new(Dtype::F32, shape, bytemuck::cast_slice(values));
            views.push((name, view.map_err(|error| content(error.to_string()))?));
        }
        let lists = [
            ("channels", serde_json::to_string(&self.channels)),
            ("scalar_names", serde_json::to_string(&self.scalar_names)),
            ("specimens", serde_json::to_string(&self.specimens)),
            ("seeds", serde_json::to_string(&self.seeds)),
        ];
        let lists = lists.into_iter().map(|(name, text)| (name.to_owned(), text.expect("plain data"))).collect::<HashMap<_, _>>();
        let bytes = safetensors::serialize(views, Some(lists)).map_err(|error| content(error.to_string()))?;
        let io = |source| ShardError::Io { path: path.to_owned(), source };
        let beside = path.with_extension("part");
        std::fs::write(&beside, bytes).map_err(io)?;
        std::fs::rename(&beside, path).map_err(io)
    }

    /// Reads one.
    ///
    /// # Errors
    /// When it is not there, damaged, or something else.
    pub fn read(path: &Path) -> Result<Self, ShardError> {
        let bytes = std::fs::read(path).map_err(|source| ShardError::Io { path: path.to_owned(), source })?;
        let parsed = Self::parse(&bytes).map_err(|what| ShardError::Content { path: path.to_owned(), what })?;
        Ok(parsed)
    }

    fn parse(bytes: &[u8]) -> Result<Self, String> {
        let file = SafeTensors::deserialize(bytes).map_err(|error| error.to_string())?;
        let (_, header) = SafeTensors::read_metadata(bytes).map_err(|error| error.to_string())?;
        let lists = header.metadata().as_ref().ok_or("no metadata")?;
        fn list<T: serde::de::DeserializeOwned>(lists: &HashMap<String, String>, name: &str) -> Result<Vec<T>, String> {
            let text = lists.get(name).ok_or_else(|| format!("no list '{name}'"))?;
            serde_json::from_str(text).map_err(|error| format!("list '{name}': {error}"))
        }
        let channels: Vec<String> = list(lists, "channels")?;
        let scalar_names: Vec<String> = list(lists, "scalar_names")?;
        let (specimens, seeds): (Vec<String>, Vec<u64>) = (list(lists, "specimens")?, list(lists, "seeds")?);
        let samples = seeds.len();
        if specimens.len() != samples {
            return Err(format!("{} specimens of {samples} samples", specimens.len()));
        }
        let array = |name: &str, shape: &[Option<usize>]| {
            let tensor = file.tensor(name).map_err(|error| format!("'{name}': {error}"))?;
            let found = tensor.shape().to_vec();
            let fits = found.len() == shape.len() && found.iter().zip(shape).all(|(n, want)| want.is_none_or(|want| want == *n));
            if !fits || tensor.dtype() != Dtype::F32 {
                return Err(format!("'{name}' is {:?} of {found:?}, expected F32 of {shape:?}", tensor.dtype()));
            }
            let values = tensor.data().chunks_exact(4).map(|bytes| f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]));
            Ok((found, values.collect::<Vec<f32>>()))
        };
        let (of_inputs, inputs) = array("inputs", &[Some(samples), Some(channels.len()), None, None])?;
        let (_, scalars) = array("scalars", &[Some(samples), Some(scalar_names.len())])?;
        let (_, scale) = array("scale", &[Some(samples)])?;
        let (of_truth, truth) = array("truth", &[Some(samples), Some(PAGES), None, None])?;
        let (_, truth_error) = array("truth_error", &of_truth.iter().map(|n| Some(*n)).collect::<Vec<_>>())?;
        let (grid_px, truth_px) = ([of_inputs[3], of_inputs[2]], [of_truth[3], of_truth[2]]);
        Ok(Self { channels, scalar_names, grid_px, truth_px, inputs, scalars, scale, truth, truth_error, specimens, seeds })
    }
}
