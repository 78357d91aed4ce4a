//! The reference behind slabs, against double-precision sums over the tables; a refined volume against itself; one pass over the rays.

use std::path::Path;

use glam::{DAffine3, DMat3, DVec2, DVec3};
use sidecarm::geometry::View;
use sidecarm::render::Quantity;
use sidecarm::render::reference::{self, Reference, trace};
use sidecarm::reporter::Reporter;
use sidecarm::scene::model::{Matter, Volume};
use sidecarm::scene::{self, Scene};

use super::scene_support::{Dice, ball, random_volume, scene as made, view, volume};

/// Material, thickness in mm, density in g/cm³.
const SLABS: [(&str, f64, f64); 3] = [("water", 200.0, 1.0), ("bone_cortical", 50.0, 1.92), ("steel_316l", 5.0, 8.0)];

fn subsets() -> impl Iterator<Item = Vec<(&'static str, f64, f64)>> {
    (1..8usize).map(|bits| (0..3).filter(|slab| bits >> slab & 1 == 1).map(|slab| SLABS[slab]).collect())
}

/// A scene file with the slabs one behind the other as boxes of 2 m.
fn box_scene(slabs: &[(&str, f64, f64)]) -> Scene {
    let mut z = -100.0;
    let mut objects = Vec::new();
    for (material, thickness, density) in slabs {
        objects
            .push(serde_json::json!({"box": {"centre_lps_mm": [0, 0, z + 0.5 * thickness], "size_mm": [2000, 2000, thickness],
            "material": material, "density_g_per_cm3": density}}));
        z += thickness;
    }
    let text = serde_json::json!({"objects": objects,
        "view": {"size_px": [7, 5], "intrinsics": [[100, 0, 3], [0, 100, 2], [0, 0, 1]],
                 "camera_from_lps": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 600], [0, 0, 0, 1]]},
        "beam": {"tube_kvp": 120, "anode_angle_deg": 12, "filtration_mm": {"aluminium": 4.3}},
        "detector": {"response": "energy", "pitch_mm": 10}})
    .to_string();
    scene::load_text(&text, Path::new("SCENE.json"), true, &Reporter::silent()).expect("loads")
}

/// One volume of 1 mm slices that holds the slabs, with empty slices around.
fn layered(slabs: &[(&str, f64, f64)]) -> Volume {
    let mut slices = vec![(0u8, 0.0f32); 3];
    for (class, (_, thickness, density)) in slabs.iter().enumerate() {
        slices.extend(vec![(class as u8 + 1, *density as f32); *thickness as usize]);
    }
    slices.extend([(0, 0.0); 4]);
    let size = [2, 2, slices.len()];
    let spacing = DVec3::new(1000.0, 1000.0, 1.0);
    Volume {
        size,
        lps_from_voxel: DAffine3 { matrix3: DMat3::from_diagonal(spacing), translation: DVec3::new(-500.0, -500.0, -110.0) },
        density_g_per_cm3: slices.iter().flat_map(|(_, density)| [*density; 4]).collect(),
        class: slices.iter().flat_map(|(class, _)| [*class; 4]).collect(),
        class_materials: (0..slabs.len()).collect(),
        truncated_at_faces: true,
        unknown: Vec::new(),
    }
}

/// −ln(Σ φ E exp(−Σ μ/ρ ρ t / cos) / Σ φ E), straight from the tables.
fn by_hand(scene: &Scene, view: &View, slabs: &[(&str, f64, f64)], pixel: [f64; 2]) -> f64 {
    let per_depth = view.intrinsics.unproject(DVec2::new(pixel[0], pixel[1])).length();
    let (mut signal, mut air) = (0.0, 0.0);
    for bin in scene.beam.spectrum.bins.iter().filter(|bin| bin.fluence > 0.0) {
        let mut depth = 0.0;
        for (material, (_, thickness, density)) in slabs.iter().enumerate() {
            let cm2_per_g = scene.materials[material].attenuation(bin.energy_kev).expect("tabulated").total_cm2_per_g;
            depth += cm2_per_g * density * 0.1 * thickness * per_depth;
        }
        signal += bin.fluence * bin.energy_kev * (-depth).exp();
        air += bin.fluence * bin.energy_kev;
    }
    -(signal / air).ln()
}

#[test]
fn slabs_and_their_combinations_are_sums_over_the_tables() {
    let (mut cases, mut worst, mut deepest) = (0, 0.0f64, 0.0f64);
    for slabs in subsets() {
        let boxes = box_scene(&slabs);
        let view = boxes.view.expect("has one");
        let mut ct = boxes.clone();
        ct.objects.truncate(1);
        ct.objects[0].matter = volume(layered(&slabs));
        // The same densities, as a volume holds them.
        let rounded: Vec<_> = slabs.iter().map(|(name, mm, density)| (*name, *mm, f64::from(*density as f32))).collect();
        for (scene, slabs) in [(&boxes, &slabs), (&ct, &rounded)] {
            let image = reference::render(scene, &view, Quantity::LineIntegral).expect("good").remove(0);
            for (index, found) in image.pixels.iter().enumerate() {
                let expected = by_hand(scene, &view, slabs, [(index % 7) as f64, (index / 7) as f64]);
                worst = worst.max((found / expected - 1.0).abs());
                deepest = deepest.max(expected);
                let control = by_hand(scene, &view, &[(slabs[0].0, slabs[0].1 * 1.0001, slabs[0].2)], [3.0, 2.0]);
                assert!(slabs.len() > 1 || index != 17 || (found / control - 1.0).abs() > 1e-5, "the control");
                cases += 1;
            }
        }
    }
    println!("{cases} pixels behind slabs, up to {deepest:.1} nepers: worst relative error {worst:.1e}");
    assert_eq!(cases, 7 * 2 * 35);
    assert!(deepest > 8.0 && worst < 1e-12, "{worst:e}");
}

