// How far a photon flies, and how much of a beam arrives: twin of src/transport/flight.rs.

const OUTSIDE: u32 = 0xffffffffu;
const SEVERAL: u32 = 0xfffffffeu;
const FAR_MM: f32 = 1e30;
const MOST_STEPS: u32 = 65536u;
override NEAR_MM: f32;        // what dense shapes are taken to be thicker by, twice

const EMPTY: u32 = 0u;
const UNIFORM: u32 = 1u;

const COLLISION: u32 = 0u;
const ARRIVED: u32 = 1u;
const LOST: u32 = 2u;

struct Ray {
    position: vec3<f32>,
    direction: vec3<f32>,
    in_box: u32,
}

// What is walked, how far, and of a beam the share that arrives.
var<private> ray: Ray;
var<private> path_mm: f32;
var<private> arrived: f32;

// 1/direction; far instead of infinite along an axis, so that no 0 · ∞ arises on a face.
fn inverse_of(direction: vec3<f32>) -> vec3<f32> {
    let small = abs(direction) < vec3<f32>(1e-30);
    let signs = select(vec3<f32>(1.0), vec3<f32>(-1.0), direction < vec3<f32>(0.0));
    return select(1.0 / direction, signs * FAR_MM, small);
}

// The cell with coordinate x; the first or the last beyond the ends.
fn cell_of(axis: u32, x: f32) -> u32 {
    let cells = job.cells[axis];
    let low = job.bounds_low[axis];
    let buckets = 4u * (cells + 1u);
    let share = clamp((x - low) / (job.bounds_high[axis] - low), 0.0, 1.0);
    var cell = indices[job.buckets[axis] + min(u32(share * f32(buckets)), buckets - 1u)];
    while cell + 1u < cells && numbers[job.planes[axis] + cell + 1u] <= x { cell += 1u; }
    return cell;
}

fn box_of(cell: vec3<u32>) -> u32 {
    return indices[job.box_of_cell + cell.x + job.cells.x * (cell.y + job.cells.y * cell.z)];
}

// Takes the ray to where it first meets the scene's bounds: after how many mm, less than 0 if it never does.
fn enter() -> f32 {
    let inverse = inverse_of(ray.direction);
    let a = (job.bounds_low.xyz - ray.position) * inverse;
    let b = (job.bounds_high.xyz - ray.position) * inverse;
    let near = min(a, b);
    let far = max(a, b);
    let start = max(max(max(near.x, near.y), near.z), 0.0);
    if !(start < min(min(far.x, far.y), far.z)) { return -1.0; }
    let position = clamp(ray.position + ray.direction * start, job.bounds_low.xyz, job.bounds_high.xyz);
    ray.position = position;
    ray.in_box = box_of(vec3<u32>(cell_of(0u, position.x), cell_of(1u, position.y), cell_of(2u, position.z)));
    return start;
}

