// Analytic shapes: where a ray runs inside them; by the chords of the shader that includes it.

const ELLIPSOID: u32 = 0u;
const CUBOID: u32 = 1u;

struct Solid {
    row_x: vec4<f32>,        // xyz: row of local_from_camera; w: local coordinate of `centre`
    row_y: vec4<f32>,
    row_z: vec4<f32>,
    centre: vec4<f32>,       // xy: in the camera, mm; z: depth_ref - depth of the centre
    size: vec4<f32>,         // half axes | half sizes | length, radius, inner radius
    bounds: vec4<u32>,       // first column, first row, one past the last column, row
    kind: u32,
    material: u32,
    density_g_per_cm3: f32,
    root: u32,               // of a mesh, among the nodes
}

// Two intervals (xy, zw) of tau; empty where the end is not beyond the start.
fn intersect(solid: Solid, depth_ref_mm: f32, direction: vec3<f32>) -> vec4<f32> {
    let nothing = vec2<f32>(FAR, -FAR);
    let w = vec3<f32>(direction.xy * depth_ref_mm - solid.centre.xy, solid.centre.z);
    let p = vec3<f32>(dot(solid.row_x.xyz, w) + solid.row_x.w, dot(solid.row_y.xyz, w) + solid.row_y.w, dot(solid.row_z.xyz, w) + solid.row_z.w);
    let q = vec3<f32>(dot(solid.row_x.xyz, direction), dot(solid.row_y.xyz, direction), dot(solid.row_z.xyz, direction));
    if solid.kind == ELLIPSOID {
        return vec4<f32>(quadric(p / solid.size.xyz, q / solid.size.xyz, 1.0), nothing);
    }
    if solid.kind == CUBOID {
        return vec4<f32>(cuboid(p, q, -solid.size.xyz, solid.size.xyz), nothing);
    }
    let caps = slab(p.z, q.z, 0.0, solid.size.x);
    let outer = meet(quadric(vec3<f32>(p.xy, 0.0), vec3<f32>(q.xy, 0.0), solid.size.y), caps);
    if !(solid.size.z > 0.0) { return vec4<f32>(outer, nothing); }
    let inner = quadric(vec3<f32>(p.xy, 0.0), vec3<f32>(q.xy, 0.0), solid.size.z);
    if !(inner.y > inner.x) { return vec4<f32>(outer, nothing); }
    return vec4<f32>(outer.x, min(outer.y, inner.x), max(outer.x, inner.y), outer.y);
}
