//! Why nothing was transported.

use std::path::PathBuf;

use crate::image::ImageFileError;
use crate::render::RenderError;
use crate::scene::physics::PhysicsError;

/// Why there is no scatter image.
#[derive(Debug, thiserror::Error)]
pub enum TransportError {
    /// Attenuation is not known there.
    #[error("attenuation: {0}")]
    Physics(#[from] PhysicsError),
    /// What heel and bow-tie leave.
    #[error(transparent)]
    Render(#[from] RenderError),
    /// The detector is nowhere.
    #[error("the detector is fx {fx} px times pitch {pitch_mm} mm from the source: give detector.pitch_mm and view.intrinsics")]
    DetectorDistance {
        /// Focal length.
        fx: f64,
        /// Pixel pitch.
        pitch_mm: f64,
    },
    /// No raster to score on.
    #[error("the scatter grid is {columns}x{rows} pixels, expected 1 to 1024 each")]
    Grid {
        /// Found.
        columns: usize,
        /// Found.
        rows: usize,
    },
    /// The spectrum is empty.
    #[error("beam: no photons in the spectrum")]
    NoPhotons,
    /// The collimator is closed.
    #[error("beam.field: no photon leaves through it")]
    NoField,
    /// What a pixel's photons are counted by is 0.
    #[error(
        "beam.bowtie and beam.heel leave no photon on the principal ray, where photons_per_pixel counts; make the bow-tie thinner there"
    )]
    DarkPrincipalRay,
    /// One attenuation for everything has no scatter.
    #[error("model.formation naive has no interactions to follow; scatter needs deepdrr")]
    Naive,
    /// Densities that no flight can bound.
    #[error("object {name}: a density is {value} g/cm3, expected a finite number from 0 up")]
    Density {
        /// The object.
        name: String,
        /// Found.
        value: f64,
    },
    /// Nobody asked for any.
    #[error("{histories} histories, expected 1 to 1e15")]
    Histories {
        /// Found.
        histories: u64,
    },
    /// A precision that is none.
    #[error("--rel-error {value}: expected a positive number")]
    RelError {
        /// Found.
        value: f64,
    },
    /// A file could not be written.
    #[error(transparent)]
    File(#[from] ImageFileError),
    /// What was saved cannot be read.
    #[error("{path}: no checkpoint of this program ({detail}); start anew with --fresh", path = path.display())]
    Unreadable {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        detail: String,
    },
    /// What was saved is of something else.
    #[error("checkpoint: {what} is {saved} there and {found} here; give the same command, or start anew with --fresh")]
    Checkpoint {
        /// What differs.
        what: &'static str,
        /// In the file.
        saved: String,
        /// Now.
        found: String,
    },
}
