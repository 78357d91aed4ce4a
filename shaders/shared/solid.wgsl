// Analytic shapes: where a ray runs inside them.

const ELLIPSOID: u32 = 0u;
const CUBOID: u32 = 1u;
const FAR: f32 = 1e30;

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

// The point of closest approach comes first, so that the discriminant loses nothing to the distance.
fn quadric(p: vec3<f32>, q: vec3<f32>, radius: f32) -> vec2<f32> {
    let qq = dot(q, q);
    if qq <= 0.0 {
        return select(vec2<f32>(FAR, -FAR), vec2<f32>(-FAR, FAR), dot(p, p) < radius * radius);
    }
    let middle = -dot(p, q) / qq;
    let nearest = p + q * middle;
    let discriminant = radius * radius - dot(nearest, nearest);
    if !(discriminant > 0.0) { return vec2<f32>(FAR, -FAR); }
    let half = sqrt(discriminant / qq);
    return vec2<f32>(middle - half, middle + half);
}

fn slab(p: f32, q: f32, lo: f32, hi: f32) -> vec2<f32> {
    if q == 0.0 {
        return select(vec2<f32>(FAR, -FAR), vec2<f32>(-FAR, FAR), p >= lo && p <= hi);
    }
    let a = (lo - p) / q;
    let b = (hi - p) / q;
    return vec2<f32>(min(a, b), max(a, b));
}

fn meet(a: vec2<f32>, b: vec2<f32>) -> vec2<f32> {
    return vec2<f32>(max(a.x, b.x), min(a.y, b.y));
}

fn cuboid(p: vec3<f32>, q: vec3<f32>, lo: vec3<f32>, hi: vec3<f32>) -> vec2<f32> {
    return meet(meet(slab(p.x, q.x, lo.x, hi.x), slab(p.y, q.y, lo.y, hi.y)), slab(p.z, q.z, lo.z, hi.z));
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
