// Polychromatic Beer-Lambert per pixel (Eq. 6), shifted by the smallest depth so that no sum under- or overflows.
// #include shared/view.wgsl

const TILE: u32 = 64u;

struct Bin {
    signal: f32,             // phi r / sum phi r
    photons: f32,            // phi
    squares: f32,            // phi r^2
    padding: f32,
}

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> bins: array<Bin>;
@group(0) @binding(2) var<storage, read> cm2_per_g: array<f32>;           // by material, then bin
@group(0) @binding(3) var<storage, read> density_g_per_cm2: array<f32>;   // by pixel, then material
// All -ln intensity; then, where moments are wanted, all sum phi T, all mean r, all mean r^2.
@group(0) @binding(4) var<storage, read_write> signal: array<f32>;

@compute @workgroup_size(TILE)
fn main(@builtin(global_invocation_id) id: vec3<u32>, @builtin(num_workgroups) groups: vec3<u32>) {
    let pixel = id.y * groups.x * TILE + id.x;
    if pixel >= view.size_px.x * view.size_px.y { return; }
    var any_matter = false;
    for (var m = 0u; m < view.material_count; m += 1u) {
        // By bits: a comparison may call NaN equal to nothing.
        any_matter = any_matter || bitcast<u32>(density_g_per_cm2[pixel * view.material_count + m]) != 0u;
    }
    if !any_matter {
        give(pixel, vec4<f32>(0.0, 1.0, view.mean_response, view.mean_square_response));
        return;
    }
    var smallest = 1e30;
    var total = 0.0;
    for (var b = 0u; b < view.bin_count; b += 1u) {
        let depth = optical_depth(pixel, b);
        smallest = min(smallest, depth);
        total += depth;
    }
    // min, max and a driver's exp may turn NaN into a number; what is not finite (its exponent has every bit) stays so,
    // to be seen and counted.
    if (bitcast<u32>(total) & 0x7f800000u) == 0x7f800000u {
        give(pixel, vec4<f32>(total));
        return;
    }
    if view.moments == 0u {
        var one = 0.0;
        for (var b = 0u; b < view.bin_count; b += 1u) {
            one += bins[b].signal * exp(max(smallest - optical_depth(pixel, b), -87.0));
        }
        signal[pixel] = smallest - log(one);
        return;
    }
    var sum = vec3<f32>(0.0);
    for (var b = 0u; b < view.bin_count; b += 1u) {
        let bin = bins[b];
        sum += vec3<f32>(bin.signal, bin.photons, bin.squares) * exp(max(smallest - optical_depth(pixel, b), -87.0));
    }
    give(pixel, vec4<f32>(smallest - log(sum.x), sum.y * exp(-smallest), sum.x * view.mean_response / sum.y, sum.z / sum.y));
}

fn give(pixel: u32, found: vec4<f32>) {
    signal[pixel] = found.x;
    if view.moments == 0u { return; }
    let pixels = view.size_px.x * view.size_px.y;
    signal[pixels + pixel] = found.y;
    signal[2u * pixels + pixel] = found.z;
    signal[3u * pixels + pixel] = found.w;
}

fn optical_depth(pixel: u32, bin: u32) -> f32 {
    var depth = 0.0;
    for (var m = 0u; m < view.material_count; m += 1u) {
        depth += cm2_per_g[m * view.bin_count + bin] * density_g_per_cm2[pixel * view.material_count + m];
    }
    return depth;
}
