//! A world as buffers: the same tables that the processor's histories read.

use glam::{DAffine3, DVec3};

use super::layout::{CellBox, Job, Thing};
use crate::render::wgsl::layout::{MESH, Node, nodes_of};
use crate::scene::model::Shape;
use crate::scene::optics::{Axis, Field};
use crate::scene::physics::ENERGY_RANGE_KEV;
use crate::transport::cells::Cells;
use crate::transport::contents::{Content, Mixture};
use crate::transport::flight::Space;
use crate::transport::history::{Estimator, World};
use crate::transport::matter::{Body, Grid, MeshBody};
use glam::DVec2;

/// Materials and parts of a point that the shader holds.
const MATERIALS: usize = 16;
/// Things of a scene: a box counts them in 16 bits.
const THINGS: usize = 0xffff;
/// Classes of a voxel.
const CLASSES: usize = 15;
/// What a voxel's density is counted in, g/cm³, and the largest count.
const DENSITY_UNIT: f64 = 1e-7;
const MOST_DENSITY: u32 = 0x0fff_ffff;
/// The kind of a volume among things.
const VOLUME: u32 = 4;
/// What rounding to f32 may take from a bound of densities.
const ROUNDING: f64 = 1e-6;

/// The buffers.
#[derive(Clone, Debug, Default)]
pub struct Packed {
    pub job: Job,
    pub numbers: Vec<f32>,
    pub indices: Vec<u32>,
    pub boxes: Vec<CellBox>,
    pub things: Vec<Thing>,
    pub voxels: Vec<u32>,
    pub nodes: Vec<Node>,
}

