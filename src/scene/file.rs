//! The scene file as typed (DESIGN §7): every key is known or an error.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::de::value::MapAccessDeserializer;
use serde::de::{MapAccess, Visitor};
use serde::{Deserialize, Deserializer};
use serde_json::Value;

use super::model::{Formation, ReadoutNoise, Response};
use crate::geometry::{CarmJoints, Intrinsics, Rigid};

/// A scene file.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneFile {
    /// In order; a later one displaces earlier ones.
    pub objects: Vec<ObjectEntry>,
    /// Absent in session scenes.
    #[serde(default)]
    pub view: Option<ViewEntry>,
    /// The beam.
    pub beam: BeamEntry,
    /// The detector.
    pub detector: DetectorEntry,
    /// What is modelled.
    #[serde(default)]
    pub model: ModelEntry,
}

/// One object.
#[derive(Clone, Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ObjectEntry {
    /// A CT.
    Ct(CtEntry),
    /// A closed triangle mesh.
    Mesh(MeshEntry),
    /// A voxelised tool.
    Voxels(VoxelsEntry),
    /// A sphere.
    Sphere(SphereEntry),
    /// An ellipsoid.
    Ellipsoid(EllipsoidEntry),
    /// A box.
    Box(BoxEntry),
    /// A rod or tube.
    Cylinder(CylinderEntry),
    /// The snake robot.
    Robot(RobotEntry),
}

/// A CT and how its voxels become matter.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CtEntry {
    /// NIfTI file.
    pub path: PathBuf,
    /// `"threshold"` or a label map.
    #[serde(default)]
    pub materials: Materials,
    /// `"keep"` gives air its density.
    #[serde(default)]
    pub air: Option<String>,
    /// The rigid body that it belongs to.
    #[serde(default)]
    pub body: Option<String>,
}

/// How voxels are classified.
#[derive(Clone, Debug, Default)]
pub enum Materials {
    /// By HU.
    #[default]
    Threshold,
    /// By a label map.
    Labels(LabelsEntry),
}

/// A label map.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LabelsEntry {
    /// NIfTI file on the CT's grid.
    pub labels: PathBuf,
    /// Material of labels that `map` does not name.
    #[serde(default = "soft_tissue")]
    pub default: String,
    /// Material per label.
    #[serde(default)]
    pub map: BTreeMap<u32, LabelMaterial>,
}

fn soft_tissue() -> String {
    "soft_tissue".to_owned()
}

/// A label's material, and whether its density is nominal instead of from HU.
#[derive(Clone, Debug)]
pub struct LabelMaterial {
    /// Name or formula.
    pub material: String,
    /// `"density": "nominal"`.
    pub nominal_density: bool,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct LabelMaterialMap {
    material: String,
    #[serde(default)]
    density: Option<String>,
}

impl<'de> Deserialize<'de> for LabelMaterial {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Either;
        impl<'de> Visitor<'de> for Either {
            type Value = LabelMaterial;
            fn expecting(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                f.write_str("a material name or {\"material\": …, \"density\": \"nominal\"}")
            }
            fn visit_str<E: serde::de::Error>(self, name: &str) -> Result<LabelMaterial, E> {
                Ok(LabelMaterial { material: name.to_owned(), nominal_density: false })
            }
            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<LabelMaterial, A::Error> {
                let found = LabelMaterialMap::deserialize(MapAccessDeserializer::new(map))?;
                match found.density.as_deref() {
                    None | Some("hu") => Ok(LabelMaterial { material: found.material, nominal_density: false }),
                    Some("nominal") => Ok(LabelMaterial { material: found.material, nominal_density: true }),
                    Some(other) => {
                        Err(serde::de::Error::custom(format!("density is \"{other}\", expected \"nominal\" or \"hu\"")))
                    }
                }
            }
        }
        deserializer.deserialize_any(Either)
    }
}

