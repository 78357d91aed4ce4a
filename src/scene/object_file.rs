//! Objects as a scene file writes them (DESIGN §7).

use std::collections::BTreeMap;

use serde::Deserialize;
use serde::de::{DeserializeSeed, Deserializer, Error as _, IntoDeserializer, MapAccess, Visitor, value::MapAccessDeserializer};

use crate::geometry::Rigid;

/// Default of `body`.
pub const BODY: &str = "specimen";

/// One object, named by its kind.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ObjectFile {
    /// A CT in Hounsfield units.
    Ct(CtFile),
    /// A closed surface.
    Mesh(MeshFile),
    /// Volume fractions of one material.
    Voxels(VoxelsFile),
    /// A ball.
    Sphere(SphereFile),
    /// An ellipsoid.
    Ellipsoid(EllipsoidFile),
    /// A cuboid.
    Box(BoxFile),
    /// A rod or a tube.
    Cylinder(CylinderFile),
    /// The snake robot.
    Robot(RobotFile),
}

/// `{"ct": …}`
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CtFile {
    /// NIfTI, NRRD or MetaImage volume, or a DICOM series: its folder, or one of its slices.
    pub path: String,
    /// How voxels become materials, by threshold if absent.
    #[serde(default)]
    pub materials: MaterialsFile,
    /// What becomes of air.
    #[serde(default)]
    pub air: AirFile,
    /// Rigid part of the specimen.
    #[serde(default)]
    pub body: Option<String>,
}

/// What becomes of air in a CT (DESIGN §5).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AirFile {
    /// Room air is nothing; lung, airways and gas within the body keep their density.
    #[default]
    Ambient,
    /// Room air too, as the material `air` at the density of the curve.
    Keep,
    /// All that is thinner than tissue is nothing.
    Drop,
}

/// `"threshold"`, `"network"`, `{"network": …}` or `{"labels": …}`.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum MaterialsFile {
    /// By Hounsfield number.
    #[default]
    Threshold,
    /// By a label map.
    Labels(LabelsFile),
    /// By a network: the one that comes with the program, or the one of these weights, `NAME.safetensors`.
    Network(Option<String>),
}

/// Labels to materials. Where a label is meant, its number or its name may stand.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LabelsFile {
    /// Label volume on the grid of the CT.
    pub labels: String,
    /// Names of labels, as CSV with the columns `id` and `structure`; if absent those that the label volume holds, else those of
    /// `label-names.csv` beside it.
    #[serde(default)]
    pub names: Option<String>,
    /// Material of labels that `map` does not name, where it is not air by threshold; `soft_tissue` if absent.
    #[serde(default)]
    pub default: Option<String>,
    /// What takes the place of `default`.
    #[serde(default, rename = "else")]
    pub otherwise: Option<ElseFile>,
    /// Material by label.
    #[serde(default)]
    pub map: MapFile,
    /// Materials of labels that `map` does not name.
    #[serde(default)]
    pub preset: Option<PresetFile>,
    /// Labels of each rigid part that may have moved since the scan; all others are of the CT's own `body`.
    #[serde(default)]
    pub bodies: BTreeMap<String, Vec<LabelFile>>,
}

/// What labels are that nothing names.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ElseFile {
    /// As without labels.
    Threshold,
    /// As the network says that comes with the program.
    Network,
}

/// Materials of the labels of a well-known segmentation, by their names.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PresetFile {
    /// TotalSegmentator, task `total`.
    #[serde(rename = "totalsegmentator")]
    TotalSegmentator,
}

/// The name of a preset, or materials by label.
#[derive(Clone, Debug, PartialEq)]
pub enum MapFile {
    /// `"totalsegmentator"`
    Preset(PresetFile),
    /// `{"hip_left": "bone_cortical"}`
    Own(BTreeMap<String, LabelMaterialFile>),
}

impl Default for MapFile {
    fn default() -> Self {
        Self::Own(BTreeMap::new())
    }
}

/// A label's number or name.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelFile(pub String);

