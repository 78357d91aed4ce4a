// Philox 4x32-10 keyed by (seed, frame, pixel, purpose); twin of src/random.rs.

const PURPOSE_QUANTUM_NOISE: u32 = 1u;

var<private> stream_key: vec2<u32>;
var<private> stream_counter: vec4<u32>;
var<private> stream_block: vec4<u32>;
var<private> stream_used: u32;

fn multiply_high(a: u32, b: u32) -> u32 {
    let a0 = a & 0xffffu;
    let a1 = a >> 16u;
    let b0 = b & 0xffffu;
    let b1 = b >> 16u;
    let low = a0 * b0;
    let cross = a1 * b0 + (low >> 16u);
    let other = a0 * b1 + (cross & 0xffffu);
    return a1 * b1 + (cross >> 16u) + (other >> 16u);
}

fn philox(start: vec4<u32>, start_key: vec2<u32>) -> vec4<u32> {
    var counter = start;
    var key = start_key;
    for (var i = 0u; i < 10u; i += 1u) {
        counter = vec4<u32>(
            multiply_high(counter.z, 0xCD9E8D57u) ^ counter.y ^ key.x,
            counter.z * 0xCD9E8D57u,
            multiply_high(counter.x, 0xD2511F53u) ^ counter.w ^ key.y,
            counter.x * 0xD2511F53u,
        );
        key += vec2<u32>(0x9E3779B9u, 0xBB67AE85u);
    }
    return counter;
}

fn open_stream(seed: vec2<u32>, frame: u32, pixel: u32, purpose: u32) {
    stream_key = seed;
    stream_counter = vec4<u32>(0u, pixel, frame, purpose);
    stream_used = 4u;
}

fn next_u32() -> u32 {
    if stream_used == 4u {
        stream_block = philox(stream_counter, stream_key);
        stream_counter.x += 1u;
        stream_used = 0u;
    }
    stream_used += 1u;
    return stream_block[stream_used - 1u];
}

// (n + 1/2) 2^-32, rounded to 24 bits and kept below 1; near 0 all 32 bits stay.
fn uniform_open() -> f32 {
    return min((f32(next_u32()) + 0.5) * 2.3283064365386963e-10, 0.99999994);
}

fn normal() -> f32 {
    let radius = sqrt(-2.0 * log(uniform_open()));
    return radius * cos(6.283185307179586 * uniform_open());
}
