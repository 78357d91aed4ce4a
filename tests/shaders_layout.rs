//! Shaders are valid, and their structs are those of the hosts' `layout`; through naga, no GPU needed.

use std::mem::{offset_of, size_of};

use sidecarm::gpu::{STEMS, source};
use sidecarm::render::wgsl::layout::{Bin, Flags, Grid, Node, Solid, View};

/// The one shader that makes no image.
const PHOTONS: &str = "follow_photons";

/// Storage buffers of a stage that every device has, by the standard of WebGPU.
const STORAGE_BUFFERS: usize = 8;

fn parse(stem: &str) -> naga::Module {
    let text = source(stem).expect("embedded");
    naga::front::wgsl::parse_str(&text).unwrap_or_else(|error| panic!("{stem}: {}", error.emit_to_string(&text)))
}

#[test]
fn every_shader_is_valid() {
    let mut checked = 0;
    for stem in STEMS {
        let module = parse(stem);
        let mut validator = naga::valid::Validator::new(naga::valid::ValidationFlags::all(), naga::valid::Capabilities::empty());
        validator.validate(&module).unwrap_or_else(|error| panic!("{stem}: {error:?}"));
        assert!(module.entry_points.iter().any(|entry| entry.name == "main"));
        let is_storage = |space: &naga::AddressSpace| matches!(space, naga::AddressSpace::Storage { .. });
        let storage = module.global_variables.iter().filter(|(_, variable)| is_storage(&variable.space)).count();
        assert!(storage <= STORAGE_BUFFERS, "{stem}: {storage} storage buffers");
        checked += 1;
    }
    assert_eq!(checked, 4);
    assert!(source("no_such_shader").is_none());
}

#[test]
fn every_shader_has_a_twin_and_does_not_grow() {
    let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR"));
    for stem in STEMS {
        let twin = if stem == PHOTONS { "src/transport/history.rs".to_owned() } else { format!("src/render/cpu/{stem}.rs") };
        assert!(root.join(twin).is_file(), "{stem} has no twin");
        let lines = std::fs::read_to_string(root.join(format!("shaders/{stem}.wgsl"))).expect("shader").lines().count();
        assert!(lines <= 220, "{stem}: {lines} lines");
    }
}

/// Name and offset of the members of a struct, and its size.
fn members(stem: &str, name: &str) -> (Vec<(String, u32)>, u32) {
    let module = parse(stem);
    let (_, found) = module.types.iter().find(|(_, ty)| ty.name.as_deref() == Some(name)).expect("struct exists");
    let naga::TypeInner::Struct { members, span } = &found.inner else { panic!("{name} is no struct") };
    (members.iter().map(|member| (member.name.clone().expect("named"), member.offset)).collect(), *span)
}

macro_rules! offsets {
    ($ty:ty, $($field:ident),+ $(,)?) => {
        (vec![$((stringify!($field).to_owned(), offset_of!($ty, $field) as u32)),+], size_of::<$ty>() as u32)
    };
}

#[test]
fn structs_have_the_layout_the_shaders_read() {
    let view = offsets!(
        View,
        size_px,
        material_count,
        bin_count,
        focal_px,
        principal_px,
        skew_px,
        depth_ref_mm,
        source_tau_mm,
        detector_tau_mm,
        later_count,
        solid_count,
        has_volume,
        frame,
        seed,
        photons_per_pixel,
        mean_response,
        mean_square_response,
        moments,
        padding,
        fitted_up_to,
    );
    for stem in STEMS.into_iter().filter(|stem| *stem != PHOTONS) {
        assert_eq!(members(stem, "View"), view, "{stem}");
    }
    let solid = offsets!(Solid, row_x, row_y, row_z, centre, size, bounds, kind, material, density_g_per_cm3, root);
    assert_eq!(members("integrate_density", "Solid"), solid);
    assert_eq!(members("integrate_density", "Node"), offsets!(Node, lo, first, hi, count));
    let flags = offsets!(Flags, overflows, matter, beyond);
    assert_eq!(members("integrate_density", "Flags"), flags);
    let grid = offsets!(
        Grid,
        row_x,
        row_y,
        row_z,
        centre,
        size,
        padding,
        occupied_from,
        occupied_to,
        cells_from,
        cells_to,
        voxels_from,
        adds
    );
    assert_eq!(members("integrate_density", "Grid"), grid);
    assert_eq!(members("attenuate_spectrum", "Bin"), offsets!(Bin, signal, photons, squares, padding));
    // The control: another struct does not pass for this one.
    assert_ne!(members("integrate_density", "Solid"), grid);
}

#[test]
fn what_photons_are_followed_in_has_the_layout_the_shader_reads() {
    use sidecarm::transport::wgsl::layout::{CellBox, Job, Thing};
    let job = offsets!(
        Job,
        source,
        axis_x,
        axis_y,
        axis_z,
        bounds_low,
        bounds_high,
        share_from_plane,
        share_offset,
        field,
        field_shape,
        field_turn,
        heel,
        grid_px,
        cells,
        field_kind,
        corners,
        materials,
        bins,
        seed,
        first,
        each,
        groups_per_batch,
        analogue,
        has_space,
        attenuation,
        incoherent,
        envelope,
        compton_norm,
        squares,
        below,
        rayleigh_norm,
        response,
        spectrum,
        heel_table,
        polygon,
        bowtie,
        planes,
        envelope_other,
        guides,
        box_of_cell,
        first_group,
        buckets,
        mesh_corners,
    );
    assert_eq!(members(PHOTONS, "Job"), job);
    let cell_box =
        offsets!(CellBox, low, content, high, amount, x_below, x_above, y_below, y_above, z_below, z_above, low_cell, high_cell);
    assert_eq!(members(PHOTONS, "CellBox"), cell_box);
    let thing = offsets!(
        Thing,
        row_x,
        row_y,
        row_z,
        shape,
        kind,
        material,
        density_g_per_cm3,
        is_air,
        size,
        first_voxel,
        own,
        classes,
        is_piecewise,
        root,
    );
    assert_eq!(members(PHOTONS, "Thing"), thing);
    // The tree of a mesh is the renderer's.
    assert_eq!(members(PHOTONS, "Node"), offsets!(Node, lo, first, hi, count));
}
