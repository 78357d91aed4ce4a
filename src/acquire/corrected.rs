//! What was done to a frame after it was read.

use std::sync::Arc;

use crate::geometry::{ConsoleGeometry, Intensifier, IntensifierError};
use crate::image::Image;

/// How a console stored a frame.
#[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Stored {
    /// What it did to the panel's picture.
    pub console: ConsoleGeometry,
    /// Columns and rows in the file.
    pub size_px: [u32; 2],
    /// Columns and rows of the panel, where they are known.
    pub panel_px: Option<[u32; 2]>,
}

impl Stored {
    /// What an intensifier that is `whole` in the panel's picture did to this one, in the pixels of the oriented frame.
    ///
    /// # Errors
    /// When the panel's picture is no other size of the one it was measured in.
    pub fn seen_through(&self, whole: &Intensifier) -> Result<Intensifier, IntensifierError> {
        whole.through_window(&self.console.window(self.size_px), self.panel_px, self.console.stored_size(self.size_px))
    }
}

/// What was done to a frame after it was read, and what is known about its values since.
#[derive(Clone, Debug, Default, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default)]
pub struct Correction {
    /// What of the console's doing was undone, in words.
    pub console: Vec<String>,
    /// What the console did, as declared or solved.
    pub stored: Option<Stored>,
    /// Stored value without X-rays that was subtracted (median over the panel).
    pub offset_value: Option<f64>,
    /// What the unattenuated signal would be, offset subtracted; `None` when it is not known for this frame.
    pub air_value: Option<f64>,
    /// Standard deviation of `air_value` over its value.
    pub air_relative_sigma: Option<f64>,
    /// Why `air_value` is what it is.
    pub air_evidence: String,
    /// Why the air map may not be that of the frame's beam: taken with another filter, or it is not known with which of several.
    pub flood_doubt: Option<String>,
    /// Stored value per detected quantum.
    pub gain_value_per_quantum: Option<f64>,
    /// Electronic noise of a pixel, stored value.
    pub readout_sigma_value: Option<f64>,
    /// Pixels that were interpolated.
    pub bad_pixels: usize,
    /// Flags of [`super::panel_maps`] by pixel.
    #[serde(skip)]
    pub flags: Option<Arc<Image<u8>>>,
}
