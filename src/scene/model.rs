//! The scene as the renderers see it: objects in order, resolved to densities, shapes and material indices.

use std::path::PathBuf;
use std::sync::{Arc, OnceLock};

use glam::{DAffine3, DVec3};

use super::optics::{BeamShape, Panel};
use super::physics::{Material, Spectrum};
use crate::geometry::{Rigid, RobotModel, View};

/// A scene ready to render. A later object displaces earlier ones (DESIGN §5).
#[derive(Clone, Debug)]
pub struct Scene {
    /// Materials in order of first appearance; everything else refers to them by index.
    pub materials: Vec<Material>,
    /// Objects in order.
    pub objects: Vec<Object>,
    /// Where it is seen from, and how large the image is; session scenes have none of their own.
    pub view: Option<View>,
    /// The X-ray beam.
    pub beam: Beam,
    /// The detector.
    pub detector: Detector,
    /// What is modelled.
    pub model: Model,
    /// Files that went into it, with their SHA-256, for provenance.
    pub inputs: Vec<InputFile>,
    /// The robot, when the scene has one: what is needed to move it.
    pub robot: Option<Robot>,
    /// Rigid parts of its CTs, and what has moved since the scan.
    pub bodies: Bodies,
}

/// Rigid parts of the specimen that may lie elsewhere than they were scanned.
#[derive(Clone, Debug, Default)]
pub struct Bodies {
    /// Bodies that labels of a CT make, by CT, then by name.
    pub labelled: Vec<Arc<LabelledBody>>,
    /// Every body that the scene knows and where it is, once that was said ([`Scene::with_bodies`]).
    pub motions: Vec<Motion>,
    /// By name, what stands where a labelled body lay and nothing has come since: the filling's share of each voxel, as a density from 0 to 1.
    pub filled: Vec<(String, Arc<Volume>)>,
}

/// Voxels of a CT that are a rigid body of their own.
#[derive(Debug)]
pub struct LabelledBody {
    /// Its name.
    pub name: String,
    /// Name of the CT among [`Scene::objects`].
    pub object: String,
    /// Places in the lists of the CT's volume, ascending, at least one.
    pub voxels: Vec<usize>,
    /// What fills its place when it has moved; made when first needed.
    pub filling: OnceLock<Filling>,
}

/// What fills the place that a body left.
#[derive(Clone, Debug, PartialEq)]
pub struct Filling {
    /// Class in the CT's volume; 0 where nothing surrounds the body.
    pub class: u8,
    /// By voxel of the body.
    pub density_g_per_cm3: Vec<f32>,
}

/// Where a body is.
#[derive(Clone, Debug, PartialEq)]
pub struct Motion {
    /// Its name.
    pub body: String,
    /// From its place in the scan to its place now.
    pub lps_from_body: Rigid,
    /// How far its middle went.
    pub shift_mm: f64,
    /// What it left and the filling stands for, where labels make it.
    pub filled_cm3: f64,
}

impl Motion {
    /// By how much it turned.
    #[must_use]
    pub fn angle_deg(&self) -> f64 {
        self.lps_from_body.angle_to_rad(&Rigid::IDENTITY).to_degrees()
    }

    /// Whether it lies elsewhere than it was scanned, by more than rounding.
    #[must_use]
    pub fn is_moved(&self) -> bool {
        !is_still(&self.lps_from_body)
    }
}

/// Whether a motion is none but for rounding.
pub(super) fn is_still(motion: &Rigid) -> bool {
    motion.angle_to_rad(&Rigid::IDENTITY) < 1e-9 && motion.translation_mm.length() < 1e-6
}

/// The robot of a scene: enough to rebuild its solids for other angles.
#[derive(Clone, Debug)]
pub struct Robot {
    /// Index of its object in [`Scene::objects`].
    pub object: usize,
    /// Dimensions.
    pub model: Arc<RobotModel>,
    /// Scene material indices of body, shaft and drill.
    pub materials: [usize; 3],
    /// Densities of body, shaft and drill.
    pub densities_g_per_cm3: [f64; 3],
    /// Where the base is.
    pub lps_from_base: Rigid,
    /// The base in the frame that a tracker reports as the base.
    pub marker_from_base: Rigid,
    /// The five control angles, as the robot reports them.
    pub control_angles_deg: [f64; 5],
    /// What is added to them.
    pub control_angle_offsets_deg: [f64; 5],
    /// Notches that were clamped at the bending limit.
    pub clamped: usize,
}

/// A file that went into a result.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct InputFile {
    /// As it was named.
    pub path: String,
    /// Lower-case hexadecimal.
    pub sha256: String,
    /// Where it lay when it was read; `None` for files that come with the program.
    #[serde(skip)]
    pub place: Option<PathBuf>,
    /// The files that it consists of, where they are several (then `sha256` is that of their hashes) or DICOM.
    #[serde(skip)]
    pub parts: Vec<InputPart>,
}

