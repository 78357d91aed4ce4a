//! Bytes of safetensors files from and to `f32` values; where the bytes come from is the caller's matter.

use std::collections::HashMap;

use safetensors::{Dtype, SafeTensors, tensor::TensorView};

/// What is wrong with a file of tensors; the reader says which file.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum TensorFault {
    /// Truncated, or another format.
    #[error("is no whole safetensors file ({detail})")]
    Form {
        /// What the reader met.
        detail: String,
    },
    /// A tensor is not there.
    #[error("tensor `{name}` is missing")]
    Missing {
        /// Its name.
        name: String,
    },
    /// A tensor that nobody asked for.
    #[error("tensor `{name}` is unknown")]
    Unknown {
        /// Its name.
        name: String,
    },
    /// A tensor holds other numbers than `f32`.
    #[error("tensor `{name}` is of type {found}, expected F32")]
    Type {
        /// Its name.
        name: String,
        /// Its type.
        found: String,
    },
    /// A tensor has another shape.
    #[error("tensor `{name}` has shape {found:?}, expected {expected:?}")]
    Shape {
        /// Its name.
        name: String,
        /// What it must be.
        expected: Vec<usize>,
        /// What it is.
        found: Vec<usize>,
    },
    /// A tensor holds NaN or an infinity.
    #[error("tensor `{name}` is not finite at value {index}")]
    NotFinite {
        /// Its name.
        name: String,
        /// Place of the first such value, row-major.
        index: usize,
    },
    /// A text of the file's metadata is missing.
    #[error("metadata `{key}` is missing")]
    MetadataMissing {
        /// Its key.
        key: String,
    },
    /// A text of the file's metadata is no JSON of the right form.
    #[error("metadata `{key}`: {detail}")]
    MetadataForm {
        /// Its key.
        key: String,
        /// What is wrong.
        detail: String,
    },
}

/// The tensors that lie in `bytes`.
///
/// # Errors
/// When `bytes` is no whole safetensors file.
pub fn tensors_from_bytes(bytes: &[u8]) -> Result<SafeTensors<'_>, TensorFault> {
    SafeTensors::deserialize(bytes).map_err(|error| TensorFault::Form { detail: error.to_string() })
}

/// The texts beside the tensors in `bytes`.
///
/// # Errors
/// When `bytes` is no whole safetensors file.
pub fn metadata_of(bytes: &[u8]) -> Result<HashMap<String, String>, TensorFault> {
    let (_, header) = SafeTensors::read_metadata(bytes).map_err(|error| TensorFault::Form { detail: error.to_string() })?;
    Ok(header.metadata().clone().unwrap_or_default())
}

/// The values of the tensor `name`, row-major, which must have `shape` and be finite.
///
/// # Errors
/// When it is missing, of another type or shape, or not finite.
pub fn floats_of(tensors: &SafeTensors<'_>, name: &str, shape: &[usize]) -> Result<Vec<f32>, TensorFault> {
    let name_owned = || name.to_owned();
    let view = tensors.tensor(name).map_err(|_| TensorFault::Missing { name: name_owned() })?;
    if view.dtype() != Dtype::F32 {
        return Err(TensorFault::Type { name: name_owned(), found: format!("{:?}", view.dtype()) });
    }
    if view.shape() != shape {
        return Err(TensorFault::Shape { name: name_owned(), expected: shape.to_vec(), found: view.shape().to_vec() });
    }
    let (words, _) = view.data().as_chunks::<4>();
    let values: Vec<f32> = words.iter().map(|word| f32::from_le_bytes(*word)).collect();
    match values.iter().position(|value| !value.is_finite()) {
        Some(index) => Err(TensorFault::NotFinite { name: name_owned(), index }),
        None => Ok(values),
    }
}

/// A safetensors file of `f32` tensors, each (name, shape, values row-major). The same input gives the same bytes while `metadata` has
/// one entry at most: the format keeps its entries in no order.
///
/// # Errors
/// When a shape and its values disagree.
pub fn bytes_from_tensors(
    list: &[(&str, Vec<usize>, &[f32])],
    metadata: Option<HashMap<String, String>>,
) -> Result<Vec<u8>, TensorFault> {
    let form = |error: safetensors::SafeTensorError| TensorFault::Form { detail: error.to_string() };
    let data: Vec<Vec<u8>> =
        list.iter().map(|(_, _, values)| values.iter().flat_map(|value| value.to_le_bytes()).collect()).collect();
    let mut views = Vec::with_capacity(list.len());
    for ((name, shape, _), bytes) in list.iter().zip(&data) {
        views.push((*name, TensorView::new(Dtype::F32, shape.clone(), bytes).map_err(form)?));
    }
    safetensors::serialize(views, metadata).map_err(form)
}
