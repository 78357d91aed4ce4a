// Random numbers of one history: twin of src/transport/stream.rs, with 32-bit words (xoshiro128++, Blackman and Vigna 2019) keyed by Philox.

const PURPOSE_TRANSPORT: u32 = 3u;

var<private> state: vec4<u32>;

fn open_history(history: vec2<u32>) {
    state = philox(vec4<u32>(history.x, history.y, 1u, PURPOSE_TRANSPORT), job.seed);
    // All zeros is the one state that never leaves itself.
    if all(state == vec4<u32>(0u)) { state.x = 1u; }
}

fn rotated(x: u32, by: u32) -> u32 {
    return (x << by) | (x >> (32u - by));
}

fn random_u32() -> u32 {
    let result = rotated(state.x + state.w, 7u) + state.x;
    let t = state.y << 9u;
    state.z ^= state.x;
    state.w ^= state.y;
    state.y ^= state.z;
    state.x ^= state.w;
    state.z ^= t;
    state.w = rotated(state.w, 11u);
    return result;
}

// In the open interval (0, 1): 23 bits and a half, which f32 holds exactly.
fn random() -> f32 {
    return (f32(random_u32() >> 9u) + 0.5) * 1.1920928955078125e-7;
}

// Exponential with mean 1; the second word reaches what 23 bits cut off. A logarithm near 0 may err to the other side of it.
fn exponential() -> f32 {
    return max(-log((f32(random_u32() >> 9u) + random()) * 1.1920928955078125e-7), 0.0);
}

// Cosine and sine of a uniform angle, within the turn for which their errors are bounded.
fn random_direction() -> vec2<f32> {
    let angle = 6.283185307179586 * (random() - 0.5);
    return vec2<f32>(cos(angle), sin(angle));
}
