//! The small pictures of a null have volumes of fewer slices, and show the same.

use std::sync::Arc;

use glam::{DAffine3, DQuat, DVec3};
use sidecarm::compare::{NullRenders, NullScatter};
use sidecarm::geometry::{Intrinsics, Rigid, View};
use sidecarm::gpu::DeviceChoice;
use sidecarm::image::Image;
use sidecarm::render::{Options, Quantity, Renderer};
use sidecarm::reporter::Reporter;
use sidecarm::scene::Scene;
use sidecarm::scene::model::{Matter, Object, Volume};
use sidecarm::scene::physics::{Material, Spectrum};

/// Tissue with rods and balls of bone, of 0.9 x 1.1 x 0.8 mm.
fn ct() -> Volume {
    let size = [80, 60, 90];
    let step = DVec3::new(0.9, 1.1, 0.8);
    let middle = 0.5 * DVec3::from_array(size.map(|n| n as f64 - 1.0));
    let mut density_g_per_cm3 = Vec::new();
    let mut class = Vec::new();
    for k in 0..size[2] {
        for j in 0..size[1] {
            for i in 0..size[0] {
                let at = (DVec3::new(i as f64, j as f64, k as f64) - middle) * step;
                let inside = (at / DVec3::new(34.0, 30.0, 34.0)).length() < 1.0;
                let ball = [(-12.0, 5.0, 9.0), (14.0, -6.0, -11.0), (3.0, 12.0, -20.0)]
                    .into_iter()
                    .any(|(x, y, z)| at.distance(DVec3::new(x, y, z)) < 6.0);
                let rod = (at.x - 0.3 * at.z + 4.0).hypot(at.y + 8.0) < 3.0;
                let (density, own) = match (inside, ball || rod) {
                    (false, _) => (0.0, 0),
                    (true, false) => (1.0 + 0.05 * (0.3 * at.x).sin(), 1),
                    (true, true) => (1.7, 2),
                };
                density_g_per_cm3.push(density as f32);
                class.push(own);
            }
        }
    }
    let lps_from_voxel = DAffine3::from_scale_rotation_translation(step, DQuat::IDENTITY, -middle * step);
    let (class_materials, truncated_at_faces, unknown) = (vec![0, 1], false, Vec::new());
    Volume { size, lps_from_voxel, density_g_per_cm3, class, class_materials, truncated_at_faces, unknown }
}

fn scene(view: View) -> Scene {
    let mut scene = Scene::plain(Spectrum::mono(60.0).expect("inside"));
    scene.materials = ["soft_tissue", "bone_cortical"].map(|name| Material::parse(name).expect("known")).to_vec();
    let object = |volume: Volume| Object { name: "ct".into(), body: "specimen".into(), matter: Matter::Volume(Arc::new(volume)) };
    scene.objects.push(object(ct()));
    scene.detector.pitch_mm = 1.5;
    scene.view = Some(view);
    scene
}

/// Seen along z, obliquely by `turn_deg`; 1 mm of the specimen is a pixel.
fn view(turn_deg: f64, shift_mm: f64) -> View {
    let turn = DQuat::from_rotation_y(turn_deg.to_radians());
    View {
        size_px: [96, 80],
        intrinsics: Intrinsics { fx: 700.0, fy: 700.0, skew: 0.0, cx: 47.5, cy: 39.5 },
        camera_from_lps: Rigid { rotation: turn, translation_mm: DVec3::new(shift_mm, 0.0, 700.0) },
    }
}

/// Root mean square of what differs, as a share of the contrast of the first.
fn change(a: &Image<f32>, b: &Image<f32>) -> f64 {
    let n = a.pixels.len() as f64;
    let mean = a.pixels.iter().map(|v| f64::from(*v)).sum::<f64>() / n;
    let contrast = a.pixels.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>();
    (a.pixels.iter().zip(&b.pixels).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>() / contrast).sqrt()
}

#[test]
fn fewer_slices_show_the_same_and_a_millimetre_shows_more() {
    for turn_deg in [0.0, 12.0, 40.0, 90.0] {
        let scene = scene(view(turn_deg, 0.0));
        let mut renderer = Renderer::new(DeviceChoice::Cpu, &Reporter::silent()).expect("a processor");
        let thin = renderer.thinned(&scene, &view(turn_deg, 0.0));
        let slices = thin[0].matter.volumes()[0].size;
        assert_eq!(slices, if turn_deg == 90.0 { [40, 60, 90] } else { [80, 60, 45] }, "{turn_deg}");
        let whole = |renderer: &mut Renderer, view: View| {
            let options = Options { quantity: Quantity::LineIntegral, ..Options::default() };
            renderer.render(&Scene { view: Some(view), ..scene.clone() }, &options).expect("rendered").pages.remove(0)
        };
        let [exact, moved] = [0.0, 1.0].map(|mm| whole(&mut renderer, view(turn_deg, mm)));
        let mut renders = NullRenders::new(&mut renderer, &scene, None, NullScatter::default());
        let [small, small_moved] = [0.0, 1.0].map(|mm| renders.render(&view(turn_deg, mm)).expect("rendered"));
        let (off, seen, small_seen) = (change(&exact, &small), change(&exact, &moved), change(&small, &small_moved));
        println!("{turn_deg} degrees: off by {off:.4}, a millimetre is {seen:.4}, and {small_seen:.4} in the small pictures");
        assert!(off > 0.0 && off < 0.05 && off < 0.5 * seen, "{turn_deg}: {off} {seen}");
        assert!((small_seen / seen - 1.0).abs() < 0.05, "a millimetre shows as much: {small_seen} {seen}");
        // What was prepared of the scene itself is still there, and renders the same.
        assert_eq!(whole(&mut renderer, view(turn_deg, 0.0)).pixels, exact.pixels);
    }
}
