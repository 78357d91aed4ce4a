//! Structs as the shaders read them; `tests/shaders_layout.rs` compares every offset with what naga finds in the WGSL.

use bytemuck::{Pod, Zeroable};
use glam::{DAffine3, DMat3, DVec3};

use crate::render::mesh_tree::MeshTree;
use crate::render::prepared::{Prepared, SeenMesh, SeenSolid, SeenVolume, Step};
use crate::scene::model::Shape;

/// `View` of `shared/view.wgsl`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
#[expect(missing_docs, reason = "documented in the shader, which has the same names")]
pub struct View {
    pub size_px: [u32; 2],
    pub material_count: u32,
    pub bin_count: u32,
    pub focal_px: [f32; 2],
    pub principal_px: [f32; 2],
    pub skew_px: f32,
    pub depth_ref_mm: f32,
    pub source_tau_mm: f32,
    pub detector_tau_mm: f32,
    pub later_count: u32,
    pub solid_count: u32,
    pub has_volume: u32,
    pub frame: u32,
    pub seed: [u32; 2],
    pub photons_per_pixel: f32,
    pub mean_response: f32,
    pub mean_square_response: f32,
    pub moments: u32,
    pub padding: [u32; 2],
    pub fitted_up_to: [[f32; 4]; 2],
}

/// `Flags` of `integrate_density.wgsl`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
#[expect(missing_docs, reason = "documented in the shader, which has the same names")]
pub struct Flags {
    pub overflows: u32,
    pub matter: u32,
    pub beyond: u32,
}

/// `Solid` of `shared/solid.wgsl`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
#[expect(missing_docs, reason = "documented in the shader, which has the same names")]
pub struct Solid {
    pub row_x: [f32; 4],
    pub row_y: [f32; 4],
    pub row_z: [f32; 4],
    pub centre: [f32; 4],
    pub size: [f32; 4],
    pub bounds: [u32; 4],
    pub kind: u32,
    pub material: u32,
    pub density_g_per_cm3: f32,
    pub root: u32,
}

/// `Node` of `shared/mesh.wgsl`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
#[expect(missing_docs, reason = "documented in the shader, which has the same names")]
pub struct Node {
    pub lo: [f32; 3],
    pub first: u32,
    pub hi: [f32; 3],
    pub count: u32,
}

/// `Grid` of `shared/grid.wgsl`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
#[expect(missing_docs, reason = "documented in the shader, which has the same names")]
pub struct Grid {
    pub row_x: [f32; 4],
    pub row_y: [f32; 4],
    pub row_z: [f32; 4],
    pub centre: [f32; 4],
    pub size: [u32; 3],
    pub padding: u32,
    pub occupied_from: [f32; 4],
    pub occupied_to: [f32; 4],
    pub cells_from: u32,
    pub cells_to: u32,
    pub voxels_from: u32,
    pub adds: u32,
}

/// `Bin` of `attenuate_spectrum.wgsl`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
#[repr(C)]
#[expect(missing_docs, reason = "documented in the shader, which has the same names")]
pub struct Bin {
    pub signal: f32,
    pub photons: f32,
    pub squares: f32,
    pub padding: f32,
}

/// A prepared scene with at most one volume, as the shader wants it.
#[derive(Clone, Debug)]
pub struct Packed {
    /// Geometry only; spectrum and noise are filled in later.
    pub view: View,
    /// Shapes and meshes in the order in which they claim the ray.
    pub solids: Vec<Solid>,
    /// Trees of the meshes.
    pub nodes: Vec<Node>,
    /// Three corners a triangle.
    pub corners: Vec<[f32; 4]>,
    /// The volume, if there is one.
    pub grid: Grid,
}

/// Packs geometry in f32 about a reference depth, where it is rounded least.
#[must_use]
pub fn pack(prepared: &Prepared) -> Packed {
    let volume = prepared.volumes.first();
    let depth_ref_mm = reference_depth(prepared);
    let volume_at = prepared.steps.iter().position(|step| matches!(step, Step::Volume(_)));
    let mut trees = Trees::default();
    let mut solid_steps = |steps: &[Step]| -> Vec<Solid> {
        let solid = |step: &Step| match *step {
            Step::Solid(index) => Some(pack_solid(&prepared.solids[index], depth_ref_mm)),
            Step::Mesh(index) => Some(trees.pack(&prepared.meshes[index], &prepared.view, depth_ref_mm)),
            Step::Volume(_) | Step::VolumeAir(_) => None,
        };
        steps.iter().filter_map(solid).collect()
    };
    let (mut solids, earlier) = match volume_at {
        Some(at) => (solid_steps(&prepared.steps[..at]), solid_steps(&prepared.steps[at..])),
        None => (solid_steps(&prepared.steps), Vec::new()),
    };
    let later_count = solids.len() as u32;
    solids.extend(earlier);
    let k = &prepared.view.intrinsics;
    let view = View {
        size_px: prepared.view.size_px,
        material_count: prepared.material_count as u32,
        focal_px: [k.fx as f32, k.fy as f32],
        principal_px: [k.cx as f32, k.cy as f32],
        skew_px: k.skew as f32,
        depth_ref_mm: depth_ref_mm as f32,
        source_tau_mm: -depth_ref_mm as f32,
        detector_tau_mm: (prepared.detector_mm - depth_ref_mm) as f32,
        later_count,
        solid_count: solids.len() as u32,
        has_volume: u32::from(volume.is_some()),
        ..View::default()
    };
    let Trees { nodes, corners } = trees;
    Packed { view, solids, nodes, corners, grid: volume.map_or_else(Grid::default, |seen| pack_grid(seen, depth_ref_mm)) }
}