impl<'de> Deserialize<'de> for Materials {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Either;
        impl<'de> Visitor<'de> for Either {
            type Value = Materials;
            fn expecting(&self, f: &mut std::fmt::Formatter) -> std::fmt::Result {
                f.write_str("\"threshold\" or {\"labels\": …, \"default\": …, \"map\": …}")
            }
            fn visit_str<E: serde::de::Error>(self, word: &str) -> Result<Materials, E> {
                if word == "threshold" {
                    return Ok(Materials::Threshold);
                }
                Err(E::custom(format!("materials is \"{word}\", expected \"threshold\" or a label map")))
            }
            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<Materials, A::Error> {
                LabelsEntry::deserialize(MapAccessDeserializer::new(map)).map(Materials::Labels)
            }
        }
        deserializer.deserialize_any(Either)
    }
}

/// A mesh.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeshEntry {
    /// STL file, mm.
    pub path: PathBuf,
    /// Material.
    pub material: String,
    /// Pose.
    #[serde(default)]
    pub lps_from_mesh: Option<Rigid>,
    /// Instead of the nominal density.
    #[serde(default)]
    pub density_g_per_cm3: Option<f64>,
    /// The rigid body that it belongs to.
    #[serde(default)]
    pub body: Option<String>,
}

/// A voxelised tool.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VoxelsEntry {
    /// NIfTI file of volume fractions.
    pub path: PathBuf,
    /// Material.
    pub material: String,
    /// Moves the file's own LPS.
    #[serde(default)]
    pub lps_from_voxels_frame: Option<Rigid>,
    /// Instead of the nominal density.
    #[serde(default)]
    pub density_g_per_cm3: Option<f64>,
    /// The rigid body that it belongs to.
    #[serde(default)]
    pub body: Option<String>,
}

/// A sphere.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SphereEntry {
    /// Centre.
    pub centre_lps_mm: [f64; 3],
    /// Radius.
    pub radius_mm: f64,
    /// Material.
    pub material: String,
    /// Instead of the nominal density.
    #[serde(default)]
    pub density_g_per_cm3: Option<f64>,
    /// The rigid body that it belongs to.
    #[serde(default)]
    pub body: Option<String>,
}

/// An ellipsoid.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EllipsoidEntry {
    /// Centre.
    pub centre_lps_mm: [f64; 3],
    /// Half axes.
    pub semi_axes_mm: [f64; 3],
    /// Rotation.
    #[serde(default)]
    pub rotation_lps_from_local: Option<[[f64; 3]; 3]>,
    /// Material.
    pub material: String,
    /// Instead of the nominal density.
    #[serde(default)]
    pub density_g_per_cm3: Option<f64>,
    /// The rigid body that it belongs to.
    #[serde(default)]
    pub body: Option<String>,
}

/// A box.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BoxEntry {
    /// Centre.
    pub centre_lps_mm: [f64; 3],
    /// Edge lengths.
    pub size_mm: [f64; 3],
    /// Rotation.
    #[serde(default)]
    pub rotation_lps_from_local: Option<[[f64; 3]; 3]>,
    /// Material.
    pub material: String,
    /// Instead of the nominal density.
    #[serde(default)]
    pub density_g_per_cm3: Option<f64>,
    /// The rigid body that it belongs to.
    #[serde(default)]
    pub body: Option<String>,
}

/// A rod or tube.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CylinderEntry {
    /// One end.
    pub from_lps_mm: [f64; 3],
    /// Other end.
    pub to_lps_mm: [f64; 3],
    /// Outer radius.
    pub radius_mm: f64,
    /// Radius of the lumen.
    #[serde(default)]
    pub inner_radius_mm: f64,
    /// Material.
    pub material: String,
    /// Instead of the nominal density.
    #[serde(default)]
    pub density_g_per_cm3: Option<f64>,
    /// The rigid body that it belongs to.
    #[serde(default)]
    pub body: Option<String>,
}

