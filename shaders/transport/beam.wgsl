// Beam and detector: twin of src/transport/source.rs, beam_shape.rs and panel.rs. Places on the plane are mm from the principal point.

const NO_PIXEL: u32 = 0xffffffffu;
override HEEL_FIRST_DEG: f32;
override HEEL_STEP_DEG: f32;

fn on_plane(point: vec3<f32>) -> vec2<f32> {
    let way = point - job.source.xyz;
    return vec2<f32>(dot(way, job.axis_x.xyz), dot(way, job.axis_y.xyz));
}

fn in_lps(place: vec2<f32>) -> vec3<f32> {
    return job.source.xyz + job.axis_x.xyz * place.x + job.axis_y.xyz * place.y + job.axis_z.xyz * job.source.w;
}

fn pixel_of(place: vec2<f32>) -> u32 {
    let from_plane = job.share_from_plane;
    let share = vec2<f32>(dot(from_plane.xy, place) + from_plane.z, from_plane.w * place.y + job.share_offset.y);
    let at = share * vec2<f32>(job.grid_px);
    if any(at < vec2<f32>(0.0)) || any(at >= vec2<f32>(job.grid_px)) { return NO_PIXEL; }
    return u32(at.x) + job.grid_px.x * u32(at.y);
}

fn plane_of(share: vec2<f32>) -> vec2<f32> {
    let from_plane = job.share_from_plane;
    let y = (share.y - job.share_offset.y) / from_plane.w;
    return vec2<f32>((share.x - from_plane.z - from_plane.y * y) / from_plane.x, y);
}

fn is_open(place: vec2<f32>) -> bool {
    switch job.field_kind {
        case 0u: { return pixel_of(place) != NO_PIXEL; }
        case 1u: {
            let off = place - job.field_shape.xy;
            let turn = job.field_turn.xy;
            let local = vec2<f32>(dot(turn, off), turn.x * off.y - turn.y * off.x);
            return all(abs(local) <= job.field_shape.zw);
        }
        case 2u: { return distance(place, job.field_shape.xy) <= job.field_shape.z; }
        default: {
            var inside = false;
            for (var n = 0u; n < job.corners; n += 1u) {
                let m = (n + 1u) % job.corners;
                let a = vec2<f32>(numbers[job.polygon.x + 2u * n], numbers[job.polygon.x + 2u * n + 1u]);
                let b = vec2<f32>(numbers[job.polygon.x + 2u * m], numbers[job.polygon.x + 2u * m + 1u]);
                if (a.y > place.y) != (b.y > place.y) && place.x < a.x + (b.x - a.x) * (place.y - a.y) / (b.y - a.y) { inside = !inside; }
            }
            return inside;
        }
    }
}

fn obliquity(place: vec2<f32>) -> f32 {
    let sdd = job.source.w;
    let squared = sdd * sdd / (sdd * sdd + dot(place, place));
    return squared * sqrt(squared);
}

// Share of the photons of an energy that bow-tie and heel leave.
fn left_of(bin: u32, place: vec2<f32>) -> f32 {
    let ray = vec3<f32>(place, job.source.w);
    var share = 1.0;
    if job.bowtie.y > 0u { share = exp(-numbers[job.bowtie.x + bin] * bowtie_mm(ray)); }
    if job.heel.w == 0.0 { return share; }
    let sine = dot(job.heel.xyz, ray) / length(ray);
    if !(sine > 0.0) { return 0.0; }
    let rows = job.heel_table.y;
    let position = clamp((degrees(asin(min(sine, 1.0))) - HEEL_FIRST_DEG) / HEEL_STEP_DEG, 0.0, f32(rows - 1u));
    let row = min(u32(position), rows - 2u);
    let low = numbers[job.heel_table.x + row * job.bins + bin];
    return share * (low + (numbers[job.heel_table.x + (row + 1u) * job.bins + bin] - low) * (position - f32(row)));
}

// Way of a ray through the bow-tie: linear between its points, constant beyond them.
fn bowtie_mm(ray: vec3<f32>) -> f32 {
    let follows_rows = job.share_offset.x != 0.0;
    let along = select(ray.x, ray.y, follows_rows);
    let across = select(ray.y, ray.x, follows_rows);
    let in_plane = length(vec2<f32>(along, ray.z));
    let angle_deg = degrees(atan2(along, ray.z));
    let points = job.bowtie.x + job.bins;
    var above = 0u;
    while above < job.bowtie.y && numbers[points + 2u * above] <= angle_deg { above += 1u; }
    var mm: f32;
    if above == 0u || above == job.bowtie.y {
        mm = numbers[points + 2u * min(above, job.bowtie.y - 1u) + 1u];
    } else {
        let low = points + 2u * (above - 1u);
        let share = (angle_deg - numbers[low]) / (numbers[low + 2u] - numbers[low]);
        mm = mix(numbers[low + 1u], numbers[low + 3u], share);
    }
    return mm * length(vec2<f32>(in_plane, across)) / in_plane;
}

// Share of scatter that an antiscatter grid lets pass.
fn passed(place: vec2<f32>, direction: vec3<f32>) -> f32 {
    let ratio = job.field_turn.z;
    if ratio == 0.0 { return 1.0; }
    let along_z = dot(direction, job.axis_z.xyz);
    let follows_rows = job.field_turn.w != 0.0;
    let slope = select(dot(direction, job.axis_x.xyz), dot(direction, job.axis_y.xyz), follows_rows) / along_z;
    return max(1.0 - ratio * abs(slope - select(place.x, place.y, follows_rows) / job.source.w), 0.0);
}
