// Photons from the focal spot to their end, and what they add to the detector: twin of src/transport/history.rs, source.rs and panel.rs.
// Sums are whole numbers of 1/64 keV (or photons), rounded at random: they do not depend on the order in which they are added.

// #include shared/philox.wgsl
// #include transport/data.wgsl
// #include transport/random.wgsl
// #include transport/beam.wgsl
// #include transport/physics.wgsl
// #include transport/matter.wgsl
// #include transport/flight.wgsl

override QUANTA: f32;            // units of sums per keV
const MOST_COLLISIONS: u32 = 100000u;
const PRIMARY: u32 = 0u;
const COMPTON: u32 = 1u;
const RAYLEIGH: u32 = 2u;
const MULTIPLE: u32 = 3u;

var<private> batch: u32;
// Energy by material and by fate of this invocation's histories.
var<private> absorbed: array<f32, 16>;
var<private> fates: array<f32, 3>;

fn stride() -> u32 {
    return PAGES * job.grid_px.x * job.grid_px.y + job.materials + FATES;
}

fn add(slot: u32, amount: f32) {
    // What is no number is no signal, and is told.
    if !(amount >= 0.0 && amount < 1e7) { give_up(NO_NUMBER); return; }
    let quanta = u32(amount * QUANTA + random());
    if quanta == 0u { return; }
    let index = 2u * (batch * stride() + slot);
    let before = atomicAdd(&sums[index], quanta);
    if before + quanta < before { atomicAdd(&sums[index + 1u], 1u); }
}

fn detect(page: u32, pixel: u32, signal: f32) {
    add(page * job.grid_px.x * job.grid_px.y + pixel, signal);
}

fn path_to_plane(position: vec3<f32>, direction: vec3<f32>) -> f32 {
    let towards = dot(direction, job.axis_z.xyz);
    if !(towards > 0.0) { return FAR_MM; }
    return max((job.source.w - dot(position - job.source.xyz, job.axis_z.xyz)) / towards, 0.0);
}

fn turned(direction: vec3<f32>, cosine: f32, azimuth: vec2<f32>) -> vec3<f32> {
    let sign_z = select(1.0, -1.0, direction.z < 0.0);
    let a = -1.0 / (sign_z + direction.z);
    let b = direction.x * direction.y * a;
    let first = vec3<f32>(1.0 + sign_z * direction.x * direction.x * a, sign_z * b, -sign_z * direction.x);
    let second = vec3<f32>(b, sign_z + direction.y * direction.y * a, -direction.y);
    let sine = sqrt(max(1.0 - cosine * cosine, 0.0));
    // Rounding would otherwise add up over a history.
    return normalize(direction * cosine + first * (sine * azimuth.x) + second * (sine * azimuth.y));
}

// What a photon that is scattered onto a point of the image sends there on average, against a direction drawn evenly over the image.
fn expect_at(material: u32, is_compton: bool, direction: vec3<f32>, path_mm: f32, pixel: u32) {
    // A photon on the plane sends nothing to it.
    let towards = dot(direction, job.axis_z.xyz);
    if !(towards > 0.0) { return; }
    let place = on_plane(photon.ray.position + direction * path_mm);
    let through = passed(place, direction);
    if through == 0.0 { return; }
    let cosine = clamp(dot(photon.ray.direction, direction), -1.0, 1.0);
    var energy_kev = photon.energy_kev;
    var density: f32;
    if is_compton {
        energy_kev *= energy_ratio(photon.energy_kev, 1.0 - cosine);
        if energy_kev < job.share_offset.z { return; }
        tune_aside(energy_kev);
        density = compton_density(material, photon.energy_kev, cosine);
    } else {
        density = rayleigh_density(material, photon.energy_kev, cosine);
    }
    let even = path_mm * path_mm / (towards * job.axis_z.w);
    let signal = through * photon.weight * response(energy_kev) * density / (density + even);
    let ray = Ray(photon.ray.position, direction, photon.ray.in_box);
    detect(photon.page, pixel, signal * transmission(ray, path_mm, is_compton));
}

