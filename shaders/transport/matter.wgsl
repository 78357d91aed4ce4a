// What is at a point: twin of src/transport/matter.rs.

const NO_THING: u32 = 0xffffffffu;
const VOLUME: u32 = 4u;

// Attenuation by scene material at unit density, at this energy.
var<private> medium: array<f32, 16>;
var<private> medium_kev: f32;

fn tune(energy_kev: f32) {
    if energy_kev == medium_kev { return; }
    medium_kev = energy_kev;
    for (var material = 0u; material < job.materials; material += 1u) { medium[material] = per_mm_at_unit_density(material, energy_kev); }
}

// Of the materials drawn at a point: how many, their attenuation together, and one of them, drawn by its share of it.
var<private> parts: u32;
var<private> parts_per_mm: f32;
var<private> struck: u32;

fn add_part(material: u32, density: f32) {
    let per_mm = density * medium[material];
    parts += 1u;
    parts_per_mm += per_mm;
    if parts == 1u || random() * parts_per_mm < per_mm { struck = material; }
}

// Draws what the `count` things named from `first` on in `indices`, the scene's last first, have at a point.
fn draw_at(first: u32, count: u32, keeps_air: bool, point: vec3<f32>) {
    parts = 0u;
    parts_per_mm = 0.0;
    for (var air = 0u; air < 2u; air += 1u) {
        if air == 1u && !keeps_air { return; }
        var present = NO_THING;
        for (var n = 0u; n < count; n += 1u) {
            let thing = indices[first + n];
            if things[thing].own != present && parts > 0u { return; }
            present = things[thing].own;
            draw_thing(thing, air == 1u, count == 1u, point);
        }
        if parts > 0u { return; }
    }
}

fn draw_thing(thing: u32, air: bool, alone: bool, point: vec3<f32>) {
    let at = vec4<f32>(point, 1.0);
    let local = vec3<f32>(dot(things[thing].row_x, at), dot(things[thing].row_y, at), dot(things[thing].row_z, at));
    let kind = things[thing].kind;
    if kind == VOLUME { draw_voxel(thing, air, alone, local); return; }
    if (things[thing].is_air != 0u) != air { return; }
    var is_inside: bool;
    if has_meshes && kind == MESH {
        is_inside = winds_around(things[thing].root, point);
    } else {
        is_inside = contains(kind, things[thing].shape.xyz, local);
    }
    if is_inside { add_part(things[thing].material, things[thing].density_g_per_cm3); }
}

fn contains(kind: u32, shape: vec3<f32>, p: vec3<f32>) -> bool {
    if kind == 0u { let q = p / shape; return dot(q, q) <= 1.0; }
    if kind == 1u { return all(abs(p) <= shape); }
    let squared = dot(p.xy, p.xy);
    return p.z >= 0.0 && p.z <= shape.x && squared <= shape.y * shape.y && !(shape.z > 0.0 && squared < shape.z * shape.z);
}

// Of a line through a mesh: beyond which place it counts, how often the mesh winds around that place, and the first crossing beyond it.
var<private> counted_mm: f32;
var<private> winding: f32;
var<private> first_mm: f32;

fn corner(index: u32) -> vec3<f32> {
    let at = job.mesh_corners + 3u * index;
    return vec3<f32>(numbers[at], numbers[at + 1u], numbers[at + 2u]);
}

// What a closed mesh has around a place is left once more than it is entered beyond it: no crossing has to be kept, however many there are.
fn take_hit(at_mm: f32, step: f32) {
    if !(at_mm > counted_mm) { return; }
    winding -= step;
    first_mm = min(first_mm, at_mm);
}

fn look_along(root: u32, position: vec3<f32>, direction: vec3<f32>, from_mm: f32) {
    counted_mm = from_mm;
    winding = 0.0;
    first_mm = FAR_MM;
    let size = abs(direction);
    var axis = 2u;
    if size.y > size.z { axis = 1u; }
    if size.x > max(size.y, size.z) { axis = 0u; }
    cross_mesh(root, position, direction, axis, from_mm);
}

// Whether a point is inside, by a line along no special direction.
fn winds_around(root: u32, point: vec3<f32>) -> bool {
    if any(point < nodes[root].lo) || any(point > nodes[root].hi) { return false; }
    look_along(root, point, vec3<f32>(0.576129, 0.613407, 0.540113), 0.0);
    return winding != 0.0;
}

fn voxel_at(thing: u32, at: vec3<u32>) -> u32 {
    let size = things[thing].size;
    return voxels[things[thing].first_voxel + at.x + size.x * (at.y + size.y * at.z)];
}

// 0 where nothing is, 1 for air, 2 for other matter.
fn kind_of(thing: u32, voxel: u32) -> u32 {
    let class_number = voxel >> 28u;
    if class_number == 0u || (voxel & 0x0fffffffu) == 0u { return 0u; }
    return 2u - indices[things[thing].classes + 2u * (class_number - 1u) + 1u];
}

fn draw_voxel(thing: u32, air: bool, alone: bool, at: vec3<f32>) {
    let last = vec3<f32>(things[thing].size - vec3<u32>(1u));
    if any(at < vec3<f32>(-0.5)) || any(at > last + 0.5) { return; }
    var low: vec3<u32>;
    var upper = vec3<f32>(0.0);
    if things[thing].is_piecewise != 0u {
        low = vec3<u32>(min(at + 0.5, last));
    } else {
        let x = clamp(at, vec3<f32>(0.0), last);
        low = vec3<u32>(min(floor(x), max(last - 1.0, vec3<f32>(0.0))));
        upper = x - vec3<f32>(low);
    }
    let chance = vec3<f32>(random(), random(), random());
    let voxel = voxel_at(thing, low + select(vec3<u32>(0u), vec3<u32>(1u), chance < upper));
    let kind = kind_of(thing, voxel);
    var holds_matter = true;
    if kind != 2u { if alone { holds_matter = !air; } else { holds_matter = has_matter(thing, low, upper); } }
    if kind != 0u {
        if holds_matter != air {
            let class_number = voxel >> 28u;
            add_part(indices[things[thing].classes + 2u * (class_number - 1u)], f32(voxel & 0x0fffffffu) * DENSITY_UNIT);
        }
    } else if holds_matter && !air {
        // It displaces what lies below all the same.
        add_part(indices[things[thing].classes], 0.0);
    }
}

// Whether a corner with weight holds anything but air.
fn has_matter(thing: u32, low: vec3<u32>, upper: vec3<f32>) -> bool {
    for (var bits = 0u; bits < 8u; bits += 1u) {
        let step = vec3<u32>(bits & 1u, (bits >> 1u) & 1u, bits >> 2u);
        let is_upper = step == vec3<u32>(1u);
        let weight = select(1.0 - upper, upper, is_upper);
        if all(weight != vec3<f32>(0.0)) && kind_of(thing, voxel_at(thing, low + step)) == 2u { return true; }
    }
    return false;
}
