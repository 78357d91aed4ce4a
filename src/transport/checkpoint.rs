//! What an interrupted run leaves: its sums, and what they are of.

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::error::TransportError;
use super::simulation::{Histories, Simulation};
use super::tally::Tally;
use crate::image::write_atomically;
use crate::regular;

/// Goes up whenever photons are followed otherwise, or the sums are others, so that none are added to those of another kind.
const METHOD: u32 = 2;

/// Sums up to some batch; going on from them gives the bits of a run that never stopped.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Checkpoint {
    version: String,
    device: String,
    histories_per_batch: u64,
    seed: u64,
    grid_px: [usize; 2],
    estimator: super::history::Estimator,
    /// SHA-256 of the scene file and of every file that it names.
    inputs: Vec<String>,
    tally: Tally,
}

impl Checkpoint {
    /// Of a run of `histories` on `device` over a scene made of files with these SHA-256.
    #[must_use]
    pub fn new(histories: &Histories, device: &str, inputs: &[String], tally: &Tally) -> Self {
        Self {
            version: format!("{}, method {METHOD}", env!("CARGO_PKG_VERSION")),
            device: device.to_owned(),
            histories_per_batch: tally.histories_per_batch,
            seed: histories.seed,
            grid_px: histories.grid_px,
            estimator: histories.estimator,
            inputs: inputs.to_vec(),
            tally: tally.clone(),
        }
    }

    /// Writes it.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self, path: &Path) -> Result<(), TransportError> {
        write_atomically(path, |file| serde_json::to_writer(file, self).map_err(std::io::Error::other))?;
        Ok(())
    }

    /// Reads one; `None` where there is no such file.
    ///
    /// # Errors
    /// When the file is there and is none.
    pub fn read(path: &Path) -> Result<Option<Self>, TransportError> {
        let text = match regular::read(path) {
            Ok(text) => text,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(TransportError::Unreadable { path: path.to_owned(), detail: error.to_string() }),
        };
        let read = serde_json::from_slice(&text);
        read.map(Some).map_err(|error| TransportError::Unreadable { path: path.to_owned(), detail: error.to_string() })
    }

    /// The sums, if they are of the same run on the same device, whose tallies are like `empty`; more or fewer histories may be asked for.
    ///
    /// # Errors
    /// When something that decides the result differs.
    pub fn tally_for(
        self,
        simulation: &Simulation,
        (device, empty): (&str, &Tally),
        inputs: &[String],
    ) -> Result<Tally, TransportError> {
        let here = Self::new(simulation.histories(), device, inputs, empty);
        let differs = |what: &'static str, saved: String, found: String| match saved == found {
            true => Ok(()),
            false => Err(TransportError::Checkpoint { what, saved, found }),
        };
        differs("the version", self.version, here.version)?;
        differs("the device", self.device, here.device)?;
        differs("histories per batch", self.histories_per_batch.to_string(), here.histories_per_batch.to_string())?;
        differs("the seed", self.seed.to_string(), here.seed.to_string())?;
        differs("the grid", format!("{:?}", self.grid_px), format!("{:?}", here.grid_px))?;
        differs("the estimator", format!("{:?}", self.estimator), format!("{:?}", here.estimator))?;
        differs("SHA-256 of scene and inputs", self.inputs.join(" "), here.inputs.join(" "))?;
        let dose = |tally: &Tally| tally.dose_voxels().map_or_else(|| "none".to_owned(), |voxels| format!("of {voxels} voxels"));
        differs("the dose map", dose(&self.tally), dose(empty))?;
        if !self.tally.is_like(empty) {
            let found = format!("{} pixels and {} materials", simulation.unattenuated().len(), simulation.materials());
            return Err(TransportError::Checkpoint { what: "the number of sums", saved: "another".to_owned(), found });
        }
        Ok(self.tally)
    }
}