/// The volume number `volume` of `prepared`, about the depth that [`pack`] takes.
#[must_use]
pub fn grid_of(prepared: &Prepared, volume: usize) -> Grid {
    pack_grid(&prepared.volumes[volume], reference_depth(prepared))
}

/// Depth of the first volume's centre, else the middle of the solids; a whole number, so that f32 has it exactly.
fn reference_depth(prepared: &Prepared) -> f64 {
    let depth = match prepared.volumes.first() {
        Some(seen) => centre_of(seen).z,
        None => {
            let depths = prepared.solids.iter().map(|seen| seen.centre_in_camera.z);
            let depths = depths.chain(prepared.meshes.iter().map(|seen| seen.centre_in_camera.z));
            let (low, high) = depths.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), z| (low.min(z), high.max(z)));
            0.5 * (low + high)
        }
    };
    if depth.is_finite() { depth.round().clamp(0.0, prepared.detector_mm.round()) } else { 0.0 }
}

fn centre_of(seen: &SeenVolume) -> DVec3 {
    seen.cell_from_camera.inverse().transform_point3(centre_cell(seen))
}

fn centre_cell(seen: &SeenVolume) -> DVec3 {
    DVec3::from_array(seen.volume.size.map(|n| 0.5 * n as f64 + 0.5))
}

fn rows(matrix: &DMat3, at_centre: DVec3) -> [[f32; 4]; 3] {
    std::array::from_fn(|row| {
        let r = matrix.row(row);
        [r.x as f32, r.y as f32, r.z as f32, at_centre[row] as f32]
    })
}

fn about(centre: DVec3, depth_ref_mm: f64) -> [f32; 4] {
    [centre.x as f32, centre.y as f32, (depth_ref_mm - centre.z) as f32, 0.0]
}

fn wide(v: DVec3) -> [f32; 4] {
    [v.x as f32, v.y as f32, v.z as f32, 0.0]
}

fn pack_solid(seen: &SeenSolid, depth_ref_mm: f64) -> Solid {
    let shape = &seen.solid.shape;
    let (kind, size) = match *shape {
        Shape::Ellipsoid { semi_axes_mm } => (0, semi_axes_mm),
        Shape::Cuboid { half_size_mm } => (1, half_size_mm),
        Shape::Cylinder { length_mm, radius_mm, inner_radius_mm } => (2, DVec3::new(length_mm, radius_mm, inner_radius_mm)),
    };
    let [row_x, row_y, row_z] = rows(&seen.local_from_camera, shape.bounding_sphere().0);
    let [from, to] = [seen.bounds.from, seen.bounds.to];
    Solid {
        row_x,
        row_y,
        row_z,
        centre: about(seen.centre_in_camera, depth_ref_mm),
        size: wide(size),
        bounds: [from[0], from[1], to[0], to[1]],
        kind,
        material: seen.solid.material as u32,
        density_g_per_cm3: seen.solid.density_g_per_cm3 as f32,
        root: 0,
    }
}

/// Meshes, one after the other.
#[derive(Default)]
struct Trees {
    nodes: Vec<Node>,
    corners: Vec<[f32; 4]>,
}

/// `MESH` of `shared/mesh.wgsl`: the kind of a mesh among shapes.
pub const MESH: u32 = 3;

/// What boxes are enlarged by, mm: more than f32 rounds.
const BOX_MARGIN_MM: f64 = 1e-3;

/// Nodes of `tree` behind `first_node` and `first_triangle` others; places are counted from `origin`.
pub fn nodes_of(tree: &MeshTree, first_node: usize, first_triangle: usize, origin: DVec3) -> impl Iterator<Item = Node> {
    tree.nodes().map(move |([lo, hi], first, count)| Node {
        lo: (lo - BOX_MARGIN_MM - origin).as_vec3().to_array(),
        first: (first + if count == 0 { first_node } else { first_triangle }) as u32,
        hi: (hi + BOX_MARGIN_MM - origin).as_vec3().to_array(),
        count: count as u32,
    })
}

impl Trees {
    fn pack(&mut self, seen: &SeenMesh, view: &crate::geometry::View, depth_ref_mm: f64) -> Solid {
        let tree = seen.made.tree.placed(&view.camera_from_lps);
        let (root, origin) = (self.nodes.len(), DVec3::Z * depth_ref_mm);
        self.nodes.extend(nodes_of(&tree, root, self.corners.len() / 3, origin));
        let corners = tree.triangles().iter().flatten();
        self.corners.extend(corners.map(|corner| (*corner - origin).as_vec3().extend(0.0).to_array()));
        // Without a triangle there is no root to begin at.
        let [from, to] = if tree.triangles().is_empty() { [[0; 2]; 2] } else { [seen.bounds.from, seen.bounds.to] };
        Solid {
            bounds: [from[0], from[1], to[0], to[1]],
            kind: MESH,
            material: seen.mesh.material as u32,
            density_g_per_cm3: seen.mesh.density_g_per_cm3 as f32,
            root: root as u32,
            ..Solid::default()
        }
    }
}

fn pack_grid(seen: &SeenVolume, depth_ref_mm: f64) -> Grid {
    let affine: &DAffine3 = &seen.cell_from_camera;
    let [row_x, row_y, row_z] = rows(&affine.matrix3, centre_cell(seen));
    let [first, end] = seen.cells.occupied.map(|cell| DVec3::from_array(cell.map(|n| n as f64)));
    Grid {
        row_x,
        row_y,
        row_z,
        centre: about(centre_of(seen), depth_ref_mm),
        size: seen.volume.size.map(|n| n as u32),
        padding: 0,
        occupied_from: wide(first),
        occupied_to: wide(end),
        cells_from: 0,
        cells_to: seen.volume.size[2] as u32 + 1,
        voxels_from: 0,
        adds: 0,
    }
}
