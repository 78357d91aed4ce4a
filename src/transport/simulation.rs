//! A scene and a view ready to transport: batches of histories on all cores, added up in their order.

use rayon::prelude::*;

use super::attenuation::Attenuation;
use super::compton::Compton;
use super::dose_grid::DoseGrid;
use super::error::TransportError;
use super::flight::{Medium, Space};
use super::history::{Estimator, Material, World};
use super::mass::masses;
use super::matter::things_of;
use super::panel::Panel;
use super::rayleigh::Rayleigh;
use super::source::Source;
use super::stream::Stream;
use super::tally::{Batch, Estimate, FEWEST, Tally};
use crate::estimate::median;
use crate::geometry::View;
use crate::scene::model::{Formation, Matter, Scene};

/// Histories of one batch: enough to be worth a thread's while, few enough that a short run has a spread.
pub const BATCH: u64 = 4096;

/// Batches that are in memory at once, by pixels of their pages.
const PIXELS_AT_ONCE: usize = 64 * 4 * 64 * 48;

/// Most histories that a counter takes.
const MOST_HISTORIES: u64 = 1_000_000_000_000_000;

/// What is asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Histories {
    /// Photons to follow, rounded up to whole batches of [`BATCH`].
    pub count: u64,
    /// Seed.
    pub seed: u64,
    /// Columns and rows of the raster that scores.
    pub grid_px: [usize; 2],
    /// How.
    pub estimator: Estimator,
    /// Stop before `count` once the median over pixels of the scatter's relative standard error is no larger.
    pub rel_error: Option<f64>,
}

impl Default for Histories {
    fn default() -> Self {
        Self { count: 1_000_000, seed: 1, grid_px: [64, 48], estimator: Estimator::default(), rel_error: None }
    }
}

/// A scene in a view, ready to run.
pub struct Simulation<'a> {
    world: World<'a>,
    histories: Histories,
    unattenuated: Vec<f64>,
}

impl<'a> Simulation<'a> {
    /// Prepares `scene` seen in `view`.
    ///
    /// # Errors
    /// When the scene has no detector, no photons or none on the principal ray, or densities that are no numbers, or attenuation is not tabulated.
    pub fn new(scene: &'a Scene, view: &View, histories: Histories) -> Result<Self, TransportError> {
        if scene.model.formation == Formation::Naive {
            return Err(TransportError::Naive);
        }
        if !(1..=MOST_HISTORIES).contains(&histories.count) {
            return Err(TransportError::Histories { histories: histories.count });
        }
        if let Some(value) = histories.rel_error.filter(|value| !(*value > 0.0)) {
            return Err(TransportError::RelError { value });
        }
        check_densities(scene)?;
        let panel = Panel::new(scene, view, histories.grid_px)?;
        let source = Source::new(scene, &panel)?;
        let unattenuated = source.unattenuated(&panel);
        let material = |material: &crate::scene::physics::Material| {
            Ok(Material {
                attenuation: Attenuation::new(material)?,
                compton: Compton::new(material)?,
                rayleigh: Rayleigh::new(material)?,
            })
        };
        let materials = scene.materials.par_iter().map(material).collect::<Result<Vec<_>, TransportError>>()?;
        let space = Space::new(things_of(scene), panel.axes[2]);
        let world = World { source, panel, space, materials, estimator: histories.estimator, dose: None };
        let simulation = Self { world, histories, unattenuated };
        if !simulation.histories_of_exposure(scene.beam.photons_per_pixel).is_finite() {
            return Err(TransportError::DarkPrincipalRay);
        }
        Ok(simulation)
    }

    /// The same, where the dose is booked by voxel as well, on at most `most_voxels` over `scene`, of which it was made. An empty scene has none.
    #[must_use]
    pub fn with_dose(mut self, scene: &Scene, most_voxels: usize) -> Self {
        self.world.dose = self.world.space.as_ref().map(|space| DoseGrid::new(scene, &space.cells.bounds(), most_voxels));
        self
    }

