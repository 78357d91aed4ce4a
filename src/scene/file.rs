//! The scene file as it is written (DESIGN §7). Unknown keys are errors that name key and place; keys that the format has and this
//! version does not model are kept as raw values, so that loading can say so.

use std::collections::BTreeMap;

use serde::de::{Deserializer, Visitor};
use serde::{Deserialize, Serialize};

use super::model::{Formation, Noise, ReadoutNoise, Response, Voxels};
use super::object_file::ObjectFile;
use super::optics::Grid;
pub use super::optics_file::{
    BowTieFile, CircleFile, FieldFile, FocalSpotFile, HeelFile, IntensifierFile, PolygonFile, RectangleFile, ScintillatorFile,
};
use crate::geometry::{CarmJoints, Intrinsics, Projection, Rigid};

/// A scene file.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneFile {
    /// Objects in order; a later one displaces earlier ones.
    pub objects: Vec<ObjectFile>,
    /// Camera and raster; session scenes have none.
    #[serde(default)]
    pub view: Option<ViewFile>,
    /// The X-ray beam.
    pub beam: BeamFile,
    /// The detector.
    #[serde(default)]
    pub detector: DetectorFile,
    /// What is modelled.
    #[serde(default)]
    pub model: ModelFile,
}

/// `view`: K and pose, or P, or C-arm joints.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewFile {
    /// Columns and rows; the calibration's for C-arm joints if absent.
    #[serde(default)]
    pub size_px: Option<[u32; 2]>,
    /// K.
    #[serde(default)]
    pub intrinsics: Option<Intrinsics>,
    /// Pose.
    #[serde(default)]
    pub camera_from_lps: Option<Rigid>,
    /// P, at any scale.
    #[serde(default)]
    pub projection: Option<Projection>,
    /// Joints in degrees and mm.
    #[serde(default)]
    pub carm: Option<CarmJoints>,
    /// C-arm calibration file.
    #[serde(default)]
    pub calibration: Option<String>,
    /// Where the specimen lies in the room.
    #[serde(default)]
    pub world_from_lps: Option<Rigid>,
}

/// `beam`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BeamFile {
    /// Tube voltage.
    #[serde(default)]
    pub tube_kvp: Option<f64>,
    /// Anode angle, 12° if absent.
    #[serde(default)]
    pub anode_angle_deg: Option<f64>,
    /// Thickness by material.
    #[serde(default)]
    pub filtration_mm: BTreeMap<String, f64>,
    /// A single energy.
    #[serde(default)]
    pub mono_kev: Option<f64>,
    /// Photons per bin.
    #[serde(default)]
    pub spectrum_csv: Option<String>,
    /// N₀ on the principal ray; the paper's 5e5 if absent.
    #[serde(default)]
    pub photons_per_pixel: Option<f64>,
    /// A filter whose thickness depends on the fan angle.
    #[serde(default)]
    pub bowtie: Option<BowTieFile>,
    /// Self-filtration of the anode.
    #[serde(default)]
    pub heel: Option<HeelFile>,
    /// Full width at half maximum; a point if absent.
    #[serde(default)]
    pub focal_spot_mm: Option<FocalSpotFile>,
    /// Collimation; open if absent.
    #[serde(default)]
    pub field: Option<FieldFile>,
}

/// `detector`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DetectorFile {
    /// Energy-integrating if absent.
    #[serde(default)]
    pub response: Option<Response>,
    /// Pixel pitch; the calibration's for C-arm joints if absent.
    #[serde(default)]
    pub pitch_mm: Option<f64>,
    /// Odd square, sum 1.
    #[serde(default)]
    pub crosstalk: Option<Vec<Vec<f64>>>,
    /// Electronic noise.
    #[serde(default)]
    pub readout_noise: Option<ReadoutNoise>,
    /// 1 if absent.
    #[serde(default)]
    pub gain: Option<f64>,
    /// 0 if absent.
    #[serde(default)]
    pub offset: Option<f64>,
    /// What absorbs; everything is absorbed if absent.
    #[serde(default)]
    pub scintillator: Option<ScintillatorFile>,
    /// Spread of light, full width at half maximum; none if absent.
    #[serde(default)]
    pub blur_fwhm_mm: Option<f64>,
    /// Whole counts up to 2^bits − 1.
    #[serde(default)]
    pub bits: Option<f64>,
    /// Largest signal, in units of the unattenuated signal on the principal ray.
    #[serde(default)]
    pub saturation: Option<f64>,
    /// Antiscatter grid.
    #[serde(default)]
    pub grid: Option<Grid>,
    /// Distortion, round mask and glare of an image intensifier.
    #[serde(default)]
    pub intensifier: Option<IntensifierFile>,
}

/// `model`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModelFile {
    /// `deepdrr` if absent.
    #[serde(default)]
    pub formation: Option<Formation>,
    /// `trilinear` if absent; `piecewise_constant` only to compare with other tools.
    #[serde(default)]
    pub voxels: Voxels,
    /// `off` if absent.
    #[serde(default)]
    pub scatter: ScatterFile,
    /// `false` if absent.
    #[serde(default)]
    pub noise: NoiseFile,
    /// 1 if absent.
    #[serde(default)]
    pub seed: Option<u64>,
}

/// `scatter`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ScatterFile {
    /// None.
    #[default]
    Off,
    /// Not available yet.
    Network,
    /// Photons are followed.
    MonteCarlo,
}

/// `noise`: `false`, `true` or `"paper"`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NoiseFile(pub Noise);

impl Default for NoiseFile {
    fn default() -> Self {
        Self(Noise::Off)
    }
}

impl<'de> Deserialize<'de> for NoiseFile {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Choice;
        impl Visitor<'_> for Choice {
            type Value = NoiseFile;
            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("false, true or \"paper\"")
            }
            fn visit_bool<E: serde::de::Error>(self, on: bool) -> Result<NoiseFile, E> {
                Ok(NoiseFile(if on { Noise::True } else { Noise::Off }))
            }
            fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<NoiseFile, E> {
                match text {
                    "paper" => Ok(NoiseFile(Noise::Paper)),
                    _ => Err(E::invalid_value(serde::de::Unexpected::Str(text), &self)),
                }
            }
        }
        deserializer.deserialize_any(Choice)
    }
}
