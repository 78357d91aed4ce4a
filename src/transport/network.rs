//! The network that scenes ask for their scatter.

use std::path::Path;

use crate::geometry::View;
use crate::render::Scatter;
use crate::reporter::Reporter;
use crate::scene::model::Scene;

/// Says the scatter of scenes whose `model.scatter` is `network`.
#[cfg(feature = "learn")]
#[derive(Clone, Debug)]
pub struct NetworkScatter(crate::infer::LoadedNetwork);

/// There is none in this build.
#[cfg(not(feature = "learn"))]
#[derive(Clone, Debug)]
pub enum NetworkScatter {}

/// Why no network says anything.
#[derive(Debug, thiserror::Error)]
pub enum NetworkError {
    /// The scene, or the network.
    #[cfg(feature = "learn")]
    #[error(transparent)]
    Predict(#[from] super::predicted::PredictError),
    /// None can be run.
    #[cfg(not(feature = "learn"))]
    #[error("model.scatter is \"network\": this program was built without the feature `learn`")]
    NotBuilt,
}

#[cfg(feature = "learn")]
impl NetworkScatter {
    /// The network `name`, a path without ending, or the one that comes with the program.
    ///
    /// # Errors
    /// As [`crate::infer::LoadedNetwork::load`].
    pub fn open(name: Option<&Path>) -> Result<Self, NetworkError> {
        use super::columns::{CHANNELS, SCALARS};
        use crate::infer::LoadedNetwork;
        let network = match name {
            Some(name) => LoadedNetwork::load(name, &CHANNELS, &SCALARS),
            None => LoadedNetwork::shipped(&CHANNELS, &SCALARS),
        };
        Ok(Self(network.map_err(super::predicted::PredictError::Network)?))
    }

    /// SHA-256 of its weights, in hexadecimal.
    #[must_use]
    pub fn sha256(&self) -> String {
        use crate::infer::ScatterNetwork;
        self.0.card().weights_sha256.clone()
    }

    /// The scatter of `scene` seen in `view`; a warning where the scene is unlike what the network was trained on.
    ///
    /// # Errors
    /// As [`super::predicted()`].
    pub fn say(&self, scene: &Scene, view: &View, reporter: &Reporter) -> Result<Scatter, NetworkError> {
        let scatter = super::predicted(&self.0, scene, view)?;
        if let Some(words) = scatter.unlike() {
            reporter.warn("scatter", words);
        }
        Ok(scatter)
    }
}

#[cfg(not(feature = "learn"))]
impl NetworkScatter {
    /// # Errors
    /// Always.
    pub fn open(_: Option<&Path>) -> Result<Self, NetworkError> {
        Err(NetworkError::NotBuilt)
    }

    /// # Panics
    /// Never: there is nothing to ask.
    #[must_use]
    pub fn sha256(&self) -> String {
        match *self {}
    }

    /// # Errors
    /// Never: there is nothing to ask.
    pub fn say(&self, _: &Scene, _: &View, _: &Reporter) -> Result<Scatter, NetworkError> {
        match *self {}
    }
}