/// `"bone_cortical"` or `{"material": "titanium", "density": "nominal"}`.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelMaterialFile {
    /// Name, formula or mass fractions.
    pub material: String,
    /// Where the density comes from.
    pub density: DensityFile,
}

/// Where a labelled voxel's density comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DensityFile {
    /// From its Hounsfield number.
    #[default]
    Hu,
    /// The material's nominal density.
    Nominal,
}

/// `{"mesh": …}`
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MeshFile {
    /// STL in mm.
    pub path: String,
    /// What it is made of.
    pub material: String,
    /// Pose; if absent, the file's coordinates are LPS, or what its header says.
    #[serde(default)]
    pub lps_from_mesh: Option<Rigid>,
    /// Density; nominal if absent.
    #[serde(default)]
    pub density_g_per_cm3: Option<f64>,
    /// Rigid part of the specimen.
    #[serde(default)]
    pub body: Option<String>,
}

/// `{"voxels": …}`
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VoxelsFile {
    /// Volume of fractions 0–1.
    pub path: String,
    /// What it is made of.
    pub material: String,
    /// From the file's own LPS.
    #[serde(default = "identity")]
    pub lps_from_voxels_frame: Rigid,
    /// Density at fraction 1; nominal if absent.
    #[serde(default)]
    pub density_g_per_cm3: Option<f64>,
    /// Rigid part of the specimen.
    #[serde(default)]
    pub body: Option<String>,
}

/// `{"sphere": …}`
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SphereFile {
    /// Centre.
    pub centre_lps_mm: [f64; 3],
    /// Radius.
    pub radius_mm: f64,
    /// What it is made of.
    pub material: String,
    /// Density; nominal if absent.
    #[serde(default)]
    pub density_g_per_cm3: Option<f64>,
    /// Rigid part of the specimen.
    #[serde(default)]
    pub body: Option<String>,
}

/// `{"ellipsoid": …}`
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EllipsoidFile {
    /// Centre.
    pub centre_lps_mm: [f64; 3],
    /// Half axes.
    pub semi_axes_mm: [f64; 3],
    /// Axes' directions; parallel to LPS if absent.
    #[serde(default = "unturned")]
    pub rotation_lps_from_local: [[f64; 3]; 3],
    /// What it is made of.
    pub material: String,
    /// Density; nominal if absent.
    #[serde(default)]
    pub density_g_per_cm3: Option<f64>,
    /// Rigid part of the specimen.
    #[serde(default)]
    pub body: Option<String>,
}

/// `{"box": …}`
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BoxFile {
    /// Centre.
    pub centre_lps_mm: [f64; 3],
    /// Edge lengths.
    pub size_mm: [f64; 3],
    /// Edges' directions; parallel to LPS if absent.
    #[serde(default = "unturned")]
    pub rotation_lps_from_local: [[f64; 3]; 3],
    /// What it is made of.
    pub material: String,
    /// Density; nominal if absent.
    #[serde(default)]
    pub density_g_per_cm3: Option<f64>,
    /// Rigid part of the specimen.
    #[serde(default)]
    pub body: Option<String>,
}

/// `{"cylinder": …}`
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CylinderFile {
    /// Middle of one end.
    pub from_lps_mm: [f64; 3],
    /// Middle of the other.
    pub to_lps_mm: [f64; 3],
    /// Outer radius.
    pub radius_mm: f64,
    /// Radius of the lumen, 0 for a rod.
    #[serde(default)]
    pub inner_radius_mm: f64,
    /// What it is made of.
    pub material: String,
    /// Density; nominal if absent.
    #[serde(default)]
    pub density_g_per_cm3: Option<f64>,
    /// Rigid part of the specimen.
    #[serde(default)]
    pub body: Option<String>,
}

/// `{"robot": …}`
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RobotFile {
    /// Model file.
    pub model: String,
    /// Pose of the base; stands in the calibration where that has one.
    #[serde(default)]
    pub lps_from_base: Option<Rigid>,
    /// The five control angles, as the robot reports them.
    #[serde(default)]
    pub control_angles_deg: [f64; 5],
    /// A file of `calibrate robot`.
    #[serde(default)]
    pub calibration: Option<String>,
    /// Rigid part of the specimen.
    #[serde(default)]
    pub body: Option<String>,
}