/// The constants that the shader shares with the tables.
#[must_use]
pub fn constants() -> [(&'static str, f64); 15] {
    use crate::transport::{attenuation, beam_shape, compton, flight, panel, rayleigh};
    [
        ("ELECTRON_KEV", compton::ELECTRON_KEV),
        ("KEV_ANGSTROM", compton::KEV_ANGSTROM),
        ("ROWS_PER_KEV", attenuation::ROWS_PER_KEV),
        ("RESPONSE_PER_KEV", panel::ROWS_PER_KEV),
        ("COMPTON_NORMS_PER_KEV", compton::NORMS_PER_KEV),
        ("RAYLEIGH_NORMS_PER_KEV", rayleigh::NORMS_PER_KEV),
        ("INCOHERENT_PER_UNIT_X", compton::ROWS_PER_UNIT_X),
        ("SQUARES_PER_UNIT_X", rayleigh::STEPS_PER_UNIT_X),
        ("ENVELOPE_KEV", compton::ENVELOPE_KEV),
        ("COSINES", compton::ENVELOPE_COSINES as f64),
        ("GUIDES", rayleigh::GUIDES as f64),
        ("HEEL_FIRST_DEG", beam_shape::FIRST_DEG),
        ("HEEL_STEP_DEG", beam_shape::STEP_DEG),
        ("DENSITY_UNIT", DENSITY_UNIT),
        ("NEAR_MM", flight::NEAR_MM),
    ]
}

/// Why the shader cannot follow photons through this world; `None` when it can.
#[must_use]
pub fn unsupported(world: &World) -> Option<String> {
    if world.materials.len() > MATERIALS {
        return Some(format!("{} materials, the shader takes {MATERIALS}", world.materials.len()));
    }
    if world.dose.is_some() {
        return Some("the shader keeps no map of the dose".to_owned());
    }
    let things = || world.space.iter().flat_map(|space| &space.things);
    if things().count() > THINGS {
        return Some(format!("{} shapes, meshes and volumes, the shader takes {THINGS}", things().count()));
    }
    for thing in things() {
        match &thing.body {
            Body::Volume(grid) if grid.classes.len() > CLASSES => {
                return Some(format!("a CT of {} materials, the shader takes {CLASSES}", grid.classes.len()));
            }
            Body::Volume(grid) => {
                let most = grid.volume.density_g_per_cm3.iter().copied().fold(0.0, f32::max);
                if f64::from(most) > DENSITY_UNIT * f64::from(MOST_DENSITY) {
                    return Some(format!("a CT of up to {most:.1} g/cm3, the shader counts to 26.8"));
                }
            }
            Body::Solid(_) | Body::Mesh(_) => {}
        }
    }
    None
}

/// Voxels of all volumes.
#[must_use]
pub fn voxels(world: &World) -> u64 {
    let of_thing = |thing: &crate::transport::matter::Thing| match &thing.body {
        Body::Volume(grid) => grid.volume.density_g_per_cm3.len() as u64,
        Body::Solid(_) | Body::Mesh(_) => 0,
    };
    world.space.iter().flat_map(|space| &space.things).map(of_thing).sum()
}

impl Packed {
    /// `world`, which is not [`unsupported`].
    #[must_use]
    pub fn new(world: &World) -> Self {
        let mut packed = Self::default();
        packed.add_physics(world);
        let origin = world.space.as_ref().map_or(world.panel.source, |space| {
            let bounds = space.cells.bounds();
            0.5 * (bounds.low + bounds.high)
        });
        packed.add_beam(world, origin);
        if let Some(space) = &world.space {
            packed.job.has_space = 1;
            packed.add_space(space, origin);
        }
        // A buffer of nothing is none.
        packed.numbers.push(0.0);
        packed.indices.push(0);
        packed.voxels.push(0);
        packed.things.push(Thing::default());
        packed.boxes.push(CellBox::default());
        packed.nodes.push(Node::default());
        packed
    }

    fn numbers(&mut self, rows: usize, values: impl IntoIterator<Item = f64>) -> [u32; 2] {
        let first = self.numbers.len() as u32;
        self.numbers.extend(values.into_iter().map(|value| value as f32));
        [first, rows as u32]
    }

    fn indices(&mut self, values: impl IntoIterator<Item = u32>) -> u32 {
        let first = self.indices.len() as u32;
        self.indices.extend(values);
        first
    }

    fn add_physics(&mut self, world: &World) {
        let materials = &world.materials;
        let first = &materials.first().map(|material| (material.attenuation.mm2_per_mg.len(), material.compton.incoherent.len()));
        let (rows, incoherent) = first.unwrap_or((2, 2));
        let attenuation = materials.iter().flat_map(|material| {
            let shares = || material.attenuation.shares.iter();
            let mu = material.attenuation.mm2_per_mg.iter().copied();
            mu.chain(shares().map(|share| share.photo)).chain(shares().map(|share| share.photo_or_compton))
        });
        self.job.attenuation = self.numbers(rows, attenuation);
        self.job.incoherent = self.numbers(incoherent, materials.iter().flat_map(|material| material.compton.incoherent.clone()));
        let envelopes = || materials.iter().flat_map(|material| &material.compton.envelopes);
        let entries =
            envelopes().flat_map(|one| one.bounds.iter().zip(&one.boxes.slots).flat_map(|(bound, (own, _))| [*bound, *own]));
        let rows = |count: fn(&crate::transport::history::Material) -> usize| materials.first().map_or(2, count);
        self.job.envelope = self.numbers(rows(|material| material.compton.envelopes.len()), entries);
        self.job.envelope_other = self.indices(envelopes().flat_map(|one| one.boxes.slots.iter().map(|(_, other)| *other)));
        let norms = materials.iter().flat_map(|material| material.compton.norms.clone());
        self.job.compton_norm = self.numbers(rows(|material| material.compton.norms.len()), norms);
        let squares = materials.iter().flat_map(|material| material.rayleigh.squares.clone());
        self.job.squares = self.numbers(rows(|material| material.rayleigh.squares.len()), squares);
        let below = materials.iter().flat_map(|material| material.rayleigh.below.clone());
        self.job.below = self.numbers(rows(|material| material.rayleigh.below.len()), below);
        let norms = materials.iter().flat_map(|material| material.rayleigh.norms.clone());
        self.job.rayleigh_norm = self.numbers(rows(|material| material.rayleigh.norms.len()), norms);
        let guides = self.indices(materials.iter().flat_map(|material| material.rayleigh.guides.clone()));
        self.job.guides = [guides, 0];
        self.job.materials = materials.len() as u32;
    }

    fn add_beam(&mut self, world: &World, origin: DVec3) {
        let (panel, source) = (&world.panel, &world.source);
        let with = |v: DVec3, w: f64| [v.x as f32, v.y as f32, v.z as f32, w as f32];
        self.job.source = with(panel.source - origin, panel.distance_mm);
        self.job.axis_x = with(panel.axes[0], source.sigma_mm.x);
        self.job.axis_y = with(panel.axes[1], source.sigma_mm.y);
        self.job.axis_z = with(panel.axes[2], panel.area_mm2);
        let (k, size) = (&panel.view.intrinsics, panel.view.size_px.map(f64::from));
        let per_mm = [k.fx / size[0], k.skew / size[0], k.fy / size[1]].map(|value| value / panel.distance_mm);
        self.job.share_from_plane = [per_mm[0], per_mm[1], (k.cx + 0.5) / size[0], per_mm[2]].map(|value| value as f32);
        let (from_kev, to_kev) = ENERGY_RANGE_KEV;
        self.job.share_offset = [0.0, (k.cy + 0.5) / size[1], from_kev, to_kev].map(|value| value as f32);
        self.job.field = [source.low_mm.x, source.low_mm.y, source.high_mm.x, source.high_mm.y].map(|value| value as f32);
        let shape = |centre: DVec2, a: f64, b: f64| [centre.x, centre.y, a, b].map(|value| value as f32);
        let mut turn = DVec2::X;
        match &source.field {
            None => {}
            Some(Field::Rectangle { size_mm, centre_mm, rotation_deg }) => {
                (self.job.field_kind, self.job.field_shape) = (1, shape(*centre_mm, 0.5 * size_mm.x, 0.5 * size_mm.y));
                turn = DVec2::from_angle(rotation_deg.to_radians());
            }
            Some(Field::Circle { diameter_mm, centre_mm }) => {
                (self.job.field_kind, self.job.field_shape) = (2, shape(*centre_mm, 0.5 * diameter_mm, 0.0));
            }
            Some(Field::Polygon { corners_mm }) => {
                (self.job.field_kind, self.job.corners) = (3, corners_mm.len() as u32);
                self.job.polygon = self.numbers(corners_mm.len(), corners_mm.iter().flat_map(|corner| corner.to_array()));
            }
        }
        let (ratio, along) = match panel.strips {
            Some(strips) => (strips.ratio, if strips.across == Axis::Row { 1.0 } else { 0.0 }),
            None => (0.0, 0.0),
        };
        self.job.field_turn = [turn.x, turn.y, ratio, along].map(|value| value as f32);
        if let Some((bowtie, coefficients)) = &source.left.bowtie {
            // cm²/g · g/cm³ · 0.1 cm: per mm.
            let per_mm = coefficients.iter().map(|cm2_per_g| 0.1 * cm2_per_g * bowtie.density_g_per_cm3);
            let entries: Vec<f64> = per_mm.chain(bowtie.thickness_mm.iter().flatten().copied()).collect();
            self.job.bowtie = self.numbers(bowtie.thickness_mm.len(), entries);
            self.job.share_offset[0] = if bowtie.axis == Axis::Row { 1.0 } else { 0.0 };
        }
        if let Some((heel, rows)) = &source.left.heel {
            let (sine, cosine) = heel.anode_angle_deg.to_radians().sin_cos();
            self.job.heel = with(sine * DVec3::Z - cosine * heel.anode_towards.in_camera(), 1.0);
            self.job.heel_table = self.numbers(rows.len(), rows.iter().flatten().copied());
        }
        self.job.grid_px = panel.grid_px.map(|n| n as u32);
        self.job.response = self.numbers(panel.responses.len(), panel.responses.clone());
        self.job.bins = source.energies_kev.len() as u32;
        let bins = source.energies_kev.iter().zip(&source.energies.slots);
        let entries: Vec<f64> = bins.flat_map(|(energy_kev, (own, other))| [*energy_kev, *own, f64::from(*other)]).collect();
        self.job.spectrum = self.numbers(source.energies_kev.len(), entries);
        self.job.analogue = u32::from(world.estimator == Estimator::Analogue);
    }

    fn add_space(&mut self, space: &Space, origin: DVec3) {
        let Cells { planes, boxes, contents, box_of_cell } = &space.cells;
        let bounds = space.cells.bounds();
        let place = |p: DVec3| (p - origin).as_vec3().to_array();
        let [low, high] = [bounds.low, bounds.high].map(place);
        self.job.bounds_low = [low[0], low[1], low[2], 0.0];
        self.job.bounds_high = [high[0], high[1], high[2], 0.0];
        for (axis, planes) in planes.iter().enumerate() {
            self.job.cells[axis] = planes.cells() as u32;
            self.job.planes[axis] = self.numbers(planes.at.len(), planes.at.iter().map(|at| at - origin[axis]))[0];
            self.job.buckets[axis] = self.indices(planes.buckets.iter().copied().map(u32::from));
        }
        self.job.box_of_cell = self.indices(box_of_cell.iter().copied());
        let contents: Vec<[u32; 2]> = contents.iter().map(|content| self.content(content)).collect();
        self.boxes.extend(boxes.iter().map(|one| {
            let [[x_below, x_above], [y_below, y_above], [z_below, z_above]] = one.neighbours;
            let [content, amount] = contents[one.content as usize];
            let [low, high] = [one.low, one.high].map(place);
            let [low_cell, high_cell] =
                [one.low_cell, one.high_cell].map(|[x, y, z]| u32::from(x) | u32::from(y) << 10 | u32::from(z) << 20);
            CellBox { low, content, high, amount, x_below, x_above, y_below, y_above, z_below, z_above, low_cell, high_cell }
        }));
        self.job.mesh_corners = self.numbers.len() as u32;
        for thing in &space.things {
            let packed = match &thing.body {
                Body::Solid(body) => {
                    let (kind, shape) = match body.solid.shape {
                        Shape::Ellipsoid { semi_axes_mm } => (0, semi_axes_mm),
                        Shape::Cuboid { half_size_mm } => (1, half_size_mm),
                        Shape::Cylinder { length_mm, radius_mm, inner_radius_mm } => {
                            (2, DVec3::new(length_mm, radius_mm, inner_radius_mm))
                        }
                    };
                    Thing {
                        shape: shape.extend(0.0).as_vec4().to_array(),
                        kind,
                        material: body.solid.material as u32,
                        density_g_per_cm3: body.solid.density_g_per_cm3 as f32,
                        is_air: u32::from(body.is_air),
                        ..placed(&body.local_from_lps, origin)
                    }
                }
                Body::Volume(grid) => self.volume(grid, origin),
                Body::Mesh(body) => self.mesh(body, origin),
            };
            self.things.push(Thing { own: thing.own as u32, ..packed });
        }
    }

    /// What a box says of its content: two words, and of a mixture the words that they name.
    fn content(&mut self, content: &Content) -> [u32; 2] {
        match content {
            Content::Empty => [0, 0],
            Content::Uniform { material, density } => [1 | material << 2, (*density as f32).to_bits()],
            Content::Mixed(mixture) => self.mixture(mixture),
        }
    }

    /// Ranges, things, and where some of them are dense the two words of the rest, the number of dense ones, and they.
    fn mixture(&mut self, mixture: &Mixture) -> [u32; 2] {
        let bits = |density: f64| (density as f32).to_bits();
        let mut dense = Vec::new();
        if let Some(found) = mixture.dense.as_deref() {
            dense.extend(self.mixture(&found.rest));
            dense.push(found.shapes.len() as u32);
            dense.extend(&found.shapes);
        }
        let flags = u32::from(mixture.keeps_air) + 2 * u32::from(mixture.is_full) + 4 * u32::from(mixture.dense.is_some());
        let ranges = mixture
            .ranges
            .iter()
            .flat_map(|range| [range.material, bits(range.from * (1.0 - ROUNDING)), bits(range.to * (1.0 + ROUNDING))]);
        let first = self.indices(ranges.chain(mixture.things.iter().copied()).chain(dense));
        [2 | first << 2, mixture.ranges.len() as u32 | flags << 8 | (mixture.things.len() as u32) << 16]
    }

    fn mesh(&mut self, body: &MeshBody, origin: DVec3) -> Thing {
        let root = self.nodes.len();
        let first_triangle = (self.numbers.len() - self.job.mesh_corners as usize) / 9;
        self.nodes.extend(nodes_of(&body.tree, root, first_triangle, origin));
        let corners = body.tree.triangles().iter().flatten();
        self.numbers.extend(corners.flat_map(|corner| (*corner - origin).as_vec3().to_array()));
        Thing {
            kind: MESH,
            material: body.mesh.material as u32,
            density_g_per_cm3: body.mesh.density_g_per_cm3 as f32,
            is_air: u32::from(body.is_air),
            root: root as u32,
            ..Thing::default()
        }
    }

    fn volume(&mut self, grid: &Grid, origin: DVec3) -> Thing {
        let classes = self.indices(grid.classes.iter().flat_map(|(material, is_air)| [*material, u32::from(*is_air)]));
        let first_voxel = self.voxels.len() as u32;
        let volume = grid.volume;
        let voxel = |(class, density): (&u8, &f32)| {
            let counted = ((f64::from(*density) / DENSITY_UNIT).round() as u32).min(MOST_DENSITY);
            u32::from(*class) << 28 | counted
        };
        self.voxels.extend(volume.class.iter().zip(&volume.density_g_per_cm3).map(voxel));
        Thing {
            kind: VOLUME,
            size: volume.size.map(|n| n as u32),
            first_voxel,
            classes,
            is_piecewise: u32::from(grid.is_piecewise_constant()),
            ..placed(&grid.voxel_from_lps, origin)
        }
    }
}

/// Rows of `local_from_lps` for places about `origin`.
fn placed(local_from_lps: &DAffine3, origin: DVec3) -> Thing {
    let (matrix, offset) = (local_from_lps.matrix3, local_from_lps.transform_point3(origin));
    let row = |n: usize| [matrix.x_axis[n], matrix.y_axis[n], matrix.z_axis[n], offset[n]].map(|value| value as f32);
    Thing { row_x: row(0), row_y: row(1), row_z: row(2), ..Thing::default() }
}
