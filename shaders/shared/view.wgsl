// What every pass knows. Depth is mm along camera z; tau = depth - depth_ref, so that f32 holds positions to 1e-5 mm.

struct View {
    size_px: vec2<u32>,
    material_count: u32,
    bin_count: u32,          // padded
    focal_px: vec2<f32>,
    principal_px: vec2<f32>,
    skew_px: f32,
    depth_ref_mm: f32,
    source_tau_mm: f32,      // tau of the focal spot: -depth_ref
    detector_tau_mm: f32,
    later_count: u32,        // solids that displace the volume
    solid_count: u32,        // all solids; the rest is displaced by the volume
    has_volume: u32,
    frame: u32,
    seed: vec2<u32>,
    photons_per_pixel: f32,
    mean_response: f32,
    mean_square_response: f32,
    moments: u32,            // whether noise needs more than line integrals
    padding: vec2<u32>,
    fitted_up_to: array<vec4<f32>, 2>, // g/cm2 by material up to which the energies hold
}

// Direction through a pixel with unit depth; the first pixel's centre is at (0, 0), as everywhere.
fn unproject(view: View, pixel: vec2<u32>) -> vec3<f32> {
    let offset = vec2<f32>(pixel) - view.principal_px;
    let y = offset.y / view.focal_px.y;
    return vec3<f32>((offset.x - view.skew_px * y) / view.focal_px.x, y, 1.0);
}
