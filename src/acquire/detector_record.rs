//! The detector calibration file (`calibration/detector/`): numbers with their unit in every key, and the maps beside them.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use super::added_filter::AddedFilter;
use super::panel_maps::{MapsError, PanelMaps};
use crate::foreign::read_small_text;
use crate::json::{JsonFault, parse_json};

/// What the panel adds up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PanelResponse {
    /// The energy of the photons: a quantum of the noise is ⟨E²⟩/⟨E⟩, so photons outnumber quanta by ⟨E²⟩/⟨E⟩².
    #[default]
    Energy,
    /// The photons.
    Counting,
}

/// The exposures of one tube current–time product.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExposureLevel {
    /// Tube current times time; `None` when the frames do not say it.
    pub exposure_mas: Option<f64>,
    /// Air frames used.
    pub frames: usize,
    /// Median over the panel, offset removed.
    pub air_value: f64,
    /// Detected quanta per pixel, median over the panel.
    pub quanta_per_pixel: Option<f64>,
    /// Share of pixels at the end of the scale; above 0 the level is not used.
    pub saturated_share: f64,
}

/// The panel under one tube voltage and filter, with nothing in the beam.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AirBeam {
    /// Tube voltage.
    pub tube_kvp: Option<f64>,
    /// Everything between anode and panel, as declared and with what the air frames state beside it: `aluminium=4.3,copper=0.2`.
    pub filter: Option<String>,
    /// The filter that the air frames state; absent where they state none.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub added_filter: Option<AddedFilter>,
    /// Focal spot to panel of the air frames.
    pub source_to_detector_mm: Option<f64>,
    /// Median over the panel of the signal per mAs, offset removed.
    pub air_value_per_mas: Option<f64>,
    /// The same for the air frames as they are, where their mAs is not known.
    pub air_value: Option<f64>,
    /// Standard deviation of the air value over its value: tube output from frame to frame, and quanta.
    pub air_relative_sigma: f64,
    /// Stored value per detected quantum: slope of variance against mean.
    pub gain_value_per_quantum: Option<f64>,
    /// Standard deviation over value.
    pub gain_relative_sigma: Option<f64>,
    /// Detected quanta per pixel and mAs, median over the panel.
    pub quanta_per_pixel_per_mas: Option<f64>,
    /// ⟨E²⟩/⟨E⟩² of the spectrum (tube voltage and filter) for an energy-integrating panel: photons per quantum.
    pub photons_per_quantum: Option<f64>,
    /// Detected photons per pixel and mAs: quanta times `photons_per_quantum`.
    pub photons_per_pixel_per_mas: Option<f64>,
    /// Stored value per keV, for an energy-integrating panel with a known spectrum.
    pub gain_value_per_kev: Option<f64>,
    /// 1 − smallest / largest signal of the smooth surface fitted to the map: heel, distance and obliquity.
    pub heel_share: Option<f64>,
    /// One entry per exposure level, ascending.
    pub levels: Vec<ExposureLevel>,
    /// Frames that were not used, each with the reason.
    pub frames_left_out: Vec<String>,
}

/// Presampled modulation transfer function from a slanted edge.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EdgeMtf {
    /// Angle of the edge against the pixel grid.
    pub edge_angle_deg: f64,
    /// `columns` or `rows`: the direction across the edge.
    pub across: String,
    /// Ascending, up to the Nyquist frequency of the pixels; line pairs per mm, per pixel where the pitch is not known.
    pub frequency_lp_per_mm: Vec<f64>,
    /// 1 at frequency 0.
    pub mtf: Vec<f64>,
    /// Where it falls to a half.
    pub half_lp_per_mm: Option<f64>,
}

/// Noise power of flat-fielded air frames, normalised by the squared mean signal.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoisePower {
    /// Of the frames it was measured on.
    pub exposure_mas: Option<f64>,
    /// Regions of `region_px` × `region_px` that were averaged.
    pub regions: usize,
    /// Side of a region.
    pub region_px: usize,
    /// Ascending; line pairs per mm, per pixel where the pitch is not known.
    pub frequency_lp_per_mm: Vec<f64>,
    /// Mean over all directions; mm² (pixels² where the pitch is not known).
    pub normalised_power_mm2: Vec<f64>,
}

/// How many pixels are not to be trusted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BadPixels {
    /// See [`super::panel_maps::DEAD`].
    pub dead: usize,
    /// See [`super::panel_maps::HOT`].
    pub hot: usize,
    /// See [`super::panel_maps::UNSTABLE`].
    pub unstable: usize,
}

/// The TIFF beside the JSON: offset, bad pixels, then one page per beam.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MapsFile {
    /// Name, in the folder of the JSON.
    pub file: PathBuf,
    /// Of the file.
    pub sha256: String,
    /// What each page holds, with its unit.
    pub pages: Vec<String>,
}

