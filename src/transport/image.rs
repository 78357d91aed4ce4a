//! What a run found, as images in units of the unattenuated signal, and as a file.

use std::path::{Path, PathBuf};

use serde_json::json;

use super::error::TransportError;
use super::mass::dose_gy;
use super::simulation::Simulation;
use super::tally::{DETECTED, ESCAPED, Estimate, PAGE_NAMES, Page, STARTED, Tally};
use crate::image::{Image, beside, write_atomically, write_tiff_f32};
use crate::scene::model::Scene;

/// A radiograph in its parts, on the coarse raster of the transport.
#[derive(Clone, Debug, PartialEq)]
pub struct ScatterImage {
    /// By [`Page`]: signal over the unattenuated signal of the same pixel with all of the panel open.
    pub pages: Vec<Image<f64>>,
    /// Their standard errors as the spread of batches has them, however little came: over many pixels their squares add up without bias.
    pub errors: Vec<Image<f64>>,
    /// All but the primary.
    pub scatter: Image<f64>,
    /// Its standard error, likewise.
    pub scatter_error: Image<f64>,
    /// Photons that were followed.
    pub histories: u64,
    /// By so many the errors are told.
    pub histories_per_batch: u64,
    /// Median over the pixels of the scatter's relative standard error; infinite where too little scatter came to tell it.
    pub relative_error: f64,
    /// Energy per history that stayed in each scene material, keV.
    pub absorbed_kev: Vec<Estimate>,
    /// Energy per history that started, keV: less than the spectrum's mean where heel or bow-tie take some.
    pub started_kev: f64,
    /// Energy per history that passed the plane of the detector, on the image or beside it, keV.
    pub detected_kev: f64,
    /// Energy per history that left elsewhere, keV.
    pub escaped_kev: f64,
}

impl Simulation<'_> {
    /// What `tally` says.
    #[must_use]
    pub fn image(&self, tally: &Tally) -> ScatterImage {
        let [width, height] = self.histories().grid_px;
        let image = |of_pixel: &dyn Fn(usize) -> f64| {
            let scaled = |pixel: usize| match self.unattenuated()[pixel] {
                open if open > 0.0 => of_pixel(pixel) / open,
                // Behind the heel: no signal to measure by.
                _ => 0.0,
            };
            Image { width, height, pixels: (0..width * height).map(scaled).collect() }
        };
        let page = |page: Page| image(&|pixel| tally.signal(page, pixel).mean);
        let error = |page: Page| image(&|pixel| tally.signal(page, pixel).standard_error);
        ScatterImage {
            pages: Page::ALL.iter().map(|one| page(*one)).collect(),
            errors: Page::ALL.iter().map(|one| error(*one)).collect(),
            scatter: image(&|pixel| tally.scatter(pixel).mean),
            scatter_error: image(&|pixel| tally.scatter(pixel).standard_error),
            histories: tally.histories(),
            histories_per_batch: tally.histories_per_batch,
            relative_error: self.stated_error(tally),
            absorbed_kev: (0..self.materials()).map(|material| tally.absorbed(material)).collect(),
            started_kev: tally.fate(STARTED).mean,
            detected_kev: tally.fate(DETECTED).mean,
            escaped_kev: tally.fate(ESCAPED).mean,
        }
    }

    /// What the numbers mean and where they come from, for `IMAGE.tif.json`.
    #[must_use]
    pub fn describe(&self, image: &ScatterImage, scene: &Scene, adapter: &str) -> serde_json::Value {
        let asked = self.histories();
        let by_material = |found: &[Estimate]| -> serde_json::Map<String, serde_json::Value> {
            scene.materials.iter().zip(found).map(|(material, found)| (material.name.clone(), json!(found))).collect()
        };
        let masses = self.masses_g();
        let doses: Vec<Estimate> =
            image.absorbed_kev.iter().zip(&masses).map(|(absorbed, mass)| dose_gy(*absorbed, *mass, 1.0)).collect();
        let exposed = self.histories_of_exposure(scene.beam.photons_per_pixel);
        let of_exposure: Vec<Estimate> =
            image.absorbed_kev.iter().zip(&masses).map(|(absorbed, mass)| dose_gy(*absorbed, *mass, exposed)).collect();
        let errors = PAGE_NAMES.iter().map(|name| format!("{name}_standard_error"));
        json!({
            "quantity": "scatter",
            "unit": "1 (unattenuated signal)",
            "pages": PAGE_NAMES.iter().map(|name| (*name).to_owned()).chain(errors).collect::<Vec<String>>(),
            "size_px": asked.grid_px,
            "histories": image.histories,
            "seed": asked.seed,
            "stated_error": finite(image.relative_error),
            "plan": {
                "estimator": asked.estimator,
                "histories_per_batch": image.histories_per_batch,
                "stated_error": "median over the pixels of the relative standard error of all scatter; null where too little came to \
                                 tell it",
                "scoring": "each pixel covers its share of the image area; expected: at every start and scattering the expected signal, \
                            directions to an even point of the image and the photon's own weighed by the balance heuristic",
                "left_out": ["fluorescence", "Doppler broadening", "interference between atoms", "matter behind the detector",
                             "scattering and fluorescence in the antiscatter grid"],
            },
            "energy_kev_per_history": {
                "started": image.started_kev,
                "absorbed": by_material(&image.absorbed_kev),
                "detector_plane": image.detected_kev,
                "escaped": image.escaped_kev,
            },
            "mass_g": by_material(&masses),
            "dose_gy_per_history": by_material(&doses),
            "exposure": {
                "photons_per_pixel": scene.beam.photons_per_pixel,
                "photons": exposed,
                "dose_gy": by_material(&of_exposure),
            },
            "scatter_to_primary": finite(image.scatter_to_primary()),
            "inputs": scene.inputs,
            "version": env!("CARGO_PKG_VERSION"),
            "adapter": adapter,
        })
    }
}

