// How far a photon flies, and how much of a beam arrives: twin of src/transport/flight.rs.

const OUTSIDE: u32 = 0xffffffffu;
const SEVERAL: u32 = 0xfffffffeu;
const FAR_MM: f32 = 1e30;
const MOST_STEPS: u32 = 65536u;

const EMPTY: u32 = 0u;
const UNIFORM: u32 = 1u;

const COLLISION: u32 = 0u;
const ARRIVED: u32 = 1u;
const LEFT: u32 = 2u;

struct Ray {
    position: vec3<f32>,
    direction: vec3<f32>,
    in_box: u32,
}

struct Photon {
    ray: Ray,
    energy_kev: f32,
    weight: f32,
    page: u32,
}

// The one that is followed.
var<private> photon: Photon;
// Attenuation by scene material at unit density: of the photon, and of what it would be after a scattering.
var<private> medium: array<f32, 16>;
var<private> aside: array<f32, 16>;
// The material of the latest collision.
var<private> struck: u32;

fn tune(energy_kev: f32) {
    for (var material = 0u; material < job.materials; material += 1u) { medium[material] = per_mm_at_unit_density(material, energy_kev); }
}

fn tune_aside(energy_kev: f32) {
    for (var material = 0u; material < job.materials; material += 1u) { aside[material] = per_mm_at_unit_density(material, energy_kev); }
}

fn per_mm(is_aside: bool, material: u32) -> f32 {
    if is_aside { return aside[material]; }
    return medium[material];
}

// 1/direction; far instead of infinite along an axis, so that no 0 · ∞ arises on a face.
fn inverse_of(direction: vec3<f32>) -> vec3<f32> {
    let small = abs(direction) < vec3<f32>(1e-30);
    let signs = select(vec3<f32>(1.0), vec3<f32>(-1.0), direction < vec3<f32>(0.0));
    return select(1.0 / direction, signs * FAR_MM, small);
}

fn cell_of(axis: u32, x: f32) -> u32 {
    let first = job.planes[axis];
    var low = 0u;
    var high = job.cells[axis];
    while high - low > 1u {
        let middle = (low + high) / 2u;
        if numbers[first + middle] <= x { low = middle; } else { high = middle; }
    }
    return low;
}

fn box_of(cell: vec3<u32>) -> u32 {
    return indices[job.box_of_cell + cell.x + job.cells.x * (cell.y + job.cells.y * cell.z)];
}

// Leaves the photon where it first meets the scene's bounds: after how many mm, less than 0 if it never does.
fn enter() -> f32 {
    let inverse = inverse_of(photon.ray.direction);
    let a = (job.bounds_low.xyz - photon.ray.position) * inverse;
    let b = (job.bounds_high.xyz - photon.ray.position) * inverse;
    let near = min(a, b);
    let far = max(a, b);
    let start = max(max(max(near.x, near.y), near.z), 0.0);
    if !(start < min(min(far.x, far.y), far.z)) { return -1.0; }
    let position = clamp(photon.ray.position + photon.ray.direction * start, job.bounds_low.xyz, job.bounds_high.xyz);
    photon.ray.position = position;
    photon.ray.in_box = box_of(vec3<u32>(cell_of(0u, position.x), cell_of(1u, position.y), cell_of(2u, position.z)));
    return start;
}

// Distance to where a ray leaves its box, and the axis.
fn exit_of(ray: Ray, inverse: vec3<f32>) -> vec2<f32> {
    let faces = select(boxes[ray.in_box].low, boxes[ray.in_box].high, inverse > vec3<f32>(0.0));
    let d = (faces - ray.position) * inverse;
    var found = vec2<f32>(d.x, 0.0);
    if d.y <= found.x { found = vec2<f32>(d.y, 1.0); }
    if d.z < found.x { found = vec2<f32>(d.z, 2.0); }
    return vec2<f32>(max(found.x, 0.0), found.y);
}

fn neighbour(index: u32, axis: u32, forwards: bool) -> u32 {
    switch axis {
        case 0u: { return select(boxes[index].x_below, boxes[index].x_above, forwards); }
        case 1u: { return select(boxes[index].y_below, boxes[index].y_above, forwards); }
        default: { return select(boxes[index].z_below, boxes[index].z_above, forwards); }
    }
}

// The box across the face on `axis` that a ray has reached; OUTSIDE beyond the last.
fn across(ray: Ray, inverse: vec3<f32>, axis: u32) -> u32 {
    let forwards = inverse[axis] > 0.0;
    let next = neighbour(ray.in_box, axis, forwards);
    if next != SEVERAL { return next; }
    let low = boxes[ray.in_box].low_cell;
    let high = boxes[ray.in_box].high_cell;
    var cell: vec3<u32>;
    for (var n = 0u; n < 3u; n += 1u) {
        if n == axis {
            cell[n] = select(low[n] - 1u, high[n], forwards);
        } else if high[n] - low[n] == 1u {
            cell[n] = low[n];
        } else {
            cell[n] = clamp(cell_of(n, ray.position[n]), low[n], high[n] - 1u);
        }
    }
    return box_of(cell);
}

