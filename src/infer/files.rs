//! The files of a network, found, checked and written out.

use std::path::{Path, PathBuf};

use serde::de::DeserializeOwned;

use super::{InferError, bytes_from_tensors, floats_of, tensors_from_bytes};
use super::{Layer, TensorFault};
use crate::image::sha256_bytes;
use crate::json::parse_json;
use crate::regular;

/// What lies beside the weights of a network and says what they are.
pub trait NetworkCard: DeserializeOwned {
    /// SHA-256 of the weights file, in hexadecimal.
    fn weights_sha256(&self) -> &str;

    /// The layers, in the order of the parameters.
    fn layers(&self) -> Vec<Layer>;

    /// That every figure of the card, which lies at `path`, can be used.
    ///
    /// # Errors
    /// Where one cannot.
    fn check(&self, path: &Path) -> Result<(), InferError>;
}

/// The two files of a network.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NetworkFiles {
    /// `NAME.safetensors`.
    pub weights: PathBuf,
    /// `NAME.json`.
    pub card: PathBuf,
}

impl NetworkFiles {
    /// The files of the network `name`, a path; the ending of either file is dropped from it.
    #[must_use]
    pub fn of(name: &Path) -> Self {
        let text = name.as_os_str().to_string_lossy();
        let known = [".safetensors", ".json"].into_iter().find(|ending| text.ends_with(ending));
        // `with_extension` alone would take a version of the name for its ending.
        let stem = if known.is_some() { name.with_extension("") } else { name.to_owned() };
        let with = |ending: &str| {
            let mut path = stem.clone().into_os_string();
            path.push(ending);
            PathBuf::from(path)
        };
        Self { weights: with(".safetensors"), card: with(".json") }
    }

    /// The card and the parameters, in the order of the layers.
    ///
    /// # Errors
    /// When a file is missing, truncated, of another network or no network at all.
    pub fn read<C: NetworkCard>(&self) -> Result<(C, Vec<f32>), InferError> {
        let read = |path: &Path| regular::read(path).map_err(|source| InferError::Read { path: path.to_owned(), source });
        self.parse(&read(&self.weights)?, &read(&self.card)?)
    }

    /// The same from what the files hold.
    pub(super) fn parse<C: NetworkCard>(&self, weights: &[u8], card: &[u8]) -> Result<(C, Vec<f32>), InferError> {
        let card: C = parse_json(card).map_err(|fault| InferError::CardForm { path: self.card.clone(), fault })?;
        card.check(&self.card)?;
        let found = sha256_bytes(weights);
        if found != card.weights_sha256() {
            return Err(InferError::Checksum {
                path: self.weights.clone(),
                card: self.card.clone(),
                expected: card.weights_sha256().to_owned(),
                found,
                byte_count: weights.len(),
            });
        }
        let parameters = parameters_from_bytes(&card.layers(), weights)
            .map_err(|fault| InferError::Weights { path: self.weights.clone(), fault })?;
        Ok((card, parameters))
    }
}

/// The weights file of a network of `layers` with `parameters`, in their order.
///
/// # Errors
/// When there are more or fewer parameters than the layers have.
pub fn weights_file(layers: &[Layer], parameters: &[f32]) -> Result<Vec<u8>, TensorFault> {
    let expected: usize = layers.iter().map(Layer::value_count).sum();
    if parameters.len() != expected {
        let (name, found) = ("all parameters".to_owned(), vec![parameters.len()]);
        return Err(TensorFault::Shape { name, expected: vec![expected], found });
    }
    let names: Vec<[String; 2]> = layers.iter().map(Layer::tensor_names).collect();
    let (mut rest, mut list) = (parameters, Vec::new());
    for (layer, [weight_name, bias_name]) in layers.iter().zip(&names) {
        let (weight, behind) = rest.split_at(layer.weight_count());
        let (bias, behind) = behind.split_at(layer.outputs);
        rest = behind;
        list.push((weight_name.as_str(), layer.weight_shape(), weight));
        list.push((bias_name.as_str(), vec![layer.outputs], bias));
    }
    bytes_from_tensors(&list, None)
}

fn parameters_from_bytes(layers: &[Layer], bytes: &[u8]) -> Result<Vec<f32>, TensorFault> {
    let tensors = tensors_from_bytes(bytes)?;
    let mut parameters = Vec::new();
    let mut known = Vec::new();
    for layer in layers {
        let [weight, bias] = layer.tensor_names();
        parameters.extend(floats_of(&tensors, &weight, &layer.weight_shape())?);
        parameters.extend(floats_of(&tensors, &bias, &[layer.outputs])?);
        known.extend([weight, bias]);
    }
    let mut names = tensors.names();
    names.sort_unstable();
    match names.into_iter().find(|name| known.iter().all(|known| known != name)) {
        Some(name) => Err(TensorFault::Unknown { name: name.to_owned() }),
        None => Ok(parameters),
    }
}

impl Layer {
    fn tensor_names(&self) -> [String; 2] {
        [format!("{}.weight", self.name), format!("{}.bias", self.name)]
    }
}
