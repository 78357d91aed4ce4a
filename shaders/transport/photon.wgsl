// The photon that is followed, what it adds to the detector, and what becomes of it at a collision.

override QUANTA: f32;            // units of sums per keV
const PRIMARY: u32 = 0u;
const COMPTON: u32 = 1u;
const RAYLEIGH: u32 = 2u;
const MULTIPLE: u32 = 3u;

struct Photon {
    ray: Ray,
    energy_kev: f32,
    weight: f32,
    page: u32,
}

var<private> batch: u32;
// The one that is followed, if there is one.
var<private> photon: Photon;
var<private> is_alive: bool;
var<private> collisions: u32;
// Of the beam that is walked: its pixel, and the signal if all of it arrived.
var<private> aim: u32;
var<private> carried: f32;
// The latest collision.
var<private> material: u32;
var<private> is_compton: bool;
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

// Sends what a photon that is scattered onto a point of the image brings there on average, against a direction drawn evenly over the image.
fn send(direction: vec3<f32>, cosine: f32, length_mm: f32, pixel: u32) {
    carried = 0.0;
    // A photon on the plane sends nothing to it.
    let towards = dot(direction, job.axis_z.xyz);
    if pixel == NO_PIXEL || !(towards > 0.0) { return; }
    let place = on_plane(photon.ray.position + direction * length_mm);
    var energy_kev = photon.energy_kev;
    var density: f32;
    if is_compton {
        energy_kev *= energy_ratio(photon.energy_kev, 1.0 - cosine);
        if energy_kev < job.share_offset.z { return; }
        density = compton_density(material, photon.energy_kev, cosine);
    } else {
        density = rayleigh_density(material, photon.energy_kev, cosine);
    }
    let even = length_mm * length_mm / (towards * job.axis_z.w);
    carried = passed(place, direction) * photon.weight * response(energy_kev) * density / (density + even);
    aim = pixel;
    tune(energy_kev);
    ray = Ray(photon.ray.position, direction, photon.ray.in_box);
    path_mm = length_mm;
}

fn send_evenly() {
    let share = vec2<f32>(random(), random());
    let cell = min(vec2<u32>(share * vec2<f32>(job.grid_px)), job.grid_px - vec2<u32>(1u));
    let way = in_lps(plane_of(share)) - photon.ray.position;
    let length_mm = length(way);
    let direction = way / length_mm;
    send(direction, clamp(dot(photon.ray.direction, direction), -1.0, 1.0), length_mm, cell.x + job.grid_px.x * cell.y);
}

// Turns the photon at its latest collision, and sends what it would bring where it goes.
fn turn() {
    let before_kev = photon.energy_kev;
    var cosine: f32;
    if is_compton { cosine = compton_cosine(material, before_kev); } else { cosine = rayleigh_cosine(material, before_kev); }
    let direction = turned(photon.ray.direction, cosine, random_direction());
    let length_mm = path_to_plane(photon.ray.position, direction);
    carried = 0.0;
    if job.analogue == 0u && length_mm < FAR_MM {
        send(direction, cosine, length_mm, pixel_of(on_plane(photon.ray.position + direction * length_mm)));
    }
    photon.ray.direction = direction;
    if !is_compton { return; }
    photon.energy_kev = before_kev * energy_ratio(before_kev, 1.0 - cosine);
    absorbed[material] += photon.weight * (before_kev - photon.energy_kev);
    if photon.energy_kev < job.share_offset.z {
        absorbed[material] += photon.weight * photon.energy_kev;
        is_alive = false;
    }
}
