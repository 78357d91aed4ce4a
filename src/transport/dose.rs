//! A map of the dose: energy that stayed in each voxel over the mass that is there.
//!
//! Energy counts where a photon leaves it: electrons go no farther than fractions of a millimetre at these energies, and fluorescence is left out.

use std::path::{Path, PathBuf};

use serde_json::json;

use super::error::TransportError;
use super::mass::{dose_gy, masses_by_voxel};
use super::simulation::Simulation;
use super::tally::{Estimate, Tally};
use crate::geometry::VoxelGrid;
use crate::image::{beside, write_atomically};
use crate::scene::model::Scene;
use crate::scene::write_nifti;

/// Dose per history.
#[derive(Clone, Debug, PartialEq)]
pub struct DoseMap {
    /// Where the voxels lie.
    pub grid: VoxelGrid,
    /// By voxel, Gy per history; 0 where no point met any mass.
    pub dose_gy: Vec<Estimate>,
    /// By voxel.
    pub mass_g: Vec<Estimate>,
    /// Energy per history that stayed in voxels with mass, keV.
    pub inside_kev: f64,
    /// Its standard error, that of voxels without mass included: voxels are not independent, so theirs do not add up. NaN after a single batch.
    pub inside_standard_error_kev: f64,
    /// In voxels without: what is there is smaller than the distance of the points that looked for it.
    pub massless_kev: f64,
    /// Outside the map.
    pub outside_kev: f64,
}

impl Simulation<'_> {
    /// What `tally` says of the dose; `None` where no map was asked for ([`Simulation::with_dose`]).
    #[must_use]
    pub fn dose_map(&self, tally: &Tally) -> Option<DoseMap> {
        let (space, dose) = (self.world().space.as_ref()?, self.world().dose.as_ref()?);
        let grid = dose.grid;
        let mass_g = masses_by_voxel(space, &grid);
        let (mut inside_kev, mut massless_kev) = (0.0, 0.0);
        let of_voxel = |(voxel, mass): (usize, &Estimate)| {
            let stayed = tally.deposited(voxel);
            if mass.mean > 0.0 {
                inside_kev += stayed.mean;
                return dose_gy(stayed, *mass, 1.0);
            }
            massless_kev += stayed.mean;
            Estimate { mean: 0.0, standard_error: 0.0 }
        };
        let dose_gy = mass_g.iter().enumerate().map(of_voxel).collect();
        let outside_kev = tally.deposited(grid.voxels()).mean;
        let inside_standard_error_kev = tally.deposited_within().standard_error;
        Some(DoseMap { grid, dose_gy, mass_g, inside_kev, inside_standard_error_kev, massless_kev, outside_kev })
    }
}

/// The files of a map: itself, its standard errors, and what they are.
#[must_use]
pub fn dose_files(path: &Path) -> [PathBuf; 3] {
    [path.to_owned(), beside(path, "error.nii.gz"), beside(path, "json")]
}

impl DoseMap {
    /// Largest dose of a voxel, Gy per history; its error tells whether it is one that few photons met.
    #[must_use]
    pub fn largest_gy(&self) -> Estimate {
        let none = Estimate { mean: 0.0, standard_error: 0.0 };
        self.dose_gy.iter().fold(none, |most, dose| if dose.mean > most.mean { *dose } else { most })
    }

    /// Writes the dose of the exposure of `scene` that `tally` is of, Gy, its standard errors, and beside them what they are; returns the latter.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(
        &self,
        path: &Path,
        scene: &Scene,
        (simulation, tally, adapter): (&Simulation, &Tally, &str),
    ) -> Result<serde_json::Value, TransportError> {
        let [_, errors, description] = dose_files(path);
        let photons = simulation.histories_of_exposure(scene.beam.photons_per_pixel);
        let of_exposure =
            |pick: fn(&Estimate) -> f64| -> Vec<f32> { self.dose_gy.iter().map(|dose| (photons * pick(dose)) as f32).collect() };
        write_nifti(path, &self.grid, &of_exposure(|dose| dose.mean))?;
        // Volumes hold numbers: after a single batch, where nobody knows the errors, all of the dose is uncertain.
        let error = |dose: &Estimate| if dose.standard_error.is_nan() { dose.mean } else { dose.standard_error };
        write_nifti(&errors, &self.grid, &of_exposure(error))?;
        let described = self.describe(scene, (simulation, tally, adapter), photons);
        write_atomically(&description, |file| write!(file, "{described:#}"))?;
        Ok(described)
    }

    fn describe(
        &self,
        scene: &Scene,
        (simulation, tally, adapter): (&Simulation, &Tally, &str),
        photons: f64,
    ) -> serde_json::Value {
        // Points are drawn for each voxel by itself.
        let variance: f64 = self.mass_g.iter().map(|mass| mass.standard_error.powi(2)).sum();
        let mass = Estimate { mean: self.mass_g.iter().map(|mass| mass.mean).sum(), standard_error: variance.sqrt() };
        let inside = Estimate { mean: self.inside_kev, standard_error: self.inside_standard_error_kev };
        let mean = dose_gy(inside, mass, photons);
        let largest = self.largest_gy();
        json!({
            "quantity": "dose",
            "unit": "Gy",
            "pages": ["dose"],
            "size": self.grid.size,
            "voxel_mm": self.grid.spacing_mm(),
            "histories": tally.histories(),
            "seed": simulation.histories().seed,
            "exposure": {
                "photons_per_pixel": scene.beam.photons_per_pixel,
                "photons": photons,
            },
            "per_history": 1.0 / photons,
            "mean_gy": mean.mean,
            "mean_standard_error_gy": mean.standard_error,
            "largest_gy": photons * largest.mean,
            "largest_standard_error_gy": photons * largest.standard_error,
            "mass_g": mass.mean,
            "energy_kev_per_history": {
                "inside": self.inside_kev,
                "massless": self.massless_kev,
                "outside": self.outside_kev,
            },
            "left_out": ["fluorescence", "the way of electrons"],
            "inputs": scene.inputs,
            "version": env!("CARGO_PKG_VERSION"),
            "adapter": adapter,
        })
    }
}
