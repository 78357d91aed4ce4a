// Photons from the focal spot to their end, and what they add to the detector: twin of src/transport/history.rs, source.rs and panel.rs.
// Sums are whole numbers of 1/64 keV (or photons), rounded at random: they do not depend on the order in which they are added.

// #include shared/philox.wgsl
// #include shared/chords.wgsl
// #include shared/mesh.wgsl
// #include transport/data.wgsl
// #include transport/random.wgsl
// #include transport/beam.wgsl
// #include transport/physics.wgsl
// #include transport/matter.wgsl
// #include transport/flight.wgsl
// #include transport/photon.wgsl

const MOST_COLLISIONS: u32 = 100000u;
const FLIGHT: u32 = 2u;           // the last leg of a turn

// Draws a photon and leaves it where it enters the scene; one that misses it is detected.
fn begin() {
    var place: vec2<f32>;
    var tries = 0u;
    for (; tries < 1000000u; tries += 1u) {
        place = job.field.xy + (job.field.zw - job.field.xy) * vec2<f32>(random(), random());
        if is_open(place) && random() < obliquity(place) { break; }
    }
    carried = 0.0;
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
    carried = weight * response(energy_kev);
    aim = pixel_of(place);
    ray = Ray(start, way / whole_mm, 0u);
    var gone_mm = -1.0;
    if job.has_space != 0u { gone_mm = enter(); }
    if !(gone_mm >= 0.0 && gone_mm < whole_mm) {
        if aim != NO_PIXEL { detect(PRIMARY, aim, carried); }
        carried = 0.0;
        fates[DETECTED] += weight * energy_kev;
        return;
    }
    photon = Photon(ray, energy_kev, weight, PRIMARY);
    collisions = 0u;
    tune(energy_kev);
    path_mm = whole_mm - gone_mm;
    if job.analogue != 0u || aim == NO_PIXEL { carried = 0.0; }
    is_alive = true;
}

// Sends the photon itself.
fn set_off() {
    tune(photon.energy_kev);
    ray = photon.ray;
    path_mm = path_to_plane(ray.position, ray.direction);
}

// What a flight that ended so leads to.
fn land(end: u32) {
    if end != COLLISION { leave(); is_alive = false; return; }
    photon.ray = ray;
    material = struck;
    collisions += 1u;
    if collisions == MOST_COLLISIONS { give_up(NO_END); return; }
    let of_material = shares(material, photon.energy_kev);
    let chance = random();
    if chance < of_material.x {
        absorbed[material] += photon.weight * photon.energy_kev;
        is_alive = false;
        return;
    }
    is_compton = chance < of_material.y;
    photon.page = select(MULTIPLE, select(RAYLEIGH, COMPTON, is_compton), photon.page == PRIMARY);
}

// A photon that leaves the scene.
fn leave() {
    let ends_on_plane = path_mm < FAR_MM;
    if ends_on_plane && job.analogue != 0u {
        let at = on_plane(photon.ray.position + photon.ray.direction * path_mm);
        let pixel = pixel_of(at);
        if pixel != NO_PIXEL {
            var through = 1.0;
            if photon.page != PRIMARY { through = passed(at, photon.ray.direction); }
            detect(photon.page, pixel, through * photon.weight * response(photon.energy_kev));
        }
    }
    let energy = photon.weight * photon.energy_kev;
    if ends_on_plane { fates[DETECTED] += energy; } else { fates[ESCAPED] += energy; }
}

@compute @workgroup_size(64)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) lane: u32,
) {
    let number = job.first_group + group.x;
    batch = number / job.groups_per_batch;
    let offset = (number * 64u + lane) * job.each;
    var n = 0u;
    // Every turn takes a photon from one collision to the next, whosever history it is: those beside it do not wait for the longest one.
    loop {
        let is_new = !is_alive;
        if is_new {
            // Told from inside: a driver that ends loops early comes to what follows them all the same.
            if n == job.each { atomicAdd(&trouble[ALL_DONE], 1u); break; }
            let low = job.first.x + offset + n;
            let carry = select(0u, 1u, low < job.first.x);
            n += 1u;
            open_history(vec2<u32>(low, job.first.y + carry));
            begin();
        }
        // Two beams, evenly and where it turns, or the one that was never scattered; then the flight. One place walks them all: a program three
        // times as long is slower.
        for (var leg = job.analogue; leg <= FLIGHT; leg += 1u) {
            if is_new { if leg == 1u { carried = 0.0; } }
            else if leg == 0u { send_evenly(); }
            else if leg == 1u { turn(); }
            let is_flight = leg == FLIGHT;
            if is_flight { if !is_alive || given_up { break; } set_off(); }
            else if carried == 0.0 { continue; }
            let end = walk(is_flight);
            // Not if it is above 0: what is no number is told.
            if is_flight { land(end); } else { detect(photon.page, aim, carried * arrived); }
        }
        if given_up {
            atomicAdd(&trouble[cause], 1u);
            given_up = false;
            is_alive = false;
        }
    }
    let pixels = PAGES * job.grid_px.x * job.grid_px.y;
    for (var material = 0u; material < job.materials; material += 1u) { add(pixels + material, absorbed[material]); }
    for (var fate = 0u; fate < FATES; fate += 1u) { add(pixels + job.materials + fate, fates[fate]); }
    if given_up { atomicAdd(&trouble[cause], 1u); }
}
