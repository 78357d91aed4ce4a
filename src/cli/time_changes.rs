//! What a change of the scene costs: only what changed should be made anew.

use std::sync::Arc;

use glam::DVec3;
use serde::Serialize;

use crate::render::{Options, RenderError, Renderer};
use crate::scene::Scene;
use crate::scene::model::Matter;
use crate::time::Stopwatch;

/// A kind of change, and what the first image after it took (median over several).
#[derive(Clone, Debug, Serialize)]
pub struct Change {
    /// `nothing`, `robot`, `c_arm`, `spectrum` or `ct`.
    pub what: &'static str,
    /// Planning, refitted energies included.
    pub plan_ms: f64,
    /// Preparation of volumes and shapes, where planning has not done it.
    pub prepare_ms: f64,
    /// Everything.
    pub wall_ms: f64,
}

type Alter = fn(&mut Scene, u32);

const CHANGES: [(&str, Alter); 5] =
    [("nothing", |_, _| ()), ("robot", move_robot), ("c_arm", move_c_arm), ("spectrum", harden), ("ct", replace_ct)];

/// Times the first image after each kind of change, `repeat` times.
///
/// # Errors
/// As [`Renderer::render`].
pub fn measure(scene: &Scene, renderer: &mut Renderer, options: &Options, repeat: usize) -> Result<Vec<Change>, RenderError> {
    let mut found = Vec::new();
    for (what, alter) in CHANGES {
        let mut scene = scene.clone();
        let mut rounds = Vec::new();
        renderer.render(&scene, options)?;
        for round in 0..repeat.max(1) {
            alter(&mut scene, round as u32 + 1);
            let watch = Stopwatch::start();
            let rendered = renderer.render(&scene, options)?;
            let stage = |name| rendered.stages.get(name).unwrap_or(0.0);
            rounds.push(Change { what, plan_ms: stage("plan"), prepare_ms: stage("prepare"), wall_ms: watch.ms() });
        }
        rounds.sort_by(|a, b| a.wall_ms.total_cmp(&b.wall_ms));
        found.push(rounds.swap_remove(rounds.len() / 2));
    }
    Ok(found)
}

/// Shapes and meshes half a millimetre further on.
fn move_robot(scene: &mut Scene, _: u32) {
    let by = DVec3::new(0.5, 0.0, 0.0);
    for object in &mut scene.objects {
        match &mut object.matter {
            Matter::Solids(solids) => solids.iter_mut().for_each(|solid| solid.lps_from_local.translation_mm += by),
            Matter::Mesh(mesh) => Arc::make_mut(mesh).vertices_lps_mm.iter_mut().for_each(|vertex| *vertex += by),
            Matter::Volume(_) | Matter::Parts(_) => {}
        }
    }
}

fn move_c_arm(scene: &mut Scene, _: u32) {
    if let Some(view) = &mut scene.view {
        view.camera_from_lps.translation_mm.x += 0.5;
    }
}

/// Another shape of the spectrum, as another tube voltage or filter makes it.
fn harden(scene: &mut Scene, round: u32) {
    for bin in &mut scene.beam.spectrum.bins {
        bin.fluence *= (f64::from(round) * 1e-3 * bin.energy_kev).exp();
    }
}

/// The same voxels as new ones.
fn replace_ct(scene: &mut Scene, _: u32) {
    for object in &mut scene.objects {
        if let Matter::Volume(volume) = &mut object.matter {
            *volume = Arc::new((**volume).clone());
        }
    }
}
