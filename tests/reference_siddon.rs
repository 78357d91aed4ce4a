//! Piecewise-constant voxels, the definition of other tools: by name, by the reference only, against a sum over every voxel.

use std::path::Path;

use clap::Parser;
use glam::{DAffine3, DMat3, DVec3};
use sidecarm::cli::render::{RenderArgs, run};
use sidecarm::gpu::DeviceChoice;
use sidecarm::render::plan::Sampling;
use sidecarm::render::reference::Reference;
use sidecarm::render::{Options, Quantity, RenderError, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Matter, Volume, Voxels};

use super::scene_support::{Dice, NiftiFile, ball, random_volume, scene, view, volume};

/// Σ over all voxels of density times the length in that voxel, each by itself, less what lies in `hole` (mm along the ray).
fn every_voxel(volume: &Volume, source: DVec3, unit: DVec3, end_mm: f64, hole: [f64; 2]) -> [f64; 2] {
    let voxel_from_lps = volume.lps_from_voxel.inverse();
    let (o, d) = (voxel_from_lps.transform_point3(source), voxel_from_lps.transform_vector3(unit));
    let mut sums = [0.0; 2];
    for k in 0..volume.size[2] {
        for j in 0..volume.size[1] {
            for i in 0..volume.size[0] {
                let index = volume.index(i, j, k);
                let centre = DVec3::new(i as f64, j as f64, k as f64);
                let (mut from, mut to) = (0.0f64, end_mm);
                for axis in 0..3 {
                    let reach = 0.5 * d[axis].signum();
                    from = from.max((centre[axis] - reach - o[axis]) / d[axis]);
                    to = to.min((centre[axis] + reach - o[axis]) / d[axis]);
                }
                let lost = (to.min(hole[1]) - from.max(hole[0])).max(0.0);
                if from < to && volume.class[index] > 0 {
                    let density = f64::from(volume.density_g_per_cm3[index]);
                    sums[usize::from(volume.class[index]) - 1] += 0.1 * density * (to - from - lost);
                }
            }
        }
    }
    sums
}

#[test]
fn piecewise_constant_voxels_are_a_sum_over_voxels() {
    let mut dice = Dice::new(41);
    let (mut rays, mut differ) = (0, 0);
    for case in 0..200 {
        let size = [[6, 5, 4], [1, 1, 1], [1, 9, 2]][case % 3];
        let mirror = if case % 2 == 0 { 1.0 } else { -1.0 };
        let spacing = DVec3::new(dice.between(0.5, 3.0), dice.between(0.5, 3.0) * mirror, dice.between(0.5, 3.0));
        let matrix3 = DMat3::from_quat(dice.rotation()) * DMat3::from_diagonal(spacing);
        let middle = DVec3::from_array(size.map(|n| 0.5 * (n as f64 - 1.0)));
        // Every fifth source is inside, every seventh detector.
        let z = if case % 5 == 0 {
            -599.0
        } else if case % 7 == 0 {
            399.0
        } else {
            0.0
        };
        let affine = DAffine3 { matrix3, translation: DVec3::new(0.0, 0.0, z) - matrix3 * middle };
        let made = random_volume(&mut dice, size, affine);
        let pixel = [31.5 + dice.between(-15.0, 15.0), 23.5 + dice.between(-15.0, 15.0)];
        let per_depth = DVec3::new((pixel[0] - 31.5) / 5000.0, (pixel[1] - 23.5) / 5000.0, 1.0);
        let (source, unit) = (DVec3::new(0.0, 0.0, -600.0), per_depth.normalize());
        let tool = ball(DVec3::new(0.2, -0.1, z), 1.0, 2);
        let along = (tool.lps_from_local.translation_mm - source).dot(unit);
        let aside = (tool.lps_from_local.translation_mm - source - unit * along).length();
        let half = (1.0 - aside * aside).max(0.0).sqrt();
        let expected = every_voxel(&made, source, unit, 1000.0 * per_depth.length(), [along - half, along + half]);
        let mut scene = scene(&["water", "bone_cortical", "steel_316l"], vec![volume(made), Matter::Solids(vec![tool])]);
        let areas = |scene: &Scene| Reference::new(scene, &view(600.0)).expect("good").area_densities(pixel);
        let trilinear = areas(&scene);
        scene.model.voxels = Voxels::PiecewiseConstant;
        let found = areas(&scene);
        for material in 0..2 {
            assert!((found[material] - expected[material]).abs() < 1e-12, "case {case}: {found:?} {expected:?}");
        }
        rays += usize::from(expected[0] + expected[1] > 0.0);
        differ += usize::from((found[0] - trilinear[0]).abs() > 1e-3);
    }
    assert!(rays > 100, "{rays}");
    assert!(differ > 60, "the control: {differ} rays see the difference from the trilinear field");
}

