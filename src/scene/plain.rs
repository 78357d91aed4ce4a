//! A scene without objects: what all else is said of.

use super::model::{Beam, Bodies, Detector, Formation, Model, Noise, Response, ScatterModel, Scene, Voxels};
use super::optics::{BeamShape, Panel};
use super::physics::Spectrum;

impl Scene {
    /// Nothing in a beam of `spectrum`: no shape of the beam, one photon a pixel, an energy-integrating detector that absorbs everything and
    /// has pixels of 1 mm, no noise, no view.
    #[must_use]
    pub fn plain(spectrum: Spectrum) -> Self {
        Self {
            materials: Vec::new(),
            objects: Vec::new(),
            view: None,
            beam: Beam { spectrum, photons_per_pixel: 1.0, shape: BeamShape::default() },
            detector: Detector {
                response: Response::Energy,
                pitch_mm: 1.0,
                crosstalk: vec![vec![1.0]],
                readout_noise: None,
                gain: 1.0,
                offset: 0.0,
                panel: Panel::default(),
            },
            model: Model {
                formation: Formation::Deepdrr,
                voxels: Voxels::Trilinear,
                scatter: ScatterModel::Off,
                noise: Noise::Off,
                seed: 1,
            },
            inputs: Vec::new(),
            robot: None,
            bodies: Bodies::default(),
        }
    }
}
