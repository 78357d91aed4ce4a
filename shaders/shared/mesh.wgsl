// Closed triangle meshes: a tree of boxes, then crossings in order. Corners are in the camera, their depth counted from depth_ref.

override has_meshes: bool = true;

const MESH: u32 = 3u;
const HITS: u32 = 32u;

struct Node {
    lo: vec3<f32>,
    first: u32,              // first triangle of a leaf, else the second child; the first child follows its parent
    hi: vec3<f32>,
    count: u32,              // triangles of a leaf; 0 for an inner node
}

@group(0) @binding(10) var<storage, read> nodes: array<Node>;
@group(0) @binding(11) var<storage, read> corners: array<vec4<f32>>;      // three a triangle

var<private> hits: array<vec2<f32>, 32>; // tau, and +1 where the ray enters, -1 where it leaves
var<private> hit_count: u32 = 0u;

fn find_hits(root: u32, depth_ref: f32, direction: vec3<f32>) {
    hit_count = 0u;
    let p = vec3<f32>(direction.xy * depth_ref, 0.0);
    var stack: array<u32, 32>;
    stack[0] = root;
    var top = 1u;
    while top > 0u {
        top -= 1u;
        let index = stack[top];
        let inside = cuboid(p, direction, nodes[index].lo, nodes[index].hi);
        if !(inside.y >= inside.x) { continue; }
        let first = nodes[index].first;
        let count = nodes[index].count;
        if count == 0u {
            if top > 30u { overflow = true; return; }
            stack[top] = first;
            stack[top + 1u] = index + 1u;
            top += 2u;
            continue;
        }
        for (var triangle = first; triangle < first + count; triangle += 1u) { add_hit(triangle, p.xy, direction.xy); }
    }
}

// Sheared so that the ray is the axis x = y = 0.
fn sheared(corner: vec3<f32>, p: vec2<f32>, slope: vec2<f32>) -> vec3<f32> {
    return vec3<f32>(corner.xy - p - slope * corner.z, corner.z);
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

fn add_hit(triangle: u32, p: vec2<f32>, slope: vec2<f32>) {
    let a = sheared(corners[3u * triangle].xyz, p, slope);
    let b = sheared(corners[3u * triangle + 1u].xyz, p, slope);
    let c = sheared(corners[3u * triangle + 2u].xyz, p, slope);
    let ab = edge(a, b);
    let bc = edge(b, c);
    let ca = edge(c, a);
    let leaves = ab > 0.0 && bc > 0.0 && ca > 0.0;
    if !(leaves || (ab < 0.0 && bc < 0.0 && ca < 0.0)) { return; }
    if hit_count == HITS { overflow = true; return; }
    let tau = (bc * a.z + ca * b.z + ab * c.z) / (ab + bc + ca);
    var i = hit_count;
    while i > 0u && hits[i - 1u].x > tau {
        hits[i] = hits[i - 1u];
        i -= 1u;
    }
    hits[i] = vec2<f32>(tau, select(1.0, -1.0, leaves));
    hit_count += 1u;
}