/// The snake robot.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotEntry {
    /// A file of `calibration/robot/`.
    pub model: PathBuf,
    /// Where its base is.
    pub lps_from_base: Rigid,
    /// The five control angles.
    pub control_angles_deg: [f64; 5],
    /// The rigid body that it belongs to.
    #[serde(default)]
    pub body: Option<String>,
}

/// Where the scene is seen from: K and pose, or P, or a C-arm's joints.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ViewEntry {
    /// Columns and rows; with `carm` the calibration's when absent.
    #[serde(default)]
    pub size_px: Option<[u32; 2]>,
    /// K.
    #[serde(default)]
    pub intrinsics: Option<Intrinsics>,
    /// Pose.
    #[serde(default)]
    pub camera_from_lps: Option<Rigid>,
    /// P instead of both.
    #[serde(default)]
    pub projection: Option<[[f64; 4]; 3]>,
    /// Joints instead of both.
    #[serde(default)]
    pub carm: Option<CarmJoints>,
    /// With `carm`: a file of `calibration/carm/`.
    #[serde(default)]
    pub calibration: Option<PathBuf>,
    /// With `carm`: where the specimen lies.
    #[serde(default)]
    pub world_from_lps: Option<Rigid>,
}

/// The beam.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BeamEntry {
    /// Tube voltage of a tungsten anode.
    #[serde(default)]
    pub tube_kvp: Option<f64>,
    /// Anode angle; 12 degrees when absent.
    #[serde(default)]
    pub anode_angle_deg: Option<f64>,
    /// Thickness per material.
    #[serde(default)]
    pub filtration_mm: BTreeMap<String, f64>,
    /// One energy instead.
    #[serde(default)]
    pub mono_kev: Option<f64>,
    /// A file instead.
    #[serde(default)]
    pub spectrum_csv: Option<PathBuf>,
    /// N₀ on the principal ray with nothing in the beam.
    #[serde(default = "photons")]
    pub photons_per_pixel: f64,
    #[serde(default)]
    pub(super) bowtie: Option<Value>,
    #[serde(default)]
    pub(super) heel: Option<Value>,
    #[serde(default)]
    pub(super) focal_spot_mm: Option<Value>,
    #[serde(default)]
    pub(super) field: Option<Value>,
}

fn photons() -> f64 {
    5e5
}

/// The detector.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DetectorEntry {
    /// `energy` or `counting`.
    #[serde(default = "energy")]
    pub response: Response,
    /// Pixel pitch.
    pub pitch_mm: f64,
    /// Odd square kernel, sum 1.
    #[serde(default)]
    pub crosstalk: Option<Vec<Vec<f64>>>,
    /// Electronic noise.
    #[serde(default)]
    pub readout_noise: Option<ReadoutNoise>,
    /// Of `counts`.
    #[serde(default = "one")]
    pub gain: f64,
    /// Of `counts`.
    #[serde(default)]
    pub offset: f64,
    #[serde(default)]
    pub(super) scintillator: Option<Value>,
    #[serde(default)]
    pub(super) blur_fwhm_mm: Option<Value>,
    #[serde(default)]
    pub(super) bits: Option<Value>,
    #[serde(default)]
    pub(super) saturation: Option<Value>,
    #[serde(default)]
    pub(super) grid: Option<Value>,
    #[serde(default)]
    pub(super) intensifier: Option<Value>,
}

fn energy() -> Response {
    Response::Energy
}

fn one() -> f64 {
    1.0
}

/// What is modelled.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ModelEntry {
    /// `deepdrr` or `naive`.
    pub formation: Formation,
    /// `off`; the others are not available yet.
    pub scatter: String,
    /// `false`, `true` or `"paper"`.
    pub noise: Value,
    /// Seed of the random numbers.
    pub seed: u64,
}

impl Default for ModelEntry {
    fn default() -> Self {
        Self { formation: Formation::Deepdrr, scatter: "off".to_owned(), noise: Value::Bool(false), seed: 1 }
    }
}
