//! Lung through the shaders: the random volumes of their other tests are of 0.3 g/cm³ and more.

use std::sync::Arc;

use glam::{DQuat, DVec3};
use serde_json::{Value, json};
use sidecarm::geometry::Rigid;
use sidecarm::gpu::DeviceChoice;
use sidecarm::render::{Options, Quantity, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::model::Matter;
use sidecarm::scene::{self, Scene};

use crate::render_scenes::{software_vulkan, worst};
use crate::scene_air::{chest, labels};

/// 20 cm of −850 HU between walls of tissue, as thin soft tissue by the threshold and as a class of its own, along the voxels and at a slant.
#[test]
fn shaders_see_lung_as_the_reference_does() {
    let Some(mut vulkan) = software_vulkan() else { return };
    let folder = tempfile::tempdir().expect("folder");
    chest().write(&folder.path().join("ct.nii"));
    std::fs::write(folder.path().join("labels.nii"), labels(&[])).expect("writes");
    let scene = |materials: &Value, angle_rad: f64| {
        let text = json!({
            "objects": [{"ct": {"path": "ct.nii", "materials": materials}}],
            "view": {"size_px": [32, 24], "intrinsics": [[500, 0, 15.5], [0, 500, 11.5], [0, 0, 1]],
                     "camera_from_lps": [[0, 1, 0, 38], [0, 0, -1, 38], [-1, 0, 0, 400], [0, 0, 0, 1]]},
            "beam": {"mono_kev": 60}, "detector": {"pitch_mm": 2.0}
        });
        let path = folder.path().join("scene.json");
        let mut scene = scene::load_text(&text.to_string(), &path, true, &Reporter::silent()).expect("good");
        // About the patient's axis through the middle of the trunk.
        if let Some(view) = &mut scene.view {
            let lps_from_middle = Rigid::translation(DVec3::new(-110.0, -38.0, 38.0));
            let turn = Rigid::rotation(DQuat::from_rotation_z(angle_rad));
            view.camera_from_lps = view.camera_from_lps * lps_from_middle * turn * lps_from_middle.inverse();
        }
        scene
    };
    let quantity = Quantity::LineIntegral;
    let mut yardstick = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("cpu");
    let mut truth_of = |scene: &Scene| {
        let options = Options { quantity, reference: true, ..Options::default() };
        yardstick.render(scene, &options).expect("renders").pages.remove(0).pixels
    };
    let named = json!({"labels": "labels.nii", "default": "soft_tissue", "map": {"1": "lung", "2": "soft_tissue"}});
    let mut cases = 0;
    for (materials, has_class) in [(json!("threshold"), false), (named, true)] {
        for angle_rad in [0.0, 0.3] {
            let scene = scene(&materials, angle_rad);
            assert_eq!(scene.materials.iter().any(|material| material.name == "lung"), has_class);
            let truth = truth_of(&scene);
            let gpu = vulkan.render(&scene, &Options { quantity, ..Options::default() }).expect("renders");
            assert_eq!(gpu.plan["executor"], "wgsl", "{:?}", gpu.notes);
            let found = &gpu.pages[0].pixels;
            println!("{materials}, {angle_rad} rad: shaders and yardstick differ by {:.1e} at most", worst(found, &truth));
            assert!(worst(found, &truth) <= gpu.stated_error, "{materials}, {angle_rad}: {:e}", worst(found, &truth));
            // The control: the lung alone, a per cent denser.
            let mut denser = scene.clone();
            let Matter::Volume(volume) = &mut denser.objects[0].matter else { panic!("a volume") };
            let densities = Arc::make_mut(volume).density_g_per_cm3.iter_mut();
            densities.filter(|density| **density > 0.0 && **density < 0.3).for_each(|density| *density *= 1.01);
            assert!(worst(found, &truth_of(&denser)) > 2.0 * gpu.stated_error, "the control: {materials}, {angle_rad}");
            cases += 1;
        }
    }
    assert_eq!(cases, 4);
}
