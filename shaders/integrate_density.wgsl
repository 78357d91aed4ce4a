// Area density of each material along each ray, later objects displacing earlier ones (Eq. 1, 5).
// #include shared/view.wgsl
// #include shared/chords.wgsl
// #include shared/solid.wgsl
// #include shared/intervals.wgsl
// #include shared/mesh.wgsl
// #include shared/claim.wgsl
// #include shared/grid.wgsl

const TILE: u32 = 8u;
const MATERIALS: u32 = 8u;

struct Flags {
    overflows: atomic<u32>,          // rays on which intervals did not fit
    matter: atomic<u32>,             // 1 when any ray met some
    beyond: atomic<u32>,             // 1 when any path is longer than those that the energies were fitted to
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> solids: array<Solid>;            // in the order in which they claim the ray
@group(0) @binding(2) var<uniform> grid: Grid;
@group(0) @binding(3) var<storage, read> material_of_kind: array<u32>;
@group(0) @binding(4) var density_texture: texture_3d<f32>;               // g/cm3 per voxel
@group(0) @binding(5) var material_texture: texture_3d<u32>;              // 0, or kind of the voxel
@group(0) @binding(6) var cell_texture: texture_3d<u32>;                  // kind of the cell
@group(0) @binding(7) var<storage, read_write> density_g_per_cm2: array<f32>; // by pixel, then material
@group(0) @binding(8) var<storage, read_write> invalid: array<atomic<u32>>; // a bit per pixel: matter borders on the unknown
@group(0) @binding(9) var<storage, read_write> flags: Flags;
@group(0) @binding(10) var<storage, read> nodes: array<Node>;             // of meshes in the camera, their depth counted from depth_ref
@group(0) @binding(11) var<storage, read> corners: array<vec4<f32>>;      // as the nodes

var<private> sums: array<f32, 8>;
@compute @workgroup_size(TILE, TILE)
fn main(@builtin(global_invocation_id) id: vec3<u32>) {
    if any(id.xy >= view.size_px) { return; }
    let pixel = id.y * view.size_px.x + id.x;
    let direction = unproject(view, id.xy);
    let mm_per_depth = length(direction);
    for (var i = 0u; i < view.later_count; i += 1u) { claim_solid(i, id.xy, direction, false); }
    var cut = false;
    if view.has_volume != 0u {
        let later = covered;
        let later_count = covered_count;
        for (var i = view.later_count; i < view.solid_count; i += 1u) { claim_solid(i, id.xy, direction, true); }
        covered = later;
        covered_count = later_count;
        // Shapes were counted with the first part of the volume.
        if grid.adds != 0u { sums = array<f32, 8>(); }
        cut = cross_volume(direction);
    }
    if overflow { atomicAdd(&flags.overflows, 1u); }
    var matter = false;
    var beyond = false;
    for (var m = 0u; m < view.material_count; m += 1u) {
        let at = pixel * view.material_count + m;
        var path = sums[m] * 0.1 * mm_per_depth;
        if grid.adds != 0u { path += density_g_per_cm2[at]; }
        // Rounding may leave less than nothing; max would turn NaN into nothing as well, and hide it.
        path = select(path, 0.0, path < 0.0);
        density_g_per_cm2[at] = path;
        // By bits: a comparison may call NaN equal to nothing, or short enough.
        let bits = bitcast<u32>(path) & 0x7fffffffu;
        matter = matter || bits != 0u;
        beyond = beyond || bits >= 0x7f800000u || path > view.fitted_up_to[m / 4u][m % 4u];
    }
    if matter && atomicLoad(&flags.matter) == 0u { atomicStore(&flags.matter, 1u); }
    if beyond && atomicLoad(&flags.beyond) == 0u { atomicStore(&flags.beyond, 1u); }
    if cut { atomicOr(&invalid[pixel / 32u], 1u << (pixel % 32u)); }
}

fn corner(index: u32) -> vec3<f32> {
    return corners[index].xyz;
}

// Integrates the volume where later solids leave room. Whether it meets matter that borders on the unknown.
fn cross_volume(direction: vec3<f32>) -> bool {
    let w = vec3<f32>(direction.xy * view.depth_ref_mm - grid.centre.xy, grid.centre.z);
    let p = vec3<f32>(dot(grid.row_x.xyz, w) + grid.row_x.w, dot(grid.row_y.xyz, w) + grid.row_y.w, dot(grid.row_z.xyz, w) + grid.row_z.w);
    let q = vec3<f32>(dot(grid.row_x.xyz, direction), dot(grid.row_y.xyz, direction), dot(grid.row_z.xyz, direction));
    let lo = vec3<f32>(0.5);
    let hi = vec3<f32>(grid.size) + 0.5;
    let inside = cuboid(p, q, lo, hi);
    if !(inside.y > inside.x) { return false; }
    let seen = vec2<f32>(view.source_tau_mm, view.detector_tau_mm);
    let least = max(lo, vec3<f32>(grid.occupied_from.xy, max(grid.occupied_from.z, f32(grid.cells_from))));
    let most = min(hi, vec3<f32>(grid.occupied_to.xy, min(grid.occupied_to.z, f32(grid.cells_to))));
    var rest = select(vec2<f32>(FAR, -FAR), meet(cuboid(p, q, least, most), seen), most.z > least.z);
    var cut = false;
    while rest.y > rest.x {
        let gap = first_gap(rest);
        if !(gap.y > gap.x) { break; }
        cut = walk(p, q, gap) || cut;
        rest.x = gap.y;
    }
    return cut;
}

fn kind_of(cell: vec3<i32>) -> u32 {
    return textureLoad(cell_texture, vec3<i32>(cell.xy, cell.z - i32(grid.cells_from)), 0).x;
}

// Cell by cell along [span.x, span.y]; whether known matter bordered on the unknown.
fn walk(p: vec3<f32>, q: vec3<f32>, span: vec2<f32>) -> bool {
    let first = vec3<i32>(0, 0, i32(grid.cells_from));
    let cells = vec3<i32>(vec2<i32>(grid.size.xy) + 1, i32(grid.cells_to));
    let ahead = select(vec3<i32>(0), vec3<i32>(1), q > vec3<f32>(0.0));
    let step = select(vec3<i32>(-1), vec3<i32>(1), q > vec3<f32>(0.0));
    let parallel = q == vec3<f32>(0.0);
    let inverse = 1.0 / select(q, vec3<f32>(1.0), parallel);
    var cell = clamp(vec3<i32>(floor(p + q * span.x)), first, cells - 1);
    var t = span.x;
    var cut = false;
    for (var guard = 4 * (cells.x + cells.y + cells.z) + 64; guard > 0; guard -= 1) {
        let kind = kind_of(cell);
        var block = cell + ahead;
        if kind == EMPTY_BRICK { block = min((cell / BRICK + ahead) * BRICK, cells); }
        let next = select((vec3<f32>(block) - p) * inverse, vec3<f32>(FAR), parallel);
        var axis = select(2, 0, next.x <= next.z);
        if next.y < next[axis] { axis = 1; }
        let end = min(next[axis], span.y);
        if kind != EMPTY && kind != EMPTY_BRICK && end > t {
            add_piece(p, q, cell, kind, t, end);
            cut = cut || kind == CUT;
        }
        if !(next[axis] < span.y) { return cut; }
        t = max(t, next[axis]);
        if kind == EMPTY_BRICK {
            // Never backwards, however the position was rounded.
            let here = clamp(vec3<i32>(floor(p + q * t)), first, cells - 1);
            let brick = (cell[axis] / BRICK) * BRICK;
            cell = select(min(here, cell), max(here, cell), step > vec3<i32>(0));
            cell[axis] = select(brick - 1, brick + BRICK, step[axis] > 0);
        } else {
            cell[axis] += step[axis];
        }
        if any(cell < first) || any(cell >= cells) { return cut; }
    }
    overflow = true;
    return cut;
}

fn add_piece(p: vec3<f32>, q: vec3<f32>, cell: vec3<i32>, kind: u32, start: f32, end: f32) {
    let held = vec3<i32>(0, 0, i32(grid.voxels_from));
    let low = max(cell - 1, vec3<i32>(0)) - held;
    let high = min(cell, vec3<i32>(grid.size) - 1) - held;
    let m = p - vec3<f32>(cell) + q * (0.5 * (start + end));
    let h = q * (0.5 * (end - start));
    var below: vec4<f32>;
    var above: vec4<f32>;
    for (var i = 0u; i < 4u; i += 1u) {
        let x = select(low.x, high.x, (i & 1u) != 0u);
        let y = select(low.y, high.y, (i & 2u) != 0u);
        below[i] = textureLoad(density_texture, vec3<i32>(x, y, low.z), 0).x;
        above[i] = textureLoad(density_texture, vec3<i32>(x, y, high.z), 0).x;
    }
    if kind < MIXED {
        sums[material_of_kind[kind]] += mean_along(below, above, m, h) * (end - start);
    } else {
        for (var i = 0u; i < 8u; i += 1u) {
            let at = select(low, high, vec3<bool>((i & 1u) != 0u, (i & 2u) != 0u, (i & 4u) != 0u));
            let voxel = textureLoad(material_texture, at, 0).x;
            if voxel != 0u {
                let value = select(below[i & 3u], above[i & 3u], i >= 4u);
                sums[material_of_kind[voxel]] += mean_weight(i, m, h) * value * (end - start);
            }
        }
    }
    for (var i = 0u; i < piece_count; i += 1u) {
        let both = meet(piece_span[i], vec2<f32>(start, end));
        sums[piece_material[i]] -= max(both.y - both.x, 0.0) * piece_density[i];
    }
}
