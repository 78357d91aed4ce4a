// What shapes and meshes claim of a ray, the last object first; reads view, solids, sums of the shader that includes it.

const PIECES: u32 = 16u;

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
    find_hits(solid.root, view.depth_ref_mm, direction);
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