fn identity() -> Rigid {
    Rigid::IDENTITY
}

fn unturned() -> [[f64; 3]; 3] {
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
}

impl<'de> Deserialize<'de> for MaterialsFile {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Materials;
        impl<'de> Visitor<'de> for Materials {
            type Value = MaterialsFile;
            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("\"threshold\", \"network\", {\"network\": …} or {\"labels\": …, \"map\": …}")
            }
            fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<MaterialsFile, E> {
                match text {
                    "threshold" => Ok(MaterialsFile::Threshold),
                    "network" => Ok(MaterialsFile::Network(None)),
                    _ => Err(E::invalid_value(serde::de::Unexpected::Str(text), &self)),
                }
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<MaterialsFile, A::Error> {
                let first: Option<String> = map.next_key()?;
                if first.as_deref() == Some("network") {
                    let name = map.next_value()?;
                    return match map.next_key::<String>()? {
                        Some(other) => Err(A::Error::custom(format!("unknown field `{other}` beside `network`"))),
                        None => Ok(MaterialsFile::Network(Some(name))),
                    };
                }
                let whole = Again { first, rest: map };
                LabelsFile::deserialize(MapAccessDeserializer::new(whole)).map(MaterialsFile::Labels)
            }
        }
        deserializer.deserialize_any(Materials)
    }
}

/// A map whose first key was read already.
struct Again<A> {
    first: Option<String>,
    rest: A,
}

impl<'de, A: MapAccess<'de>> MapAccess<'de> for Again<A> {
    type Error = A::Error;

    fn next_key_seed<K: DeserializeSeed<'de>>(&mut self, seed: K) -> Result<Option<K::Value>, A::Error> {
        match self.first.take() {
            Some(first) => seed.deserialize(first.into_deserializer()).map(Some),
            None => self.rest.next_key_seed(seed),
        }
    }

    fn next_value_seed<V: DeserializeSeed<'de>>(&mut self, seed: V) -> Result<V::Value, A::Error> {
        self.rest.next_value_seed(seed)
    }
}

impl<'de> Deserialize<'de> for LabelMaterialFile {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        #[derive(Deserialize)]
        #[serde(deny_unknown_fields)]
        struct Full {
            material: String,
            #[serde(default)]
            density: DensityFile,
        }
        struct Entry;
        impl<'de> Visitor<'de> for Entry {
            type Value = LabelMaterialFile;
            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("a material or {\"material\": …, \"density\": \"nominal\"}")
            }
            fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<LabelMaterialFile, E> {
                Ok(LabelMaterialFile { material: text.to_owned(), density: DensityFile::Hu })
            }
            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<LabelMaterialFile, A::Error> {
                let full = Full::deserialize(MapAccessDeserializer::new(map))?;
                Ok(LabelMaterialFile { material: full.material, density: full.density })
            }
        }
        deserializer.deserialize_any(Entry)
    }
}

impl<'de> Deserialize<'de> for MapFile {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Map;
        impl<'de> Visitor<'de> for Map {
            type Value = MapFile;
            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("a preset's name (\"totalsegmentator\") or materials by label")
            }
            fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<MapFile, E> {
                PresetFile::deserialize(text.into_deserializer()).map(MapFile::Preset)
            }
            fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<MapFile, A::Error> {
                BTreeMap::deserialize(MapAccessDeserializer::new(map)).map(MapFile::Own)
            }
        }
        deserializer.deserialize_any(Map)
    }
}

impl<'de> Deserialize<'de> for LabelFile {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Label;
        impl Visitor<'_> for Label {
            type Value = LabelFile;
            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("a label's number or name")
            }
            fn visit_u64<E: serde::de::Error>(self, number: u64) -> Result<LabelFile, E> {
                Ok(LabelFile(number.to_string()))
            }
            fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<LabelFile, E> {
                Ok(LabelFile(text.to_owned()))
            }
        }
        deserializer.deserialize_any(Label)
    }
}