// Distance to where the ray leaves its box, and the axis.
fn exit_of(inverse: vec3<f32>) -> vec2<f32> {
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

// The box across the face on `axis` that the ray has reached; OUTSIDE beyond the last.
fn across(inverse: vec3<f32>, axis: u32) -> u32 {
    let forwards = inverse[axis] > 0.0;
    let next = neighbour(ray.in_box, axis, forwards);
    if next != SEVERAL { return next; }
    let shifts = vec3<u32>(0u, 10u, 20u);
    let low = (vec3<u32>(boxes[ray.in_box].low_cell) >> shifts) & vec3<u32>(1023u);
    let high = (vec3<u32>(boxes[ray.in_box].high_cell) >> shifts) & vec3<u32>(1023u);
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

// Attenuation at any point of a mixture is between these; at least 0 unless it is full.
fn bounds_of(content: u32, amount: u32) -> vec2<f32> {
    var bounds = vec2<f32>(FAR_MM, 0.0);
    let last = content + 3u * (amount & 255u);
    for (var at = content; at < last; at += 3u) {
        let unit = medium[indices[at]];
        bounds.x = min(bounds.x, bitcast<f32>(indices[at + 1u]) * unit);
        bounds.y = max(bounds.y, bitcast<f32>(indices[at + 2u]) * unit);
    }
    if (amount & 512u) == 0u { bounds.x = 0.0; }
    return bounds;
}

fn attenuation_at(content: u32, amount: u32, point: vec3<f32>) -> f32 {
    draw_at(content + 3u * (amount & 255u), amount >> 16u, (amount & 256u) != 0u, point);
    return parts_per_mm;
}

// Where the ray runs through the next of the dense shapes that `list` counts and names, lumens included: the first stretch that does not end
// behind it, mm ahead; empty where there is none. Of a mesh that is ahead only where it begins: the rest is told once the ray is there.
fn next_stretch(list: u32) -> vec2<f32> {
    var next = vec2<f32>(FAR_MM, -FAR_MM);
    let at = vec4<f32>(ray.position, 1.0);
    let along = vec4<f32>(ray.direction, 0.0);
    for (var n = 1u; n <= indices[list]; n += 1u) {
        let thing = indices[list + n];
        let kind = things[thing].kind;
        if has_meshes && kind == MESH {
            look_along(things[thing].root, ray.position, ray.direction, -NEAR_MM);
            let starts = select(first_mm, -FAR_MM, winding != 0.0);
            if first_mm + NEAR_MM > starts && starts < next.x { next = vec2<f32>(starts, first_mm + NEAR_MM); }
            continue;
        }
        let x = things[thing].row_x;
        let y = things[thing].row_y;
        let z = things[thing].row_z;
        let p = vec3<f32>(dot(x, at), dot(y, at), dot(z, at));
        let q = vec3<f32>(dot(x, along), dot(y, along), dot(z, along));
        let shape = things[thing].shape.xyz;
        var one: vec2<f32>;
        switch kind {
            case 0u: { one = quadric(p / shape, q / shape, 1.0); }
            case 1u: { one = cuboid(p, q, -shape, shape); }
            default: { one = meet(quadric(vec3<f32>(p.xy, 0.0), vec3<f32>(q.xy, 0.0), shape.y), slab(p.z, q.z, 0.0, shape.x)); }
        }
        if one.y > one.x && one.y > -NEAR_MM && one.x < next.x { next = one; }
    }
    return next;
}

// Walks the ray over `path_mm` or to the scene's end. A flight ends at a collision with what is `struck`; of a beam `arrived` is an unbiased
// estimate of the share that comes to the end. Both meet tentative collisions in mixtures: a flight at the majorant, a beam above the minorant.
fn walk(is_flight: bool) -> u32 {
    let inverse = inverse_of(ray.direction);
    var left_mm = path_mm;
    var depth = 0.0;
    var share = 1.0;
    var next_at = exponential();
    var end = LOST;
    for (var steps = 0u; steps < MOST_STEPS; steps += 1u) {
        let exit = exit_of(inverse);
        let whole_mm = min(exit.x, left_mm);
        var step_mm = whole_mm;
        var content = boxes[ray.in_box].content;
        var amount = boxes[ray.in_box].amount;
        var flown_mm = -1.0;
        if (content & 3u) == UNIFORM {
            let per_mm = bitcast<f32>(amount) * medium[content >> 2u];
            let all_of_it = per_mm * step_mm;
            if !is_flight {
                depth += all_of_it;
            } else if all_of_it > next_at {
                flown_mm = next_at / per_mm;
                struck = content >> 2u;
            } else {
                next_at -= all_of_it;
            }
        } else if (content & 3u) != EMPTY {
            if (amount & 1024u) != 0u {
                // Where the ray runs through none of the dense shapes there is no more than the rest.
                let rest = (content >> 2u) + 3u * (amount & 255u) + (amount >> 16u);
                let next = next_stretch(rest + 2u);
                if next.x > 3.0 * NEAR_MM {
                    content = indices[rest];
                    amount = indices[rest + 1u];
                    step_mm = min(step_mm, next.x - 2.0 * NEAR_MM);
                } else {
                    step_mm = min(step_mm, next.y + 2.0 * NEAR_MM);
                }
            }
            let bounds = bounds_of(content >> 2u, amount);
            let least = select(bounds.x, 0.0, is_flight);
            depth += least * step_mm;
            // Above the minorant the box is crossed in units of what a tentative collision takes.
            let width = bounds.y - least;
            let all_of_it = width * step_mm;
            for (var tries = 0u; next_at < all_of_it; tries += 1u) {
                if tries == MOST_STEPS { share = 0.0; give_up(NO_END); break; }
                let at_mm = next_at / width;
                let per_mm = attenuation_at(content >> 2u, amount, ray.position + ray.direction * at_mm);
                if !is_flight {
                    share *= max((bounds.y - per_mm) / width, 0.0);
                } else if random() * bounds.y < per_mm {
                    flown_mm = at_mm;
                    break;
                }
                next_at += exponential();
            }
            next_at -= all_of_it;
        }
        if flown_mm >= 0.0 {
            ray.position += ray.direction * flown_mm;
            end = COLLISION;
            break;
        }
        ray.position += ray.direction * step_mm;
        left_mm -= step_mm;
        if !(left_mm > 0.0) || share == 0.0 { end = ARRIVED; break; }
        if step_mm < whole_mm { continue; }
        let next = across(inverse, u32(exit.y));
        if next == OUTSIDE { end = ARRIVED; break; }
        ray.in_box = next;
    }
    if end == LOST { give_up(NO_END); }
    arrived = share * exp(-depth);
    return end;
}
