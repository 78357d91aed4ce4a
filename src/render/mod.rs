//! The radiograph that should have been acquired: area densities along rays, the spectrum, noise, the detector.
//!
//! One plan, two executors: `shaders/*.wgsl` on a GPU and their twins under `cpu/` on all cores. Stages are verbs with one stem each:
//! `integrate_density` → `attenuate_spectrum` → `add_noise`; what shapes beam and panel (`flood`, `blur`) and what follows (crosstalk,
//! readout, counts: `detector`) is shared.

pub mod achieved;
pub mod before_panel;
pub mod blur;
mod bounds;
mod cast;
pub mod cells;
mod chain;
mod checks;
pub mod costs;
mod cut_faces;
pub mod cpu;
pub mod detector;
mod dicom;
mod execute;
pub mod explain;
mod face_sums;
pub mod fits;
pub mod flood;
mod guessed;
mod heel_table;
mod intensifier;
mod made;
pub mod mesh_tree;
pub mod meshes;
pub mod non_finite;
pub mod outline;
pub mod panel_costs;
mod panel_work;
pub mod pilot;
pub mod plan;
mod plan_parts;
pub mod planner;
pub mod prepared;
pub mod quadrature;
pub mod reference;
pub mod ray_counts;
mod renderer;
mod scattered;
pub mod slabs;
pub mod spectrum;
pub mod steep;
pub mod survey;
pub mod tiles;
mod timed_costs;
mod timed_panel;
mod timed_scenes;
pub mod trade;
pub mod veil;
mod view_slabs;
mod volumes;
pub mod wgsl;
pub mod ways;
pub mod words;
mod write;

pub use dicom::{unsaid_skew, write_dicom};
pub use explain::explain_unseen;
pub use guessed::{LEAST_GUESSED_MM, guessed, guessed_share};
pub use made::Made;
pub use plan::Plan;
pub use planner::Goal;
pub use renderer::{Options, Rendered, Renderer, image_ms};
pub use scattered::{Added, Origin, Scatter};
pub use write::{write_image, write_image_without_times, write_picture, written_with};

use crate::geometry::CameraError;
use crate::gpu::GpuError;
use crate::image::ImageFileError;
use crate::scene::physics::PhysicsError;

/// What an image holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Quantity {
    /// Σ φ r T / Σ φ r: 1 in air.
    #[default]
    Intensity,
    /// −ln intensity.
    LineIntegral,
    /// gain · detected signal + offset.
    Counts,
    /// g/cm² per material, one page each, noise-free.
    AreaDensity,
}

impl Quantity {
    /// As files and the command line have it.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Intensity => "intensity",
            Self::LineIntegral => "line_integral",
            Self::Counts => "counts",
            Self::AreaDensity => "area_density",
        }
    }
}

/// Why there is no image.
#[derive(Debug, thiserror::Error)]
pub enum RenderError {
    /// The scene is that of a session.
    #[error("scene has no view; add `view`, or render it from a session")]
    NoView,
    /// No pixels.
    #[error("view: image of {width}x{height} px has nothing to render")]
    EmptyView {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// K or the pose is no camera.
    #[error("view: {0}")]
    Camera(#[from] CameraError),
    /// fx · pitch is no distance.
    #[error("detector: fx {fx} px times pitch {pitch_mm} mm is no distance from the focal spot")]
    DetectorDistance {
        /// Focal length.
        fx: f64,
        /// Pixel pitch.
        pitch_mm: f64,
    },
    /// The intensifier was measured in another picture.
    #[error("detector.intensifier: {detail}")]
    Intensifier {
        /// What does not fit.
        detail: String,
    },
    /// The spectrum is empty.
    #[error("beam: no photons in the spectrum")]
    NoPhotons,
    /// A number of the scene makes no sense here.
    #[error("{what} is {value}, expected {expected}")]
    Number {
        /// Key in the scene.
        what: &'static str,
        /// Found.
        value: f64,
        /// What would do.
        expected: &'static str,
    },
    /// A volume is not what its size says.
    #[error("{name}: {detail}")]
    Volume {
        /// Object.
        name: String,
        /// What is wrong.
        detail: String,
    },
    /// Attenuation is not known there.
    #[error("attenuation: {0}")]
    Physics(#[from] PhysicsError),
    /// No such device, or it failed.
    #[error(transparent)]
    Gpu(#[from] GpuError),
    /// A plan from elsewhere does not fit the scene.
    #[error("plan: {what} is {planned} in the plan and {found} in the scene")]
    PlanMismatch {
        /// What differs.
        what: &'static str,
        /// In the plan.
        planned: String,
        /// In the scene.
        found: String,
    },
    /// The scene asks for what the fast path does not have.
    #[error("{what} serves to compare with other tools and only the reference renders it; add --reference")]
    ReferenceOnly {
        /// Key and value in the scene.
        what: &'static str,
    },
    /// No DICOM object can be made of it.
    #[error("{path}: {detail}", path = path.display())]
    Dicom {
        /// The file.
        path: std::path::PathBuf,
        /// Why.
        detail: String,
    },
    /// A file could not be written.
    #[error(transparent)]
    File(#[from] ImageFileError),
}