// A collision with a material: false where the photon ends.
fn collide(material: u32) -> bool {
    let of_material = shares(material, photon.energy_kev);
    let chance = random();
    if chance < of_material.x {
        absorbed[material] += photon.weight * photon.energy_kev;
        return false;
    }
    let is_compton = chance < of_material.y;
    if photon.page == PRIMARY {
        photon.page = select(RAYLEIGH, COMPTON, is_compton);
    } else {
        photon.page = MULTIPLE;
    }
    let before_kev = photon.energy_kev;
    if job.analogue == 0u {
        let share = vec2<f32>(random(), random());
        let cell = min(vec2<u32>(share * vec2<f32>(job.grid_px)), job.grid_px - vec2<u32>(1u));
        let way = in_lps(plane_of(share)) - photon.ray.position;
        let path_mm = length(way);
        expect_at(material, is_compton, way / path_mm, path_mm, cell.x + job.grid_px.x * cell.y);
    }
    var cosine: f32;
    if is_compton { cosine = compton_cosine(material, before_kev); } else { cosine = rayleigh_cosine(material, before_kev); }
    let direction = turned(photon.ray.direction, cosine, random_direction());
    if job.analogue == 0u {
        let path_mm = path_to_plane(photon.ray.position, direction);
        if path_mm < FAR_MM {
            let pixel = pixel_of(on_plane(photon.ray.position + direction * path_mm));
            if pixel != NO_PIXEL { expect_at(material, is_compton, direction, path_mm, pixel); }
        }
    }
    photon.ray.direction = direction;
    if is_compton {
        photon.energy_kev = before_kev * energy_ratio(before_kev, 1.0 - cosine);
        absorbed[material] += photon.weight * (before_kev - photon.energy_kev);
        if photon.energy_kev < job.share_offset.z {
            absorbed[material] += photon.weight * photon.energy_kev;
            return false;
        }
        tune(photon.energy_kev);
    }
    return true;
}

fn follow() {
    var place: vec2<f32>;
    var tries = 0u;
    for (; tries < 1000000u; tries += 1u) {
        place = job.field.xy + (job.field.zw - job.field.xy) * vec2<f32>(random(), random());
        if is_open(place) && random() < obliquity(place) { break; }
    }
    if tries == 1000000u { give_up(NO_START); return; }
    let drawn = random() * f32(job.bins);
    var bin = min(u32(drawn), job.bins - 1u);
    if drawn - f32(bin) > numbers[job.spectrum.x + 3u * bin + 1u] { bin = u32(numbers[job.spectrum.x + 3u * bin + 2u]); }
    let energy_kev = numbers[job.spectrum.x + 3u * bin];
    var start = job.source.xyz;
    let sigma = vec2<f32>(job.axis_x.w, job.axis_y.w);
    if any(sigma > vec2<f32>(0.0)) {
        let offset = sigma * (sqrt(2.0 * exponential()) * random_direction());
        start += job.axis_x.xyz * offset.x + job.axis_y.xyz * offset.y;
    }
    let way = in_lps(place) - start;
    let whole_mm = length(way);
    let weight = left_of(bin, place);
    fates[STARTED] += weight * energy_kev;
    let signal = weight * response(energy_kev);
    let aim = pixel_of(place);
    photon = Photon(Ray(start, way / whole_mm, 0u), energy_kev, weight, PRIMARY);
    var gone_mm = -1.0;
    if job.has_space != 0u { gone_mm = enter(); }
    if !(gone_mm >= 0.0 && gone_mm < whole_mm) {
        if aim != NO_PIXEL { detect(PRIMARY, aim, signal); }
        fates[DETECTED] += weight * energy_kev;
        return;
    }
    tune(energy_kev);
    var path_mm = whole_mm - gone_mm;
    if job.analogue == 0u && aim != NO_PIXEL { detect(PRIMARY, aim, signal * transmission(photon.ray, path_mm, false)); }
    for (var collisions = 0u; collisions < MOST_COLLISIONS; collisions += 1u) {
        let end = fly(path_mm);
        if given_up { return; }
        if end == COLLISION {
            if !collide(struck) { return; }
        } else {
            let ends_on_plane = path_mm < FAR_MM;
            if ends_on_plane && job.analogue != 0u {
                let at = on_plane(photon.ray.position + photon.ray.direction * path_to_plane(photon.ray.position, photon.ray.direction));
                let pixel = pixel_of(at);
                if pixel != NO_PIXEL {
                    var through = 1.0;
                    if photon.page != PRIMARY { through = passed(at, photon.ray.direction); }
                    detect(photon.page, pixel, through * photon.weight * response(photon.energy_kev));
                }
            }
            let carried = photon.weight * photon.energy_kev;
            if ends_on_plane { fates[DETECTED] += carried; } else { fates[ESCAPED] += carried; }
            return;
        }
        path_mm = path_to_plane(photon.ray.position, photon.ray.direction);
    }
    give_up(NO_END);
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let number = group.x + groups.x * group.y;
    batch = number / job.groups_per_batch;
    let offset = (number * 64u + lane) * job.each;
    for (var n = 0u; n < job.each; n += 1u) {
        let low = job.first.x + offset + n;
        let carry = select(0u, 1u, low < job.first.x);
        given_up = false;
        open_history(vec2<u32>(low, job.first.y + carry));
        follow();
        if given_up { atomicAdd(&trouble[cause], 1u); }
    }
    given_up = false;
    let pixels = PAGES * job.grid_px.x * job.grid_px.y;
    for (var material = 0u; material < job.materials; material += 1u) { add(pixels + material, absorbed[material]); }
    for (var fate = 0u; fate < FATES; fate += 1u) { add(pixels + job.materials + fate, fates[fate]); }
    if given_up { atomicAdd(&trouble[cause], 1u); }
}
