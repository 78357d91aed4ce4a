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
