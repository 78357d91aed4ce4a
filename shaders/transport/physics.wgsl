// What happens at a collision: twins of src/transport/attenuation.rs, compton.rs, rayleigh.rs, on their tables.

// The host's own constants.
override ELECTRON_KEV: f32;
override KEV_ANGSTROM: f32;
override ROWS_PER_KEV: f32;
override RESPONSE_PER_KEV: f32;
override COMPTON_NORMS_PER_KEV: f32;
override RAYLEIGH_NORMS_PER_KEV: f32;
override INCOHERENT_PER_UNIT_X: f32;
override SQUARES_PER_UNIT_X: f32;
override ENVELOPE_KEV: f32;
override COSINES: u32;
override GUIDES: u32;

// Linear between rows of a table that begins at `from`.
fn between_rows(from_row: u32, rows: u32, position: f32) -> f32 {
    let row = min(u32(max(position, 0.0)), rows - 2u);
    let low = numbers[from_row + row];
    return low + (numbers[from_row + row + 1u] - low) * (max(position, 0.0) - f32(row));
}

fn per_mm_at_unit_density(material: u32, energy_kev: f32) -> f32 {
    let rows = job.attenuation.y;
    return between_rows(job.attenuation.x + 3u * material * rows, rows, (energy_kev - job.share_offset.z) * ROWS_PER_KEV);
}

// Of photoelectric absorption; of that or Compton scattering.
fn shares(material: u32, energy_kev: f32) -> vec2<f32> {
    let rows = job.attenuation.y;
    let position = (energy_kev - job.share_offset.z) * ROWS_PER_KEV;
    let base = job.attenuation.x + 3u * material * rows;
    return vec2<f32>(between_rows(base + rows, rows, position), between_rows(base + 2u * rows, rows, position));
}

fn response(energy_kev: f32) -> f32 {
    return between_rows(job.response.x, job.response.y, (energy_kev - job.share_offset.z) * RESPONSE_PER_KEV);
}

fn energy_ratio(energy_kev: f32, one_less_cosine: f32) -> f32 {
    return 1.0 / (1.0 + energy_kev / ELECTRON_KEV * one_less_cosine);
}

fn transfer(energy_kev: f32, one_less_cosine: f32) -> f32 {
    return energy_kev / KEV_ANGSTROM * sqrt(max(0.5 * one_less_cosine, 0.0));
}

fn compton_shape(material: u32, energy_kev: f32, cosine: f32) -> f32 {
    let ratio = energy_ratio(energy_kev, 1.0 - cosine);
    let rows = job.incoherent.y;
    let bound = between_rows(job.incoherent.x + material * rows, rows, transfer(energy_kev, 1.0 - cosine) * INCOHERENT_PER_UNIT_X);
    return ratio * (ratio * ratio + 1.0 + (cosine * cosine - 1.0) * ratio) * bound;
}

fn compton_density(material: u32, energy_kev: f32, cosine: f32) -> f32 {
    let rows = job.compton_norm.y;
    let norm = between_rows(job.compton_norm.x + material * rows, rows, (energy_kev - job.share_offset.z) * COMPTON_NORMS_PER_KEV);
    return compton_shape(material, energy_kev, cosine) / norm;
}

fn compton_cosine(material: u32, energy_kev: f32) -> f32 {
    let rows = job.envelope.y;
    let row = min(u32(max((energy_kev - job.share_offset.z) / ENVELOPE_KEV, 0.0)), rows - 1u);
    let entry = (material * rows + row) * COSINES;
    for (var tries = 0u; tries < 4096u; tries += 1u) {
        let position = random() * f32(COSINES);
        var slot = min(u32(position), COSINES - 1u);
        let slot_entry = job.envelope.x + 2u * (entry + slot);
        if position - f32(slot) > numbers[slot_entry + 1u] { slot = indices[job.envelope_other + entry + slot]; }
        let cosine = -1.0 + (f32(slot) + random()) * (2.0 / f32(COSINES));
        if random() * numbers[job.envelope.x + 2u * (entry + slot)] < compton_shape(material, energy_kev, cosine) { return cosine; }
    }
    give_up(NO_ANGLE);
    return 1.0;
}

fn rayleigh_density(material: u32, energy_kev: f32, cosine: f32) -> f32 {
    let steps = job.squares.y;
    let step = min(u32(transfer(energy_kev, 1.0 - cosine) * SQUARES_PER_UNIT_X), steps - 1u);
    let rows = job.rayleigh_norm.y;
    let norm = between_rows(job.rayleigh_norm.x + material * rows, rows, (energy_kev - job.share_offset.z) * RAYLEIGH_NORMS_PER_KEV);
    return 0.5 * (1.0 + cosine * cosine) * numbers[job.squares.x + material * steps + step] / norm;
}

fn rayleigh_cosine(material: u32, energy_kev: f32) -> f32 {
    let longest = energy_kev / KEV_ANGSTROM;
    let end = longest * longest;
    let steps = job.squares.y;
    let squares = job.squares.x + material * steps;
    let below = job.below.x + material * job.below.y;
    let last = min(u32(longest * SQUARES_PER_UNIT_X), steps - 1u);
    let most = numbers[below + last] + numbers[squares + last] * max(end - edge_of(last), 0.0);
    let per_guide = f32(GUIDES) / numbers[below + steps];
    for (var tries = 0u; tries < 4096u; tries += 1u) {
        let wanted = random() * most;
        var step = min(indices[job.guides.x + material * GUIDES + min(u32(wanted * per_guide), GUIDES - 1u)], last);
        while step < last && numbers[below + step + 1u] <= wanted { step += 1u; }
        let within = max(wanted - numbers[below + step], 0.0) / numbers[squares + step];
        let squared = min(edge_of(step) + within, end);
        let cosine = clamp(1.0 - 2.0 * squared / end, -1.0, 1.0);
        if 2.0 * random() < 1.0 + cosine * cosine { return cosine; }
    }
    give_up(NO_ANGLE);
    return 1.0;
}

fn edge_of(step: u32) -> f32 {
    let x = f32(step) / SQUARES_PER_UNIT_X;
    return x * x;
}
