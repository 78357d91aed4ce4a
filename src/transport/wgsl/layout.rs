//! The structs of `shaders/transport/data.wgsl`, byte for byte.

use bytemuck::{Pod, Zeroable};

/// Everything but tables.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub struct Job {
    /// Focal spot; source to detector.
    pub source: [f32; 4],
    /// Camera's axes; standard deviations of the focal spot, then the image's area.
    pub axis_x: [f32; 4],
    /// See `axis_x`.
    pub axis_y: [f32; 4],
    /// See `axis_x`.
    pub axis_z: [f32; 4],
    /// Of the scene.
    pub bounds_low: [f32; 4],
    /// Of the scene.
    pub bounds_high: [f32; 4],
    /// Shares of the image from mm on the plane.
    pub share_from_plane: [f32; 4],
    /// The rest of it; energies of the tables.
    pub share_offset: [f32; 4],
    /// Bounds on the plane.
    pub field: [f32; 4],
    /// Centre and half sides, or radius.
    pub field_shape: [f32; 4],
    /// Turn; antiscatter grid.
    pub field_turn: [f32; 4],
    /// Direction of the sine of take-off, and whether there is a heel.
    pub heel: [f32; 4],
    /// Columns and rows.
    pub grid_px: [u32; 2],
    /// Nothing.
    pub padding_a: [u32; 2],
    /// Cells by axis.
    pub cells: [u32; 3],
    /// Image, rectangle, circle, polygon.
    pub field_kind: u32,
    /// Of a polygon.
    pub corners: u32,
    /// Scene materials.
    pub materials: u32,
    /// Of the spectrum.
    pub bins: u32,
    /// Nothing.
    pub padding_b: u32,
    /// Key of the random numbers.
    pub seed: [u32; 2],
    /// First history, low word and high word.
    pub first: [u32; 2],
    /// Histories of one invocation.
    pub each: u32,
    /// Groups that add to one batch.
    pub groups_per_batch: u32,
    /// 1: photons count where they arrive.
    pub analogue: u32,
    /// 0 for an empty scene.
    pub has_space: u32,
    /// Where tables begin, and their rows.
    pub attenuation: [u32; 2],
    /// S.
    pub incoherent: [u32; 2],
    /// Bounds and own shares.
    pub envelope: [u32; 2],
    /// Compton's.
    pub compton_norm: [u32; 2],
    /// F².
    pub squares: [u32; 2],
    /// Its cumulative.
    pub below: [u32; 2],
    /// Rayleigh's.
    pub rayleigh_norm: [u32; 2],
    /// The detector's.
    pub response: [u32; 2],
    /// Energies.
    pub spectrum: [u32; 2],
    /// By take-off, then bin.
    pub heel_table: [u32; 2],
    /// Corners.
    pub polygon: [u32; 2],
    /// What it takes by bin, and its points.
    pub bowtie: [u32; 2],
    /// By axis.
    pub planes: [u32; 3],
    /// The other bins of cosines.
    pub envelope_other: u32,
    /// Where to begin in the cumulative.
    pub guides: [u32; 2],
    /// Box of each cell.
    pub box_of_cell: u32,
    /// First group of this dispatch.
    pub first_group: u32,
    /// By axis.
    pub buckets: [u32; 3],
    /// Of meshes.
    pub mesh_corners: u32,
}

/// A box of cells.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub struct CellBox {
    /// Lower corner.
    pub low: [f32; 3],
    /// What is in it.
    pub content: u32,
    /// Upper corner.
    pub high: [f32; 3],
    /// How much of it.
    pub amount: u32,
    /// Across the faces.
    pub x_below: u32,
    /// Across the faces.
    pub x_above: u32,
    /// Across the faces.
    pub y_below: u32,
    /// Across the faces.
    pub y_above: u32,
    /// Across the faces.
    pub z_below: u32,
    /// Across the faces.
    pub z_above: u32,
    /// First planes.
    pub low_cell: u32,
    /// Last planes.
    pub high_cell: u32,
}

/// A shape, a mesh or a volume.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
pub struct Thing {
    /// Local or voxel coordinates from lps.
    pub row_x: [f32; 4],
    /// See `row_x`.
    pub row_y: [f32; 4],
    /// See `row_x`.
    pub row_z: [f32; 4],
    /// Sizes.
    pub shape: [f32; 4],
    /// Ellipsoid, cuboid, cylinder, mesh, volume.
    pub kind: u32,
    /// Scene material.
    pub material: u32,
    /// Its density.
    pub density_g_per_cm3: f32,
    /// 1 for air.
    pub is_air: u32,
    /// Voxels.
    pub size: [u32; 3],
    /// Where they begin.
    pub first_voxel: u32,
    /// What it displaces with.
    pub own: u32,
    /// Where its classes begin.
    pub classes: u32,
    /// 1: constant within voxels.
    pub is_piecewise: u32,
    /// Of a mesh, among the nodes.
    pub root: u32,
}
