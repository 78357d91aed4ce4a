// What shapes and meshes claim of a ray, the last object first; reads view, solids, sums of the shader that includes it.

const PIECES: u32 = 16u;
const HITS: u32 = 32u;

// Crossings of a mesh in order: tau, and +1 where the ray enters, -1 where it leaves.
var<private> hits: array<vec2<f32>, 32>;
var<private> hit_count: u32 = 0u;

// What the volume may displace: intervals of earlier solids, already counted.
var<private> piece_span: array<vec2<f32>, 16>;
var<private> piece_density: array<f32, 16>;
var<private> piece_material: array<u32, 16>;
var<private> piece_count: u32 = 0u;

fn claim_solid(index: u32, pixel: vec2<u32>, direction: vec3<f32>, displaced_by_volume: bool) {
    let bounds = solids[index].bounds;
    if any(pixel < bounds.xy) || any(pixel >= bounds.zw) { return; }
    let solid = solids[index];
    let seen = vec2<f32>(view.source_tau_mm, view.detector_tau_mm);
    if !has_meshes || solid.kind != MESH {
        let found = intersect(solid, view.depth_ref_mm, direction);
        claim_span(solid, meet(found.xy, seen), displaced_by_volume);
        claim_span(solid, meet(found.zw, seen), displaced_by_volume);
        return;
    }
    hit_count = 0u;
    cross_mesh(solid.root, vec3<f32>(direction.xy * view.depth_ref_mm, 0.0), direction, 2u, -FAR);
    // The winding number, not parity, survives faces that touch.
    var winding = 0.0;
    var start = 0.0;
    for (var i = 0u; i < hit_count; i += 1u) {
        let before = winding;
        winding += hits[i].y;
        if before == 0.0 { start = hits[i].x; }
        if winding == 0.0 { claim_span(solid, meet(vec2<f32>(start, hits[i].x), seen), displaced_by_volume); }
    }
}

fn take_hit(tau: f32, step: f32) {
    if hit_count == HITS { overflow = true; return; }
    var i = hit_count;
    while i > 0u && hits[i - 1u].x > tau {
        hits[i] = hits[i - 1u];
        i -= 1u;
    }
    hits[i] = vec2<f32>(tau, step);
    hit_count += 1u;
}

fn claim_span(solid: Solid, span: vec2<f32>, displaced_by_volume: bool) {
    var rest = span;
    while rest.y > rest.x {
        let gap = first_gap(rest);
        if !(gap.y > gap.x) { break; }
        sums[solid.material] += (gap.y - gap.x) * solid.density_g_per_cm3;
        if displaced_by_volume {
            if piece_count == PIECES { overflow = true; break; }
            piece_span[piece_count] = gap;
            piece_density[piece_count] = solid.density_g_per_cm3;
            piece_material[piece_count] = solid.material;
            piece_count += 1u;
        }
        rest.x = gap.y;
    }
    insert(span);
}