/// JSON has no infinity.
fn finite(value: f64) -> Option<f64> {
    value.is_finite().then_some(value)
}

impl ScatterImage {
    /// Mean scatter over mean primary.
    #[must_use]
    pub fn scatter_to_primary(&self) -> f64 {
        self.scatter.pixels.iter().sum::<f64>() / self.pages[Page::Primary as usize].pixels.iter().sum::<f64>()
    }

    /// The standard errors of the pages, pixel by pixel; NaN where nobody knows them ([`Estimate::told`]).
    #[must_use]
    pub fn told_errors(&self) -> Vec<Image<f64>> {
        let of_pixel = |(mean, error): (&f64, &f64)| Estimate { mean: *mean, standard_error: *error }.told().standard_error;
        let of_page = |(page, error): (&Image<f64>, &Image<f64>)| {
            let pixels = page.pixels.iter().zip(&error.pixels).map(of_pixel).collect();
            Image { width: page.width, height: page.height, pixels }
        };
        self.pages.iter().zip(&self.errors).map(of_page).collect()
    }

    /// Writes the pages, then their standard errors as far as they are known, as 32-bit float TIFF, and `json` beside it.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(&self, path: &Path, json: &serde_json::Value) -> Result<(), TransportError> {
        let errors = self.told_errors();
        let pages: Vec<Image<f32>> = self.pages.iter().chain(&errors).map(|page| page.map(|value| *value as f32)).collect();
        write_tiff_f32(path, &pages)?;
        let text = serde_json::to_string_pretty(json).expect("plain data");
        write_atomically(&written_with(path)[1], |file| file.write_all(text.as_bytes()))?;
        Ok(())
    }
}

/// The files of a scatter image: itself, what it is, and what an interrupted run leaves.
#[must_use]
pub fn written_with(path: &Path) -> [PathBuf; 3] {
    [path.to_owned(), beside(path, "json"), beside(path, "checkpoint")]
}
