// What photons are followed in, flattened by src/transport/wgsl/pack.rs: one uniform, tables of numbers, tables of indices, boxes, voxels.
// Places are in lps about the middle of the scene, mm.

const MATERIALS: u32 = 16u;
const PAGES: u32 = 4u;
const FATES: u32 = 3u;
const STARTED: u32 = 0u;
const DETECTED: u32 = 1u;
const ESCAPED: u32 = 2u;

struct Job {
    source: vec4<f32>,          // xyz; w: source to detector
    axis_x: vec4<f32>,          // of the camera; w: standard deviation of the focal spot along it
    axis_y: vec4<f32>,
    axis_z: vec4<f32>,          // w: area of the image on the plane
    bounds_low: vec4<f32>,
    bounds_high: vec4<f32>,
    share_from_plane: vec4<f32>, // share.x = x · plane.x + y · plane.y + z, share.y = w · plane.y + share_offset.y
    share_offset: vec4<f32>,    // x: 1 where the bow-tie follows rows; y; zw: energies of the tables, from and to
    field: vec4<f32>,           // bounds on the plane, from and to
    field_shape: vec4<f32>,     // rectangle: centre and half sides; circle: centre and radius
    field_turn: vec4<f32>,      // cosine and sine of the rectangle's turn; grid ratio; which way its strips follow each other (0 columns, 1 rows)
    heel: vec4<f32>,            // direction whose product with a ray is the sine of take-off; w: 1 where there is a heel
    grid_px: vec2<u32>,
    cells: vec3<u32>,
    field_kind: u32,            // 0 the image, 1 rectangle, 2 circle, 3 polygon
    corners: u32,               // of the polygon
    materials: u32,
    bins: u32,
    seed: vec2<u32>,
    first: vec2<u32>,           // history, low and high word
    each: u32,                  // histories of one invocation
    groups_per_batch: u32,
    analogue: u32,
    has_space: u32,
    // Where tables begin in `numbers`, and their rows.
    attenuation: vec2<u32>,
    incoherent: vec2<u32>,
    envelope: vec2<u32>,        // by material, then energy: 32 × (bound, own share)
    compton_norm: vec2<u32>,
    squares: vec2<u32>,
    below: vec2<u32>,
    rayleigh_norm: vec2<u32>,
    response: vec2<u32>,
    spectrum: vec2<u32>,        // by bin: energy, own share, the other one
    heel_table: vec2<u32>,
    polygon: vec2<u32>,
    bowtie: vec2<u32>,          // by bin what 1 mm takes; then (degrees, mm) by point, so many; 0 points for none
    planes: vec3<u32>,          // by axis, in `numbers`
    // In `indices`.
    envelope_other: u32,
    guides: vec2<u32>,
    box_of_cell: u32,
    first_group: u32,           // of this dispatch
    buckets: vec3<u32>,         // by axis: the cell in which each of four buckets a plane begins
    mesh_corners: u32,          // in `numbers`
}

struct CellBox {
    low: vec3<f32>,
    content: u32,               // kind in the lower 2 bits; above them a uniform's material, or where a mixture's ranges begin in `indices`
    high: vec3<f32>,
    amount: u32,                // bits of a uniform's density; of a mixture 8 bits of ranges, 8 of flags (1 keeps air, 2 is full, 4 some are dense:
                                // then the rest's two words, how many, and which follow in `indices`), 16 of things
    x_below: u32,
    x_above: u32,
    y_below: u32,
    y_above: u32,
    z_below: u32,
    z_above: u32,
    low_cell: u32,              // 10 bits an axis, x the lowest
    high_cell: u32,
}

struct Thing {
    row_x: vec4<f32>,           // local (or voxel) coordinates from lps
    row_y: vec4<f32>,
    row_z: vec4<f32>,
    shape: vec4<f32>,           // semi-axes; half sides; length, radius, inner radius
    kind: u32,                  // 0 ellipsoid, 1 cuboid, 2 cylinder, 3 mesh, 4 volume
    material: u32,
    density_g_per_cm3: f32,
    is_air: u32,
    size: vec3<u32>,            // voxels
    first_voxel: u32,
    own: u32,
    classes: u32,               // of a volume: where (material, is air) by class begin in `indices`
    is_piecewise: u32,
    root: u32,                  // of a mesh, among the nodes
}

@group(0) @binding(0) var<uniform> job: Job;
@group(0) @binding(1) var<storage, read> numbers: array<f32>;
@group(0) @binding(2) var<storage, read> indices: array<u32>;
@group(0) @binding(3) var<storage, read> boxes: array<CellBox>;
@group(0) @binding(4) var<storage, read> things: array<Thing>;
@group(0) @binding(5) var<storage, read> voxels: array<u32>;    // class in the upper 4 bits (0 nothing), density in units of DENSITY_UNIT
@group(0) @binding(6) var<storage, read> nodes: array<Node>;     // of meshes
@group(0) @binding(7) var<storage, read_write> sums: array<atomic<u32>>; // by batch, then slot: low and high word, in units of 1/64
@group(0) @binding(8) var<storage, read_write> trouble: array<atomic<u32>>; // by cause, histories given up; then invocations that did all of theirs

override DENSITY_UNIT: f32;   // g/cm³ that a voxel counts in

// A history that cannot be followed to its end, and why; the host is told.
const NO_NUMBER: u32 = 0u;
const NO_START: u32 = 1u;
const NO_END: u32 = 2u;
const NO_ANGLE: u32 = 3u;
const ALL_DONE: u32 = 4u;

var<private> given_up: bool;
var<private> cause: u32;

fn give_up(because: u32) {
    given_up = true;
    cause = because;
}