/// A file of a volume that has several.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct InputPart {
    /// Where it lay.
    pub path: PathBuf,
    /// Lower-case hexadecimal.
    pub sha256: String,
    /// Its size.
    pub bytes: u64,
}

/// One object of the scene file; a robot is one object made of many solids.
#[derive(Clone, Debug)]
pub struct Object {
    /// `objects[3].sphere` and the like, for messages.
    pub name: String,
    /// The rigid body that it belongs to.
    pub body: String,
    /// Its matter. Within one object, later solids displace earlier ones.
    pub matter: Matter,
}

/// The matter of an object.
#[derive(Clone, Debug)]
pub enum Matter {
    /// A voxel grid.
    Volume(Arc<Volume>),
    /// Parts of one CT, each on a grid of its own: their densities add up, and together they displace what they displace as one.
    Parts(Vec<Arc<Volume>>),
    /// Analytic shapes, in order.
    Solids(Vec<Solid>),
    /// Closed triangle meshes.
    Mesh(Arc<Mesh>),
}

impl Matter {
    /// Its voxel grids: one, the parts, or none.
    #[must_use]
    pub fn volumes(&self) -> &[Arc<Volume>] {
        match self {
            Self::Volume(volume) => std::slice::from_ref(volume),
            Self::Parts(parts) => parts,
            Self::Solids(_) | Self::Mesh(_) => &[],
        }
    }
}

/// A voxel grid of densities; per material the field is the trilinear interpolant of ρ_m(i,j,k) between voxel centres, constant over
/// the outer half voxel, zero outside [−½, n−½].
#[derive(Clone, Debug)]
pub struct Volume {
    /// Voxels along i, j, k; i varies fastest in `density_g_per_cm3` and `class`.
    pub size: [usize; 3],
    /// Continuous voxel index to `lps` (any affine: rotated, left-handed, anisotropic).
    pub lps_from_voxel: DAffine3,
    /// Density of each voxel; 0 where `class` is 0.
    pub density_g_per_cm3: Vec<f32>,
    /// 0: nothing there (air). c > 0: matter of material `class_materials[c − 1]`.
    pub class: Vec<u8>,
    /// Scene material index per class.
    pub class_materials: Vec<usize>,
    /// Whether matter outside the grid was cut off by the scan, so that rays through a face with matter are invalid. True for CTs,
    /// false for voxelised tools.
    pub truncated_at_faces: bool,
    /// Voxels outside the reconstruction circle (padding), where nothing is known; empty if there are none.
    pub unknown: Vec<bool>,
}

impl Scene {
    /// Whether a material is air. Air displaces nothing: it counts only where no other object has matter.
    #[must_use]
    pub fn is_air(&self, material: usize) -> bool {
        self.materials.get(material).is_some_and(|material| material.name == "air")
    }
}

/// How far tissue goes on beyond a face that it reaches, mm: across the patient, where a field of view cuts skin and arms, and along.
const BEYOND_MM: (f64, f64) = (50.0, 2000.0);

impl Volume {
    /// How far tissue that reaches a face across `axis` may go on beyond it, mm.
    #[must_use]
    pub fn beyond_face_mm(&self, axis: usize) -> f64 {
        let step = self.lps_from_voxel.matrix3.col(axis);
        let along = step.z.abs() > std::f64::consts::FRAC_1_SQRT_2 * step.length();
        if along { BEYOND_MM.1 } else { BEYOND_MM.0 }
    }

    /// Index of voxel (i, j, k) in the arrays.
    #[must_use]
    pub fn index(&self, i: usize, j: usize, k: usize) -> usize {
        i + self.size[0] * (j + self.size[1] * k)
    }
}

/// A convex shape, or a tube, of one material and density.
#[derive(Clone, Debug, PartialEq)]
pub struct Solid {
    /// In its own frame.
    pub shape: Shape,
    /// Pose of the shape.
    pub lps_from_local: Rigid,
    /// Scene material index.
    pub material: usize,
    /// Its density.
    pub density_g_per_cm3: f64,
}

/// Shapes in their own frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// Centre at the origin; a sphere has equal axes.
    Ellipsoid {
        /// Half axes along x, y, z.
        semi_axes_mm: DVec3,
    },
    /// Centre at the origin, faces parallel to the axes.
    Cuboid {
        /// Half sizes along x, y, z.
        half_size_mm: DVec3,
    },
    /// Along +z from the origin, flat ends; hollow when `inner_radius_mm` > 0, and the lumen displaces nothing.
    Cylinder {
        /// Length along z.
        length_mm: f64,
        /// Outer radius.
        radius_mm: f64,
        /// Radius of the lumen, 0 for a rod.
        inner_radius_mm: f64,
    },
}