#[test]
fn a_ray_on_a_face_belongs_to_the_voxel_above() {
    let made = Volume {
        size: [2, 1, 1],
        lps_from_voxel: DAffine3::from_translation(DVec3::new(-0.5, 0.0, 0.0)),
        density_g_per_cm3: vec![1.0, 3.0],
        class: vec![1, 1],
        class_materials: vec![0],
        truncated_at_faces: false,
        unknown: Vec::new(),
    };
    let mut scene = scene(&["water"], vec![volume(made)]);
    let central = |scene: &Scene| Reference::new(scene, &view(600.0)).expect("good").area_densities([31.5, 23.5])[0];
    assert!((central(&scene) - 0.2).abs() < 1e-15, "between the voxels the trilinear field has their mean");
    scene.model.voxels = Voxels::PiecewiseConstant;
    assert_eq!(central(&scene), 0.1 * 3.0);
}

#[test]
fn the_fast_path_refuses_and_the_plan_names_it() {
    let mut dice = Dice::new(42);
    let mut scene = scene(
        &["water", "bone_cortical"],
        vec![volume(random_volume(&mut dice, [3, 3, 3], DAffine3::from_translation(DVec3::NEG_ONE)))],
    );
    scene.view = Some(view(600.0));
    scene.model.voxels = Voxels::PiecewiseConstant;
    let mut renderer = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu");
    let fast = Options { quantity: Quantity::LineIntegral, ..Options::default() };
    let error = renderer.render(&scene, &fast).expect_err("the reference only");
    assert!(matches!(error, RenderError::ReferenceOnly { .. }) && error.to_string().contains("--reference"), "{error}");
    let slow = Options { reference: true, ..fast.clone() };
    let plan = renderer.plan(&scene, &slow).expect("planned");
    assert_eq!(plan.sampling, Sampling::PiecewiseConstant);
    assert!(plan.explain().contains("Siddon"), "{}", plan.explain());
    assert_eq!(renderer.render(&scene, &slow).expect("renders").plan["sampling"], "piecewise_constant");
    // A plan that was made for the fast path is refused as well, and a trilinear scene has no trace of the mode.
    scene.model.voxels = Voxels::Trilinear;
    let plan = renderer.plan(&scene, &fast).expect("planned");
    assert!(plan.sampling == Sampling::ExactSlabs && !plan.explain().contains("Siddon"));
    scene.model.voxels = Voxels::PiecewiseConstant;
    let error = renderer.render(&scene, &Options { plan: Some(plan), ..fast }).expect_err("another definition");
    assert!(matches!(error, RenderError::ReferenceOnly { .. }), "{error}");
}

#[derive(Parser)]
struct Typed {
    #[command(flatten)]
    args: RenderArgs,
}

#[test]
fn a_scene_file_names_it() {
    let folder = tempfile::tempdir().expect("folder");
    NiftiFile::int16([2, 2, 2], &[0, 50, 100, 200, 40, 20, 10, 0]).write(&folder.path().join("ct.nii"));
    let scene = |voxels: &str| {
        serde_json::json!({"objects": [{"ct": {"path": "ct.nii"}}],
            "view": {"size_px": [8, 8], "intrinsics": [[1000, 0, 3.5], [0, 1000, 3.5], [0, 0, 1]],
                     "camera_from_lps": [[1, 0, 0, 0.5], [0, 1, 0, 0.5], [0, 0, 1, 300], [0, 0, 0, 1]]},
            "beam": {"mono_kev": 60}, "detector": {"pitch_mm": 0.5}, "model": {"voxels": voxels}})
        .to_string()
    };
    let path = folder.path().join("scene.json");
    let out = folder.path().join("drr.tif");
    let render = |voxels: &str, more: &[&str]| {
        std::fs::write(&path, scene(voxels)).expect("writes");
        let typed = ["render", path.to_str().expect("UTF-8"), "--out", out.to_str().expect("UTF-8"), "--device", "cpu"];
        run(&Typed::parse_from(typed.iter().chain(more)).args, &Reporter::silent()).map_err(|error| error.to_string())
    };
    assert!(render("piecewise_constant", &[]).expect_err("fast").contains("--reference"));
    assert!(!Path::new(&out).exists(), "nothing is written");
    assert_eq!(render("piecewise_constant", &["--reference"]), Ok(0));
    let text = std::fs::read_to_string(folder.path().join("drr.tif.json")).expect("beside it");
    assert!(text.contains("\"sampling\": \"piecewise_constant\"") && text.contains("Siddon"), "{text}");
    assert_eq!(render("trilinear", &[]), Ok(0));
    let error = render("nearest", &["--reference"]).expect_err("no such thing");
    assert!(error.contains("model.voxels") && error.contains("piecewise_constant"), "{error}");
}
