// Closed triangle meshes: a tree of boxes, and where a line crosses the faces. Of the shader that includes it this reads `nodes` and the
// `corner`s, three a triangle; its `take_hit` hears of the crossings, in no order.

override has_meshes: bool = true;

const MESH: u32 = 3u;

struct Node {
    lo: vec3<f32>,
    first: u32,              // first triangle of a leaf, else the second child; the first child follows its parent
    hi: vec3<f32>,
    count: u32,              // triangles of a leaf; 0 for an inner node
}

// Crossings of the line origin + direction · t; those before t = `after` may be left out. The line must not stand across `axis`.
fn cross_mesh(root: u32, origin: vec3<f32>, direction: vec3<f32>, axis: u32, after: f32) {
    // Halving at the median leaves 2^31 triangles no deeper.
    var stack: array<u32, 32>;
    stack[0] = root;
    var top = 1u;
    while top > 0u {
        top -= 1u;
        let index = stack[top];
        let inside = cuboid(origin, direction, nodes[index].lo, nodes[index].hi);
        if !(inside.y >= max(inside.x, after)) { continue; }
        let first = nodes[index].first;
        let count = nodes[index].count;
        if count == 0u {
            stack[top] = first;
            stack[top + 1u] = index + 1u;
            top += 2u;
            continue;
        }
        for (var triangle = first; triangle < first + count; triangle += 1u) { cross_triangle(triangle, origin, direction, axis); }
    }
}

// The axes in order, so turned that `axis` is the last.
fn ending_with(axis: u32, v: vec3<f32>) -> vec3<f32> {
    return select(select(v, v.zxy, axis == 1u), v.yzx, axis == 0u);
}

// From the origin of the line, and sheared so that it is the axis x = y = 0: by numbers of the corner alone, whichever triangle asks.
fn sheared(index: u32, origin: vec3<f32>, slope: vec2<f32>, axis: u32) -> vec3<f32> {
    let from_origin = ending_with(axis, corner(index) - origin);
    return vec3<f32>(from_origin.xy - slope * from_origin.z, from_origin.z);
}

// The product of an edge, formed in one order of its ends: neighbours agree to the last bit, so that no ray slips between them.
fn edge(a: vec3<f32>, b: vec3<f32>) -> f32 {
    let swap = a.x > b.x || (a.x == b.x && a.y > b.y);
    let u = select(a, b, swap);
    let v = select(b, a, swap);
    let value = u.x * v.y - u.y * v.x;
    // A ray exactly through an edge belongs to the side on which the ordered product counts as positive.
    let counted = select(value, 1e-30, value == 0.0);
    return select(counted, -counted, swap);
}

// Tells take_hit of t, and of +1 where the line enters, -1 where it leaves.
fn cross_triangle(triangle: u32, origin: vec3<f32>, direction: vec3<f32>, axis: u32) {
    let way = ending_with(axis, direction);
    let slope = way.xy / way.z;
    let a = sheared(3u * triangle, origin, slope, axis);
    let b = sheared(3u * triangle + 1u, origin, slope, axis);
    let c = sheared(3u * triangle + 2u, origin, slope, axis);
    let ab = edge(a, b);
    let bc = edge(b, c);
    let ca = edge(c, a);
    let is_positive = ab > 0.0 && bc > 0.0 && ca > 0.0;
    if !(is_positive || (ab < 0.0 && bc < 0.0 && ca < 0.0)) { return; }
    let along = (bc * a.z + ca * b.z + ab * c.z) / (ab + bc + ca);
    take_hit(along / way.z, select(1.0, -1.0, is_positive == (way.z > 0.0)));
}
