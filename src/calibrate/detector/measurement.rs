//! What a panel is calibrated from.

use crate::acquire::{AddedFilter, PanelResponse};
use crate::image::Image;

/// A frame without a specimen.
#[derive(Clone, Debug)]
pub struct PanelFrame {
    /// For messages.
    pub label: String,
    /// Stored values.
    pub pixels: Image<f32>,
    /// Tube voltage, if known.
    pub tube_kvp: Option<f64>,
    /// What filters the beam besides the tube, if known.
    pub filter: Option<AddedFilter>,
    /// Tube current times time, if known.
    pub exposure_mas: Option<f64>,
    /// Focal spot to panel, if known.
    pub source_to_detector_mm: Option<f64>,
}

/// What a panel is calibrated from.
#[derive(Clone, Debug)]
pub struct Measurement {
    /// Nothing in the beam; two or more per exposure level, several levels.
    pub air: Vec<PanelFrame>,
    /// No X-rays.
    pub dark: Vec<PanelFrame>,
    /// A straight edge of metal on the panel, turned by 2 to 10 degrees against its grid.
    pub edge: Option<PanelFrame>,
    /// What filters the tube in all air frames: `aluminium=4.3`, of a material that it names all of it. With what the frames state of other
    /// materials it gives the spectrum.
    pub filter: Option<String>,
    /// ⟨E⟩ and ⟨E²⟩ (keV, keV²) of the beam at a tube voltage, where the spectrum is known.
    pub spectrum_moments_kev: fn(f64, &str) -> Option<[f64; 2]>,
    /// Bits per stored value, if known.
    pub bits: Option<u32>,
    /// Pixel pitch, if known.
    pub pitch_mm: Option<f64>,
    /// What the panel adds up.
    pub response: PanelResponse,
    /// Who, when, with what.
    pub origin: String,
}
