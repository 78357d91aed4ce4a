//! The shaders, embedded; `// #include shared/x.wgsl` is replaced by that file.

const FILES: [(&str, &str); 19] = [
    ("integrate_density", include_str!("../../shaders/integrate_density.wgsl")),
    ("attenuate_spectrum", include_str!("../../shaders/attenuate_spectrum.wgsl")),
    ("add_noise", include_str!("../../shaders/add_noise.wgsl")),
    ("follow_photons", include_str!("../../shaders/follow_photons.wgsl")),
    ("shared/view.wgsl", include_str!("../../shaders/shared/view.wgsl")),
    ("shared/chords.wgsl", include_str!("../../shaders/shared/chords.wgsl")),
    ("shared/solid.wgsl", include_str!("../../shaders/shared/solid.wgsl")),
    ("shared/intervals.wgsl", include_str!("../../shaders/shared/intervals.wgsl")),
    ("shared/mesh.wgsl", include_str!("../../shaders/shared/mesh.wgsl")),
    ("shared/claim.wgsl", include_str!("../../shaders/shared/claim.wgsl")),
    ("shared/grid.wgsl", include_str!("../../shaders/shared/grid.wgsl")),
    ("shared/philox.wgsl", include_str!("../../shaders/shared/philox.wgsl")),
    ("transport/beam.wgsl", include_str!("../../shaders/transport/beam.wgsl")),
    ("transport/data.wgsl", include_str!("../../shaders/transport/data.wgsl")),
    ("transport/random.wgsl", include_str!("../../shaders/transport/random.wgsl")),
    ("transport/physics.wgsl", include_str!("../../shaders/transport/physics.wgsl")),
    ("transport/matter.wgsl", include_str!("../../shaders/transport/matter.wgsl")),
    ("transport/flight.wgsl", include_str!("../../shaders/transport/flight.wgsl")),
    ("transport/photon.wgsl", include_str!("../../shaders/transport/photon.wgsl")),
];

/// Stems of the shaders that are dispatched.
pub const STEMS: [&str; 4] = ["integrate_density", "attenuate_spectrum", "add_noise", "follow_photons"];

/// The text of shader `stem` with its includes; `None` when there is no such shader or include.
#[must_use]
pub fn source(stem: &str) -> Option<String> {
    let file = |name: &str| FILES.iter().find(|(known, _)| *known == name).map(|(_, text)| *text);
    let mut text = String::new();
    for line in file(stem)?.lines() {
        match line.strip_prefix("// #include ") {
            Some(name) => text.push_str(file(name.trim())?),
            None => text.push_str(line),
        }
        text.push('\n');
    }
    Some(text)
}
