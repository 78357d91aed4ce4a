// A volume: cells between 2x2x2 voxel centres, `cell` coordinate = voxel + 1; the outer half voxel is a cell with one voxel twice.

const EMPTY: u32 = 0u;
const MIXED: u32 = 251u;
const CUT: u32 = 252u;
const EMPTY_BRICK: u32 = 253u;
const BRICK: i32 = 8;

struct Grid {
    row_x: vec4<f32>,        // xyz: row of cell_from_camera; w: cell coordinate of `centre`
    row_y: vec4<f32>,
    row_z: vec4<f32>,
    centre: vec4<f32>,       // xy: in the camera, mm; z: depth_ref - depth of the centre
    size: vec3<u32>,         // voxels
    padding: u32,
    occupied_from: vec4<f32>,
    occupied_to: vec4<f32>,
    cells_from: u32,         // cells along z that the textures hold: from here ...
    cells_to: u32,           // ... to before here
    voxels_from: u32,        // voxel with which they begin
    adds: u32,               // whether other parts of the volume were crossed before
}

// Mean of the trilinear interpolant along m - h .. m + h: f(m) + (f_xy hx hy + f_yz hy hz + f_xz hx hz) / 3, exact for the cubic.
fn mean_along(low: vec4<f32>, high: vec4<f32>, m: vec3<f32>, h: vec3<f32>) -> f32 {
    // low: corners 000 100 010 110, high: 001 101 011 111.
    let x_low = low.yw - low.xz;
    let x_high = high.yw - high.xz;
    let v_low = low.xz + m.x * x_low;
    let v_high = high.xz + m.x * x_high;
    let y = vec2<f32>(v_low.y - v_low.x, v_high.y - v_high.x);
    let w = vec2<f32>(v_low.x, v_high.x) + m.y * y;
    let xy = vec2<f32>(x_low.y - x_low.x, x_high.y - x_high.x);
    let wx = vec2<f32>(x_low.x, x_high.x) + m.y * xy;
    let f_xy = xy.x + m.z * (xy.y - xy.x);
    let f_yz = y.y - y.x;
    let f_xz = wx.y - wx.x;
    return w.x + m.z * (w.y - w.x) + (f_xy * h.x * h.y + f_yz * h.y * h.z + f_xz * h.x * h.z) * (1.0 / 3.0);
}

// Mean trilinear weight of a corner along m - h .. m + h.
fn mean_weight(corner: u32, m: vec3<f32>, h: vec3<f32>) -> f32 {
    let upper = vec3<bool>((corner & 1u) != 0u, (corner & 2u) != 0u, (corner & 4u) != 0u);
    let a = select(1.0 - m, m, upper);
    let d = select(-h, h, upper);
    return a.x * a.y * a.z + (a.x * d.y * d.z + a.y * d.x * d.z + a.z * d.x * d.y) * (1.0 / 3.0);
}