// A mixture's words: things, flags (1 keeps air, 2 is full), ranges; then the things; then by range the material and the bits of from and to.
fn majorant(words: u32, is_aside: bool) -> f32 {
    let ranges = words + 3u + indices[words];
    var most = 0.0;
    for (var n = 0u; n < indices[words + 2u]; n += 1u) {
        most = max(most, bitcast<f32>(indices[ranges + 3u * n + 2u]) * per_mm(is_aside, indices[ranges + 3u * n]));
    }
    return most;
}

fn minorant(words: u32, is_aside: bool) -> f32 {
    if (indices[words + 1u] & 2u) == 0u { return 0.0; }
    let ranges = words + 3u + indices[words];
    var least = FAR_MM;
    for (var n = 0u; n < indices[words + 2u]; n += 1u) {
        least = min(least, bitcast<f32>(indices[ranges + 3u * n + 1u]) * per_mm(is_aside, indices[ranges + 3u * n]));
    }
    return least;
}

fn attenuation_at(words: u32, point: vec3<f32>, is_aside: bool) -> f32 {
    draw_at(words + 3u, indices[words], (indices[words + 1u] & 1u) != 0u, point);
    var sum = 0.0;
    for (var n = 0u; n < parts; n += 1u) { sum += part_density[n] * per_mm(is_aside, part_material[n]); }
    return sum;
}

// Which of the materials at the point is struck where `real` lies in the sum of their attenuations.
fn struck_at(real_at: f32) -> u32 {
    var real = real_at;
    var last = 0u;
    for (var n = 0u; n < parts; n += 1u) {
        last = part_material[n];
        real -= part_density[n] * medium[last];
        if real < 0.0 { break; }
    }
    return last;
}

// Flies until a collision, the end of the scene, or `path_mm`.
fn fly(path_mm: f32) -> u32 {
    let inverse = inverse_of(photon.ray.direction);
    var left_mm = path_mm;
    var depth = exponential();
    for (var steps = 0u; steps < MOST_STEPS; steps += 1u) {
        let exit = exit_of(photon.ray, inverse);
        var step_mm = min(exit.x, left_mm);
        let arrives = left_mm <= exit.x;
        let words = indices[job.contents + boxes[photon.ray.in_box].content];
        let kind = indices[words];
        if kind == UNIFORM {
            let material = indices[words + 1u];
            let rate = bitcast<f32>(indices[words + 2u]) * medium[material];
            if rate * step_mm > depth {
                photon.ray.position += photon.ray.direction * (depth / rate);
                struck = material;
                return COLLISION;
            }
            depth -= rate * step_mm;
        } else if kind != EMPTY {
            let most = majorant(words + 1u, false);
            for (var tries = 0u; most * step_mm > depth; tries += 1u) {
                if tries == MOST_STEPS { give_up(NO_END); return LEFT; }
                let flown_mm = depth / most;
                photon.ray.position += photon.ray.direction * flown_mm;
                step_mm -= flown_mm;
                left_mm -= flown_mm;
                let rate = attenuation_at(words + 1u, photon.ray.position, false);
                let real = random() * most;
                if real < rate {
                    struck = struck_at(real);
                    return COLLISION;
                }
                depth = exponential();
            }
            depth -= most * step_mm;
        }
        photon.ray.position += photon.ray.direction * step_mm;
        if arrives { return ARRIVED; }
        left_mm -= step_mm;
        let next = across(photon.ray, inverse, u32(exit.y));
        if next == OUTSIDE { return LEFT; }
        photon.ray.in_box = next;
    }
    give_up(NO_END);
    return LEFT;
}

// An unbiased estimate of the share that arrives after `path_mm`.
fn transmission(from_ray: Ray, path_mm: f32, is_aside: bool) -> f32 {
    var ray = from_ray;
    let inverse = inverse_of(ray.direction);
    var left_mm = path_mm;
    var depth = 0.0;
    var share = 1.0;
    var next_at = exponential();
    for (var steps = 0u; steps < MOST_STEPS; steps += 1u) {
        let exit = exit_of(ray, inverse);
        let step_mm = min(exit.x, left_mm);
        let start = ray.position;
        ray.position += ray.direction * step_mm;
        let words = indices[job.contents + boxes[ray.in_box].content];
        let kind = indices[words];
        if kind == UNIFORM {
            depth += bitcast<f32>(indices[words + 2u]) * per_mm(is_aside, indices[words + 1u]) * step_mm;
        } else if kind != EMPTY {
            let most = majorant(words + 1u, is_aside);
            let least = minorant(words + 1u, is_aside);
            depth += least * step_mm;
            // Above the minorant the box is crossed in units of what a tentative collision takes.
            let all_of_it = (most - least) * step_mm;
            var gone = next_at;
            for (var tries = 0u; gone < all_of_it; tries += 1u) {
                if tries == MOST_STEPS { give_up(NO_END); return 0.0; }
                let rate = attenuation_at(words + 1u, start + ray.direction * (gone / (most - least)), is_aside);
                share *= max((most - rate) / (most - least), 0.0);
                gone += exponential();
            }
            next_at = gone - all_of_it;
            if share == 0.0 { return 0.0; }
        }
        left_mm -= step_mm;
        if !(left_mm > 0.0) { return share * exp(-depth); }
        let next = across(ray, inverse, u32(exit.y));
        if next == OUTSIDE { return share * exp(-depth); }
        ray.in_box = next;
    }
    give_up(NO_END);
    return 0.0;
}