impl Shape {
    /// Centre (local frame) and radius of a sphere around the shape, in mm.
    #[must_use]
    pub fn bounding_sphere(&self) -> (DVec3, f64) {
        match *self {
            Self::Ellipsoid { semi_axes_mm } => (DVec3::ZERO, semi_axes_mm.max_element()),
            Self::Cuboid { half_size_mm } => (DVec3::ZERO, half_size_mm.length()),
            Self::Cylinder { length_mm, radius_mm, .. } => {
                (DVec3::new(0.0, 0.0, 0.5 * length_mm), (0.25 * length_mm * length_mm + radius_mm * radius_mm).sqrt())
            }
        }
    }
}

/// A closed triangle mesh in `lps`, outward normals; its matter is where the winding number is not 0 (> 0 unless shells overlap oddly),
/// so an inner shell with inward normals is a cavity and overlapping shells are one solid.
#[derive(Clone, Debug, PartialEq)]
pub struct Mesh {
    /// Vertices in `lps`.
    pub vertices_lps_mm: Vec<DVec3>,
    /// Vertex indices, counter-clockwise seen from outside.
    pub triangles: Vec<[u32; 3]>,
    /// Scene material index.
    pub material: usize,
    /// Its density.
    pub density_g_per_cm3: f64,
}

/// The X-ray beam.
#[derive(Clone, Debug)]
pub struct Beam {
    /// Photon fractions after filtration, Σφ = 1.
    pub spectrum: Spectrum,
    /// N₀ on the principal ray with no object in the beam, behind filters and bow-tie, before grid and detector.
    pub photons_per_pixel: f64,
    /// Heel, bow-tie, collimation, focal spot.
    pub shape: BeamShape,
}

/// What the detector sums up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Response {
    /// r_k = E_k.
    Energy,
    /// r_k = 1.
    Counting,
}

/// The detector.
#[derive(Clone, Debug, PartialEq)]
pub struct Detector {
    /// Energy-integrating or photon-counting.
    pub response: Response,
    /// Pixel pitch; with fx it gives the source-to-detector distance.
    pub pitch_mm: f64,
    /// Odd square kernel with sum 1 that correlates quantum noise; 1×1 when absent.
    pub crosstalk: Vec<Vec<f64>>,
    /// Standard deviation in units of the unattenuated signal, and correlation of neighbours along a row.
    pub readout_noise: Option<ReadoutNoise>,
    /// counts = gain · detected signal + offset.
    pub gain: f64,
    /// See `gain`.
    pub offset: f64,
    /// Scintillator, grid, blur, saturation, digits.
    pub panel: Panel,
}

/// Electronic noise.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReadoutNoise {
    /// In units of the unattenuated signal on the principal ray.
    pub sigma: f64,
    /// Correlation of neighbouring pixels in a row, in [0, 1).
    #[serde(default)]
    pub row_correlation: f64,
}

/// Which image formation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Formation {
    /// Polychromatic, every material (Eq. 6).
    Deepdrr,
    /// One attenuation for everything (Eq. 8).
    Naive,
}

/// Which quantum noise.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Noise {
    /// None.
    Off,
    /// As the paper has it: Ē·(Poisson(N) − N)/N₀.
    Paper,
    /// With the compound-Poisson factor √(⟨E²⟩/Ē²) of an energy-integrating detector.
    True,
}

/// What a volume is between its voxel centres.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Voxels {
    /// Per material, the trilinear interpolant of density: what this program means by a volume (DESIGN §5).
    #[default]
    Trilinear,
    /// Constant inside each voxel, as Siddon (1985) and the tools after him have it. A point on a face belongs to the voxel above.
    PiecewiseConstant,
}

/// What is modelled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Model {
    /// Image formation.
    pub formation: Formation,
    /// What volumes are between voxel centres.
    pub voxels: Voxels,
    /// Scattered radiation.
    pub scatter: ScatterModel,
    /// Quantum noise; readout noise goes with it.
    pub noise: Noise,
    /// Seed of the random numbers.
    pub seed: u64,
}

impl Model {
    /// The scatter that images have: naive formation (Eq. 8) has none, whatever is asked.
    #[must_use]
    pub fn possible_scatter(&self) -> ScatterModel {
        if self.formation == Formation::Naive { ScatterModel::Off } else { self.scatter }
    }
}

/// What becomes of scattered radiation.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ScatterModel {
    /// It is left out.
    #[default]
    Off,
    /// Photons are followed, and what of them reaches the detector is added.
    MonteCarlo,
    /// A network that was trained on such photons says what reaches the detector.
    Network,
}

impl Model {
    /// What to say where noise is asked of a formation that has none.
    #[must_use]
    pub fn noise_left_out(&self) -> Option<&'static str> {
        (self.noise != Noise::Off && self.formation == Formation::Naive)
            .then_some("naive formation (Eq. 8) has no noise: model.noise is left out; formation \"deepdrr\" has it")
    }
}
