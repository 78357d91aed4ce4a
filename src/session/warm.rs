//! What the first frame of a session would wait for, done before it comes.

use glam::DVec3;

use super::crosscheck::choose_view;
use super::develop::Bench;
use super::file::Setup;
use crate::acquire::{Domain, Frame};
use crate::beads::{Expectation, detect};
use crate::compare::{CompareInput, compare};
use crate::mask;
use crate::render::{Options, Quantity};
use crate::reporter::Reporter;

impl Bench {
    /// Of the renderer, and as long as no frame `waits` of what comes before and after it, so
    /// that tables and memory are there.
    pub(super) fn warm(&mut self, waits: impl Fn() -> bool) {
        let beads = self.layout.iter().flat_map(|layout| &layout.beads).map(|bead| bead.lps_mm);
        let places: Vec<DVec3> = beads.chain(self.centre()).collect();
        let Setup { carm, session, .. } = &self.setup;
        let Ok(view) = choose_view(carm.as_ref(), session.world_from_lps, &places, &self.scene) else { return };
        let options = Options { quantity: Quantity::LineIntegral, ..Options::default() };
        // What is wrong with the scene is said when a frame is rendered.
        if self.renderer.warm(&self.scene, view, &options).is_err() || waits() {
            return;
        }
        let scene = self.scene.with_view(view);
        if let Some(network) = &self.network {
            // What it says of a view that nobody has is nobody's concern.
            let _ = network.say(&scene, &view, &Reporter::silent());
        }
        let Ok(rendered) = self.renderer.render(&scene, &options) else { return };
        let Ok(frame) = Frame::from_pixels("none", rendered.pages[0].clone(), Domain::Log) else { return };
        let masks = mask::of_frame(&frame);
        if !waits() {
            drop(detect(&frame, None, &Expectation::default()));
        }
        if !waits() {
            let input = CompareInput { masks: Some(&masks), ..CompareInput::new(&frame, &rendered.pages[0]) };
            let _ = compare(&input);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::mpsc::channel;

    use glam::{DAffine3, DQuat};
    use serde_json::json;

    use super::super::inputs::InputNames;
    use super::super::jobs::Order;
    use super::super::posed::Posed;
    use super::super::workshop::Workshop;
    use super::*;
    use crate::geometry::Rigid;
    use crate::gpu::DeviceChoice;
    use crate::image::Image;
    use crate::render::{Made, Renderer};
    use crate::scene::Scene;
    use crate::scene::model::{Matter, Object, Volume};
    use crate::scene::physics::{Material, Spectrum};

    /// Voxels along the edge of the CT, and their side.
    const EDGE: usize = 12;
    const STEP_MM: f64 = 8.0;

    /// A ball of tissue with a core of bone about the origin.
    fn scene() -> Scene {
        let filter = [(Material::parse("Al").expect("known"), 4.0)];
        let mut scene = Scene::plain(Spectrum::tungsten(90.0, 12.0, &filter).expect("inside"));
        let class_materials =
            ["soft_tissue", "bone_cortical"].map(|name| scene.material_index(Material::parse(name).expect("known"))).to_vec();
        let middle = 0.5 * (EDGE as f64 - 1.0);
        let class = |voxel: usize| {
            let at = [voxel % EDGE, voxel / EDGE % EDGE, voxel / (EDGE * EDGE)].map(|n| n as f64 - middle);
            match DVec3::from_array(at).length() {
                r if r < 2.0 => 2u8,
                r if r < 4.5 => 1,
                _ => 0,
            }
        };
        let class: Vec<u8> = (0..EDGE * EDGE * EDGE).map(class).collect();
        let ct = Volume {
            size: [EDGE; 3],
            lps_from_voxel: DAffine3::from_scale_rotation_translation(
                DVec3::splat(STEP_MM),
                DQuat::IDENTITY,
                DVec3::splat(-STEP_MM * middle),
            ),
            density_g_per_cm3: class.iter().map(|class| [0.0, 1.02, 1.8][usize::from(*class)]).collect(),
            class,
            class_materials,
            truncated_at_faces: false,
            unknown: Vec::new(),
        };
        scene.objects.push(Object { name: "ct".to_owned(), body: String::new(), matter: Matter::Volume(Arc::new(ct)) });
        scene.detector.pitch_mm = 3.88;
        scene
    }

    fn setup() -> Setup {
        let carm = json!({
            "origin": "test", "columns_px": 62, "rows_px": 48, "pitch_mm": 3.88, "source_to_isocentre_mm": 630.0,
            "source_to_detector_mm": 1020.0, "column_to_isocentre_mm": [800.0, 0.0, 1000.0]
        });
        let session = json!({"carm": {"port": "x", "calibration": "x"}, "frames": {"folder": "x"}, "scene": "x"});
        serde_json::from_value(
            json!({"session": session, "carm": carm, "robot": null, "beads": null, "scene_json": "{}", "scene_path": "x"}),
        )
        .expect("a setup")
    }

    /// What the DRR of a session's first frame had to make that was not there: from the side, whence nobody looked before.
    fn made_for_the_first_frame(order: Order) -> Made {
        let (scene, setup, reporter) = (scene(), setup(), Reporter::silent());
        let mut view = choose_view(setup.carm.as_ref(), None, &[DVec3::ZERO], &scene).expect("a view");
        let Rigid { rotation, translation_mm } = view.camera_from_lps;
        view.camera_from_lps = Rigid { rotation: DQuat::from_rotation_y(1.4) * rotation, translation_mm };
        let frame = Frame::from_pixels("a", Image::filled(62, 48, 1.0f32), Domain::Linear).expect("a frame");
        let masks = Arc::new(mask::of_frame(&frame));
        let posed = Posed { frame: Arc::new(frame), masks, view: Some(view), ..Posed::bare(1) };
        let names = InputNames::of(&setup, &scene.inputs);
        let renderer = Renderer::new(DeviceChoice::Cpu, &reporter).expect("cpu");
        let mut workshop = Workshop::with_scene((scene, names), None, &setup, renderer, &reporter).expect("opens");
        let (pairs, developed) = channel();
        // However soon it comes, it waits until the renderer is warm.
        workshop.submit(posed, None);
        workshop.start(order, move |pair| pairs.send(pair).is_ok()).expect("starts");
        workshop.close();
        let first = developed.recv().expect("a pair");
        workshop.abandon();
        drop(developed);
        workshop.join().expect("it ends well");
        let reasons = first.pair.reason.clone();
        first.drr.unwrap_or_else(|| panic!("a DRR, not {reasons:?}")).0.made
    }

    /// A session's first frame waited for seconds that the session had spent waiting for it. Counted, not timed: nothing of what its DRR
    /// needs is left to be made.
    #[test]
    fn the_first_frame_finds_all_made_that_the_session_could_make_while_it_waited() {
        assert_eq!(made_for_the_first_frame(Order::NewestFirst), Made::default());
        // The control: where nobody warmed it up.
        let cold = made_for_the_first_frame(Order::AsHandedIn);
        assert!(cold.volumes == 1 && cold.copies > 0 && cold.fits > 0, "{cold:?}");
    }
}