/// `volume` with voxels between the voxels, interpolated where `smooth`, else repeated; class 1 everywhere that has density.
fn refined(volume: &Volume, smooth: bool) -> Volume {
    let size = volume.size.map(|n| 2 * n - 1);
    let density_g_per_cm3: Vec<f32> = (0..size.iter().product())
        .map(|index: usize| {
            let at = [index % size[0], index / size[0] % size[1], index / (size[0] * size[1])];
            let corner = |bits: usize| {
                let [i, j, k] =
                    std::array::from_fn(|axis| if smooth { (at[axis] + (bits >> axis & 1)) / 2 } else { at[axis] / 2 });
                volume.density_g_per_cm3[volume.index(i, j, k)]
            };
            (0..8).map(corner).sum::<f32>() / 8.0
        })
        .collect();
    let affine = volume.lps_from_voxel;
    Volume {
        size,
        lps_from_voxel: DAffine3 { matrix3: affine.matrix3 * 0.5, translation: affine.translation },
        class: density_g_per_cm3.iter().map(|density| u8::from(*density > 0.0)).collect(),
        density_g_per_cm3,
        ..volume.clone()
    }
}

#[test]
fn a_volume_refined_by_its_own_interpolation_is_the_same_field() {
    let mut dice = Dice::new(31);
    let size = [6, 5, 7];
    let (mut rays, mut differ, mut worst) = (0, 0, 0.0f64);
    for _ in 0..40 {
        let turn = DMat3::from_quat(dice.rotation()) * DMat3::from_diagonal(DVec3::new(1.5, -2.0, 1.0));
        let middle = DVec3::from_array(size.map(|n| 0.5 * (n as f64 - 1.0)));
        let mut coarse = random_volume(&mut dice, size, DAffine3 { matrix3: turn, translation: -(turn * middle) });
        // A border of nothing: there the outer half voxel, whose width changes, holds nothing. 64ths, so that f32 has every mean.
        for index in 0..coarse.class.len() {
            let at = [index % size[0], index / size[0] % size[1], index / (size[0] * size[1])];
            let inside = (0..3).all(|axis| at[axis] > 0 && at[axis] + 1 < size[axis]);
            coarse.class[index] = u8::from(inside && dice.unit() < 0.8);
            coarse.density_g_per_cm3[index] = f32::from(coarse.class[index]) * (1.0 + (dice.unit() * 64.0).floor() as f32) / 64.0;
        }
        let areas = |volume_: Volume, pixel: [f64; 2]| {
            let scene = made(&["water", "bone_cortical"], vec![volume(volume_)]);
            Reference::new(&scene, &view(600.0)).expect("good").area_densities(pixel)[0]
        };
        let pixel = [31.5 + dice.between(-20.0, 20.0), 23.5 + dice.between(-20.0, 20.0)];
        let (once, twice) = (areas(coarse.clone(), pixel), areas(refined(&coarse, true), pixel));
        worst = worst.max((once - twice).abs());
        rays += usize::from(once > 0.0);
        differ += usize::from((once - areas(refined(&coarse, false), pixel)).abs() > 1e-3);
    }
    assert!(rays > 25, "{rays}");
    assert!(worst < 1e-13, "{worst:e} g/cm2");
    assert!(differ > 20, "the control: repeated voxels are another field on {differ} rays");
}

#[test]
fn one_pass_gives_what_the_parts_give_on_any_number_of_cores() {
    let mut dice = Dice::new(32);
    let mut made_volume = random_volume(&mut dice, [9, 8, 7], DAffine3::from_translation(DVec3::new(-6.0, -3.5, -3.0)));
    made_volume.truncated_at_faces = true;
    // Cut at the far face only, and there on one side.
    for index in 0..made_volume.class.len() {
        let [i, j, k] = [index % 9, index / 9 % 8, index / 72];
        if k == 0 || j == 0 || j == 7 || i == 0 || i == 8 || (k == 6 && i >= 4) {
            (made_volume.class[index], made_volume.density_g_per_cm3[index]) = (0, 0.0);
        }
    }
    let scene = made(
        &["water", "bone_cortical", "steel_316l"],
        vec![volume(made_volume), Matter::Solids(vec![ball(DVec3::new(1.0, 0.0, 0.0), 2.0, 2)])],
    );
    let view = view(600.0);
    let on = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("pool");
        pool.install(|| trace(&scene, &view, true)).expect("good")
    };
    let all = on(3);
    let areas = reference::render(&scene, &view, Quantity::AreaDensity).expect("good");
    let line = reference::render(&scene, &view, Quantity::LineIntegral).expect("good");
    let valid = reference::valid(&scene, &view).expect("good");
    for (material, page) in areas.iter().enumerate() {
        assert!(all.g_per_cm2.iter().skip(material).step_by(3).eq(&page.pixels));
    }
    assert_eq!((&all.line_integral, &all.valid), (&line[0].pixels, &valid.pixels));
    assert!(all.valid.contains(&0) && all.valid.contains(&1));
    let alone = on(1);
    assert_eq!((alone.g_per_cm2, alone.line_integral), (all.g_per_cm2, all.line_integral));
    assert!(trace(&scene, &view, false).expect("good").line_integral.is_empty());
}
