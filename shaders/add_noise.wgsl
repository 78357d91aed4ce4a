// Poisson deviates of each pixel's photon number, keyed by (seed, frame, pixel).
// #include shared/view.wgsl
// #include shared/philox.wgsl

const TILE: u32 = 64u;

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> signal: array<f32>;              // four planes, the second is sum phi T
@group(0) @binding(2) var<storage, read_write> deviates: array<f32>;      // Poisson(N) - N

@compute @workgroup_size(TILE)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let pixel = id.y * groups.x * TILE + id.x;
    if pixel >= view.size_px.x * view.size_px.y { return; }
    let ray = unproject(view, vec2<u32>(pixel % view.size_px.x, pixel / view.size_px.x));
    let squared = dot(ray, ray);
    let expected = view.photons_per_pixel * signal[view.size_px.x * view.size_px.y + pixel] / (squared * sqrt(squared));
    open_stream(view.seed, view.frame, pixel, PURPOSE_QUANTUM_NOISE);
    deviates[pixel] = deviate(expected);
}

// Poisson(expected) - expected.
fn deviate(expected: f32) -> f32 {
    if !(expected > 0.0) { return 0.0; }
    if expected < 10.0 { return by_inversion(expected) - expected; }
    if expected < 1000.0 { return by_transformed_rejection(expected) - expected; }
    let z = normal();
    let change = sqrt(expected) * z + (z * z - 1.0) / 6.0;
    // f32 holds whole numbers up to 2^24; above, rounding to one would only add error.
    if expected > 8388608.0 { return max(change, -expected); }
    return max(round(expected + change), 0.0) - expected;
}

// The uniform is read as P(X >= k); 1 - exp(-x) by its series where the difference would cancel.
fn by_inversion(expected: f32) -> f32 {
    let survival = uniform_open();
    var tail = 1.0 - exp(-expected);
    if expected < 0.1 {
        tail = expected * (1.0 - expected * (0.5 - expected * (1.0 / 6.0 - expected * (1.0 / 24.0 - expected / 120.0))));
    }
    var probability = exp(-expected);
    var k = 0.0;
    while survival < tail && k < 100.0 {
        k += 1.0;
        probability *= expected / k;
        tail -= probability;
    }
    return k;
}

// PTRS (Hoermann 1993), acceptance in deviance form.
fn by_transformed_rejection(expected: f32) -> f32 {
    let b = 0.931 + 2.53 * sqrt(expected);
    let a = -0.059 + 0.02483 * b;
    let inverse_alpha = 1.1239 + 1.1328 / (b - 3.4);
    let v_r = 0.9277 - 3.6224 / (b - 2.0);
    for (var round = 0u; round < 64u; round += 1u) {
        let u = uniform_open() - 0.5;
        let v = uniform_open();
        let us = 0.5 - abs(u);
        let k = floor((2.0 * a / us + b) * u + expected + 0.43);
        if us >= 0.07 && v <= v_r { return k; }
        if k < 0.0 || (us < 0.013 && v > us) { continue; }
        if log(v * inverse_alpha / (a / (us * us) + b)) <= log_probability(k, expected) { return k; }
    }
    return floor(expected + 0.5);
}

fn log_probability(k: f32, expected: f32) -> f32 {
    if k < 0.5 { return -expected; }
    let x = (k - expected) / expected;
    // (1 + x) ln(1 + x) - x, by its series where the difference would cancel.
    var half_square = (1.0 + x) * log(1.0 + x) - x;
    if abs(x) < 0.1 {
        half_square = x * x * (1.0 / 2.0 - x * (1.0 / 6.0 - x * (1.0 / 12.0 - x * (1.0 / 20.0 - x * (1.0 / 30.0 - x / 42.0)))));
    }
    let inverse = 1.0 / (k * k);
    let stirling = (1.0 / 12.0 - (1.0 / 360.0 - (1.0 / 1260.0 - inverse / 1680.0) * inverse) * inverse) / k;
    return -expected * half_square - 0.5 * log(6.283185307179586 * k) - stirling;
}