/// The JSON of a detector calibration. Only `origin` and the size are required: a file without maps describes a uniform panel.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DetectorRecord {
    /// Who measured it, when, with what.
    pub origin: String,
    /// Columns of the panel's frames.
    pub columns_px: u32,
    /// Rows of the panel's frames.
    pub rows_px: u32,
    /// Pixel pitch.
    #[serde(default)]
    pub pitch_mm: Option<f64>,
    /// What the panel adds up.
    #[serde(default)]
    pub response: PanelResponse,
    /// Bits per stored value.
    #[serde(default)]
    pub bits: Option<u32>,
    /// Stored value at which the panel saturates.
    #[serde(default)]
    pub saturation_value: Option<f64>,
    /// Stored value without X-rays: from darks the median over the panel, from exposures the mean of the good pixels.
    #[serde(default)]
    pub offset_value: Option<f64>,
    /// Its standard deviation.
    #[serde(default)]
    pub offset_sigma_value: Option<f64>,
    /// What the offset rests on: `darks` or `exposures`.
    #[serde(default)]
    pub offset_from: Option<String>,
    /// Electronic noise of a pixel, rounding included; `None` where neither two darks nor the air frames determine it.
    #[serde(default)]
    pub readout_sigma_value: Option<f64>,
    /// Stored value of the unattenuated signal, offset included, for any exposure: for panels behind a normalising console.
    #[serde(default)]
    pub air_value: Option<f64>,
    /// Photons per pixel at that level.
    #[serde(default)]
    pub photons_per_pixel: Option<f64>,
    /// Correlation of the quantum noise of pixels that share a side.
    #[serde(default)]
    pub noise_correlation_first_neighbour: Option<f64>,
    /// Of pixels that share a corner.
    #[serde(default)]
    pub noise_correlation_second_neighbour: Option<f64>,
    /// One per tube voltage and filter.
    #[serde(default)]
    pub beams: Vec<AirBeam>,
    /// Pixels that are interpolated and masked.
    #[serde(default)]
    pub bad_pixels: BadPixels,
    /// Presampled MTF; `None` without an edge frame.
    #[serde(default)]
    pub mtf: Option<EdgeMtf>,
    /// Normalised noise power.
    #[serde(default)]
    pub nps: Option<NoisePower>,
    /// What a person should know.
    #[serde(default)]
    pub notes: Vec<String>,
    /// The maps.
    #[serde(default)]
    pub maps: Option<MapsFile>,
}

/// A detector calibration with its maps; in a log, the maps are packed into the text.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct DetectorCalibration {
    /// The numbers.
    pub record: DetectorRecord,
    /// Pixel by pixel; empty for a uniform panel.
    pub maps: PanelMaps,
}

/// Why a detector calibration cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DetectorCalibrationError {
    /// The operating system refused.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
    /// The JSON is not a detector calibration.
    #[error("{path}: at {place}: {detail}", path = path.display())]
    Json {
        /// The file.
        path: PathBuf,
        /// The key.
        place: String,
        /// What is wrong there.
        detail: String,
    },
    /// A number that no panel has.
    #[error("{path}: {key} is {found}, expected {expected}", path = path.display())]
    Value {
        /// The file.
        path: PathBuf,
        /// The key.
        key: &'static str,
        /// What was found.
        found: String,
        /// What would be right.
        expected: &'static str,
    },
    /// The maps.
    #[error(transparent)]
    Maps(#[from] MapsError),
    /// The calibration is not one of the frame's.
    #[error("{path}: {reason}", path = path.display())]
    NotApplied {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
}

impl DetectorCalibration {
    /// Reads the JSON at `path` and the maps beside it.
    ///
    /// # Errors
    /// When a file is missing, damaged, or holds a number that no panel has; the message names file and key.
    pub fn read(path: &Path) -> Result<Self, DetectorCalibrationError> {
        let text = read_small_text(path).map_err(|source| DetectorCalibrationError::Io { path: path.to_owned(), source })?;
        let json = |JsonFault { place, detail }| DetectorCalibrationError::Json { path: path.to_owned(), place, detail };
        let record: DetectorRecord = parse_json(text.as_bytes()).map_err(json)?;
        record.check(path)?;
        let maps = match &record.maps {
            Some(maps) => {
                let size_px = [record.columns_px as usize, record.rows_px as usize];
                let tiff = path.parent().unwrap_or(Path::new("")).join(&maps.file);
                PanelMaps::read(&tiff, &maps.sha256, size_px, record.beams.len())?
            }
            None => PanelMaps::default(),
        };
        Ok(Self { record, maps })
    }
}

impl DetectorRecord {
    /// The first number that no panel has.
    fn check(&self, path: &Path) -> Result<(), DetectorCalibrationError> {
        let wrong =
            |key, found: String, expected| Err(DetectorCalibrationError::Value { path: path.to_owned(), key, found, expected });
        if !((1..=16384).contains(&self.columns_px) && (1..=16384).contains(&self.rows_px)) {
            return wrong("columns_px, rows_px", format!("{}, {}", self.columns_px, self.rows_px), "1 to 16384 each");
        }
        let positive = [
            ("pitch_mm", self.pitch_mm),
            ("saturation_value", self.saturation_value),
            ("photons_per_pixel", self.photons_per_pixel),
        ];
        for (key, value) in positive.into_iter().filter_map(|(key, value)| Some((key, value?))) {
            if !(value > 0.0 && value.is_finite()) {
                return wrong(key, value.to_string(), "a positive number");
            }
        }
        let offset = self.offset_value.unwrap_or(0.0);
        if !offset.is_finite() {
            return wrong("offset_value", offset.to_string(), "a number");
        }
        if let Some(air) = self.air_value.filter(|air| !(*air > offset && air.is_finite())) {
            return wrong("air_value", air.to_string(), "a number above offset_value");
        }
        for beam in &self.beams {
            let values = [
                ("beams: air_value_per_mas", beam.air_value_per_mas),
                ("beams: air_value", beam.air_value),
                ("beams: gain_value_per_quantum", beam.gain_value_per_quantum),
                ("beams: tube_kvp", beam.tube_kvp),
                ("beams: source_to_detector_mm", beam.source_to_detector_mm),
            ];
            for (key, value) in values.into_iter().filter_map(|(key, value)| Some((key, value?))) {
                if !(value > 0.0 && value.is_finite()) {
                    return wrong(key, value.to_string(), "a positive number");
                }
            }
        }
        Ok(())
    }
}