    /// What photons are followed in.
    pub(super) fn world(&self) -> &World<'a> {
        &self.world
    }

    /// What was asked for.
    #[must_use]
    pub fn histories(&self) -> &Histories {
        &self.histories
    }

    /// What one history adds on average to each pixel with nothing in the beam, keV or photons.
    #[must_use]
    pub fn unattenuated(&self) -> &[f64] {
        &self.unattenuated
    }

    /// [`Self::unattenuated`] without heel and bow-tie.
    #[must_use]
    pub fn unshaped(&self) -> Vec<f64> {
        self.world.source.unshaped(&self.world.panel)
    }

    /// Number of scene materials.
    #[must_use]
    pub fn materials(&self) -> usize {
        self.world.materials.len()
    }

    /// Grams of each scene material, with what drawing points leaves uncertain of them.
    #[must_use]
    pub fn masses_g(&self) -> Vec<Estimate> {
        match &self.world.space {
            Some(space) => masses(space, self.materials()),
            None => vec![Estimate { mean: 0.0, standard_error: 0.0 }; self.materials()],
        }
    }

    /// Histories of an exposure that brings `photons_per_pixel` to a pixel of the image on the principal ray with nothing in the beam, behind
    /// filters and bow-tie, were the collimator open there.
    #[must_use]
    pub fn histories_of_exposure(&self, photons_per_pixel: f64) -> f64 {
        let World { source, panel, .. } = &self.world;
        photons_per_pixel / (panel.image_pixel_area_mm2() * source.on_principal_ray_per_mm2())
    }

    /// An empty tally for this scene.
    #[must_use]
    pub fn tally(&self) -> Tally {
        let tally = Tally::new(self.world.panel.pixels(), self.materials(), BATCH);
        match &self.world.dose {
            Some(dose) => tally.with_dose(dose.grid.voxels()),
            None => tally,
        }
    }

    /// Batches that are asked for.
    #[must_use]
    pub fn batches(&self) -> u64 {
        self.histories.count.div_ceil(BATCH)
    }

    /// Runs until all histories or the wanted precision are there, and says after every step how many batches are done.
    ///
    /// # Errors
    /// What `after` says.
    pub fn run<E>(&self, tally: &mut Tally, mut after: impl FnMut(&Tally) -> Result<(), E>) -> Result<(), E> {
        while !self.is_done(tally) {
            // Steps end at the same batches whether or not a run was interrupted: that is where precision is judged.
            let step = self.batches_at_once();
            let end = ((tally.batches / step + 1) * step).min(self.batches());
            self.advance(tally, end - tally.batches);
            after(tally)?;
        }
        Ok(())
    }

    /// Whether all histories or the wanted precision are there.
    #[must_use]
    pub fn is_done(&self, tally: &Tally) -> bool {
        let is_precise = || self.histories.rel_error.is_some_and(|wanted| self.stated_error(tally) <= wanted);
        tally.batches >= self.batches() || tally.batches.is_multiple_of(self.batches_at_once()) && is_precise()
    }

    /// Median over the pixels of the relative standard error of the scatter, however little came; infinite where most have none.
    #[must_use]
    pub fn relative_error(&self, tally: &Tally) -> f64 {
        if tally.batches < 2 {
            return f64::INFINITY;
        }
        let of_pixel = |pixel: usize| {
            let found = tally.scatter(pixel);
            if found.mean > 0.0 { found.standard_error / found.mean } else { f64::INFINITY }
        };
        median((0..self.unattenuated.len()).map(of_pixel)).unwrap_or(f64::INFINITY)
    }

    /// [`Self::relative_error`]; infinite where less came to the median pixel than tells it ([`Estimate::told`]).
    #[must_use]
    pub fn stated_error(&self, tally: &Tally) -> f64 {
        let error = self.relative_error(tally);
        if error * FEWEST.sqrt() <= 1.0 { error } else { f64::INFINITY }
    }

    /// Batches that run side by side: [`Simulation::advance`] takes at most so many.
    #[must_use]
    pub fn batches_at_once(&self) -> u64 {
        (PIXELS_AT_ONCE / (4 * self.world.panel.pixels())).clamp(4, 256) as u64
    }

    /// Runs the next `batches`, on all cores of rayon's current pool. The result does not depend on how many there are.
    pub fn advance(&self, tally: &mut Tally, batches: u64) {
        let first = tally.batches;
        let run = |number: u64| self.batch(number);
        let done: Vec<Batch> = (first..first + batches).into_par_iter().map(run).collect();
        done.iter().for_each(|batch| tally.add(batch));
    }

    fn batch(&self, number: u64) -> Batch {
        let mut batch = Batch::new(self.world.panel.pixels(), self.materials());
        let (mut medium, mut aside) = (Medium::default(), Medium::default());
        for history in number * BATCH..(number + 1) * BATCH {
            let mut stream = Stream::new(self.histories.seed, history);
            self.world.run(&mut stream, &mut medium, &mut aside, &mut batch);
        }
        batch.settled()
    }
}

fn check_densities(scene: &Scene) -> Result<(), TransportError> {
    for object in &scene.objects {
        let is_wrong = |density: &f64| !(*density >= 0.0 && density.is_finite());
        let wrong = match &object.matter {
            Matter::Solids(solids) => solids.iter().map(|solid| solid.density_g_per_cm3).find(is_wrong),
            Matter::Mesh(mesh) => Some(mesh.density_g_per_cm3).filter(is_wrong),
            Matter::Volume(_) | Matter::Parts(_) => {
                let volumes = object.matter.volumes().iter();
                volumes.flat_map(|volume| &volume.density_g_per_cm3).map(|density| f64::from(*density)).find(is_wrong)
            }
        };
        if let Some(value) = wrong {
            return Err(TransportError::Density { name: object.name.clone(), value });
        }
    }
    Ok(())
}
