//! The whole of it in one call.

use std::convert::Infallible;

use super::error::TransportError;
use super::image::ScatterImage;
use super::simulation::{Histories, Simulation};
use crate::geometry::View;
use crate::scene::model::Scene;

/// Primary and scattered radiation of `scene` seen in `view`, with its own beam and detector; `progress` hears how many histories are done.
///
/// # Errors
/// When the scene has no detector, no photons, or densities that are no numbers, or attenuation is not tabulated.
pub fn scatter(
    scene: &Scene,
    view: &View,
    histories: Histories,
    progress: &mut dyn FnMut(u64),
) -> Result<ScatterImage, TransportError> {
    let simulation = Simulation::new(scene, view, histories)?;
    let mut tally = simulation.tally();
    let run = simulation.run(&mut tally, |tally| {
        progress(tally.histories());
        Ok::<(), Infallible>(())
    });
    match run {
        Ok(()) => Ok(simulation.image(&tally)),
        Err(never) => match never {},
    }
}
